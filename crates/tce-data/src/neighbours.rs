//! Exact nearest-neighbour distances from many source rows to a few thousand target rows (Eq. 9).
//!
//! For every pair, a blocked matrix product gives a *lower bound* of |x - y|² - |x|² that accounts for its own
//! rounding. The few pairs whose lower bound is below the best upper bound are then measured exactly. So the result
//! equals that of comparing all pairs in f64, whatever the offset of the data, at the speed of the product.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_base::{Interrupted, Progress};

use crate::moments::Moments;
use crate::product::Transposed;
use crate::{DataError, Rows, Standardizer};

/// Source rows and target rows per product. The tile (half a mebibyte) fits into the second-level cache.
const ROWS: usize = 256;
const TILE: usize = 512;
/// Above this squared norm, float32 products may overflow. Such rows are compared exactly with all others.
const HUGE: f64 = 1e30;

/// The units of the distances.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Units {
    /// Stored units: Eq. 9 of the paper. Velocities dominate.
    #[default]
    Raw,
    /// Every dimension divided by its std over source and target rows together (see [`Standardizer`]). With the std of
    /// the target alone, a joint that only the target blocks would dominate the distance.
    Standardised,
}

/// See [`nn_distances`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NeighbourOptions {
    /// Units of the distance.
    pub units: Units,
    /// k: distances are measured to the k-th nearest target row; 1 is the nearest.
    pub k: usize,
}

impl Default for NeighbourOptions {
    fn default() -> Self {
        Self { units: Units::Raw, k: 1 }
    }
}

/// The L2 distance of every source row to its (k-th) nearest target row, `[source.len()]`.
///
/// Exact: differences and sums in f64, rounded to f32 once. Independent of the number of threads. Memory in addition to
/// the result: one copy of the target rows, and a megabyte per thread.
///
/// # Errors
/// [`DataError::Interrupted`].
///
/// # Panics
/// If the dimensions differ, or the target has fewer than `k` rows. Coordinates must be finite.
pub fn nn_distances(source: &Rows<'_>, target: &Rows<'_>, options: &NeighbourOptions) -> Result<Vec<f32>, DataError> {
    assert_eq!(source.dim(), target.dim(), "source and target have different dimensions");
    assert!((1..=target.len()).contains(&options.k), "no {}-th neighbour among {} rows", options.k, target.len());
    let search = Search::new(source, target, options);
    let progress = (source.len() >= 100_000).then(|| Progress::new("nearest neighbours", source.len() as u64, "rows"));
    let mut out = vec![0.0f32; source.len()];
    out.par_chunks_mut(ROWS).enumerate().try_for_each_init(Scratch::default, |scratch, (b, out)| {
        if tce_base::interrupted() {
            return Err(DataError::from(Interrupted::nothing_kept()));
        }
        search.block(source, b * ROWS, out, scratch);
        if let Some(p) = &progress {
            p.inc(out.len() as u64);
        }
        Ok(())
    })?;
    if let Some(p) = progress {
        p.finish();
    }
    Ok(out)
}

/// The source rows selected by Eq. 9: the `round(lambda * N)` smallest distances, ties broken by row, in row order.
///
/// # Panics
/// If `lambda` is not in [0, 1].
pub fn lambda_quantile_select(distances: &[f32], lambda: f64) -> Vec<usize> {
    assert!((0.0..=1.0).contains(&lambda), "lambda = {lambda} is not a share");
    let keep = (lambda * distances.len() as f64).round() as usize;
    let mut order: Vec<usize> = (0..distances.len()).collect();
    if keep < order.len() {
        order.select_nth_unstable_by(keep, |&a, &b| distances[a].total_cmp(&distances[b]).then(a.cmp(&b)));
        order.truncate(keep);
    }
    order.sort_unstable();
    order
}

