//! The heart of TCE (Algorithm 1, lines 2 to 6): train q_mix and q_tran; sample states under ŷ ~ U(0, y_max), then their
//! successors.
//!
//! Everything is trained on standardised, live dimensions: a dimension without spread in source and target (Ant's 84
//! contact slots) is left out and put back as the constant it is.

use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use tce_base::{Progress, Streams};
use tce_data::Transitions;
use tce_diffusion::{
    Chunks, Condition, DiffusionError, NetworkConfig, Part, Process, Request, Sampler, Schedule, ScoreData, ScoreModel,
    Target, TrainConfig, Trainer, uniform_labels,
};
use tce_nn::{Checkpoints, Device, is_cpu};

use crate::config::GeneratorConfig;
use crate::error::{Error, Result};
use crate::inputs::Inputs;
use crate::metrics::Metrics;
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
    /// Seconds of training, all members together.
    pub seconds: f64,
}

/// What decides the trained networks.
#[derive(Serialize)]
struct TrainingSpec<'a> {
    inputs: crate::inputs::InputSpec,
    seeds: &'a [u64],
    process: Process,
    target: Target,
    state_steps: u64,
    transition_steps: u64,
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
        config: &GeneratorConfig,
        seeds: &[u64],
        root: &std::path::Path,
        device: &Device,
    ) -> Result<(Self, Stage, Trained)> {
        let g = config;
        let spec = TrainingSpec {
            inputs: inputs.spec(g.source_states),
            seeds,
            process: g.process,
            target: g.target,
            state_steps: g.state_steps,
            transition_steps: g.transition_steps,
            batch: g.batch,
            learning_rate: g.learning_rate,
            schedule: g.schedule,
            ema: g.ema,
            balanced: g.balanced,
            source_states: g.source_states,
        };
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
        let (generator, mut trained) = Self::train_now(inputs, config, seeds, device, &attempt)?;
        trained.seconds = started.elapsed().as_secs_f64();
        generator.state.save(&attempt.file(files[0]))?;
        generator.transition.save(&attempt.file(files[1]))?;
        attempt.finish(&files.map(String::from), &trained)?;
        Ok((generator, stage, trained))
    }

    fn train_now(
        inputs: &Inputs,
        config: &GeneratorConfig,
        seeds: &[u64],
        device: &Device,
        attempt: &Attempt,
    ) -> Result<(Self, Trained)> {
        let g = config;
        let members: Vec<_> = seeds.iter().map(|&s| Streams::new(s)).collect();
        let target = &inputs.target.rows;
        let source = if g.source_states { Some(inputs.source_rows()?) } else { None };
        let units = Units::fit(target, source, g.target);
        let d = units.live.len();
        let train = TrainConfig { learning_rate: g.learning_rate, schedule: g.schedule, batch: g.batch, ema: g.ema };
        let (s, s2) = (units.take(&target.observations), units.take(&target.next_observations));
        let target_states = units.state.apply(&s);

        // q_mix: the label says whose state it is (Eq. 5). q_tran: target rows alone. Neither needs the other, so they
        // train side by side where there are two threads.
        let source_states = source.map(|t| units.states(&t.observations)).unwrap_or_default();
        let outputs = units.output.apply(&g.target.encode(&s, &s2));
        let state_data = match source {
            Some(_) => ScoreData::labelled(&source_states, &target_states, d, g.balanced)?,
            None => {
                let condition = Condition::Constant(vec![0.0]);
                ScoreData::new(vec![Part { rows: &target_states, condition }], d, 1, false)?
            }
        };
        let transition_data = ScoreData::conditioned(&outputs, d, &target_states, d)?;
        let mut state = Trainer::new("state", NetworkConfig::new(d, 1), g.process, train, &members, device)?;
        let mut transition = Trainer::new("transition", NetworkConfig::new(d, d), g.process, train, &members, device)?;
        transition.stop_with(&state);
        let (mut kept_state, mut kept_transition) = (attempt.checkpoints("state")?, attempt.checkpoints("transition")?);
        let (state_step, transition_step) = (kept_state.step().unwrap_or(0), kept_transition.step().unwrap_or(0));
        let metrics = Mutex::new(attempt.metrics(|stage, at| match stage {
            "state" => at <= state_step,
            _ => at <= transition_step,
        })?);
        let mut state_run = || run(&mut state, &state_data, g.state_steps, &mut kept_state, &metrics, "state");
        let mut transition_run = || {
            let steps = g.transition_steps;
            run(&mut transition, &transition_data, steps, &mut kept_transition, &metrics, "transition")
        };
        // A GPU has one thread that queues for it.
        let (state_loss, transition_loss) = if is_cpu(device) && rayon::current_num_threads() > 1 {
            std::thread::scope(|scope| {
                let other = scope.spawn(transition_run);
                let state_loss = state_run();
                (state_loss, other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            })
        } else {
            (state_run(), transition_run())
        };
        let (state_loss, transition_loss) = match (state_loss, transition_loss) {
            // The one that diverged is the reason, not the one that was stopped for it.
            (Err(Error::Diffusion(DiffusionError::Interrupted { .. })), Err(reason)) | (Err(reason), _) => {
                return Err(reason);
            }
            (Ok(state), transition) => (state, transition?),
        };
        let trained = Trained { units: units.clone(), state_loss, transition_loss, seconds: 0.0 };
        Ok((Self { units, state: state.model(), transition: transition.model() }, trained))
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
        let outputs = || {
            let (s, s2) = (self.units.take(&target.observations), self.units.take(&target.next_observations));
            self.units.output.apply(&self.units.target.encode(&s, &s2))
        };
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

    /// State pairs `[P, rows, d]` (live dimensions, the data's units): states under ŷ ~ U(0, y_max) and their successors.
    pub fn sample_pairs(
        &self,
        rows: usize,
        config: &GeneratorConfig,
        members: &[Streams],
        target: &Transitions,
        kept: Option<Chunks>,
    ) -> Result<(Vec<f32>, Vec<f32>)> {
        let states = self.sample_states(rows, config.y_max, &config.sampler, members, target, kept)?;
        let successors = self.sample_successors(&states, &config.sampler, members, target, kept)?;
        Ok((states, successors))
    }
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

/// Trains, and keeps the losses; the last ones come back.
pub(crate) fn run(
    trainer: &mut Trainer,
    data: &ScoreData,
    steps: u64,
    checkpoints: &mut Checkpoints,
    metrics: &Mutex<Metrics>,
    name: &str,
) -> Result<Vec<f32>> {
    let mut last = Vec::new();
    trainer.train(std::slice::from_ref(data), steps, checkpoints, |step, losses| {
        last = losses.to_vec();
        if step % 500 == 0 || step == steps {
            let mut metrics = metrics.lock().unwrap_or_else(PoisonError::into_inner);
            for (m, &loss) in losses.iter().enumerate() {
                // A metric that cannot be written must not cost the training.
                let _ = metrics.log(name, step, m, [("loss", loss as f64)]);
            }
        }
    })?;
    Ok(last)
}
