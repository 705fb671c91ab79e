//! The world model of Meta-DT. Its context z distinguishes domains by their dynamics and rewards.
//!
//! ```text
//! f_t  = [relu(W_s s_t); relu(W_a a_t); relu(W_r r_t)]           features of a step, each of three parts 16 wide
//! z_t  = W_z GRU(f_(t-h), ..., f_(t-1)) + b_z                    context of the h steps before t, in R^16
//! ŝ'_t = MLP_s([s_t; a_t; z_t]);  r̂_t = MLP_r([s_t; a_t; z_t])   decoders, 128-128 ReLU
//! L    = mean (ŝ' - s')² + mean (r̂ - r)²
//! ```
//!
//! z_t depends only on steps before t, so it is known when a_t is chosen. Steps before an episode's start are zeros.

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::burn::nn::Linear;
use tce_nn::burn::tensor::activation::relu;
use tce_nn::{AdamConfig, Device, Module, NamedParameters, NetworkError, Tensor, Trained, host, tensor};

use crate::buffer::{Buffer, Member, Minibatch};
use crate::context_encoder::{ContextEncoder, EncoderSizes};
use crate::error::{LearnError, within};
use crate::networks::{Start, initialise, linear};
use crate::sequences::{Segments, Trajectories};
use crate::training::{Learner, Meter};

/// Encoder and decoders of one member.
#[derive(Module, Debug)]
pub struct WorldModel {
    /// Computes z.
    pub encoder: ContextEncoder,
    next_state: Vec<Linear>,
    reward: Vec<Linear>,
}

impl WorldModel {
    /// (ŝ', r̂) `[B, K, ·]` for s, a and z of the same shape.
    pub fn predict(&self, s: Tensor<3>, a: Tensor<3>, z: Tensor<3>) -> (Tensor<3>, Tensor<3>) {
        let x = Tensor::cat(vec![s, a, z], 2);
        let run = |layers: &[Linear]| {
            let (last, hidden) = layers.split_last().expect("at least the output layer");
            last.forward(hidden.iter().fold(x.clone(), |x, layer| relu(layer.forward(x))))
        };
        (run(&self.next_state), run(&self.reward))
    }

    /// The two terms of L, `[1]` each, of segments of one step and their strips.
    pub fn losses(&self, batch: &SegmentTensors, strip: [Tensor<3>; 3]) -> [Tensor<1>; 2] {
        let z = self.encoder.contexts(strip);
        let (next_state, reward) = self.predict(batch.s.clone(), batch.a.clone(), z);
        [(next_state - batch.s2.clone()).square().mean(), (reward - batch.r.clone()).square().mean()]
    }
}

/// How the world model is made and trained; see the [module](self) and [`crate::meta_dt`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WorldModelConfig {
    /// Training steps of the world model, before the transformer's first. Source: own; Meta-DT: 201 passes over its data.
    pub steps: u64,
    /// Learning rate of the world model, constant. Source: Meta-DT.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr: f64,
    /// Rows per step of the world model. Source: Meta-DT.
    #[schemars(range(min = 1, max = 65536))]
    pub batch: usize,
    /// Greatest norm of the world model's gradient. Source: Meta-DT.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1000000000.0))]
    pub grad_clip: f64,
    /// h, the steps that a context is made of. Source: own: as many as the transformer sees.
    #[schemars(range(min = 1, max = 65536))]
    pub horizon: usize,
    /// Width of what is made of a state, an action and a reward, each. Source: Meta-DT.
    #[schemars(range(min = 1, max = 65536))]
    pub features: usize,
    /// Width of the recurrent network that reads the steps. Source: Meta-DT.
    #[schemars(range(min = 1, max = 65536))]
    pub gru: usize,
    /// Width of the context z. Source: Meta-DT.
    #[schemars(range(min = 1, max = 65536))]
    pub latent: usize,
    /// Widths of the hidden layers of the decoders. Source: Meta-DT.
    pub hidden: Vec<usize>,
}

impl Default for WorldModelConfig {
    fn default() -> Self {
        Self {
            steps: 10_000,
            lr: 1e-3,
            batch: 128,
            grad_clip: 1.0,
            horizon: 8,
            features: 16,
            gru: 128,
            latent: 16,
            hidden: vec![128, 128],
        }
    }
}

impl WorldModelConfig {
    /// Returns an error for numbers out of range.
    ///
    /// # Errors
    /// The error names the field.
    pub fn check(&self) -> Result<(), LearnError> {
        within("world_model.lr", self.lr, 0.0..=1.0)?;
        within("world_model.grad_clip", self.grad_clip, f64::MIN_POSITIVE..=1e9)?;
        for (field, value) in [
            ("world_model.batch", self.batch),
            ("world_model.horizon", self.horizon),
            ("world_model.features", self.features),
            ("world_model.gru", self.gru),
            ("world_model.latent", self.latent),
        ] {
            within(field, value as f64, 1.0..=65536.0)?;
        }
        self.hidden.iter().try_for_each(|n| within("world_model.hidden", *n as f64, 1.0..=65536.0))
    }

