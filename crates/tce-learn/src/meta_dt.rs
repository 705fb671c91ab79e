//! Meta-DT (Wang et al. 2024) as TCE compares with it (Meta-DT*): without prompts, trained on target and source rows alike.
//!
//! ```text
//! z   = E(the h steps before), L_W = mean (ŝ' - s')² + mean (r̂ - r)²        first, on its own → world model (see world_model)
//! π_t = DT(R̂, s, z, a of the last K steps; the step's own R̂, s, z)           causal (see transformer), E as it is now
//! L_π = mean over steps and action dimensions of (π_t - a_t)²                → DT
//! ```
//!
//! A member's segments are half from the target, half from the source ([`crate::sequences`]). Steps 0 to `world_model.steps` - 1 of
//! the training are the world model's, the others the transformer's: [`MetaDt::updates`].
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | K | `context` | 8 | Meta-DT |
//! | - | `embed`, `layers`, `heads` | 128, 3, 1; ReLU | Meta-DT |
//! | - | `dropout` | .1 | Meta-DT; not on attention weights, see [`crate::transformer`] |
//! | - | `timesteps` | 1000 | episodes of MuJoCo; DT's embedding of t |
//! | - | `lr`, `weight_decay` | 5e-5, 1e-4: AdamW | Meta-DT |
//! | - | `warm_up` | 10 000 steps, linear | Meta-DT |
//! | - | `grad_clip` | .25 | Meta-DT |
//! | - | `batch` | 128 segments | Meta-DT |
//! | - | `return_scale` | 500 | Meta-DT |
//! | R̂_1 | `return_factor` | 1, times the best return of a trajectory of the target | ours: what a user without a simulator has to go by; DT's authors took the expert's |
//! | - | `world_model.steps` | 10 000 | ours; Meta-DT: 201 passes over its data |
//! | - | `world_model.lr`, `.batch`, `.grad_clip` | 1e-3, 128, 1 | Meta-DT |
//! | h | `world_model.horizon` | 8 | ours: as many steps as the transformer sees |
//! | - | `world_model.features`, `.gru`, `.latent`, `.hidden` | 16, 128, 16, (128, 128) | Meta-DT |
//!
//! Rewards are used as they are: a buffer's `reward_scale` is for critics, and `return_scale` does its work here.

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::burn::tensor::{Int, TensorData};
use tce_nn::{AdamConfig, Device, Module, NamedParameters, NetworkError, Tensor, Trained, host, tensor};

use crate::buffer::{Buffer, Minibatch};
use crate::error::{LearnError, within};
use crate::networks::Dropout;
use crate::policy::Policy;
use crate::sequence_policy::{SequencePolicy, SequenceSpec};
use crate::sequences::{Segments, Trajectories};
use crate::training::{Learner, Meter, PolicyLearner};
use crate::transformer::{DecisionTransformer, TransformerInput, TransformerSizes};
use crate::world_model::{SegmentTensors, WorldModel, WorldModelConfig};

/// The configuration of [`MetaDt`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MetaDtConfig {
    /// K
    pub context: usize,
    /// Width of a token.
    pub embed: usize,
    /// Blocks.
    pub layers: usize,
    /// Heads of attention; they share the width of a token.
    pub heads: usize,
    /// Share of the activations that are dropped.
    pub dropout: f64,
    /// Steps of an episode that are told apart.
    pub timesteps: usize,
    /// Learning rate after the warm-up.
    pub lr: f64,
    /// Decoupled weight decay, multiplied by the learning rate.
    pub weight_decay: f64,
    /// Steps over which the learning rate rises from 0.
    pub warm_up: u64,
    /// Greatest norm of the gradient.
    pub grad_clip: f64,
    /// Segments per step.
    pub batch: usize,
    /// Divides returns to go.
    pub return_scale: f64,
    /// R̂_1 over the best return of a trajectory of the target.
    pub return_factor: f64,
    /// What the contexts come from.
    pub world_model: WorldModelConfig,
}

impl Default for MetaDtConfig {
    fn default() -> Self {
        Self {
            context: 8,
            embed: 128,
            layers: 3,
            heads: 1,
            dropout: 0.1,
            timesteps: 1000,
            lr: 5e-5,
            weight_decay: 1e-4,
            warm_up: 10_000,
            grad_clip: 0.25,
            batch: 128,
            return_scale: 500.0,
            return_factor: 1.0,
            world_model: WorldModelConfig::default(),
        }
    }
}

