//! Task by task: where a method helps, where it makes no difference, where it harms.
//!
//! The yardstick is the task's own best baseline, the one with the highest mean. That is a strict one: of several baselines the best one
//! is partly the luckiest one.

use serde::Serialize;
use tce_data::Task;

use super::Analysis;

/// Differences below so many points make no difference to anybody, however sure they are.
pub const LEAST: f64 = 1.0;
/// A difference is more than chance from so many standard errors on.
pub const SURE: f64 = 2.0;

/// What a method does on a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Effect {
    /// It scores more, by more than [`SURE`] standard errors and [`LEAST`].
    Helps,
    /// It scores less, likewise.
    Harms,
    /// The difference is smaller than its uncertainty, or than [`LEAST`].
    Open,
    /// There is one seed of either, so that nobody knows how uncertain the difference is.
    OneSeed,
}

impl Effect {
    /// In print.
    pub fn word(self) -> &'static str {
        match self {
            Effect::Helps => "helps",
            Effect::Harms => "harms",
            Effect::Open => "no difference shown",
            Effect::OneSeed => "one seed",
        }
    }
}

/// A method beside the best baseline of a task.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Gap {
    /// The task.
    pub task: Task,
    /// The method, by place.
    pub method: usize,
    /// The baseline with the highest mean, by place.
    pub baseline: usize,
    /// How many points the method's mean is above the baseline's.
    pub points: f64,
    /// Standard error of that difference (Welch's); None with one seed of either.
    pub error: Option<f64>,
    /// What that means.
    pub effect: Effect,
}

/// Every method of every task beside the task's best baseline, methods in their order.
pub fn gaps(analysis: &Analysis) -> Vec<Gap> {
    let mut out = Vec::new();
    for method in (0..analysis.methods.len()).filter(|m| !analysis.methods[*m].baseline) {
        for row in analysis.tables.iter().flat_map(|t| &t.rows) {
            let scored = |m: usize| row.cells[m].as_ref();
            let baselines = (0..analysis.methods.len()).filter(|m| analysis.methods[*m].baseline);
            let best = baselines.filter_map(|m| Some((m, scored(m)?))).max_by(|a, b| a.1.mean.total_cmp(&b.1.mean));
            let (Some(own), Some((baseline, best))) = (scored(method), best) else { continue };
            let points = own.mean - best.mean;
            let variance = |c: &super::Cell| c.std.map(|s| s * s / c.seeds as f64);
            let error = variance(own).zip(variance(best)).map(|(a, b)| (a + b).sqrt());
            let effect = match error {
                None => Effect::OneSeed,
                Some(e) if points > (SURE * e).max(LEAST) => Effect::Helps,
                Some(e) if points < -(SURE * e).max(LEAST) => Effect::Harms,
                Some(_) => Effect::Open,
            };
            out.push(Gap { task: row.task, method, baseline, points, error, effect });
        }
    }
    out
}
