//! Finds the ends of episodes, the order of the rows and the known successors. Facts about the public files:
//! `datasets.md`.
//!
//! There are up to three sources: marks (`terminals`, `timeouts`), continuity (is the stored s'ᵢ the state of the next
//! row?), and a step limit that the caller passes. Continuity is tested within a tolerance per column ([`Continuity`]),
//! because successors are often stored with fewer digits. If marks and continuity contradict each other, continuity
//! wins, and a warning gives the rows.

use std::cell::LazyCell;

use rayon::prelude::*;

use super::marks::{Resolved, Table};
use super::report::{EpisodeEnds, Successors};
use super::rows::tell;
use super::steps::{Steps, doubts, in_place};
use crate::Transitions;

/// Largest number of interleaved environments (one row of each per step) that is searched for.
const MOST_ENVIRONMENTS: usize = 1024;
/// Number of rows from which a column's scale is estimated.
const SAMPLE: usize = 20_000;

/// Tests whether two states are the same up to rounding.
///
/// A column's tolerance is the largest of: a tenth of its median step, at most a hundredth of its spread; three times
/// the 90 % quantile of |s'ᵢ - sᵢ₊₁|, at most a fiftieth of its spread; the rounding error of float32 and six digits. A
/// reset to a state this close to the next one in every column is not seen as a break.
struct Continuity<'a> {
    table: &'a Table<'a>,
    next: &'a [f32],
    tolerance: &'a [f32],
}

/// The tolerance of each column; empty if the file stores no successors.
pub(super) fn tolerance(table: &Table<'_>) -> Vec<f32> {
    let Some(next) = table.next_observations else { return Vec::new() };
    let (d, n) = (table.dim, table.terminals.len());
    let sample: Vec<usize> = (0..n).step_by(n.div_ceil(SAMPLE)).collect();
    let column = |k: usize| {
        let s = |i: usize| f64::from(table.observations[i * d + k]);
        let count = sample.len() as f64;
        let mean = sample.iter().map(|&i| s(i)).sum::<f64>() / count;
        let spread = (sample.iter().map(|&i| (s(i) - mean).powi(2)).sum::<f64>() / count).sqrt();
        let largest = sample.iter().map(|&i| s(i).abs()).fold(0.0, f64::max);
        let mut steps: Vec<f64> = sample.iter().map(|&i| (f64::from(next[i * d + k]) - s(i)).abs()).collect();
        let middle = steps.len() / 2;
        let step = *steps.select_nth_unstable_by(middle, f64::total_cmp).1;
        // The 90 % quantile of |s'ᵢ - sᵢ₊₁| measures how the successors were rounded.
        let miss = |&i: &usize| (f64::from(next[i * d + k]) - f64::from(table.observations[(i + 1) * d + k])).abs();
        let mut misses: Vec<f64> = sample.iter().filter(|i| **i + 1 < n).map(miss).collect();
        let at = misses.len() * 9 / 10;
        let rounding = if misses.is_empty() { 0.0 } else { *misses.select_nth_unstable_by(at, f64::total_cmp).1 };
        let by_step = (0.1 * step).clamp(1e-4 * spread, 1e-2 * spread);
        by_step.max((3.0 * rounding).min(2e-2 * spread)).max(2e-6 * largest) as f32
    };
    (0..d).map(column).collect()
}

impl Continuity<'_> {
    /// Whether row i + lag exists and its state is the stored successor of row i.
    fn joined(&self, i: usize, lag: usize) -> bool {
        let d = self.table.dim;
        if i + lag >= self.table.terminals.len() {
            return false;
        }
        let (next, state) =
            (&self.next[i * d..(i + 1) * d], &self.table.observations[(i + lag) * d..(i + lag + 1) * d]);
        same_bits(next, state) || next.iter().zip(state).zip(self.tolerance).all(|((a, b), t)| (a - b).abs() <= *t)
    }

    /// For every row, whether the next row continues it.
    fn all(&self) -> Vec<bool> {
        (0..self.table.terminals.len()).into_par_iter().map(|i| self.joined(i, 1)).collect()
    }
}

/// Compares sixteen columns at a time, which takes a few instructions. Most rows are continued and have the same bits.
fn same_bits(a: &[f32], b: &[f32]) -> bool {
    let differ = |(a, b): (&[f32], &[f32])| a.iter().zip(b).fold(0, |bits, (a, b)| bits | (a.to_bits() ^ b.to_bits()));
    a.chunks(16).zip(b.chunks(16)).all(|pair| differ(pair) == 0)
}

