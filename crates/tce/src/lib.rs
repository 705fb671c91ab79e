//! The command line of `tce`: arguments, output of results and errors. The work is done by the other crates.

pub mod allocator;
mod bench;
mod commands;
mod conclusion;
mod costs;
mod estimates;
#[cfg(test)]
mod fuzz;
mod output;
mod told;

pub use commands::Cli;
pub use tce_run::{Error, Result};
pub use told::told;
