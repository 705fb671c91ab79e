//! What can go wrong.

use tce_nn::NetworkError;

/// A diffusion model could not be trained, used or read.
#[derive(Debug, thiserror::Error)]
pub enum DiffusionError {
    /// A setting or an input is unusable.
    #[error("{what}: found {found}, expected {expected}")]
    Input {
        /// The setting or input.
        what: String,
        /// Its value.
        found: String,
        /// What would do.
        expected: String,
    },
    /// A file of parameters could not be used.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The loss is no number any more.
    #[error(
        "{label}: the loss of member {member} (the seeds in their order, from 0) became {loss} before step {step}; \
         lower learning_rate (now {learning_rate}) or look for huge values in the training rows"
    )]
    Diverged {
        /// Which training.
        label: String,
        /// Index in the population, which is that of the seed.
        member: usize,
        /// The loss.
        loss: f32,
        /// Steps taken.
        step: u64,
        /// The learning rate.
        learning_rate: f64,
    },
    /// The user asked to stop.
    #[error(transparent)]
    Interrupted(#[from] tce_base::Interrupted),
}

impl DiffusionError {
    pub(crate) fn input(what: impl Into<String>, found: impl ToString, expected: impl Into<String>) -> Self {
        Self::Input { what: what.into(), found: found.to_string(), expected: expected.into() }
    }
}
