//! Stages: one directory per piece of work, named by the hash of all its inputs.
//!
//! A stage is done when its `done.json` exists. This file lists the files of the stage. A run uses a stage that is done, and does the
//! work otherwise. Runs with the same inputs share it.
//!
//! Each process works in a directory of its own ([`Attempt`]): on a cluster, a job that was believed dead may still run beside its
//! successor. A new attempt takes over checkpoints, metrics and sampled chunks of an
//! earlier one. The end of an attempt is one `link(2)` of a complete `done.json`: the first one wins. A later one with the same bytes
//! changes nothing; one with other bytes means that the work is not deterministic: it is kept as `fault-*.json` and reported.

use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::SystemTime;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tce_base::metrics::Metrics;
use tce_base::{
    ATTEMPTS, Damage, FileError, Owner, PROGRAM, create_folder, link_first, read_json, sha256_files, sha256_hex,
    verify_sha256, write_json,
};
use tce_nn::{Checkpoints, Device};

use crate::clock::{self, Clock};
use crate::device_kind::DeviceKind;
use crate::error::{Error, Result};

/// Version of the computation. Increase it when the same specification gives other bytes.
const FORMAT: u32 = 4;

/// What marks a stage as done.
#[derive(Serialize, Deserialize)]
struct Done<T> {
    /// The program that wrote it.
    program: String,
    /// The processor that it ran on: another one may give other bytes.
    #[serde(default)]
    machine: String,
    /// The attempt that made it.
    attempt: String,
    /// SHA-256 of every file of the stage.
    files: BTreeMap<String, String>,
    /// The stage's own summary.
    summary: T,
}

/// The place of one stage.
#[derive(Clone, Debug)]
pub struct Stage {
    directory: PathBuf,
    key: String,
}

impl Stage {
    /// The stage `name` for `spec` under `root`. The specification is kept beside the results. What another device than the CPU
    /// computes is a stage of its own: it has other bytes.
    pub fn open<S: Serialize>(root: &Path, name: &str, spec: &S, device: &Device) -> Result<Self> {
        let mut spec = serde_json::json!({ "format": FORMAT, "stage": name.rsplit('/').next(), "spec": spec });
        DeviceKind::from(device).sign(&mut spec);
        let key = sha256_hex(spec.to_string().as_bytes());
        let directory = root.join(format!("{name}-{}", &key[..12]));
        create_folder(&directory)?;
        let path = directory.join("spec.json");
        if !path.exists() {
            write_json(&path, &spec)?;
        }
        Ok(Self { directory, key })
    }

