//! How far a sweep is.

use std::collections::BTreeMap;
use std::fs;
use std::time::{Duration, SystemTime};

use serde::Serialize;

use super::work::{Active, Failure, now};
use super::{Entry, Kind, Sweep};
use crate::error::Result;
use crate::output::{plus_minus, table};

/// Without a sign of life for so long, a process counts as lost.
const SILENCE: Duration = Duration::from_secs(60);

/// The state of all work of a sweep.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    /// The sweep.
    pub name: String,
    /// Pieces of work by kind: done, and in all.
    pub kinds: BTreeMap<Kind, (usize, usize)>,
    /// At work now.
    pub running: Vec<Running>,
    /// Indices of what failed and is neither done nor at work.
    pub failed: Vec<(usize, String)>,
    /// Indices of what is neither done, at work nor failed.
    pub waiting: Vec<usize>,
    /// Results that came later and differ.
    pub faults: usize,
    /// Seconds until everything is done, if as many stay at work as now; None as long as nothing is done of what is left.
    pub seconds_left: Option<f64>,
    /// Scores so far: task, method, scores.
    pub scores: Vec<(String, String, Vec<f64>)>,
}

/// Somebody at work.
#[derive(Clone, Debug, Serialize)]
pub struct Running {
    /// The work.
    pub index: usize,
    /// What it is.
    pub what: String,
    /// Machine and process.
    pub owner: String,
    /// For so many seconds.
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
            waiting: Vec::new(),
            faults: fs::read_dir(self.directory.join("faults")).map_or(0, Iterator::count),
            seconds_left: None,
            scores: Vec::new(),
        };
        // Seconds that work of a kind and column took, and what is left of it.
        let mut times: BTreeMap<(Kind, String), (f64, usize, usize)> = BTreeMap::new();
        let mut scores: BTreeMap<(String, String), Vec<f64>> = BTreeMap::new();
        for entry in self.entries() {
            let kind = status.kinds.entry(entry.kind).or_default();
            kind.1 += 1;
            let time = times.entry((entry.kind, entry.column())).or_default();
            if let Some(outcome) = self.outcome(entry)? {
                kind.0 += 1;
                time.0 += outcome.seconds;
                time.1 += 1;
                if let Some(score) = outcome.score {
                    scores.entry((entry.task.to_string(), entry.column())).or_default().push(score);
                }
                continue;
            }
            time.2 += 1;
            if let Some(active) = active.get(&entry.id) {
                status.running.extend(active.iter().map(|a| Running {
                    index: entry.index,
                    what: entry.to_string(),
                    owner: a.owner.clone(),
                    seconds: now().saturating_sub(a.since),
                }));
            } else if let Some(failure) = self.failure(entry) {
                status.failed.push((entry.index, failure.error));
            } else {
                status.waiting.push(entry.index);
            }
        }
        let known = times.values().all(|&(_, done, left)| done > 0 || left == 0);
        let work: f64 = times.values().map(|&(seconds, done, left)| seconds / done.max(1) as f64 * left as f64).sum();
        status.seconds_left = known.then(|| work / status.running.len().max(1) as f64);
        status.scores = scores.into_iter().map(|((task, column), scores)| (task, column, scores)).collect();
        Ok(status)
    }

    /// Who is at work, by the work's id.
    fn active(&self) -> BTreeMap<String, Vec<Active>> {
        let mut out: BTreeMap<String, Vec<Active>> = BTreeMap::new();
        for file in fs::read_dir(self.directory.join("active")).into_iter().flatten().flatten() {
            let modified = file.metadata().and_then(|m| m.modified()).unwrap_or(SystemTime::UNIX_EPOCH);
            let silent = SystemTime::now().duration_since(modified).is_ok_and(|d| d > SILENCE);
            let name = file.file_name().to_string_lossy().into_owned();
            let active = fs::read(file.path()).ok().and_then(|b| serde_json::from_slice::<Active>(&b).ok());
            if let (false, Some((id, _)), Some(active)) = (silent, name.split_once('.'), active) {
                out.entry(id.to_owned()).or_default().push(active);
            }
        }
        out
    }

    /// Why a piece of work failed the last time, if it did.
    pub fn failure(&self, entry: &Entry) -> Option<Failure> {
        let bytes = fs::read(self.file("failed", &format!("{}.json", entry.id))).ok()?;
        serde_json::from_slice(&bytes).ok()
    }
}

impl Status {
    /// Whether nothing is left to do.
    pub fn complete(&self) -> bool {
        self.kinds.get(&Kind::Run).is_none_or(|(done, all)| done == all)
    }

    /// As a text for a terminal.
    pub fn render(&self) -> String {
        let word = |kind: &Kind| match kind {
            Kind::Source => "source data",
            Kind::Target => "target data",
            Kind::Distances => "distances",
            Kind::Expand => "generated rows",
            Kind::Run => "runs",
        };
        let rows = self.kinds.iter().map(|(k, (done, all))| [word(k).to_owned(), format!("{done}/{all}")]);
        let mut text = format!("{}\n{}\n", self.name, table(&["work", "done"], rows));
        let left = match (self.complete(), self.seconds_left) {
            (true, _) => "all runs are done".to_owned(),
            (false, Some(s)) => format!("about {:.0} min left", (s / 60.0).ceil()),
            (false, None) => "time left not known yet".to_owned(),
        };
        text += &format!(
            "{} at work, {} waiting, {} failed, {} faults of determinism; {left}\n",
            self.running.len(),
            self.waiting.len(),
            self.failed.len(),
            self.faults
        );
        for r in &self.running {
            text += &format!("  {} (for {} s, {})\n", r.what, r.seconds, r.owner);
        }
        for (index, error) in self.failed.iter().take(10) {
            text += &format!("  failed {index}: {}\n", error.lines().next().unwrap_or_default());
        }
        if !self.scores.is_empty() {
            let rows = self.scores.iter().map(|(t, c, s)| [t.clone(), c.clone(), plus_minus(s), s.len().to_string()]);
            text += &format!("{}\n", table(&["task", "method", "score", "seeds"], rows));
        }
        text
    }
}
