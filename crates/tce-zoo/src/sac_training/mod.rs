//! Trains SAC agents in an environment with D4RL's settings. A training run can be stopped and resumed.
//!
//! Environment steps and updates alternate (by default one to one). The first steps are uniformly random, or come from
//! the policy that the training run starts from. All random numbers are indexed by step, update or episode, and
//! checkpoints are written between episodes. A resumed run therefore gives the same bytes as an uninterrupted one. A
//! step of the simulator takes .06 to .25 ms, an update of 256 rows 10 ms. Parallel runs keep the cores busy;
//! overlapping a step with its update does not. A directory contains
//!
//! | file | content |
//! |---|---|
//! | `settings.json` | all settings that determine the run |
//! | `metrics.jsonl`, `tensorboard/` | losses and evaluations; cut back to the checkpoint when the run is resumed |
//! | `replay-STEP.hdf5`, `learner-STEP.safetensors` | the last checkpoint's replay buffer and networks |
//! | `ledger.json` | the checkpoint: step, episode, evaluations, snapshots, and SHA-256 of both files; written last |
//! | `previous.json` | the ledger of the checkpoint before; its files are kept as a backup if a file is damaged |
//! | `policy-SCORE.safetensors`, `policy.safetensors` | snapshots, and the policy of the last evaluation, each with a card |
//!
//! `settings` has what determines a training run and its goal, `ledger` its checkpoints on disk, `origin` the networks that it starts from,
//! `training` the loop, and `cards` what is written beside a policy.

mod cards;
mod ledger;
mod origin;
mod settings;
mod training;

pub use ledger::{EvaluationSummary, Ledger, Snapshot};
pub use settings::{Goal, Origin, Settings};
pub use training::Training;
