//! The deterministic policy of TD3 (Fujimoto et al. 2018), as TD3+BC, ReBRAC and BOSA train it.
//!
//! ```text
//! a' = clip(π'(s') + clip(σ n, ±c), ±1), n ~ N(0, I)
//! every d-th step: a step of π, then π' ← (1 - ρ) π' + ρ π, and Q' likewise
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | σ | `std` | .2 | TD3 |
//! | c | `clip` | .5 | TD3 |
//! | d | `every` | 2 | TD3 |
//! | ρ | `polyak` | .005 | TD3 |

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::{Averaged, Device, NamedParameters, NetworkError, Tensor};

use crate::actor::{Actor, ActorConfig, ActorNet, PolicyForm, PolicyOutput};
use crate::buffer::Buffer;
use crate::error::{LearnError, within};
use crate::policy::Policy;
use crate::training::member_noise;

/// Smoothing and delay; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DelayConfig {
    /// σ
    pub std: f64,
    /// c
    pub clip: f64,
    /// d
    pub every: u64,
    /// ρ
    pub polyak: f64,
}

impl Default for DelayConfig {
    fn default() -> Self {
        Self { std: 0.2, clip: 0.5, every: 2, polyak: 0.005 }
    }
}

impl DelayConfig {
    /// Refuses numbers out of range.
    ///
    /// # Errors
    /// Names the field.
    pub fn check(&self) -> Result<(), LearnError> {
        within("delay.std", self.std, 0.0..=1e3)?;
        within("delay.clip", self.clip, 0.0..=1e3)?;
        within("delay.every", self.every as f64, 1.0..=1e6)?;
        within("delay.polyak", self.polyak, 0.0..=1.0)
    }
}

/// π and π' of a population.
pub struct DelayedActor {
    config: DelayConfig,
    actor: Actor,
    target: Averaged<ActorNet>,
    members: Vec<Streams>,
}

impl DelayedActor {
    /// New policies for the members of `buffer`, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If a configuration cannot be used.
    pub fn new(
        buffer: &Buffer,
        actor: &ActorConfig,
        config: &DelayConfig,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        config.check()?;
        let actor = Actor::new(buffer, &ActorConfig { form: PolicyForm::TanhMean, ..actor.clone() }, steps, device)?;
        Ok(Self { config: config.clone(), target: actor.follower(), actor, members: buffer.streams() })
    }

    /// a' at s' `[P, B, inputs]`, no part of autodiff; the noise is that of `step`.
    pub fn next_action(&self, s2: Tensor<3>, step: u64) -> Tensor<3> {
        let a = self.actor.followed(&self.target, s2);
        let noise = member_noise(&self.members, "target noise", step, a.dims(), &a.device()) * self.config.std;
        (a + noise.clamp(-self.config.clip, self.config.clip)).clamp(-1.0, 1.0)
    }

    /// Whether the policy is trained at `step`, counted from 0: the d-th, 2d-th, ...
    pub fn due(&self, step: u64) -> bool {
        (step + 1).is_multiple_of(self.config.every)
    }

    /// ρ where the policy is trained, else 0: target critics move with it.
    pub fn polyak(&self, step: u64) -> f64 {
        if self.due(step) { self.config.polyak } else { 0.0 }
    }

    /// π(s).
    pub fn forward(&self, s: Tensor<3>) -> PolicyOutput {
        self.actor.forward(s)
    }

    /// A step of π down `loss`, and of π' after it.
    pub fn step(&mut self, loss: Tensor<3>, step: u64) {
        self.actor.step_averaged(loss, step, &mut self.target, self.config.polyak);
    }

    /// The policies as they are.
    pub fn policies(&self) -> Vec<Policy> {
        self.actor.policies()
    }

    /// Adds parameters and optimiser to `state`.
    pub fn save(&self, state: &mut NamedParameters) {
        self.actor.save(state);
        state.collect("target policy", self.target.net());
    }

    /// Takes them from `state`; `path` is where it came from, for messages.
    ///
    /// # Errors
    /// If they belong to another policy.
    pub fn load(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.actor.load(state, path)?;
        self.target.load("target policy", state, path)
    }
}
