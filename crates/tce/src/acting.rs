//! Agents that act and learn: SAC in an environment, at D4RL's specification, in pieces of hours.
//!
//! One environment step and one update in turns; the first steps are uniformly random. Everything random is indexed by
//! step, update or episode, and a checkpoint is taken between episodes, so that a training that was stopped goes on to the
//! same bytes. A directory holds
//!
//! | file | content |
//! |---|---|
//! | `settings.json` | what decides the training |
//! | `metrics.jsonl`, `tensorboard/` | figures of the present piece |
//! | `replay-STEP.hdf5`, `learner-STEP.safetensors` | the last checkpoint's replay buffer and networks |
//! | `ledger.json` | the checkpoint: step, episode, evaluations, snapshots, and the SHA-256 of the two; written last |
//! | `policy-SCORE.safetensors`, `policy.safetensors` | snapshots and the last policy, each with a card |

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tce_base::random::fill_uniform;
use tce_base::{FileError, Progress, Streams, interrupted, sha256_file, write_json};
use tce_data::{Agent, LoadOptions, ScoreTable, Shift, load, reference_scores, save_d4rl};
use tce_learn::sac::{Sac, SacConfig};
use tce_learn::{Buffer, Learner, Meter, Policy, PolicyLearner};
use tce_nn::{Device, NamedParameters};
use tce_sim::{EPISODE_LIMIT, Env};

use crate::actors::{Evaluation, evaluate};
use crate::error::{Error, Result};
use crate::metrics::Metrics;
use crate::output::mean_std;

/// What decides a training. Its end may be moved when it goes on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// The robot.
    pub agent: Agent,
    /// The domain.
    pub shift: Shift,
    /// Of everything random.
    pub seed: u64,
    /// Uniformly random actions before the first update.
    pub start: u64,
    /// Rows per update.
    pub batch: usize,
    /// Steps between evaluations.
    pub evaluate_every: u64,
    /// Episodes of an evaluation, with sampled actions.
    pub episodes: usize,
    /// The learner.
    pub sac: SacConfig,
}

/// When a training ends, and what it leaves on the way.
#[derive(Clone, Debug, PartialEq)]
pub struct Goal {
    /// Environment steps in all.
    pub steps: u64,
    /// Ends at the first evaluation with this score.
    pub until: Option<f64>,
    /// Keeps the policy of the first evaluation at or above each of these scores.
    pub snapshots: Vec<f64>,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
}

/// The mean return of an evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Judged {
    /// Environment steps before it.
    pub step: u64,
    /// Mean return.
    pub mean: f64,
    /// Standard deviation over episodes.
    pub std: f64,
    /// Normalised; in the source domain by D4RL's references.
    pub score: f64,
}

/// A policy that was kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// The score that it was kept for.
    pub at: f64,
    /// How it did then.
    pub judged: Judged,
    /// Its file in the directory.
    pub file: String,
}

/// How far a training is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Ledger {
    /// Environment steps taken.
    pub step: u64,
    /// Episodes finished.
    pub episode: u64,
    /// All evaluations.
    pub evaluations: Vec<Judged>,
    /// All snapshots.
    pub snapshots: Vec<Snapshot>,
    /// The checkpoint's files and their SHA-256.
    pub files: Vec<(String, String)>,
}

/// A training under way.
pub struct Training {
    settings: Settings,
    goal: Goal,
    directory: PathBuf,
    ledger: Ledger,
    saved: u64,
    sac: Sac,
    buffer: Buffer,
    env: Env,
    /// The observation, and steps of the present episode.
    observation: Vec<f32>,
    length: usize,
    meter: Meter,
    metrics: Metrics,
    progress: Progress,
    finished: bool,
}

