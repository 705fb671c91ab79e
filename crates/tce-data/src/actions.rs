//! Units of actions: the user's (torques, volts, pedals) and the box [-1, 1], in which everything here is learned.

use serde::{Deserialize, Serialize};

use crate::Transitions;

/// Actions may leave the box [-1, 1] by this much, because a tanh is rounded to float32.
pub(crate) const ACTION_TOLERANCE: f32 = 1e-4;

/// Smallest and largest action of every column, in the user's units. Inside the program, `low` is -1 and `high` is 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActionRange {
    /// `[act_dim]`.
    pub low: Vec<f32>,
    /// `[act_dim]`, each above `low`.
    pub high: Vec<f32>,
}

impl ActionRange {
    /// The action range of `tables`; `None` if all actions are already in [-1, 1].
    ///
    /// A column within [-1, 1] keeps that range: the controller takes it, even if the log does not reach both ends.
    /// Other columns get the range of the data. It is made symmetric if one side reaches at least half as far as the
    /// other.
    pub fn of(tables: &[&Transitions]) -> Option<Self> {
        let dim = tables.first()?.act_dim;
        let (mut low, mut high) = (vec![f32::INFINITY; dim], vec![f32::NEG_INFINITY; dim]);
        for action in tables.iter().flat_map(|t| t.actions.chunks_exact(dim)) {
            for ((low, high), &a) in low.iter_mut().zip(&mut high).zip(action) {
                (*low, *high) = (low.min(a), high.max(a));
            }
        }
        for (low, high) in low.iter_mut().zip(&mut high) {
            let (least, greatest) = (low.abs().min(high.abs()), low.abs().max(high.abs()));
            if greatest <= 1.0 + ACTION_TOLERANCE {
                (*low, *high) = (-1.0, 1.0);
            } else if *low < 0.0 && *high > 0.0 && least >= 0.5 * greatest {
                (*low, *high) = (-greatest, greatest);
            } else if *high - *low <= f32::EPSILON * greatest {
                // A constant column: its one value becomes the middle.
                (*low, *high) = (*low - greatest, *high + greatest);
            }
        }
        let range = Self { low, high };
        (!range.is_unit()).then_some(range)
    }

    /// Whether this range is the box [-1, 1].
    pub fn is_unit(&self) -> bool {
        self.low.iter().all(|&x| x == -1.0) && self.high.iter().all(|&x| x == 1.0)
    }

    /// Whether this is a valid range of `dim` columns: finite numbers, `low` below `high`.
    pub fn fits(&self, dim: usize) -> bool {
        let pairs = self.low.iter().zip(&self.high);
        self.low.len() == dim && self.high.len() == dim && pairs.clone().all(|(l, h)| l < h && (h - l).is_finite())
    }

    /// Number of values of `actions` `[N, act_dim]` outside the range by more than rounding.
    pub fn outside(&self, actions: &[f32]) -> usize {
        let out = |(a, (low, high)): (&f32, (&f32, &f32))| {
            let margin = ACTION_TOLERANCE * (high - low);
            *a < low - margin || *a > high + margin
        };
        let row = |row: &[f32]| row.iter().zip(self.low.iter().zip(&self.high)).filter(|x| out(*x)).count();
        actions.chunks_exact(self.low.len()).map(row).sum()
    }

    /// Indices of the columns whose largest value is more than ten times the 99.9 % quantile. After scaling to [-1, 1],
    /// a single outlier makes all other values small.
    pub fn with_outliers(tables: &[&Transitions]) -> Vec<usize> {
        let dim = tables.first().map_or(0, |t| t.act_dim);
        let wild = |d: &usize| {
            let column = tables.iter().flat_map(|t| t.actions.iter().skip(*d).step_by(dim));
            let mut sizes: Vec<f32> = column.map(|a| a.abs()).collect();
            if sizes.len() < 20 {
                return false;
            }
            let (at, most) =
                ((sizes.len() * 999 / 1000).min(sizes.len() - 2), sizes.iter().copied().fold(0.0, f32::max));
            most > 10.0 * *sizes.select_nth_unstable_by(at, f32::total_cmp).1
        };
        (0..dim).filter(wild).collect()
    }

