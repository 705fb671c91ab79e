//! Stores the products of a fit in the attempt at a stage: checkpoints, metrics, sampled chunks and the networks at the ends of cycles.

use std::sync::{Mutex, PoisonError};

use tce_augment::work::Keeper;
use tce_base::{FileError, Metrics};
use tce_diffusion::{Chunks, DiffusionError, ScoreModel};
use tce_nn::Checkpoints;

use crate::stage::Attempt;

/// Keeps what a fit has done in an attempt.
pub struct Kept<'a> {
    attempt: &'a Attempt,
    metrics: Mutex<Option<Metrics>>,
}

impl<'a> Kept<'a> {
    /// In `attempt`.
    pub fn new(attempt: &'a Attempt) -> Self {
        Self { attempt, metrics: Mutex::new(None) }
    }
}

impl Keeper for Kept<'_> {
    fn checkpoints(&self, name: &str) -> Result<Checkpoints, FileError> {
        Checkpoints::open(self.attempt.directory(), name, self.attempt.key())
    }

    fn begin(&self, trainings: &[(&str, u64)]) -> Result<(), FileError> {
        let known = |name: &str, at: u64| trainings.iter().any(|(training, step)| *training == name && at <= *step);
        let metrics = Metrics::resume(self.attempt.directory(), known)?;
        *self.metrics.lock().unwrap_or_else(PoisonError::into_inner) = Some(metrics);
        Ok(())
    }

    fn record(&self, name: &str, step: u64, metric: &'static str, values: &[f64]) {
        let mut metrics = self.metrics.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(metrics) = metrics.as_mut() else { return };
        for (m, &value) in values.iter().enumerate() {
            // A metric that cannot be written must not cost the training.
            let _ = metrics.log(name, step, m, [(metric, value)]);
        }
    }

    fn cycle(&self, name: &str, step: u64, model: &ScoreModel) -> Result<(), DiffusionError> {
        model.save(&self.attempt.file(&cycle_file(name, step)))
    }

    fn chunks(&self) -> Option<Chunks<'_>> {
        Some(Chunks { directory: self.attempt.directory(), key: self.attempt.key() })
    }
}

/// The file of the network `name` as it was at the end of a cycle.
pub fn cycle_file(name: &str, step: u64) -> String {
    format!("{name}-{step}.safetensors")
}
