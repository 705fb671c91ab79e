//! Runs policies in the simulator: collects data sets with them and evaluates them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tce_base::scratch::Scratch;
use tce_base::{PROGRAM, Progress, Rng, Streams, move_into_place, sha256_file, sha256_hex};
use tce_data::{Agent, ReferenceScores, ScoreTable, Shift, Transitions, reference_scores, save_d4rl};
use tce_learn::{Memory, Policy};
use tce_sim::{Actor, CollectOptions, EpisodeResult, Recording};

use crate::error::{Error, Result};
use crate::exhibits::Exhibit;
use crate::recipes::Recipe;

/// Which actions of a stochastic policy are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Actions {
    /// The mean action.
    Mean,
    /// Sampled actions.
    Sampled,
}

impl Actions {
    /// `Mean` if `mean`, otherwise `Sampled`.
    pub fn mean_if(mean: bool) -> Self {
        if mean { Self::Mean } else { Self::Sampled }
    }
}

/// A policy as an actor for the simulator.
pub struct PolicyActor {
    policy: Policy,
    chosen: Actions,
}

impl PolicyActor {
    /// Acts with the mean action or with sampled ones.
    pub fn new(policy: Policy, chosen: Actions) -> Self {
        Self { policy, chosen }
    }
}

impl Actor for PolicyActor {
    type Memory = Memory;

    fn start(&self) -> Memory {
        self.policy.start()
    }

    fn act(&self, observations: &[f32], memories: &mut [Memory], rngs: &mut [Rng], actions: &mut [f32]) {
        self.policy.act_with(observations, memories, (self.chosen == Actions::Sampled).then_some(rngs), actions);
    }

    fn reward(&self, memory: &mut Memory, reward: f64) {
        self.policy.reward(memory, reward);
    }
}

/// Reads a policy from a file or from the zoo (`zoo:NAME`).
///
/// # Errors
/// If there is no such policy or its file is damaged.
pub fn read_policy(path: &Path) -> Result<Policy> {
    match Exhibit::at(path)? {
        Some(exhibit) => exhibit.policy(),
        None => Ok(Policy::load(path)?),
    }
}

/// [`read_policy`] for a policy that must fit `agent`.
///
/// # Errors
/// As [`read_policy`], and if the policy has other dimensions.
pub fn load_policy(path: &Path, agent: Agent) -> Result<Policy> {
    let policy = read_policy(path)?;
    let (found, expected) = (policy.dims(), agent.dims());
    if found != expected {
        return Err(Error::Failed(format!(
            "{}: a policy of {} observations and {} actions; {agent} has {} and {}. Choose a policy of this agent",
            path.display(),
            found.0,
            found.1,
            expected.0,
            expected.1
        )));
    }
    Ok(policy)
}

impl Recipe {
    /// Collects the rows by rolling out the actors.
    pub fn collect(&self) -> Result<Transitions> {
        let (obs_dim, act_dim) = self.agent.dims();
        let total: f64 = self.parts.iter().map(|p| p.weight).sum();
        if self.parts.is_empty() || self.parts.iter().any(|p| !(p.weight > 0.0 && p.weight.is_finite())) {
            return Err(Error::Usage("a mixture needs at least one actor, and positive weights".into()));
        }
        let policies: Vec<_> = self.parts.iter().map(|p| load_policy(&p.actor, self.agent)).collect::<Result<_>>()?;
        let label = format!("collect {}-{}", self.agent, self.shift);
        let progress = Progress::new(label, self.rows as u64, "rows");
        let mut out = Transitions::with_capacity(obs_dim, act_dim, self.rows);
        let mut before = 0.0;
        for (k, (part, policy)) in self.parts.iter().zip(policies).enumerate() {
            // Rounding of the running sum keeps the total exact.
            let from = (self.rows as f64 * before / total).round() as usize;
            before += part.weight;
            let to = (self.rows as f64 * before / total).round() as usize;
            let streams = Streams::new(self.seed.wrapping_add(k as u64 * 0x9e37_79b9_7f4a_7c15));
            let options = CollectOptions { rows: to - from, lanes: self.lanes, streams, progress: Some(&progress) };
            let actor = PolicyActor::new(policy, Actions::mean_if(self.mean));
            out.extend(&tce_sim::collect(self.agent, self.shift, &actor, &options)?);
        }
        progress.finish();
        Ok(out)
    }

