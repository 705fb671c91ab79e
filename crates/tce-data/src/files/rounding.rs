//! Float64 columns whose steps float32 does not hold: coordinates and clocks that are far from zero.
//!
//! Float32 has 24 bits. A coordinate of 5.4e6 m is rounded to half a metre, however short its steps are. Columns near
//! zero are left out: where they stand still, their steps are the noise of a simulator, and nothing would save those.

use super::rows::listed;

/// Spreads from zero at which a column is far from it.
const FAR: f64 = 30.0;
/// The smallest rounding error that is told, in units of a usual step.
const TOLD: f32 = 0.01;

/// Of each column, whether it is far from zero. (The parallel moments of large tables would be slow here: an episode is
/// a small table, and there may be thousands.)
fn far(data: &[f32], dim: usize) -> Vec<bool> {
    let rows = || data.chunks_exact(dim);
    let share = 1.0 / rows().len().max(1) as f64;
    let (mut mean, mut square) = (vec![0f64; dim], vec![0f64; dim]);
    for row in rows() {
        mean.iter_mut().zip(row).for_each(|(mean, &x)| *mean += share * f64::from(x));
    }
    for row in rows() {
        let columns = square.iter_mut().zip(&mean).zip(row);
        columns.for_each(|((square, mean), &x)| *square += share * (f64::from(x) - mean).powi(2));
    }
    mean.iter().zip(&square).map(|(mean, square)| mean.abs() > FAR * square.sqrt()).collect()
}

/// Whether some column is far from zero, so that [`losses`] has to look at the stored numbers.
pub(super) fn is_doubtful(data: &[f32], dim: usize) -> bool {
    far(data, dim).contains(&true)
}

/// Of each column, the median rounding error in units of the median step; 0 for columns near zero and for constants.
/// `stored` are the first rows of `data` as the file has them.
pub(super) fn losses(stored: &[f64], data: &[f32], dim: usize) -> Vec<f32> {
    let far = far(data, dim);
    let loss = |k: usize| {
        if !far[k] {
            return 0.0;
        }
        let column = || stored.iter().skip(k).step_by(dim);
        let rounded = data.iter().skip(k).step_by(dim);
        let error = median(column().zip(rounded).map(|(x, &y)| (x - f64::from(y)).abs()));
        let step = median(column().zip(column().skip(1)).map(|(a, b)| (b - a).abs()).filter(|&step| step > 0.0));
        error.zip(step).map_or(0.0, |(error, step)| (error / step) as f32)
    };
    (0..dim).map(loss).collect()
}

/// The warning about the columns of `data` with such losses.
pub(super) fn told_losses(field: &str, losses: &[f32], data: &[f32], dim: usize) -> Option<String> {
    // Looked at first, because it is quick.
    if losses.iter().all(|&loss| loss <= TOLD) {
        return None;
    }
    let far = far(data, dim);
    let columns: Vec<usize> = (0..dim).filter(|&k| far[k] && losses[k] > TOLD).collect();
    (!columns.is_empty()).then(|| {
        format!(
            "`{field}`: float32 rounds {} by more than 1 % of a usual step, because the numbers are far from zero: subtract an offset from them \
             (the same one from s and s'), and write the file again",
            listed("column", &columns)
        )
    })
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Columns: metres far from the origin, a clock, whole numbers, a constant, numbers near zero, a slow column that
    /// float32 holds, and noise around a position near zero.
    #[test]
    fn columns_that_lose_their_steps_are_found() {
        let row = |i: usize| {
            let t = i as f64;
            let jitter = if i.is_multiple_of(2) { 1e-9 } else { 0.0 };
            [
                5.4e6 + 0.01 * t,
                1.7e9 + 0.001 * t,
                5.4e6 + t,
                5.4e6 + 0.1,
                t.sin(),
                100.0 + 0.001 * t,
                jitter + (t / 500.0).floor(),
            ]
        };
        let stored: Vec<f64> = (0..1000).flat_map(row).collect();
        let data: Vec<f32> = stored.iter().map(|&x| x as f32).collect();
        assert!(is_doubtful(&data, 7));
        let losses = losses(&stored, &data, 7);
        // A quarter of float32's unit (.5) in the metres' first steps of .01.
        assert!((10.0..15.0).contains(&losses[0]) && losses[1] > 100.0, "{losses:?}");
        assert_eq!((losses[2], losses[3], losses[4], losses[6]), (0.0, 0.0, 0.0, 0.0));
        assert!(losses[5] > 0.0 && losses[5] < TOLD, "{losses:?}");
        let told = told_losses("observations", &losses, &data, 7).unwrap();
        assert!(told.starts_with("`observations`: float32 rounds columns 0 and 1 by more than 1 %"), "{told}");
        assert_eq!(told_losses("observations", &[0.0; 7], &data, 7), None);
        assert!(!is_doubtful(&[-1.0, 0.0, 1.0], 1));
    }
}
