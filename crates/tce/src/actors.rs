//! Policies in the simulator: collecting data sets with them and scoring them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tce_base::{Progress, Rng, Streams, sha256_file, sha256_hex};
use tce_data::{Agent, Quality, ReferenceScores, Shift, Transitions, save_d4rl};
use tce_learn::Policy;
use tce_sim::{Actor, CollectOptions, EpisodeResult};

use crate::error::{Error, Result};

/// A policy as the simulator wants it.
pub struct PolicyActor {
    policy: Policy,
    mean: bool,
}

impl PolicyActor {
    /// Acts by the mean action, or by sampled ones.
    pub fn new(policy: Policy, mean: bool) -> Self {
        Self { policy, mean }
    }
}

impl Actor for PolicyActor {
    fn act(&self, observations: &[f32], rngs: &mut [Rng], actions: &mut [f32]) {
        self.policy.act(observations, (!self.mean).then_some(rngs), actions);
    }
}

/// Loads a policy and checks that it is one for `agent`.
pub fn load_policy(path: &Path, agent: Agent) -> Result<Policy> {
    let policy = Policy::load(path)?;
    let spec = policy.spec();
    let (found, expected) = ((spec.observations, spec.actions), agent.dims());
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

/// One actor's part in a data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Part {
    /// The policy's file.
    pub actor: PathBuf,
    /// Its share of the rows, relative to the other parts'.
    pub weight: f64,
}

/// How a data set is collected; equal recipes give equal bytes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Recipe {
    /// The robot.
    pub agent: Agent,
    /// The domain.
    pub shift: Shift,
    /// One after the other, as D4RL's medium-expert is medium, then expert.
    pub parts: Vec<Part>,
    /// Rows in all.
    pub rows: usize,
    /// Mean instead of sampled actions.
    pub mean: bool,
    /// Environments in lockstep.
    pub lanes: usize,
    /// The seed of everything random in it.
    pub seed: u64,
}

impl Recipe {
    /// Rolls the actors out.
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
            // Rounding the running sum keeps the total exact.
            let from = (self.rows as f64 * before / total).round() as usize;
            before += part.weight;
            let to = (self.rows as f64 * before / total).round() as usize;
            let streams = Streams::new(self.seed.wrapping_add(k as u64 * 0x9e37_79b9_7f4a_7c15));
            let options = CollectOptions { rows: to - from, lanes: self.lanes, streams, progress: Some(&progress) };
            let actor = PolicyActor::new(policy, self.mean);
            out.extend(&tce_sim::collect(self.agent, self.shift, &actor, &options)?);
        }
        progress.finish();
        Ok(out)
    }

    /// What goes into the file beside the rows.
    pub fn attributes(&self) -> Result<BTreeMap<String, String>> {
        let mut attributes = BTreeMap::new();
        attributes.insert("recipe".to_owned(), serde_json::to_string(self).expect("plain data"));
        attributes.insert("agent".to_owned(), self.agent.to_string());
        attributes.insert("shift".to_owned(), self.shift.to_string());
        attributes.insert("program".to_owned(), format!("tce {}", env!("CARGO_PKG_VERSION")));
        for (k, part) in self.parts.iter().enumerate() {
            attributes.insert(format!("actor_{k}_sha256"), sha256_file(&part.actor)?);
        }
        Ok(attributes)
    }

    /// The file of this recipe in `directory`, collected now unless it is there.
    pub fn cached(&self, directory: &Path, name: &str) -> Result<PathBuf> {
        let attributes = self.attributes()?;
        let key = sha256_hex(serde_json::to_string(&attributes).expect("strings").as_bytes());
        let path = directory.join(format!("{name}-{}.hdf5", &key[..12]));
        if !path.exists() {
            save_d4rl(&path, &self.collect()?, &attributes, &[])?;
        }
        Ok(path)
    }
}

