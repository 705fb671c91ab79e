//! Errors of data sets and files. All have one form: where, what was found, what was expected, what to do.

use std::path::{Path, PathBuf};

use tce_base::FileError;

/// The kind of a [`DataError::Invalid`]. Programs read the kind, people read the message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Problem {
    /// Zero bytes, or no rows.
    Empty,
    /// The HDF5 signature is missing.
    NotHdf5,
    /// The file is shorter than the length in its own header.
    Truncated,
    /// The bytes contradict the HDF5 format.
    Malformed,
    /// A data set that the layout needs is absent.
    MissingField,
    /// Not of shape `(N,)` or `(N, 1)`, or, for observations and actions, `(N, D)`.
    WrongRank,
    /// Not a number type.
    WrongType,
    /// Two fields have different numbers of rows.
    RowCount,
    /// Two fields, or a field and the agent, have different dimensions.
    Dimension,
    /// NaN or infinity.
    NonFinite,
    /// A number outside the range of the field.
    Value,
    /// The header declares far more data than the file's bytes can hold.
    Oversized,
    /// Valid HDF5 in an unsupported form: a compression, data in another file.
    Unsupported,
}

/// Why a data set was refused or could not be written.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// The content cannot be used.
    #[error("{}: field `{field}`: found {found}; expected {expected}. {advice}", file.display())]
    Invalid {
        /// The kind of problem.
        problem: Problem,
        /// The file.
        file: PathBuf,
        /// The HDF5 data set, or `file` if the whole file is meant.
        field: Box<str>,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
        /// What the user can do.
        advice: Box<str>,
    },
    /// The operating system reported an error.
    #[error(transparent)]
    File(#[from] FileError),
    /// The user asked to stop.
    #[error(transparent)]
    Interrupted(#[from] tce_base::Interrupted),
}

impl DataError {
    pub(crate) fn invalid(
        problem: Problem,
        file: &Path,
        field: &str,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> Self {
        Self::Invalid {
            problem,
            file: file.to_owned(),
            field: field.into(),
            found: found.into(),
            expected: expected.into(),
            advice: advice.into().into(),
        }
    }

    /// The kind of invalid content; `None` for the other errors.
    pub fn problem(&self) -> Option<Problem> {
        match self {
            Self::Invalid { problem, .. } => Some(*problem),
            _ => None,
        }
    }
}
