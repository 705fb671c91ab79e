//! A verified table of finished work.

use std::fs;
use std::path::PathBuf;

use serde::Serialize;
use tce_base::first_damaged;
use tce_report::analysis::counts_for;

use super::work::Outcome;
use super::{Entry, Kind, Sweep};
use crate::error::{Error, Result};

/// One finished run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// The task.
    pub task: String,
    /// The method, with the override's name.
    pub method: String,
    /// The seed.
    pub seed: u64,
    /// Normalised score.
    pub score: Option<f64>,
    /// Whether its policy could not act to the end; it counts as a random policy.
    pub diverged: bool,
    /// Where its policy is.
    pub place: PathBuf,
    /// Seconds.
    pub seconds: f64,
    /// The program that did it.
    pub program: String,
}

impl Row {
    /// What the run counts for in a table ([`counts_for`]).
    pub fn counted(&self) -> Option<f64> {
        counts_for(self.score, self.diverged)
    }
}

/// What is known of a piece of work.
#[derive(Clone, Debug, PartialEq)]
pub enum Checked {
    /// It is not done.
    Missing,
    /// Its files have changed, or its record is damaged.
    Corrupt(String),
    /// It is finished and verified.
    Done(Outcome),
}

/// All that is done, and what is wrong.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Gathered {
    /// Finished runs, in the order of the manifest.
    pub rows: Vec<Row>,
    /// Runs that are not done.
    pub missing: Vec<String>,
    /// Runs whose files have changed.
    pub corrupt: Vec<String>,
    /// Later results of the same work that differ.
    pub conflicts: Vec<PathBuf>,
}

impl Sweep {
    /// Everything that is done, verified file by file.
    ///
    /// # Errors
    /// If a folder cannot be read.
    pub fn gather(&self) -> Result<Gathered> {
        let mut out = Gathered::default();
        for entry in self.entries().iter().filter(|e| e.kind == Kind::Run) {
            match self.check(entry) {
                Checked::Missing => out.missing.push(entry.to_string()),
                Checked::Corrupt(what) => out.corrupt.push(format!("{entry}: {what}")),
                Checked::Done(outcome) => out.rows.push(Row {
                    task: entry.task.to_string(),
                    method: entry.column(),
                    seed: entry.seed,
                    score: outcome.score,
                    diverged: outcome.diverged,
                    place: outcome.place,
                    seconds: outcome.seconds,
                    program: outcome.program,
                }),
            }
        }
        out.conflicts = self.conflicts();
        Ok(out)
    }

    /// The outcome of a piece of work, verified file by file.
    pub fn check(&self, entry: &Entry) -> Checked {
        match self.outcome(entry) {
            Ok(None) => Checked::Missing,
            Ok(Some(outcome)) => match self.damage(entry, &outcome) {
                Some(what) => Checked::Corrupt(what),
                None => Checked::Done(outcome),
            },
            Err(e) => Checked::Corrupt(e.to_string()),
        }
    }

    /// Results that came later than another of the same work and differ.
    pub fn conflicts(&self) -> Vec<PathBuf> {
        let faults = fs::read_dir(self.directory.join("faults")).into_iter().flatten().flatten();
        let mut conflicts: Vec<PathBuf> = faults.map(|f| f.path()).collect();
        conflicts.sort();
        conflicts
    }

    /// What is wrong with the record or the files of a piece of work, or with the files that it read.
    pub(super) fn damage(&self, entry: &Entry, outcome: &Outcome) -> Option<String> {
        if outcome.id != entry.id {
            return Some(format!("found the outcome of {}, expected that of {}", outcome.id, entry.id));
        }
        self.changed_input(entry).or_else(|| first_damaged(&self.directory.join(&outcome.place), &outcome.files))
    }
}

impl Gathered {
    /// Refuses an incomplete table.
    ///
    /// # Errors
    /// If there is anything, with a list of it.
    pub fn whole(&self) -> Result<()> {
        let lists: [(&str, Vec<String>); 3] = [
            ("not done", self.missing.clone()),
            ("corrupt", self.corrupt.clone()),
            ("in conflict", self.conflicts.iter().map(|p| p.display().to_string()).collect()),
        ];
        if lists.iter().all(|(_, list)| list.is_empty()) {
            return Ok(());
        }
        let verify = if self.corrupt.is_empty() { "" } else { " with --verify" };
        let mut text = format!("the table would be partial; launch the sweep again{verify}, or say --partial\n");
        for (what, list) in lists.iter().filter(|(_, list)| !list.is_empty()) {
            text += &format!("{} {what}:\n", list.len());
            text.extend(list.iter().take(20).map(|item| format!("  {item}\n")));
            if list.len() > 20 {
                text += "  ...\n";
            }
        }
        Err(Error::Failed(text))
    }
}
