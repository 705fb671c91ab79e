//! Finds constraints that the columns of observations satisfy, and applies them to generated rows.
//!
//! A generative model with smooth outputs produces values that a sensor never produces. [`Support::fit`] finds four
//! kinds of columns. Each column has at most one kind, the first that fits:
//!
//! | kind | found if | [`Support::apply`] |
//! |---|---|---|
//! | constant | all rows are equal | puts the constant back |
//! | few values (flags, counters) | 2 to 8 distinct values in 1000 rows or more | rounds to the nearest of them |
//! | unit vector: 4 neighbouring columns (a quaternion) or 2 (cosine and sine) | norm 1 within .001 in 99 % of every table's rows, and far steadier than the columns themselves | divides by the norm |
//! | clipped | an atom at the minimum or the maximum, see [`Clip`] | clamps at that end |
//!
//! All other columns keep their bytes. Nothing is concluded from fewer than 100 rows.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// The fewest rows from which anything is concluded.
const LEAST_ROWS: usize = 100;
/// The fewest rows for which a small number of distinct values is meaningful, and the largest such number.
const LEVEL_ROWS: usize = 1000;
const MOST_LEVELS: usize = 8;
/// An atom: at least this many rows, and this share of the rows of a table, have exactly the extreme value.
const ATOM_ROWS: usize = 5;
const ATOM_SHARE: f64 = 0.002;
/// Ordinary values occur at most twice (a table may hold s and s'). This share of the distinct values must be ordinary.
const ORDINARY_COUNT: usize = 2;
const ORDINARY_SHARE: f64 = 0.75;
/// A norm must be 1 within this tolerance in this share of the rows.
const NORM_TOLERANCE: f64 = 1e-3;
const NORM_SHARE: f64 = 0.99;
/// Largest deviation of the squared norm from 1 (root mean square), relative to independent columns of the same spread.
const NORM_STEADINESS: f64 = 0.05;
/// Rounding error of a normalised float32 vector. Within it nothing is changed: a second application has no effect.
const NORM_ROUNDING: f64 = 4e-7;

/// A constant column.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Constant {
    /// Column index, from 0.
    pub column: usize,
    /// Its value.
    pub value: f32,
}

/// A column with few distinct values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Levels {
    /// Column index, from 0.
    pub column: usize,
    /// The distinct values, ascending; 2 to 8.
    pub values: Vec<f32>,
}

/// A bound at which a column is clipped.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bound {
    /// The extreme value, in the column's units.
    pub value: f32,
    /// Number of rows of all tables that have exactly this value.
    pub rows: usize,
}

/// A clipped column.
///
/// An end is clipped if at least 5 rows and .2 % of the rows of one table have exactly the extreme value of all tables,
/// while three quarters of that table's other distinct values occur at most twice. An end is also clipped if its
/// extreme value is exactly plus or minus a bound found in this way in another column: one sensor clips all its columns
/// at the same bound, and a continuous column practically never ends exactly there. (0 does not count as such a bound.)
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Clip {
    /// Column index, from 0.
    pub column: usize,
    /// The lower bound, if the column is clipped there.
    pub low: Option<Bound>,
    /// The upper bound, if the column is clipped there.
    pub high: Option<Bound>,
}

/// Neighbouring columns that form a unit vector.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UnitGroup {
    /// Index of the first column, from 0.
    pub first: usize,
    /// Number of columns: 4 (a quaternion) or 2 (cosine and sine).
    pub width: usize,
}

/// The constraints that the columns of some tables satisfy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Support {
    /// Number of columns.
    pub dim: usize,
    /// Number of rows of all tables together.
    pub rows: usize,
    /// Constant columns, ascending.
    pub constants: Vec<Constant>,
    /// Columns with few distinct values, ascending.
    pub levels: Vec<Levels>,
    /// Unit vectors, ascending, not overlapping.
    pub units: Vec<UnitGroup>,
    /// Clipped columns, ascending.
    pub clips: Vec<Clip>,
}

