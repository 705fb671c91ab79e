//! Soft actor-critic (Haarnoja et al. 2018, 2019). It collected D4RL's data, and collects this project's own.
//!
//! ```text
//! a'  ~ π(·|s');  y = r + γ (1 - terminal) (min(Q1', Q2')(s', a') - α ln π(a'|s'))
//! L_Q = mean (Q1(s, a) - y)² + mean (Q2(s, a) - y)²                             → Q1, Q2
//! Q'  ← (1 - ρ) Q' + ρ Q
//! ã   = tanh(μ(s) + σ(s) n), n ~ N(0, I)
//! L_π = mean (α ln π(ã|s) - min(Q1, Q2)(s, ã))                                  → π
//! L_α = -mean ln α · (ln π(ã|s) + H̄)                                            → α
//! ```
//!
//! ln π(ã|s) = Σ_d ln N(u_d; μ_d, σ_d²) - ln(1 - tanh² u_d), with u = μ + σ n.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | γ | `discount` | .99 | Haarnoja et al. 2019, Table 1 |
//! | ρ | `polyak` | .005 | the same |
//! | - | `lr` | 3e-4, all networks and α, constant | the same |
//! | - | `hidden` | 256, 256 ReLU | the same; D4RL |
//! | H̄ | `target_entropy` | -d_a | the same |
//! | α at the start | `initial_alpha` | 1 | their code |
//! | - | `policy_lr` | none: `lr` | ours, for a policy that is not a new one |
//! | - | `layer_norm` | no | RLPD (Ball et al. 2023), for a policy that is not a new one; behind the ReLU, in ReBRAC's order |
//! | - | `policy_start` | 0 | ours: updates of the critics alone, where the policy is not a new one |

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::burn::module::Param;
use tce_nn::{Device, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained, host, tensor};

use crate::actor::{Actor, ActorConfig, PolicyForm};
use crate::buffer::{Buffer, Minibatch};
use crate::critic::{Twins, state_action};
use crate::error::{LearnError, within};
use crate::losses::member_mean;
use crate::mlp_policy::MlpPolicy;
use crate::policy::{Policy, PolicyLearner};
use crate::training::{Learner, Meter};

/// The configuration of [`Sac`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SacConfig {
    /// γ
    pub discount: f64,
    /// ρ
    pub polyak: f64,
    /// Learning rate.
    pub lr: f64,
    /// The policy's own learning rate, if different: a good policy should not move away from what its critics know.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub policy_lr: Option<f64>,
    /// Hidden layers of policy and critics.
    pub hidden: Vec<usize>,
    /// Layer normalisation in the critics, behind the ReLU as in ReBRAC (in RLPD before it). It avoids extreme values
    /// between tried actions (Ball et al. 2023).
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub layer_norm: bool,
    /// H̄; `None` means -d_a.
    pub target_entropy: Option<f64>,
    /// α before the first step.
    pub initial_alpha: f64,
    /// Updates of the critics before the first update of policy and α. New critics would spoil a trained policy.
    pub policy_start: u64,
}

impl Default for SacConfig {
    fn default() -> Self {
        let hidden = vec![256, 256];
        let (target_entropy, policy_lr, policy_start) = (None, None, 0);
        let (discount, polyak, lr, initial_alpha) = (0.99, 0.005, 3e-4, 1.0);
        Self { discount, polyak, lr, policy_lr, hidden, layer_norm: false, target_entropy, initial_alpha, policy_start }
    }
}

/// Factor on the speed of the target critics while the policy is fixed. Values must rise from 0 over 1 / (1 - γ) steps,
/// each of which takes 1 / ρ updates.
const EAGER: f64 = 4.0;

/// ln α of every member, `[P, 1, 1]`.
#[derive(Module, Debug)]
struct Temperature {
    log_alpha: Param<Tensor<3>>,
}

/// SAC of a population.
pub struct Sac {
    config: SacConfig,
    target_entropy: f64,
    actor: Actor,
    critics: Twins,
    temperature: Trained<Temperature>,
    members: Vec<Streams>,
    device: Device,
}

