//! How long work took, over all its attempts.
//!
//! Work that was interrupted goes on from its last checkpoint, in another process. A [`Clock`] adds what earlier attempts took up to that
//! checkpoint; what they did behind it is done again, and counts once. A small file holds the seconds so far. It is written where work
//! begins, and where a part of it is done. A checkpoint, or a chunk of rows, beside the file that is newer than the file tells how
//! much longer the attempt went on. Where there is no such file, as in the folders of earlier versions, earlier attempts count as nothing.
//!
//! Clocks run inside of others: that of a stage inside of that of its run, and this one inside of that of a sweep's piece of work. What an
//! inner clock finds behind its last note, the outer ones lack, too.

use std::cell::RefCell;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Instant, SystemTime};

use serde::{Deserialize, Serialize};
use tce_base::{create_folder, write_json};

/// What the names of these files end with, where they lie beside checkpoints.
pub(crate) const SUFFIX: &str = "seconds";

thread_local! {
    /// The clocks of the work on this thread, the outermost first.
    static RUNNING: RefCell<Vec<Weak<Face>>> = const { RefCell::new(Vec::new()) };
}

/// The content of the file.
#[derive(Serialize, Deserialize)]
struct Content {
    /// Seconds of all attempts until the file was written.
    seconds: f64,
}

/// What the file of a clock says.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Noted {
    /// Seconds of all attempts until then.
    pub seconds: f64,
    /// When it was written.
    pub at: SystemTime,
}

/// The seconds that are noted at `path`; None where nothing is noted that can be read.
pub(crate) fn noted(path: &Path) -> Option<Noted> {
    let at = fs::metadata(path).and_then(|m| m.modified()).ok()?;
    let Content { seconds } = serde_json::from_slice(&fs::read(path).ok()?).ok()?;
    (seconds.is_finite() && seconds >= 0.0).then_some(Noted { seconds, at })
}

#[derive(Debug)]
struct Face {
    /// The file.
    path: PathBuf,
    started: Instant,
    /// Seconds of earlier attempts.
    before: Mutex<f64>,
}

impl Face {
    fn seconds(&self) -> f64 {
        *self.before.lock().unwrap_or_else(PoisonError::into_inner) + self.started.elapsed().as_secs_f64()
    }

    fn add(&self, seconds: f64) {
        *self.before.lock().unwrap_or_else(PoisonError::into_inner) += seconds;
    }

    /// Writes the file. A time that cannot be written must not cost the work; a folder that was removed stays so.
    fn note(&self) {
        if self.path.parent().is_some_and(Path::is_dir) {
            let _ = write_json(&self.path, &Content { seconds: self.seconds() });
        }
    }
}

/// Counts the seconds of work until it is dropped.
#[derive(Debug)]
pub(crate) struct Clock {
    face: Arc<Face>,
}

impl Clock {
    /// Starts the clock of the work whose seconds are noted at `path`, and whose checkpoints lie beside that file.
    pub fn start(path: PathBuf) -> Self {
        if let Some(folder) = path.parent() {
            let _ = create_folder(folder);
        }
        let noted = noted(&path);
        let more = noted.map_or(0.0, |noted| since_note(&path, noted.at));
        let before = noted.map_or(0.0, |noted| noted.seconds) + more;
        let outer = running();
        // A clock with a file in the same folder has looked at the same checkpoints.
        if !outer.iter().any(|face| face.path.parent() == path.parent()) {
            outer.iter().for_each(|face| face.add(more));
        }
        let face = Arc::new(Face { path, started: Instant::now(), before: Mutex::new(before) });
        RUNNING.with_borrow_mut(|all| all.push(Arc::downgrade(&face)));
        note_all();
        Self { face }
    }

    /// Seconds so far, of all attempts.
    pub fn seconds(&self) -> f64 {
        self.face.seconds()
    }

    /// The work is done, and its folder may be gone: the clocks around it count it from now on.
    pub fn finish(self) {
        drop(self);
        note_all();
    }

    /// The work is done, and nobody will resume it: removes the file.
    pub fn forget(self) {
        let path = self.face.path.clone();
        drop(self);
        let _ = fs::remove_file(path);
    }
}

/// The clocks that run on this thread.
fn running() -> Vec<Arc<Face>> {
    RUNNING.with_borrow_mut(|all| {
        all.retain(|face| face.strong_count() > 0);
        all.iter().filter_map(Weak::upgrade).collect()
    })
}