impl Support {
    /// Finds the constraints of row-major `tables` with `dim` columns each (s and s' are separate tables). A constraint
    /// must hold in all tables together. An atom in one table is enough: a large source must not hide a small target.
    ///
    /// Columns with NaN or infinity are left alone.
    ///
    /// # Panics
    /// If a table is not rectangular.
    pub fn fit(tables: &[&[f32]], dim: usize) -> Self {
        assert!(tables.iter().all(|t| t.len() % dim.max(1) == 0), "the tables are not rows of {dim}");
        let rows = tables.iter().map(|t| t.len() / dim.max(1)).sum();
        let mut out =
            Support { dim, rows, constants: Vec::new(), levels: Vec::new(), units: Vec::new(), clips: Vec::new() };
        if rows < LEAST_ROWS || dim == 0 {
            return out;
        }
        let columns = Column::scan(tables, dim);
        let mut free: Vec<bool> = columns.iter().map(|c| c.finite).collect();
        for (column, c) in columns.iter().enumerate().filter(|(_, c)| c.finite) {
            match c.levels.len() {
                1 => out.constants.push(Constant { column, value: c.levels[0] }),
                2..=MOST_LEVELS if rows >= LEVEL_ROWS => out.levels.push(Levels { column, values: c.levels.clone() }),
                _ => continue,
            }
            free[column] = false;
        }
        out.units = unit_groups(tables, dim, &free);
        for group in &out.units {
            free[group.first..group.first + group.width].fill(false);
        }
        out.clips = clips(tables, dim, &columns, &free);
        out
    }

    /// Changes row-major `rows` in place so that they satisfy the constraints. A second application changes nothing.
    /// NaN stays NaN (except in constant columns); a vector of length zero is not changed.
    ///
    /// # Panics
    /// If `rows` is not rectangular.
    pub fn apply(&self, rows: &mut [f32]) {
        assert_eq!(rows.len() % self.dim.max(1), 0, "not rows of {}", self.dim);
        for row in rows.chunks_exact_mut(self.dim.max(1)) {
            for c in &self.constants {
                // -0 and 0 are the same value: if the value is right, its bytes are kept.
                if row[c.column] != c.value {
                    row[c.column] = c.value;
                }
            }
            for c in &self.levels {
                row[c.column] = nearest(&c.values, row[c.column]);
            }
            for g in &self.units {
                normalise(&mut row[g.first..g.first + g.width]);
            }
            for c in &self.clips {
                let x = &mut row[c.column];
                match (c.low, c.high) {
                    (Some(low), _) if *x < low.value => *x = low.value,
                    (_, Some(high)) if *x > high.value => *x = high.value,
                    _ => {}
                }
            }
        }
    }

    /// Whether no constraint was found, so that [`Support::apply`] changes nothing.
    pub fn is_empty(&self) -> bool {
        self.constants.is_empty() && self.levels.is_empty() && self.units.is_empty() && self.clips.is_empty()
    }

    /// One sentence for every finding. Neighbouring columns with the same constant share one. Columns count from 0.
    pub fn describe(&self) -> Vec<String> {
        let mut out = Vec::new();
        let same = |a: &Constant, b: &Constant| a.column + 1 == b.column && a.value == b.value;
        for run in self.constants.chunk_by(same) {
            let value = run[0].value + 0.0;
            match (run.first(), run.last()) {
                (Some(a), Some(b)) if a.column < b.column => {
                    out.push(format!("Columns {} to {} are always {value}: put back to it.", a.column, b.column));
                }
                _ => out.push(format!("Column {} is always {value}: put back to it.", run[0].column)),
            }
        }
        for c in &self.levels {
            let values: Vec<String> = c.values.iter().map(f32::to_string).collect();
            out.push(format!(
                "Column {} has only the values {}: rounded to the nearest of them.",
                c.column,
                values.join(", ")
            ));
        }
        for g in &self.units {
            out.push(match g.width {
                4 => format!("Columns {} to {} are a unit quaternion: normalised.", g.first, g.first + 3),
                _ => format!("Columns {} and {} lie on the unit circle: normalised.", g.first, g.first + 1),
            });
        }
        for c in &self.clips {
            let ends: Vec<String> = [c.low, c.high]
                .iter()
                .flatten()
                .map(|b| {
                    format!("at {} ({:.2} % of the rows)", b.value, 100.0 * b.rows as f64 / self.rows.max(1) as f64)
                })
                .collect();
            out.push(format!("Column {} is clipped {}: clamped there.", c.column, ends.join(" and ")));
        }
        out
    }
}

