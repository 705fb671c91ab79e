//! Conditional variational autoencoders: of π_b(a|s), the policy that collected the data (as in BCQ; TCE, OTDF, DmC,
//! BOSA), and of the dynamics p(s'|s, a) (BOSA).
//!
//! ```text
//! behaviour c = s, x = a;  dynamics c = (s, a), x = s'
//! encoder  (c, x) → 750 → 750 → (m, ln σ), ln σ clipped to [-4, 15]      latent z of 2 dim(x) dimensions
//! decoder  (c, z) → 750 → 750 → x; tanh for actions
//! L = mean (decoder(c, m + σ n) - x)² + ½ KL(N(m, σ²) ‖ N(0, I))         both means over rows and dimensions
//! draws    x̂ = decoder(c, z), z ~ N(0, I)
//! density  ln p̂(x|c) = logsumexp over k of [Σ_d ln N(x_d; decoder(c, z_k)_d, β²) + ln N(z_k; 0, I) - ln q(z_k|c, x)] - ln K,
//!          z_1..K ~ q = N(m, σ²)                                          (IWAE; OTDF leaves out all but the first term)
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `hidden` | 750, 750 ReLU | OTDF |
//! | - | `latent_per_action` | 2 | OTDF; per dimension of x |
//! | ½ | `kl_weight` | .5 | OTDF |
//! | - | `lr` | 1e-3 | OTDF |
//! | - | `steps` | 10 000 | OTDF |
//! | - | `batch` | 128 target rows | OTDF; BOSA: rows of both domains |

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::{Activation, Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained};

use crate::blocks::map_rows;
use crate::buffer::{Buffer, Minibatch};
use crate::critic::state_action;
use crate::error::{LearnError, within};
use crate::losses::{kl_to_standard_normal, member_mean, normal_log_prob, squared_error};
use crate::training::{Learner, Meter, Place, member_noise, prepare};

/// Range of the posterior's ln σ.
const LOG_STD_RANGE: (f32, f32) = (-4.0, 15.0);

/// The configuration of a [`CvaeLearner`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default = "CvaeConfig::paper")]
pub struct CvaeConfig {
    /// Widths of the hidden layers of encoder and decoder. Source: OTDF, 750 and 750.
    pub hidden: Vec<usize>,
    /// Latent dimensions per dimension of what is modelled. Source: OTDF.
    pub latent_per_action: usize,
    /// Weight of the divergence from the prior beside the reconstruction. Source: OTDF.
    pub kl_weight: f64,
    /// Learning rate of the autoencoder, constant. Source: OTDF.
    pub lr: f64,
    /// Training steps of the autoencoder, before the learner's first. Source: OTDF, 10 000.
    pub steps: u64,
    /// Target rows per step; for BOSA, rows of both domains. Source: OTDF.
    pub batch: usize,
}

impl CvaeConfig {
    /// OTDF's settings, which the paper adopts.
    pub fn paper() -> Self {
        Self { hidden: vec![750, 750], latent_per_action: 2, kl_weight: 0.5, lr: 1e-3, steps: 10_000, batch: 128 }
    }
}

/// The modelled variable and its condition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Modelled {
    /// a given s.
    Behaviour,
    /// s' given s and a.
    Dynamics,
}

impl Modelled {
    /// (c, x) of a batch.
    pub fn split(self, batch: &Minibatch) -> (Tensor<3>, Tensor<3>) {
        match self {
            Modelled::Behaviour => (batch.s.clone(), batch.a.clone()),
            Modelled::Dynamics => (state_action(&batch.s, batch.a.clone()), batch.s2.clone()),
        }
    }
}

/// Settings of the estimate in [`Cvae::log_density`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Density {
    /// K
    pub samples: usize,
    /// β
    pub std: f64,
    /// Whether to include the densities of z and - ln K, as in the importance-weighted bound; OTDF omits them.
    pub importance: bool,
}

/// Encoder and decoder of a population.
#[derive(Module, Debug)]
pub struct Cvae {
    encoder: Mlp,
    decoder: Mlp,
}

impl Cvae {
    /// (m, ln σ) of the posterior of z, each `[P, B, latent]`.
    pub fn encode(&self, c: Tensor<3>, x: Tensor<3>) -> (Tensor<3>, Tensor<3>) {
        let out = self.encoder.forward(Tensor::cat(vec![c, x], 2));
        let z = out.dims()[2] / 2;
        (out.clone().narrow(2, 0, z), out.narrow(2, z, z).clamp(LOG_STD_RANGE.0, LOG_STD_RANGE.1))
    }

    /// x̂; actions in (-1, 1).
    pub fn decode(&self, c: Tensor<3>, z: Tensor<3>) -> Tensor<3> {
        self.decoder.forward(Tensor::cat(vec![c, z], 2))
    }

