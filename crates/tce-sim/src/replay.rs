//! Compares stored transitions with the simulator.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_base::{Interrupted, Progress, interrupted};
use tce_data::{Agent, Episode, Shift, Transitions};

use crate::SimError;
use crate::env::{Env, observed_positions, observed_velocities, task};
use crate::models::compiled;

/// Quantiles of absolute errors, by linear interpolation; zero if there are no rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// 0.5.
    pub median: f64,
    /// 0.9.
    pub p90: f64,
    /// 0.99.
    pub p99: f64,
    /// Largest.
    pub max: f64,
}

impl Quantiles {
    /// Quantiles of `values`, which may be in any order. NaN counts as larger than every number.
    pub fn of(mut values: Vec<f64>) -> Self {
        let Some(last) = values.len().checked_sub(1) else { return Self::default() };
        values.sort_by(f64::total_cmp);
        let at = |q: f64| {
            let position = q * last as f64;
            let below = position.floor() as usize;
            let above = (below + 1).min(last);
            values[below] + (position - below as f64) * (values[above] - values[below])
        };
        Self { median: at(0.5), p90: at(0.9), p99: at(0.99), max: values[last] }
    }
}

/// The one-step errors of a table of transitions with respect to an environment's dynamics.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReplayReport {
    /// Robot.
    pub agent: Agent,
    /// Shift.
    pub shift: Shift,
    /// Rows of the table.
    pub rows: usize,
    /// Rows compared.
    pub compared: usize,
    /// Rows not compared, because velocities were clipped in s and the row before does not give them.
    pub skipped_clipped: usize,
    /// Rows compared although velocities were clipped in s: the replay of the row before gave them.
    pub carried: usize,
    /// Largest absolute error over the components of s', per row.
    pub next_observation: Quantiles,
    /// Absolute error of r.
    pub reward: Quantiles,
    /// Rows whose terminal mark differs from the simulator's.
    pub terminal_mismatches: Vec<usize>,
    /// Compared rows in which the physics blew up. Their errors count as infinite.
    pub unstable: usize,
}

impl ReplayReport {
    /// Bound on the median error of s'.
    pub const NEXT_OBSERVATION_MEDIAN: f64 = 1e-6;
    /// Bound on the 99th percentile of the error of s'.
    pub const NEXT_OBSERVATION_P99: f64 = 1e-4;
    /// Bound on the 99th percentile of the error of r.
    pub const REWARD_P99: f64 = 1e-5;

    /// Whether the table comes from this environment, up to the rounding of its 32-bit numbers.
    pub fn passes(&self) -> bool {
        self.compared > 0
            && self.next_observation.median <= Self::NEXT_OBSERVATION_MEDIAN
            && self.next_observation.p99 <= Self::NEXT_OBSERVATION_P99
            && self.reward.p99 <= Self::REWARD_P99
            && self.terminal_mismatches.is_empty()
    }
}

enum Outcome {
    Skipped,
    Compared { carried: bool, next_observation: f64, reward: f64, mismatch: bool, unstable: bool },
}

/// Replays every transition: puts the robot into s, holds a for one step, and compares s', r and the terminal mark.
///
/// Rows of an episode are replayed in order, because two values are only known from the row before: velocities that
/// Hopper's and Walker2d's observations clip at 10, and the lag of Ant's torso position, which affects its reward.
///
/// # Errors
/// If the table does not have the agent's dimensions, or the user interrupts.
pub fn replay(
    agent: Agent,
    shift: Shift,
    data: &Transitions,
    progress: Option<&Progress>,
) -> Result<ReplayReport, SimError> {
    let (obs_dim, act_dim) = agent.dims();
    for (what, found, expected) in
        [("observation dimension", data.obs_dim, obs_dim), ("action dimension", data.act_dim, act_dim)]
    {
        if found != expected {
            return Err(SimError::Dimension { what, agent, found, expected });
        }
    }
    let model = compiled(agent, shift)?;
    let outcomes: Vec<Vec<Outcome>> = data
        .episodes()
        .par_iter()
        .map_init(
            || Env::with_model(agent, model.clone()),
            |env, &episode| {
                let outcomes = replay_episode(env, data, episode)?;
                if let Some(progress) = progress {
                    progress.inc((episode.end - episode.start) as u64);
                }
                Ok(outcomes)
            },
        )
        .collect::<Result<_, SimError>>()?;

    let mut report = ReplayReport {
        agent,
        shift,
        rows: data.len(),
        compared: 0,
        skipped_clipped: 0,
        carried: 0,
        next_observation: Quantiles::default(),
        reward: Quantiles::default(),
        terminal_mismatches: Vec::new(),
        unstable: 0,
    };
    let (mut next_errors, mut reward_errors) = (Vec::new(), Vec::new());
    for (row, outcome) in outcomes.into_iter().flatten().enumerate() {
        match outcome {
            Outcome::Skipped => report.skipped_clipped += 1,
            Outcome::Compared { carried, next_observation, reward, mismatch, unstable } => {
                report.compared += 1;
                report.carried += usize::from(carried);
                report.unstable += usize::from(unstable);
                next_errors.push(next_observation);
                reward_errors.push(reward);
                if mismatch {
                    report.terminal_mismatches.push(row);
                }
            }
        }
    }
    report.next_observation = Quantiles::of(next_errors);
    report.reward = Quantiles::of(reward_errors);
    Ok(report)
}