    /// Where the stage's files are.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// The directory's own name, which holds the hash of the specification.
    pub fn name(&self) -> String {
        self.directory.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned())
    }

    /// A file of the finished stage.
    pub fn file(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    fn done<T: DeserializeOwned>(&self) -> Result<Option<Done<T>>> {
        Ok(read_json(&self.file("done.json"), "remove the directory to do the stage again")?)
    }

    /// The summary, if the stage is done and its files are what they were.
    ///
    /// # Errors
    /// If a file of a finished stage was changed or removed.
    pub fn summary<T: DeserializeOwned>(&self) -> Result<Option<T>> {
        let Some(done) = self.done::<T>()? else { return Ok(None) };
        // The winner may have been killed before it gave its files their places.
        self.place(&done.attempt, done.files.keys());
        let attempt = self.directory.join(ATTEMPTS).join(&done.attempt);
        if attempt.exists() && Owner::of(&attempt).is_some_and(|owner| owner.dead()) {
            self.clear(&done.attempt);
        }
        for (name, expected) in &done.files {
            verify_sha256(&self.file(name), expected).map_err(|damage| match damage {
                Damage::File(error) => error.into(),
                changed => Error::Failed(format!(
                    "{changed}: the file was changed since the stage was done; remove {} to do it again",
                    self.directory.display()
                )),
            })?;
        }
        Ok(Some(done.summary))
    }

    /// Gives files of the winning attempt their places in the stage; what is in place already stays.
    fn place<'a>(&self, attempt: &str, files: impl Iterator<Item = &'a String>) {
        let from = self.directory.join(ATTEMPTS).join(attempt);
        for name in files {
            let (from, to) = (from.join(name), self.file(name));
            if !to.exists() && fs::hard_link(&from, &to).is_err() && !to.exists() {
                // A file system without hard links: the attempt's file is complete, so that a rename is whole, too.
                let _ = fs::rename(&from, &to);
            }
        }
    }

    /// The last steps of the winning attempt, after its files are in place: copies the metrics, which are no part of the result,
    /// and removes the attempt.
    fn clear(&self, attempt: &str) {
        let directory = self.directory.join(ATTEMPTS).join(attempt);
        self.place(attempt, std::iter::once(&"metrics.jsonl".to_owned()));
        let _ = fs::rename(directory.join("tensorboard"), self.file("tensorboard"));
        self.discard(attempt);
    }

    /// Removes an attempt.
    fn discard(&self, attempt: &str) {
        let _ = fs::remove_dir_all(self.directory.join(ATTEMPTS).join(attempt));
        // Goes away with the last attempt.
        let _ = fs::remove_dir(self.directory.join(ATTEMPTS));
    }

    /// Starts or resumes the work of this stage.
    ///
    /// # Errors
    /// If the directory cannot be made.
    pub fn attempt(&self) -> Result<Attempt> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let n = COUNT.fetch_add(1, Ordering::Relaxed);
        let name = format!("{}.{n}", Owner::this());
        let attempts = self.directory.join(ATTEMPTS);
        let directory = attempts.join(&name);
        let mut others: Vec<_> = match fs::read_dir(&attempts) {
            Ok(entries) => entries.flatten().map(|entry| (newest(&entry.path()), entry.path())).collect(),
            Err(e) if e.kind() == ErrorKind::NotFound => Vec::new(),
            Err(e) => return Err(FileError::new(&attempts, "read the directory", e).into()),
        };
        others.sort();
        let mut taken = false;
        for (_, other) in others.into_iter().rev() {
            let dead = Owner::of(&other).is_some_and(|owner| owner.dead());
            match (taken, dead) {
                // Its owner is dead: nobody writes there. If two processes want it, one gets it.
                (false, true) => taken = fs::rename(&other, &directory).is_ok(),
                // Its owner may run on another machine. A copy of its work is a valid earlier state of the same training.
                (false, false) => taken = copy(&other, &directory).is_ok(),
                (true, true) => drop(fs::remove_dir_all(&other)),
                (true, false) => {}
            }
        }
        create_folder(&directory)?;
        let clock = Clock::start(directory.join(format!("attempt.{}", clock::SUFFIX)));
        Ok(Attempt { stage: self.clone(), name, directory, clock })
    }
}

/// One try at a stage, in a directory of its own.
#[derive(Debug)]
pub struct Attempt {
    stage: Stage,
    name: String,
    directory: PathBuf,
    clock: Clock,
}

