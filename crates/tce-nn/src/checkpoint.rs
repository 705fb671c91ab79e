//! Checkpoints of a training on disk, in two generations. A kill during a write, or a file that is damaged later, costs some minutes of
//! work, never the result.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use tce_base::{FileError, Sealed, read_sealed, write_sealed};

use crate::params::NamedParameters;

static MILLISECONDS: AtomicU64 = AtomicU64::new(60_000);
/// Metadata of a checkpoint: its number in its training.
const GENERATION: &str = "checkpoint.generation";
/// Metadata of a checkpoint: the step it stands at.
const STEP: &str = "checkpoint.step";

/// Sets the time between two checkpoints of a training, 60 s unless set. Results do not depend on it.
pub fn set_checkpoint_seconds(seconds: f64) {
    MILLISECONDS.store((seconds.clamp(0.0, 1e9) * 1e3) as u64, Ordering::Relaxed);
}

/// The checkpoints `NAME.0.checkpoint` and `NAME.1.checkpoint` of one training in one directory.
#[derive(Debug)]
pub struct Checkpoints {
    /// None: nothing is kept.
    place: Option<Place>,
    restored: Option<(u64, NamedParameters, PathBuf)>,
    last: Instant,
}

#[derive(Debug)]
struct Place {
    paths: [PathBuf; 2],
    key: String,
    generation: u64,
}

impl Checkpoints {
    /// Nothing is kept: for trainings of seconds, and tests.
    pub fn none() -> Self {
        Self { place: None, restored: None, last: Instant::now() }
    }

    /// Those of the training `name` in `directory`; the newer one that is whole is read. `key`, one word, identifies all that
    /// decides the training: checkpoints with another key are not looked at.
    ///
    /// # Errors
    /// If a checkpoint is there and cannot be read. A damaged one is told of and passed over.
    pub fn open(directory: &Path, name: &str, key: &str) -> Result<Self, FileError> {
        let paths = [0, 1].map(|k| directory.join(format!("{name}.{k}.checkpoint")));
        let (mut generation, mut restored) = (0, None);
        for path in &paths {
            let read = match read_sealed(path, key)? {
                Sealed::Absent | Sealed::Foreign => continue,
                Sealed::Damaged => None,
                Sealed::Whole(bytes) => NamedParameters::from_bytes(&bytes, path).ok(),
            };
            let number = |p: &NamedParameters, key: &str| p.metadata.get(key).and_then(|v| v.parse::<u64>().ok());
            match read.and_then(|p| Some((number(&p, GENERATION)?, number(&p, STEP)?, p))) {
                None => tce_base::note!("{}: damaged, passed over", path.display()),
                Some((g, step, parameters)) if g >= generation => {
                    generation = g;
                    restored = Some((step, parameters, path.clone()));
                }
                Some(_) => {}
            }
        }
        Ok(Self { place: Some(Place { paths, key: key.to_owned(), generation }), restored, last: Instant::now() })
    }

    /// The step from which the training resumes, if there was a checkpoint.
    pub fn step(&self) -> Option<u64> {
        self.restored.as_ref().map(|r| r.0)
    }

    /// The state to resume from, with its file; once.
    pub fn restore(&mut self) -> Option<(u64, NamedParameters, PathBuf)> {
        self.restored.take().inspect(|_| tce_base::resume_step())
    }

    /// Whether it is time for a checkpoint.
    pub fn due(&self) -> bool {
        self.place.is_some() && self.last.elapsed() >= Duration::from_millis(MILLISECONDS.load(Ordering::Relaxed))
    }

    /// Keeps `state`, the state after `step` steps, in place of the older generation.
    ///
    /// # Errors
    /// If it cannot be written; then the older checkpoints are as they were.
    pub fn keep(&mut self, step: u64, mut state: NamedParameters) -> Result<(), FileError> {
        let Some(place) = &mut self.place else { return Ok(()) };
        let generation = place.generation + 1;
        state.metadata.insert(GENERATION.into(), generation.to_string());
        state.metadata.insert(STEP.into(), step.to_string());
        write_sealed(&place.paths[(generation % 2) as usize], &place.key, &state.to_bytes())?;
        place.generation = generation;
        self.last = Instant::now();
        Ok(())
    }

    /// Removes them: the training's result is on disk.
    pub fn remove(&self) {
        for path in self.place.iter().flat_map(|p| &p.paths) {
            let _ = std::fs::remove_file(path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(value: f32) -> NamedParameters {
        let mut state = NamedParameters::default();
        state.tensors.insert("x".into(), (vec![1], vec![value]));
        state
    }

    #[test]
    fn the_newest_whole_generation_counts() {
        let dir = tempfile::tempdir().unwrap();
        let open = || Checkpoints::open(dir.path(), "t", "key").unwrap();
        let value = |c: &mut Checkpoints| c.restore().map(|(step, p, _)| (step, p.tensors["x"].1[0]));
        let mut first = open();
        assert_eq!((first.step(), value(&mut first)), (None, None));
        for k in 1..=3 {
            first.keep(10 * k, state(k as f32)).unwrap();
        }
        assert_eq!(value(&mut open()), Some((30, 3.0)));
        assert_eq!(value(&mut Checkpoints::open(dir.path(), "t", "other").unwrap()), None);

        let newest = dir.path().join("t.1.checkpoint");
        let mut bytes = std::fs::read(&newest).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 4;
        std::fs::write(&newest, bytes).unwrap();
        let mut again = open();
        assert_eq!(value(&mut again), Some((20, 2.0)));
        // The damaged one is what the next replaces.
        again.keep(40, state(4.0)).unwrap();
        assert_eq!(value(&mut open()), Some((40, 4.0)));
        again.remove();
        assert_eq!(value(&mut open()), None);
    }
}
