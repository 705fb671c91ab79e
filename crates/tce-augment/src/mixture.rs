//! D_mix^λ: source and generated rows in one table (Section 4.4).
//!
//! Source and generated rows stand λ : (1 − λ) in the mixture. The paper generates (1 − λ)|D_src| rows; where fewer are
//! generated, the mixture shrinks and its ratio stays.

use std::sync::Arc;

use tce_base::Streams;
use tce_base::random::choose;
use tce_data::Transitions;

/// Rows that are no target rows, and perhaps a number for each.
#[derive(Clone, Debug)]
pub struct ScoredRows {
    /// The rows.
    pub rows: Arc<Transitions>,
    /// One number per row whose s' is known, in their order.
    pub scores: Option<Arc<Vec<f32>>>,
}

/// The rows at `indices`, with their numbers.
pub fn select(rows: &Transitions, scores: Option<&Vec<f32>>, indices: &[usize]) -> ScoredRows {
    let scores = scores.map(|scores| {
        let by_row = rows.number_by_row(scores);
        Arc::new(indices.iter().filter(|&&i| rows.known[i]).map(|&i| by_row[i]).collect())
    });
    ScoredRows { rows: Arc::new(rows.select(indices)), scores }
}

impl From<Arc<Transitions>> for ScoredRows {
    fn from(rows: Arc<Transitions>) -> Self {
        Self { rows, scores: None }
    }
}

/// Source and generated rows in the ratio λ : (1 − λ), as many as there are of both; what is too many is left out at
/// random.
pub fn mix(source: &ScoredRows, generated: &ScoredRows, lambda: f64, seed: u64) -> ScoredRows {
    let (sources, others) = (source.rows.len() as f64, generated.rows.len() as f64);
    let total = (sources / lambda).min(others / (1.0 - lambda));
    let (n_source, n_generated) = ((lambda * total).round() as usize, ((1.0 - lambda) * total).round() as usize);
    let source = subset(source, n_source, Streams::new(seed), "mixture/source");
    let generated = subset(generated, n_generated, Streams::new(seed), "mixture/generated");
    let mut rows = Arc::unwrap_or_clone(source.rows);
    rows.extend(&generated.rows);
    let scores = source.scores.zip(generated.scores).map(|(s, g)| Arc::new([s.as_slice(), g.as_slice()].concat()));
    ScoredRows { rows: Arc::new(rows), scores }
}

/// `n` rows at random, in their order.
fn subset(rows: &ScoredRows, n: usize, streams: Streams, name: &str) -> ScoredRows {
    if n >= rows.rows.len() {
        return rows.clone();
    }
    select(&rows.rows, rows.scores.as_deref(), &choose(&mut streams.stream(name), rows.rows.len(), n))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(value: f32, n: usize) -> Arc<Transitions> {
        let mut t = Transitions::new(1, 1);
        for _ in 0..n {
            t.push(&[value], &[0.0], 0.0, &[value], false, false);
        }
        Arc::new(t)
    }

    #[test]
    fn the_ratio_is_kept_whatever_is_scarce() {
        for (n_source, n_generated) in [(1000, 900), (10, 900), (1000, 18)] {
            let extra =
                |value: f32, n: usize| ScoredRows { scores: Some(Arc::new(vec![value; n])), ..rows(value, n).into() };
            let mixed = mix(&extra(1.0, n_source), &extra(0.0, n_generated), 0.1, 0);
            assert_eq!(mixed.rows.observations, *mixed.scores.unwrap(), "scores stay with their rows");
            let mixed = mixed.rows;
            let share = mixed.observations.iter().sum::<f32>() / mixed.len() as f32;
            assert!((share - 0.1).abs() < 0.03, "{n_source} {n_generated}: {share}");
            assert!(mixed.len() >= 20);
        }
    }

    /// Every third source row has no s', and so no number. That of another row is its state.
    #[test]
    fn numbers_stay_with_the_rows_that_have_one() {
        let mut t = Transitions::new(1, 1);
        (0..90).for_each(|i| t.push(&[i as f32], &[0.0], 0.0, &[0.0], i % 3 == 2, false));
        t.known = t.terminals.iter().map(|terminal| !terminal).collect();
        let numbers = (0..90).filter(|i| i % 3 != 2).map(|i| i as f32).collect();
        let source = ScoredRows { rows: Arc::new(t), scores: Some(Arc::new(numbers)) };
        let generated = ScoredRows { scores: Some(Arc::new(vec![500.0; 40])), ..rows(500.0, 40).into() };
        let mixed = mix(&source, &generated, 0.5, 0);
        let known = (0..mixed.rows.len()).filter(|&i| mixed.rows.known[i]);
        let states: Vec<f32> = known.map(|i| mixed.rows.observations[i]).collect();
        assert_eq!((mixed.rows.len(), states.len() < 80), (80, true), "half of the source's rows, some without s'");
        assert_eq!(states, *mixed.scores.unwrap());
    }

    #[test]
    fn a_subset_is_reproducible_and_without_repetition() {
        let mut t = Transitions::new(1, 1);
        (0..100).for_each(|i| t.push(&[i as f32], &[0.0], 0.0, &[0.0], false, false));
        let t = ScoredRows::from(Arc::new(t));
        let a = subset(&t, 30, Streams::new(1), "x").rows;
        assert_eq!(a, subset(&t, 30, Streams::new(1), "x").rows);
        assert!(a.observations.windows(2).all(|w| w[0] < w[1]));
    }
}
