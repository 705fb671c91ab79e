//! HDF5 files of transitions: reads OTDF's and D4RL's layouts, writes D4RL's layout.
//!
//! | layout | recognised by | successors | episode boundaries |
//! |---|---|---|---|
//! | OTDF | `next_observations`, no `timeouts` | stored; wrong ones dropped | terminal, s'ᵢ ≠ sᵢ₊₁, step limit |
//! | D4RL | everything else | stored if there (and right), else the next row, time-out rows dropped | `timeouts`, `terminals`, s'ᵢ ≠ sᵢ₊₁ |
//!
//! The test s'ᵢ = sᵢ₊₁ has a tolerance relative to each column's scale. Interleaved rows of several environments are
//! put in order. A terminal row without a successor is kept and marked
//! ([`Transitions::known`](crate::Transitions::known)).
//!
//! The whole file is validated before any of it is used. No malformed file may cause a panic or make the reader
//! allocate far more than the file's own size.

mod columns;
mod episodes;
mod episodes_in_groups;
mod flat;
mod formats;
mod hdf5;
mod load;
mod marks;
mod minari;
mod options;
mod report;
mod robomimic;
mod rounding;
mod rows;
mod save;
mod save_minari;
mod steps;
mod successors;

pub use columns::from_columns;
pub use episodes::continued;
pub use formats::Columns;
pub use load::{Loaded, load, read_attributes};
pub use minari::main_file;
pub use options::LoadOptions;
pub use report::{Dropped, EpisodeEnds, Layout, LoadReport, Successors};
pub use save::save_d4rl;
pub use save_minari::save_minari;

/// Root attribute of files written by [`save_d4rl`]. Their `next_observations` are right by construction, and a
/// time-out between two rows that follow each other is intended.
const FORMAT_ATTRIBUTE: &str = "tce_format";
const FORMAT: &str = "transitions-1";
/// Which successors are known, in files written by [`save_d4rl`]; present only if some are unknown.
const KNOWN: &str = "next_observations_known";
