//! Files with one data set per field: D4RL's, OTDF's, and those that [`save_d4rl`](super::save_d4rl) writes.
//!
//! | field | shape | also read under |
//! |---|---|---|
//! | `observations` | (N, D) | `obs`, `states` |
//! | `actions` | (N, A) | `action` |
//! | `rewards` | (N,) or (N, 1) | `reward` |
//! | `next_observations` | (N, D), may be absent | `next_obs`, `next_states` |
//! | `terminals` | (N,) or (N, 1) | `terminations`, `terminated`, `terminal` |
//! | `timeouts` | (N,) or (N, 1), may be absent | `truncations`, `truncated`, `truncateds`, `timeout`, `infos/timeouts` |
//! | `known` | (N,) or (N, 1), may be absent: 0 at terminal rows whose s' was not logged | `next_observations_known` |

use std::collections::BTreeMap;

use super::formats::{Columns, Format, Raw};
use super::hdf5::{Beside, Column, Hdf5};
use super::options::LoadOptions;
use super::report::Layout;
use super::rounding::told_losses;
use super::successors::{fill_gaps, layout_of, told_gaps};
use super::{FORMAT, FORMAT_ATTRIBUTE, KNOWN};
use crate::{DataError, Problem};

/// See the [module](self).
pub(super) struct Flat;

const OBSERVATIONS: [&str; 3] = ["observations", "obs", "states"];
const ACTIONS: [&str; 2] = ["actions", "action"];
const REWARDS: [&str; 2] = ["rewards", "reward"];
const NEXT: [&str; 3] = ["next_observations", "next_obs", "next_states"];
const TERMINALS: [&str; 4] = ["terminals", "terminations", "terminated", "terminal"];
const TIMEOUTS: [&str; 6] = ["timeouts", "truncations", "truncated", "truncateds", "timeout", "infos/timeouts"];
/// The marks of successors that are known, in files that others write from a table's columns. Ours call them [`KNOWN`].
const MARKS: &str = "known";
/// Fields that mark ends of episodes without saying whether they are terminals or time-outs.
const ANY_END: [&str; 5] = ["dones", "done", "dones_float", "episode_terminals", "ends"];
/// Fields that may mark ends of episodes and are not read.
const HINTS: [&str; 6] =
    ["infos/TimeLimit.truncated", "infos/truncated", "infos/truncations", "truncation", "episode_id", "episode_ids"];

/// The first of `names` that the file has. Adds a warning if it is not the first one of the list.
fn name<'a>(file: &Hdf5, names: &[&'a str], warnings: &mut Vec<String>) -> Option<&'a str> {
    let found = *names.iter().find(|name| file.has(name))?;
    if found != names[0] {
        warnings.push(format!("no `{}`: `{found}` was read as such", names[0]));
    }
    Some(found)
}

/// Whether [`save_d4rl`](super::save_d4rl) wrote this file.
fn is_ours(file: &Hdf5) -> Result<bool, DataError> {
    Ok(file.attributes()?.get(FORMAT_ATTRIBUTE).is_some_and(|f| f == FORMAT))
}

/// Which successors are known, if the file says so, and the field that says it. A field [`MARKS`] that is no such mark is
/// a column of the user's own: it is told, and stays one.
fn marks(
    file: &Hdf5,
    terminals: &[bool],
    beside: Beside<'_>,
    warnings: &mut Vec<String>,
) -> Result<Option<(&'static str, Vec<bool>)>, DataError> {
    if file.has(KNOWN) {
        return Ok(Some((KNOWN, file.flags(KNOWN, beside)?)));
    }
    if !file.has(MARKS) || is_ours(file)? {
        return Ok(None);
    }
    let (found, expected) = match file.flags(MARKS, beside) {
        Ok(known) if known.len() != beside.rows => {
            (format!("{} rows", known.len()), format!("{} rows, as in `{}`", beside.rows, beside.field))
        }
        Ok(known) => match known.iter().zip(terminals).position(|(&known, &terminal)| !known && !terminal) {
            None => return Ok(Some((MARKS, known))),
            Some(row) => (format!("0 in row {row}, which is no terminal"), "0 at terminal rows alone".to_owned()),
        },
        Err(DataError::Invalid { found, expected, .. }) => (found, expected),
        Err(error) => return Err(error),
    };
    warnings.push(format!(
        "`{MARKS}` was not read as marks of next states that were not logged: found {found}; expected {expected}"
    ));
    Ok(None)
}

