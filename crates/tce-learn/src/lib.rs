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
//! | a transformer on contexts of a world model | [`meta_dt`], [`transformer`], [`world_model`], [`sequences`] |
//! | the behaviour model and what it is for | [`cvae`], [`regulariser`] |
//! | actions, rewards and terminals of generated pairs | [`labels`], [`pair_model`] |

pub mod actor;
pub mod bc;
mod blocks;
mod buffer;
pub mod critic;
pub mod cvae;
mod error;
pub mod import;
pub mod iql;
pub mod labels;
pub mod losses;
pub mod meta_dt;
mod mlp_policy;
mod networks;
pub mod pair_model;
mod policy;
pub mod regulariser;
pub mod sac;
mod sequence_policy;
pub mod sequences;
mod training;
pub mod transformer;
pub mod world_model;

pub use actor::{ActionReduction, Actor, ActorConfig, PolicyForm};
pub use bc::{Bc, BcConfig};
pub use blocks::map_rows;
pub use buffer::{Buffer, Member, Minibatch, Pick, RewardScale, best_trajectories, return_range_scale};
pub use error::LearnError;
pub use iql::{Iql, IqlConfig, PolicyExtraction};
pub use labels::{LabelConfig, LabelErrors, LabelModels, Labelled, TerminalHandling, train_labels};
pub use meta_dt::{MetaDt, MetaDtConfig};
pub use mlp_policy::{Head, LOG_STD_RANGE, MlpPolicy, PolicySpec};
pub use policy::{Memory, Policy};
pub use regulariser::{Regulariser, RegulariserConfig, RegulariserKind};
pub use sequence_policy::{SequencePolicy, SequenceSpec};
pub use training::{
    Lane, Learner, Meter, Outcome, PolicyLearner, Report, Steps, member_noise, train, train_side_by_side,
};
