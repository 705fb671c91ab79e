//! What is diagnosed, and what is asked.

use serde::{Deserialize, Serialize};
use tce_data::Task;
use tce_learn::TransitionConfig;

use crate::config::Config;
use crate::inputs::Inputs;

/// What `tce diagnose` is told.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Options {
    /// Rows behind every metric.
    pub rows: usize,
    /// The label bounds.
    pub y_max: Vec<f32>,
    /// Whether the simulator may be used.
    pub simulator: bool,
    /// The transition models.
    pub transition: TransitionConfig,
    /// Updates of the value function.
    pub value_steps: u64,
    /// Abundant target rows.
    pub abundant: usize,
    /// Episodes of the policy that the generator implies.
    pub episodes: usize,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            rows: 4096,
            y_max: vec![0.0, 0.1, 0.2, 0.3, 0.4, 0.5],
            simulator: true,
            transition: TransitionConfig::default(),
            value_steps: 10_000,
            abundant: 100_000,
            episodes: 10,
        }
    }
}

/// What is diagnosed.
pub struct Subject<'a> {
    /// The run's directory, or the target's file.
    pub of: String,
    /// The task, where it is one.
    pub task: Option<Task>,
    /// Both data sets.
    pub inputs: &'a Inputs,
    /// The run's configuration.
    pub config: &'a Config,
    /// All seeds of the run: its networks are one training.
    pub seeds: &'a [u64],
    /// The seed to look at.
    pub seed: u64,
}
