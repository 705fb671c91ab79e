//! Standardises every dimension to zero mean and unit spread, without amplifying dimensions that hardly move.

use serde::{Deserialize, Serialize};

use crate::moments::Moments;
use crate::{Rows, Transitions};

/// The smallest divisor of a live dimension, relative to the median std of the live dimensions.
///
/// A blocked joint moves by about .003 rad (Hopper kinematic), while its own velocity and the other joints move by .1
/// to 10. Division by the tiny std is right for the simulator, which needs that angle as much as any other. But a
/// source state outside the blocked range would become an input of a hundred sigmas. One thousandth of the median is a
/// factor of ten below every live dimension of the public benchmark files (their smallest are 11 thousandths in s and
/// 14 thousandths in s' - s, both Hopper kinematic expert's thigh), so no real signal is attenuated there. It is above
/// the float32 rounding of a resting joint. For weaker signals, choose a smaller floor with
/// [`Standardizer::fit_with_floor`].
pub const RELATIVE_FLOOR: f64 = 1e-3;

/// An affine map per dimension, x → (x - mean) / std, computed in f64 and kept in f32.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Standardizer {
    /// Mean per dimension; for a dead dimension, its constant value.
    pub mean: Vec<f32>,
    /// Divisor per dimension, always positive: the std, at least the floor; 1 for a dead dimension.
    pub std: Vec<f32>,
    /// Constant dimensions (Ant's 84 contact slots), ascending.
    pub dead: Vec<usize>,
    /// Live dimensions whose std was below the floor, ascending.
    pub floored: Vec<usize>,
}

impl Standardizer {
    /// Fits row-major `data` with `dim` columns, with [`RELATIVE_FLOOR`]. Population std (divisor n).
    ///
    /// # Panics
    /// If `data` is not rectangular.
    pub fn fit(data: &[f32], dim: usize) -> Self {
        Self::fit_on(&[Rows::new(data, dim)])
    }

