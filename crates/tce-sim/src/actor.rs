//! Actors: what chooses the actions in an environment.

use tce_base::Rng;

/// Chooses actions.
pub trait Actor: Sync {
    /// A lane's memory of its episode; `()` for actors that use only the current observation.
    type Memory: Send;

    /// The memory of a lane at the start of an episode.
    fn start(&self) -> Self::Memory;

    /// Fills `actions` (`[rows, act_dim]`, row-major, in [-1, 1]) for `observations` (`[rows, obs_dim]`). `memories`
    /// and `rngs` hold one memory and one random generator per row, the latter for actors that sample. A row's actions
    /// may depend only on its own memory and generator, so that they do not depend on the other rows of the batch.
    fn act(&self, observations: &[f32], memories: &mut [Self::Memory], rngs: &mut [Rng], actions: &mut [f32]);

    /// Passes the reward of the last action to a lane's memory, if the episode continues.
    fn reward(&self, _memory: &mut Self::Memory, _reward: f64) {}
}

impl<F: Fn(&[f32], &mut [Rng], &mut [f32]) + Sync> Actor for F {
    type Memory = ();

    fn start(&self) {}

    fn act(&self, observations: &[f32], _: &mut [()], rngs: &mut [Rng], actions: &mut [f32]) {
        self(observations, rngs, actions)
    }
}

/// Uniformly random actions.
#[derive(Clone, Copy, Debug)]
pub struct UniformActor;

impl Actor for UniformActor {
    type Memory = ();

    fn start(&self) {}

    fn act(&self, _: &[f32], _: &mut [()], rngs: &mut [Rng], actions: &mut [f32]) {
        let dim = actions.len() / rngs.len().max(1);
        for (rng, row) in rngs.iter_mut().zip(actions.chunks_exact_mut(dim)) {
            tce_base::random::fill_uniform(rng, row);
            row.iter_mut().for_each(|a| *a = 2.0 * *a - 1.0);
        }
    }
}
