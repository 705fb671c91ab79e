//! A method's scores on a task beside those of another one: how far they are apart, and whether that is shown.

use serde::Serialize;
use tce_base::mean_std;

/// Differences below so many points make no difference to anybody, however sure they are.
pub const LEAST: f64 = 1.0;
/// A difference is more than chance from so many standard errors on.
pub const SURE: f64 = 2.0;
/// With fewer seeds of either, the spread between seeds is not known well enough to be believed.
pub const ENOUGH: usize = 3;

/// The scores of a method on a task, one for each seed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Their mean.
    pub mean: f64,
    /// Their standard deviation, of a sample; None for one seed.
    pub std: Option<f64>,
    /// How many there are.
    pub seeds: usize,
}

impl Sample {
    /// Of scores; None where there are none.
    pub fn of(scores: &[f64]) -> Option<Self> {
        let (mean, std) = mean_std(scores);
        let seeds = scores.len();
        (seeds > 0).then_some(Self { mean, std: (seeds > 1).then_some(std), seeds })
    }

    /// Squared standard error of the mean; None for one seed.
    fn variance_of_mean(&self) -> Option<f64> {
        self.std.map(|s| s * s / self.seeds as f64)
    }
}

/// What a method does on a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Effect {
    /// It scores more: by more than [`SURE`] standard errors and at least [`LEAST`], with at least [`ENOUGH`] seeds of either.
    Helps,
    /// It scores less, likewise.
    Harms,
    /// The difference is smaller than its uncertainty, or than [`LEAST`].
    Open,
    /// The difference is larger, but there are fewer than [`ENOUGH`] seeds of one of them; or there is one, so that nobody knows how
    /// uncertain the difference is.
    FewSeeds,
}

impl Effect {
    /// All of them, in the order of tables.
    pub const ALL: [Self; 4] = [Effect::Helps, Effect::Harms, Effect::Open, Effect::FewSeeds];

    /// In print.
    pub fn word(self) -> &'static str {
        match self {
            Effect::Helps => "helps",
            Effect::Harms => "harms",
            Effect::Open => "no difference shown",
            Effect::FewSeeds => "too few seeds",
        }
    }
}

/// The difference of two methods on a task.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// How many points the method's mean is above the other's.
    pub points: f64,
    /// Standard error of that difference (Welch's); None with one seed of either.
    pub error: Option<f64>,
    /// The seeds of the one that has fewer.
    #[serde(skip)]
    pub seeds: usize,
    /// What that means.
    pub effect: Effect,
}

impl Difference {
    /// Of a method and the `other` that it is held against.
    pub fn between(method: &Sample, other: &Sample) -> Self {
        let points = method.mean - other.mean;
        let error = method.variance_of_mean().zip(other.variance_of_mean()).map(|(a, b)| (a + b).sqrt());
        let seeds = method.seeds.min(other.seeds);
        let effect = match error {
            None => Effect::FewSeeds,
            Some(e) if points.abs() <= SURE * e || points.abs() < LEAST => Effect::Open,
            Some(_) if seeds < ENOUGH => Effect::FewSeeds,
            Some(_) if points > 0.0 => Effect::Helps,
            Some(_) => Effect::Harms,
        };
        Self { points, error, seeds, effect }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_shown_by_its_error_its_size_and_its_seeds() {
        let of = |a: &[f64], b: &[f64]| Difference::between(&Sample::of(a).unwrap(), &Sample::of(b).unwrap());
        let base = [60.0, 62.0, 64.0];
        // Standard errors: sqrt(4 / 3) = 1.155 each, 1.633 together.
        let above = of(&[68.0, 70.0, 72.0], &base);
        assert_eq!((above.points, above.seeds, above.effect), (8.0, 3, Effect::Helps));
        assert!((above.error.unwrap() - (8.0f64 / 3.0).sqrt()).abs() < 1e-12);
        let effect = |a: &[f64], b: &[f64]| of(a, b).effect;
        assert_eq!(effect(&base, &[68.0, 70.0, 72.0]), Effect::Harms);
        assert_eq!(effect(&[61.0, 63.0, 65.0], &base), Effect::Open);
        // Sure, but too small for anybody; one point is enough.
        assert_eq!(effect(&[1.9, 1.9, 1.9], &[1.0, 1.0, 1.0]), Effect::Open);
        assert_eq!(effect(&[2.0, 2.0, 2.0], &[1.0, 1.0, 1.0]), Effect::Helps);
        // However large it is.
        assert_eq!(effect(&[90.0, 91.0], &base), Effect::FewSeeds);
        assert_eq!(effect(&[62.0, 63.0], &base), Effect::Open);
        assert_eq!((effect(&[62.0], &base), of(&[62.0], &base).error), (Effect::FewSeeds, None));
        assert_eq!(Sample::of(&[]), None);
    }
}
