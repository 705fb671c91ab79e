//! Networks from a state pair (s, s') to the action, the reward or the terminal flag between them: the inverse dynamics
//! model, the reward model and a classifier of terminals (Table B.1).
//!
//! ```text
//! x = [(s - m) / σ, (s' - s - m_δ) / σ_δ]      `delta`;  [(s - m) / σ, (s' - m) / σ]      `next`
//! h = Dense(256)(x);   3 × h ← h + D(SiLU(Dense(256)(LayerNorm(h))));   y = Dense(d)(h)
//! D: a row's branch is left out with probability p_k = rate · k/3 in block k, else multiplied by 1 / (1 - p_k)
//! L = mean (y - a)²,   mean (y - (r - m_r) / σ_r)²,   or the cross-entropy of the terminal flag
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `input` | delta | next: Table B.1; states move by a few % of their spread per step, which `next` hides in the digits |
//! | - | `width`, `blocks` | 256, 3 | Table B.1 |
//! | rate | `drop_path` | .1 | "DropPath" without a number in B.3; linear in depth: Huang et al. 2016 |
//! | - | `lr`, `cosine` | 1e-3, to 0 | Table C.4 (constant) |

use std::path::Path;

use rand::RngExt;
use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_data::{Rows, Standardizer};
use tce_nn::burn::tensor::activation;
use tce_nn::{
    Activation, Dense, Device, LayerNorm, Module, NamedParameters, NetworkError, Tensor, Trained, cosine_decay, tensor,
};

use crate::blocks::map_rows;
use crate::buffer::{Buffer, Minibatch};
use crate::error::{LearnError, within};
use crate::losses::{member_mean, squared_error};

/// How the successor reaches the network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PairInput {
    /// As the difference s' - s in units of its own spread.
    #[default]
    Delta,
    /// As a state.
    Next,
}

/// The configuration of a [`PairModel`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PairConfig {
    /// How s' reaches the label networks: as it is, or as its difference from s. Source: Table B.1 has next.
    pub input: PairInput,
    /// Width of every layer of the label networks. Source: Table B.1.
    pub width: usize,
    /// Residual blocks of the label networks. Source: Table B.1.
    pub blocks: usize,
    /// Share of the rows for which the last block is left out in training; earlier blocks have less. Source: Table B.1 names
    /// DropPath without a number.
    pub drop_path: f64,
    /// Learning rate of the label networks at the beginning. Source: Table C.4.
    pub lr: f64,
    /// Whether the learning rate falls to 0 over the training along a cosine.
    pub cosine: bool,
}

impl Default for PairConfig {
    fn default() -> Self {
        Self { input: PairInput::default(), width: 256, blocks: 3, drop_path: 0.1, lr: 1e-3, cosine: true }
    }
}

/// What a [`PairModel`] predicts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PairTarget {
    /// The action.
    Action,
    /// The reward.
    Reward,
    /// The logit of the probability that s' is terminal.
    Terminal,
}

impl PairTarget {
    fn name(self) -> &'static str {
        match self {
            PairTarget::Action => "inverse dynamics",
            PairTarget::Reward => "reward model",
            PairTarget::Terminal => "terminal model",
        }
    }
}

/// Layer normalisation and a SiLU layer, with a skip connection around them.
#[derive(Module, Debug)]
struct Block {
    norm: LayerNorm,
    dense: Dense,
}

/// The network of Table B.1.
#[derive(Module, Debug)]
struct PairNet {
    input: Dense,
    blocks: Vec<Block>,
    output: Dense,
}

impl PairNet {
    /// `keep[k]` `[P, B, 1]` multiplies the branch of block k; `None` means 1.
    fn forward(&self, x: Tensor<3>, keep: Option<&[Tensor<3>]>) -> Tensor<3> {
        let mut h = self.input.forward(x);
        for (k, block) in self.blocks.iter().enumerate() {
            let branch = block.dense.forward(block.norm.forward(h.clone()));
            h = h + match keep {
                Some(keep) => branch * keep[k].clone(),
                None => branch,
            };
        }
        self.output.forward(h)
    }
}

/// One of the three models, for a population.
pub struct PairModel {
    target: PairTarget,
    config: PairConfig,
    net: Trained<PairNet>,
    members: Vec<Streams>,
    /// Mean and spread of the standardised states' differences, `[P, 1, inputs]`.
    delta: (Tensor<3>, Tensor<3>),
    /// Mean and spread of the predicted quantity, `[P, 1, 1]`; (0, 1) except for rewards.
    units: (Tensor<3>, Tensor<3>),
    steps: u64,
}

