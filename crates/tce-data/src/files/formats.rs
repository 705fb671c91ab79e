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

/// Columns as a file of D4RL's layout has them, row-major; what every layout is read as.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Columns {
    /// State dimension.
    pub obs_dim: usize,
    /// Action dimension.
    pub act_dim: usize,
    /// s, `[N, obs_dim]`.
    pub observations: Vec<f32>,
    /// a, `[N, act_dim]`.
    pub actions: Vec<f32>,
    /// r, `[N]`.
    pub rewards: Vec<f32>,
    /// s', `[N, obs_dim]`; None: the next row's state.
    pub next_observations: Option<Vec<f32>>,
    /// Whether s' is absorbing, `[N]`.
    pub terminals: Vec<bool>,
    /// Whether the episode was cut after the row, `[N]`; None: it is found out.
    pub timeouts: Option<Vec<bool>>,
    /// Further columns, `[N]` each.
    pub further: BTreeMap<String, Vec<f32>>,
}

/// The rows of a file, as they stand there. All columns have one entry per row.
pub(super) struct Raw {
    pub layout: Layout,
    pub columns: Columns,
    /// Which successors are known, where the file says it.
    pub known: Option<Vec<bool>>,
    /// What was read of the file in another way than by its plain names, and what was not read.
    pub warnings: Vec<String>,
}

impl Raw {
    /// Refuses other dimensions than `dims`.
    pub fn check_dims(&self, file: &Path, dims: Option<(usize, usize)>) -> Result<(), DataError> {
        let Some((o, a)) = dims else { return Ok(()) };
        let advice = "This is a file of another agent: choose the file, or the agent, that fits";
        for (field, found, expected) in
            [("observations", self.columns.obs_dim, o), ("actions", self.columns.act_dim, a)]
        {
            if found != expected {
                let (found, expected) = (format!("{found} columns"), format!("{expected} columns"));
                return Err(DataError::invalid(Problem::Dimension, file, field, found, expected, advice));
            }
        }
        Ok(())
    }
}
