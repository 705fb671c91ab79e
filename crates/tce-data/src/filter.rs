//! Z-score filtering of generated rows (Eq. 8).

use crate::Rows;
use crate::moments::Moments;

/// Which rows satisfy |x_d - μ_d| <= z_th σ_d in every dimension d, with μ and σ (population) of `rows` themselves.
///
/// Dimensions of zero spread carry no information and are skipped. A row with NaN or infinity is never kept.
pub fn zscore_keep(rows: &Rows<'_>, z_th: f64) -> Vec<bool> {
    let m = Moments::of(std::slice::from_ref(rows));
    let mut row = vec![0.0f32; rows.dim()];
    (0..rows.len())
        .map(|i| {
            rows.copy_row(i, &mut row);
            row.iter()
                .enumerate()
                .all(|(d, &x)| x.is_finite() && (m.std[d] == 0.0 || (x as f64 - m.mean[d]).abs() <= z_th * m.std[d]))
        })
        .collect()
}

/// For every row, the largest |x_d - μ_d| / σ_d over the dimensions, with μ and σ as in [`zscore_keep`]; infinite for a
/// row with NaN or infinity.
pub fn largest_z(rows: &Rows<'_>) -> Vec<f64> {
    let m = Moments::of(std::slice::from_ref(rows));
    let mut row = vec![0.0f32; rows.dim()];
    let z = |(d, &x): (usize, &f32)| match m.std[d] {
        _ if !x.is_finite() => f64::INFINITY,
        0.0 => 0.0,
        std => (x as f64 - m.mean[d]).abs() / std,
    };
    let of = |i: usize| {
        rows.copy_row(i, &mut row);
        row.iter().enumerate().map(z).fold(0.0, f64::max)
    };
    (0..rows.len()).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_goes_when_any_dimension_is_out_and_dead_dimensions_do_not_count() {
        // 99 rows at ±1 and one at 50 in the second column; the third is constant.
        let mut data: Vec<f32> =
            (0..99).flat_map(|i| [(i % 3) as f32, if i % 2 == 0 { 1.0 } else { -1.0 }, 0.1]).collect();
        data.extend([1.0, 50.0, 0.1]);
        let keep = zscore_keep(&Rows::new(&data, 3), 3.0);
        assert_eq!(keep.iter().filter(|&&k| !k).count(), 1);
        assert!(!keep[99]);
    }

    /// Two points ±1 have σ = 1: the bound is inclusive.
    #[test]
    fn the_threshold_is_inclusive() {
        let data = [1.0, -1.0];
        assert_eq!(zscore_keep(&Rows::new(&data, 1), 1.0), [true, true]);
        assert_eq!(zscore_keep(&Rows::new(&data, 1), 0.999), [false, false]);
    }

    #[test]
    fn the_largest_z_is_what_the_filter_looks_at() {
        let data = [0.0, 1.0, 7.0, 2.0, -1.0, 7.0, 4.0, 0.0, 7.0];
        let rows = Rows::new(&data, 3);
        let z = largest_z(&rows);
        for z_th in [0.5, 1.0, 1.2, 1.23] {
            assert_eq!(zscore_keep(&rows, z_th), z.iter().map(|z| *z <= z_th).collect::<Vec<_>>());
        }
        // (0, 2, 4): mean 2, σ √(8/3).
        assert!((z[0] - 1.5f64.sqrt()).abs() < 1e-12);
        assert_eq!(largest_z(&Rows::new(&[1.0, f32::NAN], 1)), [0.0, f64::INFINITY]);
    }

    #[test]
    fn nan_is_never_kept() {
        assert_eq!(zscore_keep(&Rows::new(&[1.0, f32::NAN, 1.0], 1), 3.0), [true, false, true]);
    }
}
