//! Learning from transitions, P members at once: seeds, data sets and variants are every tensor's first axis.
//!
//! | piece | file |
//! |---|---|
//! | rows and minibatches | [`Buffer`], [`Member`] |
//! | the one training loop | [`train`], [`Learner`] |
//! | trained policies of this and of other programs | [`Policy`], [`import`] |
//! | weighted imitation of actions | [`actor`], [`losses`] |
//! | behaviour cloning | [`bc`] |
//! | implicit Q-learning | [`iql`] |
//! | deterministic actor-critics | [`td3_bc`], [`rebrac`], [`deterministic`] |
//! | prior methods, which train on source and target rows | [`dara`], [`bosa`], [`srpo`], [`igdf`], [`otdf`] |
//! | the published or corrected form of a method, and shared code | [`Mode`], [`on_iql`] |
//! | selection of rows in a batch | [`selection`] |
//! | DmC: rows filtered and weighted by scores | [`dmc`] |
//! | a transformer on contexts of a world model | [`meta_dt`], [`transformer`], [`world_model`], [`sequences`] |
//! | the behaviour model and its use | [`cvae`], [`regulariser`] |
//! | actions, rewards and terminals of generated pairs | [`labels`], [`pair_model`] |
//! | one-step predictions in both domains, to filter rows and to test policies | [`dynamics`] |
//! | the value of a policy, estimated from the rows alone | [`mod@fitted_q`] |
//! | densities of a domain's transitions, to compare domains | [`transition_model`] |
//!
//! ```
//! use tce_learn::losses::expectile_loss;
//! use tce_nn::{Tensor, cpu};
//!
//! // IQL's V: at τ = .7 an error of 2 upwards counts 7/3 of one downwards.
//! let loss = |u: f32| expectile_loss(Tensor::<3>::full([1, 1, 1], u, &cpu()), 0.7).into_scalar::<f32>();
//! assert!((loss(2.0) / loss(-2.0) - 7.0 / 3.0).abs() < 1e-5);
//! ```

pub mod algorithms;
pub mod core;
mod error;
pub mod models;
pub mod policies;

// Modules are re-exported under their own names; their folder only matters to readers of the source.
use crate::algorithms::iql_config;
pub use crate::algorithms::{
    bc, bc_dropout, bosa, dara, deterministic, dmc, igdf, iql, meta_dt, method, on_iql, otdf, rebrac, regulariser, sac,
    selection, srpo, td3_bc,
};
use crate::core::{blocks, buffer, mode, shares, training};
pub use crate::core::{losses, sequences};
use crate::models::{context_encoder, contexts, networks};
pub use crate::models::{
    critic, cvae, dynamics, fitted_q, labels, pair_model, transformer, transition_model, world_model,
};
pub use crate::policies::{actor, import, onnx};
use crate::policies::{mlp_policy, npy, policy, sequence_policy};

pub use actor::{ActionReduction, Actor, ActorConfig, PolicyForm};
pub use bc::{Bc, BcConfig, CloneLoss, ScaleBy};
pub use blocks::map_rows;
pub use bosa::{Bosa, BosaConfig};
pub use buffer::{Buffer, Member, Minibatch, Pick, RewardScale, best_trajectories, return_range_scale};
pub use dara::{Dara, DaraConfig};
pub use dmc::{Dmc, DmcConfig};
pub use dynamics::{Domain, Dynamics, DynamicsConfig, Prediction, train_dynamics};
pub use error::LearnError;
pub use fitted_q::{FittedQConfig, FittedValue, PolicyActions, discounted_return, fitted_q};
pub use igdf::{Igdf, IgdfConfig};
pub use iql::{Iql, IqlConfig, PolicyExtraction};
pub use labels::{LabelConfig, LabelErrors, LabelModels, Labelled, TerminalHandling, rmse, train_labels};
pub use meta_dt::{MetaDt, MetaDtConfig};
pub use method::{About, Built, LearnedRows, Method, OtherRows, RowScores, Setup};
pub use mlp_policy::{Head, LOG_STD_RANGE, MlpPolicy, PolicySpec};
pub use mode::Mode;
pub use otdf::{Otdf, OtdfConfig};
pub use policy::{Memory, Policy, PolicyKind, PolicyLearner};
pub use rebrac::{Rebrac, RebracConfig};
pub use regulariser::{Regulariser, RegulariserConfig, RegulariserKind};
pub use sequence_policy::{SequencePolicy, SequenceSpec};
pub use srpo::{Srpo, SrpoConfig};
pub use td3_bc::{Td3Bc, Td3BcConfig};
pub use training::{
    Journal, Learner, Meter, Outcome, Place, Report, Steps, TrainingJob, member_noise, prepare, train,
    train_side_by_side,
};
pub use transition_model::{Densities, TransitionConfig, TransitionModel, train_transition_models};
