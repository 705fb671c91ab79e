//! Policies from tables.

use std::path::PathBuf;

use pyo3::prelude::*;
use tce_learn::LearnedRows;
use tce_run::inputs::Inputs;
use tce_run::pipeline::seeds as counted;
use tce_run::training_run::{Comparison, TrainingRun, ensure_fits};

use crate::errors::Raise;
use crate::settings::{Robot, Settings, named};
use crate::table::Table;
use crate::work::{Progress, attended};

/// Which policies to train.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Wanted {
    learner: Option<String>,
    top: Option<f64>,
    seeds: usize,
    first_seed: u64,
    compare: bool,
    actions: Option<String>,
}

/// Target, extra and source rows.
type Tables<'py> = (PyRef<'py, Table>, Option<PyRef<'py, Table>>, Option<PyRef<'py, Table>>);

/// Trains policies on the tables `target`, and `extra` if there is one, into the folder `out`; `source` is for the comparison. The summary
/// as JSON.
#[pyfunction]
pub fn train(
    py: Python<'_>,
    tables: Tables<'_>,
    wanted: Wanted,
    settings: Settings,
    robot: Robot,
    out: PathBuf,
    progress: Progress,
) -> PyResult<String> {
    let (target, extra, source) = tables;
    let mut config = settings.for_training(wanted.learner.as_deref(), wanted.top).or_raise(py)?;
    let (own, device) = (robot.own().or_raise(py)?, settings.device().or_raise(py)?);
    let seeds = counted(wanted.first_seed, wanted.seeds).or_raise(py)?;
    let rows = LearnedRows::with(extra.as_ref());
    let actions = wanted.actions.as_deref().map(|name| named("actions", name)).transpose().or_raise(py)?;
    let comparison = Comparison::choose(&mut config, actions, rows, wanted.compare).or_raise(py)?;
    ensure_fits(&config, rows).or_raise(py)?;
    let target = target.rows.clone();
    let source = source.filter(|_| wanted.compare).map(|table| table.rows.clone());
    let extra = extra.map(|table| (table.rows.clone(), table.origin().map(<[f32]>::to_vec)));
    let trained = attended(py, progress, move || {
        tce_base::ensure_folder(&out)?;
        let extra = extra.as_ref().map(|(rows, origin)| (rows.clone(), origin.as_deref()));
        let inputs = Inputs::of_rows(source, target, extra, &own)?;
        let inputs = inputs.with_target_rows(config.target.rows)?;
        let run = TrainingRun { config: &config, seeds: &seeds, own: &own, comparison, out: &out };
        run.run(&inputs, &device)
    })?;
    Ok(serde_json::to_string(&trained).expect("plain data"))
}
