//! A transition model P(s'|s, a) = N(μ, diag σ²). It is used to compare domains; nothing is learned from it.
//!
//! ```text
//! δ = [(s' - m) - (s - m)] / σ_s,   x = (δ - m_δ) / σ_δ      the step, in units of the first member's target rows
//! (μ, l) = MLP([s, a]),   ln σ = high - softplus(high - low') with low' = low + softplus(l - low)
//! L = mean over rows and dimensions of ½ ((x - μ) / σ)² + ln σ
//! ```
//!
//! All members share the units of x, so the divergences between members are those of their densities of s'.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `hidden` | 256, 256 ReLU | as the critics |
//! | - | `steps`, `batch` | 5000, 256 | - |
//! | - | `lr` | 1e-3, to 0 along a cosine | PETS (Chua et al. 2018), constant there |
//! | low, high | `log_std` | -5, 1 | bounds as in PETS, fixed: a deterministic world would drive σ to 0 |

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_data::{Rows, Standardizer};
use tce_nn::burn::tensor::activation::softplus;
use tce_nn::{
    Checkpoints, Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained, cosine_decay, tensor,
};

use crate::blocks::map_rows;
use crate::buffer::{Buffer, Member, Minibatch};
use crate::critic::state_action;
use crate::error::{LearnError, within};
use crate::losses::member_mean;
use crate::training::{Learner, Meter, Steps, train};

/// The configuration of [`TransitionModel`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TransitionConfig {
    /// Hidden layers.
    pub hidden: Vec<usize>,
    /// Training steps.
    pub steps: u64,
    /// Rows per member and step.
    pub batch: usize,
    /// Initial learning rate.
    pub lr: f64,
    /// Bounds of ln σ.
    pub log_std: (f64, f64),
}

impl Default for TransitionConfig {
    fn default() -> Self {
        Self { hidden: vec![256, 256], steps: 5000, batch: 256, lr: 1e-3, log_std: (-5.0, 1.0) }
    }
}

/// Predicted densities of the steps of some rows, in the models' units: row-major `[N, d]` each, d live dimensions.
#[derive(Clone, Debug, PartialEq)]
pub struct Densities {
    /// μ
    pub mean: Vec<f32>,
    /// ln σ
    pub log_std: Vec<f32>,
}

/// Transition models of a population; each is trained on the rows of its own member.
pub struct TransitionModel {
    config: TransitionConfig,
    net: Trained<Mlp>,
    buffer: Buffer,
    /// m_δ, σ_δ
    units: Standardizer,
    device: Device,
}

impl TransitionModel {
    /// Untrained models of the members' part 0. All members must have observations in the same units.
    ///
    /// # Errors
    /// If a number is out of range, or the members' standardisers differ.
    pub fn new(members: Vec<Member>, config: &TransitionConfig, device: &Device) -> Result<Self, LearnError> {
        within("lr", config.lr, 0.0..=1.0)?;
        within("log_std", config.log_std.0, -20.0..=config.log_std.1)?;
        let other = members.iter().position(|m| m.standardizer != members[0].standardizer);
        if let Some(m) = other {
            let expected = "the standardiser of member 0: densities are compared between members";
            return Err(LearnError::invalid(format!("member {m}, standardizer"), "another one", expected, "share one"));
        }
        let buffer = Buffer::new(members, config.batch)?.with_stream("transition batch");
        let (d, units) = (buffer.inputs().len(), buffer.step_units(0));
        let net = MlpConfig::relu(d + buffer.act_dim(), &config.hidden, 2 * d);
        let net = net.init(&buffer.streams(), "transition model", &device.clone().autodiff());
        Ok(Self { config: config.clone(), net: Trained::new(net), buffer, units, device: device.clone() })
    }

    /// Number of dimensions of a density: those that the networks see.
    pub fn dim(&self) -> usize {
        self.buffer.inputs().len()
    }

    /// (μ, ln σ), `[P, B, d]` each, from the network's output.
    fn split(&self, output: Tensor<3>) -> (Tensor<3>, Tensor<3>) {
        let d = output.dims()[2] / 2;
        let (low, high) = self.config.log_std;
        let raw = output.clone().narrow(2, d, d);
        let above = softplus(raw - low, 1.0) + low;
        (output.narrow(2, 0, d), softplus(above.neg() + high, 1.0).neg() + high)
    }

