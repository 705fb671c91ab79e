//! The policy during training: imitation of actions, with one weight per row.
//!
//! L_π = mean over rows of w · ℓ(s, a), with ℓ = -log π(a|s) up to constants:
//!
//! | form | π | ℓ(s, a) |
//! |---|---|---|
//! | [`PolicyForm::TanhMean`] | deterministic tanh(μ(s)) | mean over d of (tanh μ_d - a_d)² |
//! | [`PolicyForm::TanhGaussian`] | tanh(μ + σ(s) n) | the same; σ is learned through a regulariser only (OTDF) |
//! | [`PolicyForm::Gaussian`] | N(tanh μ(s), σ²), σ independent of s | -Σ_d ln N(a_d; tanh μ_d, σ_d²) |
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `form` | tanh mean | OTDF, ODRL |
//! | - | `hidden` | 256, 256 ReLU | OTDF, ODRL, IQL |
//! | - | `lr` | 3e-4 | Table C.4 |
//! | - | `cosine` | to 0 over the training | OTDF, ODRL, IQL |
//! | - | `action_reduction` | mean | ODRL; OTDF sums, which multiplies ℓ by d_a and so divides β_reg by it |
//! | ln σ ∈ [-5, 2] | - | - | IQL's authors |

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::burn::module::Param;
use tce_nn::{
    Activation, Averaged, Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained, cosine_decay,
    host,
};

use crate::buffer::Buffer;
use crate::error::{LearnError, within};
use crate::losses::{member_mean, normal_log_prob, squared_error};
use crate::mlp_policy::{Head, LOG_STD_RANGE, MlpPolicy, PolicySpec, from_population};
use crate::policy::Policy;
use crate::training::member_noise;

/// Range of a state-independent ln σ.
const FREE_LOG_STD_RANGE: (f32, f32) = (-5.0, 2.0);
/// Range of ln σ in [`Actor::likelihood_loss`]: a smaller σ makes single rows count for a thousand others.
const CLONE_LOG_STD_RANGE: (f32, f32) = (-3.0, 1.0);
/// The largest action whose atanh is taken, 3.8; that of 1 is infinite.
const LARGEST_ACTION: f32 = 0.999;

/// What kind of distribution a policy is; see the [module](self).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PolicyForm {
    /// Deterministic.
    #[default]
    TanhMean,
    /// Squashed normal with a standard deviation per state.
    TanhGaussian,
    /// Normal with a standard deviation per action dimension.
    Gaussian,
}

/// How the squared errors of an action's components become one number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ActionReduction {
    /// Their mean.
    #[default]
    Mean,
    /// Their sum.
    Sum,
}

/// The policy's part of a learner's configuration; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ActorConfig {
    /// Kind of distribution. IQL chooses it by `policy_extraction` and `regulariser`, whatever is written here.
    pub form: PolicyForm,
    /// Widths of the hidden layers of the policy.
    pub hidden: Vec<usize>,
    /// Learning rate of the policy at the beginning.
    pub lr: f64,
    /// Whether the learning rate falls to 0 over the training along a cosine.
    pub cosine: bool,
    /// How the squared errors of an action's components become one number, for the forms with a squared error.
    pub action_reduction: ActionReduction,
}

impl Default for ActorConfig {
    fn default() -> Self {
        Self {
            form: PolicyForm::default(),
            hidden: vec![256, 256],
            lr: 3e-4,
            cosine: true,
            action_reduction: ActionReduction::default(),
        }
    }
}

/// μ(s) and, for [`PolicyForm::Gaussian`], ln σ.
#[derive(Module, Debug)]
pub struct ActorNet {
    /// s → tanh μ, or (μ, ln σ).
    pub mlp: Mlp,
    /// `[P, 1, A]`
    pub log_std: Option<Param<Tensor<3>>>,
}

/// π(·|s) at the rows of a batch.
pub struct PolicyOutput {
    /// tanh(μ), `[P, B, A]`.
    pub mean: Tensor<3>,
    /// μ before the tanh and ln σ, for [`PolicyForm::TanhGaussian`].
    pre_tanh: Option<(Tensor<3>, Tensor<3>)>,
    /// ln σ, `[P, 1, A]`, for [`PolicyForm::Gaussian`].
    log_std: Option<Tensor<3>>,
}

impl PolicyOutput {
    /// The output for the first `rows` rows.
    pub fn first(&self, rows: usize) -> Self {
        let cut = |t: &Tensor<3>| t.clone().narrow(1, 0, rows);
        Self {
            mean: cut(&self.mean),
            pre_tanh: self.pre_tanh.as_ref().map(|(m, s)| (cut(m), cut(s))),
            log_std: self.log_std.clone(),
        }
    }

