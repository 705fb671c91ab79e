//! What makes a run and keeps it: configurations and their layers, stages, the pipeline, verdicts, diagnoses and sweeps.

pub mod augment;
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
pub mod learning;
pub mod methods;
pub mod mixture;
pub mod off_policy_evaluation;
pub mod own;
pub mod pipeline;
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
