//! Training rows and their conditions, and how batches are drawn from them.

use tce_base::Rng;

use crate::DiffusionError;
use crate::process::draw_index;

/// The conditions of the rows of a [`Part`].
#[derive(Clone, Debug)]
pub enum Condition<'a> {
    /// One for all rows: a domain label.
    Constant(Vec<f32>),
    /// One per row, row-major.
    Rows(&'a [f32]),
}

/// Rows of one origin.
#[derive(Clone, Debug)]
pub struct Part<'a> {
    /// Row-major, standardised.
    pub rows: &'a [f32],
    /// Their conditions.
    pub condition: Condition<'a>,
}

/// How often the rows of each part are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Balance {
    /// Every part as often as every other, in turn.
    Parts,
    /// Every row as often as every other.
    Rows,
}

/// What one member trains on.
#[derive(Clone, Debug)]
pub struct ScoreData<'a> {
    parts: Vec<Part<'a>>,
    counts: Vec<usize>,
    dims: usize,
    condition: usize,
    balance: Balance,
    dropout: f64,
}

impl<'a> ScoreData<'a> {
    /// Rows of width `dims` with conditions of width `condition`. Rows of a batch are drawn with replacement,
    /// as often as `balance` says.
    ///
    /// # Errors
    /// If a part is empty, of another width, or holds a number that is not finite.
    pub fn new(parts: Vec<Part<'a>>, dims: usize, condition: usize, balance: Balance) -> Result<Self, DiffusionError> {
        if parts.is_empty() {
            return Err(DiffusionError::input("training data", "no parts", "at least one"));
        }
        let mut counts = Vec::new();
        for (i, part) in parts.iter().enumerate() {
            let n = part.rows.len() / dims;
            if n == 0 || part.rows.len() != n * dims {
                let found = format!("{} numbers", part.rows.len());
                return Err(DiffusionError::input(format!("rows of part {i}"), found, format!("rows of {dims}")));
            }
            let (values, wanted) = match &part.condition {
                Condition::Constant(c) => (c.as_slice(), condition),
                Condition::Rows(c) => (*c, n * condition),
            };
            if values.len() != wanted {
                let found = format!("{} numbers", values.len());
                return Err(DiffusionError::input(format!("condition of part {i}"), found, format!("{wanted}")));
            }
            for (what, values, width) in [("rows", part.rows, dims), ("condition", values, condition)] {
                if let Some(at) = values.iter().position(|v| !v.is_finite()) {
                    let what = format!("{what} of part {i}, row {}, dimension {}", at / width, at % width);
                    return Err(DiffusionError::input(what, values[at], "a finite number"));
                }
            }
            counts.push(n);
        }
        Ok(Self { parts, counts, dims, condition, balance, dropout: 0.0 })
    }

    /// The same, and with probability `rate` a drawn row comes under the condition of all zeros: what the network learns for that
    /// is the distribution without a condition, which classifier-free guidance needs ([`crate::Guided`]). Give conditions that are
    /// never all zeros, see [`present`].
    ///
    /// # Errors
    /// If `rate` is not in [0, 1).
    pub fn with_dropout(self, rate: f64) -> Result<Self, DiffusionError> {
        if !(0.0..1.0).contains(&rate) {
            return Err(DiffusionError::input("condition dropout", rate, "at least 0 and less than 1"));
        }
        Ok(Self { dropout: rate, ..self })
    }

    /// A domain-labelled set for the state score network: source rows under label 1, target rows under label 0 (Eq. 5).
    ///
    /// # Errors
    /// As [`ScoreData::new`].
    pub fn labelled(
        source: &'a [f32],
        target: &'a [f32],
        dims: usize,
        balance: Balance,
    ) -> Result<Self, DiffusionError> {
        let part = |rows, label| Part { rows, condition: Condition::Constant(vec![label]) };
        Self::new(vec![part(source, 1.0), part(target, 0.0)], dims, 1, balance)
    }

    /// Rows under one condition each, for the transition score network.
    ///
    /// # Errors
    /// As [`ScoreData::new`].
    pub fn conditioned(rows: &'a [f32], dims: usize, on: &'a [f32], width: usize) -> Result<Self, DiffusionError> {
        Self::new(vec![Part { rows, condition: Condition::Rows(on) }], dims, width, Balance::Rows)
    }

    /// Width of the rows.
    pub fn dims(&self) -> usize {
        self.dims
    }

    /// Probability of a dropped condition.
    pub(crate) fn dropout(&self) -> f64 {
        self.dropout
    }

    /// Width of the conditions.
    pub fn condition(&self) -> usize {
        self.condition
    }

    /// Draws row `i` of a batch: (row, condition).
    pub(crate) fn draw(&self, rng: &mut Rng, i: usize) -> (&[f32], &[f32]) {
        let (part, row) = if self.balance == Balance::Parts {
            let part = i % self.parts.len();
            (part, draw_index(rng, self.counts[part]))
        } else {
            let mut row = draw_index(rng, self.counts.iter().sum());
            let mut part = 0;
            while row >= self.counts[part] {
                row -= self.counts[part];
                part += 1;
            }
            (part, row)
        };
        let condition = match &self.parts[part].condition {
            Condition::Constant(c) => c.as_slice(),
            Condition::Rows(c) => &c[row * self.condition..][..self.condition],
        };
        (&self.parts[part].rows[row * self.dims..][..self.dims], condition)
    }
}

/// Conditions of width `width` with a 1 behind each, which tells a condition that is there from none at all (all zeros):
/// row-major, `width` + 1 columns.
pub fn present(conditions: &[f32], width: usize) -> Vec<f32> {
    conditions.chunks_exact(width).flat_map(|c| c.iter().copied().chain([1.0])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_base::Streams;

    #[test]
    fn balanced_batches_hold_equal_shares() {
        let (source, target) = (vec![1.0; 900], vec![2.0; 100]);
        let share = |balance| {
            let data = ScoreData::labelled(&source, &target, 1, balance).unwrap();
            let mut rng = Streams::new(0).stream("b");
            let draws = (0..10_000).map(|i| data.draw(&mut rng, i));
            draws.filter(|(row, label)| row[0] == 2.0 && label[0] == 0.0).count() as f64 / 1e4
        };
        assert_eq!(share(Balance::Parts), 0.5);
        assert!((share(Balance::Rows) - 0.1).abs() < 0.01);
    }

    #[test]
    fn a_condition_that_is_there_differs_from_none() {
        assert_eq!(present(&[0.0, 2.0, 0.0, 0.0], 2), [0.0, 2.0, 1.0, 0.0, 0.0, 1.0]);
        let data = ScoreData::labelled(&[1.0], &[0.0], 1, Balance::Parts).unwrap();
        let error = data.with_dropout(1.0).unwrap_err().to_string();
        assert_eq!(error, "condition dropout: found 1, expected at least 0 and less than 1");
    }

    #[test]
    fn unusable_rows_are_refused() {
        let error = |rows: &[f32], on: &[f32]| ScoreData::conditioned(rows, 2, on, 1).unwrap_err().to_string();
        assert_eq!(error(&[0.0; 3], &[0.0]), "rows of part 0: found 3 numbers, expected rows of 2");
        assert_eq!(error(&[0.0; 4], &[0.0]), "condition of part 0: found 1 numbers, expected 2");
        assert_eq!(
            error(&[0.0, 0.0, 0.0, f32::NAN], &[0.0; 2]),
            "rows of part 0, row 1, dimension 1: found NaN, expected a finite number"
        );
    }
}
