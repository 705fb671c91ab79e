//! A training run on a user's own tables: policies, a baseline beside them, and which one is recommended, in one directory.
//!
//! | file | content |
//! |---|---|
//! | `policy-seedN.safetensors` | the policies, one per seed |
//! | `policy.safetensors` | the recommended one |
//! | `verdict.json` | why it is recommended |
//! | `baseline/` | the clones of the target rows, where the policies learned from more than those |
//! | `metrics.jsonl`, `config.toml`, `spec.json`, `summary.json` | metrics, settings, inputs of the key, results |
//! | `learned.json` | that a training came to its end, here and in `baseline/` |
//!
//! A second call with the same directory returns the finished run, or does what is missing: finished trainings are not done again, others
//! go on from their checkpoints. Paths in files are relative to the directory, which can be moved.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tce_base::{first_damaged, read_if_there, read_json, sha256_files, sha256_hex, write_json};
use tce_data::ScoreTable;
use tce_learn::{LearnedRows, OtherRows};
use tce_nn::Device;
use tce_zoo::actors::Arena;

use crate::config::{Algorithm, Config, LearnerConfig};
use crate::course::{Course, training_step};
use crate::device_kind::DeviceKind;
use crate::error::{Error, Result};
use crate::inputs::{Inputs, Table};
use crate::methods::row_scores;
use crate::off_policy_evaluation::OffPolicyEvaluator;
use crate::own::Own;
use crate::policy_training::{Learned, MemberData, learn, policy_file, save_policies};
use crate::verdict::{Candidate, Kept, keep, only, recommend};

/// The name of the baseline: clones of the target rows alone.
const BASELINE: &str = "cloning the target rows";

/// Whether the policies are compared, with each other and with a baseline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Comparison {
    /// Learn a baseline from the target rows alone, try all policies in learned dynamics, and recommend one.
    Recommend,
    /// Only train the policies.
    Skip,
}

/// The inputs of a training run besides its tables.
#[derive(Clone, Debug)]
pub struct TrainingRun<'a> {
    /// The settings.
    pub config: &'a Config,
    /// One policy is trained for each seed.
    pub seeds: &'a [u64],
    /// What the user said of the tables.
    pub own: &'a Own,
    /// Whether a policy is recommended.
    pub comparison: Comparison,
    /// The directory of everything that is left behind.
    pub out: &'a Path,
}

/// The results of a training run: `summary.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trained {
    /// The policies' files, one per seed.
    pub policies: Vec<PathBuf>,
    /// The seeds.
    pub seeds: Vec<u64>,
    /// Training and evaluation.
    #[serde(flatten)]
    pub learned: Learned,
    /// The recommendation, and the file `policy.safetensors` with the policy.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub verdict: Option<Kept>,
}

impl Trained {
    /// The same with other paths.
    fn with_paths(mut self, path: impl Fn(&Path) -> PathBuf) -> Self {
        self.policies.iter_mut().for_each(|p| *p = path(p));
        if let Some(kept) = &mut self.verdict {
            kept.file = path(&kept.file);
            kept.verdict.policy = path(&kept.verdict.policy);
        }
        self
    }
}

/// The name of the file that says that a training came to its end.
const LEARNED: &str = "learned.json";

/// Its content.
#[derive(Serialize, Deserialize)]
struct Done {
    /// Hash of all inputs of the training.
    key: String,
    /// SHA-256 of every policy.
    policies: BTreeMap<String, String>,
    learned: Learned,
}

impl Done {
    /// The end of the training `key` in `directory`; None if it has to be started or resumed.
    fn read(directory: &Path, key: &str) -> Result<Option<Self>> {
        let done: Option<Self> = read_json(&directory.join(LEARNED), "remove it to train again")?;
        Ok(done.filter(|d| d.key == key && first_damaged(directory, &d.policies).is_none()))
    }
}

/// Refuses options that `learner` has no use for, and a training without other `rows` that it needs.
///
/// # Errors
/// Names the option.
pub fn ensure_fits(learner: &LearnerConfig, rows: LearnedRows) -> Result<()> {
    let method = learner.algorithm.about();
    if learner.top < 1.0 && learner.algorithm != Algorithm::Bc {
        return Err(Error::Usage(format!(
            "learner.top: found {} with the learner {}, expected bc, whose option it is",
            learner.top, method.name
        )));
    }
    if rows == LearnedRows::Target && method.needs == OtherRows::Source {
        return Err(Error::Usage(format!(
            "learner {}: found target rows alone, expected source rows as well; give them with --extra FILE (Python: extra=)",
            method.name
        )));
    }
    Ok(())
}

