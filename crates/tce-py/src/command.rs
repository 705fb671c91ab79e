//! The commands of `tce`.

use pyo3::prelude::*;
use tce_data::Task;

use crate::errors::exception;
use crate::work::{Progress, attended};

/// Runs a command; its result as JSON.
#[pyfunction]
pub fn command(py: Python<'_>, arguments: Vec<String>, progress: Progress) -> PyResult<String> {
    let call = std::iter::once("tce".to_owned()).chain(arguments);
    let call = tce::Cli::of(call).map_err(|e| exception(py, "ConfigError", e.to_string()))?;
    attended(py, progress, move || call.json())
}

/// The program itself: prints, and returns the exit code.
#[pyfunction]
pub fn main(py: Python<'_>, arguments: Vec<String>) -> u8 {
    py.detach(|| {
        tce_base::listen_for_interrupts();
        match tce::Cli::of(arguments).map(tce::Cli::run) {
            Ok(Ok(())) => 0,
            Ok(Err(error)) => {
                tce_base::end_course(tce_base::LastStep::BrokenOff);
                eprint!("{}", tce::told(&error));
                u8::try_from(error.exit_code()).unwrap_or(1)
            }
            Err(error) => {
                // Help and versions end here, too.
                let _ = error.print();
                u8::try_from(error.exit_code()).unwrap_or(2)
            }
        }
    })
}

/// All tasks of the benchmark.
#[pyfunction]
pub fn tasks() -> Vec<String> {
    Task::all().iter().map(|task| task.to_string()).collect()
}
