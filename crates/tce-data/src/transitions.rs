//! The table of transitions that every other crate reads and writes.

use std::borrow::Cow;
use std::fmt;

use serde::{Deserialize, Serialize};

/// The four robots of the benchmark. Users' own data need no agent, only a state and an action dimension.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Agent {
    /// 17 observations, 6 actions.
    HalfCheetah,
    /// 11 observations, 3 actions.
    Hopper,
    /// 17 observations, 6 actions.
    Walker2d,
    /// 111 observations, of which the last 84 are always zero; 8 actions.
    Ant,
}

impl Agent {
    /// All agents, in the paper's order.
    pub const ALL: [Agent; 4] = [Agent::HalfCheetah, Agent::Hopper, Agent::Walker2d, Agent::Ant];

    /// Lower-case name, as in file and task names.
    pub fn name(self) -> &'static str {
        match self {
            Agent::HalfCheetah => "halfcheetah",
            Agent::Hopper => "hopper",
            Agent::Walker2d => "walker2d",
            Agent::Ant => "ant",
        }
    }

    /// Observation and action dimension (Table C.3).
    pub fn dims(self) -> (usize, usize) {
        match self {
            Agent::HalfCheetah | Agent::Walker2d => (17, 6),
            Agent::Hopper => (11, 3),
            Agent::Ant => (111, 8),
        }
    }
}

impl fmt::Display for Agent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// `len` transitions (s, a, r, s', terminal) in columns, each row-major.
///
/// Rows are in time order within an episode; [`Transitions::timeouts`] and [`Transitions::terminals`] mark where
/// episodes end. In data without an order (generated rows), every row is its own episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Transitions {
    /// State dimension d_s.
    pub obs_dim: usize,
    /// Action dimension d_a.
    pub act_dim: usize,
    /// s, `[len, obs_dim]`.
    pub observations: Vec<f32>,
    /// a, `[len, act_dim]`.
    pub actions: Vec<f32>,
    /// r, `[len]`.
    pub rewards: Vec<f32>,
    /// s', `[len, obs_dim]`.
    pub next_observations: Vec<f32>,
    /// Whether s' is absorbing, `[len]`. A time-out is not a terminal.
    pub terminals: Vec<bool>,
    /// Whether the episode was cut after this row for a reason other than a terminal, `[len]`.
    pub timeouts: Vec<bool>,
    /// Whether s' is known, `[len]`. If it is not, the row is terminal and `next_observations` repeats s. Such rows are
    /// usable for learning values and for imitation, but not for learning the dynamics
    /// ([`Transitions::with_successors`]).
    pub known: Vec<bool>,
}

/// Rows `start..end` of one episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Episode {
    /// First row.
    pub start: usize,
    /// One past the last row.
    pub end: usize,
    /// Sum of the rewards, undiscounted.
    pub episode_return: f64,
}

impl Transitions {
    /// An empty table of the given dimensions.
    pub fn new(obs_dim: usize, act_dim: usize) -> Self {
        Self { obs_dim, act_dim, ..Self::default() }
    }

