//! Coverage expansion on two tables.

use std::path::PathBuf;

use pyo3::prelude::*;
use tce_run::augment::own_tables::Augmented;
use tce_run::config::Config;
use tce_run::inputs::Inputs;
use tce_run::own::Own;

use crate::errors::Raise;
use crate::settings::{Robot, Settings};
use crate::table::Table;
use crate::work::{Progress, attended};

/// What decides the rows, besides the tables, and where the networks are kept.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Call {
    settings: Settings,
    robot: Robot,
    seed: u64,
    cache: PathBuf,
}

/// Generated rows for `target`, and the report on them as JSON with the attributes of a file of them.
#[pyfunction]
pub fn augment(
    py: Python<'_>,
    source: &Table,
    target: &Table,
    call: Call,
    progress: Progress,
) -> PyResult<(Table, String)> {
    let Call { settings, robot, seed, cache } = call;
    let (config, own): (Config, Own) = (settings.config().or_raise(py)?, robot.own().or_raise(py)?);
    let device = settings.device().or_raise(py)?;
    let (source, target) = (source.rows.clone(), target.rows.clone());
    let augmented = attended(py, progress, move || {
        tce_base::ensure_folder(&cache)?;
        let inputs = Inputs::of_rows(Some(source), target, None, &own)?.with_target_rows(config.target.rows)?;
        Augmented::new(&inputs, &config, seed, &cache, &device)
    })?;
    let report = serde_json::json!({ "report": augmented.report, "attributes": augmented.attributes });
    Ok((Table::of(augmented.generated), report.to_string()))
}