impl Attempt {
    /// Where the work happens.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// A file in the making.
    pub fn file(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    /// The hash of the specification, which checkpoints and chunks of this stage carry.
    pub fn key(&self) -> &str {
        &self.stage.key
    }

    /// Seconds that the stage took so far, with earlier attempts up to their last checkpoint.
    pub fn seconds(&self) -> f64 {
        self.clock.seconds()
    }

    /// The checkpoints of the training `name`.
    pub fn checkpoints(&self, name: &str) -> Result<Checkpoints> {
        Ok(Checkpoints::open(&self.directory, name, &self.stage.key)?)
    }

    /// The metrics so far, without those of steps that will come again: `keep` tells by kind and step.
    pub fn metrics(&self, keep: impl Fn(&str, u64) -> bool) -> Result<Metrics> {
        Ok(Metrics::resume(&self.directory, keep)?)
    }

    /// Makes `name` in this attempt the same file as `from`, without a copy where the file system allows it.
    pub fn link(&self, from: &Path, name: &str) -> Result<()> {
        let to = self.file(name);
        if to.exists() {
            fs::remove_file(&to).map_err(|e| FileError::new(&to, "replace", e))?;
        }
        fs::hard_link(from, &to)
            .or_else(|_| fs::copy(from, &to).map(drop))
            .map_err(|e| FileError::new(&to, "link or copy", e).into())
    }

    /// Marks the stage as done with `files` of this attempt, unless another attempt was first.
    ///
    /// # Errors
    /// If another attempt was first with other bytes; if a file cannot be read or written.
    pub fn finish<T: Serialize>(self, files: &[String], summary: T) -> Result<()> {
        let done = Done {
            program: PROGRAM.into(),
            machine: tce_nn::machine(),
            attempt: self.name.clone(),
            files: sha256_files(&self.directory, files.iter().cloned())?,
            summary,
        };
        let own = self.file("done.json");
        write_json(&own, &done)?;
        if link_first(&own, &self.stage.file("done.json"))? {
            self.stage.place(&self.name, files.iter());
            self.stage.clear(&self.name);
        } else {
            let winner = self.stage.done::<serde_json::Value>()?;
            if let Some(winner) = winner.filter(|w| w.files != done.files) {
                let fault = self.stage.file(&format!("fault-{}.json", self.name));
                let value = serde_json::json!({
                    "first": { "program": winner.program, "attempt": winner.attempt, "files": winner.files },
                    "later": { "program": done.program, "attempt": done.attempt, "files": done.files },
                });
                write_json(&fault, &value)?;
                return Err(Error::Failed(format!(
                    "{}: two attempts at the same work gave different bytes; the first one's result stays, and {} holds both \
                     lists of hashes. This is a fault of determinism: were the two made by different builds or processors?",
                    self.stage.directory.display(),
                    fault.display()
                )));
            }
            self.stage.discard(&self.name);
        }
        self.clock.finish();
        Ok(())
    }
}

/// The time of the last change below `directory`.
fn newest(directory: &Path) -> SystemTime {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    // Seconds are noted before anything is done.
    let work = entries.filter(|e| e.path().extension().is_none_or(|e| e != clock::SUFFIX));
    let times = work.filter_map(|e| e.metadata().and_then(|m| m.modified()).ok());
    times.max().unwrap_or(SystemTime::UNIX_EPOCH)
}

/// Copies what is in `from` into `to`; on a failure there is no `to`.
fn copy(from: &Path, to: &Path) -> std::io::Result<()> {
    fn all(from: &Path, to: &Path) -> std::io::Result<()> {
        fs::create_dir_all(to)?;
        for entry in fs::read_dir(from)? {
            let entry = entry?;
            let to = to.join(entry.file_name());
            if entry.file_type()?.is_dir() {
                all(&entry.path(), &to)?;
            } else if !entry.file_name().to_string_lossy().ends_with(".part") {
                match fs::copy(entry.path(), &to) {
                    Ok(_) => keep_time(&entry, &to),
                    // Its owner is at work and has replaced or removed it.
                    Err(e) if e.kind() == ErrorKind::NotFound => {}
                    Err(e) => return Err(e),
                }
            }
        }
        Ok(())
    }
    all(from, to).inspect_err(|_| drop(fs::remove_dir_all(to)))
}

/// Gives the copy `to` the time of its original: the times of checkpoints tell how long an attempt took.
fn keep_time(from: &fs::DirEntry, to: &Path) {
    let time = from.metadata().and_then(|m| m.modified());
    let _ = time.and_then(|time| fs::File::options().append(true).open(to)?.set_modified(time));
}

/// SHA-256 of the files of the finished stage in `directory`, as its `done.json` lists them.
///
/// # Errors
/// If the stage is not done, or its record is damaged.
pub fn files_of(directory: &Path) -> Result<BTreeMap<String, String>> {
    let stage = Stage { directory: directory.to_owned(), key: String::new() };
    let done = stage.done::<serde_json::Value>()?;
    done.map(|d| d.files).ok_or_else(|| Error::missing(directory, "no done.json: the stage is not finished"))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn stage(root: &Path, spec: u32) -> Stage {
        Stage::open(root, "stages/test", &("spec", spec), &tce_nn::cpu()).unwrap()
    }

    fn make(attempt: Attempt, content: &[u8]) -> Result<()> {
        fs::write(attempt.file("rows"), content).unwrap();
        attempt.finish(&["rows".into()], 7u32)
    }

    #[test]
    fn a_stage_is_done_once_and_damage_is_noticed() {
        let root = tempfile::tempdir().unwrap();
        let first = stage(root.path(), 1);
        assert_eq!(first.summary::<u32>().unwrap(), None);
        make(first.attempt().unwrap(), b"data").unwrap();
        assert!(!first.directory().join(ATTEMPTS).exists());
        let again = stage(root.path(), 1);
        assert_eq!(again.summary::<u32>().unwrap(), Some(7));
        assert_eq!(stage(root.path(), 2).summary::<u32>().unwrap(), None);
        fs::write(first.file("rows"), b"DATA").unwrap();
        let message = again.summary::<u32>().unwrap_err().to_string();
        assert!(message.contains("rows") && message.contains("changed"), "{message}");
    }

    #[test]
    fn of_two_copies_the_first_wins_and_a_difference_is_a_fault() {
        let root = tempfile::tempdir().unwrap();
        let s = stage(root.path(), 1);
        let [a, b, c] = [(); 3].map(|()| s.attempt().unwrap());
        make(b, b"data").unwrap();
        make(a, b"data").unwrap();
        assert_eq!(s.summary::<u32>().unwrap(), Some(7));
        let message = make(c, b"other").unwrap_err().to_string();
        assert!(message.contains("fault of determinism"), "{message}");
        assert_eq!(fs::read(s.file("rows")).unwrap(), b"data");
        assert_eq!(s.summary::<u32>().unwrap(), Some(7));
    }

    #[test]
    fn a_winner_that_dies_before_it_places_its_files_has_won() {
        let root = tempfile::tempdir().unwrap();
        let s = stage(root.path(), 1);
        let attempt = s.attempt().unwrap();
        fs::write(attempt.file("rows"), b"data").unwrap();
        let files = BTreeMap::from([("rows".to_owned(), sha256_hex(b"data"))]);
        let done =
            Done { program: "tce".into(), machine: String::new(), attempt: attempt.name.clone(), files, summary: 7u32 };
        write_json(&s.file("done.json"), &done).unwrap();
        drop(attempt);
        assert_eq!(s.summary::<u32>().unwrap(), Some(7));
        assert!(s.file("rows").exists());
    }

    #[test]
    fn a_stage_counts_earlier_attempts_up_to_their_last_checkpoint() {
        let root = tempfile::tempdir().unwrap();
        let s = stage(root.path(), 1);
        let first = s.attempt().unwrap();
        // After 500 seconds it was noted two hours ago; the last checkpoint is an hour old.
        for (name, content, hours) in [("attempt.seconds", "{\"seconds\":500}", 2), ("labels.1.checkpoint", "state", 1)]
        {
            fs::write(first.file(name), content).unwrap();
            let time = SystemTime::now() - Duration::from_secs(3600 * hours);
            fs::File::options().append(true).open(first.file(name)).unwrap().set_modified(time).unwrap();
        }
        // It may still run somewhere: its state and its times are copied.
        let next = s.attempt().unwrap();
        assert!(next.file("labels.1.checkpoint").exists());
        let seconds = next.seconds();
        assert!((4100.0..4160.0).contains(&seconds), "{seconds}");
        make(next, b"data").unwrap();
        assert!(!s.file("attempt.seconds").exists(), "it is no result");
    }

    #[test]
    fn a_dead_process_is_inherited_and_a_living_one_is_copied() {
        let root = tempfile::tempdir().unwrap();
        let s = stage(root.path(), 1);
        let alive = s.attempt().unwrap();
        fs::write(alive.file("note"), b"alive").unwrap();
        let copy = s.attempt().unwrap();
        assert_eq!(fs::read(copy.file("note")).unwrap(), b"alive");
        assert!(alive.file("note").exists());
        for attempt in [&alive, &copy] {
            fs::remove_dir_all(attempt.directory()).unwrap();
        }

        // A process cannot have started at 1: whoever had this number is gone.
        let this = Owner::this().to_string();
        let (machine_and_process, _) = this.rsplit_once('.').unwrap();
        let left = s.directory().join(ATTEMPTS).join(format!("{machine_and_process}.1.0"));
        fs::create_dir_all(&left).unwrap();
        fs::write(left.join("note"), b"dead").unwrap();
        let heir = s.attempt().unwrap();
        assert_eq!(fs::read(heir.file("note")).unwrap(), b"dead");
        assert!(!left.exists());
    }
}
