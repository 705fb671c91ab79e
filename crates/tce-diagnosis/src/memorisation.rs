//! Whether generated rows are copies of training rows.
//!
//! A sample of the right distribution is as far from the training rows as held-out rows are. As the test of Meehan et al. 2020 (A
//! Non-Parametric Test to Detect Data-Copying in Generative Models) has it, the distances of both to their nearest training row are
//! compared: p = P(d_generated < d_held-out) + ½ P(=).
//!
//! Held-out rows without a held-out set: for every episode e, its rows and a random share of the generated ones are measured against
//! the *same* rows, the training rows T∖e of the other episodes (within an episode, neighbours in time are nearly the same row); p
//! is the mean of the p_e, weighted by the rows of e. With w_e the share of rows in e:
//!
//! | rows | p |
//! |---|---|
//! | of the right distribution | ½ |
//! | copies of T: the w_e copied from e are as far from T∖e as e is | 1 − ½ Σ w_e² |
//! | beside the data | towards 0 |
//!
//! The measure needs episodes that visit the same states, as the gait of one policy does. Where every episode is a place of its own,
//! fresh rows get the p of copies, and only exact copies are told from them, by [`Memorisation::identical`].

use std::fmt;
use std::ops::Range;

use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_data::{DataError, NeighbourOptions, Rows, nn_distances};

use crate::numbers::Spread;

/// Below this p generated rows are said to lie beside the data: three of four are farther from a training row than a held-out row is.
pub const BESIDE: f64 = 0.25;
/// From this share on it is said that rows are training rows, whatever p is: chance makes none among continuous numbers.
const IDENTICAL: f64 = 0.001;

/// How near generated rows are to training rows, beside rows that the generator did not see.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Memorisation {
    /// Distance of generated rows to the nearest training row.
    pub generated: Spread,
    /// Distance of training rows to the nearest one of another episode.
    pub held_out: Spread,
    /// Share of generated rows that are a training row.
    pub identical: f64,
    /// p
    pub probability: f64,
    /// What p would be if every row were copied.
    pub of_copies: f64,
}

/// What p says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Nearer to copies than to fresh rows.
    Copies,
    /// As far from the training rows as held-out rows are, roughly.
    Fresh,
    /// Farther from the training rows than held-out rows are.
    Beside,
}

/// A sentence without its point.
impl fmt::Display for Memorisation {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let some = self.identical >= IDENTICAL;
        f.write_str(match (self.verdict(), some) {
            (Verdict::Copies, _) => "generated rows look like copies of training rows",
            (Verdict::Fresh, false) => "generated rows are no copies of training rows",
            (Verdict::Fresh, true) => "generated rows are as far from the training rows as held-out rows are",
            (Verdict::Beside, false) => {
                "generated rows are no copies, but lie farther from the training rows than held-out rows do"
            }
            (Verdict::Beside, true) => "generated rows lie farther from the training rows than held-out rows do",
        })?;
        if some { write!(f, "; {:.1} % of them are training rows", 100.0 * self.identical) } else { Ok(()) }
    }
}

impl Memorisation {
    /// What p says: copies from half the way between ½ and what copies get, beside the data below [`BESIDE`].
    pub fn verdict(&self) -> Verdict {
        match self.probability {
            p if p > (0.5 + self.of_copies) / 2.0 => Verdict::Copies,
            p if p < BESIDE => Verdict::Beside,
            _ => Verdict::Fresh,
        }
    }
}

/// Training rows with the distances of every episode to the others.
pub struct HeldOut {
    rows: Vec<f32>,
    dim: usize,
    episodes: Vec<Range<usize>>,
    /// By episode, of its rows.
    distances: Vec<Vec<f64>>,
}

impl HeldOut {
    /// Of `rows`, row-major of width `dim`. None if an episode has more than half of the rows: too little is left to compare with.
    ///
    /// # Errors
    /// If the user interrupts.
    pub fn new(rows: Vec<f32>, dim: usize, episodes: Vec<Range<usize>>) -> Result<Option<Self>, DataError> {
        let count = rows.len() / dim;
        if episodes.is_empty() || episodes.iter().any(|e| 2 * e.len() > count) {
            return Ok(None);
        }
        let mut held_out = Self { rows, dim, episodes, distances: Vec::new() };
        for e in held_out.episodes.clone() {
            let own = &held_out.rows[e.start * dim..e.end * dim];
            held_out.distances.push(held_out.without(&e, own)?);
        }
        Ok(Some(held_out))
    }

    /// Median distance of a training row to the nearest one of another episode.
    pub fn median_distance(&self) -> Option<f64> {
        Spread::of(self.distances.iter().flatten().copied()).map(|s| s.median)
    }

    /// Distances of `rows` to the nearest training row outside of `episode`.
    fn without(&self, episode: &Range<usize>, rows: &[f32]) -> Result<Vec<f64>, DataError> {
        let others = [&self.rows[..episode.start * self.dim], &self.rows[episode.end * self.dim..]].concat();
        nearest(rows, &others, self.dim)
    }

