//! Actors and the rows that they collect: soft actor-critic (SAC) in the simulator, the policies built into the
//! program, and recipes of data sets.
//!
//! ```
//! use tce_zoo::exhibits::Exhibit;
//!
//! let actor = Exhibit::find("hopper-morph-expert")?;
//! assert_eq!(actor.policy()?.dims(), (11, 3));
//! assert_eq!(actor.path().to_str(), Some("zoo:hopper-morph-expert"));
//! # Ok::<(), tce_zoo::Error>(())
//! ```

pub mod actors;
mod error;
pub mod exhibits;
pub mod recipes;
pub mod sac_training;
pub mod stand_ins;

pub use error::{Error, Result};
