//! Fitted Q evaluation: estimates the value of a policy from target rows alone, without a model of the dynamics.
//!
//! ```text
//! L_Q = mean (Q(s, a) - y)²        y = r + γ (1 - terminal) Q'(s', π(s'))        twin critics, y takes the lesser Q'
//! V   = mean over the episodes' first states of (Q₁ + Q₂)(s₀, π(s₀)) / 2
//! ```
//!
//! The networks learn Q - c, where c is the mean discounted return of the logged episodes ([`discounted_return`]). A
//! value propagates backwards by one step each time Q' follows Q, and γ = .99 needs a hundred steps. A critic that
//! starts at 0 is therefore far below the true values for tens of thousands of updates; one that starts at c is not.
//!
//! Each replicate learns from another draw of the rows: blocks of consecutive rows, drawn with replacement (a
//! moving-block bootstrap). The spread of V over the replicates is its standard error. It measures how much V depends
//! on which rows happened to be logged. It does not measure the error of Q at actions that are in no row.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | γ | `discount` | .99 | as the learners |
//! | - | `steps`, `batch`, `lr` | 3 000, 256, 1e-3 | - |
//! | Q' ← (1 - ρ) Q' + ρ Q | `polyak` | .05 | ten times TD3's, for so few updates |
//! | - | `hidden` | 256, 256 ReLU | as the critics |
//! | - | `replicates` | 3 | - |
//!
//! Reference: Le, Voloshin and Yue 2019, "Batch Policy Learning under Constraints"; twin critics as in TD3.

use std::path::Path;
use std::sync::Arc;

use rand::RngExt;
use serde::{Deserialize, Serialize};
use tce_base::{Streams, mean_std};
use tce_data::{Standardizer, Transitions};
use tce_nn::{Checkpoints, Device, NamedParameters, NetworkError, host, tensor};

use crate::buffer::{Buffer, Member, Minibatch};
use crate::critic::{Twins, state_action};
use crate::error::{LearnError, within};
use crate::training::{Learner, Meter, Steps, TrainingJob, train_side_by_side};

/// Largest number of rows of a bootstrap block.
const BLOCK: usize = 50;

/// The configuration of [`fitted_q`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FittedQConfig {
    /// Discount γ of the returns that are estimated.
    #[schemars(range(min = 0.0, max = 0.9999))]
    pub discount: f64,
    /// Updates of a replicate. 0: no fitted Q evaluation.
    pub steps: u64,
    /// Rows per update of a replicate.
    #[schemars(range(min = 1))]
    pub batch: usize,
    /// Learning rate of the critics.
    pub lr: f64,
    /// Share ρ of the critic that its target network takes over in each update.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub polyak: f64,
    /// Widths of the hidden layers of the critics.
    pub hidden: Vec<usize>,
    /// Draws of the rows, each with critics of its own. Their spread is the standard error.
    #[schemars(range(min = 1))]
    pub replicates: usize,
}

impl FittedQConfig {
    /// Returns an error for numbers out of range.
    ///
    /// # Errors
    /// The error names the field.
    pub fn check(&self) -> Result<(), LearnError> {
        within("discount", self.discount, 0.0..=0.9999)?;
        within("polyak", self.polyak, 0.0..=1.0)?;
        within("lr", self.lr, 0.0..=1.0)?;
        within("batch", self.batch as f64, 1.0..=1e9)?;
        within("replicates", self.replicates as f64, 1.0..=1e3)
    }

    /// Whether every value is the default.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

impl Default for FittedQConfig {
    fn default() -> Self {
        Self { discount: 0.99, steps: 3_000, batch: 256, lr: 1e-3, polyak: 0.05, hidden: vec![256, 256], replicates: 3 }
    }
}

/// The actions of one policy, `[rows, d_a]` in the units of the rows.
#[derive(Clone, Debug)]
pub struct PolicyActions {
    /// π(s') of every row.
    pub next: Vec<f32>,
    /// π(s₀) of every start, in the order of `starts`.
    pub start: Vec<f32>,
}

/// The result of [`fitted_q`] for one policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FittedValue {
    /// V of every replicate.
    pub replicates: Vec<f64>,
}

impl FittedValue {
    /// Mean over the replicates.
    pub fn mean(&self) -> f64 {
        mean_std(&self.replicates).0
    }

    /// Standard deviation over the replicates: the bootstrap's standard error of one of them. NaN for fewer than two.
    pub fn standard_error(&self) -> f64 {
        if self.replicates.len() < 2 { f64::NAN } else { mean_std(&self.replicates).1 }
    }
}

