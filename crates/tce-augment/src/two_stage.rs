//! The heart of TCE (Algorithm 1, lines 2 to 6): train q_mix and q_tran; sample states under ŷ ~ U(0, y_max), then their
//! successors.
//!
//! Everything is trained on standardised, live dimensions: a dimension without spread in source and target (Ant's 84
//! contact slots) is left out and put back as the constant it is.

use serde::{Deserialize, Serialize};
use tce_base::{OrAuto, Streams};
use tce_data::{Support, Transitions};
use tce_diffusion::{
    Balance, Chunks, Condition, CycleEnd, DiffusionError, NetworkConfig, Part, Request, Sampler, ScoreData, ScoreModel,
    TrainConfig, Trainer, uniform_labels,
};
use tce_learn::{LabelModels, rmse};
use tce_nn::is_cpu;

use crate::config::GeneratorConfig;
use crate::error::{Error, Result};
use crate::score_training::{Course, Metrics, Ready, held_out_rows, progress, run, start_rows};
use crate::units::Units;
use crate::work::Work;

/// Trained score networks of a whole population, with the maps between their units and the data's.
pub struct Generator {
    /// Maps of the networks.
    pub units: Units,
    /// q_mix.
    pub state: ScoreModel,
    /// q_tran.
    pub transition: ScoreModel,
}

/// The results of training the networks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trained {
    /// The maps.
    pub units: Units,
    /// Last reported loss of q_mix, per member; no number where a member diverged after it was done.
    #[serde(deserialize_with = "tce_diffusion::or_nan")]
    pub state_loss: Vec<f32>,
    /// The same of q_tran.
    #[serde(deserialize_with = "tce_diffusion::or_nan")]
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

/// How rows are drawn.
#[derive(Clone, Copy)]
pub struct Draw<'a> {
    /// The sampler.
    pub sampler: &'a Sampler,
    /// The members' random streams.
    pub members: &'a [Streams],
    /// The target's rows, where a process that starts at data starts (`start = "data"`, which is in no preset). So does q_mix, which has
    /// learned source states, too. That is a choice: it starts at target states whatever ŷ is, and ŷ alone leads away from them.
    pub target: &'a Transitions,
    /// Where sampled chunks are kept, if they are.
    pub kept: Option<Chunks<'a>>,
    /// What drawn states and successors respect, if anything.
    pub support: Option<&'a Support>,
}

impl<'a> Draw<'a> {
    /// Nothing is kept, nothing respected.
    pub fn new(sampler: &'a Sampler, members: &'a [Streams], target: &'a Transitions) -> Self {
        Self { sampler, members, target, kept: None, support: None }
    }

    /// The same, but drawn rows respect `support`.
    pub fn within(self, support: Option<&'a Support>) -> Self {
        Self { support, ..self }
    }

    /// The same, but sampled chunks are kept.
    pub fn keeping(self, chunks: Chunks<'a>) -> Self {
        Self { kept: Some(chunks), ..self }
    }

    /// Live `rows` within the support.
    fn respected(&self, units: &Units, rows: Vec<f32>) -> Vec<f32> {
        match self.support {
            Some(support) => units.within(support, &rows),
            None => rows,
        }
    }
}

