//! The marks of a file's rows, and the decisions made from them.

use super::report::{Dropped, EpisodeEnds, Successors};
use crate::Transitions;

/// What a file says about each row, before any row is dropped.
pub(super) struct Table<'a> {
    pub dim: usize,
    pub observations: &'a [f32],
    /// Stored successors, if the file has them.
    pub next_observations: Option<&'a [f32]>,
    pub terminals: &'a [bool],
    pub timeouts: Option<&'a [bool]>,
    /// Number of steps after which the collector cut an episode.
    pub limit: Option<usize>,
}

impl<'a> Table<'a> {
    /// What `t` says of its rows. A column without numbers is one that the file does not have.
    pub fn of(t: &'a Transitions, limit: Option<usize>) -> Self {
        Self {
            dim: t.obs_dim,
            observations: &t.observations,
            next_observations: (!t.next_observations.is_empty()).then_some(&t.next_observations[..]),
            terminals: &t.terminals,
            timeouts: (!t.timeouts.is_empty()).then_some(&t.timeouts[..]),
            limit,
        }
    }
}

/// The decisions made from a `Table`.
#[derive(Debug, PartialEq)]
pub(super) struct Resolved {
    pub timeouts: Vec<bool>,
    /// Rows that are kept.
    pub keep: Vec<bool>,
    /// Rows whose successor is known. The other rows are terminal.
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
