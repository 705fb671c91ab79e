//! Training until it no longer helps: cosine cycles, each twice as long as the one before it, until a criterion stops falling.
//!
//! ```text
//! cycle k = 0, 1, ...  takes first · 2ᵏ steps, its learning rate falls from the highest to zero along a half cosine
//! stop after cycle k   when  c_k > (1 - gain) · min(c_0 .. c_{k-1}),  or when the next cycle would pass the limit
//! result               the network at the end of the cycle with the least c
//! ```
//!
//! Only a network whose learning rate has come down shows what it is worth, so that the criterion is asked at the ends of cycles
//! and nowhere else. The last cycle takes a little more than half of all steps: stopping one cycle too late costs no more than
//! was spent before. (Warm restarts: Loshchilov and Hutter 2017, T_mult = 2.)
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | – | `first` | 7 500 | bench/generator.md |
//! | – | `limit` | 120 000 | bench/generator.md |
//! | – | `gain` | .1 | bench/generator.md |
//! | c_k | the caller's function | – | – |

use std::path::Path;

use tce_nn::{Checkpoints, cosine_decay};

use crate::cycles::{CycleEnd, UntilDone};
use crate::{DiffusionError, ScoreData, ScoreModel, Trainer};

impl Trainer {
    /// Trains until every member is done, and returns the best networks and what was measured at the ends of the cycles. A member's
    /// result does not depend on the others, but for one thing: a member that diverges before it is done ends the training of all. One
    /// that is done goes on beside the others, and may diverge, because its best network is kept. `criterion` gets a model at the end of
    /// a cycle and returns one criterion per member, the less the better; `on_loss` as in [`Trainer::train`], whose rules for checkpoints
    /// hold here too.
    ///
    /// # Errors
    /// As [`Trainer::train`], and those of `criterion`.
    pub fn train_until_done<E: From<DiffusionError>>(
        &mut self,
        data: &[ScoreData],
        plan: &UntilDone,
        checkpoints: &mut Checkpoints,
        mut on_loss: impl FnMut(u64, &[f32]),
        mut criterion: impl FnMut(&Self) -> Result<Vec<f64>, E>,
    ) -> Result<(ScoreModel, Vec<CycleEnd>), E> {
        plan.check()?;
        self.check_data(data)?;
        if let Some((_, state, path)) = checkpoints.restore() {
            self.restore(&state, &path)?;
        }
        let highest = self.highest_rate();
        for (k, end) in plan.ends().into_iter().enumerate() {
            if k < self.found.ends.len() {
                continue;
            }
            let done = self.found.done(plan);
            if k > 0 && done.iter().all(|&done| done) {
                break;
            }
            let length = plan.first << k;
            let begin = end - length;
            let rate = |step: u64| cosine_decay(highest, step.saturating_sub(begin), length);
            self.advance(data, end, rate, &done, checkpoints, &mut on_loss)?;
            let criterion = criterion(self)?;
            let end = CycleEnd { step: end, criterion };
            let now = self.model().parameters();
            self.found.take(plan, end, now);
        }
        let mut best = self.model().parameters();
        best.tensors.clone_from(&self.found.best.tensors);
        let model = ScoreModel::from_parameters(&best, Path::new("the best networks"), &self.plain_device())?;
        Ok((model, self.found.ends.clone()))
    }
}

#[cfg(test)]
mod tests {
    use tce_base::Streams;
    use tce_base::random::fill_normal;
    use tce_nn::cpu;

    use super::*;
    use crate::{Edm, NetworkConfig, Process, TrainConfig};

    const PLAN: UntilDone = UntilDone { first: 100, limit: 750, gain: 0.1 };

    #[test]
    fn cycles_double_within_the_limit() {
        assert_eq!(PLAN.ends(), [100, 300, 700]);
        assert_eq!(UntilDone::default().ends(), [7_500, 22_500, 52_500, 112_500]);
        for (plan, field) in [
            (UntilDone { first: 0, ..PLAN }, "first"),
            (UntilDone { limit: 99, ..PLAN }, "limit"),
            (UntilDone { gain: 1.0, ..PLAN }, "gain"),
        ] {
            assert!(plan.check().unwrap_err().to_string().starts_with(field));
        }
    }

    #[test]
    fn a_fall_by_less_than_the_gain_ends_it() {
        assert!(!PLAN.done(&[], 1.0));
        assert!(!PLAN.done(&[1.0], 0.89) && PLAN.done(&[1.0], 0.91) && PLAN.done(&[1.0, 0.5], 0.6));
        assert!(PLAN.done(&[1.0], f64::NAN));
    }

    fn trainer(members: &[Streams]) -> Trainer {
        let spec = NetworkConfig { width: 16, embedding: 8, blocks: 1, ..NetworkConfig::new(2, 1) };
        let config = TrainConfig { learning_rate: 1e-3, batch: 16, ..TrainConfig::default() };
        Trainer::new("t", spec, Process::Edm(Edm::default()), config, members, &cpu()).unwrap()
    }

