//! The progress of a sweep.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;
use std::time::UNIX_EPOCH;

use serde::Serialize;
use tce_base::counted;

use super::claim::{Active, now};
use super::{Entry, Kind, Sweep};
use crate::clock;
use crate::error::{Error, Result};

/// The state of all work of a sweep.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    /// The sweep.
    pub name: String,
    /// Pieces of work by kind: finished, and all.
    pub kinds: BTreeMap<Kind, (usize, usize)>,
    /// Running now.
    pub running: Vec<Running>,
    /// Indices of failed work that is neither finished nor running.
    pub failed: Vec<(usize, String)>,
    /// Where the logs are.
    pub logs: PathBuf,
    /// Indices of work that is neither finished, running nor failed.
    pub waiting: Vec<usize>,
    /// Later results of the same work that differ.
    pub faults: usize,
    /// Seconds until everything is done, if as many processes keep running; None if nothing of this kind is finished yet, if
    /// something failed, and if nothing is running.
    pub seconds_left: Option<f64>,
    /// Tiers, in their order; empty where the sweep has none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tiers: Vec<TierState>,
    /// Scores so far: task, method, scores.
    pub scores: Vec<(String, String, Vec<f64>)>,
}

/// How far a tier is.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TierState {
    /// Its name.
    pub name: String,
    /// Finished pieces of work.
    pub done: usize,
    /// All pieces of work.
    pub all: usize,
    /// Seconds that the finished ones took, over all attempts.
    pub seconds: f64,
    /// Seconds that the others take, one after the other; None as long as nothing of their kind is finished.
    pub seconds_left: Option<f64>,
}

impl TierState {
    /// A tier of which no work was looked at yet.
    fn new(name: &str) -> Self {
        Self { name: name.to_owned(), done: 0, all: 0, seconds: 0.0, seconds_left: Some(0.0) }
    }
}

/// A piece of work that is running.
#[derive(Clone, Debug, Serialize)]
pub struct Running {
    /// The work.
    pub index: usize,
    /// What it is.
    pub what: String,
    /// Machine and process.
    pub owner: String,
    /// Seconds since it began, with those of earlier attempts.
    pub seconds: u64,
}

impl Sweep {
    /// The state of all work.
    ///
    /// # Errors
    /// If a record is damaged.
    pub fn status(&self) -> Result<Status> {
        let active = self.active();
        let mut status = Status {
            name: self.manifest.header.name.clone(),
            kinds: BTreeMap::new(),
            running: Vec::new(),
            failed: Vec::new(),
            logs: self.directory.join("logs"),
            waiting: Vec::new(),
            faults: fs::read_dir(self.directory.join("faults")).map_or(0, Iterator::count),
            seconds_left: None,
            tiers: self.manifest.tiers().into_iter().filter(|name| !name.is_empty()).map(TierState::new).collect(),
            scores: Vec::new(),
        };
        // The kind and column of unfinished work, by the place of its tier.
        let mut left: Vec<(usize, (Kind, String))> = Vec::new();
        // Seconds that work of a kind and column took, and what is left of it.
        let mut times: BTreeMap<(Kind, String), (f64, usize, usize)> = BTreeMap::new();
        let mut scores: BTreeMap<(String, String), Vec<f64>> = BTreeMap::new();
        for entry in self.entries() {
            let kind = status.kinds.entry(entry.kind).or_default();
            kind.1 += 1;
            let time = times.entry((entry.kind, entry.column())).or_default();
            let tier = status.tiers.iter().position(|t| t.name == entry.tier);
            if let Some(tier) = tier {
                status.tiers[tier].all += 1;
            }
            if let Some(outcome) = self.outcome(entry)? {
                if let Some(tier) = tier {
                    status.tiers[tier].done += 1;
                    status.tiers[tier].seconds += outcome.seconds;
                }
                kind.0 += 1;
                time.0 += outcome.seconds;
                time.1 += 1;
                if let Some(score) = outcome.counted() {
                    scores.entry((entry.task.to_string(), entry.column())).or_default().push(score);
                }
                continue;
            }
            time.2 += 1;
            left.extend(tier.map(|tier| (tier, (entry.kind, entry.column()))));
            if let Some(active) = active.get(&entry.id) {
                status.running.extend(active.iter().map(|a| Running {
                    index: entry.index,
                    what: entry.to_string(),
                    owner: a.owner.clone(),
                    seconds: self.seconds_of(entry, a),
                }));
            } else if let Some(failure) = self.failure(entry) {
                status.failed.push((entry.index, failure.error));
            } else {
                status.waiting.push(entry.index);
            }
        }
        for (tier, work) in left {
            let (seconds, done, _) = times[&work];
            let (sum, each) = (status.tiers[tier].seconds_left, (done > 0).then(|| seconds / done as f64));
            status.tiers[tier].seconds_left = sum.zip(each).map(|(sum, each)| sum + each);
        }
        let known = times.values().all(|&(_, done, left)| done > 0 || left == 0);
        let work: f64 = times.values().map(|&(seconds, done, left)| seconds / done.max(1) as f64 * left as f64).sum();
        // What failed may fail again, and what nobody does takes for ever.
        let known = known && status.failed.is_empty() && !status.running.is_empty();
        status.seconds_left = known.then(|| work / status.running.len() as f64);
        status.scores = scores.into_iter().map(|((task, column), scores)| (task, column, scores)).collect();
        Ok(status)
    }

    /// Seconds that `entry`, which `active` is doing, took so far, with what earlier attempts took.
    fn seconds_of(&self, entry: &Entry, active: &Active) -> u64 {
        let own = now().saturating_sub(active.since);
        let Some(noted) = clock::noted(&self.spent(entry)) else { return own };
        let at = noted.at.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
        // A note of an earlier attempt says nothing of the time since.
        if at < active.since { own } else { noted.seconds as u64 + now().saturating_sub(at) }
    }
}

impl Status {
    /// Whether nothing is left to do.
    pub fn complete(&self) -> bool {
        [Kind::Run, Kind::Verdict].iter().all(|kind| self.kinds.get(kind).is_none_or(|(done, all)| done == all))
    }

    /// Whether the rest will not be done: something failed, and nothing is running.
    pub fn stuck(&self) -> bool {
        !self.failed.is_empty() && self.running.is_empty()
    }

    /// Nothing, unless something failed.
    ///
    /// # Errors
    /// How much failed, and what to do.
    pub fn healthy(&self) -> Result<()> {
        match self.failed.len() {
            0 => Ok(()),
            n => Err(Error::Failed(format!(
                "{} failed, with the message{} above; mend the cause and launch the sweep again (logs: {})",
                counted(n, "piece of work", "pieces of work"),
                if n == 1 { "" } else { "s" },
                self.logs.display()
            ))),
        }
    }

    /// What failed, by message: the first line, and the numbers of the work, in the order of the first of each.
    pub fn failures(&self) -> Vec<(&str, Vec<usize>)> {
        let mut groups: Vec<(&str, Vec<usize>)> = Vec::new();
        for (index, error) in &self.failed {
            let first = error.lines().next().unwrap_or_default();
            match groups.iter_mut().find(|(message, _)| *message == first) {
                Some((_, indices)) => indices.push(*index),
                None => groups.push((first, vec![*index])),
            }
        }
        groups
    }
}
