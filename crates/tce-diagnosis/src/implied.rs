//! The policy that a generator implies: â = Inv(s, ŝ') with ŝ' ~ q_tran(· | s).
//!
//! A learner of generated rows imitates this policy, so that its error at real states, and what it returns, say more of the
//! rows than whether they agree with the physics: a row may be a perfectly possible step of a behaviour that nobody had.
//!
//! With draws â_1 .. â_k at a state and the action a that the behaviour took there, averages over rows and components:
//!
//! | metric | definition |
//! |---|---|
//! | `single` | √ mean over draws of (â_j − a)² |
//! | `mean` | √ of (mean over draws of â_j − a)² |
//! | `between_draws` | √ mean over draws of (â_j − mean of the draws)²; single² = mean² + between_draws² |
//! | `inverse` | √ of (Inv(s, s') − a)² with the real s': what Inv itself gets wrong |
//! | `spread` | √ of (a − mean of a)², component by component: the error of always taking the mean action |

use serde::{Deserialize, Serialize};

use crate::numbers::Spread;

/// Errors of implied actions at some target rows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImpliedErrors {
    /// Rows that are part of the metrics.
    pub rows: usize,
    /// Rows in which a draw is not made of finite numbers. They are left out.
    pub lost: usize,
    /// Draws of a successor at every row.
    pub draws: usize,
    /// RMSE of one draw against the row's own action.
    pub single: f64,
    /// RMSE of the mean over the draws.
    pub mean: f64,
    /// How far the draws are from their mean.
    pub between_draws: f64,
    /// RMSE of the action that is inferred from the row's own successor.
    pub inverse: f64,
    /// Spread of the rows' own actions.
    pub spread: f64,
}

impl ImpliedErrors {
    /// From the implied actions, `drawn[j]` `[rows, act_dim]` for every draw, those that are `inferred` from real successors, and the rows'
    /// own ones. None where no row has finite numbers alone.
    ///
    /// # Panics
    /// If the tables differ in size.
    pub fn of(drawn: &[&[f32]], inferred: &[f32], actions: &[f32], act_dim: usize) -> Option<Self> {
        assert!(
            drawn.iter().all(|d| d.len() == actions.len()) && inferred.len() == actions.len(),
            "tables of one size"
        );
        let total = actions.len() / act_dim;
        let whole = |i: &usize| {
            let row = i * act_dim..(i + 1) * act_dim;
            drawn.iter().all(|d| d[row.clone()].iter().all(|v| v.is_finite()))
        };
        let kept: Vec<usize> = (0..total).filter(whole).collect();
        if kept.is_empty() || drawn.is_empty() {
            return None;
        }
        let (n, k) = (kept.len() as f64, drawn.len() as f64);
        let mut centre = vec![0.0; act_dim];
        for &i in &kept {
            (0..act_dim).for_each(|c| centre[c] += f64::from(actions[i * act_dim + c]) / n);
        }
        let (mut single, mut mean, mut between, mut inverse, mut spread) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for &i in &kept {
            for (c, centre) in centre.iter().enumerate() {
                let at = i * act_dim + c;
                let own = f64::from(actions[at]);
                let average = drawn.iter().map(|d| f64::from(d[at])).sum::<f64>() / k;
                single += drawn.iter().map(|d| (f64::from(d[at]) - own).powi(2)).sum::<f64>() / k;
                between += drawn.iter().map(|d| (f64::from(d[at]) - average).powi(2)).sum::<f64>() / k;
                mean += (average - own).powi(2);
                inverse += (f64::from(inferred[at]) - own).powi(2);
                spread += (own - centre).powi(2);
            }
        }
        let root = |sum: f64| (sum / (n * act_dim as f64)).sqrt();
        Some(Self {
            rows: kept.len(),
            lost: total - kept.len(),
            draws: drawn.len(),
            single: root(single),
            mean: root(mean),
            between_draws: root(between),
            inverse: root(inverse),
            spread: root(spread),
        })
    }
}

