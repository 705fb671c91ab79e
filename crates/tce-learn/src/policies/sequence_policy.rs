//! Policies with a memory: a decision transformer over the last steps of an episode (see [`crate::meta_dt`]).
//!
//! | network input at step t of an episode | here |
//! |---|---|
//! | R̂_1 = the requested return | `first_return` |
//! | R̂_t = R̂_1 - r_1 - ... - r_(t-1), over `return_scale` | [`Recall`] |
//! | z_t, the context of the h steps before | computed once and stored |
//! | the last K steps (R̂, s, z, a), including this one | [`Recall`] |
//!
//! The network is deterministic, so actions are not sampled.

use std::collections::VecDeque;
use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_data::Standardizer;
use tce_nn::burn::tensor::{Int, Tensor, TensorData};
use tce_nn::{Module, NamedParameters, cpu, host, tensor};

use crate::context_encoder::{ContextEncoder, EncoderSizes};
use crate::error::LearnError;
use crate::networks::Dropout;
use crate::transformer::{DecisionTransformer, TransformerInput, TransformerSizes};

/// Key of the specification in a policy file's metadata.
pub(crate) const KEY: &str = "sequence_policy";

/// Largest K. The weights in a file do not determine K, and the memory for attention grows with its square.
pub(crate) const MAX_CONTEXT: usize = 1024;

/// Prefix of the parameters' names.
const PREFIX: &str = "policy";

/// The specification of a [`SequencePolicy`]: everything except its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SequenceSpec {
    /// Length of an observation.
    pub observations: usize,
    /// Length of an action.
    pub actions: usize,
    /// The observation dimensions that the networks see, ascending.
    pub inputs: Vec<usize>,
    /// Covers all observation dimensions.
    pub standardizer: Standardizer,
    /// K, the number of steps that the transformer sees.
    pub context: usize,
    /// Sizes of the network that computes contexts.
    pub encoder: EncoderSizes,
    /// Sizes of the network that computes actions.
    pub transformer: TransformerSizes,
    /// Divides every R̂.
    pub return_scale: f64,
    /// R̂ of an episode's first step, in units of the reward.
    pub first_return: f64,
}

impl SequenceSpec {
    /// The first error in the specification: field, found, expected. `numbers` is the number of weights in the file.
    fn fault(&self, numbers: usize) -> Option<(&'static str, String, String)> {
        let (n, e, t) = (self.observations, &self.encoder, &self.transformer);
        let sizes = [self.context, e.horizon, e.features, e.hidden, t.embed, t.layers, t.heads, t.timesteps];
        if self.actions == 0 || self.inputs.is_empty() || sizes.contains(&0) || e.latent == 0 || t.features == 0 {
            return Some(("sizes", format!("{e:?}, {t:?}, context {}", self.context), "all above 0".into()));
        }
        if self.context > MAX_CONTEXT || e.horizon > 65536 {
            let found = format!("{}, {}", self.context, e.horizon);
            return Some(("context, horizon", found, format!("at most {MAX_CONTEXT} and 65536")));
        }
        if self.inputs.iter().any(|&d| d >= n) {
            return Some(("inputs", format!("{:?}", self.inputs), format!("dimensions below {n}")));
        }
        let widths = [(e.inputs, e.actions, e.latent), (t.inputs, t.actions, t.latent)];
        if widths != [(self.inputs.len(), self.actions, e.latent); 2] || !t.embed.is_multiple_of(t.heads) {
            let expected = "the policy's inputs and actions, and a width that the heads share".to_owned();
            return Some(("encoder, transformer", format!("{e:?}, {t:?}"), expected));
        }
        let z = &self.standardizer;
        if z.mean.len() != n || z.std.len() != n || z.std.iter().any(|s| s.is_nan() || *s <= 0.0) {
            let found = format!("{} means, {} divisors", z.mean.len(), z.std.len());
            return Some(("standardizer", found, format!("{n} of each, divisors positive")));
        }
        if !(self.return_scale > 0.0 && self.return_scale.is_finite() && self.first_return.is_finite()) {
            let found = format!("{}, {}", self.return_scale, self.first_return);
            return Some(("return_scale, first_return", found, "a positive number and a finite one".into()));
        }
        // Checked before memory is allocated for a network that a damaged file only declares.
        let expected = e.parameters() + t.parameters();
        (numbers as f64 != expected).then(|| ("weights", format!("{numbers} numbers"), format!("{expected}")))
    }
}

