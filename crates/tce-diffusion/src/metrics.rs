//! How far two sets of rows are from each other.

use rayon::prelude::*;
use tce_base::{Streams, random::fill_normal};

/// Sliced Wasserstein-1 distance: the mean of [`wasserstein`] over `projections` random unit directions, drawn from
/// `streams` (`metrics/projections`). Rows are row-major of width `dims`; the sets may differ in size.
///
/// # Panics
/// If a set is empty or of another width, or `projections` is 0.
pub fn sliced_wasserstein(a: &[f32], b: &[f32], dims: usize, projections: usize, streams: &Streams) -> f64 {
    assert!(projections > 0 && dims > 0, "at least one direction");
    for rows in [a, b] {
        assert!(!rows.is_empty() && rows.len().is_multiple_of(dims), "{} numbers are no rows of {dims}", rows.len());
    }
    let distances: Vec<f64> = (0..projections)
        .into_par_iter()
        .map(|i| {
            let mut direction = vec![0.0; dims];
            fill_normal(&mut streams.indexed("metrics/projections", i as u64), &mut direction);
            let norm = direction.iter().map(|v| v * v).sum::<f32>().sqrt();
            let project = |rows: &[f32]| -> Vec<f32> {
                rows.chunks_exact(dims)
                    .map(|row| row.iter().zip(&direction).map(|(x, u)| x * u).sum::<f32>() / norm)
                    .collect()
            };
            wasserstein(project(a), project(b))
        })
        .collect();
    distances.iter().sum::<f64>() / projections as f64
}

/// Wasserstein-1 distance of two sets of numbers, ∫ |F_a⁻¹(u) − F_b⁻¹(u)| du over the empirical quantile functions.
///
/// # Panics
/// If one of them is empty.
pub fn wasserstein(mut a: Vec<f32>, mut b: Vec<f32>) -> f64 {
    assert!(!a.is_empty() && !b.is_empty(), "a distance needs two sets");
    a.sort_unstable_by(f32::total_cmp);
    b.sort_unstable_by(f32::total_cmp);
    let (n, m) = (a.len() as u64, b.len() as u64);
    // Quantile levels in units of 1 / (n m), so that the merge of the two step functions is exact.
    let (mut i, mut j, mut at, mut sum) = (0, 0, 0u64, 0.0);
    while i < n && j < m {
        let until = ((i + 1) * m).min((j + 1) * n);
        sum += (until - at) as f64 * (a[i as usize] as f64 - b[j as usize] as f64).abs();
        at = until;
        i += u64::from(at == (i + 1) * m);
        j += u64::from(at == (j + 1) * n);
    }
    sum / (n * m) as f64
}

/// Standard deviation of each dimension of `rows` over that of `reference`; NaN where the reference has none.
///
/// # Panics
/// If a set is empty or of another width.
pub fn std_ratios(rows: &[f32], reference: &[f32], dims: usize) -> Vec<f64> {
    let std = |rows: &[f32]| -> Vec<f64> {
        assert!(!rows.is_empty() && rows.len().is_multiple_of(dims), "{} numbers are no rows of {dims}", rows.len());
        let n = (rows.len() / dims) as f64;
        let moment = |f: &dyn Fn(usize, f64) -> f64| {
            let mut sum = vec![0.0; dims];
            for row in rows.chunks_exact(dims) {
                row.iter().enumerate().for_each(|(d, v)| sum[d] += f(d, *v as f64));
            }
            sum.iter().map(|s| s / n).collect::<Vec<_>>()
        };
        let mean = moment(&|_, v| v);
        moment(&|d, v| (v - mean[d]).powi(2)).iter().map(|v| v.sqrt()).collect()
    };
    std(rows).iter().zip(std(reference)).map(|(a, b)| if b > 0.0 { a / b } else { f64::NAN }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn closed_forms() {
        assert_eq!(wasserstein(vec![0.0, 1.0], vec![3.0, 2.0]), 2.0);
        // Quantiles 0, 0, 0 | 1, 1, 1 against 0, 0 | 1, 1 | 2, 2 in sixths.
        assert!((wasserstein(vec![0.0, 1.0], vec![2.0, 0.0, 1.0]) - (1.0 + 2.0) / 6.0).abs() < 1e-12);
        assert_eq!(std_ratios(&[0.0, 5.0, 4.0, 5.0], &[1.0, 0.0, 2.0, 1.0], 2), [4.0, 0.0]);
        // A shift by t: E|t·u| over unit directions u; for 2 dimensions 2 |t| / π.
        let a: Vec<f32> = (0..200).map(|v| v as f32 * 0.01).collect();
        let b: Vec<f32> = a.iter().enumerate().map(|(i, v)| if i % 2 == 0 { v + 3.0 } else { *v }).collect();
        let distance = sliced_wasserstein(&a, &b, 2, 4096, &Streams::new(1));
        assert!((distance - 6.0 / std::f64::consts::PI).abs() < 0.05, "{distance}");
        assert_eq!(sliced_wasserstein(&a, &a, 2, 8, &Streams::new(1)), 0.0);
    }

    proptest! {
        /// Repeating every number changes no distribution.
        #[test]
        fn sizes_do_not_matter(a in prop::collection::vec(-5f32..5.0, 1..20), b in prop::collection::vec(-5f32..5.0, 1..20), k in 1usize..4) {
            let repeated = a.iter().flat_map(|&v| std::iter::repeat_n(v, k)).collect();
            let (x, y) = (wasserstein(a.clone(), b.clone()), wasserstein(repeated, b.clone()));
            prop_assert!((x - y).abs() < 1e-9);
            prop_assert!((x - wasserstein(b, a)).abs() < 1e-9);
        }
    }
}
