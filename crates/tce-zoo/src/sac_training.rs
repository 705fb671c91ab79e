//! Trains SAC agents in an environment with D4RL's settings. A training run can be stopped and resumed.
//!
//! Environment steps and updates alternate (by default one to one). The first steps are uniformly random, or come from
//! the policy that the training run starts from. All random numbers are indexed by step, update or episode, and
//! checkpoints are written between episodes. A resumed run therefore gives the same bytes as an uninterrupted one. A
//! step of the simulator takes .06 to .25 ms, an update of 256 rows 10 ms. Parallel runs keep the cores busy;
//! overlapping a step with its update does not. A directory contains
//!
//! | file | content |
//! |---|---|
//! | `settings.json` | all settings that determine the run |
//! | `metrics.jsonl`, `tensorboard/` | losses and evaluations; cut back to the checkpoint when the run is resumed |
//! | `replay-STEP.hdf5`, `learner-STEP.safetensors` | the last checkpoint's replay buffer and networks |
//! | `ledger.json` | the checkpoint: step, episode, evaluations, snapshots, and SHA-256 of both files; written last |
//! | `previous.json` | the ledger of the checkpoint before; its files are kept as a backup if a file is damaged |
//! | `policy-SCORE.safetensors`, `policy.safetensors` | snapshots, and the policy of the last evaluation, each with a card |

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tce_base::metrics::Metrics;
use tce_base::random::fill_uniform;
use tce_base::{
    FileError, PROGRAM, Progress, Streams, interrupted, mean_std, read_if_there, sha256_file, write_atomically,
    write_json,
};
use tce_data::{Agent, LoadOptions, ScoreTable, Shift, load, save_d4rl};
use tce_learn::sac::{Sac, SacConfig};
use tce_learn::{Buffer, Learner, Meter, Policy, PolicyKind, PolicyLearner};
use tce_nn::{Device, NamedParameters};
use tce_sim::{EPISODE_LIMIT, Env};

use crate::actors::{Actions, Arena, Evaluation, evaluate, load_policy};
use crate::error::{Error, Result};
use crate::exhibits::{Card, Exhibit};

/// All settings that determine a training run. Its goal may change when it is resumed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// The robot.
    pub agent: Agent,
    /// The domain.
    pub shift: Shift,
    /// The seed of all random numbers.
    pub seed: u64,
    /// Steps before the first update. They are uniformly random if the networks are new.
    pub start: u64,
    /// Environment steps per update.
    pub steps_per_update: u64,
    /// Share of uniformly random actions until the policy's first update, if the policy is not new. They show the
    /// critics the effects of actions other than the policy's own.
    #[serde(default, skip_serializing_if = "no_exploration")]
    pub explore: f64,
    /// Rows per update.
    pub batch: usize,
    /// The networks that it started from, if they are not new.
    pub from: Option<Origin>,
    /// Steps between evaluations.
    pub evaluate_every: u64,
    /// Episodes of an evaluation, with sampled actions.
    pub episodes: usize,
    /// The learner.
    pub sac: SacConfig,
}

fn no_exploration(share: &f64) -> bool {
    *share == 0.0
}

/// When a training run ends, and which policies it keeps.
#[derive(Clone, Debug, PartialEq)]
pub struct Goal {
    /// Total number of environment steps.
    pub steps: u64,
    /// Stop at the first evaluation with this score.
    pub until: Option<f64>,
    /// Keep the policy of the first evaluation at or above each of these scores.
    pub snapshots: Vec<f64>,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
}

/// The mean return of an evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EvaluationSummary {
    /// Environment steps before the evaluation.
    pub step: u64,
    /// Mean return.
    pub mean: f64,
    /// Standard deviation over episodes.
    pub std: f64,
    /// Mean length of the episodes.
    pub length: f64,
    /// Normalised score (source domain: D4RL's reference returns). `None` if no reference returns are published.
    pub score: Option<f64>,
}

/// A policy that was kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// The score for which it was kept.
    pub at: f64,
    /// Its evaluation at that time.
    #[serde(alias = "judged")]
    pub evaluation: EvaluationSummary,
    /// Its file in the directory.
    pub file: String,
}

/// The progress of a training run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Ledger {
    /// Environment steps taken.
    pub step: u64,
    /// Episodes finished.
    pub episode: u64,
    /// All evaluations.
    pub evaluations: Vec<EvaluationSummary>,
    /// All snapshots.
    pub snapshots: Vec<Snapshot>,
    /// The checkpoint's files and their SHA-256.
    pub files: Vec<(String, String)>,
    /// Metrics since the last evaluation.
    #[serde(default)]
    pub meter: Meter,
}