/// One of the trainings of a run.
struct Training<'a> {
    /// What it is called in messages.
    name: &'a str,
    /// One member per seed.
    data: Vec<MemberData>,
    learner: &'a LearnerConfig,
    /// Where its policies are evaluated, if anywhere.
    arena: Option<Arena>,
    /// The place of its files.
    directory: &'a Path,
}

impl TrainingRun<'_> {
    /// Trains the policies, or takes them from the directory if this run is done.
    ///
    /// # Errors
    /// If the learner needs other rows than there are, the directory holds another run, training fails, or the user interrupts.
    pub fn run(&self, inputs: &Inputs, device: &Device) -> Result<Trained> {
        ensure_fits(&self.config.learner, LearnedRows::with(inputs.extra.as_ref()))?;
        inputs.ensure_episodes(&self.config.learner)?;
        let (out, seeds) = (self.out, self.seeds);
        let method = self.config.learner.algorithm.about();
        let spec = self.spec(inputs, device);
        let key = sha256_hex(without_source(&spec).to_string().as_bytes());
        if let Some(trained) = found(out, &spec, self.comparison)? {
            tce_base::note!("done before, in {}", out.display());
            return Ok(trained);
        }
        let data = self.members(inputs)?;
        let arena = self.own.env.map(|(agent, shift)| Arena::new(agent, shift, ScoreTable::default()));
        write_json(&out.join("spec.json"), &spec)?;
        tce_base::write_atomically(&out.join("config.toml"), self.config.to_toml().as_bytes())?;
        self.plan(inputs, device);
        let alone = data.iter().map(|d| MemberData { extra: None, row_scores: None, ..d.clone() }).collect();
        let training = Training { name: method.name, data, learner: &self.config.learner, arena, directory: out };
        let (policies, learned) = self.train(training, &key, inputs, device)?;
        let verdict = match self.comparison {
            Comparison::Skip => None,
            Comparison::Recommend => {
                let alone_is_baseline = inputs.extra.is_none();
                let name = match alone_is_baseline {
                    true => method.name.to_owned(),
                    false => format!("{} with the extra rows", method.name),
                };
                let own = Candidate { name, baseline: alone_is_baseline, files: policies.clone() };
                let baseline = (!alone_is_baseline).then(|| self.baseline(alone, &key, inputs, device)).transpose()?;
                Some(self.recommend(baseline.into_iter().chain([own]).collect(), inputs, device)?)
            }
        };
        let trained = Trained { policies, seeds: seeds.to_vec(), learned, verdict };
        let inside = |path: &Path| path.strip_prefix(out).unwrap_or(path).to_owned();
        write_json(&out.join("summary.json"), &trained.clone().with_paths(inside))?;
        Ok(trained)
    }

    /// What every seed learns from.
    fn members(&self, inputs: &Inputs) -> Result<Vec<MemberData>> {
        let target = inputs.taught(self.config);
        let complete = !self.config.learner.algorithm.about().successors;
        if let Some(choice) = inputs.choice(&self.config.target) {
            tce_base::note!("{}", choice.reason);
        }
        let rows = |table: &Table| if complete { table.all_rows() } else { table.rows.clone() };
        let extra = inputs.extra.as_ref().map(rows);
        let row_scores = match &extra {
            Some(extra) => row_scores(self.config, &target, extra)?,
            None => None,
        };
        let member = |&seed: &u64| MemberData {
            seed,
            target: target.clone(),
            extra: extra.clone(),
            row_scores: row_scores.clone(),
            trajectories: vec![target.clone()],
        };
        Ok(self.seeds.iter().map(member).collect())
    }

    /// Trains a policy per seed, or takes them from their directory if this training is done. `key` is the hash of all inputs.
    fn train(
        &self,
        training: Training,
        key: &str,
        inputs: &Inputs,
        device: &Device,
    ) -> Result<(Vec<PathBuf>, Learned)> {
        let Training { name, data, learner, arena, directory } = training;
        tce_base::begin_step(&training_step(name));
        let names = self.seeds.iter().map(|&seed| policy_file(seed));
        if let Some(done) = Done::read(directory, key)? {
            tce_base::note!("{name}: learned before, in {}", directory.display());
            return Ok((names.map(|name| directory.join(name)).collect(), done.learned));
        }
        let mut files = Vec::new();
        let evaluation = &self.config.evaluation;
        let (learned, leftovers) = learn(data, learner, evaluation, arena, (directory, key), device, |policies| {
            files = save_policies(policies, self.seeds, directory, inputs)?;
            Ok(())
        })?;
        let done = Done { key: key.to_owned(), policies: sha256_files(directory, names)?, learned };
        write_json(&directory.join(LEARNED), &done)?;
        leftovers.discard();
        Ok((files, done.learned))
    }

    /// Trains the baseline: an ensemble of clones of the target rows per seed, in `baseline/`.
    fn baseline(&self, data: Vec<MemberData>, key: &str, inputs: &Inputs, device: &Device) -> Result<Candidate> {
        let learner = self.baseline_learner();
        let directory = self.out.join("baseline");
        let training = Training { name: BASELINE, data, learner: &learner, arena: None, directory: &directory };
        let (files, _) = self.train(training, key, inputs, device)?;
        Ok(Candidate { name: BASELINE.into(), baseline: true, files })
    }

    fn baseline_learner(&self) -> LearnerConfig {
        LearnerConfig { algorithm: Algorithm::Bc, standardise: true, top: 1.0, ..self.config.learner.clone() }
    }

    fn recommend(&self, candidates: Vec<Candidate>, inputs: &Inputs, device: &Device) -> Result<Kept> {
        let evaluator = || OffPolicyEvaluator::train(inputs, &self.config.dynamics, self.out, device);
        // Without a simulator a single policy is tried, too: there is no other estimate of its return.
        let alone = self.own.env.and_then(|_| only(&candidates));
        let fitted_q = (self.config.fitted_q.steps > 0).then_some((&self.config.fitted_q, device));
        keep(alone.map_or_else(|| recommend(evaluator, &candidates, fitted_q), Ok)?, self.out)
    }

    /// All inputs that decide the result. The source's rows decide the comparison alone.
    fn spec(&self, inputs: &Inputs, device: &Device) -> serde_json::Value {
        let mut spec = serde_json::json!({
            "program": env!("CARGO_PKG_VERSION"), "config": self.config, "seeds": self.seeds, "own": self.own,
            "actions": &inputs.actions, "target": &inputs.target.hash, "extra": inputs.extra.as_ref().map(|t| &t.hash),
        });
        if let Some(source) = &inputs.source {
            spec["source"] = source.hash.clone().into();
        }
        DeviceKind::from(device).sign(&mut spec);
        spec
    }

    /// Plans the steps of the command.
    fn plan(&self, inputs: &Inputs, device: &Device) {
        let (rows, seeds, config) = (&inputs.target.rows, self.seeds.len(), self.config);
        let mut course = Course::new(format!("{}x{}", rows.obs_dim, rows.act_dim), seeds, device, self.out);
        let learned = LearnedRows::with(inputs.extra.as_ref());
        course.training(config.learner.algorithm.about().name, config, learned);
        if self.comparison == Comparison::Recommend {
            if learned == LearnedRows::Mixed {
                let baseline = Config { learner: self.baseline_learner(), ..config.clone() };
                course.training(BASELINE, &baseline, LearnedRows::Target);
            }
            course.verdict(config);
            let policies = if learned == LearnedRows::Mixed { 2 } else { 1 };
            course.fitted_q(config, seeds * policies);
        }
        course.plan();
    }
}