/// Values from the replay of one row that the next row needs.
struct Carry {
    velocities: Vec<f64>,
    lag: f64,
}

fn replay_episode(env: &mut Env, data: &Transitions, episode: Episode) -> Result<Vec<Outcome>, SimError> {
    let agent = env.agent();
    let (positions, velocities) = (observed_positions(agent), observed_velocities(agent));
    let clip = task(agent).velocity_clip;
    let mut predicted = vec![0.0; data.obs_dim];
    let mut carry: Option<Carry> = None;
    let mut outcomes = Vec::with_capacity(episode.end - episode.start);
    for row in episode.start..episode.end {
        if interrupted() {
            return Err(SimError::from(Interrupted::nothing_kept()));
        }
        let observation = data.observation(row);
        if row > episode.start && data.next_observation(row - 1) != observation {
            carry = None;
        }
        env.set_state(observation);
        // An observed velocity at the clipping bound may have been any larger one. The margin covers 32-bit rounding.
        let at_clip = |v: f32| clip.is_some_and(|clip| v.abs() as f64 >= clip - 1e-6);
        let seen = &observation[positions..positions + velocities];
        let carried = seen.iter().any(|&v| at_clip(v));
        if carried {
            let Some(known) = &carry else {
                outcomes.push(Outcome::Skipped);
                continue;
            };
            for ((v, &seen), &known) in env.qvel_mut().iter_mut().zip(seen).zip(&known.velocities) {
                if at_clip(seen) {
                    *v = known;
                }
            }
        }
        if let Some(known) = &carry {
            env.set_lag(known.lag);
        }
        let result = env.step(data.action(row), &mut predicted);
        let next_observation = largest_error(env, data.next_observation(row));
        let reward = (result.reward - data.rewards[row] as f64).abs();
        let blown = |error: f64| if result.unstable || error.is_nan() { f64::INFINITY } else { error };
        outcomes.push(Outcome::Compared {
            carried,
            next_observation: blown(next_observation),
            reward: blown(reward),
            mismatch: result.terminal != data.terminals[row],
            unstable: result.unstable,
        });
        carry = (!result.unstable).then(|| Carry { velocities: env.qvel().to_vec(), lag: env.lag() });
    }
    Ok(outcomes)
}

/// The largest absolute difference between the current state, observed without rounding, and `observation`.
fn largest_error(env: &Env, observation: &[f32]) -> f64 {
    let task = task(env.agent());
    let positions = env.qpos()[task.hidden..].iter().copied();
    let velocities = env.qvel().iter().map(|&v| task.velocity_clip.map_or(v, |clip| v.clamp(-clip, clip)));
    // Ant's observation continues with its contact forces, which are zero.
    let state = positions.chain(velocities).chain(std::iter::repeat(0.0));
    let mut largest = 0.0_f64;
    for (x, &stored) in state.zip(observation) {
        let error = (x - stored as f64).abs();
        if error.is_nan() {
            return f64::NAN;
        }
        largest = largest.max(error);
    }
    largest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_interpolate_between_order_statistics() {
        let q = Quantiles::of((0..=100).rev().map(f64::from).collect());
        assert_eq!((q.median, q.p90, q.p99, q.max), (50.0, 90.0, 99.0, 100.0));
        let q = Quantiles::of(vec![1.0, 0.0]);
        assert_eq!((q.median, q.p90, q.max), (0.5, 0.9, 1.0));
        assert_eq!(Quantiles::of(Vec::new()), Quantiles::default());
    }
}