impl Ledger {
    /// The ledger of the training run in `directory`, if it has a checkpoint.
    ///
    /// # Errors
    /// If the ledger is damaged.
    pub fn read(directory: &Path) -> Result<Option<Self>> {
        read_json(&directory.join("ledger.json"))
    }

    /// The newest undamaged one of the two checkpoints in `directory`, if there is a checkpoint.
    ///
    /// # Errors
    /// If there are checkpoints, but all of them are damaged.
    fn newest_whole(directory: &Path) -> Result<Option<Self>> {
        let whole = |name: &str| -> Result<Option<Self>> {
            let ledger: Option<Self> = read_json(&directory.join(name))?;
            for (file, hash) in ledger.iter().flat_map(|l| &l.files) {
                verify(&directory.join(file), hash)?;
            }
            Ok(ledger)
        };
        let damage = match whole("ledger.json") {
            Ok(ledger) => return Ok(ledger),
            Err(damage) => damage,
        };
        match whole("previous.json") {
            Ok(Some(ledger)) => {
                tce_base::note!("{damage}; going on from the checkpoint before, at step {}", ledger.step);
                Ok(Some(ledger))
            }
            _ => Err(damage),
        }
    }
}

/// The content of a JSON file; `None` if there is no such file.
fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<Option<T>> {
    let bytes = read_if_there(path)?;
    bytes.map(|bytes| serde_json::from_slice(&bytes).map_err(|e| damaged(path, &e))).transpose()
}

/// Locks the directory: two programs in one directory would delete each other's checkpoints.
fn lock(directory: &Path) -> Result<std::fs::File> {
    let path = directory.join("lock");
    let file = std::fs::File::create(&path).map_err(|e| FileError::new(&path, "create", e))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(std::fs::TryLockError::WouldBlock) => Err(Error::Usage(format!(
            "{}: another training is at work there; let it finish, or give another --out",
            directory.display()
        ))),
        // Some network file systems do not support locks.
        Err(std::fs::TryLockError::Error(_)) => Ok(file),
    }
}

/// What a training run started from, if not from new networks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Origin {
    /// All networks of another training run.
    Training {
        /// The directory of that run.
        directory: PathBuf,
        /// `hopper-source seed 0, step 300000`.
        training: String,
        /// The file with its networks in that directory.
        file: String,
        /// SHA-256 of that file.
        sha256: String,
    },
    /// A policy; critics and temperature are new.
    Actor {
        /// Its file, or `zoo:NAME`.
        actor: PathBuf,
        /// SHA-256 of that file.
        sha256: String,
    },
}

impl Origin {
    /// The origin for a training run's directory, a policy file or `zoo:NAME`.
    fn of(path: &Path, agent: Agent) -> Result<Self> {
        if let Some(exhibit) = Exhibit::at(path)? {
            return Ok(Self::Actor { actor: path.to_owned(), sha256: exhibit.sha256() });
        }
        if path.is_file() {
            return Ok(Self::Actor { actor: path.to_owned(), sha256: sha256_file(path)? });
        }
        let none = || {
            let message = "no checkpoint of a training here; give the directory of one, such as \
                runs/sac/hopper-source-seed0, or a policy: its file, or zoo:NAME";
            Error::Usage(format!("{}: {message}", path.display()))
        };
        let settings: Settings = read_json(&path.join("settings.json"))?.ok_or_else(none)?;
        if settings.agent != agent {
            let message = "a policy of one robot cannot drive another";
            return Err(Error::Usage(format!("{}: a training of {}; {message}", path.display(), settings.agent)));
        }
        let ledger = Ledger::read(path)?.ok_or_else(none)?;
        let (file, sha256) = ledger.files.into_iter().find(|f| f.0.ends_with(".safetensors")).ok_or_else(none)?;
        let training = format!("{agent}-{} seed {}, step {}", settings.shift, settings.seed, ledger.step);
        Ok(Self::Training { directory: path.to_owned(), training, file, sha256 })
    }

    /// The path that the user gave.
    fn path(&self) -> &Path {
        match self {
            Self::Training { directory: path, .. } | Self::Actor { actor: path, .. } => path,
        }
    }

    /// The text for a card.
    fn describe(&self) -> String {
        match self {
            Self::Training { training, .. } => training.clone(),
            Self::Actor { actor, .. } => actor.display().to_string(),
        }
    }