    /// ln p̂(x|c), `[P, B, 1]`; gradients flow to `x`. The noise is that of `step` in each member's stream `name`.
    pub fn log_density(
        &self,
        c: Tensor<3>,
        x: Tensor<3>,
        density: Density,
        members: &[Streams],
        name: &str,
        step: u64,
    ) -> Tensor<3> {
        let ([p, b, given], dims, k, device) = (c.dims(), x.dims()[2], density.samples, c.device());
        let (mean, log_std) = self.encode(c.clone(), x.clone());
        let latent = mean.dims()[2];
        let repeat = |t: Tensor<3>, width: usize| -> Tensor<3> {
            t.reshape([p, b, 1, width]).expand([p, b, k, width]).reshape([p, b * k, width])
        };
        let noise = member_noise(members, name, step, [p, b * k, latent], &device);
        let (mean, log_std) = (repeat(mean, latent), repeat(log_std, latent));
        let z = mean.clone() + log_std.clone().exp() * noise;
        let decoded = self.decode(repeat(c, given), z.clone());
        let ln_beta = Tensor::<3>::full([1, 1, dims], density.std.ln(), &device);
        let mut term = normal_log_prob(repeat(x, dims), decoded, ln_beta);
        if density.importance {
            let prior = normal_log_prob(z.clone(), Tensor::zeros_like(&z), Tensor::<3>::zeros([1, 1, latent], &device));
            term = term + prior - normal_log_prob(z, mean, log_std);
        }
        let term = term.reshape([p, b, k]);
        // The largest term is factored out, so that no exponential underflows.
        let greatest = term.clone().inner().max_dim(2);
        let sum = (term - greatest.clone()).exp().sum_dim(2).log() + greatest;
        if density.importance { sum - (k as f64).ln() } else { sum }
    }

    /// Number of latent dimensions.
    pub fn latent(&self) -> usize {
        self.encoder.layers.last().map_or(0, |l| l.weight.val().dims()[2] / 2)
    }

    /// `draws` actions for each state: `states[m]` `[N, inputs]` of member m as network inputs, result
    /// `[N, draws, d_a]`. Member m's noise comes from its stream `cvae draws`.
    pub fn draw(
        &self,
        states: &[Vec<f32>],
        inputs: usize,
        members: &[Streams],
        draws: usize,
        device: &Device,
    ) -> Vec<Vec<f32>> {
        map_rows(states, inputs, device, |block, s| {
            let [p, rows, _] = s.dims();
            let z = member_noise(members, "cvae draws", block as u64, [p, rows * draws, self.latent()], device);
            let s = s.reshape([p, rows, 1, inputs]).expand([p, rows, draws, inputs]).reshape([p, rows * draws, inputs]);
            self.decode(s, z)
        })
    }
}

/// Trains a [`Cvae`] on a buffer's rows.
pub struct CvaeLearner {
    net: Trained<Cvae>,
    members: Vec<Streams>,
    config: CvaeConfig,
    modelled: Modelled,
    name: String,
}

impl CvaeLearner {
    /// New networks for the members of `buffer`; `name` distinguishes their random streams from others.
    ///
    /// # Errors
    /// If a number of the configuration is out of range.
    pub fn new(
        buffer: &Buffer,
        config: &CvaeConfig,
        modelled: Modelled,
        name: &str,
        device: &Device,
    ) -> Result<Self, LearnError> {
        within("cvae.lr", config.lr, 0.0..=1.0)?;
        within("cvae.kl_weight", config.kl_weight, 0.0..=1e6)?;
        within("cvae.latent_per_action", config.latent_per_action as f64, 1.0..=1e3)?;
        let (inputs, actions) = (buffer.inputs().len(), buffer.act_dim());
        let (given, dims, output) = match modelled {
            Modelled::Behaviour => (inputs, actions, Activation::Tanh),
            Modelled::Dynamics => (inputs + actions, inputs, Activation::Identity),
        };
        let latent = config.latent_per_action * dims;
        let (members, device) = (buffer.streams(), device.clone().autodiff());
        let encoder = MlpConfig::relu(given + dims, &config.hidden, 2 * latent);
        let decoder = MlpConfig::relu(given + latent, &config.hidden, dims).with_output_activation(output);
        let net = Cvae {
            encoder: encoder.init(&members, &format!("{name} encoder"), &device),
            decoder: decoder.init(&members, &format!("{name} decoder"), &device),
        };
        Ok(Self { net: Trained::new(net), members, config: config.clone(), modelled, name: name.to_owned() })
    }

    /// The current model, outside of autodiff.
    pub fn model(&self) -> Cvae {
        self.net.net().valid()
    }
}

