//! Policies: what acts, in files of ours and of others, and the networks that become one.

pub mod actor;
pub mod import;
pub mod mlp_policy;
pub mod npy;
pub mod policy;
pub mod sequence_policy;
