//! A table of transitions whose columns NumPy sees without a copy.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use clap::ValueEnum;
use numpy::ndarray::{ArrayView1, ArrayView2};
use numpy::{Element, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use tce_data::{Columns, LoadOptions, Loaded, Transitions, from_columns};
use tce_run::augment::own_tables::joined;
use tce_run::own::{DataFormat, Writing};
use tce_run::tables::is_augmented;

use crate::errors::{Raise, exception};
use crate::settings::Robot;
use crate::work::aside;

/// Rows (s, a, r, s', terminal, time-out) and what reading them found.
#[pyclass(frozen, module = "tce._tce")]
pub struct Table {
    pub rows: Arc<Transitions>,
    columns: BTreeMap<String, Vec<f32>>,
    report: Option<String>,
    /// Whether the program made the column `origin`: one of the user's own may mean anything.
    augmented: bool,
}

impl Table {
    /// Rows that the program made.
    pub fn of(rows: Transitions) -> Self {
        Self { rows: Arc::new(rows), columns: BTreeMap::new(), report: None, augmented: false }
    }

    fn loaded(loaded: Loaded) -> Self {
        let report = serde_json::to_string(&loaded.report).ok();
        Self { rows: Arc::new(loaded.transitions), columns: loaded.columns, report, augmented: false }
    }

    /// The column of `tce augment` that tells target rows (0) from others, if this is a table of it.
    pub fn origin(&self) -> Option<&[f32]> {
        self.columns.get("origin").filter(|_| self.augmented).map(Vec::as_slice)
    }
}

/// A read-only view of `values`, which `owner` keeps.
fn vector<'py, T: Element>(owner: &Bound<'py, Table>, values: &[T]) -> Bound<'py, PyAny> {
    // SAFETY: the table is frozen: its memory stays where it is for as long as it is alive, and the array keeps it alive.
    let array = unsafe { PyArray1::borrow_from_array(&ArrayView1::from(values), owner.clone().into_any()) };
    array.readwrite().make_nonwriteable();
    array.into_any()
}

/// The same with `dim` columns.
fn matrix<'py>(owner: &Bound<'py, Table>, values: &[f32], dim: usize) -> Bound<'py, PyAny> {
    let view = ArrayView2::from_shape((values.len() / dim.max(1), dim), values).expect("whole rows");
    // SAFETY: as above.
    let array = unsafe { PyArray2::borrow_from_array(&view, owner.clone().into_any()) };
    array.readwrite().make_nonwriteable();
    array.into_any()
}

/// A matrix, row by row.
fn flat(array: &PyReadonlyArray2<'_, f32>) -> Vec<f32> {
    array.as_slice().map_or_else(|_| array.as_array().iter().copied().collect(), <[f32]>::to_vec)
}

fn copied<T: Element + Copy>(array: &PyReadonlyArray1<'_, T>) -> Vec<T> {
    array.as_array().iter().copied().collect()
}

/// Columns by D4RL's names, of a dict.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct Arrays<'py> {
    observations: PyReadonlyArray2<'py, f32>,
    actions: PyReadonlyArray2<'py, f32>,
    rewards: PyReadonlyArray1<'py, f32>,
    next_observations: Option<PyReadonlyArray2<'py, f32>>,
    terminals: PyReadonlyArray1<'py, bool>,
    timeouts: Option<PyReadonlyArray1<'py, bool>>,
    further: BTreeMap<String, PyReadonlyArray1<'py, f32>>,
}

