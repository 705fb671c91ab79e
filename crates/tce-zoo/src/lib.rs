//! Actors and the rows that they collect: soft actor-critic (SAC) in the simulator, the policies built into the
//! program, and recipes of data sets.

pub mod actors;
mod error;
pub mod exhibits;
pub mod recipes;
pub mod sac_training;
pub mod stand_ins;

pub use error::{Error, Result};
