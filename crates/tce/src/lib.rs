//! The `tce` program as a library: what the command line says, and how results and errors are told. What it does stands in the other
//! crates.

// An error ends the command: nobody waits for its copy.

pub mod allocator;
mod bench;
mod commands;
mod conclusion;
#[cfg(test)]
mod fuzz;
mod output;
mod told;

pub use commands::Cli;
pub use tce_run::{Error, Result};
pub use told::told;