impl MetaDtConfig {
    /// Refuses numbers out of range.
    ///
    /// # Errors
    /// Names the field.
    pub fn check(&self) -> Result<(), LearnError> {
        for (field, value) in [
            ("context", self.context),
            ("embed", self.embed),
            ("layers", self.layers),
            ("heads", self.heads),
            ("batch", self.batch),
        ] {
            within(field, value as f64, 1.0..=65536.0)?;
        }
        within("timesteps", self.timesteps as f64, 1.0..=1e7)?;
        within("dropout", self.dropout, 0.0..=0.99)?;
        within("lr", self.lr, 0.0..=1.0)?;
        within("weight_decay", self.weight_decay, 0.0..=1e3)?;
        within("grad_clip", self.grad_clip, f64::MIN_POSITIVE..=1e9)?;
        within("return_scale", self.return_scale, f64::MIN_POSITIVE..=1e12)?;
        within("return_factor", self.return_factor, -1e6..=1e6)?;
        if self.embed % self.heads != 0 {
            let expected = format!("a divisor of embed = {}", self.embed);
            return Err(LearnError::invalid("heads", self.heads, expected, "correct the configuration"));
        }
        self.world_model.check()
    }

    /// Learning rate of the transformer's step `step`.
    fn rate(&self, step: u64) -> f64 {
        self.lr * ((step + 1) as f64 / self.warm_up.max(1) as f64).min(1.0)
    }
}

/// Meta-DT of a population: a member's networks are modules of their own.
pub struct MetaDt {
    config: MetaDtConfig,
    buffer: Buffer,
    members: Vec<MemberNets>,
    device: Device,
}

struct MemberNets {
    streams: Streams,
    trajectories: Trajectories,
    world: Trained<WorldModel>,
    transformer: Trained<DecisionTransformer>,
}

impl MetaDt {
    /// New networks for the members of `buffer`.
    ///
    /// # Errors
    /// If the configuration cannot be used.
    pub fn new(buffer: &Buffer, config: &MetaDtConfig, device: &Device) -> Result<Self, LearnError> {
        config.check()?;
        let trainable = device.clone().autodiff();
        let (inputs, actions) = (buffer.inputs().len(), buffer.act_dim());
        let clipped = |max_norm: f64, weight_decay: f64| AdamConfig {
            max_norm: Some(max_norm),
            weight_decay,
            ..AdamConfig::default()
        };
        let nets = |member: &crate::buffer::Member| {
            let world = config.world_model.init(inputs, actions, member.streams, &trainable);
            let transformer = sizes(config, inputs, actions).init(member.streams, &trainable);
            MemberNets {
                streams: member.streams,
                trajectories: Trajectories::new(member),
                world: Trained::with(world, clipped(config.world_model.grad_clip, 0.0)),
                transformer: Trained::with(transformer, clipped(config.grad_clip, config.weight_decay)),
            }
        };
        let members = buffer.members().iter().map(nets).collect();
        Ok(Self { config: config.clone(), buffer: buffer.clone(), members, device: device.clone() })
    }

    /// Steps of a training in which the transformer makes `steps`: the world model's come before.
    pub fn updates(config: &MetaDtConfig, steps: u64) -> u64 {
        config.world_model.steps + steps
    }
}

fn sizes(c: &MetaDtConfig, inputs: usize, actions: usize) -> TransformerSizes {
    TransformerSizes {
        inputs,
        actions,
        latent: c.world_model.latent,
        features: c.world_model.features,
        embed: c.embed,
        layers: c.layers,
        heads: c.heads,
        timesteps: c.timesteps,
    }
}

/// The transformer's input for segments with contexts, and where they have steps `[B, K, 1]`.
fn input(c: &MetaDtConfig, segments: &Segments, batch: &SegmentTensors, contexts: Tensor<3>) -> TransformerInput {
    let device = batch.s.device();
    let shape = [c.batch, c.context];
    let returns = segments.returns_to_go.iter().map(|r| r / c.return_scale as f32).collect();
    let times: Vec<i32> = segments.times.iter().map(|t| (*t).min(c.timesteps as i32 - 1)).collect();
    TransformerInput {
        returns: tensor(returns, [c.batch, c.context, 1], &device),
        states: batch.s.clone(),
        contexts,
        actions: batch.a.clone(),
        times: Tensor::<2, Int>::from_data(TensorData::new(times, shape), &device),
    }
}

