//! Implicit Q-learning (Kostrikov et al. 2022), in the form that OTDF and ODRL train and the TCE paper refers to.
//!
//! ```text
//! u   = min(Q1', Q2')(s, a) - V(s)                                   before V's step
//! L_V = mean of |τ - 1[u < 0]| u²                                    (B.12)       → V
//! y   = r + γ (1 - terminal) V(s')                                   V after its step
//! L_Q = mean (Q1(s, a) - y)² + mean (Q2(s, a) - y)²                  (B.13)       → Q1, Q2
//! Q'  ← (1 - ρ) Q' + ρ Q
//! w   = min(exp(β u), cap)
//! L_π = mean of w ℓ(s, a) + β_reg · regulariser                      (10, B.14)   → π
//! ```
//!
//! ℓ = -log π (see [`crate::actor`]); B.14 prints + log π where it must be minus. Each row's weight multiplies that
//! row's own ℓ. OTDF's and DmC's code multiplies a column of weights by a row of losses, so that every action is cloned
//! with the mean weight. This is called `mean_weight` here.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | τ | `expectile` | .7 | B.2 |
//! | β | `temperature` | 3 | B.2 |
//! | cap | `weight_cap` | 100 | IQL's authors, OTDF |
//! | γ | `discount` | .99 | OTDF, IQL |
//! | ρ | `polyak` | .005 | OTDF, IQL |
//! | - | `critic_lr` | 3e-4 | Table C.4 |
//! | - | `hidden` | 256, 256 ReLU | OTDF, IQL |
//! | - | `actor` | see [`crate::actor`] | OTDF |
//! | - | `policy_extraction` | awr_mse | OTDF as meant; awr_logprob: IQL's authors; mean_weight: OTDF as coded |
//! | - | `advantage` | raw | as published; standardised: u / its standard deviation over the batch |
//! | - | `reward_scale` | none | OTDF; return_range: IQL's authors. Applied by the buffer ([`crate::return_range_scale`]) |
//! | β_reg | `beta_reg` | .001 | Table C.5, most tasks |
//! | - | `regulariser` | none | forward_kl: Eq. 10; otdf: OTDF; see [`crate::regulariser`] |

use std::path::Path;

use tce_nn::{Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained, host};

use crate::actor::{Actor, ActorConfig, PolicyOutput};
use crate::buffer::{Buffer, Minibatch};
use crate::critic::{Twins, state_action};
use crate::error::LearnError;
pub use crate::iql_config::{IqlConfig, PolicyExtraction};
use crate::losses::{AdvantageWeights, advantage_weights, expectile_loss, member_mean};
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::policy::{Policy, PolicyLearner};
use crate::regulariser::Regulariser;
use crate::training::{Learner, Meter};

const ABOUT: About = About {
    name: "iql",
    title: "IQL",
    description: "implicit Q-learning, the learner of TCE in its paper",
    reference: "Kostrikov et al. 2022; TCE, B.2",
    published: None,
    table: "iql",
    needs: OtherRows::Any,
    episodes: false,
    scores: RowScores::None,
};

impl Method for IqlConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        self.check()
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let Some(regulariser) = on.regulariser(self)? else { return Ok(None) };
        Ok(Some(Box::new(Iql::new(on.buffer, self, regulariser, on.steps, on.device)?)))
    }

    fn backbone(&self, _: &IqlConfig) -> Option<IqlConfig> {
        Some(self.clone())
    }
}

/// A weight below this has practically no effect on a policy.
const DEAD_WEIGHT: f32 = 0.01;

/// IQL of a population.
pub struct Iql {
    config: IqlConfig,
    actor: Actor,
    /// `[P, ...]`
    value: Trained<Mlp>,
    critics: Twins,
    regulariser: Regulariser,
}

impl Iql {
    /// New networks for the members of `buffer`, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If the configuration cannot be used, or `regulariser` is not of the kind that it names.
    pub fn new(
        buffer: &Buffer,
        config: &IqlConfig,
        regulariser: Regulariser,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        config.check()?;
        if regulariser.kind() != config.regulariser {
            let (found, expected) = (format!("{:?}", regulariser.kind()), format!("{:?}", config.regulariser));
            return Err(LearnError::invalid("regulariser", found, expected, "make it with Regulariser::prepare"));
        }
        let actor = ActorConfig { form: config.form(), ..config.actor.clone() };
        let actor = Actor::new(buffer, &actor, steps, device)?;
        let (members, device) = (buffer.streams(), device.clone().autodiff());
        let inputs = buffer.inputs().len();
        let value = MlpConfig::relu(inputs, &config.hidden, 1).init(&members, "value", &device);
        let critics = Twins::new(inputs, buffer.act_dim(), &config.hidden, &members, &device);
        Ok(Self { config: config.clone(), actor, value: Trained::new(value), critics, regulariser })
    }

