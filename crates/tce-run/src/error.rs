//! What ends a command, and with which exit code.

use std::path::{Path, PathBuf};

/// Any reason for which a command fails.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The command line or a configuration is wrong: exit code 2.
    #[error("{0}")]
    Usage(String),
    /// A data set is not usable.
    #[error(transparent)]
    Data(#[from] tce_data::DataError),
    /// Source and target do not belong together.
    #[error(transparent)]
    Agents(#[from] tce_data::AgentMismatch),
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
    /// The generator failed.
    #[error(transparent)]
    Diffusion(#[from] tce_diffusion::DiffusionError),
    /// A report could not be made.
    #[error(transparent)]
    Report(#[from] tce_report::ReportError),
    /// A result does not meet what was asked of it (`tce data check --replay`).
    #[error("{0}")]
    Failed(String),
    /// Something outside of the program is missing.
    #[error("{}: {what}", path.display())]
    Missing {
        /// Where it was looked for.
        path: PathBuf,
        /// What is missing, and what to do.
        what: String,
    },
    /// The user asked to stop.
    #[error("interrupted; what was finished is kept, and the same command continues from there")]
    Interrupted,
}

impl Error {
    /// `path` does not hold what was looked for there.
    pub fn missing(path: &Path, what: impl Into<String>) -> Self {
        Self::Missing { path: path.to_owned(), what: what.into() }
    }

    /// 2 for a wrong call, 130 after an interrupt, 1 for the rest.
    pub fn exit_code(&self) -> i32 {
        match self {
            Error::Usage(_) => 2,
            Error::Interrupted
            | Error::Data(tce_data::DataError::Interrupted)
            | Error::Sim(tce_sim::SimError::Interrupted)
            | Error::Diffusion(tce_diffusion::DiffusionError::Interrupted { .. }) => 130,
            _ => 1,
        }
    }
}

impl From<tce_augment::Error> for Error {
    fn from(error: tce_augment::Error) -> Self {
        match error {
            tce_augment::Error::Data(error) => Self::Data(error),
            tce_augment::Error::File(error) => Self::File(error),
            tce_augment::Error::Learn(error) => Self::Learn(error),
            tce_augment::Error::Diffusion(error) => Self::Diffusion(error),
            tce_augment::Error::Failed(text) => Self::Failed(text),
            tce_augment::Error::Interrupted => Self::Interrupted,
        }
    }
}

impl From<tce_zoo::Error> for Error {
    fn from(error: tce_zoo::Error) -> Self {
        match error {
            tce_zoo::Error::Usage(text) => Self::Usage(text),
            tce_zoo::Error::Data(error) => Self::Data(error),
            tce_zoo::Error::Sim(error) => Self::Sim(error),
            tce_zoo::Error::File(error) => Self::File(error),
            tce_zoo::Error::Network(error) => Self::Network(error),
            tce_zoo::Error::Learn(error) => Self::Learn(error),
            tce_zoo::Error::Failed(text) => Self::Failed(text),
        }
    }
}

/// The result of a command.
pub type Result<T, E = Error> = std::result::Result<T, E>;
