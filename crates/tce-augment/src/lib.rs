//! Coverage expansion on transitions in memory: fit, sample, filter and label. No files, no stages, no simulator.
//!
//! | question | answer |
//! |---|---|
//! | The whole method on two tables? | [`Augmenter`] |
//! | TCE's two score networks alone? | [`two_stage`] |
//! | One network over whole transitions (SynthER, DmC)? | [`single_stage`] |
//! | The filter and the labels of state pairs? | [`finish`] |
//! | Source and generated rows in one table? | [`mixture`] |
//! | Checkpoints, metrics, chunks on disk? | the caller's: [`work::Keeper`] |
//!
//! ```
//! use tce_base::OrAuto;
//! use tce_augment::{Augmenter, Settings, Work, on_cpu};
//! use tce_data::Transitions;
//!
//! // A point that moves by its action; the changed robot moves half as far. Source and target would be your logs.
//! let walk = |gain: f32, rows: usize| {
//!     let mut t = Transitions::new(2, 1);
//!     for i in 0..rows {
//!         let (x, v) = ((i as f32 * 0.37).sin(), (i as f32 * 0.11).cos());
//!         let action = (i as f32 * 1.7).sin();
//!         t.push(&[x, v], &[action], x, &[x + gain * action, v], false, false);
//!     }
//!     t
//! };
//! let (source, target) = (walk(0.2, 400), walk(0.1, 100));
//!
//! // The recommended settings, cut short.
//! let mut settings = Settings::recommended();
//! settings.generator.state_steps = OrAuto::Given(20);
//! settings.generator.transition_steps = OrAuto::Given(20);
//! settings.labels.training.steps = 20;
//!
//! let device = on_cpu();
//! let augmenter = Augmenter::fit(&source, &target, &settings, None, &Work::new(&[0], &device))?;
//! let pairs = augmenter.sample(50, 0.2, &[0])?;
//! let rows = augmenter.label(&pairs)?.remove(0).transitions;
//! assert_eq!((rows.obs_dim, rows.act_dim, rows.len()), (2, 1, 50));
//! assert!(rows.actions.iter().all(|a| a.abs() <= 1.0));
//! assert_eq!(pairs, augmenter.sample(50, 0.2, &[0])?, "the same seed gives the same rows");
//! # Ok::<(), tce_augment::Error>(())
//! ```

pub mod augmenter;
pub mod config;
mod error;
pub mod finish;
pub mod mixture;
pub mod score_training;
pub mod single_stage;
pub mod two_stage;
pub mod units;
pub mod work;

pub use augmenter::{Augmenter, Pairs, Settings};
pub use error::{Error, Result};
pub use work::{Work, on_cpu};