    /// V(s) `[P, B, 1]`, outside of autodiff.
    pub fn values(&self, s: Tensor<3>) -> Tensor<3> {
        self.value.net().valid().forward(s)
    }

    /// One update of all networks. `critic_weights` `[P, B, 1]` multiply the rows of L_Q.
    pub fn step(&mut self, batch: &Minibatch, critic_weights: Option<Tensor<3>>, step: u64, meter: &mut Meter) {
        let Self { config, actor, value, critics, regulariser } = self;
        let sa = state_action(&batch.s, batch.a.clone());
        // With two threads, one computes value and a critic, the other policy and a critic. They synchronise at u, at y
        // and at the end: 8 network passes one after the other instead of 15 (a gradient counts as two).
        let ((q1, v), (q2, output)) = {
            let [one, two] = &critics.pair;
            rayon::join(
                || (one.target(sa.clone()), value.net().forward(batch.s.clone())),
                || (two.target(sa.clone()), actor.forward(batch.s.clone())),
            )
        };
        let difference = q1.min_pair(q2) - v.clone();
        let u = difference.clone().inner();
        let mut policy_meter = meter.fork();
        let (y, ()) = rayon::join(
            || {
                meter.record("value_magnitude", &v.inner().abs());
                value_step(config, value, difference, batch, meter)
            },
            || policy_step(config, (actor, regulariser), (output, u), batch, step, &mut policy_meter),
        );
        meter.join(policy_meter);
        let loss = critics.step(sa, y, critic_weights, config.critic_lr, config.polyak);
        meter.record("critic_loss", &loss);
    }
}

/// One step on L_V. Returns y, computed from V after the step.
fn value_step(
    config: &IqlConfig,
    value: &mut Trained<Mlp>,
    difference: Tensor<3>,
    batch: &Minibatch,
    meter: &mut Meter,
) -> Tensor<3> {
    let loss = expectile_loss(difference, config.expectile);
    meter.record("value_loss", &loss);
    value.step(loss.sum(), config.critic_lr);
    // Outside of autodiff, because the forward pass needs no gradient.
    let next = value.net().valid().forward(batch.s2.clone());
    batch.r.clone() + batch.not_done.clone() * next * config.discount
}

/// One step on L_π, given the policy's output and the advantages u at the rows of `batch`.
fn policy_step(
    c: &IqlConfig,
    (actor, regulariser): (&mut Actor, &Regulariser),
    (output, u): (PolicyOutput, Tensor<3>),
    batch: &Minibatch,
    step: u64,
    meter: &mut Meter,
) {
    let weights = AdvantageWeights { temperature: c.temperature, cap: c.weight_cap, scale: c.advantage };
    let mut w = advantage_weights(u.clone(), weights);
    if meter.active() {
        let members = w.dims()[0];
        let rows = w.dims()[1] as f64;
        let (values, cap) = (host(w.clone()), c.weight_cap as f32);
        let share = |test: &dyn Fn(f32) -> bool| -> Vec<f64> {
            let count = |of: &[f32]| of.iter().filter(|&&w| test(w)).count() as f64 / rows;
            values.chunks(values.len() / members).map(count).collect()
        };
        meter.add("weight_capped", share(&|w| w >= cap));
        meter.add("weight_dead", share(&|w| w < DEAD_WEIGHT));
        meter.record("weight_mean", &w);
        meter.record("advantage_mean", &u);
        let deviation = u.clone() - u.mean_dim(1);
        meter.record("advantage_std", &deviation.square().mean_dim(1).sqrt());
    }
    if c.policy_extraction == PolicyExtraction::MeanWeight {
        w = member_mean(w);
    }
    let mut loss = actor.imitation_loss(&output, batch.a.clone(), Some(w));
    meter.record("policy_loss", &loss);
    if c.beta_reg > 0.0
        && let Some(term) = regulariser.loss(actor, &output, batch, step)
    {
        meter.record("regulariser", &term);
        loss = loss + term * c.beta_reg;
    }
    drop(output);
    actor.step(loss, step);
}

impl Learner for Iql {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        self.step(batch, None, step, meter);
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.actor.save(&mut state);
        self.value.save("value", &mut state);
        self.critics.save(&mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.actor.load(state, path)?;
        self.value.load("value", state, path)?;
        self.critics.load(state, path)
    }
}

impl PolicyLearner for Iql {
    fn policies(&self) -> Vec<Policy> {
        self.actor.policies()
    }
}
