//! ReBRAC (Tarasov et al. 2023): TD3+BC with a penalty in the critics' target, too, and layer-normalised critics.
//!
//! ```text
//! a'  = clip(π'(s') + clip(σ n, ±c), ±1)
//! y   = r + γ (1 - terminal) (min(Q1', Q2')(s', a') - β_Q |a' - a'_data|²)
//! L_Q = mean (Q1(s, a) - y)² + mean (Q2(s, a) - y)²                                      → Q1, Q2
//! every d-th step:  L_π = β_π mean |π(s) - a|² - mean min(Q1, Q2)(s, π(s)) / mean |min(Q1, Q2)|   → π;  Q', π' follow
//! ```
//!
//! a'_data is the action of the next row. If the data do not contain it (the end of an episode, a generated row, a row
//! whose next row was left out), there is no penalty.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | β_π | `actor_penalty` | .1 | Tarasov et al. choose from .001 .. 1 for each task; own |
//! | β_Q | `critic_penalty` | .01 | the same, from 0 .. 1; own |
//! | γ | `discount` | .99 | their MuJoCo tasks |
//! | σ, c, d, ρ | `delay` | .2, .5, 2, .005 | [`crate::deterministic`] |
//! | - | `critic_lr`, `actor.lr` | 3e-4 | theirs: 1e-3 at batches of 1024; ours are those of the other methods |
//! | - | `hidden` | 256, 256, 256 ReLU, critics with layer normalisation | theirs |

use serde::{Deserialize, Serialize};
use tce_nn::{Device, MlpConfig};

use crate::actor::{Actor, ActorConfig};
use crate::buffer::{Buffer, Minibatch};
use crate::critic::state_action;
use crate::deterministic::{ActorCritic, DelayConfig, Deterministic, UpdateRule};
use crate::error::{LearnError, within};
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::td3_bc::normalised_value;
use crate::training::Meter;

const ABOUT: About = About {
    name: "rebrac",
    title: "ReBRAC",
    description: "TD3+BC with a penalty in the critics too, and normalised critics",
    reference: "Tarasov et al. 2023",
    published: None,
    table: "rebrac",
    needs: OtherRows::Any,
    episodes: false,
    scores: RowScores::None,
};

impl Method for RebracConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        within("actor_penalty", self.actor_penalty, 0.0..=1e6)?;
        within("critic_penalty", self.critic_penalty, 0.0..=1e6)?;
        within("discount", self.discount, 0.0..=1.0)?;
        within("critic_lr", self.critic_lr, 0.0..=1.0)?;
        self.delay.check()
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        Ok(Some(Box::new(Rebrac::new(on.buffer, self, on.steps, on.device)?)))
    }
}

/// The configuration of [`Rebrac`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RebracConfig {
    /// β_π, the weight of the distance to the data's action in the policy's loss. Source: own; Tarasov et al. choose from .001 to 1
    /// for each task.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub actor_penalty: f64,
    /// β_Q, the weight of the same distance at the next state, in the critics' target. Source: own; Tarasov et al. choose from 0 to
    /// 1 for each task.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub critic_penalty: f64,
    /// γ, the discount factor. Source: Tarasov et al.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub discount: f64,
    /// σ, c, d, ρ
    pub delay: DelayConfig,
    /// Learning rate of the critics, constant. Source: own; theirs is 1e-3 at batches of 1024.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub critic_lr: f64,
    /// Widths of the hidden layers of the critics. Source: Tarasov et al.
    pub hidden: Vec<usize>,
    /// The policy; its `form` is tanh mean.
    pub actor: ActorConfig,
}

impl Default for RebracConfig {
    fn default() -> Self {
        let hidden = vec![256, 256, 256];
        Self {
            actor_penalty: 0.1,
            critic_penalty: 0.01,
            discount: 0.99,
            delay: DelayConfig::default(),
            critic_lr: 3e-4,
            actor: ActorConfig { cosine: false, hidden: hidden.clone(), ..ActorConfig::default() },
            hidden,
        }
    }
}

/// ReBRAC of a population.
pub type Rebrac = Deterministic<Penalties>;

/// The penalties of the policy and the critics.
pub struct Penalties {
    config: RebracConfig,
    /// The next actions are read from it.
    buffer: Buffer,
}

impl Rebrac {
    /// New networks for the members of `buffer`, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If the configuration cannot be used.
    pub fn new(buffer: &Buffer, config: &RebracConfig, steps: u64, device: &Device) -> Result<Self, LearnError> {
        config.check()?;
        let critic = MlpConfig::relu(buffer.inputs().len() + buffer.act_dim(), &config.hidden, 1).with_layer_norm();
        let nets = ActorCritic::new(buffer, &config.actor, &config.delay, &critic, steps, device)?;
        Ok(Deterministic { nets, rule: Penalties { config: config.clone(), buffer: buffer.clone() } })
    }
}

impl UpdateRule for Penalties {
    fn update(&self, nets: &mut ActorCritic, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let Self { config: c, buffer } = self;
        let a2 = nets.next_action(batch.s2.clone(), step);
        let (data, known) = buffer.next_actions(batch);
        let penalty = (a2.clone() - data).square().sum_dim(2) * known;
        meter.record("critic_penalty", &penalty);
        let q = nets.next_value(batch.s2.clone(), a2) - penalty * c.critic_penalty;
        let y = batch.r.clone() + batch.not_done.clone() * q * c.discount;
        let sa = state_action(&batch.s, batch.a.clone());
        let polyak = nets.polyak(step);
        let loss = nets.critics.step(sa, y, None, c.critic_lr, polyak);
        meter.record("critic_loss", &loss);
        if nets.due(step) {
            let output = nets.forward(batch.s.clone());
            let sa = state_action(&batch.s, output.mean.clone());
            let [one, two] = &nets.critics.pair;
            let (q1, q2) = rayon::join(|| one.frozen(sa.clone()), || two.frozen(sa.clone()));
            let q = q1.min_pair(q2);
            drop(sa);
            // The penalty is a sum over components, but `squared_loss` returns their mean.
            let cloning = Actor::squared_loss(&output, batch.a.clone()) * batch.a.dims()[2] as f64;
            meter.record("policy_value", &q);
            meter.record("cloning_loss", &cloning);
            let loss = cloning * c.actor_penalty - normalised_value(q);
            drop(output);
            nets.step(loss, step);
        }
    }
}
