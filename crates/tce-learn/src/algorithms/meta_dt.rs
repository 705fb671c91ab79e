//! Meta-DT (Wang et al. 2024) as in the TCE paper's comparison (Meta-DT*): without prompts, on target and source rows.
//!
//! ```text
//! z   = E(the h steps before), L_W = mean (ŝ' - s')² + mean (r̂ - r)²        first, on its own → world model (see world_model)
//! π_t = DT(R̂, s, z, a of the last K steps; the step's own R̂, s, z)           causal (see transformer), E as it is now
//! L_π = mean over steps and action dimensions of (π_t - a_t)²                → DT
//! ```
//!
//! Half of a member's segments are from the target, half from the source ([`crate::sequences`]). Where s' is unknown, at
//! terminal rows of logs without next states, the world model does not see the row. The transformer does: it needs s, a
//! and the rewards, and a context is of steps before its own.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | K | `context` | 8 | Meta-DT |
//! | - | `embed`, `layers`, `heads` | 128, 3, 1; ReLU | Meta-DT |
//! | - | `dropout` | .1 | Meta-DT; GPT-2's places, see [`crate::transformer`] |
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
//! | - | `world_model.features`, `.gru`, `.latent`, `.hidden` | 16, 128, 16, (128, 128) | Meta-DT; its decoders see s and a through a layer of 16, ours as they are, and both for all robots |
//!
//! Rewards are not scaled: a buffer's `reward_scale` is for critics, and `return_scale` replaces it here.

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::burn::tensor::{Int, TensorData};
use tce_nn::{AdamConfig, Device, NamedParameters, NetworkError, Tensor, Trained, host, tensor};

use crate::buffer::{Buffer, Member, Minibatch};
use crate::contexts::{Contexts, Of};
use crate::error::{LearnError, within};
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::networks::Dropout;
use crate::policy::{Policy, PolicyLearner};
use crate::sequence_policy::{MAX_CONTEXT, SequencePolicy, SequenceSpec};
use crate::sequences::Segments;
use crate::training::{Learner, Meter, Place, prepare};
use crate::transformer::{DecisionTransformer, TransformerInput, TransformerSizes};
use crate::world_model::{SegmentTensors, WorldModelConfig, Worlds};

const ABOUT: About = About {
    name: "meta-dt",
    title: "Meta-DT*",
    description: "a decision transformer on contexts of a world model, zero-shot",
    reference: "Meta-DT 2024",
    published: None,
    table: "meta_dt",
    needs: OtherRows::Any,
    episodes: true,
    scores: RowScores::None,
};

impl Method for MetaDtConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        within("context", self.context as f64, 1.0..=MAX_CONTEXT as f64)?;
        for (field, value) in
            [("embed", self.embed), ("layers", self.layers), ("heads", self.heads), ("batch", self.batch)]
        {
            within(field, value as f64, 1.0..=65536.0)?;
        }
        within("timesteps", self.timesteps as f64, 1.0..=1e7)?;
        within("dropout", self.dropout, 0.0..=0.99)?;
        within("lr", self.lr, 0.0..=1.0)?;
        within("weight_decay", self.weight_decay, 0.0..=1e3)?;
        within("grad_clip", self.grad_clip, f64::MIN_POSITIVE..=1e9)?;
        within("return_scale", self.return_scale, f64::MIN_POSITIVE..=1e12)?;
        within("return_factor", self.return_factor, -1e6..=1e6)?;
        if !self.embed.is_multiple_of(self.heads) {
            let expected = format!("a divisor of embed = {}", self.embed);
            return Err(LearnError::invalid("heads", self.heads, expected, "correct the configuration"));
        }
        self.world_model.check()
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let learner = MetaDt::new(on.buffer, self, on.place, on.device)?;
        Ok(learner.map(|learner| Box::new(learner) as Box<dyn PolicyLearner>))
    }
}

