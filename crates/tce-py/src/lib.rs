//! The Python module `tce._tce`: tables as NumPy arrays, the method, policies and environments. The package `tce` (python/tce) stands in
//! front of it; nobody else is meant to call it.
//!
//! Arrays go in as float32 and bool, row-major, which the package sees to, and come out as views of the program's memory. Long calls
//! release Python's lock, listen to Ctrl-C and end at a checkpoint (work.rs). Reports are JSON text.

use pyo3::prelude::*;

mod augment;
mod command;
mod env;
mod errors;
mod policy;
mod settings;
mod table;
mod train;
mod work;

/// As the program `tce` has it, and for the same reason.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// What the package stands on.
#[pymodule]
mod _tce {
    #[pymodule_export]
    use crate::augment::augment;
    #[pymodule_export]
    use crate::command::{command, main, tasks};
    #[pymodule_export]
    use crate::env::{Env, evaluate};
    #[pymodule_export]
    use crate::policy::{Memories, Policy};
    #[pymodule_export]
    use crate::table::Table;
    #[pymodule_export]
    use crate::train::train;

    use pyo3::prelude::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        tce::allocator::keep_free_memory();
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
