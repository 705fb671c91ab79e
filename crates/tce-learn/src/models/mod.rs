//! Networks that learners and generators share, and their training: critics, the behaviour CVAE, labels, dynamics, the
//! parts of Meta-DT.

pub mod context_encoder;
pub(crate) mod contexts;
pub mod critic;
pub mod cvae;
pub mod dynamics;
pub mod fitted_q;
pub mod labels;
pub(crate) mod networks;
pub mod pair_model;
pub mod transformer;
pub mod transition_model;
pub mod world_model;
