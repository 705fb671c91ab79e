//! Why an actor cannot be trained, loaded or used.

/// Any reason for which there is no actor, or no rows of it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// What was asked for makes no sense.
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
    /// A file of parameters is not usable.
    #[error(transparent)]
    Network(#[from] tce_nn::NetworkError),
    /// A policy file is not usable.
    #[error(transparent)]
    Learn(#[from] tce_learn::LearnError),
    /// A file is not what it should be, or a training diverged.
    #[error("{0}")]
    Failed(String),
}

/// The result of what this crate does.
pub type Result<T, E = Error> = std::result::Result<T, E>;
