//! One-step predictions for any states and actions, also those that are not from a rollout.

use rayon::prelude::*;
use tce_base::{Interrupted, interrupted};
use tce_data::{Agent, Shift};

use crate::SimError;
use crate::env::Env;
use crate::models::compiled;

/// The simulator's results for a batch of states and actions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Simulated {
    /// s', `[N, obs_dim]`; NaN in rows where the physics blew up.
    pub next_observations: Vec<f32>,
    /// r, `[N]`; NaN in rows where the physics blew up.
    pub rewards: Vec<f32>,
    /// Whether the robot's rule ends the episode at s', `[N]`; true in rows where the physics blew up.
    pub terminals: Vec<bool>,
}

impl Simulated {
    /// Whether the physics stayed stable in row `i`.
    pub fn held(&self, i: usize) -> bool {
        self.rewards[i].is_finite()
    }
}

/// Rows that one environment simulates; the work is split into chunks of this size.
const CHUNK: usize = 64;

/// Simulates one step from each of `states` (`[N, obs_dim]`) under `actions` (`[N, act_dim]`), in parallel. Coordinates
/// that a state does not contain are set as in [`Env::set_state`].
///
/// # Errors
/// If the sizes do not fit the agent, an input is not finite, or the user interrupts.
pub fn simulate(agent: Agent, shift: Shift, states: &[f32], actions: &[f32]) -> Result<Simulated, SimError> {
    let (obs_dim, act_dim) = agent.dims();
    let rows = states.len() / obs_dim;
    for (what, found, expected) in
        [("numbers in `states`", states.len(), rows * obs_dim), ("numbers in `actions`", actions.len(), rows * act_dim)]
    {
        if found != expected {
            return Err(SimError::Dimension { what, agent, found, expected });
        }
    }
    for (what, table, dim) in [("`states`", states, obs_dim), ("`actions`", actions, act_dim)] {
        if let Some(at) = table.iter().position(|x| !x.is_finite()) {
            return Err(SimError::NotFinite { what, row: at / dim, value: table[at] });
        }
    }
    let model = compiled(agent, shift)?;
    let mut out = Simulated {
        next_observations: vec![0.0; rows * obs_dim],
        rewards: vec![0.0; rows],
        terminals: vec![false; rows],
    };
    out.next_observations
        .par_chunks_mut(CHUNK * obs_dim)
        .zip(out.rewards.par_chunks_mut(CHUNK))
        .zip(out.terminals.par_chunks_mut(CHUNK))
        .zip(states.par_chunks(CHUNK * obs_dim).zip(actions.par_chunks(CHUNK * act_dim)))
        .try_for_each_init(
            || Env::with_model(agent, model.clone()),
            |env, (((next, rewards), terminals), (states, actions))| {
                if interrupted() {
                    return Err(SimError::from(Interrupted::nothing_kept()));
                }
                let inputs = states.chunks_exact(obs_dim).zip(actions.chunks_exact(act_dim));
                let outputs = next.chunks_exact_mut(obs_dim).zip(rewards).zip(terminals);
                for ((state, action), ((next, reward), terminal)) in inputs.zip(outputs) {
                    env.set_state(state);
                    let result = env.step(action, next);
                    (*reward, *terminal) = (result.reward as f32, result.terminal);
                    if result.unstable {
                        next.fill(f32::NAN);
                        (*reward, *terminal) = (f32::NAN, true);
                    }
                }
                Ok(())
            },
        )?;
    Ok(out)
}