/// The inputs that decide the policies.
fn without_source(spec: &serde_json::Value) -> serde_json::Value {
    let mut spec = spec.clone();
    spec.as_object_mut().map(|inputs| inputs.remove("source"));
    spec
}

/// The finished training of `spec` in `out`; None if something of it is missing.
///
/// # Errors
/// If `out` holds results or checkpoints of another training.
fn found(out: &Path, spec: &serde_json::Value, comparison: Comparison) -> Result<Option<Trained>> {
    let summary = read_if_there(&out.join("summary.json"))?;
    let trained = summary.as_deref().and_then(|bytes| serde_json::from_slice::<Trained>(bytes).ok());
    let compared = trained.as_ref().is_some_and(|t| t.verdict.is_some());
    let same = match read_if_there(&out.join("spec.json"))? {
        Some(bytes) => serde_json::from_slice::<serde_json::Value>(&bytes).is_ok_and(|found| {
            // The source decides the comparison alone: policies that were not compared may be compared with any.
            if compared && comparison == Comparison::Recommend {
                found == *spec
            } else {
                without_source(&found) == without_source(spec)
            }
        }),
        None => summary.is_none(),
    };
    if !same {
        let end = if summary.is_some() { "the results of a" } else { "an interrupted" };
        return Err(Error::Usage(format!(
            "{}: found {end} training run with other settings, seeds or files; choose another --out{}",
            out.display(),
            if summary.is_some() { " (tce evaluate tries a policy that is there)" } else { ", or remove it" }
        )));
    }
    let trained = trained.map(|t| t.with_paths(|path| out.join(path)));
    // Policies that were removed are learned again.
    let whole = |t: &Trained| t.policies.iter().all(|p| p.exists());
    Ok(trained.filter(|t| whole(t) && (compared || comparison == Comparison::Skip)))
}
