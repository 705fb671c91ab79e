//! Behaviour cloning.
//!
//! L_π = E over (s, a) of ℓ(s, a): for the default policy form the mean squared error of tanh(μ(s)), see [`crate::actor`].
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `actor` | deterministic, 256-256, Adam 3e-4, cosine | as the policies of IQL |
//! | `top` | [`crate::best_trajectories`], before the buffer is made | 1 | "BC-10 %" of Chen et al. 2021 |
//!
//! Raw or standardised observations, and all rows or the best trajectories, are properties of a member's data: one
//! population may hold all of them.

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_nn::{Device, NamedParameters, NetworkError};

use crate::actor::{Actor, ActorConfig};
use crate::buffer::{Buffer, Minibatch};
use crate::error::LearnError;
use crate::policy::Policy;
use crate::training::{Learner, Meter, PolicyLearner};

/// The configuration of [`Bc`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BcConfig {
    /// The policy.
    pub actor: ActorConfig,
}

/// Behaviour cloning of a population.
pub struct Bc {
    actor: Actor,
}

impl Bc {
    /// New policies for the members of `buffer`, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If the configuration cannot be used.
    pub fn new(buffer: &Buffer, config: &BcConfig, steps: u64, device: &Device) -> Result<Self, LearnError> {
        Ok(Self { actor: Actor::new(buffer, &config.actor, steps, device)? })
    }
}

impl Learner for Bc {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let output = self.actor.forward(batch.s.clone());
        let loss = self.actor.imitation_loss(&output, batch.a.clone(), None);
        drop(output);
        meter.record("policy_loss", &loss);
        self.actor.step(loss, step);
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.actor.save(&mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.actor.load(state, path)
    }
}

impl PolicyLearner for Bc {
    fn policies(&self) -> Vec<Policy> {
        self.actor.policies()
    }
}
