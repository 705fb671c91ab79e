//! Shared code of layouts with one group per episode: the groups in the order of their numbers, and fields that may
//! themselves be groups of columns.

use std::collections::BTreeMap;

use tce_base::counted;

use super::formats::{Columns, Raw};
use super::hdf5::{Column, Hdf5};
use super::options::LoadOptions;
use super::report::Layout;
use super::rounding::told_losses;
use crate::{DataError, Problem};

/// The groups `PREFIX0`, `PREFIX1`, ... in `parent`, in the order of their numbers.
pub(super) fn numbered(file: &Hdf5, parent: &str, prefix: &str) -> Vec<String> {
    let members = file.names_in(parent).ok().flatten().unwrap_or_default();
    let number = |name: &String| name.strip_prefix(prefix).and_then(|n| n.parse::<u64>().ok());
    let mut numbered: Vec<(u64, String)> = members.into_iter().filter_map(|m| Some((number(&m)?, m))).collect();
    numbered.sort();
    numbered.into_iter().map(|(_, name)| name).collect()
}

/// Largest depth of nested groups of a field.
const DEEPEST: usize = 8;

/// The columns of a field in one episode.
pub(super) struct Field {
    pub rows: usize,
    /// Name (empty for a field that is one data set) and number of columns.
    pub parts: Vec<(String, usize)>,
    /// `[rows, dim]`.
    pub data: Vec<f32>,
    /// Of each column, what the rounding lost: see [`losses`](super::rounding::losses).
    pub losses: Vec<f32>,
    /// Members that are not columns of numbers (images, text).
    pub left_out: Vec<String>,
}

impl Field {
    /// Number of columns.
    pub fn dim(&self) -> usize {
        self.parts.iter().map(|p| p.1).sum()
    }

    /// Describes in words which columns belong to which part.
    pub fn describe(&self, field: &str) -> Option<String> {
        let named = self.parts.iter().any(|p| !p.0.is_empty());
        let mut at = 0;
        let parts: Vec<String> = self
            .parts
            .iter()
            .map(|(name, dim)| {
                let start = at;
                at += dim;
                if *dim == 1 { format!("{name} [{start}]") } else { format!("{name} [{start}..{at}]") }
            })
            .collect();
        named.then(|| format!("{field} are laid end to end in the order of their names: {}", parts.join(", ")))
    }
}

/// Reads a field: one data set, (N,) or (N, D), or a group of data sets, concatenated in the order of their names.
pub(super) fn field(file: &Hdf5, path: &str) -> Result<Field, DataError> {
    let (mut columns, mut left_out) = (Vec::<(String, Column)>::new(), Vec::new());
    gather(file, path, "", 0, &mut columns, &mut left_out)?;
    let Some(rows) = columns.first().map(|c| c.1.rows) else {
        let found = if left_out.is_empty() {
            "no data sets".into()
        } else {
            format!("{}, no columns of numbers", left_out.join(", "))
        };
        return Err(file.invalid(
            Problem::MissingField,
            path,
            found,
            "numbers of shape (N,) or (N, D)",
            "Store the state as numbers",
        ));
    };
    if let Some((name, column)) = columns.iter().find(|c| c.1.rows != rows) {
        let (found, expected) =
            (format!("{} rows in `{name}`", column.rows), format!("{rows}, as in `{}`", columns[0].0));
        return Err(file.invalid(Problem::RowCount, path, found, expected, "Write the file again"));
    }
    let parts: Vec<(String, usize)> = columns.iter().map(|(name, c)| (name.clone(), c.dim)).collect();
    let dim: usize = parts.iter().map(|p| p.1).sum();
    let mut data = Vec::with_capacity(rows * dim);
    for i in 0..rows {
        columns.iter().for_each(|(_, c)| data.extend_from_slice(&c.data[i * c.dim..(i + 1) * c.dim]));
    }
    let losses = columns.into_iter().flat_map(|(_, c)| c.losses).collect();
    Ok(Field { rows, parts, data, losses, left_out })
}