struct Search {
    /// Dimensions that vary; the others contribute nothing to any distance.
    live: Vec<usize>,
    centre: Vec<f64>,
    scale: Vec<f64>,
    /// Target rows, live dimensions, as stored: `[len, live]`.
    exact: Vec<f32>,
    /// Target rows, centred and scaled, with |y|² as the last coordinate.
    tiles: Transposed,
    norms: Vec<f64>,
    /// Relative rounding error of a lower bound.
    slack: f64,
    any_huge: bool,
    k: usize,
}

#[derive(Default)]
struct Scratch {
    raw: Vec<f32>,
    rows: Vec<f32>,
    points: Vec<f32>,
    bounds: Vec<f32>,
    best: Vec<Best>,
}

/// What is known about one source row during the search.
#[derive(Default, Clone)]
struct Best {
    /// |x|² of the centred and scaled row.
    norm: f64,
    /// The k smallest upper bounds so far, ascending.
    upper: Vec<f32>,
    /// Target rows that may be among the k nearest, with their lower bounds.
    candidates: Vec<(u32, f32)>,
}

impl Search {
    fn new(source: &Rows<'_>, target: &Rows<'_>, options: &NeighbourOptions) -> Self {
        let pooled = Moments::of(&[source.clone(), target.clone()]);
        let live: Vec<usize> = (0..source.dim()).filter(|&d| pooled.std[d] > 0.0).collect();
        let std = match options.units {
            Units::Raw => vec![1.0; source.dim()],
            Units::Standardised => Standardizer::fit_on(&[source.clone(), target.clone()]).std,
        };
        let scale: Vec<f64> = live.iter().map(|&d| 1.0 / std[d] as f64).collect();
        let centre: Vec<f64> = live.iter().map(|&d| pooled.mean[d]).collect();
        let width = live.len() + 1;
        let mut search = Self {
            slack: (width as f64 + 16.0) * 2f64.powi(-24),
            exact: Vec::with_capacity(target.len() * live.len()),
            tiles: Transposed { data: Vec::new(), len: 0, dim: width },
            norms: Vec::with_capacity(target.len()),
            any_huge: false,
            k: options.k,
            live,
            centre,
            scale,
        };
        let mut raw = vec![0.0; target.dim()];
        let mut points = vec![0.0f32; target.len() * width];
        for (j, point) in points.chunks_exact_mut(width).enumerate() {
            target.copy_row(j, &mut raw);
            search.exact.extend(search.live.iter().map(|&d| raw[d]));
            let norm = search.prepare(&raw, point);
            // The product with x extended by 1 gives -2xy + |y|², minus its largest possible rounding error.
            point[width - 1] = (-0.5 * norm * (1.0 - 2.0 * search.slack)) as f32;
            search.norms.push(norm);
            search.any_huge |= norm > HUGE;
        }
        search.tiles = Transposed::from_rows(&points, width);
        search
    }

    /// Centres and scales the live dimensions of `raw` into `point`; returns the squared norm.
    fn prepare(&self, raw: &[f32], point: &mut [f32]) -> f64 {
        let mut norm = 0.0;
        for (i, &d) in self.live.iter().enumerate() {
            let x = (raw[d] as f64 - self.centre[i]) * self.scale[i];
            norm += x * x;
            point[i] = x as f32;
        }
        norm
    }