/// The mean discounted return of the episodes of `rows` as they were logged.
pub fn discounted_return(rows: &Transitions, discount: f64) -> f64 {
    let episodes = rows.episodes();
    let of = |rewards: &[f32]| rewards.iter().rev().fold(0.0, |sum, &r| f64::from(r) + discount * sum);
    episodes.iter().map(|e| of(&rows.rewards[e.start..e.end])).sum::<f64>() / episodes.len() as f64
}

/// One replicate of one policy.
struct FittedQ {
    critics: Twins,
    /// π(s') of the rows of the buffer's part 0.
    next: Vec<f32>,
    width: usize,
    discount: f64,
    /// c
    constant: f64,
    lr: f64,
    polyak: f64,
}

impl Learner for FittedQ {
    fn update(&mut self, batch: &Minibatch, _step: u64, meter: &mut Meter) {
        let chosen = batch.picks.iter().flat_map(|pick| &self.next[pick.row as usize * self.width..][..self.width]);
        let a2 = tensor(chosen.copied().collect(), batch.a.dims(), &batch.a.device());
        let q2 = self.critics.lesser_target(state_action(&batch.s2, a2));
        let y = batch.r.clone() - self.constant + batch.not_done.clone() * (q2 + self.constant) * self.discount;
        let loss = self.critics.step(state_action(&batch.s, batch.a.clone()), y, None, self.lr, self.polyak);
        meter.record("q_loss", &loss);
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.critics.save(&mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.critics.load(state, path)
    }
}

/// Rows of a replicate: blocks of consecutive rows, as many rows in total as the data have.
fn bootstrap(rows: usize, streams: &Streams, replicate: u64) -> Vec<usize> {
    let block = BLOCK.min(rows);
    let mut rng = streams.indexed("bootstrap", replicate);
    let mut drawn = Vec::with_capacity(rows + block);
    while drawn.len() < rows {
        let start = rng.random_range(0..=rows - block);
        drawn.extend(start..start + block);
    }
    drawn.truncate(rows);
    drawn
}

/// Evaluates policies on the transitions `rows`, all in parallel. `starts` are rows whose state is the first of an
/// episode. `None` if the user interrupted the training.
///
/// Every policy is evaluated on the same draws of the rows, so that two policies' values can be compared by replicate.
///
/// # Errors
/// If a number is out of range, the rows cannot be learned from, or a checkpoint cannot be read or written.
///
/// # Panics
/// If a policy's actions do not fit the rows and the starts.
pub fn fitted_q(
    rows: &Transitions,
    starts: &[usize],
    policies: &[PolicyActions],
    config: &FittedQConfig,
    streams: Streams,
    checkpoints: &mut Checkpoints,
    device: &Device,
) -> Result<Option<Vec<FittedValue>>, LearnError> {
    let width = rows.act_dim;
    let fits = |p: &PolicyActions| p.next.len() == rows.len() * width && p.start.len() == starts.len() * width;
    assert!(policies.iter().all(fits), "actions of every successor and every start");
    config.check()?;
    let standardizer = Standardizer::fit(&rows.observations, rows.obs_dim);
    let draw = |replicate: usize| {
        let picked = bootstrap(rows.len(), &streams, replicate as u64);
        let member = Member {
            streams: streams.child(&format!("replicate {replicate}")),
            parts: vec![Arc::new(rows.select(&picked))],
            standardizer: standardizer.clone(),
            reward_scale: 1.0,
            row_scores: None,
        };
        Ok((picked, Buffer::new(vec![member], config.batch)?))
    };
    let constant = discounted_return(rows, config.discount);
    let draws = (0..config.replicates).map(draw).collect::<Result<Vec<_>, LearnError>>()?;
    let mut learners = Vec::new();
    for policy in policies {
        for (picked, buffer) in &draws {
            let next = picked.iter().flat_map(|&i| &policy.next[i * width..][..width]).copied().collect();
            let critics =
                Twins::new(buffer.inputs().len(), width, &config.hidden, &buffer.streams(), &device.clone().autodiff());
            let (discount, lr, polyak) = (config.discount, config.lr, config.polyak);
            learners.push(FittedQ { critics, next, width, discount, constant, lr, polyak });
        }
    }
    let buffers = draws.iter().map(|(_, buffer)| buffer).cycle();
    let mut jobs: Vec<_> =
        learners.iter_mut().zip(buffers).map(|(learner, buffer)| TrainingJob { learner, buffer }).collect();
    let nothing = |_: usize, _: &crate::training::Report, _: &FittedQ| Ok::<_, LearnError>(());
    let steps = Steps::new(config.steps, 0);
    let outcome = train_side_by_side(&mut jobs, steps, "fitted Q", checkpoints, device, nothing)?;
    drop(jobs);
    if outcome.interrupted {
        return Ok(None);
    }
    let observations = rows.select(starts).observations;
    let value = |(k, learner): (usize, &FittedQ)| {
        let buffer = &draws[k % config.replicates].1;
        let inputs = buffer.network_inputs(0, &observations);
        let s = tensor(inputs, [1, starts.len(), buffer.inputs().len()], &device.clone().autodiff());
        let a = tensor(policies[k / config.replicates].start.clone(), [1, starts.len(), width], &s.device());
        let q = |critic: &crate::critic::Critic| host(critic.online(state_action(&s, a.clone())).inner());
        let both = learner.critics.pair.each_ref().map(q);
        both.iter().flatten().map(|&v| f64::from(v)).sum::<f64>() / (2 * starts.len()) as f64 + constant
    };
    let values: Vec<f64> = learners.iter().enumerate().map(value).collect();
    Ok(Some(values.chunks(config.replicates).map(|v| FittedValue { replicates: v.to_vec() }).collect()))
}

#[cfg(test)]
mod tests {
    use tce_nn::cpu;

