//! One piece of work. One process at a time does it; where two do after all, the first outcome stays, and another one is a fault.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tce_base::{
    FileError, Owner, PROGRAM, create_folder, interrupted, read_json, sha256_file, write_json, write_json_first,
};
use tce_nn::Device;
use tce_report::analysis::counts_for;

use super::claim::now;
use super::{Entry, Kind, Sweep};
use crate::augment::{augment_rows, label_models};
use crate::clock::Clock;
use crate::config::{Config, GeneratedRows};
use crate::error::{Error, Result};
use crate::inputs::{Inputs, source_file, target_file};
use crate::mixture::distances_stage;
use crate::off_policy_evaluation::OffPolicyEvaluator;
use crate::pipeline::run;
use crate::policy_training::policy_file;
use crate::stage::files_of;
use crate::variant::Variant;
use crate::verdict::{Candidate, Verdict, recommend_or_only};

/// What the folders of verdicts begin with.
const VERDICT: &str = "verdict";
/// Time between two looks at work that another process does.
const LOOK: Duration = Duration::from_secs(1);

/// The outcome of a piece of work.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// The work's id.
    pub id: String,
    /// Normalised score, for runs; None without a simulator, or if the policy cannot act.
    pub score: Option<f64>,
    /// Whether its policy could not act to the end.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub diverged: bool,
    /// Where the result is, in the sweep's folder.
    pub place: PathBuf,
    /// SHA-256 of its files.
    pub files: BTreeMap<String, String>,
    /// Seconds it took. Interrupted attempts count up to their last checkpoint.
    pub seconds: f64,
    /// Peak memory of the process, in bytes, where the system reports it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub memory: Option<u64>,
    /// The program that did it.
    pub program: String,
}

impl Outcome {
    /// What the run counts for in a table, as in a report: a policy that diverged is no better than a random one.
    pub fn counted(&self) -> Option<f64> {
        counts_for(self.score, self.diverged)
    }

    /// Whether two copies of the work have the same result.
    pub fn agrees(&self, other: &Self) -> bool {
        (&self.id, &self.place, &self.files, self.score.map(f64::to_bits))
            == (&other.id, &other.place, &other.files, other.score.map(f64::to_bits))
    }
}

/// Why a piece of work failed.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Failure {
    /// The message.
    pub error: String,
    /// Seconds since 1970.
    pub at: u64,
}

/// What becomes of work that another process is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Taken {
    /// This process waits until it is done, or does it if the other process is lost.
    Wait,
    /// This process leaves it alone.
    Leave,
}