    /// The criterion of a member follows a script; what comes back is the network of the cycle that the script calls best.
    #[test]
    fn every_member_gets_its_own_best_network() {
        let mut x = vec![0.0; 200];
        fill_normal(&mut Streams::new(1).stream("x"), &mut x);
        let y = vec![0.0; 100];
        let data = [ScoreData::conditioned(&x, 2, &y, 1).unwrap()];
        // Member 0 gets worse in its second cycle and is done; member 1 goes on to the limit.
        let script = [[1.0, 1.0], [2.0, 0.5], [0.1, 0.2]];
        let mut seen = Vec::new();
        let mut criterion = |t: &Trainer| {
            seen.push(t.model().parameters());
            Ok::<_, DiffusionError>(script[seen.len() - 1].to_vec())
        };
        let members = [Streams::new(5), Streams::new(6)];
        let mut whole = trainer(&members);
        let (model, ends) =
            whole.train_until_done(&data, &PLAN, &mut Checkpoints::none(), |_, _| {}, &mut criterion).unwrap();
        assert_eq!(ends.iter().map(|e| e.step).collect::<Vec<_>>(), [100, 300, 700]);
        let got = model.parameters();
        assert_eq!(got.member(0), seen[0].member(0), "the first cycle was member 0's best before it was done");
        assert_eq!(got.member(1), seen[2].member(1));
        assert_ne!(got.member(0), seen[2].member(0));

        // A training that was broken off within its second cycle comes to the same.
        let mut first = trainer(&members);
        let once = |_: &Trainer| Ok::<_, DiffusionError>(script[0].to_vec());
        first
            .train_until_done(&data, &UntilDone { limit: 100, ..PLAN }, &mut Checkpoints::none(), |_, _| {}, once)
            .unwrap();
        let rate = |step: u64| cosine_decay(1e-3, step - 100, 200);
        first.advance(&data, 200, rate, &[], &mut Checkpoints::none(), |_, _| {}).unwrap();
        let mut rest = trainer(&members);
        rest.restore(&first.state(), Path::new("x")).unwrap();
        let mut at = 0;
        let criterion = |_: &Trainer| {
            at += 1;
            Ok::<_, DiffusionError>(script[at].to_vec())
        };
        let (again, ends_again) =
            rest.train_until_done(&data, &PLAN, &mut Checkpoints::none(), |_, _| {}, criterion).unwrap();
        assert_eq!(ends_again, ends);
        assert_eq!(again.parameters(), got);
    }

    /// Member 0 is done after two cycles. Then the network of one of the two is spoiled.
    #[test]
    fn a_member_that_is_done_ends_no_training_and_one_that_is_not_does() {
        let mut x = vec![0.0; 200];
        fill_normal(&mut Streams::new(1).stream("x"), &mut x);
        let y = vec![0.0; 100];
        let data = [ScoreData::conditioned(&x, 2, &y, 1).unwrap()];
        let script = [[1.0, 1.0], [2.0, 0.5], [0.1, 0.2]];
        let run = |trainer: &mut Trainer, limit: u64| {
            let criterion = |t: &Trainer| {
                let cycle = PLAN.ends().iter().position(|end| *end == t.steps()).unwrap();
                Ok::<_, DiffusionError>(script[cycle].to_vec())
            };
            let plan = UntilDone { limit, ..PLAN };
            trainer.train_until_done(&data, &plan, &mut Checkpoints::none(), |_, _| {}, criterion)
        };
        let members = [Streams::new(5), Streams::new(6)];
        let mut first = trainer(&members);
        run(&mut first, 300).unwrap();
        let whole = |spoiled: Option<usize>| {
            let mut state = first.state();
            for (name, (shape, values)) in &mut state.tensors {
                if let Some(m) = spoiled.filter(|_| name.starts_with("network.")) {
                    let size = values.len() / shape[0];
                    values[m * size..][..size].fill(f32::NAN);
                }
            }
            let mut rest = trainer(&members);
            rest.restore(&state, Path::new("x")).unwrap();
            run(&mut rest, PLAN.limit)
        };
        let parameters = |spoiled| whole(spoiled).unwrap().0.parameters();
        let (expected, got) = (parameters(None), parameters(Some(0)));
        assert_eq!(got.member(0), expected.member(0), "the network of the first cycle is kept");
        assert_eq!(got.member(1), expected.member(1));
        let error = whole(Some(1)).err().unwrap().to_string();
        assert!(error.contains("the loss of member 1 (the seeds in their order, from 0) became NaN"), "{error}");
    }

    #[test]
    fn losses_on_other_rows_are_the_same_at_every_call() {
        let trainer = trainer(&[Streams::new(5)]);
        let (x, y) = ([0.5, -0.5, 1.0, 2.0], [0.0, 0.0]);
        let data = [ScoreData::conditioned(&x, 2, &y, 1).unwrap()];
        let loss = trainer.loss_on(&data, 3).unwrap();
        assert_eq!(loss, trainer.loss_on(&data, 3).unwrap());
        assert!(loss[0].is_finite() && loss[0] > 0.0);
    }
}
