//! From a file to [`Transitions`].

use std::collections::BTreeMap;
use std::path::Path;

use super::hdf5::{Column, Hdf5};
use super::report::{Dropped, Layout, LoadReport, Successors};
use super::rules::{self, Table};
use super::{FORMAT, FORMAT_ATTRIBUTE};
use crate::check::actions_outside;
use crate::{DataError, Problem, Transitions};

/// What the caller knows about the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoadOptions {
    /// Steps after which the collector cut an episode (`None`: never). Only looked at where the file has no `timeouts`.
    pub step_limit: Option<usize>,
    /// State and action dimension that the file must have, for example [`Agent::dims`](crate::Agent::dims).
    pub dims: Option<(usize, usize)>,
    /// Further columns to read, shape (N,) or (N, 1).
    pub columns: Vec<String>,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self { step_limit: Some(1000), dims: None, columns: Vec::new() }
    }
}

/// A validated data set.
#[derive(Clone, Debug, PartialEq)]
pub struct Loaded {
    /// The rows.
    pub transitions: Transitions,
    /// The further columns that were asked for, each `[transitions.len()]`.
    pub columns: BTreeMap<String, Vec<f32>>,
    /// What was read and what was left out.
    pub report: LoadReport,
}

/// Reads and validates an HDF5 file of transitions; see [`files`](crate::files) for the layouts.
///
/// # Errors
/// A missing or unreadable file, one that is not HDF5, is cut off or damaged; a missing field, a wrong shape or type;
/// fields that disagree; NaN or infinity; a file without (usable) rows. Actions outside of [-1, 1] are a warning.
pub fn load(path: &Path, options: &LoadOptions) -> Result<Loaded, DataError> {
    let file = Hdf5::open(path)?;
    let (mut stored, mut observed) = (None, None);
    // The two large columns are inflated side by side, each through a handle of its own.
    rayon::scope(|s| {
        if file.has("next_observations") {
            s.spawn(|_| stored = Some(file.reopen().and_then(|f| f.matrix("next_observations"))));
        }
        observed = Some(file.matrix("observations"));
    });
    let observations = observed.expect("the scope has run")?;
    let stored = stored.transpose()?;
    let actions = file.matrix("actions")?;
    let rewards = file.vector("rewards")?;
    let terminals = file.flags("terminals")?;
    let timeouts = if file.has("timeouts") { Some(file.flags("timeouts")?) } else { None };
    let rows = observations.rows;
    let mut columns = BTreeMap::new();
    for name in &options.columns {
        columns.insert(name.clone(), file.vector(name)?.data);
    }
    let mut counts = vec![("actions", actions.rows), ("rewards", rewards.rows), ("terminals", terminals.len())];
    counts.extend(stored.as_ref().map(|c| ("next_observations", c.rows)));
    counts.extend(timeouts.as_ref().map(|t| ("timeouts", t.len())));
    counts.extend(columns.iter().map(|(k, v)| (k.as_str(), v.len())));
    if let Some((name, n)) = counts.iter().find(|c| c.1 != rows) {
        let expected = format!("{rows} rows, as in `observations`");
        let advice = "The fields must have one row per transition: write the file again";
        return Err(file.invalid(Problem::RowCount, name, format!("{n} rows"), expected, advice));
    }
    check_dimensions(&file, &observations, &actions, stored.as_ref(), options.dims)?;

    let mut warnings = file.notes();
    if observations.rounded || stored.as_ref().is_some_and(|c| c.rounded) {
        warnings.push("states are stored as float64; they were rounded to float32".to_owned());
    }
    warnings.extend(actions_outside(&actions.data, actions.dim).map(|w| format!("actions: {w}")));
    let trusted = file.attributes()?.get(FORMAT_ATTRIBUTE).is_some_and(|f| f == FORMAT);
    let layout = match (trusted, &stored, &timeouts) {
        (true, Some(_), Some(_)) => Layout::Tce,
        (_, Some(_), None) => Layout::Otdf,
        _ => Layout::D4rl,
    };
    let raw = Raw { dim: observations.dim, observations: &observations.data, terminals: &terminals };
    let Resolved { next_observations, timeouts, keep, successors, dropped } =
        raw.resolve(layout, stored.map(|c| c.data), timeouts, options.step_limit, &mut warnings);
    let mut transitions = Transitions {
        obs_dim: observations.dim,
        act_dim: actions.dim,
        observations: observations.data,
        actions: actions.data,
        rewards: rewards.data,
        next_observations,
        terminals,
        timeouts,
    };
    if dropped.total() > 0 {
        let t = &mut transitions;
        rules::cut_before_dropped(&keep, &t.terminals, &mut t.timeouts);
        rules::retain_rows(&mut t.observations, t.obs_dim, &keep);
        rules::retain_rows(&mut t.actions, t.act_dim, &keep);
        rules::retain_rows(&mut t.rewards, 1, &keep);
        rules::retain_rows(&mut t.next_observations, t.obs_dim, &keep);
        rules::retain_rows(&mut t.terminals, 1, &keep);
        rules::retain_rows(&mut t.timeouts, 1, &keep);
        columns.values_mut().for_each(|c| rules::retain_rows(c, 1, &keep));
    }
    if transitions.is_empty() {
        let found = format!("{rows} rows, none of them with a usable next state");
        let advice = "Add `next_observations`, or use a longer data set";
        return Err(file.invalid(Problem::Empty, "observations", found, "at least one transition", advice));
    }
    let terminals_without_successor = match successors {
        Successors::Stored => 0,
        Successors::NextRow => transitions.terminals.iter().filter(|&&t| t).count(),
    };
    if terminals_without_successor > 0 {
        warnings.push(format!(
            "{terminals_without_successor} terminal rows have the next episode's first state as next state; this file \
             holds no other. Values are not affected; for a model of the dynamics, store `next_observations`"
        ));
    }
    let report = LoadReport {
        file: path.to_owned(),
        layout,
        successors,
        rows_in_file: rows,
        rows_kept: transitions.len(),
        dropped,
        terminals_without_successor,
        warnings,
    };
    Ok(Loaded { transitions, columns, report })
}

