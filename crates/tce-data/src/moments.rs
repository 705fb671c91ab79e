//! Mean, spread and range of every dimension, computed in f64, independent of the number of threads.

use rayon::prelude::*;

use crate::Rows;

/// Rows per partial sum. It is part of the definition of the result: sums are added in chunk order.
const CHUNK: usize = 4096;

/// Moments per dimension, over all rows of one or more tables. NaN and infinity are counted and left out.
#[derive(Clone, Debug)]
pub(crate) struct Moments {
    /// Rows with a finite value, `[dim]`.
    pub count: Vec<u64>,
    pub mean: Vec<f64>,
    /// Population standard deviation (divisor n), `[dim]`. Exactly 0 for a constant.
    pub std: Vec<f64>,
    pub min: Vec<f32>,
    pub max: Vec<f32>,
    pub nan: Vec<u64>,
    pub infinite: Vec<u64>,
}

struct Partial {
    count: Vec<u64>,
    sum: Vec<f64>,
    square: Vec<f64>,
    min: Vec<f32>,
    max: Vec<f32>,
    nan: Vec<u64>,
    infinite: Vec<u64>,
}

impl Partial {
    fn new(dim: usize) -> Self {
        Self {
            count: vec![0; dim],
            sum: vec![0.0; dim],
            square: vec![0.0; dim],
            min: vec![f32::INFINITY; dim],
            max: vec![f32::NEG_INFINITY; dim],
            nan: vec![0; dim],
            infinite: vec![0; dim],
        }
    }

    fn add_row(&mut self, row: &[f32], shift: &[f64]) {
        for (d, &x) in row.iter().enumerate() {
            if !x.is_finite() {
                self.nan[d] += x.is_nan() as u64;
                self.infinite[d] += x.is_infinite() as u64;
                continue;
            }
            let y = x as f64 - shift[d];
            self.count[d] += 1;
            self.sum[d] += y;
            self.square[d] += y * y;
            self.min[d] = self.min[d].min(x);
            self.max[d] = self.max[d].max(x);
        }
    }

    fn merge(&mut self, other: &Partial) {
        for d in 0..self.sum.len() {
            self.count[d] += other.count[d];
            self.sum[d] += other.sum[d];
            self.square[d] += other.square[d];
            self.min[d] = self.min[d].min(other.min[d]);
            self.max[d] = self.max[d].max(other.max[d]);
            self.nan[d] += other.nan[d];
            self.infinite[d] += other.infinite[d];
        }
    }
}

impl Moments {
    /// Computes the moments over all rows of all `tables`, which have the same dimension. There are two passes: the
    /// second measures the spread around the mean of the first, so that a large offset costs no digits.
    pub fn of(tables: &[Rows<'_>]) -> Self {
        let dim = tables.first().map_or(0, Rows::dim);
        assert!(tables.iter().all(|t| t.dim() == dim), "the tables have different dimensions");
        // Sums of differences from an actual row make the spread of a constant exactly zero.
        let mut first = vec![0.0f32; dim];
        if let Some(table) = tables.iter().find(|t| !t.is_empty()) {
            table.copy_row(0, &mut first);
        }
        let shift: Vec<f64> = first.iter().map(|&x| if x.is_finite() { x as f64 } else { 0.0 }).collect();
        let rough = pass(tables, &shift);
        let n = |d: usize| (rough.count[d] as f64).max(1.0);
        let mean: Vec<f64> = (0..dim).map(|d| shift[d] + rough.sum[d] / n(d)).collect();
        let fine = pass(tables, &mean);
        let std =
            (0..dim).map(|d| if rough.min[d] < rough.max[d] { (fine.square[d] / n(d)).sqrt() } else { 0.0 }).collect();
        Self { count: rough.count, mean, std, min: rough.min, max: rough.max, nan: rough.nan, infinite: rough.infinite }
    }
}

fn pass(tables: &[Rows<'_>], shift: &[f64]) -> Partial {
    let dim = shift.len();
    let mut total = Partial::new(dim);
    for table in tables {
        let chunks = table.len().div_ceil(CHUNK);
        let partials: Vec<Partial> = (0..chunks)
            .into_par_iter()
            .map(|c| {
                let mut partial = Partial::new(dim);
                let mut row = vec![0.0; dim];
                for i in c * CHUNK..((c + 1) * CHUNK).min(table.len()) {
                    table.copy_row(i, &mut row);
                    partial.add_row(&row, shift);
                }
                partial
            })
            .collect();
        partials.iter().for_each(|p| total.merge(p));
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_offset_costs_no_digits_and_a_constant_has_no_spread() {
        let n = 10_000;
        let data: Vec<f32> = (0..n).flat_map(|i| [1000.0 + (i % 2) as f32 * 0.125, 0.1]).collect();
        let m = Moments::of(&[Rows::new(&data, 2)]);
        assert!((m.mean[0] - 1000.0625).abs() < 1e-9 && (m.std[0] - 0.0625).abs() < 1e-12);
        assert_eq!((m.mean[1], m.std[1]), (0.1f32 as f64, 0.0));
        assert_eq!((m.min[0], m.max[0]), (1000.0, 1000.125));
    }

    #[test]
    fn nan_and_infinity_are_counted_and_left_out() {
        let data = [f32::NAN, 1.0, f32::INFINITY, 3.0, 2.0];
        let m = Moments::of(&[Rows::new(&data, 1)]);
        assert_eq!((m.count[0], m.nan[0], m.infinite[0], m.mean[0]), (3, 1, 1, 2.0));
    }

    #[test]
    fn several_tables_are_one_population() {
        let data: Vec<f32> = (0..20_000).map(|i| (i as f32 * 0.37).sin()).collect();
        let whole = Moments::of(&[Rows::new(&data, 2)]);
        let parts = Moments::of(&[Rows::new(&data[..6000], 2), Rows::new(&data[6000..], 2)]);
        for d in 0..2 {
            assert!((whole.mean[d] - parts.mean[d]).abs() < 1e-12 && (whole.std[d] - parts.std[d]).abs() < 1e-12);
        }
    }
}