impl Training {
    /// Starts in `directory`, or goes on from the checkpoint there.
    ///
    /// # Errors
    /// If the directory holds another training, or a damaged checkpoint.
    pub fn open(directory: &Path, settings: Settings, goal: Goal, device: &Device) -> Result<Self> {
        std::fs::create_dir_all(directory).map_err(|e| FileError::new(directory, "create the directory", e))?;
        let path = directory.join("settings.json");
        match std::fs::read(&path) {
            Ok(bytes) => {
                let found: Settings = serde_json::from_slice(&bytes).map_err(|e| damaged(&path, &e))?;
                if found != settings {
                    return Err(Error::Usage(format!(
                        "{}: the training there has other settings; give another --out, or the settings it began with",
                        path.display()
                    )));
                }
            }
            Err(_) => write_json(&path, &settings)?,
        }
        let ledger = match std::fs::read(directory.join("ledger.json")) {
            Ok(bytes) => serde_json::from_slice(&bytes).map_err(|e| damaged(&directory.join("ledger.json"), &e))?,
            Err(_) => Ledger::default(),
        };
        let (agent, streams) = (settings.agent, Streams::new(settings.seed));
        // Ant's contact slots, which are always 0.
        let dead = if agent == Agent::Ant { (27..111).collect() } else { Vec::new() };
        let mut buffer = Buffer::replay(streams, agent.dims(), dead, settings.batch);
        let mut sac = Sac::new(&buffer, &settings.sac, device)?;
        for (file, hash) in &ledger.files {
            let path = directory.join(file);
            if sha256_file(&path)? != *hash {
                return Err(Error::Failed(format!(
                    "{}: not what the ledger says; the file was changed",
                    path.display()
                )));
            }
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
            meter: Meter::always(),
            metrics: Metrics::start(directory)?,
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

    /// Whether the goal is reached (or the user stopped it) and the checkpoint written.
    pub fn finished(&self) -> bool {
        self.finished
    }

    /// How far it is.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    /// The rows so far, in the order in which they came.
    pub fn replay(&self) -> &tce_data::Transitions {
        &self.buffer.members()[0].parts[0]
    }

    fn reset(&mut self) {
        let mut rng = Streams::new(self.settings.seed).indexed("reset", self.ledger.episode);
        self.env.reset(&mut rng, &mut self.observation);
        self.length = 0;
    }

    fn reached(&self) -> bool {
        let score = self.ledger.evaluations.last().map(|e| e.score);
        self.goal.until.is_some_and(|until| score.is_some_and(|s| s >= until))
    }

    /// Some steps; ends with the episode in which the goal is reached or the user interrupts.
    ///
    /// # Errors
    /// If the policy's actions are no numbers any more, or a file cannot be written.
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
        let action = if step < self.settings.start {
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
        }
        self.observation = next;
        self.ledger.step += 1;
        self.progress.inc(1);
        if self.ledger.step > self.settings.start {
            let update = self.ledger.step - self.settings.start - 1;
            let batch = self.buffer.sample(update, &self.sac.device());
            // Figures cost time, and their means need no more than every tenth.
            let mut unused = Meter::default();
            let meter = if update.is_multiple_of(10) { &mut self.meter } else { &mut unused };
            self.sac.update(&batch, update, meter);
        }
        if self.ledger.step.is_multiple_of(self.settings.evaluate_every) {
            self.judge()?;
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

    /// An evaluation with sampled actions, as D4RL's returns are, and the snapshots it is good for.
    fn judge(&mut self) -> Result<()> {
        let Settings { agent, shift, seed, episodes, .. } = self.settings;
        let policy = self.sac.policies().remove(0);
        let reference = reference_scores(agent, shift, ScoreTable::default());
        let streams = Streams::new(seed ^ self.ledger.step);
        let evaluation = evaluate(&policy, agent, shift, episodes, streams, false, reference)?;
        let judged = judged(&evaluation, self.ledger.step);
        let figures: Vec<_> = self.meter.take().into_iter().map(|(name, v)| (name, v[0])).collect();
        self.metrics.log("sac", self.ledger.step, 0, figures)?;
        self.metrics.log("evaluate", self.ledger.step, 0, [("return", judged.mean), ("score", judged.score)])?;
        self.progress.message(format!("return {:.0}, score {:.1}", judged.mean, judged.score));
        for &at in &self.goal.snapshots {
            if judged.score >= at && self.ledger.snapshots.iter().all(|s| s.at != at) {
                let file = format!("policy-{at}.safetensors");
                save_card(&policy, &self.directory.join(&file), &self.settings, &judged)?;
                self.ledger.snapshots.push(Snapshot { at, judged: judged.clone(), file });
            }
        }
        self.ledger.evaluations.push(judged);
        Ok(())
    }

    fn checkpoint(&mut self) -> Result<()> {
        let step = self.ledger.step;
        let (replay, learner) = (format!("replay-{step}.hdf5"), format!("learner-{step}.safetensors"));
        save_d4rl(&self.directory.join(&replay), self.replay(), &Default::default(), &[])?;
        self.sac.state().save(&self.directory.join(&learner))?;
        if let Some(judged) = self.ledger.evaluations.last() {
            let policy = self.sac.policies().remove(0);
            save_card(&policy, &self.directory.join("policy.safetensors"), &self.settings, judged)?;
        }
        let hashed = |name: String| Ok((name.clone(), sha256_file(&self.directory.join(&name))?));
        let files = [replay, learner].into_iter().map(hashed).collect::<Result<Vec<_>>>()?;
        let old = std::mem::replace(&mut self.ledger.files, files);
        write_json(&self.directory.join("ledger.json"), &self.ledger)?;
        for (name, _) in old.into_iter().filter(|o| !self.ledger.files.contains(o)) {
            // The new checkpoint is whole: an old one that cannot be removed costs space only.
            let _ = std::fs::remove_file(self.directory.join(name));
        }
        self.saved = step;
        Ok(())
    }
}

fn damaged(path: &Path, error: &serde_json::Error) -> Error {
    Error::Failed(format!("{}: {error}; the file is damaged", path.display()))
}

fn judged(evaluation: &Evaluation, step: u64) -> Judged {
    let (mean, std) = mean_std(&evaluation.returns);
    Judged { step, mean, std, score: evaluation.score.unwrap_or(f64::NAN) }
}

/// What a policy's file says about where it comes from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Card {
    /// The robot.
    pub agent: Agent,
    /// The domain it was trained in.
    pub shift: Shift,
    /// Of the training.
    pub seed: u64,
    /// How it did, and after how many environment steps.
    pub judged: Judged,
    /// Episodes of that evaluation.
    pub episodes: usize,
    /// The program that trained it.
    pub program: String,
}

/// Key of the card in a policy file's metadata.
const CARD: &str = "card";

fn save_card(policy: &Policy, path: &Path, settings: &Settings, judged: &Judged) -> Result<()> {
    let card = Card {
        agent: settings.agent,
        shift: settings.shift,
        seed: settings.seed,
        judged: judged.clone(),
        episodes: settings.episodes,
        program: format!("tce {}", env!("CARGO_PKG_VERSION")),
    };
    let mut parameters = policy.to_parameters();
    parameters.metadata.insert(CARD.into(), serde_json::to_string(&card).expect("plain data"));
    Ok(parameters.save(path)?)
}
