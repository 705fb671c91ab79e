//! The layouts of files, and what all of them come to.
//!
//! | layout | known by | its file |
//! |---|---|---|
//! | D4RL, OTDF, ours | none of the others | [`super::flat`] |
//! | Minari | groups `episode_0`, `episode_1`, ... | [`super::minari`] |
//! | robomimic | a group `data` of groups `demo_0`, `demo_1`, ... | [`super::robomimic`] |
//!
//! A further layout is a file with a [`Format`] and a line in `FORMATS` of `load.rs`.

use std::collections::BTreeMap;
use std::path::Path;

use super::hdf5::Hdf5;
use super::options::LoadOptions;
use super::report::Layout;
use crate::{DataError, Problem};

/// One layout.
pub(super) trait Format: Sync {
    /// Whether `file` has it, by what the file holds.
    fn recognises(&self, file: &Hdf5) -> bool;

    /// All rows, before anything is put right or dropped.
    fn read(&self, file: &Hdf5, options: &LoadOptions) -> Result<Raw, DataError>;
}

/// The rows of a file, as they stand there. All columns have one entry per row.
pub(super) struct Raw {
    pub layout: Layout,
    pub obs_dim: usize,
    pub act_dim: usize,
    pub observations: Vec<f32>,
    pub actions: Vec<f32>,
    pub rewards: Vec<f32>,
    /// Stored successors, if there are any.
    pub next_observations: Option<Vec<f32>>,
    pub terminals: Vec<bool>,
    /// Marks of time-outs, if there are any.
    pub timeouts: Option<Vec<bool>>,
    /// Which successors are known, where the file says it.
    pub known: Option<Vec<bool>>,
    /// Further columns that were asked for.
    pub columns: BTreeMap<String, Vec<f32>>,
    /// What was read of the file in another way than by its plain names, and what was not read.
    pub warnings: Vec<String>,
}

impl Raw {
    /// Refuses other dimensions than `dims`.
    pub fn check_dims(&self, file: &Path, dims: Option<(usize, usize)>) -> Result<(), DataError> {
        let Some((o, a)) = dims else { return Ok(()) };
        let advice = "This is a file of another agent: choose the file, or the agent, that fits";
        for (field, found, expected) in [("observations", self.obs_dim, o), ("actions", self.act_dim, a)] {
            if found != expected {
                let (found, expected) = (format!("{found} columns"), format!("{expected} columns"));
                return Err(DataError::invalid(Problem::Dimension, file, field, found, expected, advice));
            }
        }
        Ok(())
    }
}
