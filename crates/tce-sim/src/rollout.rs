//! Runs many environments in lockstep, so that a policy gets their observations as one batch.

use mujoco_rs::prelude::MjModel;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use tce_base::{Interrupted, Progress, Rng, Streams, interrupted};
use tce_data::{Agent, Shift, Transitions};

use crate::actor::Actor;
use crate::env::{EPISODE_LIMIT, Env};
use crate::models::compiled;
use crate::recording::{Ending, Recording};
use crate::{SimError, StepResult};

/// Options of `collect`.
#[derive(Clone, Copy)]
pub struct CollectOptions<'a> {
    /// Total number of rows.
    pub rows: usize,
    /// Number of environments in lockstep. The rows depend on it (each lane has its own episodes), but not on the
    /// number of threads.
    pub lanes: usize,
    /// The source of random numbers: streams `collect/reset` and `collect/action`, indexed by `lane << 32 | episode`.
    pub streams: Streams,
    /// Where the number of collected rows is reported.
    pub progress: Option<&'a Progress>,
}

impl CollectOptions<'_> {
    /// Options for `rows` rows with 32 lanes.
    pub fn new(rows: usize, streams: Streams) -> Self {
        Self { rows, lanes: 32, streams, progress: None }
    }
}

/// The outcome of one episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// Sum of the rewards, undiscounted.
    pub episode_return: f64,
    /// Number of steps.
    pub length: usize,
    /// Whether the episode was abandoned because the physics blew up.
    pub unstable: bool,
}

/// How the two kinds of rollout handle a step.
trait Lane: Send {
    /// Handles a step (s, a, r, s') and returns how the lane continues. `after` is s'; a reset may overwrite it.
    fn advance(&mut self, env: &mut Env, step: Step<'_>, rng: &mut Rng) -> Next;
}

/// How a lane continues.
#[derive(Clone, Copy, PartialEq)]
enum Next {
    /// With the next step of the episode.
    Step,
    /// With a new episode; `after` is its first observation.
    Episode,
    /// It stops.
    Leave,
}

struct Step<'a> {
    before: &'a [f32],
    action: &'a [f32],
    after: &'a mut [f32],
    result: StepResult,
}

/// The lanes that are still running, in rows: all inputs of an actor are contiguous in memory.
struct Lockstep<'a, A: Actor, L> {
    agent: Agent,
    actor: &'a A,
    lanes: Vec<(Env, L)>,
    memories: Vec<A::Memory>,
    rngs: Vec<Rng>,
    observations: Vec<f32>,
    next: Vec<f32>,
    actions: Vec<f32>,
}

impl<'a, A: Actor, L: Lane> Lockstep<'a, A, L> {
    fn new(agent: Agent, model: &Arc<MjModel>, actor: &'a A, starts: impl Iterator<Item = (L, Rng, Rng)>) -> Self {
        let (obs_dim, act_dim) = agent.dims();
        let mut lanes = Vec::new();
        let mut rngs = Vec::new();
        let mut observations = Vec::new();
        for (lane, mut reset, action) in starts {
            let mut env = Env::with_model(agent, model.clone());
            let row = observations.len();
            observations.resize(row + obs_dim, 0.0);
            env.reset(&mut reset, &mut observations[row..]);
            lanes.push((env, lane));
            rngs.push(action);
        }
        let rows = lanes.len();
        Self {
            agent,
            actor,
            lanes,
            memories: (0..rows).map(|_| actor.start()).collect(),
            rngs,
            observations,
            next: vec![0.0; rows * obs_dim],
            actions: vec![0.0; rows * act_dim],
        }
    }

