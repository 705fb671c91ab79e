//! From data to policies: standardisation, the learner, its metrics, and the evaluation of every member.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_data::{Agent, ReferenceScores, Shift, Standardizer, Transitions};
use tce_learn::{
    Bc, Buffer, Iql, Member, Policy, PolicyLearner, Regulariser, RewardScale, Steps, best_trajectories,
    return_range_scale, train,
};
use tce_nn::Device;

use crate::actors::{Evaluation, evaluate};
use crate::config::{Algorithm, EvaluationConfig, LearnerConfig};
use crate::error::{Error, Result};
use crate::metrics::Metrics;
use crate::units::even_standardizer;

/// The data of one member: target rows, and perhaps others.
#[derive(Clone, Debug)]
pub struct MemberData {
    /// Seed of everything random of this member.
    pub seed: u64,
    /// Target rows.
    pub target: Arc<Transitions>,
    /// Source or generated rows.
    pub extra: Option<Arc<Transitions>>,
    /// Tables with real trajectories, whose returns the reward scale is taken from.
    pub trajectories: Vec<Arc<Transitions>>,
}

/// Where policies are judged, if they can be.
#[derive(Clone, Copy, Debug)]
pub struct Arena {
    /// The robot.
    pub agent: Agent,
    /// The domain.
    pub shift: Shift,
    /// Returns that stand for 0 and 100.
    pub reference: Option<ReferenceScores>,
}

/// What learning leaves behind besides the policies.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Learned {
    /// Evaluation of the last checkpoint, per member; empty without a simulator.
    pub evaluations: Vec<Evaluation>,
    /// Means of the learner's figures over its last report, per member.
    pub figures: BTreeMap<String, Vec<f64>>,
    /// Seconds of training.
    pub seconds: f64,
}

impl Learned {
    /// The normalised scores, per member.
    pub fn scores(&self) -> Vec<f64> {
        self.evaluations.iter().filter_map(|e| e.score).collect()
    }
}

