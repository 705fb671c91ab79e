//! What was read, and what was left out.

use std::fmt;
use std::path::PathBuf;

use serde::Serialize;

/// Who wrote the file, told by its fields.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// `next_observations`, no `timeouts`: the public target data.
    Otdf,
    /// D4RL's fields; `next_observations` may be there.
    D4rl,
    /// Written by [`save_d4rl`](crate::save_d4rl).
    Tce,
    /// A Minari data set.
    Minari,
    /// A file of robomimic.
    Robomimic,
}

impl fmt::Display for Layout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Otdf => "OTDF",
            Self::D4rl => "D4RL",
            Self::Tce => "tce",
            Self::Minari => "Minari",
            Self::Robomimic => "robomimic",
        })
    }
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

/// What told where episodes end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum EpisodeEnds {
    /// `timeouts` and `terminals`, and every row whose s' is not the next row's state.
    Marks,
    /// Rows whose s' is not the next row's state, and `terminals`.
    Continuity,
    /// `terminals` and a step limit, for want of anything else.
    StepLimit(usize),
    /// `terminals` alone, for want of anything else.
    Terminals,
    /// Nothing: the rows are in no order, and each is an episode of its own.
    NoOrder,
}

impl fmt::Display for EpisodeEnds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Marks => f.write_str("episodes end where the file marks it"),
            Self::Continuity => f.write_str("episodes end where s' is not the next row's state"),
            Self::StepLimit(n) => write!(f, "episodes end at terminals and after {n} steps"),
            Self::Terminals => f.write_str("episodes end at terminals"),
            Self::NoOrder => f.write_str("rows in no order"),
        }
    }
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
    /// What told where episodes end.
    pub episodes: EpisodeEnds,
    /// Environments whose rows took turns; 1 where they did not.
    pub environments: usize,
    /// Rows in the file.
    pub rows_in_file: usize,
    /// Rows in the result: `rows_in_file` less all of `dropped`.
    pub rows_kept: usize,
    /// What is missing.
    pub dropped: Dropped,
    /// Kept terminal rows whose s' the file does not hold. Harmless for values (nothing is bootstrapped there); models of the
    /// dynamics leave them out.
    pub unknown_successors: usize,
    /// What the user should know.
    pub warnings: Vec<String>,
}

impl fmt::Display for LoadReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let successors = match self.successors {
            Successors::Stored => "stored next_observations",
            Successors::NextRow => "next states from the next row",
        };
        write!(f, "{}: {} layout, {successors}, {}, ", self.file.display(), self.layout, self.episodes)?;
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