impl PairModel {
    /// A new model for the members of `buffer`, with units from their target rows, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If a number of the configuration is out of range.
    pub fn new(
        target: PairTarget,
        buffer: &Buffer,
        config: &PairConfig,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        within("drop_path", config.drop_path, 0.0..=0.99)?;
        within("lr", config.lr, 0.0..=1.0)?;
        within("width", config.width as f64, 1.0..=1e5)?;
        let (members, inputs) = (buffer.streams(), buffer.inputs().len());
        let p = members.len();
        let (mut delta_mean, mut delta_std, mut mean, mut std) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (m, member) in buffer.members().iter().enumerate() {
            let delta = buffer.step_units(m);
            delta_mean.extend(delta.mean);
            delta_std.extend(delta.std);
            let reward = match target {
                PairTarget::Reward => Standardizer::fit_on(&[Rows::new(&member.parts[0].rewards, 1)]),
                _ => Standardizer::identity(1),
            };
            mean.extend(reward.mean);
            std.extend(reward.std);
        }
        let wide = |v: Vec<f32>| tensor(v, [p, 1, inputs], device);
        let one = |v: Vec<f32>| tensor(v, [p, 1, 1], device);
        let train = device.clone().autodiff();
        let outputs = if target == PairTarget::Action { buffer.act_dim() } else { 1 };
        let (name, w) = (target.name(), config.width);
        let dense = |part: &str, i, o, act| Dense::new(&members, &format!("{name}/{part}"), i, o, act, &train);
        let block = |k| Block {
            norm: LayerNorm::new(p, w, &train),
            dense: dense(&format!("block {k}"), w, w, Activation::Silu),
        };
        let net = PairNet {
            input: dense("input", 2 * inputs, w, Activation::Identity),
            blocks: (0..config.blocks).map(block).collect(),
            output: dense("output", w, outputs, Activation::Identity),
        };
        Ok(Self {
            target,
            config: config.clone(),
            net: Trained::new(net),
            delta: (wide(delta_mean), wide(delta_std)),
            units: (one(mean), one(std)),
            members,
            steps,
        })
    }

    /// The network's input, computed from standardised states.
    fn input(&self, s: Tensor<3>, s2: Tensor<3>) -> Tensor<3> {
        let second = match self.config.input {
            PairInput::Next => s2,
            PairInput::Delta => (s2 - s.clone() - self.delta.0.clone()) / self.delta.1.clone(),
        };
        Tensor::cat(vec![s, second], 2)
    }

    /// One step on `batch`. Returns each member's loss `[P, 1, 1]`.
    pub fn update(&mut self, batch: &Minibatch, step: u64) -> Tensor<3> {
        let x = self.input(batch.s.clone(), batch.s2.clone());
        let keep = self.path_masks(batch.s.dims()[1], step, &batch.s.device());
        let y = self.net.net().forward(x, Some(&keep));
        let loss = match self.target {
            PairTarget::Action => squared_error(y, batch.a.clone()),
            PairTarget::Reward => squared_error(y, (batch.r.clone() - self.units.0.clone()) / self.units.1.clone()),
            // -t ln p - (1 - t) ln (1 - p) of the logit y, computed without overflow.
            PairTarget::Terminal => {
                let terminal = batch.not_done.clone().neg() + 1.0;
                activation::relu(y.clone()) - y.clone() * terminal + y.abs().neg().exp().log1p()
            }
        };
        let loss = member_mean(loss);
        let values = loss.clone().inner();
        let lr = if self.config.cosine { cosine_decay(self.config.lr, step, self.steps) } else { self.config.lr };
        self.net.step(loss.sum(), lr);
        values
    }

    /// Stochastic depth: per block `[P, rows, 1]`, 0 for the rows whose branch is dropped, else 1 / (1 - p_k).
    fn path_masks(&self, rows: usize, step: u64, device: &Device) -> Vec<Tensor<3>> {
        let (p, blocks) = (self.members.len(), self.config.blocks);
        let name = format!("{}/drop path", self.target.name());
        let mut rngs: Vec<_> = self.members.iter().map(|m| m.indexed(&name, step)).collect();
        let mask = |k: usize| {
            let rate = self.config.drop_path * (k + 1) as f64 / blocks as f64;
            let kept = (1.0 / (1.0 - rate)) as f32;
            let mut data = Vec::with_capacity(p * rows);
            for rng in &mut rngs {
                data.extend((0..rows).map(|_| if rng.random::<f64>() < rate { 0.0 } else { kept }));
            }
            tensor(data, [p, rows, 1], device)
        };
        (0..blocks).map(mask).collect()
    }

    /// Predictions for pairs that `buffer` standardises. `pairs[m]` `[N, 2 obs_dim]` holds (s, s') in original units;
    /// the result is `[N, outputs]`, also in original units. Stochastic depth is off.
    pub fn predict(&self, buffer: &Buffer, pairs: &[Vec<f32>], device: &Device) -> Vec<Vec<f32>> {
        let inputs = buffer.inputs().len();
        // The concatenation (s, s') is read as two observations.
        let tables: Vec<_> = pairs.iter().enumerate().map(|(m, pairs)| buffer.network_inputs(m, pairs)).collect();
        let net = self.net.net().valid();
        map_rows(&tables, 2 * inputs, device, |_, x| {
            let (s, s2) = (x.clone().narrow(2, 0, inputs), x.narrow(2, inputs, inputs));
            net.forward(self.input(s, s2), None) * self.units.1.clone() + self.units.0.clone()
        })
    }

