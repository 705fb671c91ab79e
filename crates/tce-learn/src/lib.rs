//! Learning from transitions, P members at once: seeds, data sets and variants are the leading axis of every tensor.
//!
//! | piece | file |
//! |---|---|
//! | rows and minibatches | [`Buffer`], [`Member`] |
//! | the one training loop | [`train`], [`Learner`] |
//! | trained policies, ours and others' | [`Policy`], [`import`] |
//! | weighted imitation of actions | [`actor`], [`losses`] |
//! | behaviour cloning | [`bc`] |
//! | implicit Q-learning | [`iql`] |
//! | DmC: scored rows, filtered and weighed | [`dmc`] |
//! | the behaviour model and what it is for | [`cvae`], [`regulariser`] |
//! | actions, rewards and terminals of generated pairs | [`labels`], [`pair_model`] |

pub mod actor;
pub mod bc;
mod blocks;
mod buffer;
pub mod critic;
pub mod cvae;
pub mod dmc;
mod error;
pub mod import;
pub mod iql;
pub mod labels;
pub mod losses;
pub mod pair_model;
mod policy;
pub mod regulariser;
pub mod sac;
mod training;

pub use actor::{ActionReduction, Actor, ActorConfig, PolicyForm};
pub use bc::{Bc, BcConfig};
pub use blocks::map_rows;
pub use buffer::{Buffer, Member, Minibatch, Pick, RewardScale, best_trajectories, return_range_scale};
pub use dmc::{Dmc, DmcConfig, DmcMode};
pub use error::LearnError;
pub use iql::{Iql, IqlConfig, PolicyExtraction};
pub use labels::{LabelConfig, LabelErrors, LabelModels, Labelled, TerminalHandling, train_labels};
pub use policy::{Head, LOG_STD_RANGE, Policy, PolicySpec};
pub use regulariser::{Regulariser, RegulariserConfig, RegulariserKind};
pub use training::{
    Lane, Learner, Meter, Outcome, PolicyLearner, Report, Steps, member_noise, train, train_side_by_side,
};
