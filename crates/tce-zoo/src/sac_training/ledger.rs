//! The checkpoints of a training run on disk, in two generations.

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_base::{Damage, FileError, read_json, sha256_files, verify_sha256, write_atomically, write_json};
use tce_data::{Transitions, save_d4rl};
use tce_learn::Meter;
use tce_nn::NamedParameters;

use super::settings::REMEDY;
use crate::error::{Error, Result};

/// The ledger of the last checkpoint.
const LAST: &str = "ledger.json";
/// The ledger of the checkpoint before.
const PREVIOUS: &str = "previous.json";

/// The mean return of an evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EvaluationSummary {
    /// Environment steps before the evaluation.
    pub step: u64,
    /// Mean return.
    pub mean: f64,
    /// Standard deviation over episodes.
    pub std: f64,
    /// Mean length of the episodes.
    pub length: f64,
    /// Normalised score (source domain: D4RL's reference returns). `None` if no reference returns are published.
    pub score: Option<f64>,
}

/// A policy that was kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// The score for which it was kept.
    pub at: f64,
    /// Its evaluation at that time.
    #[serde(alias = "judged")]
    pub evaluation: EvaluationSummary,
    /// Its file in the directory.
    pub file: String,
}

/// The progress of a training run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Ledger {
    /// Environment steps taken.
    pub step: u64,
    /// Episodes finished.
    pub episode: u64,
    /// All evaluations.
    pub evaluations: Vec<EvaluationSummary>,
    /// All snapshots.
    pub snapshots: Vec<Snapshot>,
    /// The checkpoint's files and their SHA-256.
    pub files: Vec<(String, String)>,
    /// Metrics since the last evaluation.
    #[serde(default)]
    pub meter: Meter,
}

impl Ledger {
    /// The ledger of the training run in `directory`, if it has a checkpoint.
    ///
    /// # Errors
    /// If the ledger is damaged.
    pub fn read(directory: &Path) -> Result<Option<Self>> {
        read(directory, LAST)
    }

    /// The newest undamaged one of the two checkpoints in `directory`, if there is a checkpoint.
    ///
    /// # Errors
    /// If there are checkpoints, but all of them are damaged.
    pub(super) fn newest_whole(directory: &Path) -> Result<Option<Self>> {
        let whole = |name: &str| -> Result<Option<Self>> {
            let ledger = read(directory, name)?;
            for (file, hash) in ledger.iter().flat_map(|l| &l.files) {
                verify(&directory.join(file), hash)?;
            }
            Ok(ledger)
        };
        let damage = match whole(LAST) {
            Ok(ledger) => return Ok(ledger),
            Err(damage) => damage,
        };
        match whole(PREVIOUS) {
            Ok(Some(ledger)) => {
                tce_base::note!("{damage}; going on from the checkpoint before, at step {}", ledger.step);
                Ok(Some(ledger))
            }
            _ => Err(damage),
        }
    }

    /// Whether `directory` has a checkpoint.
    pub(super) fn is_in(directory: &Path) -> bool {
        directory.join(LAST).exists()
    }

    /// Writes a checkpoint of this progress: the rows and the networks, then the ledger.
    ///
    /// # Errors
    /// If a file cannot be written; then the older checkpoints are as they were.
    pub(super) fn keep(&mut self, directory: &Path, rows: &Transitions, networks: &NamedParameters) -> Result<()> {
        let step = self.step;
        let (replay, learner) = (format!("replay-{step}.hdf5"), format!("learner-{step}.safetensors"));
        save_d4rl(&directory.join(&replay), rows, &Default::default(), &[])?;
        networks.save(&directory.join(&learner))?;
        let files = sha256_files(directory, [replay, learner])?;
        let before = std::mem::replace(&mut self.files, files);
        if let (false, Ok(bytes)) = (before.is_empty(), std::fs::read(directory.join(LAST))) {
            write_atomically(&directory.join(PREVIOUS), &bytes)?;
        }
        write_json(&directory.join(LAST), self)?;
        tidy(directory, &before);
        Ok(())
    }
}

fn read(directory: &Path, name: &str) -> Result<Option<Ledger>> {
    Ok(read_json(&directory.join(name), REMEDY)?)
}

/// Refuses a file that is not what the ledger says.
pub(super) fn verify(path: &Path, hash: &str) -> Result<()> {
    verify_sha256(path, hash).map_err(|damage| match damage {
        Damage::File(error) => error.into(),
        Damage::Changed { .. } => {
            Error::Failed(format!("{}: not what the ledger says; the file was changed", path.display()))
        }
    })
}

/// Locks the directory: two programs in one directory would delete each other's checkpoints.
pub(super) fn lock(directory: &Path) -> Result<std::fs::File> {
    let path = directory.join("lock");
    let file = std::fs::File::create(&path).map_err(|e| FileError::new(&path, "create", e))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(std::fs::TryLockError::WouldBlock) => Err(Error::Usage(format!(
            "{}: another training is at work there; let it finish, or give another --out",
            directory.display()
        ))),
        // Some network file systems do not support locks.
        Err(std::fs::TryLockError::Error(_)) => Ok(file),
    }
}

/// Removes checkpoints other than `kept` and the two in the ledgers, and half-written files of a killed program: they
/// only waste space. Nothing is removed if a ledger cannot be read.
pub(super) fn tidy(directory: &Path, kept: &[(String, String)]) {
    let (Ok(last), Ok(previous)) = (read(directory, LAST), read(directory, PREVIOUS)) else { return };
    let known: Vec<_> = last.iter().chain(&previous).flat_map(|l| &l.files).chain(kept).collect();
    for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let ours = name.starts_with("replay-") || name.starts_with("learner-") || name.ends_with(".part");
        if ours && known.iter().all(|(file, _)| *file != name) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}
