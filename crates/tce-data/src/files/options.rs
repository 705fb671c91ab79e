//! What the caller knows about a file before it is read.

/// What the caller knows about the file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LoadOptions {
    /// Steps after which the collector cut an episode (`None`: never): 1000 for the benchmark's robots. Only looked at where the file has
    /// no `timeouts`.
    pub step_limit: Option<usize>,
    /// State and action dimension that the file must have, for example [`Agent::dims`](crate::Agent::dims).
    pub dims: Option<(usize, usize)>,
    /// Further columns to read, shape (N,) or (N, 1).
    pub columns: Vec<String>,
    /// Read every further column that there is (D4RL's and OTDF's layouts); what cannot be read as one is told.
    pub all_columns: bool,
    /// Look at files of ours, too: somebody may have changed them since.
    pub distrust_own: bool,
}