impl Generator {
    /// Trains both networks on the rows of `target`, and q_mix on the states of `source` as well unless `config` has it otherwise. Where
    /// the length of q_tran is `"auto"`, the actions of `labels` tell when it is done.
    ///
    /// # Errors
    /// If the source or the label models are missing where they are needed, a network diverges, or the user interrupts.
    pub fn fit(
        source: Option<&Transitions>,
        target: &Transitions,
        config: &GeneratorConfig,
        labels: Option<&LabelModels>,
        work: &Work,
    ) -> Result<(Self, Trained)> {
        let source = match (config.source_states, source) {
            (false, _) => None,
            (true, None) => {
                return Err(Error::Failed("q_mix needs source rows; give some, or set source_states = false".into()));
            }
            (true, source) => source,
        };
        let units = Units::fit(target, source, config.target);
        let tables = Tables::new(&units, source, target, config);
        let (state_data, transition_data, held_out) = (tables.state()?, tables.transition()?, tables.held_out()?);
        let [held_out_state, held_out_transition] = [0, 1].map(|k| held_out.as_ref().map(|data| &data[k]));
        let members = work.streams();
        let state_losses = |trainer: &Trainer| losses(trainer, held_out_state, &state_data);
        // What a learner will see are actions, so that they decide: the held-out loss of q_tran rises long before they are right.
        let successor_losses = |trainer: &Trainer| -> Result<Metrics> {
            let labels =
                labels.ok_or_else(|| Error::Failed("q_tran cannot be measured without label models".into()))?;
            let draw = Draw::new(&config.sampler, &members, target);
            let errors = implied_errors(&units, &trainer.model(), labels, &tables.held_out, &draw)?;
            let mut metrics = vec![("implied_action_error", errors)];
            metrics.extend(losses(trainer, held_out_transition, &transition_data)?);
            Ok(metrics)
        };
        let state_course = match config.state_steps {
            OrAuto::Given(steps) => Course::Steps(steps),
            OrAuto::Auto => Course::UntilDone { plan: config.until_done.state(), criterion: &state_losses },
        };
        let transition_course = match config.transition_steps {
            OrAuto::Given(steps) => Course::Steps(steps),
            OrAuto::Auto => Course::UntilDone { plan: config.until_done.transition(), criterion: &successor_losses },
        };
        let (state, transition) =
            train_both([&state_data, &transition_data], [&state_course, &transition_course], config, work)?;
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

    /// Samples `rows` states per member under ŷ ~ U(0, `y_max`): live dimensions in the data's units, `[P, rows, d]`.
    ///
    /// # Errors
    /// If the user interrupts, or a chunk cannot be kept.
    pub fn sample_states(&self, rows: usize, y_max: f32, draw: &Draw) -> Result<Vec<f32>> {
        let Draw { sampler, members, target, kept, .. } = *draw;
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
        Ok(draw.respected(&self.units, states))
    }

    /// Samples a successor for every state (live dimensions, the data's units, `[P, rows, d]`).
    ///
    /// # Errors
    /// As for [`Self::sample_states`].
    pub fn sample_successors(&self, states: &[f32], draw: &Draw) -> Result<Vec<f32>> {
        let Draw { sampler, members, target, kept, .. } = *draw;
        let d = self.units.live.len();
        let rows = states.len() / (d * members.len());
        let condition = self.units.state.apply(states);
        let outputs = || self.units.outputs(target);
        let start = start_rows(self.transition.process(), outputs, d, rows, members, "successor");
        let progress = progress("sample successors", rows * members.len(), sampler);
        let request =
            Request { name: "successor", rows, condition: &condition, guidance: None, start: start.as_deref(), kept };
        let mut out = self.transition.sample(request, sampler, members, Some(&progress))?;
        progress.finish();
        self.units.successors(states, &mut out);
        Ok(draw.respected(&self.units, out))
    }

    /// State pairs `[P, rows, d]` (live dimensions, the data's units): states under ŷ ~ U(0, `y_max`) and their successors.
    ///
    /// # Errors
    /// As for [`Self::sample_states`].
    pub fn sample_pairs(&self, rows: usize, y_max: f32, draw: &Draw) -> Result<(Vec<f32>, Vec<f32>)> {
        let states = self.sample_states(rows, y_max, draw)?;
        let successors = self.sample_successors(&states, draw)?;
        Ok((states, successors))
    }
}

/// Training data of the two networks, in their units, and the held-out rows that decide when to stop.
struct Tables {
    /// Live dimensions.
    dims: usize,
    balance: Balance,
    /// `[rows, dims]`; None where q_mix sees target states alone.
    source_states: Option<Vec<f32>>,
    states: Vec<f32>,
    outputs: Vec<f32>,
    held_out_states: Vec<f32>,
    held_out_outputs: Vec<f32>,
    held_out: Transitions,
}

impl Tables {
    fn new(units: &Units, source: Option<&Transitions>, target: &Transitions, config: &GeneratorConfig) -> Self {
        let dims = units.live.len();
        let (kept, held_out) = held_out_rows(target.len(), config);
        let pick = |rows: &[f32], of: &[usize]| -> Vec<f32> {
            of.iter().flat_map(|&i| rows[i * dims..(i + 1) * dims].iter().copied()).collect()
        };
        let (states, outputs) = (units.states(&target.observations), units.outputs(target));
        Self {
            dims,
            balance: if config.balanced { Balance::Parts } else { Balance::Rows },
            source_states: source.map(|t| units.states(&t.observations)),
            states: pick(&states, &kept),
            outputs: pick(&outputs, &kept),
            held_out_states: pick(&states, &held_out),
            held_out_outputs: pick(&outputs, &held_out),
            held_out: target.select(&held_out),
        }
    }

