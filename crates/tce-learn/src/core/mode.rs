//! Two forms of a method: as in the public code, or as in the paper.

use serde::{Deserialize, Serialize};

/// Which of two forms of a method is trained, where its public code and its paper differ. What exactly differs is told by the
/// method's own file; nothing else does.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, schemars::JsonSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// With the defect of the public code, so that published results can be explained.
    Published,
    /// Without it.
    #[default]
    Corrected,
}
