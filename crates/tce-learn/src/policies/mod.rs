//! Policies: what acts, in files of ours and of others, and the networks that become one.

pub mod actor;
pub mod import;
pub(crate) mod mlp_policy;
pub(crate) mod npy;
pub mod onnx;
pub(crate) mod policy;
pub(crate) mod sequence_policy;