    /// The encoder's sizes for these numbers of input and action dimensions.
    pub fn sizes(&self, inputs: usize, actions: usize) -> EncoderSizes {
        EncoderSizes {
            inputs,
            actions,
            features: self.features,
            hidden: self.gru,
            latent: self.latent,
            horizon: self.horizon,
        }
    }

    /// New networks of one member.
    pub fn init(&self, inputs: usize, actions: usize, streams: Streams, device: &Device) -> WorldModel {
        let encoder = self.sizes(inputs, actions).init("world/encoder", streams, device);
        let decoder = |name: &str, output: usize| {
            let mut widths = vec![inputs + actions + self.latent];
            widths.extend(&self.hidden);
            widths.push(output);
            let layers: Vec<_> = widths.windows(2).map(|w| linear(w[0], w[1], device)).collect();
            initialise(layers, name, streams, |_| Start::Linear)
        };
        WorldModel { encoder, next_state: decoder("world/state", inputs), reward: decoder("world/reward", 1) }
    }
}

/// [`Segments`] on the device, outside of autodiff; shapes as in [`crate::sequences`].
pub struct SegmentTensors {
    /// s
    pub s: Tensor<3>,
    /// a
    pub a: Tensor<3>,
    /// r
    pub r: Tensor<3>,
    /// s'
    pub s2: Tensor<3>,
}

impl SegmentTensors {
    /// Converts `segments` of `steps` steps each.
    pub fn new(segments: &Segments, steps: usize, device: &Device) -> Self {
        let batch = segments.rewards.len() / steps;
        let on_device = |v: &[f32]| tensor(v.to_vec(), [batch, steps, v.len() / (batch * steps)], device);
        Self {
            s: on_device(&segments.states),
            a: on_device(&segments.actions),
            r: on_device(&segments.rewards),
            s2: on_device(&segments.next_states),
        }
    }
}

/// The strips of `batch` segments on the device: states, actions, rewards.
pub fn strip(segments: &Segments, batch: usize, device: &Device) -> [Tensor<3>; 3] {
    let steps = segments.strip_rewards.len() / batch;
    [&segments.strip_states, &segments.strip_actions, &segments.strip_rewards]
        .map(|v| tensor(v.to_vec(), [batch, steps, v.len() / (batch * steps)], device))
}

/// The world models of a population during training. Each member's networks are separate modules.
pub struct Worlds {
    config: WorldModelConfig,
    buffer: Buffer,
    device: Device,
    members: Vec<(Trajectories, Trained<WorldModel>)>,
}

impl Worlds {
    /// New networks for the members of `buffer`, whose batches must hold only rows with s'.
    pub fn new(buffer: &Buffer, config: &WorldModelConfig, device: &Device) -> Self {
        let trainable = device.clone().autodiff();
        let adam = AdamConfig { max_norm: Some(config.grad_clip), ..AdamConfig::default() };
        let start = |member: &Member| {
            let model = config.init(buffer.inputs().len(), buffer.act_dim(), member.streams, &trainable);
            (Trajectories::new(member), Trained::with(model, adam))
        };
        let members = buffer.members().iter().map(start).collect();
        Self { config: config.clone(), buffer: buffer.clone(), device: device.clone(), members }
    }

    /// The trajectories of member `m`, and the current encoder.
    pub fn member(&self, m: usize) -> (&Trajectories, &ContextEncoder) {
        let (trajectories, model) = &self.members[m];
        (trajectories, &model.net().encoder)
    }
}

impl Learner for Worlds {
    /// Ignores the rows of `batch`: a learner of sequences draws its own segments.
    fn update(&mut self, _batch: &Minibatch, step: u64, meter: &mut Meter) {
        let Self { config: c, buffer, device, members } = self;
        let mut metrics: [Vec<f64>; 2] = Default::default();
        for (m, (trajectories, model)) in members.iter_mut().enumerate() {
            let segments = trajectories.sample(buffer, m, step, [c.batch, 1, c.horizon]);
            let batch = SegmentTensors::new(&segments, 1, device);
            let losses = model.net().losses(&batch, strip(&segments, c.batch, device));
            if meter.active() {
                metrics.iter_mut().zip(&losses).for_each(|(f, loss)| f.push(host(loss.clone())[0] as f64));
            }
            let [state, reward] = losses;
            model.step(state + reward, c.lr);
        }
        if meter.active() {
            ["world_state_loss", "world_reward_loss"].iter().zip(metrics).for_each(|(name, f)| meter.add(name, f));
        }
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        for (m, (_, model)) in self.members.iter().enumerate() {
            model.save(&format!("world.{m}"), &mut state);
        }
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        let mut members = self.members.iter_mut().enumerate();
        members.try_for_each(|(m, (_, model))| model.load(&format!("world.{m}"), state, path))
    }
}