impl Sac {
    /// New networks for the members of `buffer`, to which rows may be added during training.
    ///
    /// # Errors
    /// If the configuration cannot be used.
    pub fn new(buffer: &Buffer, config: &SacConfig, device: &Device) -> Result<Self, LearnError> {
        within("discount", config.discount, 0.0..=1.0)?;
        within("polyak", config.polyak, 0.0..=1.0)?;
        within("initial_alpha", config.initial_alpha, f64::MIN_POSITIVE..=1e6)?;
        let form = PolicyForm::TanhGaussian;
        let actor = ActorConfig {
            form,
            hidden: config.hidden.clone(),
            lr: config.policy_lr.unwrap_or(config.lr),
            cosine: false,
            ..Default::default()
        };
        let members = buffer.streams();
        let trainable = device.clone().autodiff();
        let critic = MlpConfig::relu(buffer.inputs().len() + buffer.act_dim(), &config.hidden, 1);
        let critic = if config.layer_norm { critic.with_layer_norm() } else { critic };
        let log_alpha = Tensor::full([members.len(), 1, 1], config.initial_alpha.ln(), &trainable);
        Ok(Self {
            target_entropy: config.target_entropy.unwrap_or(-(buffer.act_dim() as f64)),
            actor: Actor::new(buffer, &actor, 0, device)?,
            critics: Twins::with(&critic, &members, &trainable),
            temperature: Trained::new(Temperature { log_alpha: Param::from_tensor(log_alpha) }),
            members,
            device: device.clone(),
            config: config.clone(),
        })
    }

    /// Returns one action per member for one observation per member, `[P, inputs]` as network inputs. Actions are
    /// sampled with the noise `step` of each member's stream `exploration`. Row-major `[P, d_a]`.
    pub fn act(&self, observations: &[f32], step: u64) -> Vec<f32> {
        let p = self.members.len();
        let s = tensor(observations.to_vec(), [p, 1, observations.len() / p], &self.device);
        host(self.actor.frozen(s).sample_with_log_prob(&self.members, "exploration", step).0)
    }

    /// Starts from the weights of a trained policy, read from `path`.
    ///
    /// # Errors
    /// As [`Actor::begin_with`].
    pub fn begin_with(&mut self, policy: &MlpPolicy, path: &Path) -> Result<(), LearnError> {
        self.actor.begin_with(policy, path)
    }

    /// The device of the networks; batches are created on it.
    pub fn device(&self) -> Device {
        self.device.clone()
    }

    /// α per member.
    pub fn alpha(&self) -> Vec<f32> {
        host(self.temperature.net().log_alpha.val().exp())
    }
}

impl Learner for Sac {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let Self { config: c, target_entropy, actor, critics, temperature, members, .. } = self;
        let alpha = temperature.net().log_alpha.val().inner().exp();

        // L_Q. The policy at s is computed in parallel, because it does not depend on L_Q. It is skipped if the policy
        // does not learn: autodiff keeps a graph without a backward pass, which slows it down.
        let policy_learns = step >= c.policy_start;
        let (y, drawn) = rayon::join(
            || {
                let (a2, log_prob) = actor.frozen(batch.s2.clone()).sample_with_log_prob(members, "next action", step);
                let (s2a2, [one, two]) = (state_action(&batch.s2, a2), &critics.pair);
                let q = one.target(s2a2.clone()).min_pair(two.target(s2a2));
                batch.r.clone() + batch.not_done.clone() * (q - alpha.clone() * log_prob) * c.discount
            },
            || policy_learns.then(|| actor.forward(batch.s.clone()).sample_with_log_prob(members, "action", step)),
        );
        let polyak = if policy_learns { c.polyak } else { (EAGER * c.polyak).min(1.0) };
        let loss = critics.step(state_action(&batch.s, batch.a.clone()), y, None, c.lr, polyak);
        meter.record("critic_loss", &loss);

        // L_π: gradients reach the action through the critics, whose weights do not change.
        let Some((a, log_prob)) = drawn else { return };
        let sa = state_action(&batch.s, a);
        let [one, two] = &critics.pair;
        let (q1, q2) = rayon::join(|| one.frozen(sa.clone()), || two.frozen(sa.clone()));
        drop(sa);
        let entropy = log_prob.clone().inner();
        let loss = member_mean(log_prob * alpha.clone() - q1.min_pair(q2));
        meter.record("policy_loss", &loss);
        actor.step(loss, step);

        // L_α
        let error = member_mean(entropy.clone() + *target_entropy);
        temperature.step((temperature.net().log_alpha.val() * error).sum().neg(), c.lr);
        meter.record("entropy", &entropy.neg());
        meter.record("alpha", &alpha);
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.actor.save(&mut state);
        self.critics.save(&mut state);
        self.temperature.save("temperature", &mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.actor.load(state, path)?;
        self.critics.load(state, path)?;
        self.temperature.load("temperature", state, path)
    }
}

impl PolicyLearner for Sac {
    fn policies(&self) -> Vec<Policy> {
        self.actor.policies()
    }
}
