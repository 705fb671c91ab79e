//! Conditional diffusion over plain rows: noise processes, the two score networks of Table B.1, their training, samplers,
//! and distances between sets of rows.
//!
//! Every process is x^τ = α(τ) x⁰ + σ(τ) z, every network is read as a *denoiser* D(x^τ) ≈ E[x⁰ | x^τ], and every sampler
//! needs nothing but (α, σ) and D: any process goes with any sampler. The score is q = (α D − x) / σ².
//!
//! Rows are row-major `f32` matrices of standardised, live dimensions; whoever calls standardises, drops dimensions
//! without spread, and undoes both afterwards.

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

pub use cycles::{CycleEnd, UntilDone};
pub use data::{Balance, Condition, Part, ScoreData, present};
pub use error::DiffusionError;
pub use model::{Chunks, Request, ScoreModel, uniform_labels};
pub use network::{BoundNetwork, NetworkConfig, ScoreNetwork};
pub use process::{Edm, Grid, Increment, Level, Precondition, Process, Start, Ve, Vp};
pub use sampler::{Denoiser, Guided, Sampler};
pub use target::Target;
pub use train::{Schedule, TrainConfig, Trainer};
