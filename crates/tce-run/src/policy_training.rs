//! From data to policies: standardisation, the learner, its metrics, and the evaluation of every member.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_base::metrics::{Line, Metrics};
use tce_base::{Streams, interrupted};
use tce_data::{Standardizer, Transitions, even_standardizer};
use tce_learn::{
    Buffer, Journal, LearnedRows, Member, Place, Policy, PolicyLearner, Report, RewardScale, Steps, TrainingJob,
    best_trajectories, return_range_scale, train_side_by_side,
};
use tce_nn::{Checkpoints, Device, is_cpu};
use tce_sim::SimError;
use tce_zoo::actors::{Actions, Arena, Evaluation, evaluate};

use crate::clock::{self, Clock};
use crate::config::{Algorithm, EvaluationConfig, LearnerConfig};
use crate::device_kind::DeviceKind;
use crate::error::{Error, Result};
use crate::inputs::Inputs;
use crate::methods::build;

/// The data of one member: target rows, and perhaps others.
#[derive(Clone, Debug)]
pub struct MemberData {
    /// Seed of everything random of this member.
    pub seed: u64,
    /// Target rows.
    pub target: Arc<Transitions>,
    /// Source or generated rows.
    pub extra: Option<Arc<Transitions>>,
    /// One number per row of `extra` whose s' is known, for algorithms that weigh or filter these rows.
    pub row_scores: Option<Arc<Vec<f32>>>,
    /// Tables with real trajectories, whose returns the reward scale is taken from.
    pub trajectories: Vec<Arc<Transitions>>,
}

/// The name of the file of the policy of a seed.
pub fn policy_file(seed: u64) -> String {
    format!("policy-seed{seed}.safetensors")
}

/// Writes the policies of `seeds` into `directory`, with actions in the units of `inputs`; returns the files.
pub fn save_policies(policies: &[Policy], seeds: &[u64], directory: &Path, inputs: &Inputs) -> Result<Vec<PathBuf>> {
    let save = |(policy, seed): (&Policy, &u64)| {
        let file = directory.join(policy_file(*seed));
        policy.clone().in_units(inputs.actions.clone()).save(&file)?;
        Ok(file)
    };
    policies.iter().zip(seeds).map(save).collect()
}

/// The results of a training besides the policies.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Learned {
    /// Evaluation of the last checkpoint, per member; empty without a simulator.
    pub evaluations: Vec<Evaluation>,
    /// Means of the learner's metrics over its last report, per member; None is a number that is not finite.
    #[serde(alias = "figures")]
    pub metrics: BTreeMap<String, Vec<Option<f64>>>,
    /// Seconds of training and evaluation. Interrupted attempts count up to their last checkpoint.
    pub seconds: f64,
    /// The device that computed it.
    #[serde(default)]
    pub device: DeviceKind,
}

impl Learned {
    /// The normalised scores, per member; None where a policy could not be evaluated.
    pub fn scores(&self) -> Vec<Option<f64>> {
        self.evaluations.iter().map(|e| e.score).collect()
    }
}

/// What a finished training needs until its results are on disk.
#[must_use]
pub struct Leftovers<'a> {
    checkpoints: Checkpoints,
    clock: Clock,
    place: Place<'a>,
}

impl Leftovers<'_> {
    /// Removes the checkpoints. Call it when the results are on disk: an interruption before that costs no training.
    pub fn discard(self) {
        self.checkpoints.remove();
        self.clock.forget();
        self.place.discard_preparations();
    }
}

