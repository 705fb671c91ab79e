//! What a learner is: told beside its algorithm, in the algorithm's file.

use std::fmt;

use serde::Serialize;

/// A learner, as `tce learn --list` prints it and as checks before a training ask for it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct About {
    /// Its name on the command line and in `learner.algorithm`.
    pub name: &'static str,
    /// One line.
    pub description: &'static str,
    /// Whose it is.
    pub reference: &'static str,
    /// How `mode = "published"` differs; none where there is one form.
    pub published: Option<&'static str>,
    /// The table of its keys.
    pub table: &'static str,
    /// What the rows besides the target's must have.
    pub needs: OtherRows,
    /// Whether it looks at s' of terminal rows: it models the dynamics, or compares transitions of two domains.
    #[serde(skip)]
    pub successors: bool,
    /// Whether it follows episodes, so that rows must be in order.
    #[serde(skip)]
    pub episodes: bool,
}

/// What the rows besides the target's must have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OtherRows {
    /// Nothing: any rows, or none.
    Any,
    /// They are the source's: the learner compares the domains.
    Source,
    /// They have scores.
    Scored,
}

impl fmt::Display for OtherRows {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            OtherRows::Any => "any rows, or none",
            OtherRows::Source => "source rows",
            OtherRows::Scored => "source rows, or rows of mixture.generated = \"dmc\"",
        })
    }
}

impl Serialize for OtherRows {
    fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(self)
    }
}
