//! The report of what was read and what was left out.

use std::fmt;
use std::path::PathBuf;

use serde::Serialize;

/// The program that wrote the file, inferred from its fields.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// `next_observations`, no `timeouts`: the public target data.
    Otdf,
    /// D4RL's fields; `next_observations` is optional.
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
    /// s'_i = s_{i+1}. Time-out rows have no such successor and are dropped (D4RL's `qlearning_dataset`).
    NextRow,
}

/// The information that shows where episodes end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum EpisodeEnds {
    /// `timeouts` and `terminals`, and every row whose s' is not the next row's state.
    Marks,
    /// Rows whose s' is not the next row's state, and `terminals`.
    Continuity,
    /// `terminals` and a step limit, because the file has nothing else.
    StepLimit(usize),
    /// `terminals` alone, because the file has nothing else.
    Terminals,
    /// No information: the rows are in no order, and each row is its own episode.
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

/// Numbers of rows in the file that are not in the result, by reason.
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
    /// The total number of dropped rows.
    pub fn total(&self) -> usize {
        self.wrong_successor + self.time_out + self.last_row
    }
}

/// See [`load`](crate::load).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LoadReport {
    /// The file.
    pub file: PathBuf,
    /// The layout that was detected.
    pub layout: Layout,
    /// The source of s'.
    pub successors: Successors,
    /// The information that showed where episodes end.
    pub episodes: EpisodeEnds,
    /// Number of interleaved environments; 1 if the rows are not interleaved.
    pub environments: usize,
    /// Rows in the file.
    pub rows_in_file: usize,
    /// Rows in the result: `rows_in_file` minus the total of `dropped`.
    pub rows_kept: usize,
    /// The rows that are missing from the result.
    pub dropped: Dropped,
    /// Kept terminal rows whose s' is not in the file. Value functions do not need it (nothing is bootstrapped there);
    /// dynamics models leave these rows out.
    pub unknown_successors: usize,
    /// Warnings for the user.
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
