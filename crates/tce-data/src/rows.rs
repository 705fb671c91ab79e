//! Views rows as points: several columns side by side, without copying them into one matrix.

use std::ops::Range;

use crate::Transitions;

/// A table of points whose coordinates lie in one or more row-major columns.
#[derive(Clone, Debug)]
pub struct Rows<'a> {
    parts: Vec<(&'a [f32], usize)>,
    /// The rows of the parts that are points; `None`: all of them.
    taken: Option<Vec<usize>>,
    len: usize,
    dim: usize,
}

impl<'a> Rows<'a> {
    /// The rows of one row-major matrix with `dim` columns.
    pub fn new(data: &'a [f32], dim: usize) -> Self {
        Self::join(&[(data, dim)])
    }

    /// Row i is the concatenation of row i of every `(matrix, columns)`.
    ///
    /// # Panics
    /// If a part has no columns, is not rectangular, or has a different number of rows than the first part.
    pub fn join(parts: &[(&'a [f32], usize)]) -> Self {
        let rows = |&(data, dim): &(&[f32], usize)| {
            assert!(dim > 0 && data.len() % dim == 0, "{} numbers do not make rows of {dim}", data.len());
            data.len() / dim
        };
        let len = parts.first().map_or(0, rows);
        assert!(parts.iter().all(|p| rows(p) == len), "the parts have different numbers of rows");
        Self { parts: parts.to_vec(), taken: None, len, dim: parts.iter().map(|p| p.1).sum() }
    }

    /// [s, a, s'], as in Eq. 9 and in OTDF, of the rows whose s' is known: a row without s' is no such point.
    pub fn transitions(t: &'a Transitions) -> Self {
        let all =
            Self::join(&[(&t.observations, t.obs_dim), (&t.actions, t.act_dim), (&t.next_observations, t.obs_dim)]);
        if t.known.iter().all(|&known| known) {
            return all;
        }
        let taken: Vec<usize> = (0..t.len()).filter(|&i| t.known[i]).collect();
        Self { len: taken.len(), taken: Some(taken), ..all }
    }

    /// [s, s'], the state transitions of Eq. 8.
    pub fn state_pairs(t: &'a Transitions) -> Self {
        Self::join(&[(&t.observations, t.obs_dim), (&t.next_observations, t.obs_dim)])
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Number of coordinates.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Copies row `i` into `out` (`[dim]`).
    pub fn copy_row(&self, i: usize, out: &mut [f32]) {
        let i = self.taken.as_ref().map_or(i, |taken| taken[i]);
        let mut at = 0;
        for &(data, d) in &self.parts {
            out[at..at + d].copy_from_slice(&data[i * d..(i + 1) * d]);
            at += d;
        }
    }

    /// Copies rows `range` into `out` (`[range.len(), dim]`).
    pub fn copy_rows(&self, range: Range<usize>, out: &mut [f32]) {
        for (i, row) in range.zip(out.chunks_exact_mut(self.dim)) {
            self.copy_row(i, row);
        }
    }

    /// Copies all rows into one vector: `[len, dim]`.
    pub fn to_vec(&self) -> Vec<f32> {
        let mut out = vec![0.0; self.len * self.dim];
        self.copy_rows(0..self.len, &mut out);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_laid_side_by_side() {
        let rows = Rows::join(&[(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 2), (&[10.0, 20.0, 30.0], 1)]);
        assert_eq!((rows.len(), rows.dim()), (3, 3));
        let mut out = [0.0; 6];
        rows.copy_rows(1..3, &mut out);
        assert_eq!(out, [3.0, 4.0, 20.0, 5.0, 6.0, 30.0]);
        assert_eq!(rows.to_vec(), [1.0, 2.0, 10.0, 3.0, 4.0, 20.0, 5.0, 6.0, 30.0]);
    }

    #[test]
    fn a_row_without_a_successor_is_no_point() {
        let mut t = Transitions::new(1, 1);
        (0..4).for_each(|i| t.push(&[i as f32], &[0.5], 0.0, &[i as f32 + 1.0], i == 1, false));
        assert_eq!(Rows::transitions(&t).len(), 4);
        t.known[1] = false;
        let rows = Rows::transitions(&t);
        assert_eq!((rows.len(), rows.dim()), (3, 3));
        assert_eq!(rows.to_vec(), [0.0, 0.5, 1.0, 2.0, 0.5, 3.0, 3.0, 0.5, 4.0]);
    }
}
