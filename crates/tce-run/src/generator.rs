//! The heart of TCE (Algorithm 1, lines 2 to 6): train q_mix and q_tran; sample states under ŷ ~ U(0, y_max), then their
//! successors.
//!
//! Everything is trained on standardised, live dimensions: a dimension without spread in source and target (Ant's 84
//! contact slots) is left out and put back as the constant it is.

use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use tce_base::metrics::Metrics;
use tce_base::random::choose;
use tce_base::{Progress, Streams};
use tce_data::{Support, Transitions};
use tce_diffusion::{
    Chunks, Condition, CycleEnd, DiffusionError, NetworkConfig, Part, Process, Request, Sampler, Schedule, ScoreData,
    ScoreModel, Target, TrainConfig, Trainer, UntilDone, uniform_labels,
};
use tce_learn::{LabelModels, rmse};
use tce_nn::{Checkpoints, Device, is_cpu};

use crate::config::{Config, GeneratorConfig, Length, UntilDoneConfig};
use crate::error::{Error, Result};
use crate::expand::label_models;
use crate::inputs::Inputs;
use crate::stage::{Attempt, Stage};
use crate::units::Units;

/// Trained score networks and label models of a whole population, with the maps between their units and the data's.
pub struct Generator {
    /// Maps of the networks.
    pub units: Units,
    /// q_mix.
    pub state: ScoreModel,
    /// q_tran.
    pub transition: ScoreModel,
}

/// What training the networks leaves behind.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trained {
    /// The maps.
    pub units: Units,
    /// Last reported loss of q_mix, per member.
    pub state_loss: Vec<f32>,
    /// Last reported loss of q_tran, per member.
    pub transition_loss: Vec<f32>,
    /// Held-out losses at the ends of q_mix's cycles; empty where its length was given.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub state_curve: Vec<CycleEnd>,
    /// Errors of the actions that q_tran implies at held-out states, at the ends of its cycles; empty where its length was given.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub transition_curve: Vec<CycleEnd>,
    /// Seconds of training, all members together.
    pub seconds: f64,
}

/// What decides the trained networks.
#[derive(Serialize)]
struct TrainingSpec<'a> {
    inputs: crate::inputs::InputSpec,
    /// The models by whose actions q_tran is judged.
    #[serde(skip_serializing_if = "Option::is_none")]
    labels: Option<String>,
    seeds: &'a [u64],
    process: Process,
    target: Target,
    state_steps: Length,
    transition_steps: Length,
    #[serde(skip_serializing_if = "Option::is_none")]
    until_done: Option<UntilDoneConfig>,
    batch: usize,
    learning_rate: f64,
    schedule: Schedule,
    ema: f64,
    balanced: bool,
    source_states: bool,
}

impl Generator {
    /// Trains the networks, or takes them from the stage under `root` if they are there.
    pub fn train(
        inputs: &Inputs,
        config: &Config,
        seeds: &[u64],
        root: &std::path::Path,
        device: &Device,
    ) -> Result<(Self, Stage, Trained)> {
        let g = &config.generator;
        // Inferred actions tell when q_tran is done.
        let judge = match g.transition_steps {
            Length::Auto => Some(label_models(inputs, &config.labels, seeds, root, device)?),
            Length::Steps(_) => None,
        };
        let spec = TrainingSpec {
            inputs: inputs.spec_imitated(g.source_states, &config.target),
            labels: judge.as_ref().map(|(_, stage, _)| stage.name()),
            seeds,
            process: g.process,
            target: g.target,
            state_steps: g.state_steps,
            transition_steps: g.transition_steps,
            until_done: [g.state_steps, g.transition_steps].contains(&Length::Auto).then_some(g.until_done),
            batch: g.batch,
            learning_rate: g.learning_rate,
            schedule: g.schedule,
            ema: g.ema,
            balanced: g.balanced,
            source_states: g.source_states,
        };
        tce_base::begin_step("score networks");
        let stage = Stage::open(root, "stages/networks", &spec, device)?;
        let files = ["state.safetensors", "transition.safetensors"];
        if let Some(trained) = stage.summary::<Trained>()? {
            let [state, transition] = files.map(|f| stage.file(f));
            let generator = Self {
                units: trained.units.clone(),
                state: ScoreModel::load(&state, device)?,
                transition: ScoreModel::load(&transition, device)?,
            };
            return Ok((generator, stage, trained));
        }
        let started = std::time::Instant::now();
        let attempt = stage.attempt()?;
        let (generator, mut trained) =
            Self::train_now(inputs, config, judge.as_ref().map(|j| &j.0), seeds, device, &attempt)?;
        trained.seconds = started.elapsed().as_secs_f64();
        generator.state.save(&attempt.file(files[0]))?;
        generator.transition.save(&attempt.file(files[1]))?;
        let cycles = trained.state_curve.iter().map(|end| cycle_file("state", end.step));
        let cycles = cycles.chain(trained.transition_curve.iter().map(|end| cycle_file("transition", end.step)));
        let files: Vec<_> = files.into_iter().map(String::from).chain(cycles).collect();
        attempt.finish(&files, &trained)?;
        Ok((generator, stage, trained))
    }