impl Learner for CvaeLearner {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let (c, x) = self.modelled.split(batch);
        let (mean, log_std) = self.net.net().encode(c.clone(), x.clone());
        let noise = member_noise(&self.members, &format!("{} noise", self.name), step, mean.dims(), &x.device());
        let z = mean.clone() + log_std.clone().exp() * noise;
        let reconstruction = member_mean(squared_error(self.net.net().decode(c, z), x));
        let divergence = kl_to_standard_normal(mean, log_std);
        if meter.active() {
            meter.record(&format!("{}_reconstruction", self.name), &reconstruction);
            meter.record(&format!("{}_divergence", self.name), &divergence);
        }
        let loss = reconstruction + divergence * self.config.kl_weight;
        self.net.step(loss.sum(), self.config.lr);
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.net.save(&self.name, &mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.net.load(&self.name, state, path)
    }
}

/// Trains a behaviour CVAE on the target rows of `buffer`. `None` if the user interrupted it.
///
/// # Errors
/// If the configuration cannot be used, or a checkpoint cannot be read or written.
pub fn train_cvae(
    buffer: &Buffer,
    config: &CvaeConfig,
    place: Place<'_>,
    device: &Device,
) -> Result<Option<Cvae>, LearnError> {
    let target = buffer.target_only(config.batch)?.with_stream("cvae batch");
    let mut learner = CvaeLearner::new(&target, config, Modelled::Behaviour, "cvae", device)?;
    let done = prepare(&mut learner, &target, config.steps, "behaviour CVAE", place, device)?;
    Ok(done.then(|| learner.model()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buffer::Member;
    use std::path::Path;
    use std::sync::Arc;
    use tce_data::{Standardizer, Transitions};
    use tce_nn::{cpu, host, tensor};

    /// With a decoder that ignores z, all K terms are the same normal density around its output.
    #[test]
    fn the_behaviour_density_follows_its_formula() {
        let mut t = Transitions::new(2, 1);
        t.push(&[0.0, 1.0], &[0.5], 0.0, &[0.0, 0.0], false, true);
        let member = Member {
            streams: Streams::new(1),
            parts: vec![Arc::new(t)],
            standardizer: Standardizer::identity(2),
            reward_scale: 1.0,
            row_scores: None,
        };
        let buffer = Buffer::new(vec![member], 1).unwrap();
        let config = CvaeConfig { hidden: vec![8], ..CvaeConfig::paper() };
        let cvae = CvaeLearner::new(&buffer, &config, Modelled::Behaviour, "cvae", &cpu()).unwrap().model();
        let mut weights = NamedParameters::default();
        weights.collect("cvae", &cvae);
        let first = weights.tensors.get_mut("cvae.decoder.layers.0.weight").unwrap();
        assert_eq!(first.0, [1, 4, 8]);
        first.1[2 * 8..].fill(0.0);
        // Also q(z) = N(.5, 1.5²), independent of s and a.
        weights.tensors.get_mut("cvae.encoder.layers.1.weight").unwrap().1.fill(0.0);
        weights.tensors.get_mut("cvae.encoder.layers.1.bias").unwrap().1 = vec![0.5, 0.5, 1.5f32.ln(), 1.5f32.ln()];
        let cvae = weights.apply("cvae", cvae, Path::new("test")).unwrap();

        let s = tensor(vec![0.3, -0.4, 1.0, 2.0], [1, 2, 2], &cpu());
        let a = tensor(vec![0.2, -0.9], [1, 2, 1], &cpu().autodiff()).require_grad();
        let mean = host(cvae.decode(s.clone(), Tensor::zeros([1, 2, 2], &cpu())));
        let estimate = |a: Tensor<3>, samples, importance| {
            let density = Density { samples, std: 0.5, importance };
            cvae.log_density(s.clone(), a, density, &buffer.streams(), "noise", 3)
        };
        // The weights N(z; 0, I) / q(z) have a mean of 1.
        let bound = host(estimate(a.clone(), 20_000, true));
        let density = estimate(a.clone(), 5, false);
        let grads = density.clone().sum().backward();
        let (density, gradient) = (host(density), host(a.grad(&grads).unwrap()));
        for (i, a) in [0.2f32, -0.9].into_iter().enumerate() {
            let z = (a - mean[i]) / 0.5;
            let expected = 5f32.ln() - 0.5 * z * z - 0.5f32.ln() - 0.5 * (2.0 * std::f32::consts::PI).ln();
            assert!((density[i] - expected).abs() < 1e-4, "{} is not {expected}", density[i]);
            assert!((gradient[i] + z / 0.5).abs() < 1e-4);
            assert!((bound[i] - (expected - 5f32.ln())).abs() < 0.05, "{} is not {}", bound[i], expected - 5f32.ln());
        }
    }
}
