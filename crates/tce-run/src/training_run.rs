//! A training run on a user's own tables: policies, a baseline beside them, and which one is recommended, in one directory.
//!
//! | file | content |
//! |---|---|
//! | `policy-seedN.safetensors` | the policies, one per seed |
//! | `policy.safetensors` | the recommended one |
//! | `verdict.json` | why it is recommended |
//! | `baseline/` | the clones of the target rows, where the policies learned from more than those |
//! | `clones-actions/` | the policies that learned from the same rows with the baseline's actions, where both are compared |
//! | `metrics.jsonl`, `config.toml`, `spec.json`, `summary.json` | metrics, settings, inputs of the key, results |
//! | `learned.json` | that a training came to its end, here and in the folders |
//!
//! A second call with the same directory returns the finished run, or does what is missing or was changed: finished trainings are not done
//! again, others go on from their checkpoints. Paths in files are relative to the directory, which can be moved.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tce_base::{first_damaged, read_if_there, read_json, sha256_files, sha256_hex, write_json};
use tce_data::ScoreTable;
use tce_learn::{LearnedRows, OtherRows, Policy};
use tce_nn::Device;
use tce_zoo::actors::Arena;

use crate::clones::take_actions;
use crate::config::{Algorithm, Config, LearnerConfig, RowActions};
use crate::course::{Course, training_step};
use crate::device_kind::DeviceKind;
use crate::error::{Error, Result};
use crate::inputs::{Inputs, Table};
use crate::methods::row_scores;
use crate::off_policy_evaluation::OffPolicyEvaluator;
use crate::own::Own;
use crate::policy_training::{Learned, MemberData, learn, policy_file, save_policies};
use crate::verdict::{Candidate, Kept, keep, only, recommend};

mod comparison;
mod unrewarded;

pub use comparison::{Comparison, TriedActions};
use unrewarded::{only_reward, without_rewards};

/// The name of the baseline: clones of the target rows alone.
const BASELINE: &str = "cloning the target rows";
/// The folder of the baseline.
const BASELINE_FOLDER: &str = "baseline";
/// The folder of the policies that learned from the extra rows with the baseline's actions, where both are compared.
const CLONES_FOLDER: &str = "clones-actions";
/// The file of the settings.
const CONFIG: &str = "config.toml";
/// The file of all inputs that decide the result; the first one of a run.
const SPEC: &str = "spec.json";

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
    /// The policies that learned from the extra rows with the baseline's actions, one per seed; none where they were not asked for.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub other_policies: Vec<PathBuf>,
    /// The recommendation, and the file `policy.safetensors` with the policy.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub verdict: Option<Kept>,
}

