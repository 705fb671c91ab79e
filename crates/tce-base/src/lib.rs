//! The base of all crates: named random streams, files that are whole or absent, and long work that shows its progress and can be
//! interrupted.
//!
//! ```
//! use tce_base::Streams;
//! use tce_base::random::fill_normal;
//!
//! // Random numbers depend on the seed and on a name, not on what was drawn before or on which thread.
//! let draw = |seed: u64, name: &str| {
//!     let mut z = [0.0f32; 4];
//!     fill_normal(&mut Streams::new(seed).stream(name), &mut z);
//!     z
//! };
//! assert_eq!(draw(7, "resets"), draw(7, "resets"));
//! assert_ne!(draw(7, "resets"), draw(7, "actions"));
//! assert_ne!(draw(7, "resets"), draw(8, "resets"));
//! ```

pub mod auto;
pub mod checked;
pub mod course;
pub mod files;
pub mod format;
pub mod interrupt;
pub mod metrics;
pub mod owner;
pub mod progress;
pub mod random;
pub mod scratch;
pub mod sealed;
pub mod statistics;
pub mod terminal;
pub mod words;
pub mod wrap;

pub use auto::OrAuto;
pub use checked::{Damage, JsonError, first_damaged, read_json, sha256_files, verify_sha256};
pub use course::{Headline, LastStep, Step, begin_step, end_course, plan_course, resume_step};
pub use files::{
    AtomicFile, AtomicFolder, FileError, create_folder, ensure_folder, ensure_writable, link_first, move_into_place,
    read_if_there, sha256_file, sha256_hex, sha256_parts, write_atomically, write_json, write_json_first,
};
pub use interrupt::{Interrupted, interrupted, listen_for_interrupts, set_interrupted};
pub use metrics::Metrics;
pub use owner::Owner;
pub use progress::{Progress, Running, running};
pub use random::{Rng, Streams};
pub use scratch::{ATTEMPTS, Scratch};
pub use sealed::{Sealed, read_sealed, write_sealed};
pub use statistics::{mean_and_error, mean_std, plus_minus};
pub use terminal::{set_listener, set_quiet};
pub use words::{counted, did_you_mean, file_inside, nearest};

/// What files say about who wrote them.
pub const PROGRAM: &str = concat!("tce ", env!("CARGO_PKG_VERSION"));
