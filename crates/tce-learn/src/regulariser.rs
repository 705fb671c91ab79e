//! What keeps a policy near the behaviour of the target data: the second term of Eq. 10 and B.14, and OTDF's.
//!
//! ```text
//! forward_kl  E over target states s of KL(π_b(·|s) ‖ π(·|s)) = E over â ~ π_b(·|s) of -log π(â|s) - H(π_b)
//! otdf        - mean over all rows of log β(a|s), a ~ π(·|s),
//!             log β(a|s) = logsumexp over k of Σ_d ln N(a_d; decoder(s, z_k)_d, β²), z_1..K ~ encoder(s, a)
//! ```
//!
//! π_b is the behaviour CVAE ([`crate::cvae`]). The entropy of π_b does not depend on the policy. For a deterministic
//! policy -log π(â|s) is the squared error, as in the first term of the loss (up to the same constants). Actions of π_b
//! are drawn before the training, `draws` per target row; step t uses draw t mod `draws` of each row in its batch.
//! OTDF leaves out - ln K and the prior and posterior densities of z; so do we.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `draws` | 8 | - |
//! | K | `samples` | 10 | OTDF |
//! | β | `std` | √(.4/4) = .316 | OTDF |

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::{Device, Tensor, tensor};

use crate::actor::{Actor, PolicyOutput};
use crate::buffer::{Buffer, Minibatch};
use crate::cvae::{Cvae, CvaeConfig, train_cvae};
use crate::error::LearnError;
use crate::losses::{member_mean, normal_log_prob};
use crate::training::member_noise;

/// Which term; see the [module](self).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RegulariserKind {
    /// No term.
    #[default]
    None,
    /// TCE's.
    ForwardKl,
    /// OTDF's.
    Otdf,
}

/// The constants of the terms; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RegulariserConfig {
    /// The behaviour model.
    pub cvae: CvaeConfig,
    /// Actions drawn per target row for `forward_kl`.
    pub draws: usize,
    /// K of `otdf`.
    pub samples: usize,
    /// Standard deviation of the decoder's density in `otdf`.
    pub std: f64,
}

impl Default for RegulariserConfig {
    fn default() -> Self {
        Self { cvae: CvaeConfig::default(), draws: 8, samples: 10, std: 0.1f64.sqrt() }
    }
}

/// A term, ready to be used.
pub enum Regulariser {
    /// No term.
    None,
    /// Actions of π_b for every target row.
    ForwardKl {
        /// Per member `[rows, draws, d_a]`.
        actions: Vec<Vec<f32>>,
        /// Per row.
        draws: usize,
    },
    /// The behaviour model itself.
    Otdf {
        /// Outside of autodiff.
        cvae: Cvae,
        /// K
        samples: usize,
        /// β
        std: f64,
        /// For z.
        members: Vec<Streams>,
    },
}

impl Regulariser {
    /// Trains what the term needs, on the target rows of `buffer`. None if the user interrupted it.
    ///
    /// # Errors
    /// If the configuration cannot be used.
    pub fn prepare(
        kind: RegulariserKind,
        buffer: &Buffer,
        config: &RegulariserConfig,
        device: &Device,
    ) -> Result<Option<Self>, LearnError> {
        if kind == RegulariserKind::None {
            return Ok(Some(Self::None));
        }
        if config.draws == 0 || config.samples == 0 || config.std.is_nan() || config.std <= 0.0 {
            let found = format!("{}, {}, {}", config.draws, config.samples, config.std);
            return Err(LearnError::invalid(
                "draws, samples, std",
                found,
                "positive numbers",
                "correct the configuration",
            ));
        }
        let Some(cvae) = train_cvae(buffer, &config.cvae, device)? else { return Ok(None) };
        Ok(Some(match kind {
            RegulariserKind::Otdf => {
                Self::Otdf { cvae, samples: config.samples, std: config.std, members: buffer.streams() }
            }
            _ => Self::forward_kl(&cvae, buffer, config.draws, device),
        }))
    }

    /// [`Regulariser::ForwardKl`] with `draws` actions of `cvae` per target row of `buffer`.
    pub fn forward_kl(cvae: &Cvae, buffer: &Buffer, draws: usize, device: &Device) -> Self {
        let states: Vec<_> = (buffer.members().iter().enumerate())
            .map(|(m, member)| buffer.network_inputs(m, &member.parts[0].observations))
            .collect();
        let actions = cvae.draw(&states, buffer.inputs().len(), &buffer.streams(), draws, device);
        Self::ForwardKl { actions, draws }
    }

