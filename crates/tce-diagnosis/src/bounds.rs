//! Theorem 1 over λ, and the λ that it chooses.
//!
//! ```text
//! Eq. 3   2γ r_max / (1 − γ)² · (λ E[D_TV(P_src ‖ P_tar)] + (1 − λ) E[D_TV(P̂_tar ‖ P_tar)])
//! Eq. 4   γ / (1 − γ) · (λ E|E_src V(s') − E_tar V(s')| + (1 − λ) E|E_gen V(s') − E_tar V(s')|)
//! ```
//!
//! Both are a factor times λ d_source(λ) + (1 − λ) d_generated, with one discrepancy d per row. Source rows are either all of them (d does
//! not depend on λ) or the λ share nearest to the target (Eq. 9). The theorem's expectations are over ρ_mix; here the first is over the
//! source's rows and the second over the generated ones, where each of the two dynamics is used. In Eq. 4, E_gen V is V at the one ŝ' of the
//! row: its scatter counts as a discrepancy, so that d_generated is too large rather than too small.
//!
//! **The rule.** TCE leaves λ to the user: OG (λ = 0) ... NN. [`Choice::of`] takes the λ with the least bound, where d is measured by
//! models of the target rows alone, so that no environment is needed. Such a d is the row's distance from what a *model* says, and
//! the model is wrong too, most of all where the target has no rows: at the source's. With u an estimate of the model's own error,
//! the triangle inequality leaves d − u ... d + u for the true distance. Between the λ of places a < b of the grid the bounds
//! differ by
//!
//! ```text
//! bound(b) − bound(a) = (b − a) (d_between − d_generated)        d_between: rows nearer than b and not than a
//! ± (b − a) (u_between + u_generated + q √(se²_between + se²_generated))
//! ```
//!
//! and only a difference beyond its ± is told. The standard errors count trajectories and not rows: rows of one trajectory are alike. q is
//! Student's quantile at which nine comparisons that are all of equals tell a difference in about one of twenty cases (Bonferroni), with the
//! degrees of freedom of the fewer trajectories. The rule takes the smallest λ whose bound is not told from the least one; where that
//! is 0, and not every other λ is told to be worse, the data do not say, and 0 stands as the paper's default.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, StudentsT};

/// The λ at which curves are computed.
pub const GRID: [f64; 10] = [0.0, 0.025, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0];

/// The chance that one of the nine λ is told from the one that they are compared with, where all are equal.
const CHANCE: f64 = 0.05;

/// q for means of which the one with the fewest has `trajectories`.
fn quantile(trajectories: usize) -> f64 {
    let student = StudentsT::new(0.0, 1.0, trajectories as f64 - 1.0).expect("two trajectories at least");
    student.inverse_cdf(1.0 - CHANCE / (2 * (GRID.len() - 1)) as f64)
}

/// One discrepancy per row, and how wrong it may be.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rated {
    /// d
    pub gap: Vec<f64>,
    /// u of the same rows.
    pub doubt: Vec<f64>,
    /// The trajectory that each row is of.
    pub group: Vec<usize>,
}

impl Rated {
    /// Without a doubt, as the simulator rates, and every row for itself.
    pub fn certain(gap: Vec<f64>) -> Self {
        let rows = gap.len();
        Self { doubt: vec![0.0; rows], group: (0..rows).collect(), gap }
    }

    /// The same, rows of the same trajectory together.
    #[must_use]
    pub fn grouped(self, group: &[usize]) -> Self {
        assert_eq!(group.len(), self.gap.len(), "a trajectory for every row");
        Self { group: group.to_vec(), ..self }
    }

    fn select(&self, places: impl Iterator<Item = usize> + Clone) -> Self {
        Self {
            gap: places.clone().map(|i| self.gap[i]).collect(),
            doubt: places.clone().map(|i| self.doubt[i]).collect(),
            group: places.map(|i| self.group[i]).collect(),
        }
    }

    /// The rows whose numbers are finite.
    fn finite(&self) -> Self {
        self.select((0..self.gap.len()).filter(|&i| self.gap[i].is_finite() && self.doubt[i].is_finite()))
    }
}