    /// The step s' - s of a batch in the models' units.
    fn step_of(&self, batch: &Minibatch) -> Tensor<3> {
        let wide = |v: &[f32]| tensor(v.to_vec(), [1, 1, v.len()], &self.device);
        (batch.s2.clone() - batch.s.clone() - wide(&self.units.mean)) / wide(&self.units.std)
    }

    /// The members' densities for (s, a): for each member, `tables[m]` holds observations `[N, obs_dim]` and actions
    /// `[N, act_dim]` in original units.
    pub fn densities(&self, tables: &[(&[f32], &[f32])]) -> Vec<Densities> {
        let (d, a) = (self.buffer.inputs().len(), self.buffer.act_dim());
        let inputs = |(m, (s, actions)): (usize, &(&[f32], &[f32]))| -> Vec<f32> {
            Rows::join(&[(&self.buffer.network_inputs(m, s), d), (actions, a)]).to_vec()
        };
        let tables: Vec<_> = tables.iter().enumerate().map(inputs).collect();
        let net = self.net.net().valid();
        let rows = map_rows(&tables, d + a, &self.device, |_, x| {
            let (mean, log_std) = self.split(net.forward(x));
            Tensor::cat(vec![mean, log_std], 2)
        });
        let half =
            |rows: &[f32], from: usize| rows.chunks_exact(2 * d).flat_map(|r| r[from..from + d].to_vec()).collect();
        rows.iter().map(|rows| Densities { mean: half(rows, 0), log_std: half(rows, d) }).collect()
    }

    /// Converts the means to next observations `[N, obs_dim]` in original units, for the given states. Dimensions that
    /// the networks do not see keep their values.
    pub fn next_observations(&self, states: &[f32], densities: &Densities) -> Vec<f32> {
        let (inputs, width) = (self.buffer.inputs(), self.buffer.obs_dim());
        let scale = &self.buffer.members()[0].standardizer;
        let mut out = states.to_vec();
        for (row, mean) in out.chunks_exact_mut(width).zip(densities.mean.chunks_exact(inputs.len())) {
            for (k, &i) in inputs.iter().enumerate() {
                row[i] += (self.units.mean[k] + self.units.std[k] * mean[k]) * scale.std[i];
            }
        }
        out
    }
}

impl Learner for TransitionModel {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let sa = state_action(&batch.s, batch.a.clone());
        let (mean, log_std) = self.split(self.net.net().forward(sa));
        // The data are outside of autodiff.
        let x = Tensor::from_inner(self.step_of(batch));
        let error = (x - mean) / log_std.clone().exp();
        let loss = member_mean(error.square() * 0.5 + log_std);
        meter.record("transition_loss", &loss);
        self.net.step(loss.sum(), cosine_decay(self.config.lr, step, self.config.steps));
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.net.save("transition model", &mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.net.load("transition model", state, path)
    }
}

