//! Whether generated rows are copies of training rows.
//!
//! A sample of the right distribution is as far from the training rows as held-out rows are. As the test of Meehan et al. 2020 (A
//! Non-Parametric Test to Detect Data-Copying in Generative Models) has it, the distances of both to their nearest training row are
//! compared: p = P(d_generated < d_held-out) + ½ P(=), one half without copying, 1 for copies.
//!
//! Held-out rows without a held-out set: every training row against the rows of the *other* episodes. Within an episode, neighbours
//! in time are nearly the same row.

use std::ops::Range;

use serde::{Deserialize, Serialize};
use tce_data::{DataError, NeighbourOptions, Rows, nn_distances};

use crate::numbers::Spread;

/// Above this p generated rows are said to be copies: three of four lie nearer to a training row than a held-out row does.
pub const COPIES: f64 = 0.75;

/// How near generated rows are to training rows, beside rows that the generator did not see.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Memorisation {
    /// Distance of generated rows to the nearest training row.
    pub generated: Spread,
    /// Distance of held-out rows to the nearest training row.
    pub held_out: Spread,
    /// Share of generated rows that are a training row.
    pub identical: f64,
    /// p
    pub probability: f64,
}

impl Memorisation {
    /// From the distances of generated and held-out rows to their nearest training row; None where one has no finite ones.
    pub fn of(generated: &[f32], held_out: &[f32]) -> Option<Self> {
        let wide = |d: &[f32]| d.iter().map(|&d| f64::from(d)).collect::<Vec<_>>();
        let (g, h) = (wide(generated), wide(held_out));
        Some(Self {
            generated: Spread::of(g.iter().copied())?,
            held_out: Spread::of(h.iter().copied())?,
            identical: g.iter().filter(|d| **d == 0.0).count() as f64 / g.len() as f64,
            probability: probability_below(&g, h),
        })
    }

    /// Whether p says that rows were copied.
    pub fn copied(&self) -> bool {
        self.probability > COPIES
    }
}

/// P(a < b) + ½ P(a = b) for one number of each set.
fn probability_below(a: &[f64], mut b: Vec<f64>) -> f64 {
    b.sort_by(f64::total_cmp);
    let above = |x: f64| {
        let (below, up_to) = (b.partition_point(|v| *v < x), b.partition_point(|v| *v <= x));
        (b.len() - up_to) as f64 + 0.5 * (up_to - below) as f64
    };
    a.iter().map(|&x| above(x)).sum::<f64>() / (a.len() * b.len()) as f64
}

/// The distance of every row to the nearest row of another episode; None for a single episode.
///
/// # Errors
/// If the user interrupts.
pub fn distances_between_episodes(
    rows: &[f32],
    dim: usize,
    episodes: &[Range<usize>],
) -> Result<Option<Vec<f32>>, DataError> {
    if episodes.len() < 2 {
        return Ok(None);
    }
    let mut out = Vec::with_capacity(rows.len() / dim);
    for own in episodes {
        let inside = &rows[own.start * dim..own.end * dim];
        let others = [&rows[..own.start * dim], &rows[own.end * dim..]].concat();
        let options = NeighbourOptions::default();
        out.extend(nn_distances(&Rows::new(inside, dim), &Rows::new(&others, dim), &options)?);
    }
    Ok(Some(out))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tce_base::{Streams, random::fill_normal};

    use super::*;

    fn cloud(name: &str, rows: usize) -> Vec<f32> {
        let mut out = vec![0.0; rows * 4];
        fill_normal(&mut Streams::new(3).stream(name), &mut out);
        out
    }

    fn to_training(rows: &[f32], training: &[f32]) -> Vec<f32> {
        nn_distances(&Rows::new(rows, 4), &Rows::new(training, 4), &NeighbourOptions::default()).unwrap()
    }

    #[test]
    fn copies_are_flagged_and_fresh_rows_are_not() {
        let (training, held_out) = (cloud("training", 1000), cloud("held out", 1000));
        let held_out = to_training(&held_out, &training);
        let copies = Memorisation::of(&to_training(&training[..2000], &training), &held_out).unwrap();
        assert!(copies.copied() && copies.probability == 1.0 && copies.identical == 1.0);
        let mut near = training.clone();
        near.iter_mut().zip(cloud("noise", 1000)).for_each(|(x, z)| *x += 0.05 * z);
        let near = Memorisation::of(&to_training(&near, &training), &held_out).unwrap();
        assert!(near.copied() && near.identical == 0.0, "{near:?}");
        let fresh = Memorisation::of(&to_training(&cloud("fresh", 1000), &training), &held_out).unwrap();
        assert!(!fresh.copied() && (fresh.probability - 0.5).abs() < 0.04, "{fresh:?}");
    }

    #[test]
    fn only_other_episodes_count() {
        let rows = [0.0, 0.1, 5.0, 5.2, 9.0f32];
        let found = distances_between_episodes(&rows, 1, &[0..2, 2..4, 4..5]).unwrap().unwrap();
        for (found, expected) in found.iter().zip([5.0, 4.9, 4.0, 3.8, 3.8]) {
            assert!((found - expected).abs() < 1e-6);
        }
        let one = std::slice::from_ref(&(0..5));
        assert_eq!(distances_between_episodes(&rows, 1, one).unwrap(), None);
    }

    proptest! {
        /// Against the definition, ties included.
        #[test]
        fn the_probability_is_that_of_all_pairs(a in prop::collection::vec(-3i8..3, 1..30), b in prop::collection::vec(-3i8..3, 1..30)) {
            let wide = |v: &[i8]| v.iter().map(|&x| f64::from(x)).collect::<Vec<_>>();
            let (a, b) = (wide(&a), wide(&b));
            let pair = |x: f64, y: f64| if x < y { 1.0 } else if x == y { 0.5 } else { 0.0 };
            let all: f64 = a.iter().flat_map(|&x| b.iter().map(move |&y| pair(x, y))).sum();
            prop_assert!((probability_below(&a, b.clone()) - all / (a.len() * b.len()) as f64).abs() < 1e-12);
        }
    }
}
