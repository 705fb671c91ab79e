//! What keeps a report from being made.

use std::path::{Path, PathBuf};

use crate::stats::StatsError;

/// A report could not be made.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A file holds something else than it should.
    #[error("{}: field `{field}`: found {found}, expected {expected}; {advice}", file.display())]
    Field {
        /// The file.
        file: PathBuf,
        /// The field, as in `summary.seeds[2]`.
        field: String,
        /// What is there.
        found: String,
        /// What should be there.
        expected: String,
        /// What to do.
        advice: String,
    },
    /// A file could not be read or written.
    #[error(transparent)]
    File(#[from] tce_base::FileError),
    /// There is nothing to report on.
    #[error("{}: {what}", path.display())]
    Nothing {
        /// The folder.
        path: PathBuf,
        /// What was looked for, and what to do.
        what: String,
    },
    /// Scores that no statistic is defined for.
    #[error(transparent)]
    Stats(#[from] StatsError),
}

impl ReportError {
    /// `field` of `file` is not what it should be.
    pub fn field(
        file: &Path,
        field: impl Into<String>,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> Self {
        Self::Field {
            file: file.to_owned(),
            field: field.into(),
            found: found.into(),
            expected: expected.into(),
            advice: advice.into(),
        }
    }
}

/// The result of making a report.
pub type Result<T, E = ReportError> = std::result::Result<T, E>;