/// The attributes of the file's root group, as text.
pub fn read_attributes(path: &Path) -> Result<BTreeMap<String, String>, DataError> {
    Hdf5::open(path)?.attributes()
}

fn check_dimensions(
    file: &Hdf5,
    observations: &Column,
    actions: &Column,
    stored: Option<&Column>,
    dims: Option<(usize, usize)>,
) -> Result<(), DataError> {
    let differ = |field: &str, found: usize, expected: usize, what: &str, advice: &str| {
        let expected = format!("{expected} columns{what}");
        Err(file.invalid(Problem::Dimension, field, format!("{found} columns"), expected, advice))
    };
    if let Some(next) = stored.filter(|n| n.dim != observations.dim) {
        let advice = "A state and its successor have the same dimension: write the file again";
        return differ("next_observations", next.dim, observations.dim, ", as in `observations`", advice);
    }
    if let Some((o, a)) = dims {
        let advice = "This is a file of another agent: choose the file, or the agent, that fits";
        if observations.dim != o {
            return differ("observations", observations.dim, o, "", advice);
        }
        if actions.dim != a {
            return differ("actions", actions.dim, a, "", advice);
        }
    }
    Ok(())
}

/// The file's columns that decide about rows.
struct Raw<'a> {
    dim: usize,
    observations: &'a [f32],
    terminals: &'a [bool],
}

struct Resolved {
    next_observations: Vec<f32>,
    timeouts: Vec<bool>,
    keep: Vec<bool>,
    successors: Successors,
    dropped: Dropped,
}

impl Raw<'_> {
    fn resolve(
        &self,
        layout: Layout,
        stored: Option<Vec<f32>>,
        timeouts: Option<Vec<bool>>,
        limit: Option<usize>,
        warnings: &mut Vec<String>,
    ) -> Resolved {
        let Some(next_observations) = stored else {
            let timeouts = timeouts.unwrap_or_else(|| {
                warnings.push(match limit {
                    Some(n) => {
                        format!("no `timeouts` field: episodes are taken to end after {n} steps or at a terminal")
                    }
                    None => "no `timeouts` field: episodes are taken to end at terminals only".to_owned(),
                });
                rules::count_timeouts(self.terminals, limit)
            });
            return self.next_row(timeouts);
        };
        let table = Table {
            dim: self.dim,
            observations: self.observations,
            next_observations: &next_observations,
            terminals: self.terminals,
        };
        let (timeouts, wrong) = match timeouts {
            Some(timeouts) if layout == Layout::D4rl && rules::successors_are_next_rows(&table, &timeouts) => {
                warnings.push(
                    "the stored next_observations are the following row's state even where an episode ends; they are \
                     treated as absent"
                        .to_owned(),
                );
                return self.next_row(timeouts);
            }
            Some(timeouts) => (timeouts, vec![false; self.terminals.len()]),
            None => rules::infer_boundaries(&table, limit),
        };
        let keep: Vec<bool> = wrong.iter().map(|w| !w).collect();
        let dropped = Dropped { wrong_successor: wrong.iter().filter(|&&w| w).count(), ..Dropped::default() };
        Resolved { next_observations, timeouts, keep, successors: Successors::Stored, dropped }
    }

    /// D4RL's `qlearning_dataset` for files without successors: s'_i = s_{i+1}; time-out rows and the last row have
    /// none and are dropped.
    fn next_row(&self, timeouts: Vec<bool>) -> Resolved {
        let rows = self.terminals.len();
        let mut next_observations = self.observations[self.dim..].to_vec();
        next_observations.extend_from_slice(&self.observations[self.observations.len() - self.dim..]);
        let keep = (0..rows).map(|i| i + 1 < rows && !timeouts[i]).collect();
        let time_out = timeouts[..rows - 1].iter().filter(|&&t| t).count();
        let dropped = Dropped { time_out, last_row: 1, ..Dropped::default() };
        Resolved { next_observations, timeouts, keep, successors: Successors::NextRow, dropped }
    }
}
