//! Trained policies, independent of their training: they map what a lane has seen of its episode to its next action.
//!
//! | kind | made by | memory of an episode |
//! |---|---|---|
//! | [`MlpPolicy`] | BC, IQL, SAC, other programs | none |
//! | [`SequencePolicy`] | Meta-DT | the last steps, and the rest of the requested return |
//!
//! Code that rolls out a policy keeps one [`Memory`] per lane. [`Policy::start`] creates it at the start of an episode,
//! [`Policy::act_with`] takes it together with the observation, and [`Policy::reward`] adds the reward after the step.

use std::io::{self, Read};
use std::path::Path;

use tce_base::{FileError, Rng, file_inside};
use tce_data::ActionRange;
use tce_nn::NamedParameters;

use crate::error::LearnError;
use crate::import::load_npz;
use crate::mlp_policy::MlpPolicy;
use crate::sequence_policy::{self, Recall, SequencePolicy};
use crate::training::Learner;

/// Key of the action range in a policy file's metadata.
const RANGE: &str = "action_range";

/// One policy, ready to act.
#[derive(Clone, Debug)]
pub struct Policy {
    kind: PolicyKind,
    /// The range in the user's units, if it is not the box [-1, 1].
    range: Option<ActionRange>,
}

/// How a policy chooses its actions.
#[derive(Clone, Debug)]
pub enum PolicyKind {
    /// From the observation alone.
    Mlp(Box<MlpPolicy>),
    /// From the last steps of the episode.
    Sequence(Box<SequencePolicy>),
}

impl From<MlpPolicy> for Policy {
    fn from(policy: MlpPolicy) -> Self {
        Self { kind: PolicyKind::Mlp(Box::new(policy)), range: None }
    }
}

impl From<SequencePolicy> for Policy {
    fn from(policy: SequencePolicy) -> Self {
        Self { kind: PolicyKind::Sequence(Box::new(policy)), range: None }
    }
}

/// A lane's memory of its episode. It is empty and allocates nothing for a policy without a memory.
#[derive(Clone, Debug, Default)]
pub struct Memory(pub(crate) Option<Box<Recall>>);

impl Policy {
    /// Reads a policy: `.safetensors` (written by this program, any kind) or `.npz` (plain arrays of other programs,
    /// see [`crate::import`]).
    ///
    /// # Errors
    /// If the file is missing, damaged, or not a policy.
    pub fn load(path: &Path) -> Result<Self, LearnError> {
        if path.is_dir() {
            let inside = file_inside(path, |p| p.extension().is_some_and(|e| e == "safetensors" || e == "npz"));
            let words = format!("it is a folder, not a file{inside}");
            return Err(FileError::new(path, "read", io::Error::new(io::ErrorKind::IsADirectory, words)).into());
        }
        if path.extension().is_some_and(|e| e == "npz") {
            return load_npz(path).map(Self::from);
        }
        if let Some(found) = other_format(path) {
            return Err(LearnError::Policy {
                path: path.to_owned(),
                field: "file".into(),
                found: found.into(),
                expected: "a policy: .safetensors as `tce learn` writes it, or .npz of plain arrays".into(),
                remedy: "for another program's network, write its weights with numpy.savez under the names in the documentation of tce_learn::import".into(),
            });
        }
        Self::from_parameters(&NamedParameters::load(path)?, path)
    }

    /// The policy in the parameters of a file; `path` is for messages.
    ///
    /// # Errors
    /// If the parameters are not a policy.
    pub fn from_parameters(parameters: &NamedParameters, path: &Path) -> Result<Self, LearnError> {
        let policy: Self = match parameters.metadata.contains_key(sequence_policy::KEY) {
            true => SequencePolicy::from_parameters(parameters, path)?.into(),
            false => MlpPolicy::from_parameters(parameters, path)?.into(),
        };
        let Some(text) = parameters.metadata.get(RANGE) else { return Ok(policy) };
        let range = serde_json::from_str::<ActionRange>(text).ok().filter(|r| r.fits(policy.dims().1));
        let range = range.ok_or_else(|| LearnError::Policy {
            path: path.to_owned(),
            field: RANGE.into(),
            found: text.chars().take(200).collect(),
            expected: format!("`low` and `high` of {} actions, each low below its high", policy.dims().1),
            remedy: "the file contradicts itself: write it anew".into(),
        })?;
        Ok(policy.in_units(Some(range)))
    }