/// Encoder and transformer of a policy.
#[derive(Module, Debug)]
struct Networks {
    encoder: ContextEncoder,
    transformer: DecisionTransformer,
}

/// One policy, ready to act.
#[derive(Clone, Debug)]
pub struct SequencePolicy {
    spec: SequenceSpec,
    networks: Networks,
}

/// A lane's memory of its episode.
#[derive(Clone, Debug)]
pub(crate) struct Recall {
    /// The last steps, up to max(K, h) of them; the newest is last.
    steps: VecDeque<Past>,
    /// Number of steps so far.
    time: usize,
    return_to_go: f64,
}

#[derive(Clone, Debug)]
struct Past {
    return_to_go: f32,
    state: Vec<f32>,
    context: Vec<f32>,
    action: Vec<f32>,
    reward: f32,
}

impl Recall {
    /// Replaces the newest step's action.
    #[cfg(test)]
    pub(crate) fn act(&mut self, action: &[f32]) {
        self.steps.back_mut().expect("a step").action.copy_from_slice(action);
    }

    /// Stores the reward of the newest step.
    pub(crate) fn reward(&mut self, reward: f64) {
        self.return_to_go -= reward;
        if let Some(step) = self.steps.back_mut() {
            step.reward = reward as f32;
        }
    }
}

impl SequencePolicy {
    /// A policy with the given weights, named `policy.encoder...` and `policy.transformer...`; `path` is for messages.
    ///
    /// # Errors
    /// If the specification contradicts itself or the weights do not fit it.
    pub fn new(spec: SequenceSpec, weights: &NamedParameters, path: &Path) -> Result<Self, LearnError> {
        let own = weights.tensors.iter().filter(|(name, _)| name.starts_with("policy."));
        if let Some((field, found, expected)) = spec.fault(own.map(|(_, (_, data))| data.len()).sum()) {
            let (path, field) = (path.to_owned(), field.to_owned());
            let remedy = "the file contradicts itself: write it anew".to_owned();
            return Err(LearnError::Policy { path, field, found, expected, remedy });
        }
        let (streams, device) = (Streams::new(0), cpu());
        let encoder = spec.encoder.init("policy", streams, &device);
        let blank = Networks { encoder, transformer: spec.transformer.init(streams, &device) };
        let networks = weights.apply(PREFIX, blank, path)?;
        Ok(Self { spec, networks })
    }

    /// The policy with these trained networks.
    pub(crate) fn of(spec: SequenceSpec, encoder: &ContextEncoder, transformer: &DecisionTransformer) -> Self {
        let mut weights = NamedParameters::default();
        weights.collect(&format!("{PREFIX}.encoder"), encoder);
        weights.collect(&format!("{PREFIX}.transformer"), transformer);
        Self::new(spec, &weights, Path::new("(in memory)")).expect("the networks were made from the specification")
    }

    /// The specification.
    pub fn spec(&self) -> &SequenceSpec {
        &self.spec
    }

    /// The same policy with another requested return.
    #[cfg(test)]
    pub(crate) fn asked(&mut self, first_return: f64) -> &Self {
        self.spec.first_return = first_return;
        self
    }

    pub(crate) fn from_parameters(parameters: &NamedParameters, path: &Path) -> Result<Self, LearnError> {
        let text = parameters.metadata.get(KEY).map_or("", String::as_str);
        let spec = serde_json::from_str(text).map_err(|e| LearnError::Policy {
            path: path.to_owned(),
            field: KEY.into(),
            found: e.to_string(),
            expected: "the specification of a policy with a memory".into(),
            remedy: "give a file written by `tce learn`".into(),
        })?;
        Self::new(spec, parameters, path)
    }

    pub(crate) fn to_parameters(&self) -> NamedParameters {
        let mut out = NamedParameters::default();
        out.collect(PREFIX, &self.networks);
        out.metadata.insert(KEY.into(), serde_json::to_string(&self.spec).expect("plain numbers"));
        out
    }

    /// The memory of a lane at the start of an episode.
    pub(crate) fn start(&self) -> Recall {
        Recall { steps: VecDeque::new(), time: 0, return_to_go: self.spec.first_return }
    }

