//! `tce train-sac`.

use std::path::PathBuf;

use clap::Args;
use rayon::prelude::*;
use serde::Serialize;
use tce_data::{Agent, Shift, parse_environment, save_d4rl};
use tce_learn::sac::SacConfig;
use tce_nn::{Device, on_threads_of};
use tce_run::error::{Error, Result};
use tce_zoo::sac_training::{Goal, Ledger, Settings, Training};

use crate::output::{Output, table};

/// Steps of a training before the next one's turn.
const TURN: u64 = 200;

/// Arguments of `train-sac`.
#[derive(Debug, Args)]
pub struct TrainSac {
    /// Environments: hopper (source), hopper-morph, ant-gravity, ...; several are trained side by side.
    #[arg(required = true, value_parser = parse_environment)]
    environments: Vec<(Agent, Shift)>,
    /// Environment steps in all; a training that is there goes on to so many.
    #[arg(long, default_value_t = 1_000_000)]
    steps: u64,
    /// End at the first evaluation with this normalised score.
    #[arg(long, help_heading = "What is kept, and when it ends")]
    until_score: Option<f64>,
    /// Keep the policy of the first evaluation at each of these scores.
    #[arg(long, value_delimiter = ',', allow_hyphen_values = true, help_heading = "What is kept, and when it ends")]
    snapshot_scores: Vec<f64>,
    /// Trainings per environment, with seeds from --seed on.
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    /// The first seed.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Directory of the trainings, one below it for each.
    #[arg(long, default_value = "runs/sac")]
    out: PathBuf,
    /// Begin with networks of the same robot in another domain: the directory of a training, or a policy (its file, or
    /// zoo:NAME).
    #[arg(long, help_heading = "Training")]
    from: Option<PathBuf>,
    /// Updates of the critics alone, before the policy's first.
    #[arg(long, default_value_t = 0, help_heading = "Training")]
    policy_start: u64,
    /// With --from: share of uniformly random actions until the policy's first update. They tell the critics what other actions do.
    #[arg(long, default_value_t = 0.0)]
    explore: f64,
    /// Layer normalisation in the critics: they then promise nothing extreme of actions that nobody tried.
    #[arg(long)]
    critic_norm: bool,
    /// The temperature α before the first update. A trained policy wants less than a new one.
    #[arg(long, default_value_t = 1.0, help_heading = "Training")]
    temperature: f64,
    /// The entropy that α keeps the policy at (default: minus the number of actions). A trained policy has less, and loses its
    /// gait where it has to gain it back.
    #[arg(long, allow_hyphen_values = true)]
    target_entropy: Option<f64>,
    /// The policy's learning rate (default: the critics', 3e-4).
    #[arg(long)]
    policy_lr: Option<f64>,
    /// Steps before the first update: uniformly random, or the policy's of --from.
    #[arg(long, default_value_t = 10_000, help_heading = "Training")]
    start: u64,
    /// Environment steps per update.
    #[arg(long, default_value_t = 1, help_heading = "Training")]
    steps_per_update: u64,
    /// Rows per update.
    #[arg(long, default_value_t = 256, help_heading = "Training")]
    batch: usize,
    /// Steps between evaluations.
    #[arg(long, default_value_t = 10_000, help_heading = "Evaluation")]
    evaluate_every: u64,
    /// Episodes of an evaluation, with sampled actions.
    #[arg(long, default_value_t = 20, help_heading = "Evaluation")]
    episodes: usize,
    /// Steps between checkpoints.
    #[arg(long, default_value_t = 50_000, help_heading = "What is kept, and when it ends")]
    checkpoint_every: u64,
    /// At the end, write the replay buffers into the trainings' directories, in D4RL's layout (medium-replay).
    #[arg(long, help_heading = "What is kept, and when it ends")]
    replay: bool,
}

#[derive(Serialize)]
struct Row {
    environment: String,
    seed: u64,
    directory: PathBuf,
    #[serde(flatten)]
    ledger: Ledger,
    steps_per_second: f64,
}

/// A training and where it is.
struct Begun {
    environment: String,
    seed: u64,
    directory: PathBuf,
    training: Training,
    /// Why it does not go on.
    fault: Option<Error>,
    /// The steps that an earlier command took.
    before: u64,
}