/// The configuration of [`MetaDt`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MetaDtConfig {
    /// K, the steps that the transformer sees. Source: Meta-DT.
    #[schemars(range(min = 1, max = 1024))]
    pub context: usize,
    /// Width of a token. Source: Meta-DT.
    #[schemars(range(min = 1, max = 65536))]
    pub embed: usize,
    /// Blocks of the transformer. Source: Meta-DT.
    #[schemars(range(min = 1, max = 65536))]
    pub layers: usize,
    /// Heads of attention; they share the width of a token. Source: Meta-DT.
    #[schemars(range(min = 1, max = 65536))]
    pub heads: usize,
    /// Share of the activations that are dropped in training. Source: Meta-DT.
    #[schemars(range(min = 0.0, max = 0.99))]
    pub dropout: f64,
    /// Steps of an episode that are told apart; later ones look like the last. Source: episodes of MuJoCo.
    #[schemars(range(min = 1, max = 10000000))]
    pub timesteps: usize,
    /// Learning rate after the warm-up. Source: Meta-DT.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr: f64,
    /// Decoupled weight decay, multiplied by the learning rate. Source: Meta-DT.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub weight_decay: f64,
    /// Steps over which the learning rate rises from 0. Source: Meta-DT.
    pub warm_up: u64,
    /// Greatest norm of the gradient. Source: Meta-DT.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1000000000.0))]
    pub grad_clip: f64,
    /// Segments of episodes per step, half of them the target's. Source: Meta-DT.
    #[schemars(range(min = 1, max = 65536))]
    pub batch: usize,
    /// What returns to go are divided by. Source: Meta-DT.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1000000000000.0))]
    pub return_scale: f64,
    /// How many times the best return of a trajectory of the target an evaluation asks for. Source: own; the expert's return, which
    /// a user does not know, was asked for by others.
    #[schemars(range(min = -1000000.0, max = 1000000.0))]
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
    /// Learning rate of the transformer at `step`.
    fn rate(&self, step: u64) -> f64 {
        self.lr * ((step + 1) as f64 / self.warm_up.max(1) as f64).min(1.0)
    }
}

/// Meta-DT of a population. Each member's networks are separate modules.
pub struct MetaDt {
    config: MetaDtConfig,
    buffer: Buffer,
    device: Device,
    /// The finished world models.
    worlds: Worlds,
    members: Vec<MemberNets>,
}

struct MemberNets {
    streams: Streams,
    /// Computed with the finished world model.
    contexts: Contexts,
    transformer: Trained<DecisionTransformer>,
}