    /// Its kind.
    pub fn kind(&self) -> RegulariserKind {
        match self {
            Self::None => RegulariserKind::None,
            Self::ForwardKl { .. } => RegulariserKind::ForwardKl,
            Self::Otdf { .. } => RegulariserKind::Otdf,
        }
    }

    /// The term, per member; `output` is the policy at the batch's states.
    pub fn loss(&self, actor: &Actor, output: &PolicyOutput, batch: &Minibatch, step: u64) -> Option<Tensor<3>> {
        let [p, b, _] = batch.s.dims();
        let (a, device) = (batch.a.dims()[2], batch.s.device());
        match self {
            Self::None => None,
            Self::ForwardKl { actions, draws } => {
                let rows = batch.target_rows;
                let mut drawn = Vec::with_capacity(p * rows * a);
                for (actions, picks) in actions.iter().zip(batch.picks.chunks(b)) {
                    for pick in &picks[..rows] {
                        let at = (pick.row as usize * draws + step as usize % draws) * a;
                        drawn.extend_from_slice(&actions[at..at + a]);
                    }
                }
                let drawn = tensor(drawn, [p, rows, a], &device);
                Some(actor.imitation_loss(&output.first(rows), drawn, None))
            }
            Self::Otdf { cvae, samples, std, members } => {
                let action = output.sample(members, step);
                Some(-member_mean(behaviour_log_density(cvae, batch.s.clone(), action, *samples, *std, members, step)))
            }
        }
    }
}

/// OTDF's log β(a|s), `[P, B, 1]`; gradients flow to `a`.
fn behaviour_log_density(
    cvae: &Cvae,
    s: Tensor<3>,
    a: Tensor<3>,
    samples: usize,
    std: f64,
    members: &[Streams],
    step: u64,
) -> Tensor<3> {
    let ([p, b, inputs], actions) = (s.dims(), a.dims()[2]);
    let (mean, log_std) = cvae.encode(s.clone(), a.clone());
    let latent = mean.dims()[2];
    let repeat = |x: Tensor<3>, width: usize| -> Tensor<3> {
        x.reshape([p, b, 1, width]).expand([p, b, samples, width]).reshape([p, b * samples, width])
    };
    let noise = member_noise(members, "regulariser noise", step, [p, b * samples, latent], &s.device());
    let z = repeat(mean, latent) + repeat(log_std.exp(), latent) * noise;
    let decoded = cvae.decode(repeat(s.clone(), inputs), z);
    let log_std = Tensor::<3>::full([1, 1, actions], std.ln(), &s.device());
    let log_prob = normal_log_prob(repeat(a, actions), decoded, log_std).reshape([p, b, samples]);
    // The greatest term taken out first, so that no exponential underflows.
    let greatest = log_prob.clone().inner().max_dim(2);
    (log_prob - greatest.clone()).exp().sum_dim(2).log() + greatest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buffer::Member;
    use crate::cvae::CvaeLearner;
    use std::path::Path;
    use std::sync::Arc;
    use tce_data::{Standardizer, Transitions};
    use tce_nn::{NamedParameters, cpu, host};

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
        let config = CvaeConfig { hidden: vec![8], ..CvaeConfig::default() };
        let cvae = CvaeLearner::new(&buffer, &config, &cpu()).unwrap().model();
        let mut weights = NamedParameters::default();
        weights.collect("cvae", &cvae);
        let first = weights.tensors.get_mut("cvae.decoder.layers.0.weight").unwrap();
        assert_eq!(first.0, [1, 4, 8]);
        first.1[2 * 8..].fill(0.0);
        let cvae = weights.apply("cvae", cvae, Path::new("test")).unwrap();

        let s = tensor(vec![0.3, -0.4, 1.0, 2.0], [1, 2, 2], &cpu());
        let a = tensor(vec![0.2, -0.9], [1, 2, 1], &cpu().autodiff()).require_grad();
        let mean = host(cvae.decode(s.clone(), Tensor::zeros([1, 2, 2], &cpu())));
        let density = behaviour_log_density(&cvae, s, a.clone(), 5, 0.5, &buffer.streams(), 3);
        let grads = density.clone().sum().backward();
        let (density, gradient) = (host(density), host(a.grad(&grads).unwrap()));
        for (i, a) in [0.2f32, -0.9].into_iter().enumerate() {
            let z = (a - mean[i]) / 0.5;
            let expected = 5f32.ln() - 0.5 * z * z - 0.5f32.ln() - 0.5 * (2.0 * std::f32::consts::PI).ln();
            assert!((density[i] - expected).abs() < 1e-4, "{} is not {expected}", density[i]);
            assert!((gradient[i] + z / 0.5).abs() < 1e-4);
        }
    }
}