impl TrainSac {
    /// Runs the command.
    pub fn run(self, output: Output, device: &Device) -> Result<()> {
        self.refuse()?;
        tce_sim::open_library()?;
        let mut trainings = self.begin(device)?;
        let started = std::time::Instant::now();
        // A training that fails does not take the others with it.
        while trainings.iter().any(|t| t.fault.is_none() && !t.training.finished()) {
            on_threads_of(device, || {
                trainings.par_iter_mut().filter(|t| t.fault.is_none()).for_each(|t| {
                    t.fault = t.training.advance(TURN).err().map(Error::from);
                });
            });
        }
        let seconds = started.elapsed().as_secs_f64();
        let (mut rows, mut faults) = (Vec::new(), Vec::new());
        for Begun { environment, seed, directory, training, fault, before } in trainings {
            if self.replay {
                save_d4rl(&directory.join("medium-replay.hdf5"), training.replay(), &Default::default(), &[])?;
            }
            faults.extend(fault.map(|fault| (format!("{environment} seed {seed}"), fault)));
            let ledger = training.ledger().clone();
            let steps_per_second = (ledger.step - before) as f64 / seconds;
            rows.push(Row { environment, seed, directory, ledger, steps_per_second });
        }
        if tce_base::interrupted() {
            return Err(Error::interrupted());
        }
        output.print(&rows, |rows| {
            let head = ["training", "steps", "return", "score", "snapshots", "steps/s", "directory"];
            table(&head, rows.iter().map(Row::cells))
        });
        failed(faults)
    }

    /// Refuses arguments out of range.
    fn refuse(&self) -> Result<()> {
        let counts =
            [self.steps, self.seeds, self.episodes as u64, self.evaluate_every, self.start, self.steps_per_update];
        if counts.contains(&0) || self.batch == 0 {
            let message = "--steps, --seeds, --episodes, --evaluate-every, --start, --steps-per-update and --batch must be at least 1";
            return Err(Error::Usage(message.into()));
        }
        if !(0.0..=1.0).contains(&self.explore) {
            return Err(Error::Usage(format!("--explore {}: expected a share from 0 to 1", self.explore)));
        }
        super::refuse::folder(&self.out)?;
        for (k, environment) in self.environments.iter().enumerate() {
            if self.environments[..k].contains(environment) {
                return Err(Error::Usage(format!("{}-{} is named twice", environment.0, environment.1)));
            }
        }
        Ok(())
    }

    /// Starts or resumes all trainings.
    fn begin(&self, device: &Device) -> Result<Vec<Begun>> {
        let goal = Goal {
            steps: self.steps,
            until: self.until_score,
            snapshots: self.snapshot_scores.clone(),
            checkpoint_every: self.checkpoint_every,
        };
        let mut trainings = Vec::new();
        for &(agent, shift) in &self.environments {
            for seed in self.seed..self.seed + self.seeds {
                let environment = format!("{agent}-{shift}");
                let directory = self.out.join(format!("{environment}-seed{seed}"));
                let settings = self.settings(agent, shift, seed);
                let training = Training::open(&directory, settings, self.from.as_deref(), goal.clone(), device)?;
                let before = training.ledger().step;
                trainings.push(Begun { environment, seed, directory, training, fault: None, before });
            }
        }
        Ok(trainings)
    }

    fn settings(&self, agent: Agent, shift: Shift, seed: u64) -> Settings {
        Settings {
            agent,
            shift,
            seed,
            start: self.start,
            steps_per_update: self.steps_per_update,
            explore: self.explore,
            batch: self.batch,
            from: None,
            evaluate_every: self.evaluate_every,
            episodes: self.episodes,
            sac: SacConfig {
                policy_start: self.policy_start,
                initial_alpha: self.temperature,
                layer_norm: self.critic_norm,
                target_entropy: self.target_entropy,
                policy_lr: self.policy_lr,
                ..SacConfig::default()
            },
        }
    }
}

impl Row {
    /// In the table.
    fn cells(&self) -> [String; 7] {
        let last = self.ledger.evaluations.last();
        [
            format!("{} seed {}", self.environment, self.seed),
            self.ledger.step.to_string(),
            last.map_or("-".into(), |e| format!("{:.0} ± {:.0}", e.mean, e.std)),
            last.and_then(|e| e.score).map_or("-".into(), |s| format!("{s:.1}")),
            self.ledger.snapshots.len().to_string(),
            format!("{:.0}", self.steps_per_second),
            self.directory.display().to_string(),
        ]
    }
}

/// The error of trainings that failed, with their names where there are several.
fn failed(mut faults: Vec<(String, Error)>) -> Result<()> {
    match faults.len() {
        0 => Ok(()),
        1 => Err(faults.remove(0).1),
        _ => {
            let lines: Vec<_> = faults.iter().map(|(name, fault)| format!("{name}: {fault}")).collect();
            Err(Error::Failed(lines.join("\n")))
        }
    }
}
