//! One-step predictions in both domains: an ensemble f(s, a, y) ≈ (s' - s, r, terminal), trained on the rows of both
//! domains, with the domain as an input.
//!
//! ```text
//! x = [s, a, y]                        y = 0 in the target, 1 in the source
//! L = mean over rows and dimensions of (f_δr(x) - [(s' - s - m_δ) / σ_δ, (r - m_r) / σ_r])²
//!     + mean over rows of the cross-entropy of f_T(x) and the terminal flag
//! ```
//!
//! Half of every batch is target rows. From the source's many rows the model learns what the domains share, also far
//! from the few target rows; the input y represents the differences. The model is therefore accurate where there are no
//! target rows. It shows which generated rows are possible ([`Dynamics::errors`]), and can test a policy before it runs
//! on a robot ([`Dynamics::predict`], step by step).
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `members` | 3 | - |
//! | - | `hidden` | 256, 256 ReLU | as the critics |
//! | - | `steps`, `batch` | 20 000, 256 | - |
//! | - | `lr` | 1e-3, to 0 along a cosine | PETS (Chua et al. 2018), constant there |
//! | m, σ | mean and spread over the target's rows | - | - |

use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_data::{Rows, Standardizer, Transitions};
use tce_nn::{
    Checkpoints, Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained, cosine_decay, tensor,
};

use crate::blocks::map_rows;
use crate::buffer::{Buffer, Member, Minibatch};
use crate::critic::state_action;
use crate::error::{LearnError, within};
use crate::losses::{binary_cross_entropy, member_mean};
use crate::training::{Learner, Meter, Steps, train};

/// The configuration of [`Dynamics`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DynamicsConfig {
    /// Networks of the ensemble.
    pub members: usize,
    /// Widths of the hidden layers of the learned dynamics.
    pub hidden: Vec<usize>,
    /// Training steps of the learned dynamics.
    pub steps: u64,
    /// Rows per network and step, half of them the target's.
    #[schemars(range(min = 1))]
    pub batch: usize,
    /// Learning rate of the learned dynamics at the beginning.
    pub lr: f64,
}

impl Default for DynamicsConfig {
    fn default() -> Self {
        Self { members: 3, hidden: vec![256, 256], steps: 20_000, batch: 256, lr: 1e-3 }
    }
}

/// One of the two domains.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Domain {
    /// The domain of the changed robot.
    Target,
    /// The domain of the unchanged robot.
    Source,
}

impl Domain {
    fn label(self) -> f32 {
        match self {
            Domain::Target => 0.0,
            Domain::Source => 1.0,
        }
    }
}

/// The predictions of one network of the ensemble for some rows.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// s', `[N, obs_dim]`, in the units of the data.
    pub next_observations: Vec<f32>,
    /// r, `[N]`.
    pub rewards: Vec<f32>,
    /// Whether s' is terminal, `[N]`.
    pub terminals: Vec<bool>,
}

/// The ensemble.
pub struct Dynamics {
    config: DynamicsConfig,
    net: Trained<Mlp>,
    buffer: Buffer,
    /// m_δ, σ_δ, for standardised dimensions.
    step: Standardizer,
    /// m_r, σ_r
    reward: (f32, f32),
    device: Device,
}

impl Dynamics {
    /// An untrained ensemble for the rows of the target and, if given, of the source. `standardizer` standardises
    /// observations for the networks.
    ///
    /// # Errors
    /// If a number is out of range, or the tables do not fit each other.
    pub fn new(
        target: Arc<Transitions>,
        source: Option<Arc<Transitions>>,
        standardizer: Standardizer,
        streams: Streams,
        config: &DynamicsConfig,
        device: &Device,
    ) -> Result<Self, LearnError> {
        within("members", config.members as f64, 1.0..=64.0)?;
        within("lr", config.lr, 0.0..=1.0)?;
        let rewards = Standardizer::fit(&target.rewards, 1);
        let parts: Vec<_> = std::iter::once(target).chain(source).collect();
        let member = |k| Member {
            streams: streams.child(&format!("dynamics {k}")),
            parts: parts.clone(),
            standardizer: standardizer.clone(),
            reward_scale: 1.0,
            row_scores: None,
        };
        let buffer =
            Buffer::new((0..config.members).map(member).collect(), config.batch)?.with_stream("dynamics batch");
        let (d, step) = (buffer.inputs().len(), buffer.step_units(0));
        let net = MlpConfig::relu(d + buffer.act_dim() + 1, &config.hidden, d + 2);
        let net = net.init(&buffer.streams(), "dynamics", &device.clone().autodiff());
        let (net, reward) = (Trained::new(net), (rewards.mean[0], rewards.std[0]));
        Ok(Self { config: config.clone(), net, buffer, step, reward, device: device.clone() })
    }

