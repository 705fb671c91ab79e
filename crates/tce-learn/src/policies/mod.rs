//! Policies: how they act, their files (ours and those of other programs), and the networks they are made from.

pub mod actor;
pub mod import;
pub(crate) mod mlp_policy;
pub(crate) mod npy;
pub mod onnx;
pub(crate) mod policy;
pub(crate) mod sequence_policy;
