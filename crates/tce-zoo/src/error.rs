//! Errors when an actor is trained, loaded or used.

/// Any reason why there is no actor, or why it has no rows.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The request is invalid.
    #[error("{0}")]
    Usage(String),
    /// A data set cannot be read or written.
    #[error(transparent)]
    Data(#[from] tce_data::DataError),
    /// The simulator failed.
    #[error(transparent)]
    Sim(#[from] tce_sim::SimError),
    /// A file could not be read or written.
    #[error(transparent)]
    File(#[from] tce_base::FileError),
    /// A parameter file cannot be used.
    #[error(transparent)]
    Network(#[from] tce_nn::NetworkError),
    /// A policy file cannot be used.
    #[error(transparent)]
    Learn(#[from] tce_learn::LearnError),
    /// A file has the wrong content, or a training run diverged.
    #[error("{0}")]
    Failed(String),
}

impl From<tce_base::JsonError> for Error {
    fn from(error: tce_base::JsonError) -> Self {
        match error {
            tce_base::JsonError::File(error) => Self::File(error),
            tce_base::JsonError::Damaged(text) => Self::Failed(text),
        }
    }
}

/// The result type of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;
