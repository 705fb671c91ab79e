//! Theorem 1 over λ, and the λ that it chooses.
//!
//! ```text
//! Eq. 3   2γ r_max / (1 − γ)² · (λ E[D_TV(P_src ‖ P_tar)] + (1 − λ) E[D_TV(P̂_tar ‖ P_tar)])
//! Eq. 4   γ / (1 − γ) · (λ E|E_src V(s') − E_tar V(s')| + (1 − λ) E|E_gen V(s') − E_tar V(s')|)
//! ```
//!
//! Both are a factor times λ d_source(λ) + (1 − λ) d_generated, with one discrepancy d per row. Source rows are either all of them (d does
//! not depend on λ) or the λ share nearest to the target (Eq. 9; d grows with λ). The expectations are over the rows of the
//! mixture, which stand for ρ_mix.
//!
//! **The rule.** TCE leaves λ to the user: OG (λ = 0) ... NN. [`Choice::of`] takes the λ with the least bound, where the bound is measured by
//! models of the target rows alone, so that no environment is needed; and because the curve has noise, the smallest λ from which
//! the least bound is no more than one standard error of the difference away (after the rule of Breiman et al. 1984).

use serde::{Deserialize, Serialize};

/// The λ at which curves are computed.
pub const GRID: [f64; 10] = [0.0, 0.025, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0];

/// λ d_source(λ) + (1 − λ) d_generated for every λ of [`GRID`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// With the λ share of source rows nearest to the target.
    pub nearest: Vec<f64>,
    /// With source rows as they come.
    pub all: Vec<f64>,
    /// d of the nearest share alone, NaN (null) at λ = 0.
    #[serde(deserialize_with = "numbers")]
    pub source: Vec<f64>,
    /// Standard errors of `source`, 0 at λ = 0.
    pub source_error: Vec<f64>,
    /// d_generated
    pub generated: f64,
    /// Its standard error.
    pub generated_error: f64,
}

/// JSON has no NaN.
fn numbers<'de, D: serde::Deserializer<'de>>(from: D) -> Result<Vec<f64>, D::Error> {
    let all = Vec::<Option<f64>>::deserialize(from)?;
    Ok(all.into_iter().map(|v| v.unwrap_or(f64::NAN)).collect())
}

/// Mean and its standard error.
fn mean(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    (mean, (variance / n).sqrt())
}

impl Curve {
    /// From one discrepancy per source row, nearest row first, and one per generated row. Rows whose discrepancy is not a finite number
    /// are left out. None if nothing is left.
    pub fn of(sources: &[f64], generated: &[f64]) -> Option<Self> {
        let finite = |v: &[f64]| v.iter().copied().filter(|v| v.is_finite()).collect::<Vec<_>>();
        let (sources, generated) = (finite(sources), finite(generated));
        if sources.is_empty() || generated.is_empty() {
            return None;
        }
        let ((g, generated_error), (whole, _)) = (mean(&generated), mean(&sources));
        let mut curve =
            Self { nearest: vec![], all: vec![], source: vec![], source_error: vec![], generated: g, generated_error };
        for lambda in GRID {
            let share = ((lambda * sources.len() as f64).round() as usize).max(1);
            let (d, error) = if lambda == 0.0 { (f64::NAN, 0.0) } else { mean(&sources[..share]) };
            curve.source.push(d);
            curve.source_error.push(error);
            curve.nearest.push(if lambda == 0.0 { g } else { lambda * d + (1.0 - lambda) * g });
            curve.all.push(lambda * whole + (1.0 - lambda) * g);
        }
        Some(curve)
    }

    /// The standard error of the difference between `nearest` at two places of [`GRID`].
    fn error_between(&self, a: usize, b: usize) -> f64 {
        let part = |k: usize| (GRID[k] * self.source_error[k]).powi(2);
        (((GRID[a] - GRID[b]) * self.generated_error).powi(2) + part(a) + part(b)).sqrt()
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
    /// The λ with the least bound.
    pub least: f64,
    /// The bound there, without its factor.
    pub least_bound: f64,
    /// The bound at λ = 0, without its factor.
    pub generated_alone: f64,
}

impl Choice {
    /// The rule.
    pub fn of(curve: &Curve) -> Self {
        let best = (0..GRID.len()).min_by(|&a, &b| curve.nearest[a].total_cmp(&curve.nearest[b])).expect("a grid");
        let enough = |&k: &usize| curve.nearest[k] - curve.nearest[best] <= curve.error_between(k, best);
        let chosen = (0..best).find(enough).unwrap_or(best);
        Self {
            lambda: GRID[chosen],
            least: GRID[best],
            least_bound: curve.nearest[best],
            generated_alone: curve.generated,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curve_is_the_mixture_of_both_means() {
        // The nearest half of the source is at .1, the rest at 1.1.
        let sources: Vec<f64> = (0..1000).map(|i| if i < 500 { 0.1 } else { 1.1 }).chain([f64::NAN]).collect();
        let curve = Curve::of(&sources, &[0.3, 0.5, f64::INFINITY]).unwrap();
        assert!((curve.generated - 0.4).abs() < 1e-12);
        let at = |lambda: f64| GRID.iter().position(|l| *l == lambda).unwrap();
        assert!((curve.nearest[at(0.0)] - 0.4).abs() < 1e-12 && curve.source[0].is_nan());
        assert!((curve.nearest[at(0.4)] - (0.4 * 0.1 + 0.6 * 0.4)).abs() < 1e-12);
        // At .8, 500 of 800 rows are at .1.
        let d = (500.0 * 0.1 + 300.0 * 1.1) / 800.0;
        assert!((curve.nearest[at(0.8)] - (0.8 * d + 0.2 * 0.4)).abs() < 1e-12);
        assert!((curve.all[at(0.4)] - (0.4 * 0.6 + 0.6 * 0.4)).abs() < 1e-12);
        assert!((curve.generated_error - 0.1).abs() < 1e-12, "two rows at ±.1: {}", curve.generated_error);
        assert_eq!(Curve::of(&[], &[1.0]), None);
    }

    #[test]
    fn the_rule_takes_generated_rows_unless_near_source_rows_are_better() {
        let generated: Vec<f64> = (0..1000).map(|i| 0.4 + 0.01 * f64::from(i % 2)).collect();
        let far = vec![2.0; 1000];
        assert_eq!(Choice::of(&Curve::of(&far, &generated).unwrap()).lambda, 0.0);
        // The nearest 30 % are as good as real ones, the others are not.
        let near: Vec<f64> = (0..1000).map(|i| if i < 300 { 0.01 } else { 3.0 }).collect();
        let choice = Choice::of(&Curve::of(&near, &generated).unwrap());
        assert_eq!((choice.lambda, choice.least), (0.3, 0.3));
        // An advantage within the noise does not count.
        let noisy: Vec<f64> = (0..100).map(|i| if i % 2 == 0 { 0.0 } else { 0.8 }).collect();
        let choice = Choice::of(&Curve::of(&[0.395; 100], &noisy).unwrap());
        assert_eq!(choice.lambda, 0.0);
        assert!(choice.least > 0.0);
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
        };
        assert!((bounds.transition_factor() - 99_000.0).abs() < 1e-6);
        assert!((bounds.value_factor() - 99.0).abs() < 1e-9);
    }
}
