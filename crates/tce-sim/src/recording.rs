//! Records one episode so that it can be drawn afterwards.
//!
//! Only coordinates are stored. The positions of the limbs are computed again when a picture is drawn, in a separate
//! state. Computing them in the running simulation would change its next step (Ant's reward reads what the last
//! integration stage left).

use serde::{Deserialize, Serialize};
use tce_data::{Agent, Shift};

/// How an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ending {
    /// By the robot's rule: the robot fell, or left the states that the rule allows.
    Fell,
    /// At the limit of [`crate::EPISODE_LIMIT`] steps.
    TimeLimit,
    /// The physics blew up.
    Unstable,
}

/// One episode: the robot's coordinates after every step.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// The robot.
    pub agent: Agent,
    /// The domain.
    pub shift: Shift,
    /// How the episode ended.
    pub ending: Ending,
    coordinates: usize,
    poses: Vec<f64>,
    returns: Vec<f64>,
}

impl Recording {
    /// An empty recording.
    pub(crate) fn new(agent: Agent, shift: Shift) -> Self {
        Self { agent, shift, ending: Ending::TimeLimit, coordinates: 0, poses: Vec::new(), returns: Vec::new() }
    }

    /// Adds the state after a step; the first state is the one after the reset.
    pub(crate) fn push(&mut self, qpos: &[f64], episode_return: f64) {
        self.coordinates = qpos.len();
        self.poses.extend_from_slice(qpos);
        self.returns.push(episode_return);
    }

    /// Number of steps.
    pub fn length(&self) -> usize {
        self.returns.len() - 1
    }

    /// The coordinates after `step` steps.
    pub fn pose(&self, step: usize) -> &[f64] {
        &self.poses[step * self.coordinates..(step + 1) * self.coordinates]
    }

    /// The sum of the rewards of the first `step` steps.
    pub fn return_at(&self, step: usize) -> f64 {
        self.returns[step]
    }
}
