//! What ends a command, and with which exit code.

use std::path::{Path, PathBuf};

use tce_base::Interrupted;

/// Any reason for which a command fails.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The command line or a configuration is wrong: exit code 2.
    #[error("{0}")]
    Usage(String),
    /// A data set is not usable.
    #[error(transparent)]
    Data(tce_data::DataError),
    /// Source and target do not belong together.
    #[error(transparent)]
    Agents(#[from] tce_data::AgentMismatch),
    /// The simulator failed.
    #[error(transparent)]
    Sim(tce_sim::SimError),
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
    Diffusion(tce_diffusion::DiffusionError),
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
    #[error(transparent)]
    Interrupted(#[from] Interrupted),
}

impl Error {
    /// `path` does not hold what was looked for there.
    pub fn missing(path: &Path, what: impl Into<String>) -> Self {
        Self::Missing { path: path.to_owned(), what: what.into() }
    }

    /// The user asked to stop; the same command resumes from the checkpoints.
    pub fn interrupted() -> Self {
        Interrupted::resumable().into()
    }

    /// This error of a command that keeps what it has finished: wherever an interrupt met it, the same command goes on.
    pub fn of_resumable(self) -> Self {
        match self {
            Error::Interrupted(_) => Self::interrupted(),
            other => other,
        }
    }

    /// 2 for a wrong call, 130 after an interrupt, 1 for the rest.
    pub fn exit_code(&self) -> i32 {
        match self {
            Error::Usage(_) => 2,
            Error::Interrupted(_) => Interrupted::EXIT_CODE,
            _ => 1,
        }
    }
}

/// An error of another crate is a case of its own here, but for an interruption, which is one case wherever it happened.
macro_rules! taken_over {
    ($($case:ident: $of:ident::$error:ident;)*) => {
        $(
            impl From<$of::$error> for Error {
                fn from(error: $of::$error) -> Self {
                    match error {
                        $of::$error::Interrupted(reason) => Self::Interrupted(reason),
                        error => Self::$case(error),
                    }
                }
            }
        )*
    };
}

taken_over! {
    Data: tce_data::DataError;
    Sim: tce_sim::SimError;
    Diffusion: tce_diffusion::DiffusionError;
}

impl From<tce_base::JsonError> for Error {
    fn from(error: tce_base::JsonError) -> Self {
        match error {
            tce_base::JsonError::File(error) => Self::File(error),
            tce_base::JsonError::Damaged(text) => Self::Failed(text),
        }
    }
}

impl From<tce_augment::Error> for Error {
    fn from(error: tce_augment::Error) -> Self {
        match error {
            tce_augment::Error::Data(error) => error.into(),
            tce_augment::Error::File(error) => Self::File(error),
            tce_augment::Error::Learn(error) => Self::Learn(error),
            tce_augment::Error::Diffusion(error) => error.into(),
            tce_augment::Error::Failed(text) => Self::Failed(text),
            tce_augment::Error::Interrupted(reason) => Self::Interrupted(reason),
        }
    }
}

impl From<tce_zoo::Error> for Error {
    fn from(error: tce_zoo::Error) -> Self {
        match error {
            tce_zoo::Error::Usage(text) => Self::Usage(text),
            tce_zoo::Error::Data(error) => error.into(),
            tce_zoo::Error::Sim(error) => error.into(),
            tce_zoo::Error::File(error) => Self::File(error),
            tce_zoo::Error::Network(error) => Self::Network(error),
            tce_zoo::Error::Learn(error) => Self::Learn(error),
            tce_zoo::Error::Failed(text) => Self::Failed(text),
        }
    }
}

/// The result of a command.
pub type Result<T, E = Error> = std::result::Result<T, E>;