/// Fields that may mark ends of episodes and were not read in addition to `timeouts`.
fn other_marks(file: &Hdf5, timeouts: Option<&str>) -> Vec<String> {
    let others = TIMEOUTS.iter().filter(|name| file.has(name) && Some(**name) != timeouts);
    let others = others.filter(|_| timeouts.is_some());
    let of_two =
        others.map(|name| format!("`{name}` was not read, because `{}` is there", timeouts.unwrap_or_default()));
    let hints = ANY_END.iter().chain(&HINTS).filter(|name| timeouts.is_none() && file.has(name));
    let hints =
        hints.map(|name| format!("`{name}` was not read; if it tells where episodes end, store it as `timeouts`"));
    of_two.chain(hints).collect()
}

impl Format for Flat {
    fn recognises(&self, _file: &Hdf5) -> bool {
        true
    }

    fn read(&self, file: &Hdf5, options: &LoadOptions) -> Result<Raw, DataError> {
        let mut warnings = Vec::new();
        let mut field = |names: &[&'static str]| name(file, names, &mut warnings);
        let mut needed = |names: &[&'static str]| field(names).ok_or_else(|| file.missing(names[0]));
        let (observations, actions, rewards) = (needed(&OBSERVATIONS)?, needed(&ACTIONS)?, needed(&REWARDS)?);
        let (next, terminals, timeouts) = (field(&NEXT), field(&TERMINALS), field(&TIMEOUTS));
        let terminals = terminals.ok_or_else(|| without_terminals(file))?;
        warnings.extend(other_marks(file, timeouts));

        let (mut stored, mut observed) = (None, None);
        // The two large columns are decompressed in parallel, each through its own handle.
        rayon::scope(|s| {
            if let Some(next) = next {
                s.spawn(|_| stored = Some(file.reopen().and_then(|f| f.matrix_with_gaps(next))));
            }
            observed = Some(file.matrix(observations));
        });
        let observed = observed.expect("the scope has run")?;
        let mut stored = stored.transpose()?;
        let beside = Beside { field: observations, rows: observed.rows };
        let (acted, rewarded) = (file.matrix(actions)?, file.vector(rewards, beside)?);
        let terminal = file.flags(terminals, beside)?;
        let timeout = timeouts.map(|name| file.flags(name, beside)).transpose()?;
        let told = marks(file, &terminal, beside, &mut warnings)?;
        let fields = [observations, actions, rewards, terminals, told.as_ref().map_or(KNOWN, |told| told.0)];
        let columns = further(file, options, &fields, next, timeouts, beside, &mut warnings)?;
        let mut known = told.map(|told| told.1);

        let mut counts = vec![(actions, acted.rows), (rewards, rewarded.rows), (terminals, terminal.len())];
        counts.extend(next.zip(stored.as_ref()).map(|(name, c)| (name, c.rows)));
        counts.extend(timeouts.zip(timeout.as_ref()).map(|(name, t)| (name, t.len())));
        counts.extend(known.as_ref().map(|k| (KNOWN, k.len())));
        counts.extend(columns.iter().map(|(k, v)| (k.as_str(), v.len())));
        same_rows(file, beside, &counts)?;
        if let Some((name, c)) = next.zip(stored.as_ref()).filter(|(_, c)| c.dim != observed.dim) {
            let advice = "A state and its successor have the same dimension: write the file again";
            let expected = format!("{} columns, as in `{observations}`", observed.dim);
            return Err(file.invalid(Problem::Dimension, name, format!("{} columns", c.dim), expected, advice));
        }
        if let Some((name, c)) = next.zip(stored.as_mut()) {
            match fill_gaps(&mut c.data, &observed.data, &terminal, &mut known) {
                // The plain read returns an error that says where and what.
                Err(_) => drop(file.matrix(name)?),
                Ok(gaps) => warnings.extend(told_gaps(name, gaps)),
            }
        }
        if observed.rounded || stored.as_ref().is_some_and(|c| c.rounded) {
            warnings.push("states are stored as float64; they were rounded to float32".to_owned());
        }
        for (name, c) in [(observations, &observed), (actions, &acted), (rewards, &rewarded)] {
            warnings.extend(told_losses(name, &c.losses, &c.data, c.dim));
        }
        let layout = match (is_ours(file)?, &stored, &timeout) {
            (true, Some(_), Some(_)) => Layout::Tce,
            _ => layout_of(stored.is_some(), timeout.is_some()),
        };
        let columns = Columns {
            obs_dim: observed.dim,
            act_dim: acted.dim,
            observations: observed.data,
            actions: acted.data,
            rewards: rewarded.data,
            next_observations: stored.map(|c: Column| c.data),
            terminals: terminal,
            timeouts: timeout,
            further: columns,
        };
        Ok(Raw { layout, columns, known, warnings })
    }
}

/// Returns an error if one of these fields, with its number of rows, has more or fewer of them than `beside`.
fn same_rows(file: &Hdf5, beside: Beside<'_>, counts: &[(&str, usize)]) -> Result<(), DataError> {
    let Some((name, n)) = counts.iter().find(|c| c.1 != beside.rows) else { return Ok(()) };
    let expected = format!("{} rows, as in `{}`", beside.rows, beside.field);
    let advice = "The fields must have one row per transition: write the file again";
    Err(file.invalid(Problem::RowCount, name, format!("{n} rows"), expected, advice))
}

/// The requested columns. If all are requested: all columns of the file, and warnings about unreadable ones.
fn further(
    file: &Hdf5,
    options: &LoadOptions,
    fields: &[&str],
    next: Option<&str>,
    timeouts: Option<&str>,
    beside: Beside<'_>,
    warnings: &mut Vec<String>,
) -> Result<BTreeMap<String, Vec<f32>>, DataError> {
    let mut columns = BTreeMap::new();
    for name in &options.columns {
        columns.insert(name.clone(), file.vector(name, beside)?.data);
    }
    if options.all_columns {
        let read = |name: &str| fields.contains(&name) || next == Some(name) || timeouts == Some(name);
        let (rows, mut left_out) = (beside.rows, Vec::new());
        for name in file.all_datasets()?.into_iter().filter(|name| !read(name)) {
            match file.vector(&name, beside) {
                Ok(column) if column.rows == rows && name.matches('/').count() <= 1 => {
                    drop(columns.insert(name, column.data))
                }
                Err(DataError::Invalid { problem: Problem::NonFinite, found, expected, .. }) => {
                    warnings.push(format!("`{name}` was not read: found {found}; expected {expected}"));
                }
                _ => left_out.push(name),
            }
        }
        if !left_out.is_empty() {
            warnings.push(format!("not read, because they are no columns of {rows} numbers: {}", left_out.join(", ")));
        }
    }
    Ok(columns)
}

fn without_terminals(file: &Hdf5) -> DataError {
    match ANY_END.into_iter().find(|name| file.has(name)) {
        Some(name) => file.invalid(
            Problem::MissingField,
            "terminals",
            format!("`{name}`, which does not tell terminals from time-outs"),
            "`terminals`: true where the robot cannot go on; and `timeouts`: true where the episode was cut",
            format!(
                "Store both; where no episode ends by itself, all `terminals` are false and `{name}` is `timeouts`"
            ),
        ),
        None => file.missing("terminals"),
    }
}