    /// A sample tanh(μ + σ n) with gradients through it; the noise of `step` comes from each member's streams.
    ///
    /// # Panics
    /// If the form is not [`PolicyForm::TanhGaussian`].
    pub fn sample(&self, members: &[Streams], step: u64) -> Tensor<3> {
        self.draw(members, "policy noise", step).action
    }

    /// A sample ã = tanh(u), u = μ + σ n, and its log density Σ_d ln N(u_d; μ_d, σ_d²) - ln(1 - tanh² u_d),
    /// `[P, B, 1]`. n comes from the members' streams `name`, index `step`.
    ///
    /// # Panics
    /// If the form is not [`PolicyForm::TanhGaussian`].
    pub fn sample_with_log_prob(&self, members: &[Streams], name: &str, step: u64) -> (Tensor<3>, Tensor<3>) {
        let Draw { noise, u, action, log_std } = self.draw(members, name, step);
        // ln(1 - tanh² u) = 2 (ln 2 - |u| - ln(1 + e^(-2|u|))): avoids the logarithm of a number near zero.
        let magnitude = u.abs();
        let softplus = (magnitude.clone() * -2.0).exp().log1p();
        let squash = ((magnitude + softplus).neg() + std::f64::consts::LN_2) * 2.0;
        // (u - μ) / σ equals the drawn n. Computed from u, it would have rounding errors that a small σ amplifies.
        let normal = (noise.powi_scalar(2) * -0.5 - log_std - 0.5 * std::f64::consts::TAU.ln()) - squash;
        (action, normal.sum_dim(2))
    }

    fn draw(&self, members: &[Streams], name: &str, step: u64) -> Draw {
        let (mean, log_std) = self.pre_tanh.as_ref().expect("only a tanh-Gaussian policy is sampled in training");
        let noise = member_noise(members, name, step, mean.dims(), &mean.device().inner());
        let log_std = log_std.clone();
        let u = mean.clone() + log_std.clone().exp() * noise.clone();
        Draw { noise, action: u.clone().tanh(), u, log_std }
    }
}

/// n, u = μ + σ n, tanh u and ln σ, each `[P, B, A]`.
struct Draw {
    noise: Tensor<3>,
    u: Tensor<3>,
    action: Tensor<3>,
    log_std: Tensor<3>,
}

/// The policies of a population and their optimiser.
pub struct Actor {
    net: Trained<ActorNet>,
    config: ActorConfig,
    specs: Vec<PolicySpec>,
    /// Number of steps over which the learning rate decays.
    steps: u64,
}

impl Actor {
    /// New policies for the members of `buffer`, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If a number of the configuration is out of range.
    pub fn new(buffer: &Buffer, config: &ActorConfig, steps: u64, device: &Device) -> Result<Self, LearnError> {
        Self::named("policy", buffer, config, steps, device)
    }

    /// [`Actor::new`] with initial weights from the members' streams `name`.
    ///
    /// # Errors
    /// As [`Actor::new`].
    pub fn named(
        name: &str,
        buffer: &Buffer,
        config: &ActorConfig,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        within("lr", config.lr, 0.0..=1.0)?;
        let (head, output_activation) = match config.form {
            PolicyForm::TanhMean => (Head::Mean, Activation::Tanh),
            PolicyForm::TanhGaussian => (Head::TanhGaussian, Activation::Identity),
            // Filled in when the policies are extracted.
            PolicyForm::Gaussian => (Head::Gaussian { log_std: Vec::new() }, Activation::Tanh),
        };
        let spec = |member: &crate::buffer::Member| PolicySpec {
            observations: buffer.obs_dim(),
            actions: buffer.act_dim(),
            inputs: buffer.inputs().to_vec(),
            standardizer: member.standardizer.clone(),
            clip: None,
            hidden: config.hidden.clone(),
            activation: Activation::Relu,
            output_activation,
            head: head.clone(),
            log_std_range: None,
        };
        let specs: Vec<PolicySpec> = buffer.members().iter().map(spec).collect();
        let device = device.clone().autodiff();
        let log_std = matches!(config.form, PolicyForm::Gaussian)
            .then(|| Param::from_tensor(Tensor::zeros([specs.len(), 1, buffer.act_dim()], &device)));
        let mlp: MlpConfig = specs[0].network();
        let net = ActorNet { mlp: mlp.init(&buffer.streams(), name, &device), log_std };
        Ok(Self { net: Trained::new(net), config: config.clone(), specs, steps })
    }

