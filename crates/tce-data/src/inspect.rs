//! Statistics of a data set.

use serde::Serialize;

use crate::moments::Moments;
use crate::{Episode, ReferenceScores, Rows, Transitions};

/// Mean, spread and range of one number per episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// How many values there are.
    pub count: usize,
    /// Mean; 0 if there are no values.
    pub mean: f64,
    /// Population standard deviation.
    pub std: f64,
    /// Smallest value; 0 if there are no values.
    pub min: f64,
    /// Largest value; 0 if there are no values.
    pub max: f64,
}

impl Summary {
    /// Summarises `values`.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Self {
        let values: Vec<f64> = values.into_iter().collect();
        if values.is_empty() {
            return Self { count: 0, mean: 0.0, std: 0.0, min: 0.0, max: 0.0 };
        }
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let std = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
        let min = values.iter().copied().fold(f64::INFINITY, f64::min);
        let max = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        Self { count: values.len(), mean, std, min, max }
    }
}

/// Statistics of the columns of one field, each list `[dim]`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DimensionSummary {
    /// Mean of the finite values.
    pub mean: Vec<f64>,
    /// Population standard deviation of the finite values.
    pub std: Vec<f64>,
    /// Smallest finite value; 0 if there is none.
    pub min: Vec<f32>,
    /// Largest finite value; 0 if there is none.
    pub max: Vec<f32>,
    /// Constant dimensions.
    pub dead: Vec<usize>,
    /// Number of NaN values.
    pub nan: u64,
    /// Number of infinite values.
    pub infinite: u64,
}

impl DimensionSummary {
    fn of(rows: Rows<'_>) -> Self {
        let m = Moments::of(&[rows]);
        let finite = |v: &[f32]| v.iter().zip(&m.count).map(|(&x, &n)| if n == 0 { 0.0 } else { x }).collect();
        Self {
            min: finite(&m.min),
            max: finite(&m.max),
            dead: (0..m.std.len()).filter(|&d| m.std[d] == 0.0).collect(),
            nan: m.nan.iter().sum(),
            infinite: m.infinite.iter().sum(),
            mean: m.mean,
            std: m.std,
        }
    }
}

/// See [`inspect`].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Inspection {
    /// Number of transitions.
    pub rows: usize,
    /// State dimension.
    pub obs_dim: usize,
    /// Action dimension.
    pub act_dim: usize,
    /// Number of episodes, complete or cut.
    pub episodes: usize,
    /// Episodes that ended at a terminal or reached the step limit.
    pub complete_episodes: usize,
    /// Rows with a terminal.
    pub terminals: usize,
    /// Rows with a time-out (or where the episode was cut).
    pub timeouts: usize,
    /// Lengths of all episodes.
    pub lengths: Summary,
    /// Undiscounted returns of the complete episodes; of all episodes if none is complete.
    pub returns: Summary,
    /// s.
    pub observations: DimensionSummary,
    /// a.
    pub actions: DimensionSummary,
    /// s'.
    pub next_observations: DimensionSummary,
    /// r, one dimension.
    pub rewards: DimensionSummary,
}

impl Inspection {
    /// The mean return, normalised by `reference`. `None` if no episode is complete: a partial return is not a return.
    pub fn normalised_score(&self, reference: Option<ReferenceScores>) -> Option<f64> {
        reference.filter(|_| self.complete_episodes > 0).map(|r| r.normalised_score(self.returns.mean))
    }
}

/// Computes the statistics of `data`. An episode is complete if it ended at a terminal or at a time-out. With a
/// `step_limit`, a time-out counts if the episode is at most two rows short of it (the public files lost a row or two
/// of their time-outs); without one, every marked end counts.
pub fn inspect(data: &Transitions, step_limit: Option<usize>) -> Inspection {
    let episodes = data.episodes();
    let timed_out = |e: &&Episode| match step_limit {
        Some(limit) => e.end - e.start + 2 >= limit,
        None => data.timeouts[e.end - 1],
    };
    let complete: Vec<_> = episodes.iter().filter(|e| data.terminals[e.end - 1] || timed_out(e)).collect();
    let returns = if complete.is_empty() {
        Summary::of(episodes.iter().map(|e| e.episode_return))
    } else {
        Summary::of(complete.iter().map(|e| e.episode_return))
    };
    Inspection {
        rows: data.len(),
        obs_dim: data.obs_dim,
        act_dim: data.act_dim,
        episodes: episodes.len(),
        complete_episodes: complete.len(),
        terminals: data.terminals.iter().filter(|&&t| t).count(),
        timeouts: data.timeouts.iter().filter(|&&t| t).count(),
        lengths: Summary::of(episodes.iter().map(|e| (e.end - e.start) as f64)),
        returns,
        observations: DimensionSummary::of(Rows::new(&data.observations, data.obs_dim)),
        actions: DimensionSummary::of(Rows::new(&data.actions, data.act_dim)),
        next_observations: DimensionSummary::of(Rows::new(&data.next_observations, data.obs_dim)),
        rewards: DimensionSummary::of(Rows::new(&data.rewards, 1)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn episodes_returns_and_dead_dimensions() {
        let mut t = Transitions::new(2, 1);
        for i in 0..7 {
            // Episodes: 3 rows to a terminal, 3 rows to the limit, 1 row cut by the end of the file.
            t.push(&[i as f32, 0.5], &[0.1], 2.0, &[i as f32 + 1.0, f32::NAN], i == 2, i == 5);
        }
        let got = inspect(&t, Some(5));
        assert_eq!((got.rows, got.episodes, got.complete_episodes), (7, 3, 2));
        assert_eq!((got.terminals, got.timeouts), (1, 1));
        assert_eq!(got.returns, Summary { count: 2, mean: 6.0, std: 0.0, min: 6.0, max: 6.0 });
        assert_eq!(got.lengths.max, 3.0);
        assert_eq!(got.observations.dead, [1]);
        assert_eq!((got.observations.mean[0], got.observations.std[0]), (3.0, 2.0));
        assert_eq!((got.next_observations.nan, got.next_observations.max[1]), (7, 0.0));
        // Without a limit, every marked time-out is an end.
        assert_eq!(inspect(&t, None).complete_episodes, 2);
        t.timeouts[5] = false;
        assert_eq!(inspect(&t, None).complete_episodes, 1);
        assert!(serde_json::to_string(&got).unwrap().contains("\"complete_episodes\":2"));
    }

    #[test]
    fn an_empty_table_has_numbers_too() {
        let got = inspect(&Transitions::new(2, 1), None);
        assert_eq!((got.rows, got.episodes, got.returns.mean), (0, 0, 0.0));
    }
}
