//! Scores in (0, 1] that say how much closer a row is to the target data than to the source data. The score comes from
//! DmC's nearest-neighbour estimate of a density ratio.
//!
//! ```text
//! ρ(x)     = ln D(x → tar) − ln D(x → src)       D = d² (faiss gives squares) or d, d the L2 distance to the k-th neighbour
//! score(x) = 1 / (1 + ρ(x) − min ρ)              min over the source rows; 1: the most target-like source row
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | k | `neighbour` | 5 | DmC: index 4 of the sorted neighbours |
//! | D | `squared` | true | DmC: faiss' L2 index returns squares |
//! | - | `reference` | 50 000 | own: source rows that stand for all of them; DmC: all |
//!
//! **A row as its own neighbour.** The published index contains the source rows. It therefore returns a source row as
//! its own nearest neighbour, at distance 0, and index 4 of a row's own set is the 4th *other* row. The same holds
//! here: a source row is compared with its 4th other source row, whether or not it was drawn into the reference.
//!
//! **Thinning.** With m of n source rows drawn at random, the k-th neighbour lies about where the (k n / m)-th was: in
//! d dimensions ln d_k grows by ln(n / m) / d wherever the density is even over that distance. Constants cancel in ρ −
//! min ρ.
//!
//! **Copies.** A row with k copies has distance 0, which has no logarithm. Its distance is replaced by the smallest
//! distance that is not 0.

use serde::{Deserialize, Serialize};

use tce_base::Streams;
use tce_base::random::choose;

use crate::neighbours::Units;
use crate::{DataError, NeighbourOptions, Rows, nn_distances};

/// The settings of [`density_scores`]; see the [module](self).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DensityOptions {
    /// k, which nearest neighbour distances are measured to; a row's nearest in its own set is the row itself.
    #[schemars(range(min = 2, max = 1000000))]
    pub neighbour: usize,
    /// Most source rows that distances are measured to; with fewer source rows the result is exact. Source: DmC takes all.
    pub reference: usize,
    /// Whether the distance is squared before its logarithm is taken. Source: DmC's index gives squared ones.
    pub squared: bool,
}

impl Default for DensityOptions {
    fn default() -> Self {
        Self { neighbour: 5, reference: 50_000, squared: true }
    }
}

/// What all source rows' scores share. Scores of further rows can be computed from it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DensityScale {
    /// min ρ, rounded up to a number that a file stores without change.
    pub least: f32,
    /// The smallest distance to the target that is not 0.
    pub target_floor: f32,
    /// The smallest distance to the source that is not 0.
    pub source_floor: f32,
}

/// Scores of the source rows.
#[derive(Clone, Debug, PartialEq)]
pub struct DensityScores {
    /// `[source.len()]`
    pub source: Vec<f32>,
    /// For [`further_scores`].
    pub scale: DensityScale,
}

/// The scores of all source rows. Points are [s, a, s'], in stored units as in DmC.
///
/// The reference is drawn from the stream `density/reference`. The result is independent of the number of threads.
///
/// # Errors
/// [`DataError::Interrupted`].
///
/// # Panics
/// If k is less than 2, or a set or the reference has fewer than k rows. Coordinates must be finite.
pub fn density_scores(
    source: &Rows<'_>,
    target: &Rows<'_>,
    options: &DensityOptions,
    streams: &Streams,
) -> Result<DensityScores, DataError> {
    let k = options.neighbour;
    assert!(k >= 2, "neighbour = {k}: a row's nearest neighbour in its own set is the row itself");
    let reference = Reference::draw(source, options, streams);
    let points = Rows::new(&reference.points, source.dim());
    let own = match &reference.indices {
        None => nn_distances(source, source, &at(k))?,
        Some(indices) => {
            // A row of the reference finds itself there; any other row does not.
            let mut own = nn_distances(source, &points, &at(k - 1))?;
            let drawn = nn_distances(&points, &points, &at(k))?;
            indices.iter().zip(drawn).for_each(|(&i, d)| own[i] = d);
            own
        }
    };
    let to_target = nn_distances(source, target, &at(k))?;
    let mut scale = DensityScale { least: 0.0, target_floor: floor(&to_target), source_floor: floor(&own) };
    let ratios: Vec<f64> = scale.ratios(&to_target, &own, options.squared).collect();
    let least = ratios.iter().copied().fold(f64::INFINITY, f64::min);
    scale.least = least as f32;
    if (scale.least as f64) < least {
        scale.least = scale.least.next_up();
    }
    Ok(DensityScores { source: ratios.into_iter().map(|rho| scale.score(rho)).collect(), scale })
}