/// The result of one pass over a column.
struct Column {
    finite: bool,
    min: f32,
    max: f32,
    /// The distinct values, ascending, if there are at most [`MOST_LEVELS`]; otherwise one more than that.
    levels: Vec<f32>,
}

impl Column {
    /// Scans all columns in one pass over the rows: a million rows of 111 columns do not fit into a cache.
    fn scan(tables: &[&[f32]], dim: usize) -> Vec<Column> {
        let new = || Column { finite: true, min: f32::INFINITY, max: f32::NEG_INFINITY, levels: Vec::new() };
        let mut columns: Vec<Column> = (0..dim).map(|_| new()).collect();
        for row in tables.iter().flat_map(|t| t.chunks_exact(dim)) {
            for (c, &x) in columns.iter_mut().zip(row) {
                c.finite &= x.is_finite();
                (c.min, c.max) = (c.min.min(x), c.max.max(x));
                if c.levels.len() <= MOST_LEVELS && !c.levels.contains(&x) {
                    c.levels.push(x);
                }
            }
        }
        columns.iter_mut().for_each(|c| c.levels.sort_by(f32::total_cmp));
        columns
    }
}

fn values(table: &[f32], dim: usize, column: usize) -> impl Iterator<Item = &f32> {
    table.iter().skip(column).step_by(dim)
}

/// The nearest of `values` (ascending); the smaller one of two equally near values. NaN stays NaN.
fn nearest(values: &[f32], x: f32) -> f32 {
    if x.is_nan() || values.contains(&x) {
        return x;
    }
    let distance = |v: f32| (v as f64 - x as f64).abs();
    values.iter().copied().reduce(|best, v| if distance(v) < distance(best) { v } else { best }).unwrap_or(x)
}

fn normalise(vector: &mut [f32]) {
    let norm = squared_norm(vector).sqrt();
    if !norm.is_finite() || norm == 0.0 || (norm - 1.0).abs() <= NORM_ROUNDING {
        return;
    }
    vector.iter_mut().for_each(|x| *x = (*x as f64 / norm) as f32);
}

fn squared_norm(vector: &[f32]) -> f64 {
    vector.iter().map(|&x| (x as f64).powi(2)).sum()
}

/// All windows of `free` columns that are unit vectors. Of overlapping windows, those with the steadiest norm are kept.
fn unit_groups(tables: &[&[f32]], dim: usize, free: &[bool]) -> Vec<UnitGroup> {
    let windows: Vec<UnitGroup> = [4, 2]
        .into_iter()
        .flat_map(|width| (0..=dim.saturating_sub(width)).map(move |first| UnitGroup { first, width }))
        .filter(|g| g.first + g.width <= dim && free[g.first..g.first + g.width].iter().all(|f| *f))
        .collect();
    let mut found: Vec<(f64, UnitGroup)> =
        windows.into_par_iter().filter_map(|g| Some((deviation(tables, dim, g)?, g))).collect();
    found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.first.cmp(&b.1.first)));
    let mut out: Vec<UnitGroup> = Vec::new();
    for (_, g) in found {
        if out.iter().all(|o| o.first + o.width <= g.first || g.first + g.width <= o.first) {
            out.push(g);
        }
    }
    out.sort_by_key(|g| g.first);
    out
}

