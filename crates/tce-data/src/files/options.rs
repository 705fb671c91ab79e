//! What the caller knows about a file before it is read.

/// What the caller knows about the file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LoadOptions {
    /// Number of steps after which the collector cut an episode (`None`: never): 1000 for the benchmark's robots. Used
    /// only if the file has no `timeouts`.
    pub step_limit: Option<usize>,
    /// State and action dimension that the file must have, for example [`Agent::dims`](crate::Agent::dims).
    pub dims: Option<(usize, usize)>,
    /// Further columns to read, shape (N,) or (N, 1).
    pub columns: Vec<String>,
    /// Read every further column (D4RL's and OTDF's layouts). A warning names those that cannot be read.
    pub all_columns: bool,
    /// Also examine files written by this program, in case someone has changed them.
    pub distrust_own: bool,
}