    /// Attributes that are written to the file with the rows.
    pub fn attributes(&self) -> Result<BTreeMap<String, String>> {
        let mut attributes = BTreeMap::new();
        attributes.insert("recipe".to_owned(), serde_json::to_string(self).expect("plain data"));
        attributes.insert("agent".to_owned(), self.agent.to_string());
        attributes.insert("shift".to_owned(), self.shift.to_string());
        attributes.insert("program".to_owned(), PROGRAM.to_owned());
        for (k, part) in self.parts.iter().enumerate() {
            let hash = match Exhibit::at(&part.actor)? {
                Some(exhibit) => exhibit.sha256(),
                None => sha256_file(&part.actor)?,
            };
            attributes.insert(format!("actor_{k}_sha256"), hash);
        }
        Ok(attributes)
    }

    /// The file of this recipe in `directory`. If it does not exist, the rows are collected now.
    pub fn cached(&self, directory: &Path, name: &str) -> Result<PathBuf> {
        cached(directory, name, &self.attributes()?, || self.collect())
    }
}

/// The file in `directory` with the rows that `attributes` describe. If it does not exist, `make` produces the rows
/// now. The file name is `name` and the start of the hash of `attributes`.
pub fn cached(
    directory: &Path,
    name: &str,
    attributes: &BTreeMap<String, String>,
    make: impl FnOnce() -> Result<Transitions>,
) -> Result<PathBuf> {
    let key = sha256_hex(serde_json::to_string(attributes).expect("strings").as_bytes());
    let path = directory.join(format!("{name}-{}.hdf5", &key[..12]));
    Scratch::tidy(directory);
    if !path.exists() {
        let scratch = Scratch::new(directory)?;
        let own = scratch.file("rows.hdf5");
        save_d4rl(&own, &make()?, attributes, &[])?;
        move_into_place(&own, &path)?;
    }
    Ok(path)
}

/// The results of some episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Undiscounted return of every episode.
    pub returns: Vec<f64>,
    /// Steps of every episode.
    pub lengths: Vec<usize>,
    /// 100 (J - J_r) / (J_e - J_r) of the mean return J, if reference returns are known.
    pub score: Option<f64>,
    /// Why there are no episodes, if the evaluation failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failed: Option<String>,
    /// Episodes that ended because the physics became unstable: their last rewards mean nothing.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub unstable: usize,
}

fn is_zero(count: &usize) -> bool {
    *count == 0
}

impl Evaluation {
    fn of(results: &[EpisodeResult], reference: Option<ReferenceScores>) -> Self {
        let returns: Vec<f64> = results.iter().map(|r| r.episode_return).collect();
        let mean_return = returns.iter().sum::<f64>() / returns.len() as f64;
        let score = reference.map(|r| r.normalised_score(mean_return));
        let unstable = results.iter().filter(|r| r.unstable).count();
        Self { lengths: results.iter().map(|r| r.length).collect(), returns, score, failed: None, unstable }
    }

    /// The evaluation of a policy that cannot act, with the reason.
    pub fn failed(why: String) -> Self {
        Self { returns: Vec::new(), lengths: Vec::new(), score: None, failed: Some(why), unstable: 0 }
    }

    /// Mean length of the episodes.
    pub fn mean_length(&self) -> f64 {
        self.lengths.iter().sum::<usize>() as f64 / self.lengths.len() as f64
    }
}

/// Where policies are evaluated.
#[derive(Clone, Copy, Debug)]
pub struct Arena {
    /// The robot.
    pub agent: Agent,
    /// The domain.
    pub shift: Shift,
    /// Returns with scores 0 and 100.
    pub reference: Option<ReferenceScores>,
}

impl Arena {
    /// Uses the reference returns of `table`, if it has any.
    pub fn new(agent: Agent, shift: Shift, table: ScoreTable) -> Self {
        Self { agent, shift, reference: reference_scores(agent, shift, table) }
    }
}

/// Evaluates `policy` over `episodes` episodes with mean or sampled `actions`. Stops when `stop` returns true; pass
/// [`tce_base::interrupted`] to let the user stop it.
pub fn evaluate(
    policy: &Policy,
    arena: Arena,
    episodes: usize,
    streams: Streams,
    actions: Actions,
    stop: impl Fn() -> bool,
) -> Result<Evaluation> {
    let actor = PolicyActor::new(policy.clone(), actions);
    let results = tce_sim::evaluate(arena.agent, arena.shift, &actor, episodes, streams, stop)?;
    Ok(Evaluation::of(&results, arena.reference))
}

/// [`evaluate`] with a recording of the first episode.
pub fn evaluate_recorded(
    policy: &Policy,
    arena: Arena,
    episodes: usize,
    streams: Streams,
    actions: Actions,
    stop: impl Fn() -> bool,
) -> Result<(Evaluation, Recording)> {
    let actor = PolicyActor::new(policy.clone(), actions);
    let (results, recording) = tce_sim::evaluate_recorded(arena.agent, arena.shift, &actor, episodes, streams, stop)?;
    Ok((Evaluation::of(&results, arena.reference), recording))
}