impl Trained {
    /// The same with other paths.
    fn with_paths(mut self, path: impl Fn(&Path) -> PathBuf) -> Self {
        self.policies.iter_mut().chain(&mut self.other_policies).for_each(|p| *p = path(p));
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

    /// Whether the policies of the finished training `key` are in `directory`, as they were.
    fn is_intact(directory: &Path, key: &str, seeds: &[u64]) -> Result<bool> {
        if directory.join(LEARNED).exists() {
            return Ok(Self::read(directory, key)?.is_some());
        }
        // Trainings of earlier versions, which did not write this file, stay finished.
        Ok(seeds.iter().all(|&seed| Policy::load(&directory.join(policy_file(seed))).is_ok()))
    }
}

/// Refuses a directory with a file of settings that no run wrote: the run's own would replace it.
///
/// # Errors
/// Names the file.
pub fn ensure_own_folder(out: &Path) -> Result<()> {
    let config = out.join(CONFIG);
    if config.exists() && !out.join(SPEC).exists() {
        return Err(Error::Usage(format!(
            "{}: found a file that no training wrote (there is no {SPEC} beside it), expected none: the settings of this training would \
             replace it. Choose another folder for the results, or move the file",
            config.display()
        )));
    }
    Ok(())
}

/// Refuses options that the learner of `config` has no use for, and a training without other `rows` that it needs.
///
/// # Errors
/// Names the option.
pub fn ensure_fits(config: &Config, rows: LearnedRows) -> Result<()> {
    let learner = &config.learner;
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
    config.ensure_actions(rows)
}

/// What policies are learned by.
struct Method {
    /// The name in the comparison.
    name: String,
    /// The name in messages.
    step: String,
    /// Whether the extra rows have the actions of the baseline.
    by_clones: bool,
    /// The hash of all inputs.
    key: String,
    /// The place of its files.
    directory: PathBuf,
}

impl Method {
    /// Whether its training came to its end, and nothing of it was changed since.
    fn is_done(&self) -> Result<bool> {
        Ok(Done::read(&self.directory, &self.key)?.is_some())
    }
}

/// One of the trainings of a run.
struct Training<'a> {
    /// What it is called in messages.
    name: &'a str,
    /// One member per seed.
    data: Vec<MemberData>,
    /// The policies whose actions the extra rows get, if not their own.
    clones: Option<&'a [PathBuf]>,
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
        ensure_own_folder(self.out)?;
        let rows = LearnedRows::with(inputs.extra.as_ref());
        ensure_fits(self.config, rows)?;
        if self.comparison.both() {
            ensure_fits(&self.by_clones(), rows)?;
        }
        inputs.ensure_episodes(&self.config.learner)?;
        let (out, seeds) = (self.out, self.seeds);
        let spec = self.spec(inputs, device);
        let methods = self.methods(inputs, device);
        if let Some(trained) = self.found(&spec, &methods)? {
            tce_base::note!("done before, in {}", out.display());
            return Ok(trained);
        }
        let data = self.members(inputs)?;
        write_json(&out.join(SPEC), &spec)?;
        tce_base::write_atomically(&out.join(CONFIG), self.config.to_toml().as_bytes())?;
        self.plan(inputs, &methods, device);
        let alone = data.iter().map(|d| MemberData { extra: None, row_scores: None, ..d.clone() }).collect::<Vec<_>>();
        let key = &methods[0].key;
        let mut baseline = None;
        let mut candidates = Vec::new();
        let mut learned = None;
        for method in &methods {
            if method.by_clones && baseline.is_none() {
                baseline = Some(self.baseline(alone.clone(), key, inputs, device)?);
            }
            let clones = baseline.as_ref().filter(|_| method.by_clones).map(|clones| &clones.files[..]);
            // The first one's policies are the training's own, and tried in a simulator where there is one.
            let arena = self.own.env.filter(|_| learned.is_none());
            let arena = arena.map(|(agent, shift)| Arena::new(agent, shift, ScoreTable::default()));
            let (name, directory) = (&method.step, &method.directory);
            let data = data.clone();
            let training = Training { name, data, clones, learner: &self.config.learner, arena, directory };
            let (files, result) = self.train(training, &method.key, inputs, device)?;
            learned.get_or_insert(result);
            candidates.push(Candidate { name: method.name.clone(), baseline: inputs.extra.is_none(), files });
        }
        let mut files = candidates.iter().map(|candidate| candidate.files.clone());
        let (policies, other_policies) = (files.next().unwrap_or_default(), files.next().unwrap_or_default());
        let verdict = match self.comparison {
            Comparison::Skip => None,
            Comparison::Recommend { .. } => {
                if inputs.extra.is_some() && baseline.is_none() {
                    baseline = Some(self.baseline(alone, key, inputs, device)?);
                }
                Some(self.recommend(baseline.into_iter().chain(candidates).collect(), inputs, device)?)
            }
        };
        let learned = learned.unwrap_or_default();
        let trained = Trained { policies, seeds: seeds.to_vec(), learned, other_policies, verdict };
        let inside = |path: &Path| path.strip_prefix(out).unwrap_or(path).to_owned();
        write_json(&out.join("summary.json"), &trained.clone().with_paths(inside))?;
        Ok(trained)
    }

    /// What is learned from all rows: first the training of the settings, whose key is the baseline's, too, and, where both are compared, the one with the baseline's actions.
    fn methods(&self, inputs: &Inputs, device: &Device) -> Vec<Method> {
        let rows = LearnedRows::with(inputs.extra.as_ref());
        let learner = self.config.learner.algorithm.about().name;
        let method = |config: &Config, directory: PathBuf| {
            let by_clones = config.mixture.by_clones_on(rows);
            let name = match (rows, by_clones) {
                (LearnedRows::Target, _) => learner.to_owned(),
                (LearnedRows::Mixed, false) => format!("{learner} with the extra rows"),
                (LearnedRows::Mixed, true) => format!("{learner} with the extra states and the baseline's actions"),
            };
            let spec = TrainingRun { config, ..self.clone() }.spec(inputs, device);
            let key = key_of(&spec);
            let step = if directory == self.out { learner.to_owned() } else { name.clone() };
            Method { name, step, by_clones, key, directory }
        };
        let mut methods = vec![method(self.config, self.out.to_owned())];
        if self.comparison.both() {
            methods.push(method(&self.by_clones(), self.out.join(CLONES_FOLDER)));
        }
        methods
    }

    /// The settings with the baseline's actions.
    fn by_clones(&self) -> Config {
        Config { mixture: self.config.mixture.with_actions(RowActions::Clones), ..self.config.clone() }
    }

    /// What every seed learns from.
    fn members(&self, inputs: &Inputs) -> Result<Vec<MemberData>> {
        let target = inputs.learned_from(&self.config.target);
        if let Some(choice) = inputs.choice(&self.config.target) {
            tce_base::note!("{}", choice.reason);
        }
        let extra = inputs.extra.as_ref().map(Table::all_rows);
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
        let Training { name, mut data, clones, learner, arena, directory } = training;
        tce_base::begin_step(&training_step(name));
        let names = self.seeds.iter().map(|&seed| policy_file(seed));
        if let Some(done) = Done::read(directory, key)? {
            tce_base::note!("{name}: learned before, in {}", directory.display());
            return Ok((names.map(|name| directory.join(name)).collect(), done.learned));
        }
        if let Some(clones) = clones {
            take_actions(&mut data, clones)?;
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
        let learner = self.config.learner.of_clones();
        let directory = self.out.join(BASELINE_FOLDER);
        let training =
            Training { name: BASELINE, data, clones: None, learner: &learner, arena: None, directory: &directory };
        let (files, _) = self.train(training, key, inputs, device)?;
        Ok(Candidate { name: BASELINE.into(), baseline: true, files })
    }

    fn recommend(&self, candidates: Vec<Candidate>, inputs: &Inputs, device: &Device) -> Result<Kept> {
        // Without a simulator a single policy is tried, too: there is no other estimate of its return.
        let alone = self.own.env.and_then(|_| only(&candidates));
        let verdict = match alone.or_else(|| without_rewards(&candidates, inputs.target.complete())) {
            Some(verdict) => verdict,
            None => {
                let evaluator = || OffPolicyEvaluator::train(inputs, &self.config.dynamics, self.out, device);
                let fitted_q = (self.config.fitted_q.steps > 0).then_some((&self.config.fitted_q, device));
                recommend(evaluator, &candidates, fitted_q)?
            }
        };
        keep(verdict, self.out)
    }

    /// All inputs that decide the result. The source's rows decide the comparison alone; which policies are compared is told by the results.
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
    fn plan(&self, inputs: &Inputs, methods: &[Method], device: &Device) {
        let (rows, seeds, config) = (&inputs.target.rows, self.seeds.len(), self.config);
        let mut course = Course::new(format!("{}x{}", rows.obs_dim, rows.act_dim), seeds, device, self.out);
        let learned = LearnedRows::with(inputs.extra.as_ref());
        for method in methods {
            if method.by_clones {
                course.training(BASELINE, &config.of_clones(), LearnedRows::Target);
            }
            course.training(&method.step, config, learned);
        }
        if self.comparison != Comparison::Skip {
            let mixed = learned == LearnedRows::Mixed;
            if mixed && !methods.iter().any(|method| method.by_clones) {
                course.training(BASELINE, &config.of_clones(), LearnedRows::Target);
            }
            if only_reward(inputs.target.complete()).is_none() {
                let policies = seeds * (methods.len() + usize::from(mixed));
                course.verdict(config, policies);
                course.fitted_q(config, policies);
            }
        }
        course.plan();
    }

    /// The finished training of `spec`, which learns by `methods`; None if something of it is missing or was changed.
    ///
    /// # Errors
    /// If the directory holds results or checkpoints of another training.
    fn found(&self, spec: &serde_json::Value, methods: &[Method]) -> Result<Option<Trained>> {
        let out = self.out;
        let summary = read_if_there(&out.join("summary.json"))?;
        let trained = summary.as_deref().and_then(|bytes| serde_json::from_slice::<Trained>(bytes).ok());
        let compared = trained.as_ref().is_some_and(|t| t.verdict.is_some());
        let same = match read_if_there(&out.join(SPEC))? {
            Some(bytes) => serde_json::from_slice::<serde_json::Value>(&bytes).is_ok_and(|found| {
                // The source decides the comparison alone: policies that were not compared may be compared with any.
                if compared && self.comparison != Comparison::Skip {
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
        let Some(mut trained) = trained.map(|t| t.with_paths(|path| out.join(path))) else { return Ok(None) };
        // What is missing or was changed is made again, from what is still there.
        let learned = Done::is_intact(out, &methods[0].key, self.seeds)?;
        if self.comparison == Comparison::Skip {
            trained.other_policies.clear();
        }
        // An earlier call may have compared fewer policies, or more.
        let as_many =
            self.comparison == Comparison::Skip || trained.other_policies.is_empty() != self.comparison.both();
        let kept = match &trained.verdict {
            Some(kept) if learned && as_many => self.is_intact(kept, spec, methods)?,
            _ => false,
        };
        if !kept {
            trained.verdict = None;
        }
        if !learned || compared && as_many && !kept {
            tce_base::note!("{}: files of the finished training are missing or were changed", out.display());
        }
        Ok(Some(trained).filter(|_| learned && (kept || self.comparison == Comparison::Skip)))
    }

    /// Whether a verdict is there with all that it is about: the policies of the further `methods`, the baseline, where the training `spec` has
    /// one, and the recommended policy, which is a copy of one of the policies.
    fn is_intact(&self, kept: &Kept, spec: &serde_json::Value, methods: &[Method]) -> Result<bool> {
        let baseline = !spec["extra"].is_null();
        if baseline && !Done::is_intact(&self.out.join(BASELINE_FOLDER), &methods[0].key, self.seeds)? {
            return Ok(false);
        }
        for method in &methods[1..] {
            if !method.is_done()? {
                return Ok(false);
            }
        }
        let copied = match (read_if_there(&kept.file)?, read_if_there(&kept.verdict.policy)?) {
            (Some(copy), Some(policy)) => copy == policy,
            _ => false,
        };
        Ok(copied && self.out.join("verdict.json").exists())
    }
}

/// The inputs that decide the policies.
fn without_source(spec: &serde_json::Value) -> serde_json::Value {
    let mut spec = spec.clone();
    spec.as_object_mut().map(|inputs| inputs.remove("source"));
    spec
}

/// The key of the policies that `spec` decides.
fn key_of(spec: &serde_json::Value) -> String {
    sha256_hex(without_source(spec).to_string().as_bytes())
}