/// Implied actions at real target states.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImpliedActions {
    /// At rows that q_tran was trained on.
    pub trained: Option<ImpliedErrors>,
    /// At rows that it was not; None where all were trained on.
    pub held_out: Option<ImpliedErrors>,
}

/// What the implied policy gets in the target domain.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImpliedRollout {
    /// Episodes.
    pub episodes: usize,
    /// Mean and standard deviation of the episodes' normalised scores; None without reference returns.
    pub score: Option<(f64, f64)>,
    /// Mean and standard deviation of the episodes' returns; None where the policy could not act.
    pub returns: Option<(f64, f64)>,
    /// Mean length of an episode, in steps.
    pub length: Option<f64>,
    /// Why there are no metrics, where there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failed: Option<String>,
}

/// All that is measured of the implied policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Implied {
    /// Its actions beside the behaviour's.
    pub actions: ImpliedActions,
    /// What it gets; None without a simulator.
    pub rollout: Option<ImpliedRollout>,
    /// The score of the target data, where it is known.
    pub behaviour_score: Option<f64>,
}

impl Implied {
    /// What was found, what it means, and what would be good.
    pub fn sentence(&self) -> String {
        let mut text = String::new();
        if let Some(e) = self.actions.trained {
            text += &format!(
                "The action that the generator implies at real states differs from the behaviour's by {:.3}{}; the behaviour's actions \
                 spread by {:.3}, and the inverse dynamics model alone errs by {:.3}.",
                e.single,
                self.actions.held_out.map_or(String::new(), |h| format!(" ({:.3} at rows held out)", h.single)),
                e.spread,
                e.inverse
            );
        }
        match &self.rollout {
            Some(ImpliedRollout { failed: Some(why), .. }) => text += &format!(" It cannot be rolled out: {why}."),
            Some(ImpliedRollout { score: Some((mean, std)), episodes, .. }) => {
                text += &format!(" Rolled out for {episodes} episodes, it scores {mean:.1} ± {std:.1}");
                text += &self.behaviour_score.map_or(".".into(), |s| format!("; the target data score {s:.1}."));
            }
            Some(ImpliedRollout { returns: Some((mean, std)), episodes, .. }) => {
                text += &format!(" Rolled out for {episodes} episodes, it returns {mean:.1} ± {std:.1}.");
            }
            _ => {}
        }
        text += " Good is a difference near the noise of the behaviour's own actions, the same at rows held out";
        text += if self.rollout.is_some() { ", and a score near that of the target data." } else { "." };
        text
    }
}

/// Rows whose ŝ are about as far from the target's states.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorBin {
    /// Median distance of ŝ to the nearest target state, in [`ErrorOverDistance::unit`].
    pub distance: f64,
    /// Errors of the rows.
    pub error: Spread,
}

/// What errors of generated rows are against.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Truth {
    /// The simulator.
    Simulator,
    /// Models of the target's rows: how far they are apart.
    Models,
}

/// Errors of generated rows over the distance of ŝ to the nearest real target state.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorOverDistance {
    /// The unit of distance in standard deviations of the states: the median distance of a target state to the nearest one of another
    /// episode; 1 where episodes do not allow it.
    pub unit: f64,
    /// Whether `unit` is of other episodes.
    pub by_episode: bool,
    /// Whether the errors are against the simulator; otherwise how far models of the target's rows are apart.
    pub simulated: bool,
    /// Bins of as many rows each, the nearest first.
    pub bins: Vec<ErrorBin>,
}

impl ErrorOverDistance {
    /// The most bins.
    const BINS: usize = 10;
    /// The fewest rows of a bin, where there are as many.
    const FEWEST: usize = 20;

