//! Many numbers as few.

use serde::{Deserialize, Serialize};

/// Mean, median and the 10th and 90th percentile of the finite ones among some numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// How many finite numbers.
    pub count: usize,
    /// How many that are not finite: states in which the physics blew up, say.
    pub lost: usize,
    /// Mean.
    pub mean: f64,
    /// 10th percentile.
    pub p10: f64,
    /// Median.
    pub median: f64,
    /// 90th percentile.
    pub p90: f64,
}

impl Spread {
    /// Of `values`; None where none is finite.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let all: Vec<f64> = values.into_iter().collect();
        let mut finite: Vec<f64> = all.iter().copied().filter(|v| v.is_finite()).collect();
        finite.sort_by(f64::total_cmp);
        let last = finite.len().checked_sub(1)?;
        let at = |q: f64| finite[(last as f64 * q).round() as usize];
        Some(Self {
            count: finite.len(),
            lost: all.len() - finite.len(),
            mean: finite.iter().sum::<f64>() / finite.len() as f64,
            p10: at(0.1),
            median: at(0.5),
            p90: at(0.9),
        })
    }
}

/// Counts in bins of equal width.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Histogram {
    /// Where the first bin begins.
    pub low: f64,
    /// Where the last one ends.
    pub high: f64,
    /// Numbers in each bin; those outside are in the first and the last one.
    pub counts: Vec<u64>,
}

impl Histogram {
    /// Counts `values` in `bins` bins from `low` to `high`; NaN are left out.
    ///
    /// # Panics
    /// If there is no bin, or no width.
    pub fn of(values: impl IntoIterator<Item = f64>, low: f64, high: f64, bins: usize) -> Self {
        assert!(bins > 0 && high > low, "a histogram from {low} to {high} in {bins} bins");
        let mut counts = vec![0; bins];
        for value in values.into_iter().filter(|v| !v.is_nan()) {
            let at = ((value - low) / (high - low) * bins as f64).floor().clamp(0.0, (bins - 1) as f64);
            counts[at as usize] += 1;
        }
        Self { low, high, counts }
    }
}

/// A share as whole percent; with a decimal near 0 and 100 %, and what would round to 0 said to be below 0.1 %.
pub fn percent(share: f64) -> String {
    let value = 100.0 * share;
    let near_an_end = (value > 0.0 && value < 9.95) || (99.0..100.0).contains(&value);
    if value > 0.0 && value < 0.05 {
        return "< 0.1 %".into();
    }
    if near_an_end { format!("{value:.1} %") } else { format!("{value:.0} %") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_of_known_numbers() {
        let spread = Spread::of((0..=100).map(f64::from).chain([f64::NAN, f64::INFINITY])).unwrap();
        let expected = Spread { count: 101, lost: 2, mean: 50.0, p10: 10.0, median: 50.0, p90: 90.0 };
        assert_eq!(spread, expected);
        assert_eq!(Spread::of([f64::NAN]), None);
        let bins = Histogram::of([0.0, 0.1, 0.5, 0.99, 1.0, -3.0, 7.0, f64::NAN], 0.0, 1.0, 2);
        assert_eq!(bins.counts, [3, 4]);
    }
}
