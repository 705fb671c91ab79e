//! A diagnosis under way: what is diagnosed, and the rows that stand for all of them.

use std::path::Path;

use tce_base::Streams;
use tce_base::random::choose;
use tce_data::{Agent, Shift, Transitions};

use super::rows::Sampler;
use super::{Options, Subject};

/// A diagnosis under way.
pub struct Work<'a> {
    pub subject: &'a Subject<'a>,
    pub options: &'a Options,
    pub root: &'a Path,
    pub sampler: &'a Sampler<'a>,
    pub simulator: Option<(Agent, Shift)>,
}

/// Source rows that stand for all of them.
pub struct Sources {
    /// Those that are measured, the nearest to the target first.
    pub sorted: Transitions,
    /// The episode that each of them is of.
    pub episodes: Vec<usize>,
    /// Some of the nearest share.
    pub nearest: Transitions,
    /// None of those that are measured: what models may learn from.
    pub others: Transitions,
}

/// `count` rows at random, in their order.
pub fn few(t: &Transitions, count: usize, streams: &Streams, name: &str) -> Transitions {
    if t.len() <= count {
        return t.clone();
    }
    t.select(&choose(&mut streams.stream(name), t.len(), count))
}