/// Trains a model for every member, resuming from and storing `checkpoints`. `None` if the user interrupted it.
///
/// # Errors
/// If the configuration or the data cannot be used, or a checkpoint cannot be read or written.
pub fn train_transition_models(
    members: Vec<Member>,
    config: &TransitionConfig,
    checkpoints: &mut Checkpoints,
    device: &Device,
) -> Result<Option<TransitionModel>, LearnError> {
    let mut model = TransitionModel::new(members, config, device)?;
    let (buffer, steps) = (model.buffer.clone(), Steps::new(config.steps, 0));
    let nothing = |_: &crate::training::Report, _: &TransitionModel| Ok::<_, LearnError>(());
    let outcome = train(&mut model, &buffer, steps, "transition models", checkpoints, device, nothing)?;
    Ok((!outcome.interrupted).then_some(model))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use rand::RngExt;
    use tce_base::Streams;
    use tce_base::random::fill_normal;
    use tce_data::Transitions;
    use tce_nn::cpu;

    use super::*;

    /// s' = s + gain a + noise, in two dimensions of different size, and a dead dimension.
    fn world(seed: u64, gain: f32, noise: [f32; 2]) -> Arc<Transitions> {
        let mut rng = Streams::new(seed).stream("world");
        let mut t = Transitions::new(3, 1);
        for _ in 0..4000 {
            let s = [rng.random_range(-1.0f32..1.0), 7.0, rng.random_range(-100.0f32..100.0)];
            let a = rng.random_range(-1.0f32..1.0);
            let mut z = [0.0; 2];
            fill_normal(&mut rng, &mut z);
            let s2 = [s[0] + 0.1 * gain * a + noise[0] * z[0], 7.0, s[2] + 10.0 * gain * a + noise[1] * z[1]];
            t.push(&s, &[a], 0.0, &s2, false, true);
        }
        Arc::new(t)
    }

    fn members(tables: &[Arc<Transitions>]) -> Vec<Member> {
        let standardizer = Standardizer::fit(&tables[0].observations, 3);
        let member = |(m, t): (usize, &Arc<Transitions>)| Member {
            streams: Streams::new(m as u64),
            parts: vec![t.clone()],
            standardizer: standardizer.clone(),
            reward_scale: 1.0,
            row_scores: None,
        };
        tables.iter().enumerate().map(member).collect()
    }

    #[test]
    fn mean_and_spread_of_known_worlds() {
        let tables = [world(1, 1.0, [0.02, 4.0]), world(2, 2.0, [0.04, 4.0])];
        let config = TransitionConfig { steps: 1500, hidden: vec![64], ..TransitionConfig::default() };
        let model = train_transition_models(members(&tables), &config, &mut Checkpoints::none(), &cpu());
        let model = model.unwrap().unwrap();
        let (s, a) = ([0.2, 7.0, 30.0, -0.4, 7.0, 0.0], [0.5, -0.8]);
        let densities = model.densities(&[(&s, &a), (&s, &a)]);
        for (m, gain) in [1.0, 2.0].into_iter().enumerate() {
            let next = model.next_observations(&s, &densities[m]);
            for (row, &a) in a.iter().enumerate() {
                let (next, s) = (&next[3 * row..][..3], &s[3 * row..][..3]);
                assert!((next[0] - s[0] - 0.1 * gain * a).abs() < 0.02, "member {m}: {next:?}");
                assert!((next[2] - s[2] - 10.0 * gain * a).abs() < 2.0, "member {m}: {next:?}");
                assert_eq!(next[1], 7.0, "a dead dimension stays");
            }
        }
        // The units are the first world's steps, whose variance is that of 0.1 a plus that of the noise.
        let unit = |gain: f32, noise: f32| (gain * gain / 3.0 + noise * noise).sqrt();
        let expected =
            [[0.02 / unit(0.1, 0.02), 4.0 / unit(10.0, 4.0)], [0.04 / unit(0.1, 0.02), 4.0 / unit(10.0, 4.0)]];
        for (m, expected) in expected.iter().enumerate() {
            for (log_std, expected) in densities[m].log_std.iter().zip(expected.iter().cycle()) {
                assert!((log_std.exp() / expected - 1.0).abs() < 0.2, "member {m}: {} {expected}", log_std.exp());
            }
        }
    }

    #[test]
    fn the_spread_stays_within_its_bounds() {
        let model = TransitionModel::new(members(&[world(1, 1.0, [0.0, 0.0])]), &TransitionConfig::default(), &cpu());
        let model = model.unwrap();
        let raw = tensor(vec![0.0, 0.0, -100.0, 100.0], [1, 1, 4], &cpu());
        let (_, log_std) = model.split(raw);
        let log_std = tce_nn::host(log_std);
        assert!((log_std[0] + 5.0).abs() < 1e-2 && (log_std[1] - 1.0).abs() < 1e-2, "{log_std:?}");
    }

    #[test]
    fn members_in_different_units_are_refused() {
        let mut members = members(&[world(1, 1.0, [0.1, 1.0]), world(2, 1.0, [0.1, 1.0])]);
        members[1].standardizer.mean[0] += 1.0;
        let refused = TransitionModel::new(members, &TransitionConfig::default(), &cpu());
        assert!(refused.err().unwrap().to_string().contains("member 1, standardizer"));
    }
}
