//! What a file says of its rows, and what is made of it.

use super::report::{Dropped, EpisodeEnds, Successors};

/// What a file says row by row, before anything is dropped.
pub(super) struct Table<'a> {
    pub dim: usize,
    pub observations: &'a [f32],
    /// Stored successors, if there are any.
    pub next_observations: Option<&'a [f32]>,
    pub terminals: &'a [bool],
    pub timeouts: Option<&'a [bool]>,
    /// Steps after which the collector cut an episode.
    pub limit: Option<usize>,
}

/// What is made of it.
#[derive(Debug, PartialEq)]
pub(super) struct Resolved {
    pub timeouts: Vec<bool>,
    /// Rows that stay.
    pub keep: Vec<bool>,
    /// Rows whose successor is known. The others are terminal.
    pub known: Vec<bool>,
    pub successors: Successors,
    pub ends: EpisodeEnds,
    pub dropped: Dropped,
    pub warnings: Vec<String>,
}

impl Resolved {
    pub fn new(timeouts: Vec<bool>, successors: Successors, ends: EpisodeEnds) -> Self {
        let (keep, known) = (vec![true; timeouts.len()], vec![true; timeouts.len()]);
        Self { timeouts, keep, known, successors, ends, dropped: Dropped::default(), warnings: Vec::new() }
    }
}
