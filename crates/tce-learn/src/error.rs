//! Errors before training starts, and errors of policy files.

use std::path::PathBuf;

use tce_base::FileError;
use tce_nn::NetworkError;

/// A learner rejected its input.
#[derive(Debug, thiserror::Error)]
pub enum LearnError {
    /// A field of a configuration, or of the learner's data, cannot be used.
    #[error("{field}: found {found}, expected {expected}; {remedy}")]
    Invalid {
        /// The field.
        field: String,
        /// Its value.
        found: String,
        /// What is accepted.
        expected: String,
        /// What to do.
        remedy: String,
    },
    /// An error of a parameter file.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// An error of a file.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file is not a policy, or is a policy of an unknown kind.
    #[error("{}: {field}: found {found}, expected {expected}; {remedy}", path.display())]
    Policy {
        /// The file.
        path: PathBuf,
        /// The array or metadata key.
        field: String,
        /// What the file contains.
        found: String,
        /// What is accepted.
        expected: String,
        /// What to do.
        remedy: String,
    },
}

impl LearnError {
    /// The error for a value that cannot be used: its field, what was found, what is expected, and what to do.
    pub fn invalid(
        field: impl Into<String>,
        found: impl ToString,
        expected: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        Self::Invalid {
            field: field.into(),
            found: found.to_string(),
            expected: expected.into(),
            remedy: remedy.into(),
        }
    }
}

/// Returns an error for a value outside `range` (NaN is outside of every range).
pub(crate) fn within(field: &str, value: f64, range: std::ops::RangeInclusive<f64>) -> Result<(), LearnError> {
    if range.contains(&value) {
        return Ok(());
    }
    let expected = format!("a number in [{}, {}]", range.start(), range.end());
    Err(LearnError::invalid(field, value, expected, "correct the configuration"))
}
