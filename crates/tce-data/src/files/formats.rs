//! The supported layouts of files, and the form that all of them are read into.
//!
//! | layout | known by | its file |
//! |---|---|---|
//! | D4RL, OTDF, this program's | none of the others | [`super::flat`] |
//! | Minari | groups `episode_0`, `episode_1`, ... | [`super::minari`] |
//! | robomimic | a group `data` of groups `demo_0`, `demo_1`, ... | [`super::robomimic`] |
//!
//! To add a layout, write a file with a [`Format`] and add a line to `FORMATS` in `load.rs`.

use std::collections::BTreeMap;
use std::path::Path;

use super::hdf5::Hdf5;
use super::options::LoadOptions;
use super::report::Layout;
use crate::{DataError, Problem};

/// One file layout.
pub(super) trait Format: Sync {
    /// Whether `file` has this layout, judged by its content.
    fn recognises(&self, file: &Hdf5) -> bool;

    /// Reads all rows, before anything is corrected or dropped.
    fn read(&self, file: &Hdf5, options: &LoadOptions) -> Result<Raw, DataError>;
}

/// Columns as in D4RL's layout, row-major. Every layout is read into this form.
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
    /// s', `[N, obs_dim]`; `None`: the next row's state.
    pub next_observations: Option<Vec<f32>>,
    /// Whether s' is absorbing, `[N]`.
    pub terminals: Vec<bool>,
    /// Whether the episode was cut after the row, `[N]`; `None`: inferred from the states.
    pub timeouts: Option<Vec<bool>>,
    /// Further columns, `[N]` each.
    pub further: BTreeMap<String, Vec<f32>>,
}

/// The rows of a file as they are stored. All columns have one entry per row.
pub(super) struct Raw {
    pub layout: Layout,
    pub columns: Columns,
    /// Which successors are known, if the file says so.
    pub known: Option<Vec<bool>>,
    /// What was read other than by its standard name, and what was not read.
    pub warnings: Vec<String>,
}

impl Raw {
    /// Returns an error if the dimensions differ from `dims`.
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