    /// Of q_mix: the label says whose state it is (Eq. 5).
    fn state(&self) -> Result<ScoreData<'_>> {
        Ok(match &self.source_states {
            Some(source) => ScoreData::labelled(source, &self.states, self.dims, self.balance)?,
            None => target_states(&self.states, self.dims)?,
        })
    }

    /// Of q_tran: target rows alone.
    fn transition(&self) -> Result<ScoreData<'_>> {
        Ok(ScoreData::conditioned(&self.outputs, self.dims, &self.states, self.dims)?)
    }

    /// Held-out data of q_mix and q_tran, if any rows are held out.
    fn held_out(&self) -> Result<Option<[ScoreData<'_>; 2]>> {
        if self.held_out.is_empty() {
            return Ok(None);
        }
        let state = target_states(&self.held_out_states, self.dims)?;
        let transition = ScoreData::conditioned(&self.held_out_outputs, self.dims, &self.held_out_states, self.dims)?;
        Ok(Some([state, transition]))
    }
}

/// States under the target's label.
fn target_states(rows: &[f32], dims: usize) -> Result<ScoreData<'_>> {
    let condition = Condition::Constant(vec![0.0]);
    Ok(ScoreData::new(vec![Part { rows, condition }], dims, 1, Balance::Rows)?)
}

/// Batches of a loss that tells when to stop: 8192 draws of a row, a noise level and noise at 128 rows a batch.
const PROBE_BATCHES: u64 = 64;

/// The losses of a network on rows that it does not see, if there are any, and on those that it sees.
fn losses(trainer: &Trainer, held_out: Option<&ScoreData>, seen: &ScoreData) -> Result<Metrics> {
    let of = |data: &ScoreData| trainer.loss_on(std::slice::from_ref(data), PROBE_BATCHES);
    let held_out = held_out.map(of).transpose()?;
    Ok(held_out.map(|l| ("held_out_loss", l)).into_iter().chain([("training_loss", of(seen)?)]).collect())
}

/// Trains q_mix and q_tran. Neither needs the other, so they train side by side where there are two threads.
fn train_both(
    data: [&ScoreData; 2],
    courses: [&Course; 2],
    config: &GeneratorConfig,
    work: &Work,
) -> Result<(Ready, Ready)> {
    let GeneratorConfig { learning_rate, schedule, batch, ema, process, .. } = *config;
    let train = TrainConfig { learning_rate, schedule, batch, ema };
    let (members, d) = (work.streams(), data[0].dims());
    let trainer =
        |name, condition| Trainer::new(name, NetworkConfig::new(d, condition), process, train, &members, work.device);
    let (mut state, mut transition) = (trainer("state", 1)?, trainer("transition", d)?);
    transition.stop_with(&state);
    let keeper = work.keeper;
    let (mut kept_state, mut kept_transition) = (keeper.checkpoints("state")?, keeper.checkpoints("transition")?);
    keeper.begin(&[("state", kept_state.step().unwrap_or(0)), ("transition", kept_transition.step().unwrap_or(0))])?;
    let mut state_run = || run(&mut state, data[0], courses[0], &mut kept_state, keeper, "state");
    let mut transition_run = || run(&mut transition, data[1], courses[1], &mut kept_transition, keeper, "transition");
    // A GPU has one thread that queues for it.
    let results = if is_cpu(work.device) && rayon::current_num_threads() > 1 {
        std::thread::scope(|scope| {
            let other = scope.spawn(transition_run);
            let state = state_run();
            (state, other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        })
    } else {
        (state_run(), transition_run())
    };
    match results {
        // The one that diverged is the reason, not the one that was stopped for it.
        (Err(Error::Diffusion(DiffusionError::Interrupted(_))), Err(reason)) | (Err(reason), _) => Err(reason),
        (Ok(state), transition) => Ok((state, transition?)),
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
    draw: &Draw,
) -> Result<Vec<f64>> {
    let Draw { sampler, members, target, .. } = *draw;
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
    let (whole, own) = (rows.observations.repeat(PROBE_DRAWS), rows.actions.repeat(PROBE_DRAWS));
    let error = |(m, out): (usize, &mut [f32])| {
        units.successors(&states, out);
        Ok(rmse(&models.actions(m, &whole, &units.put_back(out))?, &own))
    };
    out.chunks_exact_mut(n * d).enumerate().map(error).collect()
}