/// In which row the state s'ᵢ is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Lag {
    /// In row i + 1, or in no particular one.
    Next,
    /// In row i + k, because the rows of k environments take turns.
    Turns(usize),
    /// In row i + k of one robot, whose rows are in order: each row is k steps.
    Later(usize),
}

impl Lag {
    /// The number of environments that take turns.
    pub fn environments(self) -> usize {
        match self {
            Self::Turns(environments) => environments,
            Self::Next | Self::Later(_) => 1,
        }
    }
}

/// Finds the row of most successors. Rows that take turns and rows of several steps each look the same to s'; the
/// distances between neighbours tell them apart, and so do the marks.
pub(super) fn lag(table: &Table<'_>, tolerance: &[f32]) -> Lag {
    let n = table.terminals.len();
    let Some(next) = table.next_observations else { return Lag::Next };
    let continuity = Continuity { table, next, tolerance };
    let sample: Vec<usize> = (0..n).step_by(n.div_ceil(2000)).collect();
    let share = |lag: usize| {
        let rows: Vec<_> = sample.iter().filter(|&&i| i + lag < n).collect();
        rows.iter().filter(|&&&i| continuity.joined(i, lag)).count() as f64 / rows.len().max(1) as f64
    };
    if share(1) > 0.5 {
        return Lag::Next;
    }
    let mut lags = 2..=MOST_ENVIRONMENTS.min(n / 2);
    match lags.find(|&lag| share(lag) > 0.5) {
        None => Lag::Next,
        Some(lag) if Steps::new(table).nearer_than(lag) || marked_as_one(&continuity, lag) => Lag::Later(lag),
        Some(lag) => Lag::Turns(lag),
    }
}

/// Whether the marks are those of one robot: at the end of an episode, its last `lag` rows have no successor `lag` rows
/// further on, and only the last of them is marked. Where environments take turns, the row before a marked one is
/// another environment's, which goes on or has a mark of its own.
fn marked_as_one(continuity: &Continuity<'_>, lag: usize) -> bool {
    let table = continuity.table;
    let marked = |i: usize| table.terminals[i] || table.timeouts.is_some_and(|timeouts| timeouts[i]);
    let broken = |i: usize| !continuity.joined(i, lag);
    let ends: Vec<usize> = (1..table.terminals.len() - lag).filter(|&i| marked(i) && broken(i)).collect();
    2 * ends.iter().filter(|&&i| broken(i - 1) && !marked(i - 1)).count() > ends.len()
}

/// The indices of `n` interleaved rows, sorted by environment.
pub(super) fn untangled(n: usize, environments: usize) -> Vec<usize> {
    (0..environments).flat_map(|k| (k..n).step_by(environments)).collect()
}

/// Whether some row that does not end an episode has a successor other than the next row's state.
pub(super) fn has_unmarked_ends(table: &Table<'_>) -> bool {
    let (Some(next), Some(timeouts)) = (table.next_observations, table.timeouts) else { return true };
    let tolerance = tolerance(table);
    let continuity = Continuity { table, next, tolerance: &tolerance };
    let last = table.terminals.len() - 1;
    (0..last).into_par_iter().any(|i| !table.terminals[i] && !timeouts[i] && !continuity.joined(i, 1))
}

/// For every row, whether the next row continues it: no mark ends the episode, and the next row's state is s' up to
/// rounding, as when a file is read. The marks alone do not tell it: where a file without `timeouts` stores its
/// successors in another way, ends of episodes stay unmarked, and s' is not the next row's state.
pub fn continued(t: &Transitions) -> Vec<bool> {
    let table = Table::of(t, None);
    let Some(next) = table.next_observations else { return Vec::new() };
    let tolerance = tolerance(&table);
    let mut joined = Continuity { table: &table, next, tolerance: &tolerance }.all();
    let ended = t.terminals.iter().zip(&t.timeouts).map(|(terminal, timeout)| *terminal || *timeout);
    joined.iter_mut().zip(ended).for_each(|(joined, ended)| *joined &= !ended);
    joined
}