/// Rows of D4RL's data sets, and the stand-in actors under `shared/policies` that come closest to their behaviour: until
/// the project has actors of its own. Weights are calibrated so that mean returns are within 10 % of D4RL's.
pub fn stand_in(agent: Agent, quality: Quality, rows: usize, seed: u64, shared: &Path) -> Result<Recipe> {
    use Agent::*;
    let medium: &[(&str, f64)] = match agent {
        HalfCheetah => &[("yth_sac_halfcheetah_seed1_B_20201001_0803_e9a4951", 1.0)],
        Hopper => &[("zoo_sac_hopper_final", 0.7), ("yth_sac_hopper_seed4_C_20201001_0828_6ebb228", 0.3)],
        Walker2d => &[("yth_sac_walker2d_seed4_D_20201002_0053_baba2dc", 0.56), ("zoo_tqc_walker2d_final", 0.44)],
        Ant => &[("yth_sac_ant_seed0_A_20201001_0516_32b71a2", 1.0)],
    };
    let expert: &[(&str, f64)] = match agent {
        HalfCheetah => &[("yth_sac_halfcheetah_seed3_D_20201002_0053_baba2dc", 1.0)],
        Hopper => &[("yth_sac_hopper_seed2_D_20201002_0053_baba2dc", 1.0)],
        Walker2d => &[("yth_sac_walker2d_seed5_D_20201002_0053_baba2dc", 1.0)],
        Ant => &[("yth_sac_ant_seed5_D_20201002_0053_baba2dc", 1.0)],
    };
    // Early stages of training, then the medium actor: the shape of a replay buffer.
    let replay: &[(&str, f64)] = match agent {
        HalfCheetah => &[
            ("yth_sac_halfcheetah_seed5_B_20201001_0803_e9a4951", 0.15),
            ("yth_sac_halfcheetah_seed3_B_20201001_0803_e9a4951", 0.2),
            ("yth_sac_halfcheetah_seed4_B_20201001_0803_e9a4951", 0.3),
            ("yth_sac_halfcheetah_seed1_B_20201001_0803_e9a4951", 0.35),
        ],
        Hopper => &[
            ("yth_sac_hopper_seed1_B_20201001_0803_e9a4951", 0.25),
            ("yth_sac_hopper_seed3_C_20201001_0828_6ebb228", 0.25),
            ("yth_sac_hopper_seed2_C_20201001_0828_6ebb228", 0.25),
            ("yth_sac_hopper_seed4_C_20201001_0828_6ebb228", 0.25),
        ],
        Walker2d => &[
            ("yth_sac_walker2d_seed1_B_20201001_0803_e9a4951", 0.15),
            ("yth_sac_walker2d_seed4_C_20201001_0828_6ebb228", 0.15),
            ("yth_sac_walker2d_seed3_C_20201001_0828_6ebb228", 0.15),
            ("yth_sac_walker2d_seed1_C_20201001_0828_6ebb228", 0.25),
            ("yth_sac_walker2d_seed4_D_20201002_0053_baba2dc", 0.3),
        ],
        Ant => &[
            ("yth_sac_ant_seed1_B_20201001_0803_e9a4951", 0.3),
            ("yth_sac_ant_seed1_C_20201001_0828_6ebb228", 0.4),
            ("yth_sac_ant_seed0_A_20201001_0516_32b71a2", 0.3),
        ],
    };
    let (parts, rows) = match quality {
        Quality::Medium => (medium.to_vec(), rows),
        Quality::Expert => (expert.to_vec(), rows),
        Quality::MediumExpert => {
            let share = |actors: &[(&'static str, f64)]| actors.to_vec();
            let mut parts = share(medium);
            parts.extend(share(expert));
            (parts, 2 * rows)
        }
        Quality::MediumReplay => {
            // D4RL's buffers hold 202k, 402k, 302k and 302k rows beside 1M of medium.
            let share = match agent {
                HalfCheetah => 0.202,
                Hopper => 0.402,
                Walker2d | Ant => 0.302,
            };
            (replay.to_vec(), (rows as f64 * share) as usize)
        }
    };
    let parts = parts
        .into_iter()
        .map(|(name, weight)| {
            let actor = shared.join(format!("policies/{name}.npz"));
            if actor.exists() {
                Ok(Part { actor, weight })
            } else {
                Err(Error::missing(
                    &actor,
                    "this stand-in actor is not there; set TCE_SHARED to the folder that holds policies/, or give \
                     source data with --source",
                ))
            }
        })
        .collect::<Result<_>>()?;
    Ok(Recipe { agent, shift: Shift::Source, parts, rows, mean: false, lanes: 32, seed })
}

/// The folder with stand-in actors and the public target sets: `TCE_SHARED`, by default `../shared`.
pub fn shared_folder() -> PathBuf {
    std::env::var_os("TCE_SHARED").map_or_else(|| PathBuf::from("../shared"), PathBuf::from)
}

/// Returns of some episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Undiscounted return of every episode.
    pub returns: Vec<f64>,
    /// Steps of every episode.
    pub lengths: Vec<usize>,
    /// 100 (J - J_r) / (J_e - J_r) of the mean return, where references are known.
    pub score: Option<f64>,
}

/// Rolls `policy` out for `episodes` episodes by its mean action.
pub fn evaluate(
    policy: &Policy,
    agent: Agent,
    shift: Shift,
    episodes: usize,
    streams: Streams,
    mean: bool,
    reference: Option<ReferenceScores>,
) -> Result<Evaluation> {
    let actor = PolicyActor::new(policy.clone(), mean);
    let results: Vec<EpisodeResult> = tce_sim::evaluate(agent, shift, &actor, episodes, streams)?;
    let returns: Vec<f64> = results.iter().map(|r| r.episode_return).collect();
    let mean_return = returns.iter().sum::<f64>() / returns.len() as f64;
    Ok(Evaluation {
        lengths: results.iter().map(|r| r.length).collect(),
        returns,
        score: reference.map(|r| r.normalised_score(mean_return)),
    })
}