#[pymethods]
impl Table {
    /// Reads a file in any layout that the program knows, with all its further columns.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf, robot: Robot) -> PyResult<Self> {
        let own = robot.own().or_raise(py)?;
        let options = LoadOptions { all_columns: true, ..own.load_options() };
        let (loaded, augmented) = aside(py, || (tce_data::load(&path, &options), is_augmented(&path)))?;
        loaded.map(|loaded| Self { augmented, ..Self::loaded(loaded) }).or_raise(py)
    }

    /// Checks arrays as a file with the same columns is checked.
    #[staticmethod]
    fn of_arrays(py: Python<'_>, name: PathBuf, arrays: Arrays<'_>, robot: Robot) -> PyResult<Self> {
        let (observations, next) = (&arrays.observations, arrays.next_observations.as_ref());
        if let Some(next) = next.filter(|next| next.shape()[1] != observations.shape()[1]) {
            let (found, expected) = (next.shape()[1], observations.shape()[1]);
            let message = format!(
                "{}: field `next_observations`: found {found} columns; expected {expected} columns, as in `observations`",
                name.display()
            );
            return Err(exception(py, "DataError", message));
        }
        let columns = Columns {
            obs_dim: observations.shape()[1],
            act_dim: arrays.actions.shape()[1],
            observations: flat(observations),
            actions: flat(&arrays.actions),
            rewards: copied(&arrays.rewards),
            next_observations: next.map(flat),
            terminals: copied(&arrays.terminals),
            timeouts: arrays.timeouts.as_ref().map(copied),
            further: arrays.further.iter().map(|(name, column)| (name.clone(), copied(column))).collect(),
        };
        let options = robot.own().or_raise(py)?.load_options();
        aside(py, || from_columns(columns, &name, &options))?.map(Self::loaded).or_raise(py)
    }

    /// Rows as another process had them, which were checked there.
    #[staticmethod]
    fn of_state(
        observations: PyReadonlyArray2<'_, f32>,
        actions: PyReadonlyArray2<'_, f32>,
        rewards: PyReadonlyArray1<'_, f32>,
        next_observations: PyReadonlyArray2<'_, f32>,
        flags: [PyReadonlyArray1<'_, bool>; 3],
        further: BTreeMap<String, PyReadonlyArray1<'_, f32>>,
        report: Option<String>,
    ) -> Self {
        let [terminals, timeouts, known] = flags.map(|array| copied(&array));
        let rows = Transitions {
            obs_dim: observations.shape()[1],
            act_dim: actions.shape()[1],
            observations: flat(&observations),
            actions: flat(&actions),
            rewards: copied(&rewards),
            next_observations: flat(&next_observations),
            terminals,
            timeouts,
            known,
        };
        let columns = further.iter().map(|(name, column)| (name.clone(), copied(column))).collect();
        // Target rows among extra ones are found by their content all the same.
        Self { rows: Arc::new(rows), columns, report, augmented: false }
    }

    fn __len__(&self) -> usize {
        self.rows.len()
    }

    /// State and action dimension.
    #[getter]
    fn dims(&self) -> (usize, usize) {
        (self.rows.obs_dim, self.rows.act_dim)
    }

    /// What reading found, as JSON; None for rows that the program made.
    #[getter]
    fn report(&self) -> Option<&str> {
        self.report.as_deref()
    }

    /// The table's own columns by their names, as read-only views.
    fn columns<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyDict>> {
        let (table, columns) = (this.get(), PyDict::new(this.py()));
        let t = &table.rows;
        columns.set_item("observations", matrix(this, &t.observations, t.obs_dim))?;
        columns.set_item("actions", matrix(this, &t.actions, t.act_dim))?;
        columns.set_item("rewards", vector(this, &t.rewards))?;
        columns.set_item("next_observations", matrix(this, &t.next_observations, t.obs_dim))?;
        columns.set_item("terminals", vector(this, &t.terminals))?;
        columns.set_item("timeouts", vector(this, &t.timeouts))?;
        columns.set_item("known", vector(this, &t.known))?;
        Ok(columns)
    }

    /// The further columns. They are apart, because a file may have one that is called as one of the table's own.
    fn further<'py>(this: &Bound<'py, Self>) -> PyResult<Bound<'py, PyDict>> {
        let columns = PyDict::new(this.py());
        for (name, values) in &this.get().columns {
            columns.set_item(name, vector(this, values))?;
        }
        Ok(columns)
    }

    /// First row, row after the last one, and return of every episode.
    fn episodes(&self) -> Vec<(usize, usize, f64)> {
        self.rows.episodes().iter().map(|e| (e.start, e.end, e.episode_return)).collect()
    }

    /// The rows at `indices`; an episode ends where its next row is not taken.
    fn select(&self, py: Python<'_>, indices: Vec<usize>) -> PyResult<Self> {
        if let Some(bad) = indices.iter().find(|&&i| i >= self.rows.len()) {
            let words = format!("row {bad}: the table has {}", self.rows.len());
            return Err(pyo3::exceptions::PyIndexError::new_err(words));
        }
        let pick = |values: &Vec<f32>| indices.iter().map(|&i| values[i]).collect();
        let columns = self.columns.iter().map(|(name, values)| (name.clone(), pick(values))).collect();
        let rows = aside(py, || Arc::new(self.rows.select(&indices)))?;
        Ok(Self { rows, columns, report: None, augmented: self.augmented })
    }

    /// These rows, then `generated` ones, with the column `origin`, as `tce augment` writes them.
    fn joined(&self, py: Python<'_>, generated: &Self) -> PyResult<Self> {
        let (rows, origin) = aside(py, || joined(&self.rows, &generated.rows))?;
        let columns = BTreeMap::from([("origin".to_owned(), origin)]);
        Ok(Self { rows: Arc::new(rows), columns, report: None, augmented: true })
    }

    /// What `tce data check` notices, as JSON.
    fn check(&self, py: Python<'_>, robot: Robot) -> PyResult<String> {
        let agent = robot.own().or_raise(py)?.agent();
        let check = aside(py, || tce_data::check(&self.rows, agent))?;
        Ok(serde_json::to_string(&check).expect("plain data"))
    }

    /// What `tce data inspect` tells, as JSON.
    fn inspect(&self, py: Python<'_>, robot: Robot) -> PyResult<String> {
        let limit = robot.own().or_raise(py)?.limit();
        let inspection = aside(py, || tce_data::inspect(&self.rows, limit))?;
        Ok(serde_json::to_string(&inspection).expect("plain data"))
    }

    /// Writes the rows, whole or not at all.
    fn save(
        &self,
        py: Python<'_>,
        path: PathBuf,
        format: &str,
        id: Option<String>,
        overwrite: bool,
        attributes: BTreeMap<String, String>,
    ) -> PyResult<()> {
        let format = DataFormat::from_str(format, false).map_err(|_| {
            let words = format!("format: found {format:?}, expected \"d4rl\" or \"minari\"");
            exception(py, "ConfigError", words)
        })?;
        if path.exists() && !overwrite {
            let words = format!("{} exists; choose another name, or say overwrite=True", path.display());
            return Err(pyo3::exceptions::PyFileExistsError::new_err(words));
        }
        let columns: Vec<(&str, &[f32])> = self.columns.iter().map(|(k, v)| (k.as_str(), v.as_slice())).collect();
        let writing = Writing { format, id, force: overwrite };
        aside(py, || writing.write(&path, &self.rows, None, &attributes, &columns))?.or_raise(py)
    }
}
