//! Everything that was measured of one run.

use serde::{Deserialize, Serialize};
use tce_data::Task;

use crate::bounds::{Bounds, Choice};
use crate::coverage::Coverage;
use crate::embedding::Embedding;
use crate::implied::{ErrorOverDistance, Implied};
use crate::memorisation::Memorisation;
use crate::numbers::{Histogram, Spread};

/// The outcome of `tce diagnose`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Diagnosis {
    /// The run's directory, or the target's file.
    pub of: String,
    /// The task, where the rows are of one.
    pub task: Option<Task>,
    /// The seed of the generator.
    pub seed: u64,
    /// The run's own y_max.
    pub y_max: f64,
    /// The run's own z_th; None without a filter.
    pub z_threshold: Option<f64>,
    /// λ of the run's mixture.
    pub lambda: f64,
    /// Generated rows behind every metric.
    pub rows: usize,
    /// Target rows.
    pub target_rows: usize,
    /// States of each domain that coverage is counted over, and covering rows; those are no reference rows.
    pub coverage_rows: usize,
    /// Coverage by as many other target rows. None where rows are too few.
    pub covered_by_target: Option<Coverage>,
    /// Whether those are of other episodes, as fresh rows are.
    pub covered_by_fresh: bool,
    /// Metrics over y_max, ascending.
    pub bounds_of_y: Vec<AtBound>,
    /// The rows as they are drawn under the run's own y_max.
    pub sampled: Sampled,
    /// Source, nearest source, target and generated transitions in the plane (Fig. 1a).
    pub transitions: Option<Embedding>,
    /// Source, target and generated states in the plane (Fig. 3 a.1), by y_max.
    pub states: Vec<(f64, Embedding)>,
    /// Inverse dynamics and reward model.
    pub labels: Labels,
    /// The policy that the generator implies; None in files from before it was measured.
    #[serde(default)]
    pub implied: Option<Implied>,
    /// Errors of rows over the distance of ŝ to the target; None in files from before it was measured, and without rows.
    #[serde(default)]
    pub error_over_distance: Option<ErrorOverDistance>,
    /// Theorem 1; None without source rows.
    pub theorem: Option<Bounds>,
    /// λ from the data alone.
    pub choice: Option<Choice>,
    /// What the same rule says where the simulator measures, to check `choice` against.
    pub choice_by_simulator: Option<Choice>,
    /// What could not be measured, and why.
    pub notes: Vec<String>,
}

impl Diagnosis {
    /// The metrics at one y_max.
    pub fn at(&self, y_max: f64) -> Option<&AtBound> {
        self.bounds_of_y.iter().find(|b| (b.y_max - y_max).abs() < 1e-9)
    }

    /// The metrics at the run's own y_max.
    pub fn at_own_bound(&self) -> Option<&AtBound> {
        self.at(self.y_max)
    }
}

/// Metrics at one y_max.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AtBound {
    /// The label bound.
    pub y_max: f64,
    /// Rows that hold a number that is not finite. They are part of no metric but `rejected`.
    pub lost: usize,
    /// Coverage by rows that pass the filter; None where too few do, which `Diagnosis::notes` tell.
    pub coverage: Option<Coverage>,
    /// Share of rows that the filter rejects, lost ones among them.
    pub rejected: f64,
    /// Whether rows that pass are copies; None where one episode has most of the target rows, or no row passes.
    pub memorisation: Option<Memorisation>,
    /// Of rows that pass.
    pub kept: Reliability,
    /// Of rows that do not; None if there is none.
    pub outliers: Option<Reliability>,
}

/// How good rows are. Distances are in units of the training states' spread.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Reliability {
    /// Rows.
    pub rows: usize,
    /// Distance of ŝ to the nearest state of source and target (Fig. 3 b.1).
    pub distance: Option<Spread>,
    /// KL between the transition models of the run's and of abundant target rows at (ŝ, â), nats per dimension (Fig. 3 b.2).
    pub transition_kl: Option<Spread>,
    /// |difference| of the reward models of the run's and of abundant target rows at (ŝ, ŝ') (Fig. 3 b.3).
    pub reward_difference: Option<Spread>,
    /// |r̂ − r| with r of the simulator at (ŝ, â).
    pub reward_error: Option<Spread>,
    /// RMS over dimensions of (simulated(ŝ, â) − ŝ') / std(s' − s).
    pub consistency: Option<Spread>,
}

/// Rows under the run's own settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sampled {
    /// ŷ of rows that pass the filter.
    pub y_kept: Histogram,
    /// ŷ of rows that do not.
    pub y_rejected: Histogram,
    /// The largest |z| over the dimensions of (ŝ, ŝ').
    pub z: Histogram,
    /// The same for the real target rows, by their own mean and spread: what the filter does to real data.
    pub z_real: Histogram,
    /// Share of real target rows that the filter would reject.
    pub real_rejected: f64,
}

/// Errors of the label models.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Labels {
    /// RMSE of actions on held-out target rows, and the actions' spread.
    pub held_out_action: Option<(f64, f64)>,
    /// RMSE of rewards on held-out target rows, and the rewards' spread.
    pub held_out_reward: Option<(f64, f64)>,
    /// RMSE of actions and rewards on the source's states under the target's dynamics: where expansion leads.
    pub at_source: Option<(f64, f64)>,
    /// RMSE of actions and rewards on true transitions from generated states.
    pub at_generated: Option<(f64, f64)>,
    /// Share of generated rows whose terminal flag is not the simulator's.
    pub terminal: Option<f64>,
}