/// Decides where episodes end and which successors are known. The rows must be in order.
pub(super) fn resolve(table: &Table<'_>, tolerance: &[f32], lag: Lag) -> Resolved {
    if let Lag::Later(steps) = lag {
        return some_steps_later(table, steps);
    }
    match (table.next_observations, table.timeouts) {
        (Some(next), timeouts) => {
            let mut joined = Continuity { table, next, tolerance }.all();
            cut_between(&mut joined, lag.environments());
            match timeouts {
                Some(timeouts) => by_marks(table, timeouts, &joined),
                None => by_continuity(table, &joined),
            }
        }
        (None, Some(timeouts)) => {
            let mut warnings = Vec::new();
            let timeouts = in_place(table, timeouts, &mut warnings);
            let mut out = next_rows(table, timeouts, EpisodeEnds::Marks);
            warnings.extend(doubts(table, &out));
            out.warnings.splice(0..0, warnings);
            out
        }
        (None, None) => {
            let ends = table.limit.map_or(EpisodeEnds::Terminals, EpisodeEnds::StepLimit);
            let warning = match table.limit {
                Some(n) => format!("no `timeouts` field: episodes are taken to end after {n} steps or at a terminal"),
                None => {
                    "neither `timeouts` nor `next_observations`: episodes are taken to end at terminals only".into()
                }
            };
            let mut out = next_rows(table, count_timeouts(table.terminals, table.limit), ends);
            out.warnings.insert(0, warning);
            out.warnings.extend(doubts(table, &out));
            out
        }
    }
}

/// Marks the last row of each environment as not continued: another environment's rows follow.
fn cut_between(joined: &mut [bool], environments: usize) {
    let n = joined.len();
    let mut end = 0;
    for k in 0..environments {
        end += (n - k).div_ceil(environments);
        joined[end - 1] = false;
    }
}

/// Handles a file with stored successors and `timeouts`.
fn by_marks(table: &Table<'_>, timeouts: &[bool], joined: &[bool]) -> Resolved {
    let last = table.terminals.len() - 1;
    let rows_of = |what: &dyn Fn(usize) -> bool| (0..last).filter(|&i| what(i)).collect::<Vec<_>>();
    let ended = |i: usize| table.terminals[i] || timeouts[i];
    let ends = rows_of(&ended);
    let joined_ends = rows_of(&|i| ended(i) && joined[i]);
    let joined_timeouts = rows_of(&|i| timeouts[i] && !table.terminals[i] && joined[i]);
    let breaks = rows_of(&|i| !ended(i) && !joined[i]);
    // Computed only for doubtful files.
    let steps = LazyCell::new(|| Steps::new(table));
    if breaks.len() * 2 > last.max(1) && steps.in_order() {
        let mut out = Resolved::new(timeouts.to_vec(), Successors::Stored, EpisodeEnds::Marks);
        out.warnings.push(elsewhere(breaks.len(), last));
        return out;
    }
    if breaks.len() * 2 > last.max(1) {
        let mut out = Resolved::new(timeouts.to_vec(), Successors::Stored, EpisodeEnds::NoOrder);
        breaks.iter().for_each(|&i| out.timeouts[i] = true);
        out.warnings.push(no_order(breaks.len(), last));
        return out;
    }
    // Signs of successors built from the next row: equal to it at every end, no other breaks, the state jumps there.
    let many = joined_ends.len() * 10 > last.max(10);
    if joined_ends.len() * 2 > ends.len()
        && breaks.len() * 4 < joined_ends.len()
        && !many
        && steps.jump_at(&joined_ends)
    {
        let mut out = rebuilt(table, timeouts, joined);
        breaks.iter().for_each(|&i| out.timeouts[i] = true);
        return out;
    }
    let marks = rows_of(&|i| timeouts[i]);
    let mut out = Resolved::new(timeouts.to_vec(), Successors::Stored, EpisodeEnds::Marks);
    if (0..last).all(|i| joined[i]) {
        // Such successors carry no more information than the next rows.
        let moved = in_place(table, timeouts, &mut out.warnings);
        if moved != timeouts {
            let mut told = std::mem::take(&mut out.warnings);
            let mut out = rebuilt(table, &moved, joined);
            told.append(&mut out.warnings);
            return Resolved { warnings: told, ..out };
        }
        let doubts = doubts(table, &out);
        out.warnings.extend(doubts);
    }
    if !breaks.is_empty() {
        reconcile(&mut out, &marks, &joined_timeouts, &breaks);
    }
    breaks.iter().for_each(|&i| out.timeouts[i] = true);
    out.warnings.extend(displaced_terminals(table, joined));
    out.warnings.extend(held_terminals(table, joined));
    out
}

