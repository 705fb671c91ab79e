//! What every training stands on: rows and batches, the one training loop, losses.

pub mod blocks;
pub mod buffer;
pub mod losses;
pub mod mode;
pub mod sequences;
pub mod training;