    /// Number of networks in the ensemble.
    pub fn members(&self) -> usize {
        self.config.members
    }

    /// The predictions of every network for its own rows: `tables[k]` holds observations `[N, obs_dim]` and actions
    /// `[N, act_dim]`, in the units of the data, for network k. Dimensions that the networks do not see stay unchanged.
    ///
    /// # Panics
    /// If there is not one table per network.
    pub fn predict(&self, tables: &[(&[f32], &[f32])], domain: Domain) -> Vec<Prediction> {
        assert_eq!(tables.len(), self.members(), "one table per network");
        let (d, a) = (self.buffer.inputs().len(), self.buffer.act_dim());
        let label = domain.label();
        let inputs = |(k, (s, actions)): (usize, &(&[f32], &[f32]))| -> Vec<f32> {
            let labels = vec![label; actions.len() / a];
            Rows::join(&[(&self.buffer.network_inputs(k, s), d), (actions, a), (&labels, 1)]).to_vec()
        };
        let inputs: Vec<_> = tables.iter().enumerate().map(inputs).collect();
        let net = self.net.net().valid();
        let outputs = map_rows(&inputs, d + a + 1, &self.device, |_, x| net.forward(x));
        let (dims, width, scale) =
            (self.buffer.inputs(), self.buffer.obs_dim(), &self.buffer.members()[0].standardizer);
        let table = |(outputs, (s, _)): (&Vec<f32>, &(&[f32], &[f32]))| {
            let mut next_observations = s.to_vec();
            let rows = outputs.len() / (d + 2);
            let (mut rewards, mut terminals) = (Vec::with_capacity(rows), Vec::with_capacity(rows));
            for (row, output) in next_observations.chunks_exact_mut(width).zip(outputs.chunks_exact(d + 2)) {
                for (k, &i) in dims.iter().enumerate() {
                    row[i] += (self.step.mean[k] + self.step.std[k] * output[k]) * scale.std[i];
                }
                rewards.push(self.reward.0 + self.reward.1 * output[d]);
                terminals.push(output[d + 1] > 0.0);
            }
            Prediction { next_observations, rewards, terminals }
        };
        outputs.iter().zip(tables).map(table).collect()
    }

    /// The distance of rows from the ensemble's predictions: RMS of (f(s, a) - s') / σ_δ over the dimensions that the
    /// networks see, averaged over the networks. 1 is an error as large as the spread of a step.
    pub fn errors(&self, rows: &Transitions, domain: Domain) -> Vec<f64> {
        let table = (rows.observations.as_slice(), rows.actions.as_slice());
        let predictions = self.predict(&vec![table; self.members()], domain);
        let scale = &self.buffer.members()[0].standardizer;
        let unit: Vec<f32> =
            self.buffer.inputs().iter().zip(&self.step.std).map(|(&i, std)| scale.std[i] * std).collect();
        let mut errors = vec![0.0; rows.len()];
        for prediction in &predictions {
            let expected = prediction.next_observations.chunks_exact(rows.obs_dim);
            for ((error, expected), s2) in
                errors.iter_mut().zip(expected).zip(rows.next_observations.chunks_exact(rows.obs_dim))
            {
                let square = |(&i, unit): (&usize, &f32)| f64::from((expected[i] - s2[i]) / unit).powi(2);
                let sum: f64 = self.buffer.inputs().iter().zip(&unit).map(square).sum();
                *error += (sum / unit.len() as f64).sqrt() / predictions.len() as f64;
            }
        }
        errors
    }
}