/// Prefers the `breaks` between states to the time-out `marks`; `joined_timeouts`: marks that the next row continues.
fn reconcile(out: &mut Resolved, marks: &[usize], joined_timeouts: &[usize], breaks: &[usize]) {
    if joined_timeouts.len() * 2 > marks.len() {
        joined_timeouts.iter().for_each(|&i| out.timeouts[i] = false);
        out.ends = EpisodeEnds::Continuity;
        out.warnings.push(format!(
            "`timeouts` contradicts the states: it marks {}, which the next row continues, and not {}, where s' is not the next row's \
             state. Episodes end where the states say; correct `timeouts` (is it shifted?)",
            tell(joined_timeouts),
            tell(breaks)
        ));
    } else {
        // A mark one row away from a visible end belongs to that end.
        let beside = |i: &&usize| {
            breaks.binary_search(&(**i + 1)).is_ok() || **i > 0 && breaks.binary_search(&(**i - 1)).is_ok()
        };
        let displaced: Vec<usize> = joined_timeouts.iter().filter(beside).copied().collect();
        if !displaced.is_empty() {
            displaced.iter().for_each(|&i| out.timeouts[i] = false);
            out.warnings.push(format!(
                "`timeouts` marks {}, which the next row continues, one row from an end: the marks were moved",
                tell(&displaced)
            ));
        }
        if marks.is_empty() {
            out.ends = EpisodeEnds::Continuity;
        }
        out.warnings.push(format!(
            "`timeouts` does not mark {}, where s' is not the next row's state: episodes end there, too",
            tell(breaks)
        ));
    }
}

/// Warns if a terminal row is followed by its own successor, which is also terminal.
fn held_terminals(table: &Table<'_>, joined: &[bool]) -> Option<String> {
    let t = table.terminals;
    let held: Vec<usize> = (0..t.len().saturating_sub(1)).filter(|&i| t[i] && t[i + 1] && joined[i]).collect();
    (!held.is_empty()).then(|| {
        format!(
            "`terminals` stays true after {}: nothing is bootstrapped there, and each such row is an episode; a terminal is the row in which \
             the episode ends",
            tell(&held)
        )
    })
}

fn elsewhere(breaks: usize, n: usize) -> String {
    format!(
        "the stored next_observations are not the next row's state in {breaks} of {n} rows, although the rows are in order (other digits, other \
         columns, or some steps later?): they are used as they are, and episodes end where the file marks it"
    )
}

/// Handles rows in order whose stored successors are the state `steps` rows later.
fn some_steps_later(table: &Table<'_>, steps: usize) -> Resolved {
    let (timeouts, ends) = match table.timeouts {
        Some(timeouts) => (timeouts.to_vec(), EpisodeEnds::Marks),
        None => (vec![false; table.terminals.len()], EpisodeEnds::Terminals),
    };
    let mut out = Resolved::new(timeouts, Successors::Stored, ends);
    out.warnings.push(format!(
        "the stored next_observations are the state {steps} rows later, although the rows are in order (is each row {steps} steps?): they are \
         used as they are, and episodes end where the file marks it"
    ));
    out
}

/// Handles a file whose stored successors are the next row's state even at ends, where the true ones are unknown.
fn rebuilt(table: &Table<'_>, timeouts: &[bool], joined: &[bool]) -> Resolved {
    let last = table.terminals.len() - 1;
    let mut out = Resolved::new(timeouts.to_vec(), Successors::NextRow, EpisodeEnds::Marks);
    for i in 0..=last {
        let unknown = i == last || (joined[i] && (table.terminals[i] || timeouts[i]));
        if unknown && table.terminals[i] {
            out.known[i] = false;
        } else if unknown {
            out.keep[i] = false;
            *(if i == last { &mut out.dropped.last_row } else { &mut out.dropped.time_out }) += 1;
        }
    }
    out.warnings.push(
        "the stored next_observations are the following row's state even where an episode ends; there they are treated as absent"
            .into(),
    );
    out
}