impl MemberNets {
    /// A step down L_W; its two terms.
    fn world_step(&mut self, segments: &Segments, c: &WorldModelConfig, device: &Device) -> [f64; 2] {
        let batch = SegmentTensors::new(segments, c.batch, 1, device);
        let [state, reward] = self.world.net().losses(&batch);
        let figures = [&state, &reward].map(|l| host(l.clone())[0] as f64);
        self.world.step(state + reward, c.lr);
        figures
    }

    /// L_π of segments, `[1]`.
    fn policy_loss(
        &self,
        segments: &Segments,
        c: &MetaDtConfig,
        dropout: Option<&mut Dropout>,
        device: &Device,
    ) -> Tensor<1> {
        let batch = SegmentTensors::new(segments, c.batch, c.context, device);
        // Outside of autodiff: the world model stays.
        let contexts = batch.contexts(&self.world.net().encoder.valid());
        let actions = self.transformer.net().forward(input(c, segments, &batch, contexts), dropout);
        let steps = segments.valid.iter().sum::<f32>();
        let valid = tensor(segments.valid.clone(), [c.batch, c.context, 1], device);
        let width = actions.dims()[2] as f32;
        ((actions - batch.a).square() * valid).sum() / (steps * width)
    }
}

impl Learner for MetaDt {
    /// The rows of `batch` are not looked at: a learner of sequences draws segments of its own.
    fn update(&mut self, _batch: &Minibatch, step: u64, meter: &mut Meter) {
        let Self { config: c, buffer, members, device } = self;
        let w = &c.world_model;
        let mut figures: [Vec<f64>; 2] = Default::default();
        for (m, nets) in members.iter_mut().enumerate() {
            if let Some(step) = step.checked_sub(w.steps) {
                let segments = nets.trajectories.sample(buffer, m, w.steps + step, [c.batch, c.context, w.horizon]);
                let mut dropout = Dropout::new(c.dropout, nets.streams.indexed("dropout", step));
                let loss = nets.policy_loss(&segments, c, Some(&mut dropout), device);
                figures[0].push(host(loss.clone())[0] as f64);
                nets.transformer.step(loss, c.rate(step));
            } else {
                let segments = nets.trajectories.sample(buffer, m, step, [w.batch, 1, w.horizon]);
                let [state, reward] = nets.world_step(&segments, w, device);
                figures[0].push(state);
                figures[1].push(reward);
            }
        }
        if meter.active() {
            let names = if step < w.steps { ["world_state_loss", "world_reward_loss"] } else { ["policy_loss", ""] };
            for (name, values) in names.into_iter().zip(figures).filter(|(name, _)| !name.is_empty()) {
                meter.add(name, values);
            }
        }
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        for (m, nets) in self.members.iter().enumerate() {
            nets.world.save(&format!("world.{m}"), &mut state);
            nets.transformer.save(&format!("transformer.{m}"), &mut state);
        }
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        for (m, nets) in self.members.iter_mut().enumerate() {
            nets.world.load(&format!("world.{m}"), state, path)?;
            nets.transformer.load(&format!("transformer.{m}"), state, path)?;
        }
        Ok(())
    }
}

impl PolicyLearner for MetaDt {
    fn policies(&self) -> Vec<Policy> {
        let (buffer, c) = (&self.buffer, &self.config);
        let (inputs, actions) = (buffer.inputs().len(), buffer.act_dim());
        let policy = |(nets, member): (&MemberNets, &crate::buffer::Member)| {
            let spec = SequenceSpec {
                observations: buffer.obs_dim(),
                actions,
                inputs: buffer.inputs().to_vec(),
                standardizer: member.standardizer.clone(),
                context: c.context,
                encoder: c.world_model.sizes(inputs, actions),
                transformer: sizes(c, inputs, actions),
                return_scale: c.return_scale,
                first_return: c.return_factor * nets.trajectories.best_target_return(),
            };
            let policy = SequencePolicy::of(spec, &nets.world.net().encoder, nets.transformer.net());
            Policy::Sequence(Box::new(policy))
        };
        self.members.iter().zip(buffer.members()).map(policy).collect()
    }
}
