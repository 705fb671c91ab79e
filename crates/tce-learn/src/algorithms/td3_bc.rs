//! TD3+BC (Fujimoto and Gu 2021): a deterministic actor-critic whose policy is kept close to the actions of the data.
//!
//! ```text
//! a'  = clip(π'(s') + clip(σ n, ±c), ±1);  y = r + γ (1 - terminal) min(Q1', Q2')(s', a')
//! L_Q = mean (Q1(s, a) - y)² + mean (Q2(s, a) - y)²                               → Q1, Q2
//! every d-th step:  L_π = mean ℓ(s, a) - (α / mean |Q1(s, π(s))|) mean Q1(s, π(s))   → π;  Q', π' follow
//! ```
//!
//! ℓ = (π(s) - a)², mean over components ([`crate::actor`]); there is no gradient through the divisor of α.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | α | `alpha` | 2.5 | Fujimoto and Gu |
//! | γ | `discount` | .99 | the same |
//! | σ, c, d, ρ | `delay` | .2, .5, 2, .005 | [`crate::deterministic`] |
//! | - | `critic_lr` | 3e-4 | the same |
//! | - | `hidden` | 256, 256 ReLU | the same |
//! | - | `actor` | 256-256, 3e-4, constant | the same |

use serde::{Deserialize, Serialize};
use tce_nn::{Device, MlpConfig, Tensor};

use crate::actor::{Actor, ActorConfig};
use crate::buffer::{Buffer, Minibatch};
use crate::critic::state_action;
use crate::deterministic::{ActorCritic, DelayConfig, Deterministic, UpdateRule};
use crate::error::{LearnError, within};
use crate::losses::member_mean;
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::training::Meter;

const ABOUT: About = About {
    name: "td3-bc",
    title: "TD3+BC",
    description: "TD3 with a behaviour-cloning term",
    reference: "Fujimoto and Gu 2021",
    published: None,
    table: "td3_bc",
    needs: OtherRows::Any,
    episodes: false,
    scores: RowScores::None,
};

impl Method for Td3BcConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        within("alpha", self.alpha, 0.0..=1e6)?;
        within("discount", self.discount, 0.0..=1.0)?;
        within("critic_lr", self.critic_lr, 0.0..=1.0)?;
        self.delay.check()
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        Ok(Some(Box::new(Td3Bc::new(on.buffer, self, on.steps, on.device)?)))
    }
}

/// The configuration of [`Td3Bc`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Td3BcConfig {
    /// α, the weight of the value beside the distance to the data's action in the policy's loss. Source: Fujimoto and Gu.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub alpha: f64,
    /// γ, the discount factor. Source: Fujimoto and Gu.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub discount: f64,
    /// σ, c, d, ρ
    pub delay: DelayConfig,
    /// Learning rate of the critics, constant. Source: Fujimoto and Gu.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub critic_lr: f64,
    /// Widths of the hidden layers of the critics. Source: Fujimoto and Gu.
    pub hidden: Vec<usize>,
    /// The policy; its `form` is tanh mean.
    pub actor: ActorConfig,
}

impl Default for Td3BcConfig {
    fn default() -> Self {
        Self {
            alpha: 2.5,
            discount: 0.99,
            delay: DelayConfig::default(),
            critic_lr: 3e-4,
            hidden: vec![256, 256],
            actor: ActorConfig { cosine: false, ..ActorConfig::default() },
        }
    }
}

/// TD3+BC of a population.
pub type Td3Bc = Deterministic<Td3BcConfig>;

impl Td3Bc {
    /// New networks for the members of `buffer`, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If the configuration cannot be used.
    pub fn new(buffer: &Buffer, config: &Td3BcConfig, steps: u64, device: &Device) -> Result<Self, LearnError> {
        config.check()?;
        let critic = MlpConfig::relu(buffer.inputs().len() + buffer.act_dim(), &config.hidden, 1);
        let nets = ActorCritic::new(buffer, &config.actor, &config.delay, &critic, steps, device)?;
        Ok(Deterministic { nets, rule: config.clone() })
    }
}

/// mean Q / mean |Q| per member, no gradient through the divisor: independent of the rewards' scale. `q` `[P, B, 1]`.
pub fn normalised_value(q: Tensor<3>) -> Tensor<3> {
    let scale = member_mean(q.clone().inner().abs()).clamp_min(1e-8);
    member_mean(q) / Tensor::from_inner(scale)
}

impl UpdateRule for Td3BcConfig {
    fn update(&self, nets: &mut ActorCritic, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let q = nets.next_value(batch.s2.clone(), nets.next_action(batch.s2.clone(), step));
        let y = batch.r.clone() + batch.not_done.clone() * q * self.discount;
        let sa = state_action(&batch.s, batch.a.clone());
        let polyak = nets.polyak(step);
        let loss = nets.critics.step(sa, y, None, self.critic_lr, polyak);
        meter.record("critic_loss", &loss);
        if nets.due(step) {
            let output = nets.forward(batch.s.clone());
            let q = nets.critics.pair[0].frozen(state_action(&batch.s, output.mean.clone()));
            let cloning = Actor::squared_loss(&output, batch.a.clone());
            meter.record("policy_value", &q);
            meter.record("cloning_loss", &cloning);
            let loss = cloning - normalised_value(q) * self.alpha;
            drop(output);
            nets.step(loss, step);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_nn::{cpu, host, tensor};

    #[test]
    fn the_value_is_in_units_of_its_own_magnitude() {
        let q = tensor(vec![2.0, -1.0, 5.0], [1, 3, 1], &cpu().autodiff()).require_grad();
        let value = normalised_value(q.clone());
        assert!((host(value.clone().inner())[0] - 6.0 / 8.0).abs() < 1e-6);
        // The gradient treats mean |Q| = 8/3 as a constant: 1/3 · 3/8.
        let gradient = host(q.grad(&value.sum().backward()).unwrap());
        assert!(gradient.iter().all(|g| (g - 0.125).abs() < 1e-6), "{gradient:?}");
    }
}
