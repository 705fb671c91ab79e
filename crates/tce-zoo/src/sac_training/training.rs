//! The loop: environment steps and updates, evaluations and checkpoints.

use std::path::{Path, PathBuf};

use tce_base::metrics::Metrics;
use tce_base::random::fill_uniform;
use tce_base::{Progress, Streams, create_folder, interrupted, write_json};
use tce_data::{Agent, LoadOptions, ScoreTable, load};
use tce_learn::sac::Sac;
use tce_learn::{Buffer, Learner, Meter, PolicyLearner};
use tce_nn::{Device, NamedParameters};
use tce_sim::{EPISODE_LIMIT, Env};

use super::cards::{save_card, summarise};
use super::ledger::{Ledger, Snapshot, lock, tidy};
use super::settings::{self, Goal, Origin, Settings};
use crate::actors::{Actions, Arena, evaluate};
use crate::error::{Error, Result};

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
        settings: Settings,
        from: Option<&Path>,
        goal: Goal,
        device: &Device,
    ) -> Result<Self> {
        // Checked before anything is written: a run that cannot start leaves no files behind.
        let begins = !Ledger::is_in(directory);
        let origin = from.filter(|_| begins).map(|from| Origin::of(from, settings.agent)).transpose()?;
        create_folder(directory)?;
        let lock = lock(directory)?;
        let ledger = Ledger::newest_whole(directory)?;
        let (settings, origin) = match &ledger {
            Some(ledger) => {
                // A finished run writes no further checkpoint, so a killed program's files are removed here.
                tidy(directory, &ledger.files);
                (settings.resuming(directory, from)?, None)
            }
            None => {
                let settings = Settings { from: origin.clone(), ..settings };
                write_json(&directory.join(settings::FILE), &settings)?;
                (settings, origin)
            }
        };
        let ledger = ledger.unwrap_or_default();
        let (agent, streams) = (settings.agent, Streams::new(settings.seed));
        // Ant's contact slots are always 0.
        let dead = if agent == Agent::Ant { (27..111).collect() } else { Vec::new() };
        let mut buffer = Buffer::replay(streams, agent.dims(), dead, settings.batch);
        let mut sac = Sac::new(&buffer, &settings.sac, device)?;
        if let Some(origin) = origin {
            origin.start(&mut sac, agent)?;
        }
        restore(&ledger, directory, agent, &mut buffer, &mut sac)?;
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
        let rows = &self.buffer.members()[0].parts[0];
        self.ledger.keep(&self.directory, rows, &self.sac.state())?;
        self.saved = self.ledger.step;
        Ok(())
    }
}

/// Puts the rows and the networks of a checkpoint into their places.
fn restore(ledger: &Ledger, directory: &Path, agent: Agent, buffer: &mut Buffer, sac: &mut Sac) -> Result<()> {
    for (file, _) in &ledger.files {
        let path = directory.join(file);
        if file.ends_with(".hdf5") {
            let options = LoadOptions { dims: Some(agent.dims()), ..LoadOptions::default() };
            *buffer.replay_mut() = load(&path, &options)?.transitions;
        } else {
            sac.restore(&NamedParameters::load(&path)?, &path)?;
        }
    }
    Ok(())
}