    /// The same policies, which sample in the range of ln σ that [`Actor::likelihood_loss`] trains: outside of it the
    /// network's ln σ has learned nothing.
    pub(crate) fn sampling_as_cloned(mut self) -> Self {
        self.specs.iter_mut().for_each(|spec| spec.log_std_range = Some(CLONE_LOG_STD_RANGE));
        self
    }

    /// Replaces the initial weights by those of `policy`, which was read from `path`; the optimiser stays new.
    ///
    /// # Errors
    /// If it is not a network with the same inputs, layers and form, or this population has several members.
    pub fn begin_with(&mut self, policy: &MlpPolicy, path: &Path) -> Result<(), LearnError> {
        // A clone by likelihood has a range of ln σ of its own, which does not matter to who goes on training it.
        let given = PolicySpec { log_std_range: None, ..policy.spec().clone() };
        if self.specs.len() != 1 || given != self.specs[0] {
            let (path, field) = (path.to_owned(), "policy".to_owned());
            let say = |s: &PolicySpec| {
                let plain =
                    s.standardizer.mean.iter().all(|m| *m == 0.0) && s.standardizer.std.iter().all(|s| *s == 1.0);
                let units = if plain { "as they are" } else { "standardised" };
                let layers = format!("hidden layers {:?}, {:?}", s.hidden, s.head);
                format!("{} observations {units}, {} actions, {layers}", s.observations, s.actions)
            };
            let (found, expected) = (say(policy.spec()), say(&self.specs[0]));
            let remedy = "give a policy that `tce train-sac` wrote, of the same robot".to_owned();
            return Err(LearnError::Policy { path, field, found, expected, remedy });
        }
        let net = self.net.net().clone();
        let mlp = policy.to_parameters().apply("policy", net.mlp, path)?;
        self.net = Trained::new(ActorNet { mlp, ..net });
        Ok(())
    }

    /// π(·|s).
    pub fn forward(&self, s: Tensor<3>) -> PolicyOutput {
        self.output(self.net.net(), s)
    }

    /// π(·|s) with `hidden` applied to the output of every hidden layer.
    pub fn forward_with(&self, s: Tensor<3>, hidden: impl FnMut(Tensor<3>) -> Tensor<3>) -> PolicyOutput {
        let net = self.net.net();
        self.head(net, net.mlp.forward_with(s, hidden))
    }

    /// A target network of the policy, initialised with its weights; [`Actor::step_averaged`] updates it.
    pub fn follower(&self) -> Averaged<ActorNet> {
        Averaged::new(self.net.net())
    }

    /// The action tanh μ(s) `[P, B, A]` of a [`Actor::follower`], outside of autodiff.
    pub fn followed(&self, follower: &Averaged<ActorNet>, s: Tensor<3>) -> Tensor<3> {
        self.output(follower.net(), s).mean
    }

    /// π(·|s) outside of autodiff.
    pub fn frozen(&self, s: Tensor<3>) -> PolicyOutput {
        self.output(&self.net.net().valid(), s)
    }

    fn output(&self, net: &ActorNet, s: Tensor<3>) -> PolicyOutput {
        self.head(net, net.mlp.forward(s))
    }

    fn head(&self, net: &ActorNet, out: Tensor<3>) -> PolicyOutput {
        let log_std = net.log_std.as_ref().map(|p| p.val().clamp(FREE_LOG_STD_RANGE.0, FREE_LOG_STD_RANGE.1));
        if self.config.form != PolicyForm::TanhGaussian {
            return PolicyOutput { mean: out, pre_tanh: None, log_std };
        }
        let a = out.dims()[2] / 2;
        let (mean, log_std) = (out.clone().narrow(2, 0, a), out.narrow(2, a, a));
        let log_std = log_std.clamp(LOG_STD_RANGE.0, LOG_STD_RANGE.1);
        PolicyOutput { mean: mean.clone().tanh(), pre_tanh: Some((mean, log_std)), log_std: None }
    }

    /// mean over rows and components of (tanh μ(s) - a)², per member, whatever the form.
    pub fn squared_loss(output: &PolicyOutput, a: Tensor<3>) -> Tensor<3> {
        member_mean(squared_error(output.mean.clone(), a))
    }

    /// mean over rows of w · ℓ(s, a), per member. `weights` is `[P, B, 1]`; `None` means 1.
    pub fn imitation_loss(&self, output: &PolicyOutput, a: Tensor<3>, weights: Option<Tensor<3>>) -> Tensor<3> {
        let per_row = match &output.log_std {
            Some(log_std) => -normal_log_prob(a, output.mean.clone(), log_std.clone()),
            None => {
                let error = squared_error(output.mean.clone(), a);
                match self.config.action_reduction {
                    ActionReduction::Mean => error.mean_dim(2),
                    ActionReduction::Sum => error.sum_dim(2),
                }
            }
        };
        member_mean(match weights {
            Some(w) => per_row * w,
            None => per_row,
        })
    }