    /// The same policy with actions in the user's units: the actions -1 and 1 become `low` and `high`.
    pub fn in_units(self, range: Option<ActionRange>) -> Self {
        Self { range, ..self }
    }

    /// The range in the user's units; `None`: the box [-1, 1].
    pub fn action_range(&self) -> Option<&ActionRange> {
        self.range.as_ref()
    }

    /// How the policy chooses its actions.
    pub fn kind(&self) -> &PolicyKind {
        &self.kind
    }

    /// [`Self::kind`], mutable.
    #[cfg(test)]
    pub(crate) fn kind_mut(&mut self) -> &mut PolicyKind {
        &mut self.kind
    }

    /// The weights, with the kind of policy and its specification in the metadata. Callers may add their own metadata
    /// before saving.
    pub fn to_parameters(&self) -> NamedParameters {
        let mut out = match &self.kind {
            PolicyKind::Mlp(policy) => policy.to_parameters(),
            PolicyKind::Sequence(policy) => policy.to_parameters(),
        };
        if let Some(range) = &self.range {
            out.metadata.insert(RANGE.into(), serde_json::to_string(range).expect("plain numbers"));
        }
        out
    }

    /// Writes a safetensors file; it is complete or absent.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), LearnError> {
        Ok(self.to_parameters().save(path)?)
    }

    /// The policy that acts by the mean output of `policies` ([`MlpPolicy::average`]); the first policy if it is the
    /// only one or has a memory.
    ///
    /// # Panics
    /// If `policies` is empty, or they differ in more than their weights.
    pub fn average(policies: &[&Self]) -> Self {
        let networks: Option<Vec<&MlpPolicy>> = policies.iter().map(|p| p.as_mlp()).collect();
        match networks {
            Some(networks) if networks.len() > 1 => {
                Self::from(MlpPolicy::average(&networks)).in_units(policies[0].range.clone())
            }
            _ => policies[0].clone(),
        }
    }

    fn as_mlp(&self) -> Option<&MlpPolicy> {
        match &self.kind {
            PolicyKind::Mlp(policy) => Some(policy),
            PolicyKind::Sequence(_) => None,
        }
    }

    /// The lengths of an observation and of an action.
    pub fn dims(&self) -> (usize, usize) {
        match &self.kind {
            PolicyKind::Mlp(policy) => (policy.spec().observations, policy.spec().actions),
            PolicyKind::Sequence(policy) => (policy.spec().observations, policy.spec().actions),
        }
    }

    /// The memory of a lane at the start of an episode.
    pub fn start(&self) -> Memory {
        match &self.kind {
            PolicyKind::Mlp(_) => Memory::default(),
            PolicyKind::Sequence(policy) => Memory(Some(Box::new(policy.start()))),
        }
    }

    /// Fills `actions` `[rows, d_a]` for `observations` `[rows, d_s]`, both row-major, of lanes with these `memories`:
    /// with mean actions, or with sampled ones if there is one generator per row and the policy is random. The result
    /// of a row depends only on that row, its memory and its generator.
    ///
    /// # Panics
    /// If the lengths do not match, or a memory belongs to another policy.
    pub fn act_with(
        &self,
        observations: &[f32],
        memories: &mut [Memory],
        rngs: Option<&mut [Rng]>,
        actions: &mut [f32],
    ) {
        match &self.kind {
            PolicyKind::Mlp(policy) => policy.act(observations, rngs, actions),
            PolicyKind::Sequence(policy) => {
                // The actions in the memory are those of the box [-1, 1].
                let recalls = memories.iter_mut().map(|m| m.0.as_deref_mut().expect("a memory of this policy"));
                policy.act(observations, &mut recalls.collect::<Vec<_>>(), actions);
            }
        }
        if let Some(range) = &self.range {
            range.to_own(actions);
        }
    }

    /// [`Policy::act_with`] at the start of episodes; for a policy without a memory, at any time.
    ///
    /// # Panics
    /// If the lengths do not match.
    pub fn act(&self, observations: &[f32], rngs: Option<&mut [Rng]>, actions: &mut [f32]) {
        let mut memories = vec![self.start(); observations.len() / self.dims().0];
        self.act_with(observations, &mut memories, rngs, actions);
    }

    /// Adds the reward of the last action to a lane's memory.
    pub fn reward(&self, memory: &mut Memory, reward: f64) {
        if let Some(recall) = &mut memory.0 {
            recall.reward(reward);
        }
    }
}

