//! Implicit Q-learning (Kostrikov et al. 2022), in the form that OTDF and ODRL train and TCE names.
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
//! ℓ = -log π (see [`crate::actor`]); B.14 prints + log π where it must be minus. Each row's weight multiplies that row's
//! own ℓ; OTDF's and DmC's code multiplies a column of weights with a row of losses, which clones every action with the
//! mean weight: that is `mean_weight` here.
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

use serde::{Deserialize, Serialize};
use tce_nn::{Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained, host};

use crate::about::{About, OtherRows};
use crate::actor::{Actor, ActorConfig, PolicyForm, PolicyOutput};
use crate::buffer::{Buffer, Minibatch, RewardScale};
use crate::critic::{Twins, state_action};
use crate::error::{LearnError, within};
use crate::losses::{AdvantageScale, AdvantageWeights, advantage_weights, expectile_loss, member_mean};
use crate::policy::{Policy, PolicyLearner};
use crate::regulariser::{Regulariser, RegulariserKind};
use crate::training::{Learner, Meter};

/// What it is.
pub const ABOUT: About = About {
    name: "iql",
    description: "implicit Q-learning, TCE's learner",
    reference: "Kostrikov et al. 2022; TCE, B.2",
    published: None,
    table: "iql",
    needs: OtherRows::Any,
    successors: false,
    episodes: false,
};

/// A weight below this does not move a policy.
const DEAD_WEIGHT: f32 = 0.01;

/// How the critics' advantages reach the policy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PolicyExtraction {
    /// Weighted squared error of a deterministic policy (or of a tanh-Gaussian's mean).
    #[default]
    AwrMse,
    /// Weighted log-likelihood of a normal policy with a standard deviation per action dimension.
    AwrLogprob,
    /// As `awr_mse`, every row with the mean weight of its batch: what OTDF's code does.
    MeanWeight,
}

/// The configuration of [`Iql`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct IqlConfig {
    /// τ_V, the expectile of Q that V is regressed on. Source: Eq. B.12, Appendix B.2.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub expectile: f64,
    /// β_Adv, how sharply the policy prefers actions with an advantage. Source: Eq. B.14, Appendix B.2: 3.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub temperature: f64,
    /// Greatest weight of a row in the policy's loss. Source: IQL's authors, OTDF.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e+30))]
    pub weight_cap: f64,
    /// γ, the discount factor. Source: OTDF, IQL.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub discount: f64,
    /// ρ, how far target networks follow in one step. Source: OTDF, IQL.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub polyak: f64,
    /// Learning rate of V and Q, constant. Source: Table C.4.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub critic_lr: f64,
    /// Widths of the hidden layers of V and Q. Source: OTDF, IQL.
    pub hidden: Vec<usize>,
    /// The policy; its `form` follows from `policy_extraction` and `regulariser`.
    pub actor: ActorConfig,
    /// How advantages become a policy. Source: OTDF as meant.
    pub policy_extraction: PolicyExtraction,
    /// Units of the advantage before β_Adv multiplies it. Source: the paper's are raw.
    pub advantage: AdvantageScale,
    /// What rewards are multiplied by before a critic sees them. Source: OTDF does without.
    pub reward_scale: RewardScale,
    /// β_reg, the weight of the behaviour term in the policy's loss. Source: Table C.5.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub beta_reg: f64,
    /// What keeps the policy near the target's behaviour. Source: Eq. 10 is forward_kl.
    pub regulariser: RegulariserKind,
}

impl Default for IqlConfig {
    fn default() -> Self {
        Self {
            expectile: 0.7,
            temperature: 3.0,
            weight_cap: 100.0,
            discount: 0.99,
            polyak: 0.005,
            critic_lr: 3e-4,
            hidden: vec![256, 256],
            actor: ActorConfig::default(),
            policy_extraction: PolicyExtraction::default(),
            advantage: AdvantageScale::default(),
            reward_scale: RewardScale::default(),
            beta_reg: 1e-3,
            regulariser: RegulariserKind::default(),
        }
    }
}

impl IqlConfig {
    /// Refuses numbers out of range, and combinations that cannot be trained.
    ///
    /// # Errors
    /// Names the field.
    pub fn check(&self) -> Result<(), LearnError> {
        within("expectile", self.expectile, 0.0..=1.0)?;
        within("temperature", self.temperature, 0.0..=1e6)?;
        within("weight_cap", self.weight_cap, f64::MIN_POSITIVE..=1e30)?;
        within("discount", self.discount, 0.0..=1.0)?;
        within("polyak", self.polyak, 0.0..=1.0)?;
        within("critic_lr", self.critic_lr, 0.0..=1.0)?;
        within("beta_reg", self.beta_reg, 0.0..=1e6)?;
        if self.regulariser == RegulariserKind::Otdf && self.policy_extraction == PolicyExtraction::AwrLogprob {
            let remedy = "choose awr_mse or mean_weight, or another regulariser";
            return Err(LearnError::invalid(
                "policy_extraction",
                "awr_logprob",
                "a tanh-Gaussian policy for OTDF",
                remedy,
            ));
        }
        Ok(())
    }

    fn form(&self) -> PolicyForm {
        match (self.policy_extraction, self.regulariser) {
            (PolicyExtraction::AwrLogprob, _) => PolicyForm::Gaussian,
            (_, RegulariserKind::Otdf) => PolicyForm::TanhGaussian,
            _ => PolicyForm::TanhMean,
        }
    }
}

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
    /// If the configuration cannot be used, or `regulariser` is not of the kind it names.
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

    /// V(s) `[P, B, 1]`, no part of autodiff.
    pub fn values(&self, s: Tensor<3>) -> Tensor<3> {
        self.value.net().valid().forward(s)
    }

    /// One update of all networks. `critic_weights` `[P, B, 1]` multiply the rows of L_Q.
    pub fn step(&mut self, batch: &Minibatch, critic_weights: Option<Tensor<3>>, step: u64, meter: &mut Meter) {
        let Self { config, actor, value, critics, regulariser } = self;
        let sa = state_action(&batch.s, batch.a.clone());
        // Where there are two threads, one computes value and a critic, the other policy and a critic; they meet in u, in y
        // and at the end: 8 of 15 network passes instead of 15 (a gradient counts as two).
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

/// A step down L_V. Returns y, of V after the step.
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
    // Outside of autodiff: nothing of the forward pass needs to be kept.
    let next = value.net().valid().forward(batch.s2.clone());
    batch.r.clone() + batch.not_done.clone() * next * config.discount
}

/// A step down L_π, from the policy's output and the advantages u at the rows of `batch`.
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