    /// Fills `actions` `[rows, d_a]` for `observations` `[rows, d_s]` of lanes with these memories.
    pub(crate) fn act(&self, observations: &[f32], memories: &mut [&mut Recall], actions: &mut [f32]) {
        let spec = &self.spec;
        let rows = memories.len();
        assert_eq!((rows * spec.observations, rows * spec.actions), (observations.len(), actions.len()));
        if rows == 0 {
            return;
        }
        self.see(observations, memories);
        let out = host(self.networks.transformer.forward(self.recent(memories), &mut Dropout::none()));
        let per_row = spec.context * spec.actions;
        for ((memory, action), out) in
            memories.iter_mut().zip(actions.chunks_exact_mut(spec.actions)).zip(out.chunks_exact(per_row))
        {
            let newest = memory.steps.len().min(spec.context) - 1;
            action.copy_from_slice(&out[newest * spec.actions..][..spec.actions]);
            let step = memory.steps.back_mut().expect("the step that was just seen");
            step.action.copy_from_slice(action);
            memory.time += 1;
        }
    }

    /// Adds the observations to the memories, with their contexts.
    fn see(&self, observations: &[f32], memories: &mut [&mut Recall]) {
        let spec = &self.spec;
        let (rows, h, d, a) = (memories.len(), spec.encoder.horizon, spec.inputs.len(), spec.actions);
        // Steps before the start of the episode are zeros.
        let mut strip = [vec![0.0; rows * h * d], vec![0.0; rows * h * a], vec![0.0; rows * h]];
        for (row, memory) in memories.iter().enumerate() {
            let known = memory.steps.len().min(h);
            let steps = memory.steps.range(memory.steps.len() - known..);
            for (at, step) in (row * h + h - known..).zip(steps) {
                strip[0][at * d..][..d].copy_from_slice(&step.state);
                strip[1][at * a..][..a].copy_from_slice(&step.action);
                strip[2][at] = step.reward;
            }
        }
        let strip = strip.map(|v| {
            let width = v.len() / (rows * h);
            tensor(v, [rows, h, width], &cpu())
        });
        let contexts = host(self.networks.encoder.contexts(strip));
        let z = &spec.standardizer;
        let seen = observations.chunks_exact(spec.observations).zip(contexts.chunks_exact(spec.encoder.latent));
        for (memory, (row, context)) in memories.iter_mut().zip(seen) {
            let state = spec.inputs.iter().map(|&d| (row[d] - z.mean[d]) / z.std[d]).collect();
            memory.steps.push_back(Past {
                return_to_go: (memory.return_to_go / spec.return_scale) as f32,
                state,
                context: context.to_vec(),
                action: vec![0.0; a],
                reward: 0.0,
            });
            if memory.steps.len() > spec.context.max(h) {
                memory.steps.pop_front();
            }
        }
    }

    /// The last K steps of every memory, the oldest first; padded with zeros if there are fewer.
    fn recent(&self, memories: &[&mut Recall]) -> TransformerInput {
        let spec = &self.spec;
        let (rows, k) = (memories.len(), spec.context);
        let [mut returns, mut states, mut contexts, mut actions] =
            [1, spec.inputs.len(), spec.encoder.latent, spec.actions].map(|width| vec![0.0; rows * k * width]);
        let mut times = vec![0; rows * k];
        for (row, memory) in memories.iter().enumerate() {
            let known = memory.steps.len().min(k);
            let steps = memory.steps.range(memory.steps.len() - known..);
            for (i, (at, step)) in (row * k..).zip(steps).enumerate() {
                returns[at] = step.return_to_go;
                let into = |all: &mut [f32], values: &[f32]| {
                    all[at * values.len()..][..values.len()].copy_from_slice(values);
                };
                into(&mut states, &step.state);
                into(&mut contexts, &step.context);
                into(&mut actions, &step.action);
                times[at] = (memory.time + i + 1 - known).min(spec.transformer.timesteps - 1) as i32;
            }
        }
        let on_device = |v: Vec<f32>| {
            let width = v.len() / (rows * k);
            tensor(v, [rows, k, width], &cpu())
        };
        TransformerInput {
            returns: on_device(returns),
            states: on_device(states),
            contexts: on_device(contexts),
            actions: on_device(actions),
            times: Tensor::<2, Int>::from_data(TensorData::new(times, [rows, k]), &cpu()),
        }
    }
}
