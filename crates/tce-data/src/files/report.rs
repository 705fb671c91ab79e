//! What was read, and what was left out.

use std::fmt;
use std::path::PathBuf;

use serde::Serialize;

/// Who wrote the file, judged by its fields.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// `next_observations`, no `timeouts`: the public target data.
    Otdf,
    /// D4RL's fields; `next_observations` may be there.
    D4rl,
    /// Written by [`save_d4rl`](crate::save_d4rl).
    Tce,
}

/// Where s' comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Successors {
    /// From `next_observations`.
    Stored,
    /// s'_i = s_{i+1}; the time-out rows, which have no such successor, are dropped (D4RL's `qlearning_dataset`).
    NextRow,
}

/// Rows of the file that are not in the result, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Dropped {
    /// The stored successor is the next episode's first state (OTDF's medium-expert files).
    pub wrong_successor: usize,
    /// Time-out rows whose successor the file does not hold.
    pub time_out: usize,
    /// The last row of the file, if the file does not hold its successor.
    pub last_row: usize,
}

impl Dropped {
    /// All of them.
    pub fn total(&self) -> usize {
        self.wrong_successor + self.time_out + self.last_row
    }
}

/// See [`load`](crate::load).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LoadReport {
    /// The file.
    pub file: PathBuf,
    /// The layout found.
    pub layout: Layout,
    /// What was taken as s'.
    pub successors: Successors,
    /// Rows in the file.
    pub rows_in_file: usize,
    /// Rows in the result: `rows_in_file` less all of `dropped`.
    pub rows_kept: usize,
    /// What is missing.
    pub dropped: Dropped,
    /// Kept terminal rows whose s' is the next episode's first state, because the file holds no other. Harmless for
    /// values (nothing is bootstrapped there), wrong for a model of the dynamics.
    pub terminals_without_successor: usize,
    /// What the user should know.
    pub warnings: Vec<String>,
}

impl fmt::Display for LoadReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let layout = match self.layout {
            Layout::Otdf => "OTDF",
            Layout::D4rl => "D4RL",
            Layout::Tce => "tce",
        };
        let successors = match self.successors {
            Successors::Stored => "stored next_observations",
            Successors::NextRow => "next states from the next row",
        };
        write!(f, "{}: {layout} layout, {successors}, ", self.file.display())?;
        write!(f, "{} of {} rows", self.rows_kept, self.rows_in_file)?;
        for (rows, reason) in [
            (self.dropped.wrong_successor, "a wrong stored successor"),
            (self.dropped.time_out, "a time-out and no stored successor"),
            (self.dropped.last_row, "the end of the file"),
        ] {
            if rows > 0 {
                write!(f, "; dropped {rows} for {reason}")?;
            }
        }
        self.warnings.iter().try_for_each(|w| write!(f, "\n  warning: {w}"))
    }
}