    /// Adds parameters and optimiser to `state`.
    pub fn save(&self, state: &mut NamedParameters) {
        self.net.save(self.target.name(), state);
    }

    /// Restores parameters and optimiser from `state`. The units are those of the buffer for which the model was made.
    ///
    /// # Errors
    /// If they belong to another model.
    pub fn load(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.net.load(self.target.name(), state, path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buffer::Member;
    use std::sync::Arc;
    use tce_data::Transitions;
    use tce_nn::{cpu, host};

    fn buffer() -> Buffer {
        let mut t = Transitions::new(2, 1);
        for i in 0..50 {
            let x = (i as f32 * 0.7).sin();
            t.push(&[x, 100.0 * x], &[x], 10.0 + 5.0 * x, &[x + 0.01 * x * x, 100.0 * x - 0.5], i % 9 == 0, true);
        }
        let standardizer = Standardizer::fit(&t.observations, 2);
        let member = |seed| Member {
            streams: Streams::new(seed),
            parts: vec![Arc::new(t.clone())],
            standardizer: standardizer.clone(),
            reward_scale: 1.0,
            row_scores: None,
        };
        Buffer::new(vec![member(1), member(2)], 16).unwrap()
    }

    fn model(target: PairTarget, config: &PairConfig) -> PairModel {
        PairModel::new(target, &buffer(), config, 10, &cpu()).unwrap()
    }

    #[test]
    fn stochastic_depth_keeps_the_expectation() {
        let model = model(PairTarget::Action, &PairConfig { drop_path: 0.3, ..PairConfig::default() });
        let masks = model.path_masks(20_000, 0, &cpu());
        for (k, mask) in masks.into_iter().enumerate() {
            let (rate, mask) = (0.1 * (k + 1) as f32, host(mask));
            let dropped = mask.iter().filter(|&&m| m == 0.0).count() as f32 / mask.len() as f32;
            assert!((dropped - rate).abs() < 0.01, "block {k}: {dropped}");
            assert!(mask.iter().all(|&m| m == 0.0 || (m - 1.0 / (1.0 - rate)).abs() < 1e-6));
            let mean = mask.iter().sum::<f32>() / mask.len() as f32;
            assert!((mean - 1.0).abs() < 0.01, "block {k}: {mean}");
        }
        assert_ne!(host(model.path_masks(50, 1, &cpu()).remove(2)), host(model.path_masks(50, 2, &cpu()).remove(2)));
    }

    /// With delta inputs, both halves of the input have mean 0 and standard deviation 1 over the data.
    #[test]
    fn inputs_are_in_units_of_their_spread() {
        let buffer = buffer();
        let model = model(PairTarget::Action, &PairConfig::default());
        let rows = &buffer.members()[0].parts[0];
        let s = tensor(buffer.network_inputs(0, &rows.observations), [1, 50, 2], &cpu());
        let s2 = tensor(buffer.network_inputs(0, &rows.next_observations), [1, 50, 2], &cpu());
        let expand = |t: Tensor<3>| t.expand([2, 50, 2]);
        let x = host(model.input(expand(s), expand(s2)));
        for d in 0..3 {
            let column: Vec<f32> = x[..200].iter().skip(d).step_by(4).copied().collect();
            let mean = column.iter().sum::<f32>() / 50.0;
            let std = (column.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / 50.0).sqrt();
            assert!(mean.abs() < 1e-4 && (std - 1.0).abs() < 1e-3, "dimension {d}: {mean}, {std}");
        }
        // The second difference is the constant -0.5: dead up to rounding, so it must not be amplified.
        assert!(x[..200].iter().skip(3).step_by(4).all(|v| v.abs() < 100.0));
    }

    #[test]
    fn the_classification_loss_is_the_cross_entropy() {
        let buffer = buffer();
        let mut model = model(PairTarget::Terminal, &PairConfig { drop_path: 0.0, ..PairConfig::default() });
        let batch = buffer.sample(0, &cpu());
        let y = host(model.net.net().valid().forward(model.input(batch.s.clone(), batch.s2.clone()), None));
        let not_done = host(batch.not_done.clone());
        let loss = host(model.update(&batch, 0));
        for (m, loss) in loss.into_iter().enumerate() {
            let row = |i: usize| {
                let p = 1.0 / (1.0 + (-y[i] as f64).exp());
                -(if not_done[i] == 0.0 { p } else { 1.0 - p }).ln()
            };
            let expected = (16 * m..16 * (m + 1)).map(row).sum::<f64>() / 16.0;
            assert!((loss as f64 - expected).abs() < 1e-5);
        }
    }
}