    use super::*;

    /// A walk on a line: s' = s + a / 10, r = a (1 if the state does not matter); π(s) = c has value c / (1 - γ).
    fn walk() -> Transitions {
        let mut rng = Streams::new(1).stream("walk");
        let mut t = Transitions::new(1, 1);
        for _ in 0..40 {
            let mut s = rng.random_range(-1.0f32..1.0);
            for step in 0..50 {
                let a = rng.random_range(-1.0f32..1.0);
                t.push(&[s], &[a], a, &[s + a / 10.0], false, step == 49);
                s += a / 10.0;
            }
        }
        t
    }

    #[test]
    fn constant_policies_are_worth_what_a_geometric_series_says() {
        let rows = walk();
        let starts: Vec<usize> = rows.episodes().iter().map(|e| e.start).collect();
        let of = |c: f32| PolicyActions { next: vec![c; rows.len()], start: vec![c; starts.len()] };
        let config = FittedQConfig {
            discount: 0.8,
            steps: 1500,
            hidden: vec![32],
            lr: 3e-3,
            polyak: 0.05,
            replicates: 2,
            ..FittedQConfig::default()
        };
        let policies = [of(0.5), of(-0.5)];
        let none = &mut Checkpoints::none();
        let values = fitted_q(&rows, &starts, &policies, &config, Streams::new(2), none, &cpu()).unwrap().unwrap();
        for (value, expected) in values.iter().zip([2.5, -2.5]) {
            assert!((value.mean() - expected).abs() < 0.2, "{value:?}, expected {expected}");
            assert!(value.standard_error() < 0.3, "{value:?}");
        }
    }

    #[test]
    fn terminal_rows_have_no_future() {
        let mut rows = Transitions::new(1, 1);
        (0..200).for_each(|k| rows.push(&[k as f32 / 100.0], &[0.0], 3.0, &[0.0], true, false));
        let starts = [0, 50];
        let policy = PolicyActions { next: vec![0.0; 200], start: vec![0.0; 2] };
        let config =
            FittedQConfig { steps: 600, hidden: vec![32], lr: 1e-2, replicates: 1, ..FittedQConfig::default() };
        let none = &mut Checkpoints::none();
        let values = fitted_q(&rows, &starts, &[policy], &config, Streams::new(2), none, &cpu()).unwrap().unwrap();
        assert!((values[0].mean() - 3.0).abs() < 0.1, "{values:?}");
    }

    #[test]
    fn logged_returns_are_discounted_episode_by_episode() {
        let mut rows = Transitions::new(1, 1);
        for (reward, end) in [(1.0, false), (2.0, true), (4.0, true)] {
            rows.push(&[0.0], &[0.0], reward, &[0.0], end, false);
        }
        assert_eq!(discounted_return(&rows, 0.5), (2.0 + 4.0) / 2.0);
    }

    #[test]
    fn a_replicate_has_as_many_rows_in_blocks() {
        let drawn = bootstrap(120, &Streams::new(3), 0);
        assert_eq!(drawn.len(), 120);
        assert!(drawn.iter().all(|&i| i < 120));
        let follows = drawn.windows(2).filter(|w| w[1] == w[0] + 1).count();
        assert!(follows >= 116, "{follows}");
        assert_ne!(drawn, bootstrap(120, &Streams::new(3), 1));
        assert_eq!(bootstrap(7, &Streams::new(3), 0).len(), 7);
    }
}
