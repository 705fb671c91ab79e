//! Distances between consecutive states: they show where episodes end if stored successors are absent or uninformative.

use super::marks::{Resolved, Table};
use super::rows::tell;

/// The steps between consecutive rows, in units of the columns' spreads.
pub(super) struct Steps<'a> {
    table: &'a Table<'a>,
    lengths: Vec<f32>,
    median: f32,
}

impl<'a> Steps<'a> {
    pub fn new(table: &'a Table<'a>) -> Self {
        let lengths = step_lengths(table.observations, table.dim, 1);
        let median = median(lengths.iter().copied());
        Self { table, lengths, median }
    }

    /// Whether the state jumps after these rows, as it does where a new episode begins. On the public sets such steps
    /// are 1.8 to 56 times the usual one.
    pub fn jump_at(&self, rows: &[usize]) -> bool {
        // With one or two ends, the steps may be long by chance.
        let jump = if rows.len() < 3 { 3.0 * JUMP } else { JUMP };
        median(rows.iter().map(|&i| self.lengths[i])) > jump * self.median
    }

    /// Whether a row is much closer to the next one than to any other. (Not true at HalfCheetah's pace.)
    pub fn in_order(&self) -> bool {
        let d = self.table.dim;
        let n = self.table.terminals.len();
        // A stride that is not close to a multiple of a short period.
        let far = (n as f64 * 0.381_966) as usize;
        let rows: Vec<f32> =
            (0..n).flat_map(|i| self.table.observations[((i + i * far) % n) * d..][..d].iter().copied()).collect();
        let apart = median(step_lengths(&rows, d, 1).into_iter());
        self.median < 0.6 * apart
    }

    /// Whether a row is closer to the next one than to the row `lag` further on, as the rows of one robot are.
    pub fn nearer_than(&self, lag: usize) -> bool {
        self.median < median(step_lengths(self.table.observations, self.table.dim, lag).into_iter())
    }
}

/// Smallest ratio of the median step into another episode to the usual step.
const JUMP: f32 = 1.4;

/// Returns `timeouts` of a file without successors, shifted by some rows if the states jump there and not at the marks.
pub(super) fn in_place(table: &Table<'_>, timeouts: &[bool], warnings: &mut Vec<String>) -> Vec<bool> {
    let n = timeouts.len();
    let reach = FURTHEST as usize;
    let marks: Vec<usize> = (reach..n.saturating_sub(reach + 1)).filter(|&i| timeouts[i]).collect();
    if marks.len() < 3 {
        return timeouts.to_vec();
    }
    let steps = Steps::new(table);
    let at = |shift: isize| median(marks.iter().map(|&i| steps.lengths[i.wrapping_add_signed(shift)]));
    let here = at(0);
    let (there, shift) =
        (-FURTHEST..=FURTHEST).map(|s| (at(s), s)).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((here, 0));
    if there <= 4.0 * here || there <= 4.0 * steps.median {
        return timeouts.to_vec();
    }
    warnings.push(format!(
        "`timeouts` contradicts the states: it marks {}, but the states jump {} {}. Episodes end where they jump; correct `timeouts`",
        tell(&marks),
        if shift.abs() == 1 { "one row".into() } else { format!("{} rows", shift.abs()) },
        if shift < 0 { "before" } else { "after" }
    ));
    (0..n).map(|i| i.checked_add_signed(-shift).and_then(|j| timeouts.get(j)).copied().unwrap_or(false)).collect()
}

/// Largest shift, in rows, that is tried between the marks and the jumps of the state.
const FURTHEST: isize = 5;

/// Warnings for a file without successors: jumps of the state where no episode ends; interleaved environments.
pub(super) fn doubts(table: &Table<'_>, out: &Resolved) -> Vec<String> {
    let steps = Steps::new(table);
    let ended = |i: usize| table.terminals[i] || out.timeouts[i];
    let mut told = Vec::new();
    let jumps = jumps(&steps.lengths, &ended);
    if !jumps.is_empty() {
        told.push(format!(
            "the state jumps after {}, far more than in a usual step, and no episode ends there: their s' is another episode's first state, if a \
             `timeouts` is missing or in other rows. Store `timeouts`, or `next_observations`",
            tell(&jumps)
        ));
    }
    let (d, n) = (table.dim, table.terminals.len());
    let apart = |lag: usize| {
        let rows = (0..n - lag).step_by((n - lag).div_ceil(2000));
        let pair = |i: usize| {
            let (a, b) = (&table.observations[i * d..][..d], &table.observations[(i + lag) * d..][..d]);
            a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>()
        };
        median(rows.map(pair))
    };
    if n > 1000 && !steps.in_order() {
        let near = apart(1);
        // These are squared distances: the ratio .1 is about a third of the distance.
        if let Some(k) = (2..=64).find(|&lag| apart(lag) < 0.1 * near) {
            told.push(format!(
                "states {k} rows apart are much closer than neighbours: do the rows of {k} environments take turns? Then every s' is another \
                 environment's. Store `next_observations`, or write one environment after the other (a gait of {k} steps looks the same)"
            ));
        }
    }
    told
}

/// Rows that do not end an episode and after which the state jumps: by more than 8 usual steps and 5 times the 95 %
/// quantile of the steps, at least three such rows. The contacts of walking robots stay below that.
fn jumps(lengths: &[f32], ended: &dyn Fn(usize) -> bool) -> Vec<usize> {
    let mut usual: Vec<f32> = (0..lengths.len()).filter(|&i| !ended(i)).map(|i| lengths[i]).collect();
    if usual.len() < 100 {
        return Vec::new();
    }
    let at = usual.len() * 95 / 100;
    let high = *usual.select_nth_unstable_by(at, f32::total_cmp).1;
    let bound = (8.0 * median(usual.into_iter())).max(5.0 * high);
    let rows: Vec<usize> = (0..lengths.len()).filter(|&i| bound > 0.0 && !ended(i) && lengths[i] > bound).collect();
    if rows.len() >= 3 { rows } else { Vec::new() }
}

/// The distance from each row to the row `lag` further on, in units of the columns' spreads.
fn step_lengths(observations: &[f32], dim: usize, lag: usize) -> Vec<f32> {
    let moments = crate::moments::Moments::of(&[crate::Rows::new(observations, dim)]);
    let scale: Vec<f32> = moments.std.iter().map(|&s| if s > 0.0 { 1.0 / s as f32 } else { 0.0 }).collect();
    let pairs = observations.chunks_exact(dim).zip(observations.chunks_exact(dim).skip(lag));
    let length = |(a, b): (&[f32], &[f32])| {
        a.iter().zip(b).zip(&scale).map(|((a, b), s)| ((b - a) * s).powi(2)).sum::<f32>().sqrt()
    };
    pairs.map(length).collect()
}

fn median(values: impl Iterator<Item = f32>) -> f32 {
    let mut values: Vec<f32> = values.collect();
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}
