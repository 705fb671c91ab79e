//! HDF5 files of transitions: OTDF's and D4RL's layouts in, D4RL's layout out.
//!
//! | layout | recognised by | successors | episode boundaries |
//! |---|---|---|---|
//! | OTDF | `next_observations`, no `timeouts` | stored; wrong ones dropped | terminal, step limit, s'_i ≠ s_{i+1} |
//! | D4RL | everything else | stored if there (and right), else the next row, time-out rows dropped | `timeouts`, `terminals` |
//!
//! Nothing is used before the whole file has been validated, and no malformed file may panic or make the reader
//! allocate far beyond the file's own size.

mod hdf5;
mod load;
mod report;
mod rules;
mod save;

pub use load::{LoadOptions, Loaded, load, read_attributes};
pub use report::{Dropped, Layout, LoadReport, Successors};
pub use save::save_d4rl;

/// Root attribute of files written by [`save_d4rl`]: their `next_observations` are right by construction, and a
/// time-out between two rows that do follow each other is meant.
const FORMAT_ATTRIBUTE: &str = "tce_format";
const FORMAT: &str = "transitions-1";
