//! Why no rows can be generated.

/// Any reason for which there are no generated rows.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A data set is not usable.
    #[error(transparent)]
    Data(#[from] tce_data::DataError),
    /// A checkpoint could not be read or written.
    #[error(transparent)]
    File(#[from] tce_base::FileError),
    /// Label models cannot be used.
    #[error(transparent)]
    Learn(#[from] tce_learn::LearnError),
    /// A score network cannot be trained or sampled.
    #[error(transparent)]
    Diffusion(#[from] tce_diffusion::DiffusionError),
    /// Nothing came out.
    #[error("{0}")]
    Failed(String),
    /// The user asked to stop.
    #[error(transparent)]
    Interrupted(#[from] tce_base::Interrupted),
}

/// The result of what this crate does.
pub type Result<T, E = Error> = std::result::Result<T, E>;