/// The scores of rows that are in neither set (generated rows), on the `scale` of the source rows. A ρ below the
/// smallest one of the source rows is replaced by that one, so such a row has score 1.
///
/// # Errors
/// [`DataError::Interrupted`].
///
/// # Panics
/// As [`density_scores`].
pub fn further_scores(
    rows: &Rows<'_>,
    source: &Rows<'_>,
    target: &Rows<'_>,
    scale: &DensityScale,
    options: &DensityOptions,
    streams: &Streams,
) -> Result<Vec<f32>, DataError> {
    let reference = Reference::draw(source, options, streams);
    let points = Rows::new(&reference.points, source.dim());
    let points = if reference.indices.is_none() { source } else { &points };
    let to_target = nn_distances(rows, target, &at(options.neighbour))?;
    let to_source = nn_distances(rows, points, &at(options.neighbour))?;
    Ok(scale.ratios(&to_target, &to_source, options.squared).map(|rho| scale.score(rho)).collect())
}

fn at(k: usize) -> NeighbourOptions {
    NeighbourOptions { units: Units::Raw, k }
}

/// The smallest distance that is not 0; 1 if all are 0.
fn floor(distances: &[f32]) -> f32 {
    let least = distances.iter().filter(|d| **d > 0.0).fold(f32::INFINITY, |a, &b| a.min(b));
    if least.is_finite() { least } else { 1.0 }
}

impl DensityScale {
    fn ratios<'a>(&self, to_target: &'a [f32], to_source: &'a [f32], squared: bool) -> impl Iterator<Item = f64> + 'a {
        let (target_floor, source_floor) = (self.target_floor, self.source_floor);
        let factor = if squared { 2.0 } else { 1.0 };
        let log = |d: f32, floor: f32| (d.max(floor) as f64).ln();
        to_target.iter().zip(to_source).map(move |(&t, &s)| factor * (log(t, target_floor) - log(s, source_floor)))
    }

    fn score(&self, rho: f64) -> f32 {
        (1.0 / (1.0 + (rho - self.least as f64).max(0.0))) as f32
    }
}

/// The source rows that represent the whole source.
struct Reference {
    /// Row-major; empty if all rows are used unchanged.
    points: Vec<f32>,
    /// Their indices, ascending; `None`: all rows.
    indices: Option<Vec<usize>>,
}