    /// Copies the networks into a training run that starts.
    fn start(&self, sac: &mut Sac, agent: Agent) -> Result<()> {
        match self {
            Self::Training { directory, file, sha256, .. } => {
                let path = directory.join(file);
                verify(&path, sha256)?;
                sac.restore(&NamedParameters::load(&path)?, &path)?;
            }
            Self::Actor { actor, .. } => {
                let policy = load_policy(actor, agent)?;
                let PolicyKind::Mlp(network) = policy.kind() else {
                    let message = "a policy with a memory; SAC goes on from networks of one state only";
                    return Err(Error::Usage(format!("{}: {message}", actor.display())));
                };
                sac.begin_with(network, actor)?;
            }
        }
        Ok(())
    }
}

fn verify(path: &Path, hash: &str) -> Result<()> {
    if sha256_file(path)? == hash {
        return Ok(());
    }
    Err(Error::Failed(format!("{}: not what the ledger says; the file was changed", path.display())))
}

/// A training run in progress.
pub struct Training {
    settings: Settings,
    goal: Goal,
    directory: PathBuf,
    ledger: Ledger,
    saved: u64,
    sac: Sac,
    buffer: Buffer,
    env: Env,
    /// The current observation, and the steps of the current episode.
    observation: Vec<f32>,
    length: usize,
    metrics: Metrics,
    progress: Progress,
    finished: bool,
    /// Held while the training run is open.
    #[allow(dead_code)]
    lock: std::fs::File,
}

impl Training {
    /// Starts a training run in `directory`, with the networks of the run or policy `from` if given, or resumes it from
    /// its checkpoint.
    ///
    /// # Errors
    /// If the directory is in use, or holds another run or a damaged checkpoint, or `from` holds no networks.
    pub fn open(
        directory: &Path,
        mut settings: Settings,
        from: Option<&Path>,
        goal: Goal,
        device: &Device,
    ) -> Result<Self> {
        // Checked before anything is written: a run that cannot start leaves no files behind.
        let begins = !directory.join("ledger.json").exists();
        let origin = from.filter(|_| begins).map(|from| Origin::of(from, settings.agent)).transpose()?;
        std::fs::create_dir_all(directory).map_err(|e| FileError::new(directory, "create the directory", e))?;
        let lock = lock(directory)?;
        let path = directory.join("settings.json");
        let ledger = Ledger::newest_whole(directory)?;
        if let Some(ledger) = &ledger {
            // A finished run writes no further checkpoint, so a killed program's files are removed here.
            tidy(directory, &ledger.files);
        }
        if ledger.is_some() {
            let found: Settings = read_json(&path)?.ok_or_else(|| {
                Error::Failed(format!("{}: missing, beside a checkpoint; restore the directory", path.display()))
            })?;
            if let (Some(from), Some(found)) = (from, &found.from)
                && from != found.path()
            {
                return Err(Error::Usage(format!(
                    "{}: the training there began with {}, not {}",
                    path.display(),
                    found.path().display(),
                    from.display()
                )));
            }
            settings.from.clone_from(&found.from);
            if found != settings || (from.is_some() && found.from.is_none()) {
                return Err(Error::Usage(format!(
                    "{}: the training there has other settings; give another --out, or the settings it began with",
                    path.display()
                )));
            }
        } else {
            settings.from.clone_from(&origin);
            write_json(&path, &settings)?;
        }
        let origin = origin.filter(|_| ledger.is_none());
        let ledger = ledger.unwrap_or_default();
        let (agent, streams) = (settings.agent, Streams::new(settings.seed));
        // Ant's contact slots are always 0.
        let dead = if agent == Agent::Ant { (27..111).collect() } else { Vec::new() };
        let mut buffer = Buffer::replay(streams, agent.dims(), dead, settings.batch);
        let mut sac = Sac::new(&buffer, &settings.sac, device)?;
        if let Some(origin) = origin {
            origin.start(&mut sac, agent)?;
        }
        for (file, _) in &ledger.files {
            let path = directory.join(file);
            if file.ends_with(".hdf5") {
                let options = LoadOptions { dims: Some(agent.dims()), ..LoadOptions::default() };
                *buffer.replay_mut() = load(&path, &options)?.transitions;
            } else {
                sac.restore(&NamedParameters::load(&path)?, &path)?;
            }
        }
        let label = format!("sac {agent}-{} seed {}", settings.shift, settings.seed);
        let mut training = Self {
            env: Env::new(agent, settings.shift)?,
            observation: vec![0.0; agent.dims().0],
            length: 0,
            metrics: Metrics::resume(directory, |_, at| at <= ledger.step)?,
            lock,
            progress: Progress::new(label, goal.steps.saturating_sub(ledger.step), "steps"),
            saved: ledger.step,
            finished: ledger.step >= goal.steps,
            directory: directory.to_owned(),
            settings,
            goal,
            ledger,
            sac,
            buffer,
        };
        training.finished |= training.reached();
        training.reset();
        Ok(training)
    }

