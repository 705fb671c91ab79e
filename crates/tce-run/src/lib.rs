//! Runs: configuration, presets and variants, stages with their files, the pipeline, verdicts, diagnoses and sweeps.
//!
//! | question | module |
//! |---|---|
//! | Which settings are there, and where does a value come from? | [`config`], [`layers`], [`keys`], [`variant`] |
//! | Which learners are there? | [`learners`] |
//! | What is stored, and when is work done? | [`stage`], [`kept`] |
//! | A whole run of the benchmark? | [`pipeline`] |
//! | A training on own tables? | [`training_run`] |
//! | Generated rows? | [`augment`], [`mixture`] |
//! | Which policy is best, without a simulator? | [`off_policy_evaluation`], [`verdict`] |
//! | Can generated rows be trusted? | [`diagnosis`] |
//! | Many runs? | [`sweep`], [`study`] |
//!
//! ```
//! use tce_run::layers::{Layered, Preset};
//!
//! // A preset, and a value on top of it.
//! let set = ["generator.y_max=0.1".to_owned()];
//! let config = Layered::new(Preset::Default, None, None, None, &set)?.config()?;
//! assert_eq!((config.generator.y_max, config.learner.bc.ensemble), (0.1, 5));
//! # Ok::<(), tce_run::error::Error>(())
//! ```

pub mod augment;
mod clock;
mod clones;
pub mod config;
pub mod course;
pub mod device_kind;
pub mod diagnosis;
pub mod error;
pub mod inputs;
pub mod kept;
pub mod keys;
pub mod layers;
pub mod learners;
pub mod methods;
pub mod mixture;
pub mod off_policy_evaluation;
pub mod own;
pub mod pipeline;
pub mod policy_training;
pub mod recipe;
pub mod stage;
pub mod study;
pub mod sweep;
pub mod tables;
pub mod task_data;
mod titles;
pub mod training_run;
pub mod variant;
pub mod verdict;
pub mod wrong_keys;

pub use error::{Error, Result};