    fn train_now(
        inputs: &Inputs,
        config: &Config,
        models: Option<&LabelModels>,
        seeds: &[u64],
        device: &Device,
        attempt: &Attempt,
    ) -> Result<(Self, Trained)> {
        let g = &config.generator;
        let members: Vec<_> = seeds.iter().map(|&s| Streams::new(s)).collect();
        let target = &*inputs.imitated(&config.target);
        let source = if g.source_states { Some(inputs.source_rows()?) } else { None };
        let units = Units::fit(target, source, g.target);
        let d = units.live.len();
        let train = TrainConfig { learning_rate: g.learning_rate, schedule: g.schedule, batch: g.batch, ema: g.ema };
        let all_states = units.states(&target.observations);
        // Rows that tell when to stop are seen by neither network.
        let (kept, held_out) = held_out_rows(target.len(), g);
        let pick = |rows: &[f32], of: &[usize]| -> Vec<f32> {
            of.iter().flat_map(|&i| rows[i * d..(i + 1) * d].iter().copied()).collect()
        };
        let (target_states, held_out_states) = (pick(&all_states, &kept), pick(&all_states, &held_out));

        // q_mix: the label says whose state it is (Eq. 5). q_tran: target rows alone. Neither needs the other, so they
        // train side by side where there are two threads.
        let source_states = source.map(|t| units.states(&t.observations)).unwrap_or_default();
        let all_outputs = units.outputs(target);
        let (outputs, held_out_outputs) = (pick(&all_outputs, &kept), pick(&all_outputs, &held_out));
        let state_data = match source {
            Some(_) => ScoreData::labelled(&source_states, &target_states, d, g.balanced)?,
            None => {
                let condition = Condition::Constant(vec![0.0]);
                ScoreData::new(vec![Part { rows: &target_states, condition }], d, 1, false)?
            }
        };
        let transition_data = ScoreData::conditioned(&outputs, d, &target_states, d)?;
        let probe_states = match held_out.is_empty() {
            true => None,
            false => {
                let part = Part { rows: &held_out_states, condition: Condition::Constant(vec![0.0]) };
                Some(ScoreData::new(vec![part], d, 1, false)?)
            }
        };
        let probe_successors = match held_out.is_empty() {
            true => None,
            false => Some(ScoreData::conditioned(&held_out_outputs, d, &held_out_states, d)?),
        };
        let losses = |trainer: &Trainer, probe: &Option<ScoreData>, data: &ScoreData| -> Result<Figures> {
            let of = |data: &ScoreData| trainer.loss_on(std::slice::from_ref(data), PROBE_BATCHES);
            let held_out = probe.as_ref().map(of).transpose()?;
            Ok(held_out.map(|l| ("held_out_loss", l)).into_iter().chain([("training_loss", of(data)?)]).collect())
        };
        let judge_states = |trainer: &Trainer| losses(trainer, &probe_states, &state_data);
        // What a learner will see are actions, so that they decide: the held-out loss of q_tran rises long before they are right.
        let apart = target.select(&held_out);
        let judge_successors = |trainer: &Trainer| -> Result<Figures> {
            let models = models.ok_or_else(|| Error::Failed("q_tran cannot be judged without label models".into()))?;
            let model = trainer.model();
            let errors = implied_errors(&units, &model, models, &apart, &g.sampler, &members, target)?;
            let mut figures = vec![("implied_action_error", errors)];
            figures.extend(losses(trainer, &probe_successors, &transition_data)?);
            Ok(figures)
        };
        let state_course = match g.state_steps {
            Length::Steps(steps) => Course::Steps(steps),
            Length::Auto => Course::UntilDone { plan: g.until_done.state(), judge: &judge_states },
        };
        let transition_course = match g.transition_steps {
            Length::Steps(steps) => Course::Steps(steps),
            Length::Auto => Course::UntilDone { plan: g.until_done.transition(), judge: &judge_successors },
        };
        let mut state = Trainer::new("state", NetworkConfig::new(d, 1), g.process, train, &members, device)?;
        let mut transition = Trainer::new("transition", NetworkConfig::new(d, d), g.process, train, &members, device)?;
        transition.stop_with(&state);
        let (mut kept_state, mut kept_transition) = (attempt.checkpoints("state")?, attempt.checkpoints("transition")?);
        let (state_step, transition_step) = (kept_state.step().unwrap_or(0), kept_transition.step().unwrap_or(0));
        let metrics = Mutex::new(attempt.metrics(|stage, at| match stage {
            "state" => at <= state_step,
            _ => at <= transition_step,
        })?);
        let mut state_run = || run(&mut state, &state_data, &state_course, &mut kept_state, &metrics, "state", attempt);
        let mut transition_run = || {
            let (data, course) = (&transition_data, &transition_course);
            run(&mut transition, data, course, &mut kept_transition, &metrics, "transition", attempt)
        };
        // A GPU has one thread that queues for it.
        let (state, transition) = if is_cpu(device) && rayon::current_num_threads() > 1 {
            std::thread::scope(|scope| {
                let other = scope.spawn(transition_run);
                let state = state_run();
                (state, other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            })
        } else {
            (state_run(), transition_run())
        };
        let (state, transition) = match (state, transition) {
            // The one that diverged is the reason, not the one that was stopped for it.
            (Err(Error::Diffusion(DiffusionError::Interrupted { .. })), Err(reason)) | (Err(reason), _) => {
                return Err(reason);
            }
            (Ok(state), transition) => (state, transition?),
        };
        let trained = Trained {
            units: units.clone(),
            state_loss: state.loss,
            transition_loss: transition.loss,
            state_curve: state.curve,
            transition_curve: transition.curve,
            seconds: 0.0,
        };
        Ok((Self { units, state: state.model, transition: transition.model }, trained))
    }

    /// Member `index` as a population of one.
    pub fn member(&self, index: usize) -> Self {
        Self { units: self.units.clone(), state: self.state.member(index), transition: self.transition.member(index) }
    }

    /// What q_tran is trained on: standardised outputs of the rows of `target`, `[rows, d]`.
    pub(crate) fn outputs(&self, target: &Transitions) -> Vec<f32> {
        self.units.outputs(target)
    }

    /// Samples `rows` states per member under ŷ ~ U(0, y_max): live dimensions in the data's units, `[P, rows, d]`.
    pub fn sample_states(
        &self,
        rows: usize,
        y_max: f32,
        sampler: &Sampler,
        members: &[Streams],
        target: &Transitions,
        kept: Option<Chunks>,
    ) -> Result<Vec<f32>> {
        let labels: Vec<f32> = members.iter().flat_map(|m| uniform_labels(m, "state", rows, y_max)).collect();
        let d = self.units.live.len();
        let training = || self.units.states(&target.observations);
        let start = start_rows(self.state.process(), training, d, rows, members, "state");
        let progress = progress("sample states", rows * members.len(), sampler);
        let request =
            Request { name: "state", rows, condition: &labels, guidance: None, start: start.as_deref(), kept };
        let mut states = self.state.sample(request, sampler, members, Some(&progress))?;
        progress.finish();
        self.units.state.invert_in_place(&mut states);
        Ok(states)
    }

    /// Samples a successor for every state (live dimensions, the data's units, `[P, rows, d]`).
    pub fn sample_successors(
        &self,
        states: &[f32],
        sampler: &Sampler,
        members: &[Streams],
        target: &Transitions,
        kept: Option<Chunks>,
    ) -> Result<Vec<f32>> {
        let d = self.units.live.len();
        let rows = states.len() / (d * members.len());
        let condition = self.units.state.apply(states);
        let outputs = || self.outputs(target);
        let start = start_rows(self.transition.process(), outputs, d, rows, members, "successor");
        let progress = progress("sample successors", rows * members.len(), sampler);
        let request =
            Request { name: "successor", rows, condition: &condition, guidance: None, start: start.as_deref(), kept };
        let mut out = self.transition.sample(request, sampler, members, Some(&progress))?;
        progress.finish();
        self.units.output.invert_in_place(&mut out);
        self.units.target.decode(states, &mut out);
        Ok(out)
    }

    /// State pairs `[P, rows, d]` (live dimensions, the data's units): states under ŷ ~ U(0, y_max) and their successors, both
    /// within the `support`.
    pub fn sample_pairs(
        &self,
        rows: usize,
        config: &GeneratorConfig,
        members: &[Streams],
        target: &Transitions,
        support: Option<&Support>,
        kept: Option<Chunks>,
    ) -> Result<(Vec<f32>, Vec<f32>)> {
        let respect = |rows: Vec<f32>| match support {
            Some(support) => self.units.within(support, &rows),
            None => rows,
        };
        let states = respect(self.sample_states(rows, config.y_max, &config.sampler, members, target, kept)?);
        let successors = respect(self.sample_successors(&states, &config.sampler, members, target, kept)?);
        Ok((states, successors))
    }
}

/// Successors drawn at every held-out state.
const PROBE_DRAWS: usize = 4;

/// The error of the actions that q_tran implies at the states of `rows`, per member: RMSE of Inv(s, ŝ') against the row's own action. The
/// same noise at every call.
fn implied_errors(
    units: &Units,
    model: &ScoreModel,
    models: &LabelModels,
    rows: &Transitions,
    sampler: &Sampler,
    members: &[Streams],
    target: &Transitions,
) -> Result<Vec<f64>> {
    let d = units.live.len();
    let states = units.take(&rows.observations).repeat(PROBE_DRAWS);
    let streams: Vec<_> = members.iter().map(|m| m.child("until done")).collect();
    let n = states.len() / d;
    let start = start_rows(model.process(), || units.outputs(target), d, n, &streams, "successor");
    let condition = units.state.apply(&states);
    let request = Request {
        name: "successor",
        rows: n,
        condition: &condition,
        guidance: None,
        start: start.as_deref(),
        kept: None,
    };
    let mut out = model.sample(request, sampler, &streams, None)?;
    units.output.invert_in_place(&mut out);
    let (whole, own) = (rows.observations.repeat(PROBE_DRAWS), rows.actions.repeat(PROBE_DRAWS));
    let error = |(m, out): (usize, &mut [f32])| {
        units.target.decode(&states, out);
        Ok(rmse(&models.actions(m, &whole, &units.put_back(out))?, &own))
    };
    out.chunks_exact_mut(n * d).enumerate().map(error).collect()
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

/// The file of the network as it was at the end of a cycle.
pub fn cycle_file(name: &str, step: u64) -> String {
    format!("{name}-{step}.safetensors")
}

/// Rows that follow each other and are held out together: neighbours in time are too much alike for one to test the other.
const HELD_OUT_RUN: usize = 25;

/// The rows of `n` to train on, and the share that is held out, in runs at random places; both ascending. The same for all seeds.
pub(crate) fn hold_out_runs(n: usize, share: f64) -> (Vec<usize>, Vec<usize>) {
    // Of a single run one half would be held out from the other.
    let length = if n > HELD_OUT_RUN { HELD_OUT_RUN } else { n.div_ceil(2).max(1) };
    let runs = n.div_ceil(length);
    let count = ((runs as f64 * share).round() as usize).clamp(usize::from(share > 0.0), runs.saturating_sub(1));
    let chosen = choose(&mut Streams::new(0).stream("held out runs"), runs, count);
    (0..n).partition(|i| chosen.binary_search(&(i / length)).is_err())
}

/// Of `n` target rows, those that the networks of `config` are trained on, and those that are held out to tell when to stop.
pub(crate) fn held_out_rows(n: usize, config: &GeneratorConfig) -> (Vec<usize>, Vec<usize>) {
    let auto = [config.state_steps, config.transition_steps].contains(&Length::Auto);
    hold_out_runs(n, if auto { config.until_done.held_out } else { 0.0 })
}

/// Figures of a network at the end of a cycle, one number per member each. The first one decides when the training is done; the less
/// the better.
pub(crate) type Figures = Vec<(&'static str, Vec<f64>)>;

/// How long a network is trained.
pub(crate) enum Course<'a> {
    /// So many updates.
    Steps(u64),
    /// Until the first of its figures no longer falls.
    UntilDone {
        /// The cycles.
        plan: UntilDone,
        /// Measures the network.
        judge: &'a (dyn Fn(&Trainer) -> Result<Figures> + Sync),
    },
}

/// A network that was trained.
pub(crate) struct Ready {
    /// The network.
    pub model: ScoreModel,
    /// Last reported loss, per member.
    pub loss: Vec<f32>,
    /// What decided at the ends of the cycles; empty where the length was given.
    pub curve: Vec<CycleEnd>,
}

/// Batches of a loss that tells when to stop: 8192 draws of a row, a noise level and noise at 128 rows a batch.
const PROBE_BATCHES: u64 = 64;

/// Trains, and keeps the losses and, where there are cycles, the network at the end of each of them.
pub(crate) fn run(
    trainer: &mut Trainer,
    data: &ScoreData,
    course: &Course,
    checkpoints: &mut Checkpoints,
    metrics: &Mutex<Metrics>,
    name: &str,
    attempt: &Attempt,
) -> Result<Ready> {
    let data = std::slice::from_ref(data);
    let log = |step: u64, figure: &'static str, values: &[f64]| {
        let mut metrics = metrics.lock().unwrap_or_else(PoisonError::into_inner);
        for (m, &value) in values.iter().enumerate() {
            // A metric that cannot be written must not cost the training.
            let _ = metrics.log(name, step, m, [(figure, value)]);
        }
    };
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
        Course::UntilDone { plan, judge } => {
            let judge = |trainer: &Trainer| -> Result<Vec<f64>> {
                let figures = judge(trainer)?;
                figures.iter().for_each(|(figure, values)| log(trainer.steps(), figure, values));
                trainer.model().save(&attempt.file(&cycle_file(name, trainer.steps())))?;
                Ok(figures.into_iter().next().map(|(_, values)| values).unwrap_or_default())
            };
            trainer.train_until_done(data, plan, checkpoints, on_loss, judge)?
        }
    };
    Ok(Ready { model, loss, curve })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn held_out_rows_come_in_runs_and_are_the_share() {
        let (kept, held_out) = hold_out_runs(5000, 0.05);
        assert_eq!((kept.len(), held_out.len()), (4750, 250));
        assert!(held_out.chunks(HELD_OUT_RUN).all(|run| run[0] % HELD_OUT_RUN == 0 && run[24] == run[0] + 24));
        let mut all = [kept, held_out].concat();
        all.sort_unstable();
        assert_eq!(all, (0..5000).collect::<Vec<_>>());
        assert_eq!(hold_out_runs(100, 0.0), ((0..100).collect(), vec![]));
        let (kept, held_out) = hold_out_runs(60, 0.01);
        assert!(!held_out.is_empty() && kept.len() >= 35, "at least one run, never all");
    }
}