    /// Whether the goal is reached (or the user stopped the run) and the checkpoint is written.
    pub fn finished(&self) -> bool {
        self.finished
    }

    /// The progress of the run.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// The rows collected so far, in order.
    pub fn replay(&self) -> &tce_data::Transitions {
        &self.buffer.members()[0].parts[0]
    }

    fn reset(&mut self) {
        let mut rng = Streams::new(self.settings.seed).indexed("reset", self.ledger.episode);
        self.env.reset(&mut rng, &mut self.observation);
        self.length = 0;
    }

    fn reached(&self) -> bool {
        let best = self.ledger.evaluations.iter().filter_map(|e| e.score).fold(f64::NEG_INFINITY, f64::max);
        self.goal.until.is_some_and(|until| best >= until)
    }

    /// Takes some steps. Ends with the episode in which the goal is reached or the user interrupts.
    ///
    /// # Errors
    /// If the policy's actions are not finite, or a file cannot be written.
    pub fn advance(&mut self, steps: u64) -> Result<()> {
        for _ in 0..steps {
            if self.finished {
                return Ok(());
            }
            self.step()?;
        }
        Ok(())
    }

    fn step(&mut self) -> Result<()> {
        let step = self.ledger.step;
        let (streams, (obs_dim, act_dim)) = (Streams::new(self.settings.seed), self.settings.agent.dims());
        let action = if self.explores(step) {
            let mut action = vec![0.0; act_dim];
            fill_uniform(&mut streams.indexed("random action", step), &mut action);
            action.iter_mut().for_each(|a| *a = 2.0 * *a - 1.0);
            action
        } else {
            self.sac.act(&self.buffer.network_inputs(0, &self.observation), step)
        };
        if action.iter().any(|a| !a.is_finite()) {
            return Err(Error::Failed(format!(
                "the policy's action is no number at step {step}: the training has diverged"
            )));
        }
        let mut next = vec![0.0; obs_dim];
        let result = self.env.step(&action, &mut next);
        self.length += 1;
        let timeout = !result.terminal && (self.length == EPISODE_LIMIT || result.unstable);
        if !result.unstable {
            let (s, reward) = (&self.observation, result.reward as f32);
            self.buffer.replay_mut().push(s, &action, reward, &next, result.terminal, timeout);
        } else if self.length > 1 {
            // The physics blew up: the episode ends at the row before.
            *self.buffer.replay_mut().timeouts.last_mut().expect("this episode's rows") = true;
        }
        self.observation = next;
        self.ledger.step += 1;
        self.progress.inc(1);
        let trained = self.ledger.step.saturating_sub(self.settings.start);
        if trained > 0 && trained.is_multiple_of(self.settings.steps_per_update) {
            let update = trained / self.settings.steps_per_update - 1;
            let batch = self.buffer.sample(update, &self.sac.device());
            // Metrics cost time. Every tenth update is enough for their means.
            let mut meter = if update.is_multiple_of(10) { Meter::always() } else { Meter::default() };
            self.sac.update(&batch, update, &mut meter);
            self.ledger.meter.join(meter);
        }
        if self.ledger.step.is_multiple_of(self.settings.evaluate_every) {
            self.evaluate()?;
        }
        if result.terminal || timeout {
            self.ledger.episode += 1;
            self.finished = self.ledger.step >= self.goal.steps || self.reached() || interrupted();
            if self.finished || self.ledger.step - self.saved >= self.goal.checkpoint_every {
                self.checkpoint()?;
            }
            self.reset();
        }
        Ok(())
    }

    /// Whether the action of `step` is uniformly random.
    fn explores(&self, step: u64) -> bool {
        let Settings { start, steps_per_update, explore, sac, from, .. } = &self.settings;
        if from.is_none() {
            return step < *start;
        }
        if *explore <= 0.0 || step >= start + sac.policy_start * steps_per_update {
            return false;
        }
        let mut draw = [0.0];
        fill_uniform(&mut Streams::new(self.settings.seed).indexed("explore", step), &mut draw);
        f64::from(draw[0]) < *explore
    }