    /// Bins of pairs (distance in standard deviations, error); None without rows, or without a unit above 0.
    pub fn of(mut rows: Vec<(f64, f64)>, unit: Option<f64>, truth: Truth) -> Option<Self> {
        let simulated = truth == Truth::Simulator;
        let by_episode = unit.is_some();
        let unit = unit.unwrap_or(1.0);
        rows.retain(|(distance, _)| distance.is_finite());
        if rows.is_empty() || unit.is_nan() || unit <= 0.0 {
            return None;
        }
        rows.sort_by(|a, b| a.0.total_cmp(&b.0));
        let count = (rows.len() / Self::FEWEST).clamp(1, Self::BINS);
        let bin = |k: usize| {
            let part = &rows[k * rows.len() / count..(k + 1) * rows.len() / count];
            let distance = part[part.len() / 2].0 / unit;
            Spread::of(part.iter().map(|(_, error)| *error)).map(|error| ErrorBin { distance, error })
        };
        Some(Self { unit, by_episode, simulated, bins: (0..count).filter_map(bin).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_known_draws() {
        // Two rows of one component; the draws are off by ±.2 about a mean that is off by .1.
        let (a, b) = ([0.4, -0.2].map(|x: f32| x + 0.3), [0.4, -0.2].map(|x: f32| x - 0.1));
        let found = ImpliedErrors::of(&[&a, &b], &[0.4, -0.2], &[0.4, -0.2], 1).unwrap();
        for (value, expected) in [
            (found.mean, 0.1),
            (found.between_draws, 0.2),
            (found.single, 0.05f64.sqrt()),
            (found.inverse, 0.0),
            (found.spread, 0.3),
        ] {
            assert!((value - expected).abs() < 1e-6, "{found:?}: {value} {expected}");
        }
        assert_eq!((found.rows, found.lost, found.draws), (2, 0, 2));
    }

    #[test]
    fn rows_without_numbers_are_left_out() {
        let found = ImpliedErrors::of(&[&[f32::NAN, 1.0]], &[0.0, 0.0], &[0.0, 0.0], 1).unwrap();
        assert_eq!((found.rows, found.lost, found.single), (1, 1, 1.0));
        assert_eq!(ImpliedErrors::of(&[&[f32::NAN]], &[0.0], &[0.0], 1), None);
    }

    /// Constants of a component are no spread.
    #[test]
    fn the_spread_is_component_by_component() {
        let actions = [1.0, -1.0, 1.0, -1.0];
        assert_eq!(ImpliedErrors::of(&[&actions], &actions, &actions, 2).unwrap().spread, 0.0);
    }

    #[test]
    fn errors_are_binned_by_their_distance() {
        let rows: Vec<(f64, f64)> = (0..400).rev().map(|i| (f64::from(i), f64::from(i) / 10.0)).collect();
        let found = ErrorOverDistance::of(rows, Some(2.0), Truth::Simulator).unwrap();
        assert_eq!(found.bins.len(), 10);
        assert_eq!((found.bins[0].distance, found.bins[0].error.median), (10.0, 2.0));
        assert!(found.bins.windows(2).all(|w| w[0].distance < w[1].distance && w[0].error.count == 40));
        assert_eq!(ErrorOverDistance::of(vec![(1.0, 1.0); 5], None, Truth::Models).unwrap().bins.len(), 1);
        assert_eq!(ErrorOverDistance::of(vec![], None, Truth::Models), None);
    }

    #[test]
    fn the_sentence_says_what_is_known() {
        let e = ImpliedErrors {
            rows: 9,
            lost: 0,
            draws: 8,
            single: 0.25,
            mean: 0.2,
            between_draws: 0.15,
            inverse: 0.03,
            spread: 0.5,
        };
        let actions = ImpliedActions { trained: Some(e), held_out: None };
        let mut all = Implied { actions, rollout: None, behaviour_score: None };
        assert!(all.sentence().starts_with("The action that the generator implies at real states differs"));
        assert!(!all.sentence().contains("Rolled out"));
        all.rollout = Some(ImpliedRollout {
            episodes: 10,
            score: Some((61.0, 4.0)),
            returns: Some((1000.0, 10.0)),
            length: Some(900.0),
            failed: None,
        });
        all.behaviour_score = Some(90.0);
        let text = all.sentence();
        assert!(
            text.contains("Rolled out for 10 episodes, it scores 61.0 ± 4.0; the target data score 90.0."),
            "{text}"
        );
    }
}