    fn block(&self, source: &Rows<'_>, first: usize, out: &mut [f32], s: &mut Scratch) {
        let (live, width) = (self.live.len(), self.live.len() + 1);
        s.raw.resize(source.dim(), 0.0);
        s.rows.resize(ROWS * live, 0.0);
        s.points.resize(ROWS * width, 0.0);
        s.bounds.resize(ROWS * TILE, 0.0);
        s.best.resize(ROWS, Best::default());
        for i in 0..out.len() {
            source.copy_row(first + i, &mut s.raw);
            for (to, &d) in s.rows[i * live..(i + 1) * live].iter_mut().zip(&self.live) {
                *to = s.raw[d];
            }
            let point = &mut s.points[i * width..(i + 1) * width];
            s.best[i].norm = self.prepare(&s.raw, point);
            point[width - 1] = 1.0;
            s.best[i].upper.clear();
            s.best[i].upper.resize(self.k, f32::INFINITY);
            s.best[i].candidates.clear();
        }
        for tile in (0..self.norms.len()).step_by(TILE) {
            let count = TILE.min(self.norms.len() - tile);
            self.tiles.dot(&s.points[..out.len() * width], tile, count, -2.0, &mut s.bounds);
            for (best, lower) in s.best.iter_mut().zip(s.bounds.chunks_exact(count)).take(out.len()) {
                if minimum(lower) <= best.upper[self.k - 1] {
                    self.offer(best, tile, lower);
                }
            }
        }
        for (i, distance) in out.iter_mut().enumerate() {
            *distance = self.exact_distance(&s.rows[i * live..(i + 1) * live], &mut s.best[i]);
        }
    }

    /// Keeps the rows of a tile that may be among the nearest, and tightens the upper bound.
    fn offer(&self, best: &mut Best, tile: usize, lower: &[f32]) {
        for (j, &low) in lower.iter().enumerate() {
            if low <= best.upper[self.k - 1] {
                best.candidates.push(((tile + j) as u32, low));
                // `low` lacks |x|² and its share of the rounding error. Both are the same for the whole row and are
                // added here. The last term covers products that underflow.
                let error = 4.0 * self.slack * (best.norm + self.norms[tile + j]) + 1e-30;
                let high = ((low as f64 + error) as f32).next_up();
                let at = best.upper.partition_point(|&u| u <= high);
                if at < self.k {
                    best.upper.pop();
                    best.upper.insert(at, high);
                }
            }
        }
    }

    fn exact_distance(&self, row: &[f32], best: &mut Best) -> f32 {
        let live = self.live.len();
        let square = |j: usize| -> f64 {
            let y = &self.exact[j * live..(j + 1) * live];
            row.iter().zip(y).zip(&self.scale).map(|((&x, &y), s)| ((x as f64 - y as f64) * s).powi(2)).sum()
        };
        let limit = best.upper[self.k - 1];
        let mut squares: Vec<f64> = if self.any_huge || best.norm > HUGE {
            (0..self.norms.len()).map(square).collect()
        } else {
            best.candidates.iter().filter(|c| c.1 <= limit).map(|c| square(c.0 as usize)).collect()
        };
        let (_, kth, _) = squares.select_nth_unstable_by(self.k - 1, f64::total_cmp);
        kth.sqrt() as f32
    }
}