/// Root mean square of the squared norm's deviation from 1; `None` if the columns are not a unit vector.
fn deviation(tables: &[&[f32]], dim: usize, group: UnitGroup) -> Option<f64> {
    let (mut within, mut squares) = (0usize, 0.0f64);
    let mut sums = [(0.0f64, 0.0f64); 4];
    for table in tables {
        let rows = table.len() / dim;
        let may_fail = ((1.0 - NORM_SHARE) * rows as f64) as usize;
        let mut failed = 0;
        for row in table.chunks_exact(dim) {
            let vector = &row[group.first..group.first + group.width];
            let square = squared_norm(vector);
            if (square.sqrt() - 1.0).abs() > NORM_TOLERANCE {
                failed += 1;
                if failed > may_fail {
                    return None;
                }
                continue;
            }
            within += 1;
            squares += (square - 1.0).powi(2);
            for (sum, &x) in sums.iter_mut().zip(vector) {
                let x2 = (x as f64).powi(2);
                *sum = (sum.0 + x2, sum.1 + x2 * x2);
            }
        }
    }
    let n = within as f64;
    let deviation = (squares / n).sqrt();
    let independent: f64 = sums.iter().map(|s| (s.1 / n - (s.0 / n).powi(2)).max(0.0)).sum();
    (within > 0 && deviation <= NORM_STEADINESS * independent.sqrt()).then_some(deviation)
}

/// Clipped columns among the `free` ones.
fn clips(tables: &[&[f32]], dim: usize, columns: &[Column], free: &[bool]) -> Vec<Clip> {
    let candidates: Vec<usize> = (0..dim).filter(|&d| free[d]).collect();
    // For each candidate and end: the number of rows at the extreme value, and whether they are an atom.
    let ends: Vec<[(Bound, bool); 2]> = candidates
        .par_iter()
        .map(|&d| [columns[d].min, columns[d].max].map(|extreme| atom(tables, dim, d, extreme)))
        .collect();
    let bounds: Vec<f32> =
        ends.iter().flatten().filter(|(b, atom)| *atom && b.value != 0.0).map(|(b, _)| b.value.abs()).collect();
    let clipped = |(b, atom): (Bound, bool)| (atom || bounds.contains(&b.value.abs())).then_some(b);
    candidates
        .into_iter()
        .zip(ends)
        .map(|(column, [low, high])| Clip { column, low: clipped(low), high: clipped(high) })
        .filter(|c| c.low.is_some() || c.high.is_some())
        .collect()
}

/// Number of rows that have exactly the `extreme` value, and whether they are an atom in one of the tables.
fn atom(tables: &[&[f32]], dim: usize, column: usize, extreme: f32) -> (Bound, bool) {
    let mut bound = Bound { value: extreme, rows: 0 };
    let mut is_atom = false;
    for table in tables {
        let rows = table.len() / dim;
        let at = values(table, dim, column).filter(|x| **x == extreme).count();
        bound.rows += at;
        is_atom = is_atom
            || (at >= ATOM_ROWS
                && at as f64 >= ATOM_SHARE * rows as f64
                && mostly_distinct(table, dim, column, extreme));
    }
    (bound, is_atom)
}

/// Whether most distinct values of a column other than `extreme` are ordinary ones.
fn mostly_distinct(table: &[f32], dim: usize, column: usize, extreme: f32) -> bool {
    let mut others: Vec<f32> = values(table, dim, column).copied().filter(|x| *x != extreme).collect();
    others.par_sort_unstable_by(f32::total_cmp);
    let (mut distinct, mut ordinary) = (0usize, 0usize);
    for equal in others.chunk_by(|a, b| a == b) {
        distinct += 1;
        ordinary += (equal.len() <= ORDINARY_COUNT) as usize;
    }
    distinct > MOST_LEVELS && ordinary as f64 >= ORDINARY_SHARE * distinct as f64
}

#[cfg(test)]
mod tests;
