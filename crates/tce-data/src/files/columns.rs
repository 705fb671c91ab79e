//! Rows that are already in memory, for example NumPy arrays.

use std::path::Path;

use super::formats::{Columns, Raw};
use super::load::{Loaded, finish};
use super::options::LoadOptions;
use super::successors::{fill_gaps, layout_of, told_gaps};
use crate::{DataError, Problem};

/// Validates and corrects `columns` exactly as [`load`](crate::load) does for a file with the same columns. Error
/// messages and warnings use `name` for the table.
///
/// # Errors
/// No rows or no columns, columns of different lengths, NaN or infinity, dimensions other than the expected ones.
pub fn from_columns(mut columns: Columns, name: &Path, options: &LoadOptions) -> Result<Loaded, DataError> {
    let (obs_dim, act_dim, rows) = (columns.obs_dim, columns.act_dim, columns.rewards.len());
    let invalid = |problem, field: &str, found: String, expected: String, advice: &str| {
        Err(DataError::invalid(problem, name, field, found, expected, advice))
    };
    if rows == 0 || obs_dim == 0 || act_dim == 0 {
        let field = if obs_dim == 0 {
            "observations"
        } else if act_dim == 0 {
            "actions"
        } else {
            "rewards"
        };
        let expected = "at least one row, and one column of states and of actions".to_owned();
        return invalid(Problem::Empty, field, "an empty array".into(), expected, "Record more of this robot");
    }
    let mut sizes = vec![
        ("observations", columns.observations.len(), obs_dim),
        ("actions", columns.actions.len(), act_dim),
        ("terminals", columns.terminals.len(), 1),
    ];
    sizes.extend(columns.next_observations.as_ref().map(|next| ("next_observations", next.len(), obs_dim)));
    sizes.extend(columns.timeouts.as_ref().map(|t| ("timeouts", t.len(), 1)));
    sizes.extend(columns.further.iter().map(|(field, values)| (field.as_str(), values.len(), 1)));
    if let Some((field, len, dim)) = sizes.into_iter().find(|(_, len, dim)| *len != rows * dim) {
        let found = format!("{} rows of {dim}", len as f64 / dim as f64);
        let expected = format!("{rows} rows, as in `rewards`");
        return invalid(Problem::RowCount, field, found, expected, "The arrays must have one row per transition");
    }
    for (field, values, dim) in [
        ("observations", &columns.observations, obs_dim),
        ("actions", &columns.actions, act_dim),
        ("rewards", &columns.rewards, 1),
    ] {
        if let Some(at) = values.iter().position(|x| !x.is_finite()) {
            let found = format!("{} in row {}, column {}", values[at], at / dim, at % dim);
            return invalid(Problem::NonFinite, field, found, "finite numbers".into(), "Remove the row, or repair it");
        }
    }
    let (mut known, mut warnings) = (None, Vec::new());
    if let Some(next) = &mut columns.next_observations {
        match fill_gaps(next, &columns.observations, &columns.terminals, &mut known) {
            Ok(gaps) => warnings.extend(told_gaps("next_observations", gaps)),
            Err(row) => {
                let found = format!("a number that is not finite in row {row}, which is no terminal");
                let (field, expected) = ("next_observations", "finite numbers".to_owned());
                return invalid(Problem::NonFinite, field, found, expected, "Remove the row, or repair it");
            }
        }
    }
    let layout = layout_of(columns.next_observations.is_some(), columns.timeouts.is_some());
    finish(Raw { layout, columns, known, warnings }, name, options)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    /// Two episodes of three rows; the state increases by one step within each.
    fn columns() -> Columns {
        Columns {
            obs_dim: 1,
            act_dim: 1,
            observations: vec![0.0, 1.0, 2.0, 10.0, 11.0, 12.0],
            actions: vec![0.5; 6],
            rewards: vec![1.0; 6],
            next_observations: Some(vec![1.0, 2.0, 3.0, 11.0, 12.0, 13.0]),
            terminals: vec![false, false, true, false, false, false],
            ..Columns::default()
        }
    }

    fn load(columns: Columns) -> Result<Loaded, DataError> {
        from_columns(columns, Path::new("arm"), &LoadOptions::default())
    }

    #[test]
    fn columns_in_memory_are_read_as_a_file_of_them() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("arm.hdf5");
        let loaded = load(columns()).unwrap();
        crate::save_d4rl(&path, &loaded.transitions, &BTreeMap::new(), &[]).unwrap();
        assert_eq!(crate::load(&path, &LoadOptions::default()).unwrap().transitions, loaded.transitions);
        assert_eq!(loaded.transitions.episodes().iter().map(|e| e.end).collect::<Vec<_>>(), [3, 6]);
        // If there are no successors, s' is the next row's state, and the last row has none.
        let without = load(Columns { next_observations: None, ..columns() }).unwrap();
        assert_eq!(without.transitions.next_observations[..2], [1.0, 2.0]);
        assert_eq!(without.report.dropped.last_row, 1);
    }

    #[test]
    fn what_a_file_may_not_have_is_refused() {
        let mut short = columns();
        short.actions.pop();
        let mut broken = columns();
        broken.rewards[3] = f32::NAN;
        let mut lost = columns();
        lost.next_observations.as_mut().unwrap()[1] = f32::INFINITY;
        for (columns, words) in [
            (short, "arm: field `actions`: found 5 rows of 1; expected 6 rows"),
            (broken, "field `rewards`: found NaN in row 3, column 0"),
            (lost, "row 1, which is no terminal"),
            (Columns::default(), "field `observations`: found an empty array"),
        ] {
            let error = load(columns).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }

    #[test]
    fn the_successor_of_a_terminal_may_be_unknown() {
        let mut columns = columns();
        columns.next_observations.as_mut().unwrap()[2] = f32::NAN;
        let loaded = load(columns).unwrap();
        assert_eq!(loaded.transitions.known, [true, true, false, true, true, true]);
        assert_eq!(loaded.transitions.next_observations[2], 2.0);
    }
}