/// Learns one policy per member. On the CPU members are trained side by side, elsewhere as one population: a member's
/// policy is the same, up to the rounding of the device. Metrics and checkpoints are kept in a directory, beside a cache key: the hash of all inputs. `keep` gets the policies before they are evaluated, so that what hours of training gave is on disk
/// whatever happens then.
pub fn learn<'a>(
    data: Vec<MemberData>,
    config: &LearnerConfig,
    evaluation: &EvaluationConfig,
    arena: Option<Arena>,
    (directory, key): (&'a Path, &'a str),
    device: &Device,
    keep: impl FnOnce(&[Policy]) -> Result<()>,
) -> Result<(Learned, Leftovers<'a>)> {
    let clock = Clock::start(directory.join(format!("learner.{}", clock::SUFFIX)));
    let rows = LearnedRows::with(data.iter().find_map(|d| d.extra.as_ref()));
    let config = &LearnerConfig { steps: config.steps(rows), ..config.clone() };
    let journal = Journal::default();
    let place = Place { directory: Some(directory), key, job: 0, journal: Some(&journal) };
    let seeds: Vec<_> = data.iter().map(|d| d.seed).collect();
    let size = if is_cpu(device) { 1 } else { data.len().max(1) };
    let start = |(job_number, data)| job(data, config, Place { job: job_number, ..place }, device);
    let jobs = data.par_chunks(size).enumerate().map(start).collect::<Result<Vec<_>>>()?;
    drop(data);
    let (buffers, mut learners): (Vec<_>, Vec<_>) = jobs.into_iter().unzip();
    let mut jobs: Vec<_> =
        learners.iter_mut().zip(&buffers).map(|(l, buffer)| TrainingJob { learner: l.as_mut(), buffer }).collect();
    let updates = config.steps;
    let steps = Steps::new(updates, (updates / 50).max(1));
    let label = format!("learn {} {seeds:?}", config.algorithm.about().name);
    let mut learned = Learned { device: device.into(), ..Learned::default() };
    let due = |step: u64| step < updates && step.checked_div(evaluation.every).is_some_and(|k| k > 0);
    let mut checkpoints = place.checkpoints("learner")?;
    let from = checkpoints.step().unwrap_or(0);
    // Metrics of preparations are written again at every start.
    let before = journal.take();
    let before = before.iter().flat_map(|(job, training, report)| lines(training, report, job * size)).collect();
    let metrics = &mut Metrics::resume_behind(directory, before, |stage, at| {
        at <= from && ["learn", "evaluate"].contains(&stage)
    })?;
    // The last evaluation came with the last report.
    let number = |step: u64| step.checked_div(evaluation.every).unwrap_or(0);
    let mut evaluated = vec![number(from - from % steps.report_every); jobs.len()];
    let outcome = train_side_by_side(&mut jobs, steps, &label, &mut checkpoints, device, |k, report, learner| {
        for line in lines("learn", report, k * size) {
            metrics.write(&line)?;
        }
        for (name, values) in &report.metrics {
            let means = learned.metrics.entry(name.clone()).or_insert_with(|| vec![None; seeds.len()]);
            for (mean, value) in means[k * size..].iter_mut().zip(values) {
                *mean = value.is_finite().then_some(*value);
            }
        }
        let number = number(report.step);
        if let (Some(arena), true) = (arena, due(report.step) && number > evaluated[k]) {
            evaluated[k] = number;
            let evaluations = evaluate_all(&learner.policies(), &seeds[k * size..], evaluation.episodes, arena)?;
            for (m, e) in evaluations.iter().enumerate() {
                metrics.log("evaluate", report.step, k * size + m, e.score.map(|s| ("score", s)))?;
            }
        }
        Ok::<_, Error>(())
    })?;
    if outcome.interrupted {
        return Err(Error::interrupted());
    }
    let policies: Vec<Policy> = learners.iter().flat_map(|l| l.policies()).collect();
    keep(&policies)?;
    if let Some(arena) = arena {
        learned.evaluations = evaluate_all(&policies, &seeds, evaluation.episodes, arena)?;
        for (m, e) in learned.evaluations.iter().enumerate() {
            metrics.log("evaluate", updates, m, e.score.map(|s| ("score", s)))?;
        }
    }
    learned.seconds = clock.seconds();
    // Its metrics are written.
    let place = Place { directory: Some(directory), key, job: 0, journal: None };
    Ok((learned, Leftovers { checkpoints, clock, place }))
}

/// A report of `stage` on members `first` and following.
fn lines<'a>(stage: &'a str, report: &'a Report, first: usize) -> impl Iterator<Item = Line> + use<'a> {
    let members = report.metrics.values().map(Vec::len).max().unwrap_or(0);
    let values = move |m| report.metrics.iter().map(move |(name, v): (&String, &Vec<f64>)| (name.as_str(), v[m]));
    (0..members).map(move |m| Line::new(stage, report.step, first + m, values(m)))
}

/// The members of `data` as one training, before its first step.
fn job(
    data: &[MemberData],
    config: &LearnerConfig,
    place: Place<'_>,
    device: &Device,
) -> Result<(Buffer, Box<dyn PolicyLearner>)> {
    let members = data.iter().map(|d| member(d, config)).collect::<Result<Vec<_>>>()?;
    let buffer = Buffer::new(members, config.batch())?.fading(config.fade());
    let learner = build(&buffer, config, place, device)?;
    Ok((buffer, learner))
}

fn member(data: &MemberData, config: &LearnerConfig) -> Result<Member> {
    let target = match (config.algorithm, config.top) {
        (Algorithm::Bc, top) if top < 1.0 => Arc::new(best_trajectories(&data.target, top)?),
        _ => data.target.clone(),
    };
    let others = data.extra.as_deref().filter(|_| !config.scales_by_target());
    let standardizer = match config.standardise {
        true => even_standardizer(&target, others),
        false => Standardizer::identity(target.obs_dim),
    };
    let reward_scale = match config.backbone().map_or(RewardScale::None, |iql| iql.reward_scale) {
        RewardScale::None => 1.0,
        RewardScale::ReturnRange => {
            let tables: Vec<_> = data.trajectories.iter().map(Arc::as_ref).collect();
            return_range_scale(&tables)?
        }
    };
    let parts = std::iter::once(target).chain(data.extra.clone()).collect();
    Ok(Member {
        streams: Streams::new(data.seed),
        parts,
        standardizer,
        reward_scale,
        row_scores: data.row_scores.clone(),
    })
}

/// Evaluates every member's policy with the member's own streams.
fn evaluate_all(policies: &[Policy], seeds: &[u64], episodes: usize, arena: Arena) -> Result<Vec<Evaluation>> {
    policies
        .par_iter()
        .zip(seeds)
        .map(|(p, &seed)| {
            match evaluate(p, arena, episodes, Streams::new(seed), Actions::Mean, interrupted) {
                // If one member has diverged, the others keep their results.
                Err(tce_zoo::Error::Sim(e @ SimError::NotFinite { .. })) => {
                    tce_base::note!("seed {seed}: {e}; it has no score");
                    Ok(Evaluation::failed(e.to_string()))
                }
                evaluations => Ok(evaluations?),
            }
        })
        .collect()
}
