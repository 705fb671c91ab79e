//! Finished work whose files are missing or changed. It is marked as unfinished, and the next launch does it again.
//!
//! Nothing is removed. The record and the files are renamed to `.NAME.damaged-N`.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use tce_base::FileError;

use super::work::Outcome;
use super::{Entry, Kind, Sweep};
use crate::error::{Error, Result};

/// What is looked at of files that are there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Check {
    /// Whether they exist.
    Existence,
    /// Their hashes, too.
    Content,
}

impl Sweep {
    /// Marks damaged work as unfinished, and describes it. `check` says what is looked at.
    ///
    /// # Errors
    /// If a folder cannot be written; with [`Check::Content`], if a user's own file changed since the sweep was planned.
    pub fn take_back_damaged(&self, check: Check) -> Result<Vec<String>> {
        let mut taken = Vec::new();
        let mut again = BTreeSet::new();
        for entry in self.entries() {
            // What was made of the planned file is whole; another file is another sweep.
            if let Some(change) = self.changed_input(entry).filter(|_| check == Check::Content) {
                return Err(Error::Failed(change));
            }
            let why = match self.outcome(entry) {
                Ok(None) => continue,
                Ok(Some(outcome)) => {
                    let damage = match check {
                        Check::Content => self.damage(entry, &outcome),
                        Check::Existence => self.lost(&outcome),
                    };
                    // A verdict on a policy that is learned again is one on another policy.
                    let stale = || {
                        let run = entry.needs.iter().find(|&n| again.contains(n))?;
                        let run = &self.entries()[*run];
                        (entry.kind == Kind::Verdict)
                            .then(|| format!("it is about the policy of work {run}, which is done again"))
                    };
                    let Some(why) = damage.or_else(stale) else { continue };
                    // A record that is another piece's has that piece's files.
                    if outcome.id == entry.id {
                        self.set_aside(entry, &outcome)?;
                    }
                    why
                }
                Err(e) => e.to_string(),
            };
            again.insert(entry.index);
            let record = self.file("done", &format!("{}.json", entry.id));
            move_aside(&record)?;
            let error = format!("it was done, and is to be done again: {why}");
            self.note_failure(entry, &error)?;
            taken.push(format!("{entry}: {why}"));
        }
        Ok(taken)
    }

    /// The first file that is not there.
    fn lost(&self, outcome: &Outcome) -> Option<String> {
        let place = self.directory.join(&outcome.place);
        let missing = outcome.files.keys().map(|name| place.join(name)).find(|file| !file.exists());
        missing.map(|file| format!("{}: no such file", file.display()))
    }

    fn set_aside(&self, entry: &Entry, outcome: &Outcome) -> Result<()> {
        let place = self.directory.join(&outcome.place);
        match entry.kind {
            // These lie in one folder with those of other tasks.
            Kind::Source | Kind::Target => outcome.files.keys().try_for_each(|name| move_aside(&place.join(name))),
            Kind::Distances | Kind::Augment | Kind::Run | Kind::Verdict => move_aside(&place),
        }
    }
}

/// Gives what is at `path` a name that is not taken, if there is anything.
fn move_aside(path: &Path) -> Result<()> {
    let old = path.file_name().unwrap_or_default().to_string_lossy();
    let name = |n: usize| path.with_file_name(format!(".{old}.damaged-{n}"));
    let free = (1..).map(name).find(|p| !p.exists()).expect("there are more numbers than files");
    match fs::rename(path, &free) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
            Err(FileError::new(&free, "rename what is damaged to", e).into())
        }
        _ => Ok(()),
    }
}
