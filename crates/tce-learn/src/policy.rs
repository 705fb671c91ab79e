//! Trained policies, apart from how they were trained: from what a lane has seen of its episode to its next action.
//!
//! | kind | made by | what it remembers of an episode |
//! |---|---|---|
//! | [`MlpPolicy`] | BC, IQL, SAC, other people's programs | nothing |
//! | [`SequencePolicy`] | Meta-DT | the last steps, and what is left of the return it was promised |
//!
//! Whoever rolls a policy out keeps one [`Memory`] per lane: made at an episode's start by [`Policy::start`], given to
//! [`Policy::act_with`] beside the observation, told the reward by [`Policy::reward`] after the step.

use std::path::Path;

use tce_base::Rng;
use tce_nn::NamedParameters;

use crate::error::LearnError;
use crate::mlp_policy::MlpPolicy;
use crate::sequence_policy::{self, Recall, SequencePolicy};

/// One policy, ready to act.
#[derive(Clone, Debug)]
pub enum Policy {
    /// From the observation alone.
    Mlp(Box<MlpPolicy>),
    /// From the last steps.
    Sequence(Box<SequencePolicy>),
}

/// What a lane remembers of its episode; empty, and without memory of the heap, for a policy that remembers nothing.
#[derive(Clone, Debug, Default)]
pub struct Memory(pub(crate) Option<Box<Recall>>);

impl Policy {
    /// Reads a policy: `.safetensors` (ours, of any kind) or `.npz` (plain arrays of other programs, see [`crate::import`]).
    ///
    /// # Errors
    /// If the file is missing, damaged, or not a policy.
    pub fn load(path: &Path) -> Result<Self, LearnError> {
        if path.extension().is_some_and(|e| e == "npz") {
            return crate::import::load_npz(path);
        }
        Self::from_parameters(&NamedParameters::load(path)?, path)
    }

    /// The policy of a file that was read before; `path` is for messages.
    ///
    /// # Errors
    /// If it is not a policy.
    pub fn from_parameters(parameters: &NamedParameters, path: &Path) -> Result<Self, LearnError> {
        match parameters.metadata.contains_key(sequence_policy::KEY) {
            true => SequencePolicy::from_parameters(parameters, path).map(|p| Self::Sequence(Box::new(p))),
            false => MlpPolicy::from_parameters(parameters, path).map(|p| Self::Mlp(Box::new(p))),
        }
    }

    /// The weights and, in the metadata, what kind of policy it is and its specification. Callers may add metadata of their own
    /// before saving.
    pub fn to_parameters(&self) -> NamedParameters {
        match self {
            Self::Mlp(policy) => policy.to_parameters(),
            Self::Sequence(policy) => policy.to_parameters(),
        }
    }