impl Reference {
    fn draw(source: &Rows<'_>, options: &DensityOptions, streams: &Streams) -> Self {
        let n = source.len();
        if n <= options.reference {
            return Self { points: Vec::new(), indices: None };
        }
        let indices = choose(&mut streams.stream("density/reference"), n, options.reference);
        let mut points = vec![0.0; indices.len() * source.dim()];
        points.chunks_exact_mut(source.dim()).zip(&indices).for_each(|(point, &i)| source.copy_row(i, point));
        Self { points, indices: Some(indices) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_base::random::fill_normal;

    fn normal(name: &str, rows: usize, dim: usize, mean: f32, std: f32) -> Vec<f32> {
        let mut x = vec![0.0; rows * dim];
        fill_normal(&mut Streams::new(3).stream(name), &mut x);
        x.iter_mut().for_each(|x| *x = mean + std * *x);
        x
    }

    /// ρ of every row of `rows` by comparing all pairs. `own`: the index of row 0 in the source, or `None`.
    fn brute(rows: &[f32], source: &[f32], target: &[f32], dim: usize, k: usize) -> Vec<f64> {
        let kth = |x: &[f32], set: &[f32]| {
            let square = |y: &[f32]| x.iter().zip(y).map(|(a, b)| (*a as f64 - *b as f64).powi(2)).sum::<f64>();
            let mut all: Vec<f64> = set.chunks_exact(dim).map(square).collect();
            all.sort_by(f64::total_cmp);
            all[k - 1]
        };
        rows.chunks_exact(dim).map(|x| kth(x, target).ln() - kth(x, source).ln()).collect()
    }

    #[test]
    fn scores_equal_those_of_all_pairs() {
        let (source, target) = (normal("s", 400, 3, 0.0, 1.0), normal("t", 60, 3, 1.0, 0.5));
        let (s, t) = (Rows::new(&source, 3), Rows::new(&target, 3));
        let (options, streams) = (DensityOptions::default(), Streams::new(0));
        let scores = density_scores(&s, &t, &options, &streams).unwrap();
        let rho = brute(&source, &source, &target, 3, 5);
        let least = rho.iter().copied().fold(f64::INFINITY, f64::min);
        for (score, rho) in scores.source.iter().zip(&rho) {
            assert!((*score as f64 - 1.0 / (1.0 + rho - least)).abs() < 1e-6, "{score} {rho}");
        }
        assert_eq!(scores.source.iter().copied().fold(0.0, f32::max), 1.0);

        // Without squares ρ is half as large.
        let plain = DensityOptions { squared: false, ..options };
        let plain = density_scores(&s, &t, &plain, &streams).unwrap();
        for (a, b) in scores.source.iter().zip(&plain.source) {
            assert!(((1.0 / a - 1.0) - 2.0 * (1.0 / b - 1.0)).abs() < 1e-4);
        }

        // Further rows do not find themselves. Rows more target-like than the best source row get its score.
        let more = normal("more", 50, 3, 0.5, 1.0);
        let further = further_scores(&Rows::new(&more, 3), &s, &t, &scores.scale, &options, &streams).unwrap();
        for (score, rho) in further.iter().zip(brute(&more, &source, &target, 3, 5)) {
            assert!((*score as f64 - 1.0 / (1.0 + (rho - least).max(0.0))).abs() < 1e-6);
        }
    }

    /// Source N(0, I), target N(1, ¼ I) in the plane. The true ln(p_tar / p_src) is known. Thinning may only shift ln
    /// d_k by ln(n / m) / 2 in the plane, the same for all rows.
    #[test]
    fn a_thinned_source_shifts_all_ratios_by_one_constant() {
        let (n, dim) = (20_000, 2);
        let (source, target) = (normal("s", n, dim, 0.0, 1.0), normal("t", 2000, dim, 1.0, 0.5));
        let (s, t) = (Rows::new(&source, dim), Rows::new(&target, dim));
        let rho = |reference: usize| {
            let options = DensityOptions { neighbour: 10, reference, squared: false };
            let scores = density_scores(&s, &t, &options, &Streams::new(0)).unwrap();
            let rho: Vec<f64> =
                scores.source.iter().map(|&v| 1.0 / v as f64 - 1.0 + scores.scale.least as f64).collect();
            rho
        };
        let (exact, thinned) = (rho(n), rho(n / 8));
        // Only rows with close neighbours: within two of the source's standard deviations.
        let inner: Vec<usize> = (0..n).filter(|&i| source[2 * i..2 * i + 2].iter().all(|x| x.abs() < 2.0)).collect();
        let moments = |values: &[f64]| {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt())
        };
        let shift: Vec<f64> = inner.iter().map(|&i| exact[i] - thinned[i]).collect();
        let (mean, std) = moments(&shift);
        assert!((mean - 8f64.ln() / dim as f64).abs() < 0.06, "{mean} instead of {}", 8f64.ln() / dim as f64);
        // Each row has the noise of a 10th neighbour, once in each estimate: √(2 ψ'(10)) / 2 = .23.
        assert!(std < 0.25, "{std}");

        // Both estimate the true ratio, −ln(p_tar / p_src) / 2 up to a constant.
        let truth = |i: usize| -> f64 {
            let x = &source[2 * i..2 * i + 2];
            x.iter().map(|&x| (x as f64 - 1.0).powi(2) / 0.25 / 2.0 - (x as f64).powi(2) / 2.0).sum::<f64>() / 2.0
        };
        for rho in [&exact, &thinned] {
            let near: Vec<usize> = inner.iter().copied().filter(|&i| truth(i) < 1.0).collect();
            let error: Vec<f64> = near.iter().map(|&i| rho[i] - truth(i)).collect();
            assert!(moments(&error).1 < 0.3, "{:?}", moments(&error));
        }
    }

    #[test]
    fn a_row_is_its_own_neighbour_once_wherever_it_was_drawn() {
        let source = normal("s", 600, 2, 0.0, 1.0);
        let (s, t) = (Rows::new(&source, 2), Rows::new(&source, 2));
        // With all rows but one in the reference, a score must not depend on whether the row is in it.
        let exact = DensityOptions { reference: 600, ..DensityOptions::default() };
        let thin = DensityOptions { reference: 599, ..exact };
        let [a, b] = [exact, thin].map(|o| density_scores(&s, &t, &o, &Streams::new(1)).unwrap());
        assert!(a.source.iter().all(|&score| score == 1.0), "the same set twice: every ratio is 0");
        let changed = b.source.iter().filter(|&&score| score != b.source[0]).count();
        assert!(changed < 20, "one row less concerns the few that are next to it: {changed}");
    }

    #[test]
    fn copies_have_finite_scores_and_threads_do_not_matter() {
        let mut source = normal("s", 3000, 3, 0.0, 1.0);
        for i in 1..20 {
            source.copy_within(0..3, 3 * i);
        }
        let target = source[..90].to_vec();
        let options = DensityOptions { reference: 1000, ..DensityOptions::default() };
        let run = || {
            let (s, t) = (Rows::new(&source, 3), Rows::new(&target, 3));
            density_scores(&s, &t, &options, &Streams::new(1)).unwrap()
        };
        let pool = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        let scores = pool(1).install(run);
        assert_eq!(scores, pool(2).install(run));
        assert!(scores.source.iter().all(|s| *s > 0.0 && *s <= 1.0));
    }
}
