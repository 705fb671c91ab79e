//! Code that the tests of learners share.

use tce_learn::{Buffer, LearnError, Learner, Report, Steps, train};
use tce_nn::{Checkpoints, cpu};

/// Trains from step `from` to `to` and returns the only report, given at the end.
pub fn go<L: Learner + ?Sized>(learner: &mut L, buffer: &Buffer, from: u64, to: u64) -> Report {
    let mut last = None;
    let steps = Steps { from, to, report_every: 0 };
    train(learner, buffer, steps, "test", &mut Checkpoints::none(), &cpu(), |report, _| {
        last = Some(report.clone());
        Ok::<_, LearnError>(())
    })
    .unwrap();
    last.unwrap()
}