fn gather(
    file: &Hdf5,
    path: &str,
    name: &str,
    depth: usize,
    columns: &mut Vec<(String, Column)>,
    left_out: &mut Vec<String>,
) -> Result<(), DataError> {
    let Some(mut all) = file.names_in(path)? else {
        match file.table(path) {
            Ok(column) => columns.push((name.to_owned(), column)),
            // Images and text beside the numbers of a state are not an error.
            Err(e) if !name.is_empty() && matches!(e.problem(), Some(Problem::WrongRank | Problem::WrongType)) => {
                left_out.push(name.to_owned());
            }
            Err(e) => return Err(e),
        }
        return Ok(());
    };
    // `_index_2` of a tuple comes before `_index_10`.
    let order = |name: &String| (name.strip_prefix("_index_").and_then(|n| n.parse::<u64>().ok()), name.clone());
    all.sort_by_key(order);
    // In a damaged file a group may contain itself.
    if depth > DEEPEST {
        let (found, expected) = (format!("groups in groups, {name}"), format!("at most {DEEPEST} of them"));
        return Err(file.invalid(Problem::Malformed, path, found, expected, "Store the state as columns of numbers"));
    }
    for member in all {
        let inner = if name.is_empty() { member.clone() } else { format!("{name}/{member}") };
        gather(file, &format!("{path}/{member}"), &inner, depth + 1, columns, left_out)?;
    }
    Ok(())
}

/// The field of an episode. `None` for an episode without steps, which is counted in `empty`.
pub(super) fn unless_empty(field: Result<Field, DataError>, empty: &mut usize) -> Result<Option<Field>, DataError> {
    match field {
        Err(e) if e.problem() == Some(Problem::Empty) => {
            *empty += 1;
            Ok(None)
        }
        field => field.map(Some),
    }
}

/// Rows of episodes, one after the other.
#[derive(Default)]
pub(super) struct Together {
    pub obs: Vec<(String, usize)>,
    pub act: Vec<(String, usize)>,
    /// The largest losses of the columns of states and of actions, over the episodes.
    losses: [Vec<f32>; 2],
    pub observations: Vec<f32>,
    pub next_observations: Vec<f32>,
    pub actions: Vec<f32>,
    pub rewards: Vec<f32>,
    pub terminals: Vec<bool>,
    pub timeouts: Vec<bool>,
    pub warnings: Vec<String>,
}

impl Together {
    /// Adds the warnings about what was left out, and about what was rounded too much.
    pub fn finish(&mut self, empty: usize, options: &LoadOptions) {
        let [states, actions] = &self.losses;
        let told = [
            told_losses("observations", states, &self.observations, states.len()),
            told_losses("actions", actions, &self.actions, actions.len()),
        ];
        self.warnings.extend(told.into_iter().flatten());
        if empty > 0 {
            self.warnings.push(format!(
                "{} left out",
                counted(empty, "episode without a step was", "episodes without a step were")
            ));
        }
        if options.all_columns || !options.columns.is_empty() {
            self.warnings.push(
                "what episodes hold besides states, actions, rewards and flags (infos, masks) was not read".into(),
            );
        }
    }

    /// All rows, in the form of a file's rows.
    pub fn raw(self, layout: Layout) -> Raw {
        let dim = |parts: &[(String, usize)]| parts.iter().map(|p| p.1).sum();
        let columns = Columns {
            obs_dim: dim(&self.obs),
            act_dim: dim(&self.act),
            observations: self.observations,
            actions: self.actions,
            rewards: self.rewards,
            next_observations: Some(self.next_observations),
            terminals: self.terminals,
            timeouts: Some(self.timeouts),
            further: BTreeMap::new(),
        };
        Raw { layout, columns, known: None, warnings: self.warnings }
    }

    /// Records the columns of states and actions, and their losses; returns an error if they differ from those of
    /// earlier episodes.
    pub fn same(&mut self, file: &Hdf5, episode: &str, states: &Field, actions: &Field) -> Result<(), DataError> {
        if self.obs.is_empty() {
            (self.obs, self.act) = (states.parts.clone(), actions.parts.clone());
            self.warnings.extend([states.describe("observations"), actions.describe("actions")].into_iter().flatten());
            if !states.left_out.is_empty() {
                self.warnings.push(format!(
                    "observations that are no columns of numbers were left out: {}",
                    states.left_out.join(", ")
                ));
            }
        }
        if self.obs != states.parts || self.act != actions.parts {
            let (found, expected) = (
                format!("{:?} and {:?}", states.parts, actions.parts),
                format!("{:?} and {:?}, as in the episodes before", self.obs, self.act),
            );
            return Err(file.invalid(
                Problem::Dimension,
                episode,
                found,
                expected,
                "Write episodes of one robot into one file",
            ));
        }
        for (largest, field) in self.losses.iter_mut().zip([states, actions]) {
            largest.resize(field.losses.len(), 0.0);
            largest.iter_mut().zip(&field.losses).for_each(|(largest, loss)| *largest = largest.max(*loss));
        }
        Ok(())
    }
}