/// Learns one policy per member. Members are trained together, in as many groups as there are threads: a member's policy
/// does not depend on its group, and groups scale where one training spread over cores does not (see `tce-nn`'s kernels).
pub fn learn(
    data: Vec<MemberData>,
    config: &LearnerConfig,
    evaluation: &EvaluationConfig,
    arena: Option<Arena>,
    metrics: &mut Metrics,
    device: &Device,
) -> Result<(Vec<Policy>, Learned)> {
    let started = std::time::Instant::now();
    let groups = rayon::current_num_threads().min(data.len()).max(1);
    let size = data.len().div_ceil(groups);
    let metrics = Mutex::new(metrics);
    let results: Vec<Result<(Vec<Policy>, Learned)>> = std::thread::scope(|scope| {
        let group = |(k, data): (usize, &[MemberData])| {
            let (data, metrics) = (data.to_vec(), &metrics);
            scope.spawn(move || learn_group(data, k * size, config, evaluation, arena, metrics, device))
        };
        let threads: Vec<_> = data.chunks(size).enumerate().map(group).collect();
        threads.into_iter().map(|t| t.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    });
    let (mut policies, mut learned) = (Vec::new(), Learned::default());
    for result in results {
        let (p, l) = result?;
        policies.extend(p);
        learned.evaluations.extend(l.evaluations);
        for (name, values) in l.figures {
            learned.figures.entry(name).or_default().extend(values);
        }
    }
    learned.seconds = started.elapsed().as_secs_f64();
    Ok((policies, learned))
}

/// Learns the policies of members `first..` of the whole population as one training.
fn learn_group(
    data: Vec<MemberData>,
    first: usize,
    config: &LearnerConfig,
    evaluation: &EvaluationConfig,
    arena: Option<Arena>,
    metrics: &Mutex<&mut Metrics>,
    device: &Device,
) -> Result<(Vec<Policy>, Learned)> {
    let members = data.iter().map(|d| member(d, config)).collect::<Result<Vec<_>>>()?;
    let seeds: Vec<_> = data.iter().map(|d| d.seed).collect();
    drop(data);
    let buffer = Buffer::new(members, config.batch)?;
    let mut learner: Box<dyn PolicyLearner> = match config.algorithm {
        Algorithm::Bc => Box::new(Bc::new(&buffer, &config.bc, config.steps, device)?),
        Algorithm::Iql => {
            let regulariser = Regulariser::prepare(config.iql.regulariser, &buffer, &config.behaviour, device)?;
            let regulariser = regulariser.ok_or(Error::Interrupted)?;
            Box::new(Iql::new(&buffer, &config.iql, regulariser, config.steps, device)?)
        }
    };
    let log = |stage: &str, step: u64, m: usize, values: Vec<(&str, f64)>| {
        metrics.lock().unwrap_or_else(PoisonError::into_inner).log(stage, step, first + m, values)
    };
    let report_every = (config.steps / 50).max(1);
    let mut learned = Learned::default();
    let mut judged = 0;
    let steps = Steps::new(config.steps, report_every);
    let label = format!("learn {} {seeds:?}", label(config.algorithm));
    let outcome = train(learner.as_mut(), &buffer, steps, &label, device, |report, learner| {
        for m in 0..seeds.len() {
            log("learn", report.step, m, report.metrics.iter().map(|(&name, v)| (name, v[m])).collect())?;
        }
        learned.figures = report.metrics.iter().map(|(&k, v)| (k.to_owned(), v.clone())).collect();
        let due = report.step.checked_div(evaluation.every).unwrap_or(0);
        if let (Some(arena), true, true) = (arena, due > judged, report.step < config.steps) {
            judged = due;
            for (m, e) in judge(&learner.policies(), &seeds, evaluation.episodes, arena)?.iter().enumerate() {
                log("evaluate", report.step, m, e.score.map(|s| ("score", s)).into_iter().collect())?;
            }
        }
        Ok::<_, Error>(())
    })?;
    if outcome.interrupted {
        return Err(Error::Interrupted);
    }
    let policies = learner.policies();
    if let Some(arena) = arena {
        learned.evaluations = judge(&policies, &seeds, evaluation.episodes, arena)?;
        for (m, e) in learned.evaluations.iter().enumerate() {
            log("evaluate", config.steps, m, e.score.map(|s| ("score", s)).into_iter().collect())?;
        }
    }
    Ok((policies, learned))
}

fn label(algorithm: Algorithm) -> &'static str {
    match algorithm {
        Algorithm::Bc => "bc",
        Algorithm::Iql => "iql",
    }
}

fn member(data: &MemberData, config: &LearnerConfig) -> Result<Member> {
    let target = match (config.algorithm, config.top) {
        (Algorithm::Bc, top) if top < 1.0 => Arc::new(best_trajectories(&data.target, top)?),
        _ => data.target.clone(),
    };
    let standardizer = match config.standardise {
        true => even_standardizer(&target, data.extra.as_deref()),
        false => Standardizer::identity(target.obs_dim),
    };
    let reward_scale = match config.iql.reward_scale {
        RewardScale::None => 1.0,
        RewardScale::ReturnRange => {
            let tables: Vec<_> = data.trajectories.iter().map(Arc::as_ref).collect();
            return_range_scale(&tables)?
        }
    };
    let parts = std::iter::once(target).chain(data.extra.clone()).collect();
    Ok(Member { streams: Streams::new(data.seed), parts, standardizer, reward_scale })
}

/// Evaluates every member's policy with the member's own streams.
fn judge(policies: &[Policy], seeds: &[u64], episodes: usize, arena: Arena) -> Result<Vec<Evaluation>> {
    policies
        .par_iter()
        .zip(seeds)
        .map(|(p, &seed)| evaluate(p, arena.agent, arena.shift, episodes, Streams::new(seed), true, arena.reference))
        .collect()
}