/// The format of a file that starts like another format; `None` if it may be safetensors or cannot be read.
fn other_format(path: &Path) -> Option<&'static str> {
    let mut start = Vec::new();
    std::fs::File::open(path).ok()?.take(10).read_to_end(&mut start).ok()?;
    match start.as_slice() {
        [b'P', b'K', 3, 4, ..] => Some("a zip archive, such as a PyTorch checkpoint (.pt), or an .npz of another name"),
        // Pickle protocols 2 to 5; a safetensors length has six zero bytes after the first two.
        [0x80, 2..=5, rest @ ..] if rest.get(..6) != Some(&[0; 6]) => {
            Some("a Python pickle, such as an old PyTorch checkpoint")
        }
        [0x89, b'H', b'D', b'F', ..] => Some("an HDF5 file: a data set, or Keras weights"),
        [0x93, b'N', b'U', b'M', b'P', b'Y', ..] => Some("a single NumPy array (.npy)"),
        _ => None,
    }
}

/// A learner whose result is one policy per member.
pub trait PolicyLearner: Learner {
    /// The current policies, in the order of the members.
    fn policies(&self) -> Vec<Policy>;
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
            log_std_range: None,
        };
        let network = spec.network().init(&[Streams::new(5)], "policy", &cpu());
        from_population(vec![spec], &network).remove(0).into()
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
    fn actions_are_in_the_users_units() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("policy.safetensors");
        let range = ActionRange { low: vec![-20.0, 0.0], high: vec![20.0, 10.0] };
        policy().in_units(Some(range.clone())).save(&path).unwrap();
        let loaded = Policy::load(&path).unwrap();
        assert_eq!(loaded.action_range(), Some(&range));
        let (mut unit, mut own) = (vec![0.0; 2], vec![0.0; 2]);
        policy().act(&[0.1, -0.2, 0.3], None, &mut unit);
        loaded.act(&[0.1, -0.2, 0.3], None, &mut own);
        assert_eq!(own, [20.0 * unit[0], 5.0 * (unit[1] + 1.0)]);
        let mut parameters = loaded.to_parameters();
        parameters.metadata.insert(RANGE.into(), "{\"low\":[1,1],\"high\":[1,2]}".into());
        let error = Policy::from_parameters(&parameters, &path).unwrap_err().to_string();
        assert!(error.contains("action_range") && error.contains("each low below its high"), "{error}");
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
    fn files_of_other_programs_are_told_what_they_are() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("model.pt");
        for (start, what) in [
            (&b"PK\x03\x04rest of an archive"[..], "PyTorch checkpoint"),
            (b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j", "Python pickle"),
            (b"\x89HDF\r\n\x1a\n....", "an HDF5 file"),
            (b"\x93NUMPY\x01\x00", "a single NumPy array"),
        ] {
            std::fs::write(&path, start).unwrap();
            let error = Policy::load(&path).unwrap_err().to_string();
            assert!(error.contains(what) && error.contains("expected a policy"), "{error}");
        }
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