/// The smallest of `values`, written so that the compiler uses SIMD minima.
fn minimum(values: &[f32]) -> f32 {
    let mut lanes = [f32::INFINITY; 16];
    let chunks = values.chunks_exact(16);
    let rest = chunks.remainder();
    for chunk in chunks {
        for (m, &v) in lanes.iter_mut().zip(chunk) {
            *m = if v < *m { v } else { *m };
        }
    }
    lanes.iter().chain(rest).fold(f32::INFINITY, |m, &v| if v < m { v } else { m })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::RngExt;
    use tce_base::Streams;

    /// Compares all pairs in f64, from the definition.
    fn brute(source: &[f32], target: &[f32], dim: usize, k: usize, scale: &[f64]) -> Vec<f32> {
        let row = |x: &[f32]| {
            let mut all: Vec<f64> = target
                .chunks_exact(dim)
                .map(|y| (0..dim).map(|d| ((x[d] as f64 - y[d] as f64) * scale[d]).powi(2)).sum())
                .collect();
            all.sort_by(f64::total_cmp);
            all[k - 1].sqrt() as f32
        };
        source.chunks_exact(dim).map(row).collect()
    }

    fn distances(source: &[f32], target: &[f32], dim: usize, options: NeighbourOptions) -> Vec<f32> {
        nn_distances(&Rows::new(source, dim), &Rows::new(target, dim), &options).unwrap()
    }

    /// Different summation orders of the same f64 terms may change the last bit of the f32.
    fn same(a: &[f32], b: &[f32]) -> bool {
        a.len() == b.len() && a.iter().zip(b).all(|(x, y)| (x - y).abs() <= 2e-7 * y.abs())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        /// Any offset (cancellation), any scale, more rows than a block and a tile, k up to 5, constant dimensions.
        #[test]
        fn equals_brute_force(
            seed in 0u64..1000, n in 1usize..600, m in 5usize..700, dim in 1usize..12,
            offset in prop_oneof![Just(0f32), Just(1e3), Just(-1e6)], spread in prop_oneof![Just(1f32), Just(1e-3), Just(1e12)], k in 1usize..=5,
        ) {
            let mut rng = Streams::new(seed).stream("points");
            let mut draw = |rows: usize| -> Vec<f32> {
                (0..rows * dim).map(|i| if i % dim == 3 { 7.0 } else { offset + spread * rng.random_range(-1.0f32..1.0) }).collect()
            };
            let (source, target) = (draw(n), draw(m));
            let got = distances(&source, &target, dim, NeighbourOptions { k, units: Units::Raw });
            prop_assert!(same(&got, &brute(&source, &target, dim, k, &vec![1.0; dim])));
        }
    }

    #[test]
    fn a_copy_has_distance_zero_and_overflowing_rows_are_exact() {
        let mut rng = Streams::new(1).stream("points");
        let mut target: Vec<f32> = (0..4000).map(|_| 1e4 + rng.random_range(-1.0f32..1.0)).collect();
        let mut source = target[400..800].to_vec();
        assert!(distances(&source, &target, 8, NeighbourOptions::default()).iter().all(|&d| d == 0.0));
        source[3] = 3e30;
        target[11] = -1e25;
        let want = brute(&source, &target, 8, 1, &[1.0; 8]);
        assert!(same(&distances(&source, &target, 8, NeighbourOptions::default()), &want));
    }

    #[test]
    fn standardised_units_divide_by_the_pooled_spread() {
        let mut rng = Streams::new(2).stream("points");
        let mut draw = |n: usize| -> Vec<f32> {
            (0..n * 3).map(|i| [1.0, 100.0, 0.01][i % 3] * rng.random_range(-1.0f32..1.0)).collect()
        };
        let (source, target) = (draw(300), draw(200));
        let s = Standardizer::fit(&[&source[..], &target[..]].concat(), 3);
        let scale: Vec<f64> = s.std.iter().map(|&x| 1.0 / x as f64).collect();
        let options = NeighbourOptions { units: Units::Standardised, k: 1 };
        let got = distances(&source, &target, 3, options);
        let want = brute(&source, &target, 3, 1, &scale);
        assert!(got.iter().zip(&want).all(|(a, b)| (a - b).abs() <= 1e-6 * b), "pooled std from one or two tables");
    }

    #[test]
    fn one_thread_gives_the_same_bytes() {
        let mut rng = Streams::new(3).stream("points");
        let points: Vec<f32> = (0..30_000).map(|_| rng.random_range(-1.0f32..1.0)).collect();
        let run = || distances(&points[..24_000], &points[24_000..], 6, NeighbourOptions::default());
        let pool = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        assert_eq!(pool(1).install(run), pool(2).install(run));
    }

    #[test]
    fn the_quantile_keeps_exactly_its_share_with_ties_by_row() {
        let d = [3.0, 1.0, 2.0, 1.0, 1.0];
        assert_eq!(lambda_quantile_select(&d, 0.4), [1, 3]);
        assert_eq!(lambda_quantile_select(&d, 0.5), [1, 3, 4], "2.5 rounds to 3");
        assert_eq!(lambda_quantile_select(&d, 0.0), [0usize; 0]);
        assert_eq!(lambda_quantile_select(&d, 1.0), [0, 1, 2, 3, 4]);
    }
}