/// Handles a file with stored successors and without `timeouts`.
///
/// An episode ends at a terminal, after `limit` steps, where s'ᵢ ≠ sᵢ₊₁, and at the last row. If an episode ended by a
/// terminal or the limit and its last stored successor is the following row's state, that successor was built as sᵢ₊₁
/// and is wrong: it is the next episode's first state. A last row that ended so then has a wrong successor, too.
fn by_continuity(table: &Table<'_>, joined: &[bool]) -> Resolved {
    let n = table.terminals.len();
    let breaks = (0..n - 1).filter(|&i| !joined[i] && !table.terminals[i]).count();
    let displaced = displaced_terminals(table, joined);
    // Computed only for doubtful files.
    let steps = LazyCell::new(|| Steps::new(table));
    if breaks * 2 > n && steps.in_order() {
        let mut out = Resolved::new(vec![false; n], Successors::Stored, EpisodeEnds::Terminals);
        out.warnings.push(elsewhere(breaks, n));
        return out;
    }
    let joined_terminals: Vec<usize> = (0..n - 1).filter(|&i| table.terminals[i] && joined[i]).collect();
    let rebuilt = displaced.is_none()
        && !joined_terminals.is_empty()
        && joined_terminals.len() * 10 <= n.max(10)
        && steps.jump_at(&joined_terminals);
    let mut out = Resolved::new(vec![false; n], Successors::Stored, EpisodeEnds::Continuity);
    let (mut any, mut start) = (false, 0);
    for (i, &continues) in joined.iter().enumerate() {
        let by_limit = Some(i + 1 - start) == table.limit;
        // If the state does not jump after a terminal, its stored successor is right.
        let over = by_limit || (table.terminals[i] && rebuilt);
        if over || table.terminals[i] || !continues {
            out.timeouts[i] = !table.terminals[i];
            start = i + 1;
        }
        let wrong = over && (continues || (i + 1 == n && any));
        any |= wrong;
        match (wrong, table.terminals[i]) {
            (true, true) => out.known[i] = false,
            (true, false) => {
                out.keep[i] = false;
                out.dropped.wrong_successor += 1;
            }
            (false, _) => {}
        }
    }
    if (0..n - 1).all(|i| joined[i]) {
        let doubts = doubts(table, &out);
        out.warnings.extend(doubts);
    }
    if breaks * 2 > n {
        out.ends = EpisodeEnds::NoOrder;
        out.warnings.push(no_order(breaks, n));
    }
    out.warnings.extend(displaced);
    out.warnings.extend(held_terminals(table, joined));
    out
}

/// Warns if most terminals are followed by their own successor, while an episode visibly ends one row before or after.
fn displaced_terminals(table: &Table<'_>, joined: &[bool]) -> Option<String> {
    let last = table.terminals.len() - 1;
    let terminals: Vec<usize> = (0..last).filter(|&i| table.terminals[i]).collect();
    let ends = |i: usize| i < last && !table.terminals[i] && !joined[i];
    let displaced: Vec<usize> =
        terminals.iter().copied().filter(|&i| joined[i] && (ends(i + 1) || (i > 0 && ends(i - 1)))).collect();
    (!displaced.is_empty() && displaced.len() * 2 > terminals.len()).then(|| {
        format!(
            "`terminals` contradicts the states: it marks {}, which the next row continues, while an episode ends one row away. \
             The flags are used as they are; correct `terminals` (is it shifted?)",
            tell(&displaced)
        )
    })
}

fn no_order(breaks: usize, n: usize) -> String {
    format!(
        "the rows are in no order: s' is not the next row's state in {breaks} of {n} rows. Single transitions are used as they are; what \
         follows episodes (returns, the better trajectories, sequence models) cannot be told from this file"
    )
}

/// D4RL's `qlearning_dataset` for files without successors: s'ᵢ = sᵢ₊₁. Time-out rows and the last row have no
/// successor and are dropped. Terminal rows have none either, but nothing is bootstrapped there: they stay, marked.
fn next_rows(table: &Table<'_>, timeouts: Vec<bool>, ends: EpisodeEnds) -> Resolved {
    let last = timeouts.len() - 1;
    let mut out = Resolved::new(timeouts, Successors::NextRow, ends);
    for i in 0..=last {
        if table.terminals[i] {
            out.known[i] = false;
            out.timeouts[i] = false;
        } else if i == last || out.timeouts[i] {
            out.keep[i] = false;
            *(if i == last { &mut out.dropped.last_row } else { &mut out.dropped.time_out }) += 1;
        }
    }
    out
}

/// Marks rows where the step limit cut an episode, as D4RL does, for files without `timeouts` and `next_observations`.
fn count_timeouts(terminals: &[bool], limit: Option<usize>) -> Vec<bool> {
    let mut steps = 0;
    let full = |&terminal: &bool| {
        steps += 1;
        let full = Some(steps) == limit;
        if terminal || full {
            steps = 0;
        }
        full
    };
    terminals.iter().map(full).collect()
}