    /// The likelihood of the actions under a tanh-Gaussian policy, as β-NLL has it: mean over rows and components of
    /// σ^(2β) ((u - μ)² / (2σ²) + ln σ), with u = atanh a and the first factor a constant, per member. β = 0 is the negative
    /// log-likelihood, which gives up on rows that are far off; β = 1 has the gradient of the squared error for μ. Source: Seitzer et al. 2022.
    ///
    /// # Panics
    /// If the form is not [`PolicyForm::TanhGaussian`].
    pub fn likelihood_loss(output: &PolicyOutput, a: Tensor<3>, beta: f64) -> Tensor<3> {
        let (mean, log_std) = output.pre_tanh.as_ref().expect("only a tanh-Gaussian policy has a likelihood");
        let a = a.clamp(-LARGEST_ACTION, LARGEST_ACTION);
        // atanh a
        let u = Tensor::from_inner(((a.clone() + 1.0).log() - (a.neg() + 1.0).log()) * 0.5);
        let log_std = log_std.clone().clamp(CLONE_LOG_STD_RANGE.0, CLONE_LOG_STD_RANGE.1);
        let z = (u - mean.clone()) / log_std.clone().exp();
        // Outside of autodiff: a detached copy would hold on to the graph.
        let factor = Tensor::from_inner((log_std.clone().inner() * (2.0 * beta)).exp());
        member_mean(((z.powi_scalar(2) * 0.5 + log_std) * factor).mean_dim(2))
    }

    /// One optimiser step on the sum of the members' losses, with the learning rate of `step`.
    pub fn step(&mut self, loss: Tensor<3>, step: u64) {
        let lr = self.learning_rate(step);
        self.net.step(loss.sum(), lr);
    }

    /// [`Actor::step`], then one step of `follower` towards the policy with `rate`.
    pub fn step_averaged(&mut self, loss: Tensor<3>, step: u64, follower: &mut Averaged<ActorNet>, rate: f64) {
        let lr = self.learning_rate(step);
        self.net.step_averaged(loss.sum(), lr, follower, rate);
    }

    fn learning_rate(&self, step: u64) -> f64 {
        if self.config.cosine { cosine_decay(self.config.lr, step, self.steps) } else { self.config.lr }
    }

    /// The current policies.
    pub fn policies(&self) -> Vec<Policy> {
        let mut specs = self.specs.clone();
        if let Some(log_std) = &self.net.net().log_std {
            let values = host(log_std.val().clamp(FREE_LOG_STD_RANGE.0, FREE_LOG_STD_RANGE.1));
            for (spec, values) in specs.iter_mut().zip(values.chunks(self.specs[0].actions)) {
                spec.head = Head::Gaussian { log_std: values.to_vec() };
            }
        }
        from_population(specs, &self.net.net().mlp).into_iter().map(Policy::from).collect()
    }

    /// Adds parameters and optimiser to `state`.
    pub fn save(&self, state: &mut NamedParameters) {
        self.net.save("policy", state);
    }

    /// Restores parameters and optimiser from `state`.
    ///
    /// # Errors
    /// If they belong to another policy.
    pub fn load(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.net.load("policy", state, path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_nn::{cpu, tensor};

    /// Against the formula, worked out by hand: two rows of one component.
    #[test]
    fn the_likelihood_loss_follows_its_formula() {
        let device = cpu().autodiff();
        let part = |values: [f32; 2]| tensor(values.to_vec(), [1, 2, 1], &device);
        let (mean, log_std) = ([0.2f32, -1.0], [-1.0f32, 0.5]);
        let output =
            PolicyOutput { mean: part(mean).tanh(), pre_tanh: Some((part(mean), part(log_std))), log_std: None };
        let actions = [0.5f32, 1.0];
        for beta in [0.0, 0.5, 1.0] {
            let row = |k: usize| {
                let u = f64::from(actions[k].min(LARGEST_ACTION)).atanh();
                let (m, s) = (f64::from(mean[k]), f64::from(log_std[k]));
                (2.0 * beta * s).exp() * (0.5 * ((u - m) / s.exp()).powi(2) + s)
            };
            let loss = Actor::likelihood_loss(&output, tensor(actions.to_vec(), [1, 2, 1], &cpu()), beta);
            let (found, expected) = (f64::from(host(loss.inner())[0]), (row(0) + row(1)) / 2.0);
            assert!((found - expected).abs() < 1e-3 * expected.abs(), "β = {beta}: {found}, {expected}");
        }
    }
}
