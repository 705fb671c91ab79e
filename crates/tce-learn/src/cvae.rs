//! The behaviour CVAE: a model of π_b(a|s), the policy that collected the target data (as in BCQ; OTDF, DmC and BOSA).
//!
//! ```text
//! encoder  (s, a) → 750 → 750 → (m, ln σ), ln σ clipped to [-4, 15]      latent z of 2 d_a dimensions
//! decoder  (s, z) → 750 → 750 → tanh
//! L = mean (decoder(s, m + σ n) - a)² + ½ KL(N(m, σ²) ‖ N(0, I))         both means over rows and dimensions
//! draws    â = decoder(s, z), z ~ N(0, I)
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `hidden` | 750, 750 ReLU | OTDF |
//! | - | `latent_per_action` | 2 | OTDF |
//! | ½ | `kl_weight` | .5 | OTDF |
//! | - | `lr` | 1e-3 | OTDF |
//! | - | `steps` | 10 000 | OTDF |
//! | - | `batch` | 128 target rows | OTDF |

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::{Activation, Checkpoints, Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained};

use crate::blocks::map_rows;
use crate::buffer::{Buffer, Minibatch};
use crate::error::{LearnError, within};
use crate::losses::{kl_to_standard_normal, member_mean, squared_error};
use crate::training::{Learner, Meter, Steps, member_noise, train};

/// Range of the posterior's ln σ.
const LOG_STD_RANGE: (f32, f32) = (-4.0, 15.0);

/// The configuration of a [`CvaeLearner`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CvaeConfig {
    /// Hidden layers of encoder and decoder.
    pub hidden: Vec<usize>,
    /// Latent dimensions per action dimension.
    pub latent_per_action: usize,
    /// Weight of the divergence.
    pub kl_weight: f64,
    /// Learning rate, constant.
    pub lr: f64,
    /// Training steps.
    pub steps: u64,
    /// Target rows per step.
    pub batch: usize,
}

impl Default for CvaeConfig {
    fn default() -> Self {
        Self { hidden: vec![750, 750], latent_per_action: 2, kl_weight: 0.5, lr: 1e-3, steps: 10_000, batch: 128 }
    }
}

/// Encoder and decoder of a population.
#[derive(Module, Debug)]
pub struct Cvae {
    encoder: Mlp,
    decoder: Mlp,
}

impl Cvae {
    /// (m, ln σ) of the posterior of z, each `[P, B, 2 d_a]`.
    pub fn encode(&self, s: Tensor<3>, a: Tensor<3>) -> (Tensor<3>, Tensor<3>) {
        let out = self.encoder.forward(Tensor::cat(vec![s, a], 2));
        let z = out.dims()[2] / 2;
        (out.clone().narrow(2, 0, z), out.narrow(2, z, z).clamp(LOG_STD_RANGE.0, LOG_STD_RANGE.1))
    }

    /// Actions in (-1, 1).
    pub fn decode(&self, s: Tensor<3>, z: Tensor<3>) -> Tensor<3> {
        self.decoder.forward(Tensor::cat(vec![s, z], 2))
    }

    /// Latent dimensions.
    pub fn latent(&self) -> usize {
        self.encoder.layers.last().map_or(0, |l| l.weight.val().dims()[2] / 2)
    }

    /// `draws` actions for each state: `states[m]` `[N, inputs]` of member m as the networks see them, result
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
}

impl CvaeLearner {
    /// New networks for the members of `buffer`.
    ///
    /// # Errors
    /// If a number of the configuration is out of range.
    pub fn new(buffer: &Buffer, config: &CvaeConfig, device: &Device) -> Result<Self, LearnError> {
        within("cvae.lr", config.lr, 0.0..=1.0)?;
        within("cvae.kl_weight", config.kl_weight, 0.0..=1e6)?;
        within("cvae.latent_per_action", config.latent_per_action as f64, 1.0..=1e3)?;
        let (inputs, actions) = (buffer.inputs().len(), buffer.act_dim());
        let latent = config.latent_per_action * actions;
        let (members, device) = (buffer.streams(), device.clone().autodiff());
        let encoder = MlpConfig::relu(inputs + actions, &config.hidden, 2 * latent);
        let decoder =
            MlpConfig::relu(inputs + latent, &config.hidden, actions).with_output_activation(Activation::Tanh);
        let net = Cvae {
            encoder: encoder.init(&members, "cvae encoder", &device),
            decoder: decoder.init(&members, "cvae decoder", &device),
        };
        Ok(Self { net: Trained::new(net), members, config: config.clone() })
    }

    /// The model as it is, outside of autodiff.
    pub fn model(&self) -> Cvae {
        self.net.net().valid()
    }
}

impl Learner for CvaeLearner {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let (mean, log_std) = self.net.net().encode(batch.s.clone(), batch.a.clone());
        let noise = member_noise(&self.members, "cvae noise", step, mean.dims(), &batch.s.device());
        let z = mean.clone() + log_std.clone().exp() * noise;
        let reconstruction = member_mean(squared_error(self.net.net().decode(batch.s.clone(), z), batch.a.clone()));
        let divergence = kl_to_standard_normal(mean, log_std);
        meter.record("cvae_reconstruction", &reconstruction);
        meter.record("cvae_divergence", &divergence);
        let loss = reconstruction + divergence * self.config.kl_weight;
        self.net.step(loss.sum(), self.config.lr);
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.net.save("cvae", &mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.net.load("cvae", state, path)
    }
}

/// Trains a behaviour CVAE on the target rows of `buffer`. None if the user interrupted it.
///
/// # Errors
/// If the configuration cannot be used.
pub fn train_cvae(buffer: &Buffer, config: &CvaeConfig, device: &Device) -> Result<Option<Cvae>, LearnError> {
    let target = buffer.target_only(config.batch)?.with_stream("cvae batch");
    let mut learner = CvaeLearner::new(&target, config, device)?;
    let steps = Steps::new(config.steps, 0);
    let outcome = train(&mut learner, &target, steps, "behaviour CVAE", &mut Checkpoints::none(), device, |_, _| {
        Ok::<_, LearnError>(())
    })?;
    Ok((!outcome.interrupted).then(|| learner.model()))
}