impl MetaDt {
    /// New networks for the members of `buffer`. The world models are trained here. `None` if interrupted.
    ///
    /// # Errors
    /// If the configuration cannot be used, the s' of no row of a table is known, or a checkpoint at `place` cannot be read
    /// or written.
    pub fn new(
        buffer: &Buffer,
        config: &MetaDtConfig,
        place: Place<'_>,
        device: &Device,
    ) -> Result<Option<Self>, LearnError> {
        config.check()?;
        let c = &config.world_model;
        let known = buffer.clone().with_successors()?;
        let mut worlds = Worlds::new(&known, c, device);
        if !prepare(&mut worlds, &known, c.steps, "Meta-DT world model", place, device)? {
            return Ok(None);
        }
        let trainable = device.clone().autodiff();
        let adam =
            AdamConfig { max_norm: Some(config.grad_clip), weight_decay: config.weight_decay, ..AdamConfig::default() };
        let nets = |(m, member): (usize, &Member)| {
            let transformer = sizes(config, buffer.inputs().len(), buffer.act_dim()).init(member.streams, &trainable);
            MemberNets {
                streams: member.streams,
                contexts: Contexts::new(worlds.member(m).0, c.latent),
                transformer: Trained::with(transformer, adam),
            }
        };
        let members = buffer.members().iter().enumerate().map(nets).collect();
        Ok(Some(Self { config: config.clone(), buffer: buffer.clone(), device: device.clone(), worlds, members }))
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

impl MemberNets {
    /// π at the steps of `segments`, `[B, K, A]`.
    fn actions(&mut self, segments: &Segments, of: Of, c: &MetaDtConfig, dropout: &mut Dropout) -> Tensor<3> {
        let contexts = self.contexts.of(segments, c.context, of);
        let batch = SegmentTensors::new(segments, c.context, of.device);
        let shape = [c.batch, c.context];
        let on_device = |v: Vec<f32>| {
            let width = v.len() / (c.batch * c.context);
            tensor(v, [c.batch, c.context, width], of.device)
        };
        let times: Vec<i32> = segments.times.iter().map(|t| (*t).min(c.timesteps as i32 - 1)).collect();
        let input = TransformerInput {
            returns: on_device(segments.returns_to_go.iter().map(|r| r / c.return_scale as f32).collect()),
            states: batch.s,
            contexts: on_device(contexts),
            actions: batch.a,
            times: Tensor::<2, Int>::from_data(TensorData::new(times, shape), of.device),
        };
        self.transformer.net().forward(input, dropout)
    }
}

/// L_π of `actions` `[B, K, A]` at the steps of `segments`, `[1]`.
fn policy_loss(actions: Tensor<3>, segments: &Segments, device: &Device) -> Tensor<1> {
    let [b, k, width] = actions.dims();
    let data = tensor(segments.actions.clone(), [b, k, width], device);
    let valid = tensor(segments.valid.clone(), [b, k, 1], device);
    let numbers = segments.valid.iter().sum::<f32>() * width as f32;
    ((actions - data).square() * valid).sum() / numbers
}

impl Learner for MetaDt {
    /// Ignores the rows of `batch`: a learner of sequences draws its own segments.
    fn update(&mut self, _batch: &Minibatch, step: u64, meter: &mut Meter) {
        let Self { config: c, buffer, device, worlds, members } = self;
        let mut metrics = Vec::new();
        for (m, nets) in members.iter_mut().enumerate() {
            let (trajectories, encoder) = worlds.member(m);
            // The indices differ from those of the world model's segments.
            let segments = trajectories.sample(buffer, m, c.world_model.steps + step, [c.batch, c.context, 0]);
            let mut dropout = Dropout::new(c.dropout, nets.streams.indexed("dropout", step));
            let of = Of { trajectories, encoder, buffer, member: m, device };
            let loss = policy_loss(nets.actions(&segments, of, c, &mut dropout), &segments, device);
            if meter.active() {
                metrics.push(host(loss.clone())[0] as f64);
            }
            nets.transformer.step(loss, c.rate(step));
        }
        if meter.active() {
            meter.add("policy_loss", metrics);
        }
    }

    fn state(&self) -> NamedParameters {
        let mut state = self.worlds.state();
        for (m, nets) in self.members.iter().enumerate() {
            nets.transformer.save(&format!("transformer.{m}"), &mut state);
        }
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.worlds.restore(state, path)?;
        for (m, nets) in self.members.iter_mut().enumerate() {
            nets.transformer.load(&format!("transformer.{m}"), state, path)?;
            nets.contexts = Contexts::new(self.worlds.member(m).0, self.config.world_model.latent);
        }
        Ok(())
    }
}

impl PolicyLearner for MetaDt {
    fn policies(&self) -> Vec<Policy> {
        let (buffer, c) = (&self.buffer, &self.config);
        let (inputs, actions) = (buffer.inputs().len(), buffer.act_dim());
        let policy = |(m, (nets, member)): (usize, (&MemberNets, &Member))| {
            let (trajectories, encoder) = self.worlds.member(m);
            let spec = SequenceSpec {
                observations: buffer.obs_dim(),
                actions,
                inputs: buffer.inputs().to_vec(),
                standardizer: member.standardizer.clone(),
                context: c.context,
                encoder: c.world_model.sizes(inputs, actions),
                transformer: sizes(c, inputs, actions),
                return_scale: c.return_scale,
                first_return: c.return_factor * trajectories.best_target_return(),
            };
            SequencePolicy::of(spec, encoder, nets.transformer.net()).into()
        };
        self.members.iter().zip(buffer.members()).enumerate().map(policy).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::PolicyKind;
    use std::sync::Arc;
    use tce_base::random::fill_normal;
    use tce_data::{Standardizer, Transitions};
    use tce_nn::cpu;

    /// Episodes of 7, 1 and 5 steps, with three observations (one of them constant) and two actions.
    fn learner() -> (MetaDt, Arc<Transitions>) {
        let mut t = Transitions::new(3, 2);
        let mut row = [0.0; 9];
        for i in 0..13 {
            fill_normal(&mut Streams::new(3).indexed("row", i), &mut row);
            (row[1], row[7]) = (4.0, 4.0);
            t.push(&row[..3], &[row[3].tanh(), row[4].tanh()], row[5], &row[6..], i == 6, i == 7);
        }
        let t = Arc::new(t);
        let standardizer = Standardizer::fit(&t.observations, 3);
        let member = Member {
            streams: Streams::new(1),
            parts: vec![t.clone()],
            standardizer,
            reward_scale: 1.0,
            row_scores: None,
        };
        let buffer = Buffer::new(vec![member], 2).unwrap();
        let mut config = MetaDtConfig { context: 3, embed: 16, heads: 2, batch: 5, ..MetaDtConfig::default() };
        (config.timesteps, config.return_scale) = (4, 2.0);
        (config.world_model.horizon, config.world_model.gru, config.world_model.steps) = (2, 8, 0);
        (MetaDt::new(&buffer, &config, Place::NONE, &cpu()).unwrap().unwrap(), t)
    }

    /// The loss of a batch equals that of the finished policy's actions, run step by step through the table's episodes:
    /// training computes what an evaluation computes, and the loss is the mean over existing steps.
    #[test]
    fn the_loss_is_that_of_the_policy_that_acts() {
        let (mut learner, t) = learner();
        let mut policy = learner.policies().remove(0);
        let mut errors = Vec::new();
        for episode in t.episodes() {
            let PolicyKind::Sequence(sequence) = policy.kind_mut() else { panic!("a policy with a memory") };
            // The policy is asked for the return that the data have in this episode.
            let mut memory = sequence.asked(episode.episode_return).start();
            let mut a = [0.0; 2];
            for i in episode.start..episode.end {
                sequence.act(t.observation(i), &mut [&mut memory], &mut a);
                errors.push(a.iter().zip(t.action(i)).map(|(a, b)| (a - b).powi(2)).sum::<f32>());
                // The policy's memory gets the action of the data.
                memory.act(t.action(i));
                memory.reward(t.rewards[i].into());
            }
        }
        let MetaDt { config: c, buffer, device, worlds, members } = &mut learner;
        let nets = &mut members[0];
        let (trajectories, encoder) = worlds.member(0);
        let segments = trajectories.sample(buffer, 0, 11, [c.batch, c.context, 0]);
        let of = Of { trajectories, encoder, buffer, member: 0, device };
        let actions = nets.actions(&segments, of, c, &mut Dropout::none());
        let loss = host(policy_loss(actions.clone(), &segments, device))[0];
        let begin = |row: usize| [0, 7, 8].into_iter().rfind(|b| *b <= row).unwrap();
        let rows = segments.picks.iter().flat_map(|p| {
            let row = p.row as usize;
            begin(row).max((row + 1).saturating_sub(3))..row + 1
        });
        let rows: Vec<_> = rows.collect();
        // The policy sees three steps, as do a segment's later steps; segments that start within an episode see fewer.
        let whole: Vec<_> = segments.picks.iter().map(|p| p.row as usize).collect();
        assert!(rows.len() > whole.len());
        let per_step = host(actions);
        for (k, row) in whole.into_iter().enumerate() {
            let last = segments.valid[3 * k..][..3].iter().filter(|v| **v > 0.0).count() - 1;
            let own = &per_step[(3 * k + last) * 2..][..2];
            let error = own.iter().zip(t.action(row)).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
            assert!((error - errors[row]).abs() < 1e-5, "row {row}: {error} {}", errors[row]);
        }
        let own = per_step.chunks(2).zip(segments.actions.chunks(2)).zip(&segments.valid);
        let sum: f32 = own.map(|((a, b), v)| v * ((a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2))).sum();
        assert!((loss - sum / (2.0 * rows.len() as f32)).abs() < 1e-6, "{loss}");
    }

    #[test]
    fn the_rate_rises_and_stays() {
        let c = MetaDtConfig::default();
        assert!((c.rate(0) - 5e-9).abs() < 1e-18 && (c.rate(4999) - 2.5e-5).abs() < 1e-15);
        assert_eq!((c.rate(9_999), c.rate(1 << 40)), (5e-5, 5e-5));
    }
}
