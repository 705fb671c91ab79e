//! The benchmark's robots in MuJoCo: models, environments, rollouts, and the replay of stored transitions.
//!
//! | question | answer |
//! |---|---|
//! | Which model? | [`models::mjcf`]: generated from one description per robot and a shift |
//! | One environment? | [`Env`] |
//! | A data set? | [`collect`] |
//! | A policy's returns? | [`evaluate`] |
//! | What does it look like? | [`evaluate_recorded`], then a [`video::Video`] of the recordings |
//! | Do stored transitions follow the dynamics? | [`replay`] (whole data sets), [`simulate`] (single rows) |
//! | Is MuJoCo available? | [`open_library`], called before a command starts; everything else opens it automatically |
//! | Would a generated state end the episode? | [`terminal_rule`] |
//!
//! ```
//! use tce_base::Streams;
//! use tce_data::{Agent, Shift};
//! use tce_sim::Env;
//!
//! let mut hopper = Env::new(Agent::Hopper, Shift::Morph)?;
//! let mut observation = vec![0.0; Agent::Hopper.dims().0];
//! hopper.reset(&mut Streams::new(0).stream("reset"), &mut observation);
//! let step = hopper.step(&[0.0; 3], &mut observation);
//! // It stands: one reward for being alive, and no action to pay for.
//! assert!(!step.terminal && (step.reward - 1.0).abs() < 0.1);
//! # Ok::<(), tce_sim::SimError>(())
//! ```

mod actor;
mod analysis;
mod env;
mod error;
mod library;
pub mod models;
mod recording;
mod replay;
mod rollout;
pub mod video;

pub use actor::{Actor, UniformActor};
pub use analysis::{Simulated, simulate};
pub use env::{EPISODE_LIMIT, Env, StepResult, terminal_rule};
pub use error::LibraryError;
pub use error::SimError;
pub use library::open as open_library;
pub use recording::{Ending, Recording};
pub use replay::{Quantiles, ReplayReport, replay};
pub use rollout::{CollectOptions, EpisodeResult, collect, evaluate, evaluate_recorded};
