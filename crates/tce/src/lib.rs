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
mod told;
mod units;
mod variant;
mod verdict;
mod video;
mod wrong_keys;
mod zoo;

/// What files say about who wrote them.
const PROGRAM: &str = concat!("tce ", env!("CARGO_PKG_VERSION"));

pub use commands::Cli;
pub use error::{Error, Result};
pub use told::told;