    /// Evaluates with sampled actions, as for D4RL's returns, and saves the snapshots whose score is reached.
    fn evaluate(&mut self) -> Result<()> {
        let Settings { agent, shift, seed, episodes, .. } = self.settings;
        let policy = self.sac.policies().remove(0);
        let arena = Arena::new(agent, shift, ScoreTable::default());
        let streams = Streams::new(seed ^ self.ledger.step);
        // It runs to its end even if the user interrupts, because the checkpoint that follows needs it.
        let evaluation = evaluate(&policy, arena, episodes, streams, Actions::Sampled, || false)?;
        let summary = summarise(&evaluation, self.ledger.step);
        let metrics: Vec<_> = self.ledger.meter.take().into_iter().map(|(name, v)| (name, v[0])).collect();
        let metrics = metrics.iter().map(|(name, value)| (name.as_str(), *value));
        self.metrics.log("sac", self.ledger.step, 0, metrics)?;
        let metrics = [("return", Some(summary.mean)), ("length", Some(summary.length)), ("score", summary.score)];
        let metrics = metrics.into_iter().filter_map(|(name, value)| Some((name, value?)));
        self.metrics.log("evaluate", self.ledger.step, 0, metrics)?;
        let score = summary.score.map_or(String::new(), |s| format!(", score {s:.1}"));
        self.progress.message(format!("return {:.0}{score}", summary.mean));
        // Saved here and not with the checkpoint: some updates later the policy differs from the evaluated one.
        save_card(&policy, &self.directory.join("policy.safetensors"), &self.settings, &summary)?;
        for &at in &self.goal.snapshots {
            if summary.score.is_some_and(|s| s >= at) && self.ledger.snapshots.iter().all(|s| s.at != at) {
                let file = format!("policy-{at}.safetensors");
                save_card(&policy, &self.directory.join(&file), &self.settings, &summary)?;
                self.ledger.snapshots.push(Snapshot { at, evaluation: summary.clone(), file });
            }
        }
        self.ledger.evaluations.push(summary);
        Ok(())
    }

    fn checkpoint(&mut self) -> Result<()> {
        let step = self.ledger.step;
        let (replay, learner) = (format!("replay-{step}.hdf5"), format!("learner-{step}.safetensors"));
        save_d4rl(&self.directory.join(&replay), self.replay(), &Default::default(), &[])?;
        self.sac.state().save(&self.directory.join(&learner))?;
        let hashed = |name: String| Ok((name.clone(), sha256_file(&self.directory.join(&name))?));
        let files = [replay, learner].into_iter().map(hashed).collect::<Result<Vec<_>>>()?;
        let before = std::mem::replace(&mut self.ledger.files, files);
        if let (false, Ok(bytes)) = (before.is_empty(), std::fs::read(self.directory.join("ledger.json"))) {
            write_atomically(&self.directory.join("previous.json"), &bytes)?;
        }
        write_json(&self.directory.join("ledger.json"), &self.ledger)?;
        tidy(&self.directory, &before);
        self.saved = step;
        Ok(())
    }
}

/// Removes checkpoints other than `kept` and the two in the ledgers, and half-written files of a killed program: they
/// only waste space. Nothing is removed if a ledger cannot be read.
fn tidy(directory: &Path, kept: &[(String, String)]) {
    let ledger = |name: &str| read_json::<Ledger>(&directory.join(name));
    let (Ok(last), Ok(previous)) = (ledger("ledger.json"), ledger("previous.json")) else { return };
    let known: Vec<_> = last.iter().chain(&previous).flat_map(|l| &l.files).chain(kept).collect();
    for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let ours = name.starts_with("replay-") || name.starts_with("learner-") || name.ends_with(".part");
        if ours && known.iter().all(|(file, _)| *file != name) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

fn damaged(path: &Path, error: &serde_json::Error) -> Error {
    Error::Failed(format!("{}: {error}; the file is damaged", path.display()))
}

fn summarise(evaluation: &Evaluation, step: u64) -> EvaluationSummary {
    let (mean, std) = mean_std(&evaluation.returns);
    EvaluationSummary { step, mean, std, length: evaluation.mean_length(), score: evaluation.score }
}

fn save_card(policy: &Policy, path: &Path, settings: &Settings, summary: &EvaluationSummary) -> Result<()> {
    let card = Card {
        agent: settings.agent,
        shift: settings.shift,
        role: None,
        seed: settings.seed,
        steps: summary.step,
        updates: summary.step.saturating_sub(settings.start) / settings.steps_per_update,
        batch: settings.batch,
        from: settings.from.as_ref().map(Origin::describe),
        cloned_from: None,
        episodes: settings.episodes,
        mean: summary.mean,
        std: summary.std,
        length: summary.length,
        score: summary.score,
        program: PROGRAM.into(),
    };
    let mut parameters = policy.to_parameters();
    card.attach(&mut parameters);
    Ok(parameters.save(path)?)
}
