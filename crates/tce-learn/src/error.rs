//! What can go wrong before a training starts, or with a file of a policy.

use std::path::PathBuf;

use tce_base::FileError;
use tce_nn::NetworkError;

/// A learner refused its input.
#[derive(Debug, thiserror::Error)]
pub enum LearnError {
    /// A field of a configuration, or of the data a learner is given, cannot be used.
    #[error("{field}: found {found}, expected {expected}; {remedy}")]
    Invalid {
        /// The field.
        field: String,
        /// Its value.
        found: String,
        /// What would be accepted.
        expected: String,
        /// What to do.
        remedy: String,
    },
    /// A file of parameters.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// A file.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file is not a policy, or not one of a kind known here.
    #[error("{}: {field}: found {found}, expected {expected}; {remedy}", path.display())]
    Policy {
        /// The file.
        path: PathBuf,
        /// The array or key.
        field: String,
        /// What the file holds.
        found: String,
        /// What would be accepted.
        expected: String,
        /// What to do.
        remedy: String,
    },
}

impl LearnError {
    /// A value that cannot be used: its field, what was found, what is expected, and what to do.
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

/// Refuses a value outside `range` (NaN is outside of every range).
pub(crate) fn within(field: &str, value: f64, range: std::ops::RangeInclusive<f64>) -> Result<(), LearnError> {
    if range.contains(&value) {
        return Ok(());
    }
    let expected = format!("a number in [{}, {}]", range.start(), range.end());
    Err(LearnError::invalid(field, value, expected, "correct the configuration"))
}
