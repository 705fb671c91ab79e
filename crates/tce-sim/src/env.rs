//! One environment: reset, step, observation, reward and the end of an episode.
//!
//! Everything here follows OpenAI Gym's v2 environments (Ant: contact forces always zero), which produced the public
//! data. The numbers were measured by replaying those data (`shared/reference/environments.md`).

use std::sync::Arc;

use mujoco_rs::prelude::{MjData, MjModel, MjtObjBase, MjtWarning};
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use tce_base::Rng;
use tce_data::{Agent, Shift};

use crate::SimError;
use crate::models::compiled;

/// Number of steps after which an episode is cut (a time-out, not a terminal).
pub const EPISODE_LIMIT: usize = 1000;

/// Differences between the robots other than their models.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Task {
    /// MuJoCo steps per environment step.
    frame_skip: usize,
    /// Number of leading coordinates that the observation leaves out (x; for Ant also y).
    pub(crate) hidden: usize,
    /// Observed velocities are clipped to this magnitude.
    pub(crate) velocity_clip: Option<f64>,
    /// Reward for every step.
    alive: f64,
    /// Weight of the summed squared actions.
    control_cost: f64,
    /// Half width of the uniform noise on the coordinates at a reset.
    position_noise: f64,
    /// Noise on the velocities at a reset.
    velocity_noise: VelocityNoise,
}

#[derive(Clone, Copy, Debug)]
enum VelocityNoise {
    /// Uniform with this half width.
    Uniform(f64),
    /// Normal with this standard deviation.
    Normal(f64),
}

pub(crate) fn task(agent: Agent) -> Task {
    let legged = Task {
        frame_skip: 4,
        hidden: 1,
        velocity_clip: Some(10.0),
        alive: 1.0,
        control_cost: 1e-3,
        position_noise: 0.005,
        velocity_noise: VelocityNoise::Uniform(0.005),
    };
    let crawling = Task {
        frame_skip: 5,
        hidden: 1,
        velocity_clip: None,
        alive: 0.0,
        control_cost: 0.1,
        position_noise: 0.1,
        velocity_noise: VelocityNoise::Normal(0.1),
    };
    match agent {
        Agent::HalfCheetah => crawling,
        Agent::Hopper | Agent::Walker2d => legged,
        Agent::Ant => Task { hidden: 2, alive: 1.0, control_cost: 0.5, ..crawling },
    }
}

/// The result of one step, apart from the next observation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepResult {
    /// Reward.
    pub reward: f64,
    /// Whether the episode ended by the robot's rule. The limit of [`EPISODE_LIMIT`] steps does not count here.
    pub terminal: bool,
    /// Whether the physics blew up (MuJoCo found a non-finite or huge number and reset the robot). The step then does
    /// not follow the environment's dynamics: discard it and end the episode.
    pub unstable: bool,
}

/// One simulated robot. Environments share their compiled model; each has its own state.
pub struct Env {
    agent: Agent,
    task: Task,
    data: MjData<Arc<MjModel>>,
    /// Seconds per step.
    dt: f64,
    torso: usize,
    /// The x from which the next reward is measured. For Ant that is the torso body's position after the last RK4
    /// stage, which lags behind the coordinate: the original environment reads this value.
    x: f64,
}

impl Env {
    /// A robot at rest. Call [`Env::reset`] or [`Env::set_state`] before stepping.
    ///
    /// # Errors
    /// See [`compiled`].
    pub fn new(agent: Agent, shift: Shift) -> Result<Self, SimError> {
        Ok(Self::with_model(agent, compiled(agent, shift)?))
    }

    /// A robot whose model is already compiled.
    pub(crate) fn with_model(agent: Agent, model: Arc<MjModel>) -> Self {
        let task = task(agent);
        let torso = model.name_to_id(MjtObjBase::mjOBJ_BODY, "torso").expect("every robot has a torso");
        let dt = seconds_per_step(agent, &model);
        Self { agent, task, data: MjData::new(model), dt, torso, x: 0.0 }
    }

    /// The robot's agent.
    pub fn agent(&self) -> Agent {
        self.agent
    }

    /// Seconds per step.
    pub fn dt(&self) -> f64 {
        self.dt
    }

    /// All coordinates, including those that the observation leaves out.
    pub fn qpos(&self) -> &[f64] {
        self.data.qpos()
    }

    /// All velocities, not clipped.
    pub fn qvel(&self) -> &[f64] {
        self.data.qvel()
    }

    /// Starts an episode from the rest pose with noise. Fills `obs`, which has the agent's observation dimension.
    pub fn reset(&mut self, rng: &mut Rng, obs: &mut [f32]) {
        self.data.reset();
        let width = self.task.position_noise;
        for q in self.data.qpos_mut() {
            *q += rng.random_range(-width..width);
        }
        if self.agent == Agent::Ant {
            let quaternion = &mut self.data.qpos_mut()[3..7];
            let norm = quaternion.iter().map(|q| q * q).sum::<f64>().sqrt();
            quaternion.iter_mut().for_each(|q| *q /= norm);
        }
        for v in self.data.qvel_mut() {
            *v = match self.task.velocity_noise {
                VelocityNoise::Uniform(width) => rng.random_range(-width..width),
                VelocityNoise::Normal(deviation) => {
                    let z: f64 = StandardNormal.sample(rng);
                    deviation * z
                }
            };
        }
        self.data.forward();
        self.x = self.data.qpos()[0];
        self.observe(obs);
    }