impl Learner for Dynamics {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let [p, b, d] = batch.s.dims();
        let labels: Vec<f32> = batch.picks.iter().map(|pick| if pick.part == 0 { 0.0 } else { 1.0 }).collect();
        let wide = |v: &[f32]| tensor(v.to_vec(), [1, 1, v.len()], &self.device);
        let x = Tensor::cat(vec![state_action(&batch.s, batch.a.clone()), tensor(labels, [p, b, 1], &self.device)], 2);
        let delta = (batch.s2.clone() - batch.s.clone() - wide(&self.step.mean)) / wide(&self.step.std);
        let reward = (batch.r.clone() - self.reward.0) / self.reward.1;
        let expected = Tensor::from_inner(Tensor::cat(vec![delta, reward], 2));
        let output = self.net.net().forward(x);
        let error = member_mean((output.clone().narrow(2, 0, d + 1) - expected).square());
        let terminals = Tensor::from_inner(batch.not_done.clone().neg() + 1.0);
        let terminal = binary_cross_entropy(output.narrow(2, d + 1, 1), terminals);
        meter.record("dynamics_loss", &error);
        meter.record("terminal_loss", &terminal);
        self.net.step((error + terminal).sum(), cosine_decay(self.config.lr, step, self.config.steps));
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.net.save("dynamics", &mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.net.load("dynamics", state, path)
    }
}

/// Trains an ensemble, resuming from and storing `checkpoints`. `None` if the user interrupted it.
///
/// # Errors
/// If a checkpoint cannot be read or written.
pub fn train_dynamics(
    mut model: Dynamics,
    checkpoints: &mut Checkpoints,
    device: &Device,
) -> Result<Option<Dynamics>, LearnError> {
    let (buffer, steps) = (model.buffer.clone(), Steps::new(model.config.steps, 0));
    let nothing = |_: &crate::training::Report, _: &Dynamics| Ok::<_, LearnError>(());
    let outcome = train(&mut model, &buffer, steps, "dynamics", checkpoints, device, nothing)?;
    Ok((!outcome.interrupted).then_some(model))
}

#[cfg(test)]
mod tests {
    use rand::RngExt;
    use tce_nn::cpu;

    use super::*;

    /// s' = s + gain · a, r = 2 s, terminal above .8.
    fn world(gain: f32, range: std::ops::Range<f32>, rows: usize) -> Arc<Transitions> {
        let mut rng = Streams::new(1).stream("world");
        let mut t = Transitions::new(2, 1);
        for _ in 0..rows {
            let (s, a) = (rng.random_range(range.clone()), rng.random_range(-1.0f32..1.0));
            t.push(&[s, 7.0], &[a], 2.0 * s, &[s + gain * a, 7.0], s + gain * a > 0.8, true);
        }
        Arc::new(t)
    }

    #[test]
    fn both_domains_are_learned_and_told_apart() {
        let (target, source) = (world(0.1, -1.0..1.0, 1000), world(0.2, -1.0..1.0, 4000));
        let config = DynamicsConfig { hidden: vec![64], steps: 1500, members: 2, ..DynamicsConfig::default() };
        let scale = Standardizer::fit(&target.observations, 2);
        let model =
            Dynamics::new(target.clone(), Some(source.clone()), scale, Streams::new(3), &config, &cpu()).unwrap();
        let model = train_dynamics(model, &mut Checkpoints::none(), &cpu()).unwrap().unwrap();
        let (s, a): (&[f32], &[f32]) = (&[0.3, 7.0, -0.5, 7.0], &[0.5, -0.8]);
        for (domain, gain) in [(Domain::Target, 0.1), (Domain::Source, 0.2)] {
            for prediction in model.predict(&[(s, a), (s, a)], domain) {
                for (row, &a) in a.iter().enumerate() {
                    let (s, next) = (s[2 * row], &prediction.next_observations[2 * row..][..2]);
                    assert!((next[0] - s - gain * a).abs() < 0.01, "{domain:?}: {next:?}");
                    assert_eq!(next[1], 7.0, "a dimension that never changes stays");
                    assert!((prediction.rewards[row] - 2.0 * s).abs() < 0.1);
                    assert!(!prediction.terminals[row]);
                }
            }
        }
        let edge: (&[f32], &[f32]) = (&[0.95, 7.0], &[0.9]);
        assert!(model.predict(&[edge, edge], Domain::Target).iter().all(|p| p.terminals[0]));
        // The source's rows are impossible in the target: their steps differ by half of a source step.
        let mean = |e: Vec<f64>| e.iter().sum::<f64>() / e.len() as f64;
        let (own, foreign) = (mean(model.errors(&target, Domain::Target)), mean(model.errors(&source, Domain::Target)));
        assert!(own < 0.1 && foreign > 0.6, "{own} {foreign}");
        assert!(mean(model.errors(&source, Domain::Source)) < 0.2);
    }
}