    /// Writes a safetensors file, whole or not at all.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), LearnError> {
        Ok(self.to_parameters().save(path)?)
    }

    /// The policy whose action is that of the mean output of `policies` ([`MlpPolicy::average`]); the first one where it is alone or
    /// remembers something.
    ///
    /// # Panics
    /// If there is none, or they differ in more than their weights.
    pub fn average(policies: &[&Self]) -> Self {
        let networks: Option<Vec<&MlpPolicy>> = policies.iter().map(|p| p.as_mlp()).collect();
        match networks {
            Some(networks) if networks.len() > 1 => Self::Mlp(Box::new(MlpPolicy::average(&networks))),
            _ => policies[0].clone(),
        }
    }

    fn as_mlp(&self) -> Option<&MlpPolicy> {
        match self {
            Self::Mlp(policy) => Some(policy),
            Self::Sequence(_) => None,
        }
    }

    /// Lengths of an observation and of an action.
    pub fn dims(&self) -> (usize, usize) {
        match self {
            Self::Mlp(policy) => (policy.spec().observations, policy.spec().actions),
            Self::Sequence(policy) => (policy.spec().observations, policy.spec().actions),
        }
    }

    /// The memory of a lane whose episode begins.
    pub fn start(&self) -> Memory {
        match self {
            Self::Mlp(_) => Memory::default(),
            Self::Sequence(policy) => Memory(Some(Box::new(policy.start()))),
        }
    }

    /// Fills `actions` `[rows, d_a]` for `observations` `[rows, d_s]`, both row-major, of lanes with these `memories`: mean
    /// actions, or, with one generator per row, sampled ones, of a kind of policy that is random. A row's result depends on
    /// that row, its memory and its generator only.
    ///
    /// # Panics
    /// If the lengths do not fit each other, or a memory is another policy's.
    pub fn act_with(
        &self,
        observations: &[f32],
        memories: &mut [Memory],
        rngs: Option<&mut [Rng]>,
        actions: &mut [f32],
    ) {
        match self {
            Self::Mlp(policy) => policy.act(observations, rngs, actions),
            Self::Sequence(policy) => {
                let recalls = memories.iter_mut().map(|m| m.0.as_deref_mut().expect("a memory of this policy"));
                policy.act(observations, &mut recalls.collect::<Vec<_>>(), actions);
            }
        }
    }

    /// [`Policy::act_with`] at the beginning of episodes; for a policy that remembers nothing, at any time.
    ///
    /// # Panics
    /// If the lengths do not fit each other.
    pub fn act(&self, observations: &[f32], rngs: Option<&mut [Rng]>, actions: &mut [f32]) {
        let mut memories = vec![self.start(); observations.len() / self.dims().0];
        self.act_with(observations, &mut memories, rngs, actions);
    }

    /// Tells a lane's memory the reward of the last action.
    pub fn reward(&self, memory: &mut Memory, reward: f64) {
        if let Some(recall) = &mut memory.0 {
            recall.reward(reward);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mlp_policy::{Head, KEY, PolicySpec, from_population};
    use tce_base::Streams;
    use tce_data::Standardizer;
    use tce_nn::{Activation, cpu};

    fn policy() -> Policy {
        let spec = PolicySpec {
            observations: 3,
            actions: 2,
            inputs: vec![0, 2],
            standardizer: Standardizer::identity(3),
            clip: Some(3.0),
            hidden: vec![64],
            activation: Activation::Relu,
            output_activation: Activation::Identity,
            head: Head::Gaussian { log_std: vec![-0.1, 1.0 / 3.0] },
        };
        let network = spec.network().init(&[Streams::new(5)], "policy", &cpu());
        from_population(vec![spec], &network).remove(0)
    }

    #[test]
    fn files_keep_every_bit() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("policy.safetensors");
        let saved = policy();
        saved.save(&path).unwrap();
        let loaded = Policy::load(&path).unwrap();
        assert_eq!(loaded.to_parameters(), saved.to_parameters());
        let (mut a, mut b) = (vec![0.0; 8], vec![0.0; 8]);
        let observations = [0.1, -0.2, 0.3, 1.0, -1.0, 0.5, 2.0, 0.0, -0.7, 4.0, 4.0, 4.0];
        saved.act(&observations, None, &mut a);
        loaded.act(&observations, None, &mut b);
        assert_eq!(a, b);
    }

    #[test]
    fn what_is_not_a_policy_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("policy.safetensors");
        NamedParameters::default().save(&path).unwrap();
        assert!(Policy::load(&path).unwrap_err().to_string().contains("a policy's specification"));
        let mut parameters = policy().to_parameters();
        let json = parameters.metadata[KEY].replace("\"inputs\":[0,2]", "\"inputs\":[0,3]");
        parameters.metadata.insert(KEY.into(), json);
        parameters.save(&path).unwrap();
        assert!(Policy::load(&path).unwrap_err().to_string().contains("dimensions below 3"));
    }

    #[test]
    fn policies_are_shared_between_threads() {
        fn sync<T: Send + Sync>() {}
        sync::<Policy>();
    }

    #[test]
    fn a_policy_that_remembers_nothing_has_a_memory_without_content() {
        let (policy, mut memory) = (policy(), Memory::default());
        policy.reward(&mut memory, 1.0);
        assert!(policy.start().0.is_none() && memory.0.is_none());
    }
}