    /// Runs one step of every lane. Finished lanes are moved, in their order, to `finished`.
    fn tick(&mut self, finished: &mut Vec<L>) -> Result<(), SimError> {
        let (obs_dim, act_dim) = self.agent.dims();
        let actor = self.actor;
        let rows = self.lanes.len();
        let observations = &mut self.observations[..rows * obs_dim];
        let next = &mut self.next[..rows * obs_dim];
        let actions = &mut self.actions[..rows * act_dim];
        actor.act(observations, &mut self.memories, &mut self.rngs, actions);
        if let Some(at) = actions.iter().position(|a| !a.is_finite()) {
            return Err(SimError::NotFinite { what: "the actor's actions", row: at / act_dim, value: actions[at] });
        }
        let running: Vec<bool> = self
            .lanes
            .par_iter_mut()
            .zip(self.memories.par_iter_mut().zip(self.rngs.par_iter_mut()))
            .zip(observations.par_chunks_exact_mut(obs_dim).zip(next.par_chunks_exact_mut(obs_dim)))
            .zip(actions.par_chunks_exact(act_dim))
            .map(|((((env, lane), (memory, rng)), (before, after)), action)| {
                let result = env.step(action, after);
                let reward = result.reward;
                let next = lane.advance(env, Step { before, action, after, result }, rng);
                match next {
                    Next::Step => actor.reward(memory, reward),
                    Next::Episode => *memory = actor.start(),
                    Next::Leave => {}
                }
                next != Next::Leave
            })
            .collect();
        std::mem::swap(&mut self.observations, &mut self.next);
        if running.iter().all(|&r| r) {
            return Ok(());
        }
        let mut kept = 0;
        for (row, &runs) in running.iter().enumerate() {
            if runs {
                self.observations.copy_within(row * obs_dim..(row + 1) * obs_dim, kept * obs_dim);
                kept += 1;
            }
        }
        let mut flags = running.iter();
        self.rngs.retain(|_| *flags.next().expect("one flag per row"));
        let mut flags = running.iter();
        self.memories.retain(|_| *flags.next().expect("one flag per row"));
        let done = self.lanes.extract_if(.., {
            let mut flags = running.iter();
            move |_| !*flags.next().expect("one flag per row")
        });
        finished.extend(done.map(|(_, lane)| lane));
        Ok(())
    }
}

/// One lane of a collection: runs one episode after another until its quota is reached.
struct Collector {
    index: u64,
    quota: usize,
    episode: u64,
    steps: usize,
    unstable: usize,
    streams: Streams,
    table: Transitions,
}

impl Collector {
    fn stream(&self, name: &str) -> Rng {
        self.streams.indexed(name, self.index << 32 | self.episode)
    }
}

impl Lane for Collector {
    fn advance(&mut self, env: &mut Env, step: Step<'_>, rng: &mut Rng) -> Next {
        let Step { before, action, after, result } = step;
        let mut over = result.unstable;
        if result.unstable {
            self.unstable += 1;
            // The episode ends at the row before, if there is one.
            if self.steps > 0 {
                *self.table.timeouts.last_mut().expect("this episode's rows") = true;
            }
        } else {
            self.steps += 1;
            let full = self.table.len() + 1 == self.quota;
            let timeout = !result.terminal && (self.steps == EPISODE_LIMIT || full);
            self.table.push(before, action, result.reward as f32, after, result.terminal, timeout);
            over = result.terminal || timeout;
        }
        if self.table.len() == self.quota {
            return Next::Leave;
        }
        if !over {
            return Next::Step;
        }
        self.episode += 1;
        self.steps = 0;
        env.reset(&mut self.stream("collect/reset"), after);
        *rng = self.stream("collect/action");
        Next::Episode
    }
}

/// Rolls out `actor` until there are `options.rows` transitions, sorted by lane and in time order within a lane. The
/// last episode of a lane is cut with a time-out mark. The bytes are the same at any number of threads.
///
/// Steps in which the physics blew up are dropped, and their episode ends with a time-out.
///
/// # Errors
/// If options are out of range, the actor returns a number that is not finite, the physics blow up repeatedly, or the
/// user interrupts.
pub fn collect<A: Actor>(
    agent: Agent,
    shift: Shift,
    actor: &A,
    options: &CollectOptions<'_>,
) -> Result<Transitions, SimError> {
    if options.lanes == 0 {
        return Err(SimError::Option { option: "lanes", found: 0, expected: "at least 1" });
    }
    let model = compiled(agent, shift)?;
    let (obs_dim, act_dim) = agent.dims();
    let lanes = options.lanes.min(options.rows);
    let starts = (0..lanes).map(|lane| {
        let quota = options.rows / lanes + usize::from(lane < options.rows % lanes);
        let collector = Collector {
            index: lane as u64,
            quota,
            episode: 0,
            steps: 0,
            unstable: 0,
            streams: options.streams,
            table: Transitions::with_capacity(obs_dim, act_dim, quota),
        };
        let (reset, action) = (collector.stream("collect/reset"), collector.stream("collect/action"));
        (collector, reset, action)
    });
    let mut lockstep = Lockstep::new(agent, &model, actor, starts);
    let mut finished = Vec::with_capacity(lanes);
    while !lockstep.lanes.is_empty() {
        if interrupted() {
            return Err(Interrupted::nothing_kept().into());
        }
        let rows = lockstep.lanes.len() as u64;
        lockstep.tick(&mut finished)?;
        if let Some(progress) = options.progress {
            progress.inc(rows);
        }
        if let Some((_, lane)) = lockstep.lanes.iter().find(|(_, lane)| lane.unstable > 100 + lane.quota / 10) {
            return Err(SimError::Unstable { agent, shift, count: lane.unstable, rows: lane.table.len() });
        }
    }
    finished.sort_by_key(|lane| lane.index);
    let mut out = Transitions::with_capacity(obs_dim, act_dim, options.rows);
    for lane in finished {
        out.extend(&lane.table);
    }
    Ok(out)
}

