//! The deterministic policy of TD3 (Fujimoto et al. 2018), as trained by TD3+BC, ReBRAC and BOSA.
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
use tce_nn::{Averaged, Device, MlpConfig, NamedParameters, NetworkError, Tensor};

use crate::actor::{Actor, ActorConfig, ActorNet, PolicyForm, PolicyOutput};
use crate::buffer::{Buffer, Minibatch};
use crate::critic::{Twins, state_action};
use crate::error::{LearnError, within};
use crate::policy::{Policy, PolicyLearner};
use crate::training::{Learner, Meter, member_noise};

/// Smoothing and delay; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DelayConfig {
    /// σ of the noise on the target policy's actions. Source: TD3.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub std: f64,
    /// c, the greatest noise on the target policy's actions. Source: TD3.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub clip: f64,
    /// d, critic steps per step of the policy. Source: TD3.
    #[schemars(range(min = 1, max = 1000000))]
    pub every: u64,
    /// ρ, how far target networks follow in one step. Source: TD3.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub polyak: f64,
}

impl Default for DelayConfig {
    fn default() -> Self {
        Self { std: 0.2, clip: 0.5, every: 2, polyak: 0.005 }
    }
}

impl DelayConfig {
    /// Returns an error for numbers out of range.
    ///
    /// # Errors
    /// The error names the field.
    pub fn check(&self) -> Result<(), LearnError> {
        within("delay.std", self.std, 0.0..=1e3)?;
        within("delay.clip", self.clip, 0.0..=1e3)?;
        within("delay.every", self.every as f64, 1.0..=1e6)?;
        within("delay.polyak", self.polyak, 0.0..=1.0)
    }
}

/// π, π', Q and Q' of a population.
pub struct ActorCritic {
    config: DelayConfig,
    actor: Actor,
    target: Averaged<ActorNet>,
    /// Q and Q'.
    pub critics: Twins,
    members: Vec<Streams>,
}

impl ActorCritic {
    /// New networks for the members of `buffer`, to be trained for `steps` steps; `critic` is a network on [s, a].
    ///
    /// # Errors
    /// If a configuration cannot be used.
    pub fn new(
        buffer: &Buffer,
        actor: &ActorConfig,
        config: &DelayConfig,
        critic: &MlpConfig,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        config.check()?;
        let actor = Actor::new(buffer, &ActorConfig { form: PolicyForm::TanhMean, ..actor.clone() }, steps, device)?;
        let members = buffer.streams();
        Ok(Self {
            config: config.clone(),
            target: actor.follower(),
            actor,
            critics: Twins::with(critic, &members, &device.clone().autodiff()),
            members,
        })
    }

    /// a' at s' `[P, B, inputs]`, outside of autodiff; the noise is that of `step`.
    pub fn next_action(&self, s2: Tensor<3>, step: u64) -> Tensor<3> {
        let a = self.actor.followed(&self.target, s2);
        let noise = member_noise(&self.members, "target noise", step, a.dims(), &a.device()) * self.config.std;
        (a + noise.clamp(-self.config.clip, self.config.clip)).clamp(-1.0, 1.0)
    }

    /// min(Q1', Q2')(s', a'), outside of autodiff.
    pub fn next_value(&self, s2: Tensor<3>, a2: Tensor<3>) -> Tensor<3> {
        self.critics.lesser_target(state_action(&s2, a2))
    }

    /// Whether the policy is trained at `step`, counted from 0. It is trained at the d-th, 2d-th, ... step.
    pub fn due(&self, step: u64) -> bool {
        (step + 1).is_multiple_of(self.config.every)
    }

    /// ρ if the policy is trained at `step`, otherwise 0: target critics move only together with it.
    pub fn polyak(&self, step: u64) -> f64 {
        if self.due(step) { self.config.polyak } else { 0.0 }
    }

    /// π(s).
    pub fn forward(&self, s: Tensor<3>) -> PolicyOutput {
        self.actor.forward(s)
    }

    /// One step of π on `loss`, followed by one step of π'.
    pub fn step(&mut self, loss: Tensor<3>, step: u64) {
        self.actor.step_averaged(loss, step, &mut self.target, self.config.polyak);
    }

    fn save(&self, state: &mut NamedParameters) {
        self.actor.save(state);
        state.collect("target policy", self.target.net());
        self.critics.save(state);
    }

    fn load(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.actor.load(state, path)?;
        self.target.load("target policy", state, path)?;
        self.critics.load(state, path)
    }
}

/// How a method trains the networks of an [`ActorCritic`].
pub trait UpdateRule: Send {
    /// One step; `step` counts from 0.
    fn update(&self, nets: &mut ActorCritic, batch: &Minibatch, step: u64, meter: &mut Meter);
}

/// An [`ActorCritic`] trained by an [`UpdateRule`].
pub struct Deterministic<R> {
    pub(crate) nets: ActorCritic,
    pub(crate) rule: R,
}

impl<R: UpdateRule> Learner for Deterministic<R> {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        self.rule.update(&mut self.nets, batch, step, meter);
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.nets.save(&mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.nets.load(state, path)
    }
}

impl<R: UpdateRule> PolicyLearner for Deterministic<R> {
    fn policies(&self) -> Vec<Policy> {
        self.nets.actor.policies()
    }
}