    /// An empty table with room for `rows`.
    pub fn with_capacity(obs_dim: usize, act_dim: usize, rows: usize) -> Self {
        Self {
            obs_dim,
            act_dim,
            observations: Vec::with_capacity(rows * obs_dim),
            actions: Vec::with_capacity(rows * act_dim),
            rewards: Vec::with_capacity(rows),
            next_observations: Vec::with_capacity(rows * obs_dim),
            terminals: Vec::with_capacity(rows),
            timeouts: Vec::with_capacity(rows),
            known: Vec::with_capacity(rows),
        }
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// Whether there are no rows.
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// s of row `i`.
    pub fn observation(&self, i: usize) -> &[f32] {
        &self.observations[i * self.obs_dim..(i + 1) * self.obs_dim]
    }

    /// a of row `i`.
    pub fn action(&self, i: usize) -> &[f32] {
        &self.actions[i * self.act_dim..(i + 1) * self.act_dim]
    }

    /// s' of row `i`.
    pub fn next_observation(&self, i: usize) -> &[f32] {
        &self.next_observations[i * self.obs_dim..(i + 1) * self.obs_dim]
    }

    /// Appends one row.
    pub fn push(&mut self, s: &[f32], a: &[f32], r: f32, s2: &[f32], terminal: bool, timeout: bool) {
        debug_assert_eq!((s.len(), a.len(), s2.len()), (self.obs_dim, self.act_dim, self.obs_dim));
        self.observations.extend_from_slice(s);
        self.actions.extend_from_slice(a);
        self.rewards.push(r);
        self.next_observations.extend_from_slice(s2);
        self.terminals.push(terminal);
        self.timeouts.push(timeout);
        self.known.push(true);
    }

    /// Appends all rows of `other`.
    ///
    /// # Panics
    /// If the dimensions differ.
    pub fn extend(&mut self, other: &Transitions) {
        assert_eq!((self.obs_dim, self.act_dim), (other.obs_dim, other.act_dim), "dimensions differ");
        self.observations.extend_from_slice(&other.observations);
        self.actions.extend_from_slice(&other.actions);
        self.rewards.extend_from_slice(&other.rewards);
        self.next_observations.extend_from_slice(&other.next_observations);
        self.terminals.extend_from_slice(&other.terminals);
        self.timeouts.extend_from_slice(&other.timeouts);
        self.known.extend_from_slice(&other.known);
    }

    /// The rows at `indices`, in that order. If the row that follows a row here does not follow it in the selection,
    /// the row gets a `timeout` mark, so that separate episodes are not joined.
    pub fn select(&self, indices: &[usize]) -> Transitions {
        let mut out = Transitions::with_capacity(self.obs_dim, self.act_dim, indices.len());
        for (k, &i) in indices.iter().enumerate() {
            let continues = indices.get(k + 1) == Some(&(i + 1));
            let timeout = self.timeouts[i] || (!continues && !self.terminals[i]);
            out.push(
                self.observation(i),
                self.action(i),
                self.rewards[i],
                self.next_observation(i),
                self.terminals[i],
                timeout,
            );
            out.known[k] = self.known[i];
        }
        out
    }

    /// The rows whose s' is known.
    pub fn with_successors(&self) -> Cow<'_, Transitions> {
        if self.known.iter().all(|&known| known) {
            return Cow::Borrowed(self);
        }
        let rows: Vec<usize> = (0..self.len()).filter(|&i| self.known[i]).collect();
        Cow::Owned(self.select(&rows))
    }

    /// One number per row, of `numbers` that only rows with a known s' have, in their order; 0 for the others.
    pub fn number_by_row(&self, numbers: &[f32]) -> Vec<f32> {
        let mut next = numbers.iter();
        let of = |known: &bool| if *known { next.next().copied().unwrap_or_default() } else { 0.0 };
        self.known.iter().map(of).collect()
    }

    /// Episodes in row order: each ends at a terminal, at a time-out, or at the last row.
    pub fn episodes(&self) -> Vec<Episode> {
        let mut episodes = Vec::new();
        let (mut start, mut episode_return) = (0, 0.0);
        for i in 0..self.len() {
            episode_return += self.rewards[i] as f64;
            if self.terminals[i] || self.timeouts[i] || i + 1 == self.len() {
                episodes.push(Episode { start, end: i + 1, episode_return });
                (start, episode_return) = (i + 1, 0.0);
            }
        }
        episodes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(terminals: &[bool], timeouts: &[bool]) -> Transitions {
        let mut t = Transitions::new(1, 1);
        for i in 0..terminals.len() {
            t.push(&[i as f32], &[0.0], 1.0, &[i as f32 + 1.0], terminals[i], timeouts[i]);
        }
        t
    }

    #[test]
    fn episodes_end_at_terminals_timeouts_and_the_last_row() {
        let t = table(&[false, true, false, false, false], &[false, false, false, true, false]);
        let ends: Vec<_> = t.episodes().iter().map(|e| (e.start, e.end, e.episode_return)).collect();
        assert_eq!(ends, [(0, 2, 2.0), (2, 4, 2.0), (4, 5, 1.0)]);
    }

    #[test]
    fn selecting_cuts_where_rows_no_longer_follow_each_other() {
        let t = table(&[false; 5], &[false; 5]);
        let s = t.select(&[0, 1, 3, 4]);
        assert_eq!(s.timeouts, [false, true, false, true]);
        assert_eq!(s.observations, [0.0, 1.0, 3.0, 4.0]);
    }
}
