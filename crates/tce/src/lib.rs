//! The `tce` program as a library: tasks, presets and variants, the pipeline's stages, run directories and commands.

mod acting;
mod actors;
mod bench;
mod commands;
mod conclusion;
mod config;
mod course;
mod diagnosis;
mod error;
mod expand;
#[cfg(test)]
mod fuzz;
mod generator;
mod inputs;
mod joint;
mod judge;
mod keys;
mod layers;
mod learning;
mod methods;
mod metrics;
mod mixture;
mod narrow;
mod output;
mod own;
mod pipeline;
mod processor;
mod recipe;
mod scratch;
mod stage;
mod stand_ins;
mod study;
mod sweep;
mod units;
mod variant;
mod verdict;
mod video;
mod wrong_keys;
mod zoo;

/// What files say about who wrote them.
const PROGRAM: &str = concat!("tce ", env!("CARGO_PKG_VERSION"));

/// An error as the terminal shows it: its own words, once. They hold what caused it, so that the chain of causes would say it again.
pub fn report(error: Error) -> miette::Report {
    // A second call, in a test, finds the hook set.
    let _ = miette::set_hook(Box::new(|_| Box::new(miette::MietteHandlerOpts::new().without_cause_chain().build())));
    miette::Report::new(error)
}

pub use commands::Cli;
pub use error::{Error, Result};