    /// How near `generated` rows are; None if there are none.
    ///
    /// # Errors
    /// If the user interrupts.
    pub fn compare(&self, generated: &[f32], streams: &Streams) -> Result<Option<Memorisation>, DataError> {
        let (dim, count) = (self.dim, generated.len() / self.dim);
        let mut order: Vec<usize> = (0..count).collect();
        order.shuffle(&mut streams.stream("shares of the episodes"));
        let total: usize = self.episodes.iter().map(Range::len).sum();
        let (mut above, mut weight, mut squares) = (0.0, 0.0, 0.0);
        for (e, distances) in self.episodes.iter().zip(&self.distances) {
            // Episodes follow one another: a share of the generated rows each, as large as theirs of the training rows.
            let share = &order[e.start * count / total..e.end * count / total];
            squares += (e.len() as f64 / total as f64).powi(2);
            if share.is_empty() {
                continue;
            }
            let rows: Vec<f32> = share.iter().flat_map(|&i| generated[i * dim..(i + 1) * dim].to_vec()).collect();
            above += e.len() as f64 * probability_below(&self.without(e, &rows)?, distances.clone());
            weight += e.len() as f64;
        }
        let to_all = nearest(generated, &self.rows, dim)?;
        let identical = to_all.iter().filter(|d| **d == 0.0).count() as f64 / count as f64;
        let spreads = Spread::of(to_all).zip(Spread::of(self.distances.iter().flatten().copied()));
        Ok(spreads.map(|(generated, held_out)| Memorisation {
            generated,
            held_out,
            identical,
            probability: above / weight,
            of_copies: 1.0 - squares / 2.0,
        }))
    }
}

fn nearest(rows: &[f32], among: &[f32], dim: usize) -> Result<Vec<f64>, DataError> {
    let found = nn_distances(&Rows::new(rows, dim), &Rows::new(among, dim), &NeighbourOptions::default())?;
    Ok(found.into_iter().map(f64::from).collect())
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tce_base::random::fill_normal;

    use super::*;

    /// Episodes are clusters: rows of one lie around its own centre.
    fn episodes(name: &str, centres: &[f32], rows: usize) -> Vec<f32> {
        let mut out = vec![0.0; centres.len() * rows * 4];
        fill_normal(&mut Streams::new(3).stream(name), &mut out);
        for (rows, centre) in out.chunks_exact_mut(rows * 4).zip(centres) {
            rows.iter_mut().for_each(|x| *x += centre);
        }
        out
    }

    fn compare(training: &[f32], generated: &[f32], episodes: usize) -> Memorisation {
        let each = training.len() / 4 / episodes;
        let ranges = (0..episodes).map(|e| e * each..(e + 1) * each).collect();
        let held_out = HeldOut::new(training.to_vec(), 4, ranges).unwrap().unwrap();
        held_out.compare(generated, &Streams::new(1)).unwrap().unwrap()
    }

    #[test]
    fn copies_fresh_rows_and_rows_beside_the_data_are_told_apart() {
        for count in [2, 3, 5, 50] {
            let centres = vec![0.0; count];
            let training = episodes("training", &centres, 1000 / count);
            let copies = compare(&training, &training, count);
            assert_eq!((copies.verdict(), copies.identical), (Verdict::Copies, 1.0), "{count} episodes: {copies:?}");
            assert!((copies.probability - copies.of_copies).abs() < 0.03, "{count} episodes: {copies:?}");
            let mut near = training.clone();
            near.iter_mut().zip(episodes("noise", &centres, 1000 / count)).for_each(|(x, z)| *x += 0.05 * z);
            let near = compare(&training, &near, count);
            assert_eq!((near.verdict(), near.identical), (Verdict::Copies, 0.0), "{count} episodes: {near:?}");
            // A perfect generator, however few the episodes are.
            let fresh = compare(&training, &episodes("fresh", &centres, 2000 / count), count);
            assert!(fresh.verdict() == Verdict::Fresh && (fresh.probability - 0.5).abs() < 0.05, "{count}: {fresh:?}");
            let mut far: Vec<f32> = training.iter().map(|x| 3.0 * x + 2.0).collect();
            assert_eq!(compare(&training, &far, count).verdict(), Verdict::Beside, "{count} episodes");
            // Every fiftieth of them a training row: too few for p, and nothing that chance does.
            far.chunks_exact_mut(4).zip(training.chunks_exact(4)).step_by(50).for_each(|(x, t)| x.copy_from_slice(t));
            let said = compare(&training, &far, count).to_string();
            assert!(said.ends_with("than held-out rows do; 2.0 % of them are training rows"), "{said}");
        }
    }

    /// The limit of the measure: where every episode is a place of its own, rows of the others' places look like copies. What is left
    /// to tell them by is how many are identical.
    #[test]
    fn episodes_apart_from_each_other_cannot_be_measured_by_p() {
        let centres = [0.0, 30.0, 60.0, 90.0, 120.0];
        let training = episodes("training", &centres, 200);
        let fresh = compare(&training, &episodes("fresh", &centres, 400), 5);
        assert!(fresh.identical == 0.0 && fresh.verdict() == Verdict::Copies, "{fresh:?}");
    }

    #[test]
    fn only_other_episodes_count() {
        let rows = vec![0.0, 0.1, 5.0, 5.2, 9.0f32];
        let held_out = HeldOut::new(rows.clone(), 1, vec![0..2, 2..4, 4..5]).unwrap().unwrap();
        for (found, expected) in held_out.distances.concat().iter().zip([5.0, 4.9, 4.0, 3.8, 3.8]) {
            assert!((found - expected).abs() < 1e-6);
        }
        assert!((held_out.median_distance().unwrap() - 4.0).abs() < 1e-6);
        let one = std::iter::once(0..5).collect();
        assert!(HeldOut::new(rows.clone(), 1, one).unwrap().is_none());
        assert!(HeldOut::new(rows, 1, vec![0..3, 3..5]).unwrap().is_none(), "two rows are too few to compare with");
        assert!(held_out.compare(&[], &Streams::new(0)).unwrap().is_none());
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
