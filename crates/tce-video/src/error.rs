//! Why a video cannot be written.

use std::path::{Path, PathBuf};

/// Any reason for which there is no video.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The user asked to stop.
    #[error(transparent)]
    Interrupted(#[from] tce_base::Interrupted),
    /// A file could not be written.
    #[error(transparent)]
    File(#[from] tce_base::FileError),
    /// The encoder failed.
    #[error("{0}")]
    Failed(String),
    /// The encoder is missing.
    #[error("{}: {what}", path.display())]
    Missing {
        /// The video's file.
        path: PathBuf,
        /// What is missing, and what to do.
        what: String,
    },
}

impl Error {
    /// There is no video at `path`, for want of something.
    pub fn missing(path: &Path, what: impl Into<String>) -> Self {
        Self::Missing { path: path.to_owned(), what: what.into() }
    }
}

/// The result of writing a video.
pub type Result<T, E = Error> = std::result::Result<T, E>;