    /// Puts the robot into the state that `obs` describes. Values not in `obs` are set to zero: the root's x (for Ant
    /// also y), which does not affect the dynamics, and the solver's warm start. Velocities that the observation
    /// clipped are set to the clipping bound.
    ///
    /// # Panics
    /// If `obs` does not have the agent's dimension.
    pub fn set_state(&mut self, obs: &[f32]) {
        assert_eq!(obs.len(), self.agent.dims().0, "observation dimension of {}", self.agent);
        self.data.reset();
        let hidden = self.task.hidden;
        let qpos = self.data.qpos_mut();
        qpos[..hidden].fill(0.0);
        let seen = qpos.len() - hidden;
        widen(&mut qpos[hidden..], obs);
        widen(self.data.qvel_mut(), &obs[seen..]);
        self.x = 0.0;
    }

    /// The velocities, for changes before a step.
    pub(crate) fn qvel_mut(&mut self) -> &mut [f64] {
        self.data.qvel_mut()
    }

    /// The lag of Ant's torso position behind its coordinate, m; zero for the others.
    pub(crate) fn lag(&self) -> f64 {
        self.x - self.data.qpos()[0]
    }

    /// Sets the lag for the next reward (see [`Env::lag`]).
    pub(crate) fn set_lag(&mut self, lag: f64) {
        self.x = self.data.qpos()[0] + lag;
    }

    /// Applies `action` (clamped to [-1, 1] by the motors) for one step and fills `obs` with the next observation.
    ///
    /// # Panics
    /// If `action` or `obs` does not have the agent's dimension.
    pub fn step(&mut self, action: &[f32], obs: &mut [f32]) -> StepResult {
        assert_eq!(action.len(), self.agent.dims().1, "action dimension of {}", self.agent);
        widen(self.data.ctrl_mut(), action);
        for _ in 0..self.task.frame_skip {
            self.data.step();
        }
        let before = self.x;
        self.x = if self.agent == Agent::Ant { self.data.xpos()[self.torso][0] } else { self.data.qpos()[0] };
        let squares: f64 = action.iter().map(|&a| a as f64 * a as f64).sum();
        let reward = (self.x - before) / self.dt + self.task.alive - self.task.control_cost * squares;
        self.observe(obs);
        let terminal = is_terminal(self.agent, &self.data.qpos()[self.task.hidden..], self.data.qvel());
        let warnings = self.data.warning();
        let unstable = [MjtWarning::mjWARN_BADQPOS, MjtWarning::mjWARN_BADQVEL, MjtWarning::mjWARN_BADQACC]
            .iter()
            .any(|&w| warnings[w as usize].number > 0);
        StepResult { reward, terminal, unstable }
    }

    /// Writes the observation of the current state.
    ///
    /// # Panics
    /// If `obs` does not have the agent's dimension.
    pub fn observe(&self, obs: &mut [f32]) {
        assert_eq!(obs.len(), self.agent.dims().0, "observation dimension of {}", self.agent);
        let positions = &self.data.qpos()[self.task.hidden..];
        let velocities = self.data.qvel();
        // Ant's observation ends with 84 contact forces, which are zero in the public data. As in the MuJoCo versions
        // that produced these data, `mj_rnePostConstraint` is not called.
        obs.fill(0.0);
        for (o, &q) in obs.iter_mut().zip(positions) {
            *o = q as f32;
        }
        for (o, &v) in obs[positions.len()..].iter_mut().zip(velocities) {
            *o = self.task.velocity_clip.map_or(v, |clip| v.clamp(-clip, clip)) as f32;
        }
    }
}

/// Seconds per step of `agent`'s environments with this model.
pub(crate) fn seconds_per_step(agent: Agent, model: &MjModel) -> f64 {
    model.opt().timestep * task(agent).frame_skip as f64
}

/// Copies the leading numbers of `from` into `to`.
fn widen(to: &mut [f64], from: &[f32]) {
    for (t, &f) in to.iter_mut().zip(from) {
        *t = f.into();
    }
}

/// The robots' rules for the end of an episode, applied to the state after a step: observed coordinates and all
/// velocities. If a tested value is NaN, the state is terminal.
fn is_terminal(agent: Agent, positions: &[f64], velocities: &[f64]) -> bool {
    let finite = || positions.iter().chain(velocities).all(|x| x.is_finite());
    let height = positions[0];
    let healthy = match agent {
        Agent::HalfCheetah => true,
        Agent::Hopper => {
            let bounded = positions[1..].iter().chain(velocities).all(|x| x.abs() < 100.0);
            finite() && bounded && height > 0.7 && positions[1].abs() < 0.2
        }
        Agent::Walker2d => height > 0.8 && height < 2.0 && positions[1].abs() < 1.0,
        Agent::Ant => finite() && (0.2..=1.0).contains(&height),
    };
    !healthy
}

/// Number of coordinates in an observation.
pub(crate) fn observed_positions(agent: Agent) -> usize {
    match agent {
        Agent::HalfCheetah | Agent::Walker2d => 8,
        Agent::Hopper => 5,
        Agent::Ant => 13,
    }
}

/// Number of velocities in an observation.
pub(crate) fn observed_velocities(agent: Agent) -> usize {
    match agent {
        Agent::HalfCheetah | Agent::Walker2d => 9,
        Agent::Hopper => 6,
        Agent::Ant => 14,
    }
}

/// Whether the robot's rule ends the episode at `next_obs`. It needs no simulator: for generated transitions.
///
/// # Panics
/// If `next_obs` does not have the agent's dimension.
pub fn terminal_rule(agent: Agent, next_obs: &[f32]) -> bool {
    assert_eq!(next_obs.len(), agent.dims().0, "observation dimension of {agent}");
    let mut state = [0.0; 27];
    let positions = observed_positions(agent);
    let state = &mut state[..positions + observed_velocities(agent)];
    widen(state, next_obs);
    is_terminal(agent, &state[..positions], &state[positions..])
}