/// Sums over some rows. Parts of a whole add up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Part {
    /// Rows.
    pub rows: usize,
    /// Σ d
    pub sum: f64,
    /// Σ u
    pub doubt: f64,
}

impl Part {
    fn of(rated: &Rated) -> Self {
        Self { rows: rated.gap.len(), sum: rated.gap.iter().sum(), doubt: rated.doubt.iter().sum() }
    }

    fn and(self, other: &Self) -> Self {
        Self { rows: self.rows + other.rows, sum: self.sum + other.sum, doubt: self.doubt + other.doubt }
    }

    /// Mean d; NaN without rows.
    pub fn mean(&self) -> f64 {
        self.sum / self.rows as f64
    }

    /// Mean u; NaN without rows.
    pub fn mean_doubt(&self) -> f64 {
        self.doubt / self.rows as f64
    }
}

/// How well a mean is known.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeanError {
    /// The square of its standard error.
    pub squared: f64,
    /// Trajectories that it is from.
    pub trajectories: usize,
}

/// Of the mean d: c / (c − 1) Σ (Σ (d − mean))² / n², the inner sum over the rows of each of c trajectories. None for a single trajectory:
/// it says nothing of others.
fn mean_error(rated: &Rated) -> Option<MeanError> {
    let n = rated.gap.len() as f64;
    let mean = rated.gap.iter().sum::<f64>() / n;
    let mut sums = BTreeMap::<usize, f64>::new();
    for (d, group) in rated.gap.iter().zip(&rated.group) {
        *sums.entry(*group).or_default() += d - mean;
    }
    let c = sums.len() as f64;
    let squared = c / (c - 1.0) * sums.values().map(|s| s * s).sum::<f64>() / (n * n);
    (sums.len() > 1).then_some(MeanError { squared, trajectories: sums.len() })
}

/// λ d_source(λ) + (1 − λ) d_generated for every λ of [`GRID`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// With the λ share of source rows nearest to the target.
    pub nearest: Vec<f64>,
    /// With source rows as they come.
    pub all: Vec<f64>,
    /// The source rows between each λ of the grid and the one before; none at λ = 0.
    pub parts: Vec<Part>,
    /// The generated rows.
    pub generated: Part,
    /// Of the mean of the source rows between the places a < b of the grid, at [a][b − a − 1]; None where they are of one trajectory.
    pub errors: Vec<Vec<Option<MeanError>>>,
    /// The same of the generated rows.
    pub generated_error: Option<MeanError>,
    /// Rows whose discrepancy is not a finite number, and which are left out: source and generated ones.
    pub lost: (usize, usize),
}

impl Curve {
    /// From ratings of the source rows, nearest row first, and of the generated rows. None if no finite ones are left.
    pub fn of(sources: &Rated, generated: &Rated) -> Option<Self> {
        let (s, g) = (sources.finite(), generated.finite());
        if s.gap.is_empty() || g.gap.is_empty() {
            return None;
        }
        let lost = (sources.gap.len() - s.gap.len(), generated.gap.len() - g.gap.len());
        let rows = |k: usize| if k == 0 { 0 } else { ((GRID[k] * s.gap.len() as f64).round() as usize).max(1) };
        let between = |a: usize, b: usize| s.select(rows(a)..rows(b));
        let part = |k: usize| if k == 0 { Part::default() } else { Part::of(&between(k - 1, k)) };
        let errors = |a: usize| (a + 1..GRID.len()).map(|b| mean_error(&between(a, b))).collect();
        let mut curve = Self {
            nearest: vec![],
            all: vec![],
            parts: (0..GRID.len()).map(part).collect(),
            generated: Part::of(&g),
            errors: (0..GRID.len()).map(errors).collect(),
            generated_error: mean_error(&g),
            lost,
        };
        let (generated, whole) = (curve.generated.mean(), curve.source(GRID.len() - 1).mean());
        for (k, lambda) in GRID.into_iter().enumerate() {
            let own = if k == 0 { generated } else { lambda * curve.source(k).mean() + (1.0 - lambda) * generated };
            curve.nearest.push(own);
            curve.all.push(lambda * whole + (1.0 - lambda) * generated);
        }
        Some(curve)
    }

