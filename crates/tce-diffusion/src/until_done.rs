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
//! | c_k | the caller's `judge` | – | – |

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_nn::{Checkpoints, NamedParameters, NetworkError, cosine_decay};

use crate::{DiffusionError, ScoreData, ScoreModel, Trainer};

/// Prefix of the best networks in a training's state.
const BEST: &str = "best/";
/// Key of the cycles' ends in the metadata of a training's state.
const ENDS: &str = "until_done";

/// When a training is done: after a cosine cycle that lowers the criterion by less than `gain`, or at the `limit`. Cycle k takes
/// `first` · 2ᵏ steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct UntilDone {
    /// Steps of the first cycle.
    pub first: u64,
    /// Steps that all cycles together may take.
    pub limit: u64,
    /// Share by which the criterion has to fall in a cycle for another one to follow; below zero, it may rise by so much.
    pub gain: f64,
}

impl Default for UntilDone {
    fn default() -> Self {
        Self { first: 7_500, limit: 120_000, gain: 0.1 }
    }
}

impl UntilDone {
    /// Refuses numbers that cannot be meant.
    ///
    /// # Errors
    /// Names the field.
    pub fn check(&self) -> Result<(), DiffusionError> {
        if self.first == 0 {
            return Err(DiffusionError::input("first", 0, "at least 1 step"));
        }
        if self.limit < self.first {
            return Err(DiffusionError::input("limit", self.limit, format!("at least `first`, {}", self.first)));
        }
        if !(self.gain < 1.0 && self.gain.is_finite()) {
            return Err(DiffusionError::input("gain", self.gain, "less than 1"));
        }
        Ok(())
    }

    /// The steps at which cycles end, as far as the limit allows.
    pub fn ends(&self) -> Vec<u64> {
        let end = |k: u32| self.first.saturating_mul((1u64 << k) - 1);
        (1..40).map(end).take_while(|&end| end <= self.limit).collect()
    }

    /// Whether a member whose criteria were `before` at the earlier ends is done with `now`. A criterion that is no number ends
    /// the training, too.
    fn done(&self, before: &[f64], now: f64) -> bool {
        let best = before.iter().copied().fold(f64::INFINITY, f64::min);
        !before.is_empty() && (now.is_nan() || now > (1.0 - self.gain) * best)
    }
}

/// What was measured at the end of a cycle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CycleEnd {
    /// Steps since the beginning.
    pub step: u64,
    /// The criterion of every member.
    pub criterion: Vec<f64>,
}

/// What a training until done has found so far.
#[derive(Clone, Debug, Default)]
pub(crate) struct Found {
    ends: Vec<CycleEnd>,
    /// The networks to be returned, all members.
    best: NamedParameters,
}

impl Found {
    /// Adds what was found to the state of a training.
    pub(crate) fn keep(&self, state: &mut NamedParameters) {
        if self.ends.is_empty() {
            return;
        }
        state.tensors.extend(self.best.tensors.iter().map(|(name, t)| (format!("{BEST}{name}"), t.clone())));
        // As bits: a criterion may be no number, for which JSON has no word.
        let bits: Vec<_> =
            self.ends.iter().map(|e| (e.step, e.criterion.iter().map(|c| c.to_bits()).collect())).collect();
        let text = serde_json::to_string::<Vec<(u64, Vec<u64>)>>(&bits).expect("plain numbers");
        state.metadata.insert(ENDS.to_owned(), text);
    }

    /// What [`Found::keep`] added, nothing if nothing was.
    pub(crate) fn restored(state: &NamedParameters, path: &Path) -> Result<Self, DiffusionError> {
        let Some(text) = state.metadata.get(ENDS) else { return Ok(Self::default()) };
        let bits: Vec<(u64, Vec<u64>)> = serde_json::from_str(text)
            .map_err(|e| NetworkError::Format { path: path.to_owned(), reason: format!("metadata '{ENDS}': {e}") })?;
        let ends =
            bits.into_iter().map(|(step, c)| CycleEnd { step, criterion: c.into_iter().map(f64::from_bits).collect() });
        Ok(Self { ends: ends.collect(), best: state.under(BEST) })
    }

    /// The criteria of member `m` so far.
    fn criteria(&self, m: usize) -> Vec<f64> {
        self.ends.iter().map(|e| e.criterion[m]).collect()
    }

    /// The members that were done before the last end or at it.
    fn done(&self, plan: &UntilDone) -> Vec<bool> {
        let members = self.ends.first().map_or(0, |e| e.criterion.len());
        let done = |m| {
            let criteria = self.criteria(m);
            (0..criteria.len()).any(|k| plan.done(&criteria[..k], criteria[k]))
        };
        (0..members).map(done).collect()
    }

    /// Takes the end of a cycle: the networks `now` of the members that are not done yet and have become better.
    fn take(&mut self, plan: &UntilDone, end: CycleEnd, now: NamedParameters) {
        let before = self.done(plan);
        if self.ends.is_empty() {
            self.best = now;
        } else {
            for (m, &c) in end.criterion.iter().enumerate() {
                let better = self.criteria(m).iter().all(|&earlier| c < earlier);
                if better && !before[m] {
                    for (name, (shape, values)) in &mut self.best.tensors {
                        let size = values.len() / shape[0];
                        values[m * size..][..size].copy_from_slice(&now.tensors[name].1[m * size..][..size]);
                    }
                }
            }
        }
        self.ends.push(end);
    }
}

impl Trainer {
    /// Trains until every member is done, and returns the best networks and what was measured at the ends of the cycles. A member's
    /// result does not depend on the others. `judge` gets a model at the end of a cycle and returns one criterion per member, the
    /// less the better; `on_loss` as in [`Trainer::train`], whose rules for checkpoints hold here too.
    ///
    /// # Errors
    /// As [`Trainer::train`], and those of `judge`.
    pub fn train_until_done<E: From<DiffusionError>>(
        &mut self,
        data: &[ScoreData],
        plan: &UntilDone,
        checkpoints: &mut Checkpoints,
        mut on_loss: impl FnMut(u64, &[f32]),
        mut judge: impl FnMut(&Self) -> Result<Vec<f64>, E>,
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
            if k > 0 && self.found.done(plan).iter().all(|&done| done) {
                break;
            }
            let length = plan.first << k;
            let begin = end - length;
            let rate = |step: u64| cosine_decay(highest, step.saturating_sub(begin), length);
            self.advance(data, end, rate, checkpoints, &mut on_loss)?;
            let criterion = judge(self)?;
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
        let mut judge = |t: &Trainer| {
            seen.push(t.model().parameters());
            Ok::<_, DiffusionError>(script[seen.len() - 1].to_vec())
        };
        let members = [Streams::new(5), Streams::new(6)];
        let mut whole = trainer(&members);
        let (model, ends) =
            whole.train_until_done(&data, &PLAN, &mut Checkpoints::none(), |_, _| {}, &mut judge).unwrap();
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
        first.advance(&data, 200, rate, &mut Checkpoints::none(), |_, _| {}).unwrap();
        let mut rest = trainer(&members);
        rest.restore(&first.state(), Path::new("x")).unwrap();
        let mut at = 0;
        let judge = |_: &Trainer| {
            at += 1;
            Ok::<_, DiffusionError>(script[at].to_vec())
        };
        let (again, ends_again) =
            rest.train_until_done(&data, &PLAN, &mut Checkpoints::none(), |_, _| {}, judge).unwrap();
        assert_eq!(ends_again, ends);
        assert_eq!(again.parameters(), got);
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
