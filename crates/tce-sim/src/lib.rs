//! The benchmark's robots in MuJoCo: models, environments, rollouts, and the replay of stored transitions.
//!
//! | question | answer |
//! |---|---|
//! | Which model? | [`models::mjcf`]: generated from one description per robot and a shift |
//! | One environment? | [`Env`] |
//! | A data set? | [`collect`] |
//! | A policy's returns? | [`evaluate`] |
//! | Do stored transitions follow the dynamics? | [`replay`] (whole data sets), [`simulate`] (single rows) |
//! | Would a generated state end the episode? | [`terminal_rule`] |

mod analysis;
mod env;
mod error;
pub mod models;
mod replay;
mod rollout;

pub use analysis::{Simulated, simulate};
pub use env::{EPISODE_LIMIT, Env, StepResult, terminal_rule};
pub use error::SimError;
pub use replay::{Quantiles, ReplayReport, replay};
pub use rollout::{Actor, CollectOptions, EpisodeResult, UniformActor, collect, evaluate};
