//! Sweeps: many runs from one description, on machines that are preempted, crash and fill up.
//!
//! `tce sweep plan` turns a description into an immutable list of work, [`Manifest`]; `launch` gives unfinished work to processes
//! of this machine or to Slurm; `gather` makes a table of finished work. The folder, not a queue, says what is finished:
//!
//! | path in the sweep's folder | content |
//! |---|---|
//! | `manifest.jsonl` | a header with every configuration, then one line for each piece of work |
//! | `runs/` | data, stages and runs, as `tce run --out` leaves them; pieces of work share stages |
//! | `done/ID.json` | outcome of a piece of work, made by `link(2)`: the first one wins |
//! | `faults/` | outcomes that came later and differ: faults of determinism |
//! | `active/` | who is at which work: a file with a heartbeat for each process; what one does, no other begins |
//! | `spent/` | seconds that unfinished work took so far |
//! | `failed/`, `logs/`, `slurm/` | failures with reasons, output, submissions |

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

use tce_base::{FileError, read_if_there, sha256_file, write_atomically};

use crate::error::{Error, Result};
use crate::inputs::DataArgs;

mod claim;
mod description;
pub mod gather;
pub mod local;
mod manifest;
mod repair;
pub mod slurm;
pub mod status;
pub mod work;

pub use description::{Description, Files, Override, Tier, Unavailable};
pub use manifest::{Entry, Header, Kind, Manifest};
pub use repair::Check;

/// The list of work in a sweep's folder.
const MANIFEST: &str = "manifest.jsonl";

/// The sweep in whose folder `path` lies, or would lie; none outside of all.
pub fn around(path: &Path) -> Option<PathBuf> {
    let whole = std::path::absolute(path).ok()?;
    whole.ancestors().skip(1).find(|p| p.join(MANIFEST).is_file()).map(Path::to_owned)
}

/// A sweep's folder and its manifest.
#[derive(Clone, Debug)]
pub struct Sweep {
    /// The folder.
    pub directory: PathBuf,
    /// The work.
    pub manifest: Manifest,
}

impl Sweep {
    /// Writes `manifest` into `directory`, unless the same is there already.
    ///
    /// # Errors
    /// If another manifest is there: finished work belongs to it.
    pub fn create(directory: &Path, manifest: Manifest) -> Result<Self> {
        let path = directory.join(MANIFEST);
        let text = manifest.to_jsonl();
        match read_if_there(&path)? {
            Some(old) if old == text.as_bytes() => {}
            Some(_) => {
                return Err(Error::Usage(format!(
                    "{}: holds another plan, and a plan does not change; give another folder",
                    path.display()
                )));
            }
            None => write_atomically(&path, text.as_bytes())?,
        }
        Ok(Self { directory: directory.to_owned(), manifest })
    }

    /// The sweep planned in `directory`.
    ///
    /// # Errors
    /// If there is none, or its manifest is damaged.
    pub fn open(directory: &Path) -> Result<Self> {
        let path = directory.join(MANIFEST);
        let text = fs::read_to_string(&path).map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => {
                Error::Usage(format!("{}: no sweep here; plan one with `tce sweep plan`", directory.display()))
            }
            _ => FileError::new(&path, "read", e).into(),
        })?;
        Ok(Self { directory: directory.to_owned(), manifest: Manifest::parse(&text, &path)? })
    }

    /// The pieces of work.
    pub fn entries(&self) -> &[Entry] {
        &self.manifest.entries
    }

    /// How a user's own file of a piece of work has changed since the sweep was planned; None if it has not.
    pub fn changed_input(&self, entry: &Entry) -> Option<String> {
        // A file is hashed once as long as its size and time stay; gathering asks for every run.
        static KNOWN: Mutex<BTreeMap<(PathBuf, u64, SystemTime), String>> = Mutex::new(BTreeMap::new());
        let files = self.manifest.header.data.get(&entry.task)?;
        files.source.iter().chain(&files.target).find_map(|file| {
            let expected = self.manifest.header.hashes.get(file)?;
            let found = fs::metadata(file).map_err(|e| e.to_string()).and_then(|meta| {
                let key = (file.clone(), meta.len(), meta.modified().map_err(|e| e.to_string())?);
                let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
                if let Some(hash) = known.get(&key) {
                    return Ok(hash.clone());
                }
                let hash = sha256_file(file).map_err(|e| e.to_string())?;
                known.insert(key, hash.clone());
                Ok(hash)
            });
            (found.as_ref() != Ok(expected)).then(|| {
                format!(
                    "{}: found {}, expected SHA-256 {expected} as when the sweep was planned; put that file back, or plan a new sweep",
                    file.display(),
                    found.map_or_else(|e| e, |hash| format!("SHA-256 {hash}"))
                )
            })
        })
    }

    fn data(&self, entry: &Entry) -> DataArgs {
        DataArgs { out: self.directory.join("runs"), ..self.manifest.header.data_of(entry.task) }
    }

    /// A file about a piece of work, in one of the folders of the [module's](self) table.
    fn file(&self, folder: &str, name: &str) -> PathBuf {
        self.directory.join(folder).join(name)
    }
}

#[cfg(test)]
mod tests {
    use super::manifest::tests::{TWO, plan};
    use super::*;

    #[test]
    fn a_folder_holds_one_plan() {
        let dir = tempfile::tempdir().unwrap();
        let manifest = plan(TWO).unwrap();
        Sweep::create(dir.path(), manifest.clone()).unwrap();
        Sweep::create(dir.path(), manifest.clone()).unwrap();
        assert_eq!(Sweep::open(dir.path()).unwrap().manifest, manifest);
        let other = plan(&TWO.replace("seeds = 2", "seeds = 3")).unwrap();
        assert!(Sweep::create(dir.path(), other).unwrap_err().to_string().contains("another plan"));
    }
}
