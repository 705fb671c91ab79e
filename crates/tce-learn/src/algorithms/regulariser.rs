//! Keeps a policy close to the behaviour of the target data: the second term of Eq. 10 and B.14, and OTDF's term.
//!
//! ```text
//! forward_kl  E over target states s of KL(π_b(·|s) ‖ π(·|s)) = E over â ~ π_b(·|s) of -log π(â|s) - H(π_b)
//! otdf        - mean over all rows of log β(a|s), a ~ π(·|s),
//!             log β(a|s) = logsumexp over k of Σ_d ln N(a_d; decoder(s, z_k)_d, β²), z_1..K ~ encoder(s, a)
//! ```
//!
//! π_b is the behaviour CVAE ([`crate::cvae`]). The entropy of π_b does not depend on the policy. For a deterministic
//! policy -log π(â|s) is the squared error, as in the first term of the loss (up to the same constants). Actions of π_b
//! are drawn before training, `draws` per target row; step t uses draw t mod `draws` of each row in its batch. Like
//! OTDF, we omit - ln K and the prior and posterior densities of z.
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
use crate::cvae::{Cvae, CvaeConfig, Density, train_cvae};
use crate::error::LearnError;
use crate::losses::member_mean;
use crate::shares::split;
use crate::training::Place;

/// Which term; see the [module](self).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default = "RegulariserConfig::paper")]
pub struct RegulariserConfig {
    /// The behaviour model.
    pub cvae: CvaeConfig,
    /// Actions drawn from the behaviour model per target row, for the regulariser `forward_kl`. Source: own.
    pub draws: usize,
    /// K, the samples behind a density of the behaviour model, for the regulariser `otdf`. Source: OTDF.
    pub samples: usize,
    /// β, the standard deviation of the decoder's density, for the regulariser `otdf`. Source: OTDF, √(.4/4).
    pub std: f64,
}

impl RegulariserConfig {
    /// The constants of OTDF and of the paper.
    pub fn paper() -> Self {
        Self { cvae: CvaeConfig::paper(), draws: 8, samples: 10, std: 0.1f64.sqrt() }
    }
}

/// Refuses members whose batches hold different numbers of target rows. `forward_kl` counts the same rows of all of them, so that the
/// result of a member would depend on the others.
fn same_target_rows(buffer: &Buffer) -> Result<(), LearnError> {
    let rows: Vec<usize> = buffer.members().iter().map(|m| split(buffer.batch(), &m.parts)[0]).collect();
    match rows.iter().position(|n| *n != rows[0]) {
        None => Ok(()),
        Some(m) => Err(LearnError::invalid(
            "regulariser = forward_kl",
            format!("{} target rows in a batch of member 0, {} of member {m}", rows[0], rows[m]),
            "as many of every member",
            "train members with other rows and those without in two populations",
        )),
    }
}

/// A prepared term.
pub enum Regulariser {
    /// No term.
    None,
    /// Actions of π_b for every target row.
    ForwardKl {
        /// For each member, `[rows, draws, d_a]`.
        actions: Vec<Vec<f32>>,
        /// Number of draws per row.
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
        /// Random streams for z.
        members: Vec<Streams>,
    },
}

impl Regulariser {
    /// Trains the model that the term needs, on the target rows of `buffer`. `None` if the user interrupted it.
    ///
    /// # Errors
    /// If the configuration cannot be used, the batches of two members have different numbers of target rows (`forward_kl`), or a
    /// checkpoint cannot be read or written.
    pub fn prepare(
        kind: RegulariserKind,
        buffer: &Buffer,
        config: &RegulariserConfig,
        place: Place<'_>,
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
        if kind == RegulariserKind::ForwardKl {
            same_target_rows(buffer)?;
        }
        let Some(cvae) = train_cvae(buffer, &config.cvae, place, device)? else { return Ok(None) };
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

    /// The term, per member; `output` is the policy's output at the batch's states.
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
                let density = Density { samples: *samples, std: *std, importance: false };
                let s = batch.s.clone();
                Some(-member_mean(cvae.log_density(s, action, density, members, "regulariser noise", step)))
            }
        }
    }
}
