//! Measures of generated and source rows against the target's: the paper's analyses (Fig. 1a, Fig. 3, Appendix F),
//! Theorem 1, and a λ chosen by it. Nothing here knows networks: their predictions come in as numbers.
//!
//! | question | file |
//! |---|---|
//! | Which states do generated rows reach? (Fig. 3 a.2) | [`coverage`] |
//! | What does it look like? (Fig. 1a, Fig. 3 a.1) | [`embedding`] |
//! | Are generated rows copies of training rows? | [`memorisation`] |
//! | Which policy do generated rows imply? How do their errors grow away from the data? | [`implied`] |
//! | How far are two transition models apart? (Fig. 3 b.2) | [`gaussian`] |
//! | What does Theorem 1 say, and which λ does it choose? | [`bounds`] |
//! | Should these rows be used, and why? | [`advice`] |
//! | Everything about one run | [`Diagnosis`] |
//!
//! ```
//! use tce_diagnosis::gaussian::{Normals, kl};
//!
//! // Two predictions of one number: N(0, 1), and N(2, 1).
//! let p = Normals { mean: &[0.0], log_std: &[0.0], dim: 1 };
//! let q = Normals { mean: &[2.0], log_std: &[0.0], dim: 1 };
//! assert_eq!(kl(p, q), [2.0]);
//! ```

pub mod advice;
pub mod bounds;
pub mod coverage;
mod diagnosis;
pub mod embedding;
pub mod gaussian;
pub mod implied;
pub mod memorisation;
mod numbers;

pub use advice::{Advice, Answer};
pub use bounds::{Bounds, Choice, Curve, MeanError, Part, Rated};
pub use coverage::Coverage;
pub use diagnosis::{AtBound, Diagnosis, Labels, Reliability, Sampled};
pub use embedding::{Embedding, Group};
pub use implied::{ErrorOverDistance, Implied, ImpliedActions, ImpliedErrors, ImpliedRollout, Truth};
pub use memorisation::{HeldOut, Memorisation, Verdict};
pub use numbers::{Histogram, Spread};
