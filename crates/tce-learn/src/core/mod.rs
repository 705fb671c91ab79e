//! The basis of every training run: rows and batches, the training loop, losses.

pub(crate) mod blocks;
pub(crate) mod buffer;
pub mod losses;
pub(crate) mod mode;
pub mod sequences;
pub(crate) mod shares;
pub(crate) mod training;
