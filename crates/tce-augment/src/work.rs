//! The inputs of a fit besides data and settings: seeds, a device, and where checkpoints and metrics are stored.

use tce_base::{FileError, Streams};
use tce_diffusion::{Chunks, DiffusionError, ScoreModel};
use tce_nn::{Checkpoints, Device, cpu};

/// Stores checkpoints, metrics and samples of a fit. The default methods store nothing.
pub trait Keeper: Sync {
    /// The checkpoints of the training `name`.
    ///
    /// # Errors
    /// If they cannot be read.
    fn checkpoints(&self, name: &str) -> Result<Checkpoints, FileError> {
        let _ = name;
        Ok(Checkpoints::none())
    }

    /// Trainings begin, or are resumed after so many updates: metrics of later updates will come again.
    ///
    /// # Errors
    /// If metrics cannot be kept.
    fn begin(&self, trainings: &[(&str, u64)]) -> Result<(), FileError> {
        let _ = trainings;
        Ok(())
    }

    /// A metric of the training `name` after `step` updates, one value per member. It must not fail: a metric is no reason to lose
    /// a training.
    fn record(&self, name: &str, step: u64, metric: &'static str, values: &[f64]) {
        let _ = (name, step, metric, values);
    }

    /// The network of the training `name` at the end of a cycle, after `step` updates.
    ///
    /// # Errors
    /// If it cannot be written.
    fn cycle(&self, name: &str, step: u64, model: &ScoreModel) -> Result<(), DiffusionError> {
        let _ = (name, step, model);
        Ok(())
    }

    /// Where sampled rows are kept chunk by chunk; None: they are not.
    fn chunks(&self) -> Option<Chunks<'_>> {
        None
    }
}

/// Keeps nothing: for fits of minutes, examples and tests.
#[derive(Clone, Copy, Debug, Default)]
pub struct Nothing;

impl Keeper for Nothing {}

/// Members, device and storage of a fit.
#[derive(Clone, Copy)]
pub struct Work<'a> {
    /// The members of the population, one policy or data set each; member i equals a fit of seed i alone.
    pub seeds: &'a [u64],
    /// What computes the networks.
    pub device: &'a Device,
    /// Storage of checkpoints and metrics.
    pub keeper: &'a dyn Keeper,
}

impl<'a> Work<'a> {
    /// Nothing is kept.
    pub fn new(seeds: &'a [u64], device: &'a Device) -> Self {
        Self { seeds, device, keeper: &Nothing }
    }

    /// The members' random streams.
    pub fn streams(&self) -> Vec<Streams> {
        self.seeds.iter().map(|&seed| Streams::new(seed)).collect()
    }
}

/// The CPU, on which the same seed gives the same bytes at any number of threads.
pub fn on_cpu() -> Device {
    cpu()
}
