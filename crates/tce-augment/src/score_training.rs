//! Training of score networks, for a given length or until a criterion on held-out rows no longer falls.

use tce_base::{OrAuto, Progress, Streams};
use tce_data::hold_out_runs;
use tce_diffusion::{CycleEnd, Process, Sampler, ScoreData, ScoreModel, Trainer, UntilDone};
use tce_nn::Checkpoints;

use crate::config::GeneratorConfig;
use crate::error::Result;
use crate::work::Keeper;

/// Metrics of a network at the end of a cycle, one number per member each. The first one decides when the training is done; the less
/// the better.
pub(crate) type Metrics = Vec<(&'static str, Vec<f64>)>;

/// How long a network is trained.
pub(crate) enum Course<'a> {
    /// So many updates.
    Steps(u64),
    /// Until the first of its metrics no longer falls.
    UntilDone {
        /// The cycles.
        plan: UntilDone,
        /// Measures the network.
        criterion: &'a (dyn Fn(&Trainer) -> Result<Metrics> + Sync),
    },
}

/// A network that was trained.
pub(crate) struct Ready {
    /// The network.
    pub model: ScoreModel,
    /// Last reported loss, per member.
    pub loss: Vec<f32>,
    /// The criterion at the ends of the cycles; empty where the length was given.
    pub curve: Vec<CycleEnd>,
}

/// Trains, and keeps the losses and, where there are cycles, the network at the end of each of them.
pub(crate) fn run(
    trainer: &mut Trainer,
    data: &ScoreData,
    course: &Course,
    checkpoints: &mut Checkpoints,
    keeper: &dyn Keeper,
    name: &str,
) -> Result<Ready> {
    let data = std::slice::from_ref(data);
    let log = |step: u64, metric: &'static str, values: &[f64]| keeper.record(name, step, metric, values);
    let mut loss = Vec::new();
    let end = match course {
        Course::Steps(steps) => Some(*steps),
        Course::UntilDone { .. } => None,
    };
    let on_loss = |step: u64, losses: &[f32]| {
        loss = losses.to_vec();
        if step.is_multiple_of(500) || Some(step) == end {
            log(step, "loss", &losses.iter().map(|&l| f64::from(l)).collect::<Vec<_>>());
        }
    };
    let (model, curve) = match course {
        Course::Steps(steps) => {
            trainer.train(data, *steps, checkpoints, on_loss)?;
            (trainer.model(), Vec::new())
        }
        Course::UntilDone { plan, criterion } => {
            let at_cycle_end = |trainer: &Trainer| -> Result<Vec<f64>> {
                let metrics = criterion(trainer)?;
                metrics.iter().for_each(|(metric, values)| log(trainer.steps(), metric, values));
                keeper.cycle(name, trainer.steps(), &trainer.model())?;
                Ok(metrics.into_iter().next().map(|(_, values)| values).unwrap_or_default())
            };
            trainer.train_until_done(data, plan, checkpoints, on_loss, at_cycle_end)?
        }
    };
    Ok(Ready { model, loss, curve })
}

/// Training rows (width `d`) for processes that start at data, `[P, rows, d]`; the others need none.
pub(crate) fn start_rows(
    process: Process,
    training: impl FnOnce() -> Vec<f32>,
    d: usize,
    rows: usize,
    members: &[Streams],
    name: &str,
) -> Option<Vec<f32>> {
    use rand::RngExt;
    if !process.starts_at_data() {
        return None;
    }
    let training = training();
    let n = training.len() / d;
    let mut out = Vec::with_capacity(rows * members.len() * d);
    for member in members {
        let mut rng = member.stream(&format!("start/{name}"));
        for _ in 0..rows {
            let i = rng.random_range(0..n);
            out.extend_from_slice(&training[i * d..(i + 1) * d]);
        }
    }
    Some(out)
}

/// A progress bar of sampling.
pub(crate) fn progress(label: &str, rows: usize, sampler: &Sampler) -> Progress {
    Progress::new(label, (rows * sampler.evaluations()) as u64, "evaluations")
}

/// Of `n` target rows, those that the networks of `config` are trained on, and those that are held out to tell when to stop.
pub fn held_out_rows(n: usize, config: &GeneratorConfig) -> (Vec<usize>, Vec<usize>) {
    let auto = [config.state_steps, config.transition_steps].contains(&OrAuto::Auto);
    hold_out_runs(n, if auto { config.until_done.held_out } else { 0.0 })
}
