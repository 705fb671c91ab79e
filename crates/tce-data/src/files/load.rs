//! Reads a file into [`Transitions`].

use std::collections::BTreeMap;
use std::path::Path;

use super::episodes::{self, Lag};
use super::flat::Flat;
use super::formats::{Format, Raw};
use super::hdf5::Hdf5;
use super::marks::Table;
use super::minari::{Minari, main_file};
use super::options::LoadOptions;
use super::report::{Dropped, EpisodeEnds, Layout, LoadReport, Successors};
use super::robomimic::Robomimic;
use super::rows;
use crate::{DataError, Problem, Transitions};

/// All layouts, in the order in which they are tried. The last one accepts every file.
const FORMATS: [&dyn Format; 3] = [&Minari, &Robomimic, &Flat];

/// A validated data set.
#[derive(Clone, Debug, PartialEq)]
pub struct Loaded {
    /// The rows.
    pub transitions: Transitions,
    /// The requested further columns, each `[transitions.len()]`.
    pub columns: BTreeMap<String, Vec<f32>>,
    /// Describes what was read and what was left out.
    pub report: LoadReport,
}

/// Reads and validates an HDF5 file of transitions; see [`files`](crate::files) for the layouts.
///
/// # Errors
/// A missing or unreadable file, a file that is not HDF5, is truncated or damaged; a missing field, a wrong shape or
/// type; fields that contradict each other; NaN or infinity; a file without (usable) rows.
pub fn load(path: &Path, options: &LoadOptions) -> Result<Loaded, DataError> {
    let file = Hdf5::open(&main_file(path))?;
    let format = FORMATS.into_iter().find(|format| format.recognises(&file)).unwrap_or(&Flat);
    let mut raw = format.read(&file, options)?;
    // The notes are complete only after the last number is read.
    let mut warnings = file.notes();
    warnings.append(&mut raw.warnings);
    raw.warnings = warnings;
    finish(raw, path, options)
}

/// Corrects and validates rows that were read. Messages call them `path`.
pub(super) fn finish(raw: Raw, path: &Path, options: &LoadOptions) -> Result<Loaded, DataError> {
    raw.check_dims(path, options.dims)?;
    let Raw { layout, columns: read, known, mut warnings } = raw;
    let (rows, mut columns) = (read.rewards.len(), read.further);
    let mut transitions = Transitions {
        obs_dim: read.obs_dim,
        act_dim: read.act_dim,
        observations: read.observations,
        actions: read.actions,
        rewards: read.rewards,
        next_observations: read.next_observations.unwrap_or_default(),
        terminals: read.terminals,
        timeouts: read.timeouts.unwrap_or_default(),
        known: known.unwrap_or_else(|| vec![true; rows]),
    };
    let summary = match layout {
        Layout::Otdf | Layout::D4rl => settle(&mut transitions, &mut columns, options.step_limit, &mut warnings),
        // The file is ours, but someone has changed it: it is treated like any other.
        Layout::Tce if options.distrust_own && episodes::has_unmarked_ends(&Table::of(&transitions, None)) => {
            settle(&mut transitions, &mut columns, options.step_limit, &mut warnings)
        }
        // In these layouts, marks and successors are right by construction.
        Layout::Tce | Layout::Minari | Layout::Robomimic => {
            let mut summary = Summary::plain();
            summary.dropped.last_row = drop_cut_ends(&mut transitions, &mut columns);
            summary
        }
    };
    if transitions.is_empty() {
        let found = format!("{rows} rows, none of them with a usable next state");
        let advice = "Add `next_observations`, or use a longer data set";
        return Err(DataError::invalid(Problem::Empty, path, "observations", found, "at least one transition", advice));
    }
    let unknown_successors = transitions.known.iter().filter(|&&known| !known).count();
    if unknown_successors > 0 {
        warnings.push(format!(
            "{unknown_successors} terminal rows are without a next state. Policies learn from them; models of the dynamics do not: store \
             `next_observations` for that"
        ));
    }
    let Summary { environments, ends, successors, dropped } = summary;
    let report = LoadReport {
        file: path.to_owned(),
        layout,
        successors,
        episodes: ends,
        environments,
        rows_in_file: rows,
        rows_kept: transitions.len(),
        dropped,
        unknown_successors,
        warnings,
    };
    Ok(Loaded { transitions, columns, report })
}