/// One episode of an evaluation.
struct Evaluator {
    index: usize,
    result: EpisodeResult,
    recording: Option<Recording>,
}

impl Evaluator {
    /// How the episode ended at this step; `None` if it continues.
    fn ending(&self, step: StepResult) -> Option<Ending> {
        match step {
            StepResult { unstable: true, .. } => Some(Ending::Unstable),
            StepResult { terminal: true, .. } => Some(Ending::Fell),
            _ => (self.result.length == EPISODE_LIMIT).then_some(Ending::TimeLimit),
        }
    }
}

impl Lane for Evaluator {
    fn advance(&mut self, env: &mut Env, step: Step<'_>, _: &mut Rng) -> Next {
        let result = &mut self.result;
        if step.result.unstable {
            result.unstable = true;
        } else {
            result.episode_return += step.result.reward;
            result.length += 1;
            if let Some(recording) = &mut self.recording {
                recording.push(env.qpos(), result.episode_return);
            }
        }
        let ending = self.ending(step.result);
        if let (Some(recording), Some(ending)) = (&mut self.recording, ending) {
            recording.ending = ending;
        }
        if ending.is_some() { Next::Leave } else { Next::Step }
    }
}

/// Rolls out `episodes` whole episodes in lockstep and returns their results in order. Random numbers come from the
/// streams `evaluate/reset` and `evaluate/action`, indexed by episode. Two policies evaluated with the same streams
/// therefore start from the same states. `stop` is called before every step.
///
/// # Errors
/// If the actor returns a number that is not finite, or `stop` returns true.
pub fn evaluate<A: Actor>(
    agent: Agent,
    shift: Shift,
    actor: &A,
    episodes: usize,
    streams: Streams,
    stop: impl Fn() -> bool,
) -> Result<Vec<EpisodeResult>, SimError> {
    let lanes = evaluate_lanes(agent, shift, actor, episodes, streams, Record::Nothing, stop)?;
    Ok(lanes.into_iter().map(|lane| lane.result).collect())
}

/// [`evaluate`], with a recording of the first episode. The recording does not change the results.
///
/// # Errors
/// As [`evaluate`], and if `episodes` is 0.
pub fn evaluate_recorded<A: Actor>(
    agent: Agent,
    shift: Shift,
    actor: &A,
    episodes: usize,
    streams: Streams,
    stop: impl Fn() -> bool,
) -> Result<(Vec<EpisodeResult>, Recording), SimError> {
    let mut lanes = evaluate_lanes(agent, shift, actor, episodes, streams, Record::First, stop)?;
    let recording = lanes.first_mut().and_then(|lane| lane.recording.take());
    let recording = recording.ok_or(SimError::Option { option: "episodes", found: 0, expected: "at least 1" })?;
    Ok((lanes.into_iter().map(|lane| lane.result).collect(), recording))
}

/// Of which episodes there are recordings.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Record {
    Nothing,
    First,
}

fn evaluate_lanes<A: Actor>(
    agent: Agent,
    shift: Shift,
    actor: &A,
    episodes: usize,
    streams: Streams,
    record: Record,
    stop: impl Fn() -> bool,
) -> Result<Vec<Evaluator>, SimError> {
    let model = compiled(agent, shift)?;
    let starts = (0..episodes).map(|index| {
        let result = EpisodeResult { episode_return: 0.0, length: 0, unstable: false };
        let recording = (record == Record::First && index == 0).then(|| Recording::new(agent, shift));
        let i = index as u64;
        let lane = Evaluator { index, result, recording };
        (lane, streams.indexed("evaluate/reset", i), streams.indexed("evaluate/action", i))
    });
    let mut lockstep = Lockstep::new(agent, &model, actor, starts);
    for (env, lane) in &mut lockstep.lanes {
        if let Some(recording) = &mut lane.recording {
            recording.push(env.qpos(), 0.0);
        }
    }
    let mut finished = Vec::with_capacity(episodes);
    while !lockstep.lanes.is_empty() {
        if stop() {
            return Err(Interrupted::nothing_kept().into());
        }
        lockstep.tick(&mut finished)?;
    }
    finished.sort_by_key(|lane| lane.index);
    Ok(finished)
}