/// Waits for a moment.
fn pause() -> Result<()> {
    let started = Instant::now();
    while started.elapsed() < LOOK {
        if interrupted() {
            return Err(Error::interrupted());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

/// Resets the peak memory of this process, so that each piece of work in it has its own. Where the system cannot do that, a
/// later piece has the peak of all earlier ones.
fn forget_peak_memory() {
    let _ = fs::write("/proc/self/clear_refs", "5");
}

/// Peak memory of this process, in bytes.
fn peak_memory() -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let kilobytes = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?.split_whitespace().next()?;
    Some(kilobytes.parse::<u64>().ok()? * 1024)
}

/// A data set as an outcome: no score, its folder, its hash.
fn data_file(file: &Path) -> Result<(Option<f64>, PathBuf, BTreeMap<String, String>)> {
    let name = file.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let files = BTreeMap::from([(name, sha256_file(file)?)]);
    Ok((None, file.parent().unwrap_or(Path::new("")).to_owned(), files))
}

impl Sweep {
    /// The outcome of a piece of work, if it is done.
    ///
    /// # Errors
    /// If the record of it is damaged.
    pub fn outcome(&self, entry: &Entry) -> Result<Option<Outcome>> {
        let path = self.file("done", &format!("{}.json", entry.id));
        Ok(read_json(&path, "remove it to do the work again")?)
    }

    /// The pieces of work that are not done, in the order of the manifest.
    ///
    /// # Errors
    /// If the record of one is damaged.
    pub fn missing(&self) -> Result<Vec<&Entry>> {
        let mut missing = Vec::new();
        for entry in self.entries() {
            if self.outcome(entry)?.is_none() {
                missing.push(entry);
            }
        }
        Ok(missing)
    }

    /// Does a piece of work, unless it is done; None if another process is doing it, and `taken` says to leave it.
    ///
    /// # Errors
    /// The failure, which is also stored in `failed/`; if an earlier copy of the work has another result; or if the user interrupts.
    pub fn work(&self, entry: &Entry, taken: Taken, device: &Device) -> Result<Option<Outcome>> {
        if let Some(outcome) = self.outcome(entry)? {
            return Ok(Some(outcome));
        }
        let mut told = false;
        let claim = loop {
            let claim = self.claim(entry)?;
            // Behind the claim: whoever had the work may just have come to its end.
            if let Some(outcome) = self.outcome(entry)? {
                return Ok(Some(outcome));
            }
            if let Some(claim) = claim {
                break claim;
            }
            if taken == Taken::Leave {
                return Ok(None);
            }
            if let Some(owner) = self.other_at(entry).filter(|_| !told) {
                told = true;
                tce_base::note!("{entry}: {owner} is doing it; waiting for its end");
            }
            pause()?;
        };
        self.forget_failure(entry);
        let clock = Clock::start(self.spent(entry));
        let outcome = match self.changed_input(entry) {
            Some(change) => Err(Error::Failed(change)),
            None => self.compute(entry, &clock, device).and_then(|outcome| self.settle(outcome)),
        };
        match &outcome {
            Ok(_) => clock.forget(),
            Err(e) if e.exit_code() != 130 => self.note_failure(entry, &e.to_string())?,
            Err(_) => {}
        }
        drop(claim);
        outcome.map(Some)
    }

    /// Where the seconds are noted that an unfinished piece of work took so far.
    pub(super) fn spent(&self, entry: &Entry) -> PathBuf {
        self.file("spent", &format!("{}.json", entry.id))
    }

    fn failure_file(&self, entry: &Entry) -> PathBuf {
        self.file("failed", &format!("{}.json", entry.id))
    }

    /// Stores why a piece of work failed.
    pub(super) fn note_failure(&self, entry: &Entry, error: &str) -> Result<()> {
        Ok(write_json(&self.failure_file(entry), &Failure { error: error.to_owned(), at: now() })?)
    }

    /// Removes the reason of an earlier failure: the piece of work is tried again, and may fail for another.
    pub(super) fn forget_failure(&self, entry: &Entry) {
        let _ = fs::remove_file(self.failure_file(entry));
    }

    /// Why a piece of work failed the last time, if it did.
    pub fn failure(&self, entry: &Entry) -> Option<Failure> {
        let bytes = fs::read(self.failure_file(entry)).ok()?;
        serde_json::from_slice(&bytes).ok()
    }

    fn compute(&self, entry: &Entry, clock: &Clock, device: &Device) -> Result<Outcome> {
        // Before hours of training, not after them.
        tce_sim::open_library()?;
        forget_peak_memory();
        let config = self.manifest.config(entry)?;
        let args = self.data(entry);
        let root = &args.out;
        let seeds = &[entry.seed];
        let mut diverged = false;
        let (score, place, files) = match entry.kind {
            Kind::Source => data_file(&source_file(entry.task, &args, config.source.rows)?)?,
            Kind::Target => data_file(&target_file(entry.task, &args)?)?,
            Kind::Augment => {
                let inputs = Inputs::of_config(entry.task, &args, &config)?;
                let stage = match config.mixture.generated {
                    GeneratedRows::None => label_models(&inputs, &config.labels, seeds, root, device)?.1,
                    _ => augment_rows(&inputs, &config, seeds, root, device)?.stage,
                };
                (None, stage.directory().to_owned(), files_of(stage.directory())?)
            }
            Kind::Distances => {
                let inputs = Inputs::of_config(entry.task, &args, &config)?;
                let kind = config.distances().expect("planned for a configuration that has some");
                let place = distances_stage(&inputs, kind, root)?.1;
                (None, place.clone(), files_of(&place)?)
            }
            Kind::Run => {
                let inputs = Inputs::of_config(entry.task, &args, &config)?;
                let name = entry.column().replace(' ', "-");
                let summary = run(&name, &inputs, &config, seeds, root, &entry.task.directory(), device)?;
                diverged = summary.learned.evaluations.first().is_some_and(|e| e.failed.is_some());
                (summary.scores.first().copied().flatten(), summary.directory.clone(), files_of(&summary.directory)?)
            }
            Kind::Verdict => self.verdict(entry, &config, device)?,
        };
        Ok(Outcome {
            id: entry.id.clone(),
            score,
            diverged,
            place: place.strip_prefix(&self.directory).unwrap_or(&place).to_owned(),
            files,
            seconds: clock.seconds(),
            memory: peak_memory(),
            program: PROGRAM.into(),
        })
    }

    /// Recommends one of the policies of the runs that `entry` needs; the verdict lies beside them.
    fn verdict(
        &self,
        entry: &Entry,
        config: &Config,
        device: &Device,
    ) -> Result<(Option<f64>, PathBuf, BTreeMap<String, String>)> {
        let root = self.data(entry).out;
        let mut candidates = Vec::new();
        let mut widest = None;
        for run in entry.needs.iter().map(|&n| &self.entries()[n]) {
            let done = self.outcome(run)?.ok_or_else(|| {
                Error::Failed(format!("{run} is not done, and the verdict needs its policy; launch the sweep again"))
            })?;
            let own = self.manifest.config(run)?;
            let variant = run.variant.expect("a run has a variant");
            let title = match run.label.as_str() {
                "" => variant.row_title(&own),
                label => format!("{}, {label}", variant.row_title(&own)),
            };
            candidates.push(Candidate {
                name: title,
                baseline: Variant::BASELINES.contains(&variant),
                files: vec![self.directory.join(&done.place).join(policy_file(run.seed))],
            });
            widest = widest.or(own.needs_source().then_some(own));
        }
        let inputs = Inputs::of_config(entry.task, &self.data(entry), widest.as_ref().unwrap_or(config))?;
        let evaluator = || OffPolicyEvaluator::train(&inputs, &config.dynamics, &root, device);
        let verdict = recommend_or_only(evaluator, &candidates)?;
        let task = root.join(entry.task.directory());
        let place = task.join(format!("{VERDICT}-seed{}-{}", entry.seed, &entry.id[..12]));
        create_folder(&place)?;
        // Relative to the task's folder, as that of `tce run` is.
        let policy = verdict.policy.strip_prefix(&task).unwrap_or(&verdict.policy).to_owned();
        let file = place.join("verdict.json");
        write_json(&file, &Verdict { policy, ..verdict })?;
        let files = BTreeMap::from([("verdict.json".to_owned(), sha256_file(&file)?)]);
        Ok((None, place, files))
    }

    /// Makes `outcome` the work's outcome, unless a copy of the work was first.
    ///
    /// # Errors
    /// If that copy has another result: both are kept.
    pub fn settle(&self, outcome: Outcome) -> Result<Outcome> {
        let path = self.file("done", &format!("{}.json", outcome.id));
        if write_json_first(&path, &outcome)? {
            return Ok(outcome);
        }
        let bytes = fs::read(&path).map_err(|e| FileError::new(&path, "read", e))?;
        match serde_json::from_slice::<Outcome>(&bytes) {
            Ok(first) if first.agrees(&outcome) => Ok(first),
            first => {
                let fault = self.file("faults", &format!("{}.{}.json", outcome.id, Owner::this()));
                write_json(&fault, &serde_json::json!({ "first": first.ok(), "later": outcome }))?;
                Err(Error::Failed(format!(
                    "two copies of the work {} came to different results; the first stays, and {} holds both. This is a \
                     fault of determinism: were they done by different builds or processors?",
                    outcome.id,
                    fault.display()
                )))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sweep::Manifest;

    #[test]
    fn the_first_outcome_stays_and_another_one_is_a_fault() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("s.toml");
        fs::write(&path, "tasks = [\"hopper-morph:medium->expert\"]\nvariants = [\"bc\"]\nbaselines = false\n")
            .unwrap();
        let sweep = Sweep::create(&dir.path().join("s"), Manifest::plan(&path).unwrap()).unwrap();
        let entry = sweep.entries().last().unwrap();
        let outcome = |score: f64, seconds: f64| Outcome {
            id: entry.id.clone(),
            score: Some(score),
            diverged: false,
            place: "runs/x".into(),
            files: BTreeMap::new(),
            seconds,
            memory: None,
            program: "tce".into(),
        };
        assert_eq!(sweep.outcome(entry).unwrap(), None);
        sweep.settle(outcome(1.0, 5.0)).unwrap();
        let without = |diverged| Outcome { score: None, diverged, ..outcome(1.0, 5.0) };
        assert_eq!(
            [outcome(1.0, 5.0), without(true), without(false)].map(|o| o.counted()),
            [Some(1.0), Some(0.0), None]
        );
        // The same in another time is the same.
        assert_eq!(sweep.settle(outcome(1.0, 7.0)).unwrap().seconds, 5.0);
        let message = sweep.settle(outcome(2.0, 5.0)).unwrap_err().to_string();
        assert!(message.contains("fault of determinism"), "{message}");
        assert_eq!(sweep.outcome(entry).unwrap().unwrap().score, Some(1.0));
        assert_eq!(sweep.gather().unwrap().conflicts.len(), 1);
        assert_eq!(sweep.status().unwrap().faults, 1);
        let left = fs::read_dir(dir.path().join("s/done")).unwrap().count();
        assert_eq!(left, 1, "nothing half-written stays");
    }
}
