//! Task by task: where a method helps, where it makes no difference, where it harms.
//!
//! The yardstick is the task's own best baseline, the one with the highest mean. That is a strict one: of several baselines the best one
//! is partly the luckiest one.

use serde::Serialize;
use tce_data::Task;

use super::{Analysis, Cell};
use crate::difference::{Difference, Sample};

/// A method beside the best baseline of a task.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Gap {
    /// The task.
    pub task: Task,
    /// The method, by place.
    pub method: usize,
    /// The baseline with the highest mean, by place.
    pub baseline: usize,
    /// How far the method is above it.
    #[serde(flatten)]
    pub difference: Difference,
}

/// Every method of every task beside the task's best baseline, methods in their order.
pub fn gaps(analysis: &Analysis) -> Vec<Gap> {
    let sample = |c: &Cell| Sample { mean: c.mean, std: c.std, seeds: c.seeds };
    let mut out = Vec::new();
    for method in (0..analysis.methods.len()).filter(|m| !analysis.methods[*m].baseline) {
        for row in analysis.tables.iter().flat_map(|t| &t.rows) {
            let scored = |m: usize| row.cells[m].as_ref();
            let baselines = (0..analysis.methods.len()).filter(|m| analysis.methods[*m].baseline);
            let best = baselines.filter_map(|m| Some((m, scored(m)?))).max_by(|a, b| a.1.mean.total_cmp(&b.1.mean));
            let (Some(own), Some((baseline, best))) = (scored(method), best) else { continue };
            let difference = Difference::between(&sample(own), &sample(best));
            out.push(Gap { task: row.task, method, baseline, difference });
        }
    }
    out
}