    /// The source rows up to a place of [`GRID`].
    pub fn source(&self, place: usize) -> Part {
        self.between(0, place)
    }

    fn between(&self, a: usize, b: usize) -> Part {
        self.parts[a + 1..=b].iter().fold(Part::default(), Part::and)
    }

    /// How far `nearest` at two places a < b of [`GRID`] has to differ for the difference to be told; None where no difference could be.
    pub fn doubt_between(&self, a: usize, b: usize) -> Option<f64> {
        let (part, g) = (self.between(a, b), self.generated_error?);
        // Two places may share their rows where there are few.
        let (doubt, s) = match part.rows {
            0 => (0.0, MeanError { squared: 0.0, ..g }),
            _ => (part.mean_doubt(), self.errors[a][b - a - 1]?),
        };
        let error = quantile(s.trajectories.min(g.trajectories)) * (s.squared + g.squared).sqrt();
        Some((GRID[b] - GRID[a]) * (doubt + self.generated.mean_doubt() + error))
    }

    /// Whether the bound at place `a` is told to be greater than the one at `b`.
    fn told_worse(&self, a: usize, b: usize) -> bool {
        self.doubt_between(a.min(b), a.max(b)).is_some_and(|doubt| self.nearest[a] - self.nearest[b] > doubt)
    }
}

/// What u is multiplied by, given mean d and u of held-out rows, whose true discrepancy is 0: their ratio, but never less than 1. u of a
/// held-out row has to be that between models of which one at least has not seen it: models that have seen a row agree.
pub fn calibration(held_out: Option<(f64, f64)>) -> f64 {
    match held_out {
        Some((d, u)) if u > 0.0 => (d / u).max(1.0),
        _ => 1.0,
    }
}

/// Both bounds, as far as they can be measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// γ
    pub discount: f64,
    /// The largest |r| of the target rows.
    pub r_max: f64,
    /// Eq. 3 without its factor, against P_tar of abundant rows.
    pub transition: Option<Curve>,
    /// Eq. 4 without its factor, V(s') under the true dynamics being the simulator's.
    pub value: Option<Curve>,
    /// The same two measured by models of the target rows alone.
    pub transition_alone: Option<Curve>,
    /// See `transition_alone`; what the rule looks at.
    pub value_alone: Option<Curve>,
    /// Of target rows by models that did not see them: mean d, and how far those are from the models that did, what [`calibration`] is made
    /// from. None where they are no numbers.
    pub held_out: Option<(f64, f64)>,
}

impl Bounds {
    /// 2γ r_max / (1 − γ)²
    pub fn transition_factor(&self) -> f64 {
        2.0 * self.discount * self.r_max / (1.0 - self.discount).powi(2)
    }

    /// γ / (1 − γ)
    pub fn value_factor(&self) -> f64 {
        self.discount / (1.0 - self.discount)
    }
}

/// A λ and why.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Choice {
    /// The λ.
    pub lambda: f64,
    /// Whether the data say so. If not, `lambda` is 0, the paper's default.
    pub told: bool,
    /// The λ with the least bound.
    pub least: f64,
    /// The bound there, without its factor.
    pub least_bound: f64,
    /// The bound at λ = 0, without its factor.
    pub generated_alone: f64,
}

impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.told {
            true => write!(f, "{}", self.lambda),
            false => write!(f, "cannot tell ({} by default)", self.lambda),
        }
    }
}

impl Choice {
    /// What to do with the source rows.
    pub fn sentence(&self) -> String {
        match self {
            Choice { told: false, .. } => {
                "The data do not tell whether real source rows should be added to them. By default none are (λ = 0)."
                    .into()
            }
            Choice { lambda: 0.0, .. } => "Add no real source rows to them: the data alone speak for λ = 0.".into(),
            Choice { lambda, .. } => format!(
                "Add the nearest source rows to them: the data alone speak for a share of {}, λ = {lambda}.",
                crate::numbers::percent(*lambda)
            ),
        }
    }

