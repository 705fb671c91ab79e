//! What can be wrong with a data set or its file, in one form: where, what was found, what was expected, what to do.

use std::path::{Path, PathBuf};

use tce_base::FileError;

/// The kind of a [`DataError::Invalid`], for programs; people read its message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Problem {
    /// Zero bytes, or no rows.
    Empty,
    /// The HDF5 signature is missing.
    NotHdf5,
    /// The file ends before the length in its own header.
    Truncated,
    /// The bytes contradict the HDF5 format.
    Malformed,
    /// A data set that the layout needs is not there.
    MissingField,
    /// Neither `(N,)`, `(N, 1)` nor, for observations and actions, `(N, D)`.
    WrongRank,
    /// Not a number type.
    WrongType,
    /// Two fields disagree about the number of rows.
    RowCount,
    /// Two fields, or a field and the agent, disagree about a dimension.
    Dimension,
    /// NaN or infinity.
    NonFinite,
    /// A number outside of what the field may hold.
    Value,
    /// The file announces far more data than its bytes can hold.
    Oversized,
    /// Right HDF5 in a form that is not read: a compression, another file's data.
    Unsupported,
}

/// Why a data set was refused or could not be written.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// The content is not usable.
    #[error("{}: field `{field}`: found {found}; expected {expected}. {advice}", file.display())]
    Invalid {
        /// What kind of problem.
        problem: Problem,
        /// The file.
        file: PathBuf,
        /// The HDF5 data set, or `file` for the file as a whole.
        field: Box<str>,
        /// What is there.
        found: String,
        /// What should be there.
        expected: String,
        /// What the user can do.
        advice: Box<str>,
    },
    /// The operating system refused.
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

    /// The kind of an invalid content, `None` for the other errors.
    pub fn problem(&self) -> Option<Problem> {
        match self {
            Self::Invalid { problem, .. } => Some(*problem),
            _ => None,
        }
    }
}