/// Writes the files of all of them.
fn note_all() {
    running().iter().for_each(|face| face.note());
}

/// Seconds from `noted`, when the file at `path` was written, until the last checkpoint or chunk beside it.
fn since_note(path: &Path, noted: SystemTime) -> f64 {
    let entries = path.parent().and_then(|folder| fs::read_dir(folder).ok());
    let kept = entries
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.path().extension().is_some_and(|e| e == "checkpoint" || e == "chunk"));
    let last = kept.filter_map(|entry| entry.metadata().and_then(|m| m.modified()).ok()).max();
    last.and_then(|last| last.duration_since(noted).ok()).map_or(0.0, |d| d.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    /// An attempt that went on for some seconds after its note, up to its last checkpoint, and was then killed.
    fn killed(note: &Path, seconds: f64, more: u64) {
        let folder = note.parent().unwrap();
        fs::create_dir_all(folder).unwrap();
        fs::write(note, format!("{{ \"seconds\": {seconds} }}")).unwrap();
        fs::write(folder.join("learner.0.checkpoint"), b"state").unwrap();
        // Whatever came behind the checkpoint is done again.
        fs::write(folder.join("metrics.jsonl"), b"").unwrap();
        let noted = SystemTime::now() - Duration::from_secs(100_000);
        let set = |path: &Path, at: SystemTime| {
            fs::File::options().append(true).open(path).unwrap().set_modified(at).unwrap();
        };
        set(note, noted);
        set(&folder.join("learner.0.checkpoint"), noted + Duration::from_secs(more));
    }

    fn about(found: f64, expected: f64) {
        assert!((found - expected).abs() < 30.0, "found {found}, expected about {expected}");
    }

    #[test]
    fn earlier_attempts_count_up_to_their_last_checkpoint() {
        let dir = tempfile::tempdir().unwrap();
        let note = dir.path().join("stage/attempt.seconds");
        about(Clock::start(note.clone()).seconds(), 0.0);
        killed(&note, 1000.0, 500);
        about(Clock::start(note.clone()).seconds(), 1500.0);
        // Killed again before the next checkpoint: nothing counts twice.
        about(Clock::start(note.clone()).seconds(), 1500.0);
        Clock::start(note.clone()).forget();
        assert!(!note.exists());
        for damaged in ["", "{}", "{ \"seconds\": -5 }", "{ \"seconds\": null }"] {
            fs::write(&note, damaged).unwrap();
            about(Clock::start(note.clone()).seconds(), 0.0);
        }
    }

    #[test]
    fn clocks_around_others_count_the_same_seconds_once() {
        let dir = tempfile::tempdir().unwrap();
        let [piece, run, learner, stage] =
            ["spent/a.json", "run/attempt.seconds", "run/learner.seconds", "s/a.seconds"]
                .map(|name| dir.path().join(name));
        // A piece of work and its run were noted when their stage began, which was killed later.
        killed(&stage, 0.0, 300);
        for (note, seconds) in [(&piece, 2000.0), (&run, 1000.0)] {
            fs::create_dir_all(note.parent().unwrap()).unwrap();
            fs::write(note, format!("{{ \"seconds\": {seconds} }}")).unwrap();
        }
        let (outer, inner) = (Clock::start(piece.clone()), Clock::start(run.clone()));
        let within = Clock::start(stage.clone());
        about(within.seconds(), 300.0);
        about(inner.seconds(), 1300.0);
        about(outer.seconds(), 2300.0);
        fs::remove_dir_all(dir.path().join("s")).unwrap();
        within.finish();
        assert!(!dir.path().join("s").exists(), "what is gone stays so");
        drop((outer, inner));
        about(noted(&piece).unwrap().seconds, 2300.0);

        // A training in the folder of its run: both look at its checkpoints, and the piece of work around them counts them once.
        killed(&run, 1300.0, 400);
        fs::write(&learner, "{ \"seconds\": 50 }").unwrap();
        let at = noted(&run).unwrap().at;
        fs::File::options().append(true).open(&learner).unwrap().set_modified(at).unwrap();
        let (outer, inner) = (Clock::start(piece.clone()), Clock::start(run.clone()));
        let training = Clock::start(learner.clone());
        about(training.seconds(), 450.0);
        about(inner.seconds(), 1700.0);
        about(outer.seconds(), 2700.0);
        outer.forget();
        assert!(!piece.exists() && learner.exists());
    }
}