    /// The rule.
    pub fn of(curve: &Curve) -> Self {
        let best = (0..GRID.len()).min_by(|&a, &b| curve.nearest[a].total_cmp(&curve.nearest[b])).expect("a grid");
        let chosen = (0..best).find(|&k| !curve.told_worse(k, best)).unwrap_or(best);
        Self {
            lambda: GRID[chosen],
            told: chosen > 0 || (1..GRID.len()).all(|k| curve.told_worse(k, 0)),
            least: GRID[best],
            least_bound: curve.nearest[best],
            generated_alone: curve.nearest[0],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(sources: &[f64], generated: &[f64]) -> Curve {
        Curve::of(&Rated::certain(sources.to_vec()), &Rated::certain(generated.to_vec())).unwrap()
    }

    #[test]
    fn the_curve_is_the_mixture_of_both_means() {
        // The nearest half of the source is at .1, the rest at 1.1.
        let sources: Vec<f64> = (0..1000).map(|i| if i < 500 { 0.1 } else { 1.1 }).chain([f64::NAN]).collect();
        let curve = curve(&sources, &[0.3, 0.5, f64::INFINITY]);
        assert!((curve.generated.mean() - 0.4).abs() < 1e-12);
        let at = |lambda: f64| GRID.iter().position(|l| *l == lambda).unwrap();
        assert!((curve.nearest[at(0.0)] - 0.4).abs() < 1e-12);
        assert!((curve.nearest[at(0.4)] - (0.4 * 0.1 + 0.6 * 0.4)).abs() < 1e-12);
        // At .8, 500 of 800 rows are at .1.
        let d = (500.0 * 0.1 + 300.0 * 1.1) / 800.0;
        assert!((curve.nearest[at(0.8)] - (0.8 * d + 0.2 * 0.4)).abs() < 1e-12);
        assert!((curve.all[at(0.4)] - (0.4 * 0.6 + 0.6 * 0.4)).abs() < 1e-12);
        assert_eq!((curve.lost, curve.parts.iter().map(|p| p.rows).sum::<usize>()), ((1, 1), 1000));
        assert!((curve.generated_error.unwrap().squared - 0.01).abs() < 1e-12, "two rows at ±.1");
        assert_eq!(Curve::of(&Rated::default(), &Rated::certain(vec![1.0])), None);
    }

    /// 100 rows of four trajectories are four numbers, and one trajectory is none.
    #[test]
    fn rows_of_a_trajectory_count_once() {
        let gap: Vec<f64> = (0..100).map(|i| f64::from(i / 25)).collect();
        let group: Vec<usize> = (0..100).map(|i| i / 25).collect();
        let four = mean_error(&Rated::certain(gap.clone()).grouped(&group)).unwrap();
        let expected = mean_error(&Rated::certain(vec![0.0, 1.0, 2.0, 3.0])).unwrap();
        assert!((four.squared - 5.0 / 12.0).abs() < 1e-12 && (expected.squared - 5.0 / 12.0).abs() < 1e-12);
        assert_eq!((four.trajectories, expected.trajectories), (4, 4));
        assert!(mean_error(&Rated::certain(gap.clone())).unwrap().squared < expected.squared / 20.0);
        assert_eq!(mean_error(&Rated::certain(gap).grouped(&[7; 100])), None);
        let single = Rated::certain(vec![0.1; 1000]).grouped(&[7; 1000]);
        let choice = Choice::of(&Curve::of(&single, &Rated::certain(vec![5.0; 1000])).unwrap());
        assert_eq!((choice.lambda, choice.told, choice.least), (0.0, false, 1.0));
    }

    /// The ± of the module's words, on numbers worked by hand: between .4 and .6 lie 200 rows, half at 1 and half at 3.
    #[test]
    fn differences_are_doubted_by_the_rows_between() {
        let gap: Vec<f64> = (0..1000).map(|i| if i % 2 == 0 { 1.0 } else { 3.0 }).collect();
        let doubt: Vec<f64> = (0..1000).map(|i| if (400..600).contains(&i) { 0.5 } else { 9.0 }).collect();
        let generated = Rated { gap: vec![4.0, 6.0], doubt: vec![0.1, 0.3], group: vec![0, 1] };
        let curve = Curve::of(&Rated { gap, doubt, group: (0..1000).collect() }, &generated).unwrap();
        // Squares of the standard errors: 1 / 199 between, 1 / 1 of the two generated rows. Student with one degree of freedom is Cauchy.
        let cauchy = (std::f64::consts::PI * (0.5 - 0.05 / 18.0)).tan();
        let expected = 0.2 * (0.5 + 0.2 + cauchy * (1.0 / 199.0 + 1.0f64).sqrt());
        let at = |lambda: f64| GRID.iter().position(|l| *l == lambda).unwrap();
        let found = curve.doubt_between(at(0.4), at(0.6)).unwrap();
        assert!((found / expected - 1.0).abs() < 1e-6, "{found} is not {expected}");
        // Many are normal: Φ⁻¹(1 − .05 / 18).
        assert!((quantile(1_000_000) - 2.7729).abs() < 1e-3 && quantile(10) > 3.5);
        assert!((curve.nearest[at(0.6)] - curve.nearest[at(0.4)] - 0.2 * (2.0 - 5.0)).abs() < 1e-12);
    }

    #[test]
    fn the_rule_takes_generated_rows_unless_near_source_rows_are_told_to_be_better() {
        let generated: Vec<f64> = (0..1000).map(|i| 0.4 + 0.01 * f64::from(i % 2)).collect();
        let far = vec![2.0; 1000];
        let choice = Choice::of(&curve(&far, &generated));
        assert_eq!((choice.lambda, choice.told), (0.0, true));
        // The nearest 30 % are as good as real ones, the others are not.
        let near: Vec<f64> = (0..1000).map(|i| if i < 300 { 0.01 } else { 3.0 }).collect();
        let choice = Choice::of(&curve(&near, &generated));
        assert_eq!((choice.lambda, choice.least, choice.told), (0.3, 0.3, true));
        // An advantage within the noise does not count, and is said to be none.
        let noisy: Vec<f64> = (0..100).map(|i| if i % 2 == 0 { 0.0 } else { 0.8 }).collect();
        let choice = Choice::of(&curve(&[0.395; 100], &noisy));
        assert_eq!((choice.lambda, choice.told), (0.0, false));
        assert!(choice.least > 0.0 && choice.to_string() == "cannot tell (0 by default)");
    }

    /// Models that guess at the source's rows do not decide between them and generated ones.
    #[test]
    fn what_models_guess_does_not_count() {
        let rows = |gap: f64, doubt: f64| Rated { doubt: vec![doubt; 1000], ..Rated::certain(vec![gap; 1000]) };
        let rated = |gap: f64, doubt: f64| Choice::of(&Curve::of(&rows(gap, doubt), &rows(0.4, 0.3)).unwrap());
        assert_eq!((rated(160.0, 150.0).lambda, rated(160.0, 150.0).told), (0.0, true));
        assert_eq!((rated(160.0, 165.0).lambda, rated(160.0, 165.0).told), (0.0, false));
        assert_eq!((rated(0.2, 0.1).lambda, rated(0.2, 0.1).told), (0.0, false), "less than .4 in doubt");
        let sure = Rated::certain(vec![0.4; 1000]);
        let near = Curve::of(&rows(0.2, 0.1), &sure).unwrap();
        assert_eq!((Choice::of(&near).lambda, Choice::of(&near).told), (1.0, true));
    }

    #[test]
    fn factors_are_those_of_the_theorem() {
        let bounds = Bounds {
            discount: 0.99,
            r_max: 5.0,
            transition: None,
            value: None,
            transition_alone: None,
            value_alone: None,
            held_out: None,
        };
        assert!((bounds.transition_factor() - 99_000.0).abs() < 1e-6);
        assert!((bounds.value_factor() - 99.0).abs() < 1e-9);
    }
}