/// Drops non-terminal rows whose successor is unknown (the last rows of demonstrations). Returns their number.
fn drop_cut_ends(t: &mut Transitions, columns: &mut BTreeMap<String, Vec<f32>>) -> usize {
    let keep: Vec<bool> = t.known.iter().zip(&t.terminals).map(|(known, terminal)| *known || *terminal).collect();
    retain(t, columns, &keep);
    keep.iter().filter(|&&k| !k).count()
}

/// Drops all rows except `keep`. The row before a dropped one ends its episode.
fn retain(t: &mut Transitions, columns: &mut BTreeMap<String, Vec<f32>>, keep: &[bool]) {
    if keep.iter().all(|&k| k) {
        return;
    }
    rows::cut_before_dropped(keep, &t.terminals, &mut t.timeouts);
    rows::retain(&mut t.observations, t.obs_dim, keep);
    rows::retain(&mut t.actions, t.act_dim, keep);
    rows::retain(&mut t.rewards, 1, keep);
    rows::retain(&mut t.next_observations, t.obs_dim, keep);
    for flags in [&mut t.terminals, &mut t.timeouts, &mut t.known] {
        rows::retain(flags, 1, keep);
    }
    columns.values_mut().for_each(|c| rows::retain(c, 1, keep));
}

/// The attributes of the file's root group, as text.
pub fn read_attributes(path: &Path) -> Result<BTreeMap<String, String>, DataError> {
    Hdf5::open(&main_file(path))?.attributes()
}

/// Decisions about a whole file.
struct Summary {
    environments: usize,
    ends: EpisodeEnds,
    successors: Successors,
    dropped: Dropped,
}

impl Summary {
    /// For a file in which nothing had to be corrected.
    fn plain() -> Self {
        let (ends, successors) = (EpisodeEnds::Marks, Successors::Stored);
        Self { environments: 1, ends, successors, dropped: Dropped::default() }
    }
}

/// Puts the rows in order, finds the ends of episodes and the successors, and drops unusable rows.
/// `t.next_observations` and `t.timeouts` are empty if the file has none, and complete afterwards.
fn settle(
    t: &mut Transitions,
    columns: &mut BTreeMap<String, Vec<f32>>,
    limit: Option<usize>,
    warnings: &mut Vec<String>,
) -> Summary {
    let rows = t.len();
    let mut tolerance = episodes::tolerance(&Table::of(t, limit));
    let lag = episodes::lag(&Table::of(t, limit), &tolerance);
    if let Lag::Turns(environments) = lag {
        warnings.push(format!(
            "the rows of {environments} environments take turns (s' is the state {environments} rows later): they were put one environment \
             after the other"
        ));
        reorder(t, columns, &episodes::untangled(rows, environments));
        // Once the rows are in order, the distances between them have changed.
        tolerance = episodes::tolerance(&Table::of(t, limit));
    }
    let mut out = episodes::resolve(&Table::of(t, limit), &tolerance, lag);
    // Successors that the file marks as unknown stay unknown.
    out.known.iter_mut().zip(&t.known).for_each(|(known, said)| *known &= said);
    warnings.extend(out.warnings);
    if t.next_observations.is_empty() {
        t.next_observations = t.observations[t.obs_dim..].to_vec();
        t.next_observations.extend_from_slice(&t.observations[t.observations.len() - t.obs_dim..]);
    }
    let d = t.obs_dim;
    for i in (0..rows).filter(|&i| !out.known[i]) {
        t.next_observations[i * d..(i + 1) * d].copy_from_slice(&t.observations[i * d..(i + 1) * d]);
    }
    (t.timeouts, t.known) = (out.timeouts, out.known);
    retain(t, columns, &out.keep);
    Summary { environments: lag.environments(), ends: out.ends, successors: out.successors, dropped: out.dropped }
}

fn reorder(t: &mut Transitions, columns: &mut BTreeMap<String, Vec<f32>>, order: &[usize]) {
    t.observations = rows::reordered(&t.observations, t.obs_dim, order);
    t.actions = rows::reordered(&t.actions, t.act_dim, order);
    t.rewards = rows::reordered(&t.rewards, 1, order);
    t.next_observations = rows::reordered(&t.next_observations, t.obs_dim, order);
    t.terminals = rows::reordered(&t.terminals, 1, order);
    t.known = rows::reordered(&t.known, 1, order);
    if !t.timeouts.is_empty() {
        t.timeouts = rows::reordered(&t.timeouts, 1, order);
    }
    columns.values_mut().for_each(|c| *c = rows::reordered(c, 1, order));
}