    /// Fits all rows of all `tables` as one population.
    ///
    /// # Panics
    /// If the tables' dimensions differ.
    pub fn fit_on(tables: &[Rows<'_>]) -> Self {
        Self::fit_with_floor(tables, RELATIVE_FLOOR)
    }

    /// Like [`Standardizer::fit_on`], with another floor (relative to the median std of the live dimensions).
    pub fn fit_with_floor(tables: &[Rows<'_>], relative_floor: f64) -> Self {
        let m = Moments::of(tables);
        let dim = m.mean.len();
        let mut live: Vec<f64> = m.std.iter().copied().filter(|&s| s > 0.0).collect();
        live.sort_by(f64::total_cmp);
        let floor = if live.is_empty() { 0.0 } else { relative_floor * live[live.len() / 2] };
        let mut out = Self { mean: Vec::new(), std: Vec::new(), dead: Vec::new(), floored: Vec::new() };
        for d in 0..dim {
            out.mean.push(m.mean[d] as f32);
            let std = m.std[d].max(floor) as f32;
            if m.std[d] == 0.0 || std < f32::MIN_POSITIVE {
                out.dead.push(d);
                out.std.push(1.0);
                continue;
            }
            if m.std[d] < floor {
                out.floored.push(d);
            }
            out.std.push(std);
        }
        out
    }

    /// The identity map.
    pub fn identity(dim: usize) -> Self {
        Self { mean: vec![0.0; dim], std: vec![1.0; dim], dead: Vec::new(), floored: Vec::new() }
    }

    /// Number of dimensions.
    pub fn dim(&self) -> usize {
        self.mean.len()
    }

    /// The dimensions that are not dead, ascending.
    pub fn live(&self) -> Vec<usize> {
        (0..self.dim()).filter(|d| self.dead.binary_search(d).is_err()).collect()
    }

    /// Standardises row-major `data`.
    pub fn apply(&self, data: &[f32]) -> Vec<f32> {
        let mut out = data.to_vec();
        self.apply_in_place(&mut out);
        out
    }

    /// Standardises row-major `data` in place.
    ///
    /// # Panics
    /// If `data` is not rectangular.
    pub fn apply_in_place(&self, data: &mut [f32]) {
        assert_eq!(data.len() % self.dim().max(1), 0, "not rows of {}", self.dim());
        data.chunks_exact_mut(self.dim().max(1)).for_each(|row| self.apply_row(row));
    }

    /// Standardises one row in place.
    pub fn apply_row(&self, row: &mut [f32]) {
        for ((x, m), s) in row.iter_mut().zip(&self.mean).zip(&self.std) {
            *x = (*x - m) / s;
        }
    }

    /// Undoes [`Standardizer::apply`].
    pub fn invert(&self, data: &[f32]) -> Vec<f32> {
        let mut out = data.to_vec();
        self.invert_in_place(&mut out);
        out
    }

    /// Undoes [`Standardizer::apply_in_place`].
    ///
    /// # Panics
    /// If `data` is not rectangular.
    pub fn invert_in_place(&self, data: &mut [f32]) {
        assert_eq!(data.len() % self.dim().max(1), 0, "not rows of {}", self.dim());
        for row in data.chunks_exact_mut(self.dim().max(1)) {
            for ((x, m), s) in row.iter_mut().zip(&self.mean).zip(&self.std) {
                *x = *x * s + m;
            }
        }
    }

    /// Sets the dead dimensions of row-major `data` (in original units) to their constant value. A generative model
    /// leaves noise there.
    pub fn restore_dead(&self, data: &mut [f32]) {
        for row in data.chunks_exact_mut(self.dim().max(1)) {
            self.dead.iter().for_each(|&d| row[d] = self.mean[d]);
        }
    }
}

/// The map for which the states of a half-and-half batch have zero mean and unit variance. Target rows and other rows
/// have equal weight, however many more of the others there are.
pub fn even_standardizer(target: &Transitions, other: Option<&Transitions>) -> Standardizer {
    let d = target.obs_dim;
    let mut few = Vec::new();
    if let Some(other) = other {
        let n = target.len().min(other.len());
        (0..n).for_each(|i| few.extend_from_slice(other.observation(i * other.len() / n)));
    }
    let mut tables = vec![Rows::new(&target.observations, d)];
    if !few.is_empty() {
        tables.push(Rows::new(&few, d));
    }
    Standardizer::fit_on(&tables)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Columns: spread 1, spread 2e-3 (a blocked joint), spread 1e-6 (noise), constant.
    fn sample() -> Vec<f32> {
        (0..1000)
            .flat_map(|i| {
                let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
                [5.0 + sign, 0.002 * sign, 1e-6 * sign, 0.7]
            })
            .collect()
    }

    #[test]
    fn a_blocked_joint_keeps_its_signal_and_noise_is_floored() {
        let s = Standardizer::fit(&sample(), 4);
        assert_eq!(s.dead, [3]);
        assert_eq!(s.floored, [2]);
        assert_eq!(s.mean, [5.0, 0.0, 0.0, 0.7]);
        // The median of {1, 2e-3, 1e-6} is 2e-3, the floor 2e-6.
        assert_eq!(s.std, [1.0, 0.002, 2e-6, 1.0]);
        assert_eq!(s.live(), [0, 1, 2]);
    }

    #[test]
    fn dead_dimensions_become_zero_and_come_back() {
        let s = Standardizer::fit(&sample(), 4);
        let z = s.apply(&sample());
        assert!(z.iter().skip(3).step_by(4).all(|&x| x == 0.0));
        let mut noisy = s.invert(&[0.0, 0.0, 0.0, 0.3]);
        s.restore_dead(&mut noisy);
        assert_eq!(noisy[3], 0.7);
    }

    #[test]
    fn it_survives_json_and_refuses_unknown_fields() {
        let s = Standardizer::fit(&sample(), 4);
        let json = serde_json::to_string(&s).unwrap();
        assert_eq!(serde_json::from_str::<Standardizer>(&json).unwrap(), s);
        assert!(serde_json::from_str::<Standardizer>(&json.replace("dead", "alive")).is_err());
    }

    proptest! {
        #[test]
        fn standardised_data_have_mean_0_and_std_1(data in prop::collection::vec(-100f32..100.0, 60)) {
            let s = Standardizer::fit(&data, 3);
            prop_assume!(s.dead.is_empty() && s.floored.is_empty());
            let z = s.apply(&data);
            let m = Moments::of(&[Rows::new(&z, 3)]);
            for d in 0..3 {
                prop_assert!(m.mean[d].abs() < 1e-4 && (m.std[d] - 1.0).abs() < 1e-4);
            }
            for (x, y) in data.iter().zip(s.invert(&z)) {
                prop_assert!((x - y).abs() < 1e-3);
            }
        }

        #[test]
        fn nothing_is_ever_divided_by_zero(data in prop::collection::vec(prop_oneof![Just(0f32), Just(1e-30), Just(1e30), Just(3.0)], 40)) {
            let s = Standardizer::fit(&data, 4);
            prop_assert!(s.std.iter().all(|&x| x.is_finite() && x > 0.0));
            prop_assert!(s.apply(&data).iter().all(|x| x.is_finite()));
        }
    }
}
