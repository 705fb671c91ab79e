//! Conditional diffusion over plain rows: noise processes, the two score networks of Table B.1, their training, samplers,
//! and distances between sets of rows.
//!
//! Every process is x^τ = α(τ) x⁰ + σ(τ) z, every network is read as a *denoiser* D(x^τ) ≈ E[x⁰ | x^τ], and every sampler
//! needs nothing but (α, σ) and D: any process goes with any sampler. The score is q = (α D − x) / σ².
//!
//! Rows are row-major `f32` matrices of standardised, live dimensions; whoever calls standardises, drops dimensions
//! without spread, and undoes both afterwards.
//!
//! ```
//! use tce_diffusion::{Edm, Process};
//!
//! // EDM keeps the clean row as it is and adds noise up to σ_max.
//! let process = Process::Edm(Edm::default());
//! let (clean, noisy) = (process.level(0.0), process.level(1.0));
//! assert_eq!((clean.alpha, noisy.alpha), (1.0, 1.0));
//! assert!(clean.sigma < noisy.sigma);
//! ```

mod cycles;
mod data;
mod error;
pub mod metrics;
mod model;
mod network;
mod process;
mod sampler;
mod target;
mod train;
mod until_done;

pub use cycles::{CycleEnd, UntilDone, or_nan};
pub use data::{Balance, Condition, Part, ScoreData, present};
pub use error::DiffusionError;
pub use model::{Chunks, Request, ScoreModel, uniform_labels};
pub use network::{BoundNetwork, NetworkConfig, ScoreNetwork};
pub use process::{Edm, Grid, Increment, Level, Precondition, Process, Start, Ve, Vp};
pub use sampler::{Denoiser, Guided, Sampler};
pub use target::Target;
pub use train::{Schedule, TrainConfig, Trainer};