    /// Converts `actions` `[N, act_dim]` from the user's units to the box.
    pub fn to_unit(&self, actions: &mut [f32]) {
        self.each(actions, |a, low, high| 2.0 * (a - low) / (high - low) - 1.0);
    }

    /// Converts `actions` `[N, act_dim]` from the box to the user's units.
    pub fn to_own(&self, actions: &mut [f32]) {
        self.each(actions, |a, low, high| low + (a + 1.0) * 0.5 * (high - low));
    }

    fn each(&self, actions: &mut [f32], f: impl Fn(f32, f32, f32) -> f32) {
        for action in actions.chunks_exact_mut(self.low.len()) {
            for ((a, &low), &high) in action.iter_mut().zip(&self.low).zip(&self.high) {
                *a = f(*a, low, high);
            }
        }
    }
}

impl std::fmt::Display for ActionRange {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let columns: Vec<String> = self.low.iter().zip(&self.high).map(|(l, h)| format!("{l}:{h}")).collect();
        f.write_str(&columns.join(","))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn table(actions: &[[f32; 2]]) -> Transitions {
        let mut t = Transitions::new(1, 2);
        actions.iter().for_each(|a| t.push(&[0.0], a, 0.0, &[0.0], false, false));
        t
    }

    #[test]
    fn what_is_in_the_box_stays_as_it_is() {
        assert_eq!(ActionRange::of(&[&table(&[[-0.2, 1.00005], [0.1, -1.0]])]), None);
    }

    #[test]
    fn columns_have_ranges_of_their_own_over_all_tables() {
        let range = |a: &[[f32; 2]], b: &[[f32; 2]]| ActionRange::of(&[&table(a), &table(b)]).unwrap();
        let r = range(&[[-19.5, 0.3]], &[[20.0, -0.3]]);
        assert_eq!(r, ActionRange { low: vec![-20.0, -1.0], high: vec![20.0, 1.0] });
        assert_eq!(r.to_string(), "-20:20,-1:1");
        // Columns: a pedal, and a valve that never moved.
        let r = range(&[[0.0, 7.0]], &[[10.0, 7.0]]);
        assert_eq!((r.low[0], r.high[0]), (0.0, 10.0));
        let mut action = [10.0, 7.0];
        r.to_unit(&mut action);
        assert_eq!(action, [1.0, 0.0]);
        assert!(r.fits(2) && !r.fits(3) && !ActionRange { low: vec![1.0], high: vec![1.0] }.fits(1));
    }

    #[test]
    fn wild_and_outlying_values_are_told() {
        let mut t = table(&[[0.5, -0.5]; 2000]);
        assert_eq!(ActionRange::with_outliers(&[&t]), [0; 0]);
        t.actions[15] = 1e6;
        assert_eq!(ActionRange::with_outliers(&[&t]), [1]);
        let range = ActionRange { low: vec![-10.0; 2], high: vec![10.0; 2] };
        assert_eq!(range.outside(&[10.0005, -10.1, 3.0, 11.0]), 2);
    }

    proptest! {
        #[test]
        fn there_and_back(rows in prop::collection::vec([-500.0f32..500.0, -3.0f32..900.0], 1..40)) {
            let t = table(&rows);
            if let Some(range) = ActionRange::of(&[&t]) {
                let mut actions = t.actions.clone();
                range.to_unit(&mut actions);
                prop_assert!(actions.iter().all(|a| a.abs() <= 1.0 + 1e-5), "{actions:?}");
                range.to_own(&mut actions);
                for (a, b) in actions.iter().zip(&t.actions) {
                    prop_assert!((a - b).abs() <= 1e-4 * 900.0, "{a} {b}");
                }
            }
        }
    }
}
