//! What a user says of own files: the robot, if it is one of the benchmark's, where the collector cut episodes, and the units of
//! actions.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use clap::Args;
use serde::Serialize;
use tce_base::{AtomicFolder, FileError, move_into_place};
use tce_data::{
    ActionRange, Agent, DataError, LoadOptions, Problem, Shift, Transitions, parse_environment, save_d4rl, save_minari,
};
use tce_sim::EPISODE_LIMIT;

/// Options of every command that reads a user's own files.
#[derive(Clone, Debug, Default, Args, Serialize)]
#[command(next_help_heading = "Your own files")]
pub struct Own {
    /// The robot is this one of the benchmark's (hopper-morph, ...): its terminal rule and its limit of 1000 steps apply, and policies are
    /// tried in its simulator. Without it, nothing is assumed of the robot: terminals are learned from the rows.
    #[arg(long, value_parser = parse_environment, value_name = "ROBOT-SHIFT")]
    pub env: Option<(Agent, Shift)>,
    /// Steps after which the collector cut episodes, for files without `timeouts` (default: none).
    #[arg(long, value_name = "STEPS", value_parser = clap::value_parser!(u32).range(1..))]
    pub step_limit: Option<u32>,
    /// Least and greatest action, LOW:HIGH for all columns or one pair a column, separated by commas (default: those of the data, where
    /// they leave -1:1).
    #[arg(long, value_name = "LOW:HIGH,...", value_parser = parse_range, allow_hyphen_values = true)]
    pub action_range: Option<ActionRange>,
}

impl Own {
    /// The robot.
    pub fn agent(&self) -> Option<Agent> {
        self.env.map(|(agent, _)| agent)
    }

    /// How its files are read.
    pub fn load_options(&self) -> LoadOptions {
        let limit = self.step_limit.map(|n| n as usize).or(self.env.map(|_| EPISODE_LIMIT));
        LoadOptions {
            step_limit: limit,
            dims: self.agent().map(Agent::dims),
            distrust_own: true,
            ..LoadOptions::default()
        }
    }

    /// The episodes' limit that decides when one is whole.
    pub fn limit(&self) -> Option<usize> {
        self.load_options().step_limit
    }
}

/// LOW:HIGH for all columns, or one pair a column, separated by commas.
///
/// # Errors
/// In words, if it is none.
pub fn parse_range(text: &str) -> Result<ActionRange, String> {
    let mut range = ActionRange { low: Vec::new(), high: Vec::new() };
    for column in text.split(',') {
        let pair =
            column.split_once(':').and_then(|(low, high)| Some((low.trim().parse().ok()?, high.trim().parse().ok()?)));
        let (low, high): (f32, f32) =
            pair.ok_or_else(|| format!("found {column:?}, expected LOW:HIGH, as in -20:20"))?;
        range.low.push(low);
        range.high.push(high);
    }
    match range.fits(range.low.len()) {
        true => Ok(range),
        false => Err(format!("found {text}, expected finite numbers, each LOW below its HIGH")),
    }
}

/// The range for `columns` actions that the user gave: one pair counts for all.
///
/// # Errors
/// In words, if there are fewer or more pairs than columns.
pub fn range_of(given: &ActionRange, columns: usize, file: &Path) -> Result<ActionRange, String> {
    let found = given.low.len();
    match found {
        1 => Ok(ActionRange { low: vec![given.low[0]; columns], high: vec![given.high[0]; columns] }),
        n if n == columns => Ok(given.clone()),
        n => Err(format!(
            "--action-range: found {n} pairs, expected one, or {columns}: {} has {columns} actions",
            file.display()
        )),
    }
}

/// The layout of a written data set.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum DataFormat {
    /// One HDF5 file with a data set a field.
    #[default]
    D4rl,
    /// A folder for `minari.load_dataset`.
    Minari,
}

/// Options of commands that write a data set.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "What is written")]
pub struct Writing {
    /// The layout of the written data set.
    #[arg(long, value_enum, default_value_t, value_name = "LAYOUT")]
    pub format: DataFormat,
    /// Minari: the data set's id (default: the last two parts of the written folder's path).
    #[arg(long, value_name = "ID", value_parser = parse_id)]
    pub id: Option<String>,
    /// Replace what is there.
    #[arg(long)]
    pub force: bool,
}

/// The files of a Minari data set, in the folder `data` of its own: the rows, and what they are.
const MINARI: [&str; 2] = ["main_data.hdf5", "metadata.json"];

impl Writing {
    /// Refuses a place with something of another kind than what is written. Call it before long work whose result goes there.
    ///
    /// # Errors
    /// Says what is there: a folder where a file is written, a file where a folder is written, or, in the folder, a `data` that is not a data
    /// set alone: nobody would expect that other files go with it.
    pub fn ensure_replaceable(&self, path: &Path) -> Result<(), DataError> {
        let refuse = |place: &Path, found: String, expected: &str| {
            Err(DataError::Invalid {
                problem: Problem::Value,
                file: place.to_owned(),
                field: "file".into(),
                found,
                expected: expected.into(),
                advice: "Nothing was written; choose another name".into(),
            })
        };
        let data = path.join("data");
        match self.format {
            DataFormat::D4rl if path.is_dir() => {
                refuse(path, "a folder".into(), "the name of a file, which the layout d4rl is")
            }
            DataFormat::Minari if path.exists() && !path.is_dir() => {
                refuse(path, "a file".into(), "the name of a folder, which the layout minari is")
            }
            DataFormat::Minari if data.exists() => {
                let other = if data.is_dir() { not_of_minari(&data)? } else { Some("a file".into()) };
                other.map_or(Ok(()), |found| refuse(&data, found, "a Minari data set and nothing else"))
            }
            DataFormat::D4rl | DataFormat::Minari => Ok(()),
        }
    }

    /// Writes `rows`, in the units of the user's actions, whose range is `range`. Minari takes no `attributes` and no `columns`.
    ///
    /// # Errors
    /// What [`save_d4rl`], [`save_minari`] and [`Self::ensure_replaceable`] refuse.
    pub fn write(
        &self,
        path: &Path,
        rows: &Transitions,
        range: Option<&ActionRange>,
        attributes: &BTreeMap<String, String>,
        columns: &[(&str, &[f32])],
    ) -> Result<(), DataError> {
        self.ensure_replaceable(path)?;
        match self.format {
            DataFormat::D4rl => save_d4rl(path, rows, attributes, columns),
            DataFormat::Minari => {
                let id = self.id.clone().unwrap_or_else(|| id_of(path));
                match self.force && path.exists() {
                    true => replace_minari(path, &id, rows, range),
                    false => save_minari(path, &id, rows, range),
                }
            }
        }
    }
}

/// What makes the folder `data` something else than that of a Minari data set; None: it is one, or empty.
fn not_of_minari(data: &Path) -> Result<Option<String>, FileError> {
    let io = |e| FileError::new(data, "read the folder", e);
    let entries = fs::read_dir(data).map_err(io)?.collect::<Result<Vec<_>, _>>().map_err(io)?;
    let mut names: Vec<String> = entries.iter().map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    let other = names.iter().find(|name| !MINARI.contains(&name.as_str()));
    let whole = names.is_empty() || names.iter().any(|name| name == MINARI[0]);
    Ok(match other {
        Some(other) => Some(format!("{other} in it")),
        None => (!whole).then(|| format!("no {} in it", MINARI[0])),
    })
}

/// Writes a Minari data set into the folder `path`, which is there. The two files of an old one are replaced, each in one step, when the new
/// ones are complete; whatever else is in the folder stays.
fn replace_minari(path: &Path, id: &str, rows: &Transitions, range: Option<&ActionRange>) -> Result<(), DataError> {
    let data = path.join("data");
    // Inside of the folder: a rename from there cannot cross devices. It goes away with all that was not renamed.
    let temporary = AtomicFolder::create(&data)?;
    let set = temporary.path().join("set");
    save_minari(&set, id, rows, range).map_err(|error| under_the_name(path, error))?;
    let fresh = set.join("data");
    if !data.exists() {
        return Ok(move_into_place(&fresh, &data)?);
    }
    for name in MINARI {
        move_into_place(&fresh.join(name), &data.join(name))?;
    }
    Ok(())
}

/// The same error of `path`: nobody knows the temporary folder that it was met in.
fn under_the_name(path: &Path, error: DataError) -> DataError {
    let file = path.to_owned();
    match error {
        DataError::Invalid { problem, field, found, expected, advice, .. } => {
            DataError::Invalid { problem, file, field, found, expected, advice }
        }
        DataError::File(FileError { action, source, .. }) => FileError { path: file, action, source }.into(),
        interrupted => interrupted,
    }
}

/// The id under which Minari finds a folder: the last two parts of its path.
fn id_of(path: &Path) -> String {
    let word = |c: char| if c.is_ascii_alphanumeric() || c == '-' || c == '_' { c } else { '-' };
    let name = |p: Option<&Path>| {
        let name = p.and_then(Path::file_name).map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        name.chars().map(word).collect::<String>()
    };
    let (set, space) = (name(Some(path)), name(path.parent()));
    let space = if space.len() > 1 { space } else { "tce".into() };
    let versioned = set.rsplit_once("-v").is_some_and(|(_, n)| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()));
    if versioned { format!("{space}/{set}") } else { format!("{space}/{set}-v0") }
}

/// An id that Minari takes: NAMESPACE/NAME-v0, of letters, digits, `-` and `_`.
fn parse_id(text: &str) -> Result<String, String> {
    let word =
        |part: &str| !part.is_empty() && part.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_');
    let (space, name) = text.rsplit_once('/').map_or((None, text), |(space, name)| (Some(space), name));
    let versioned =
        name.rsplit_once("-v").is_some_and(|(n, v)| word(n) && !v.is_empty() && v.bytes().all(|b| b.is_ascii_digit()));
    let spaced = space.is_none_or(|s| s.len() > 1 && s.split('/').all(word));
    match versioned && spaced {
        true => Ok(text.to_owned()),
        false => {
            Err(format!("found {text:?}, expected NAMESPACE/NAME-v0 of letters, digits, - and _, as in lab/arm-v0"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_read_and_nonsense_is_refused() {
        let range = parse_range("-20:20,0:1.5").unwrap();
        assert_eq!(range, ActionRange { low: vec![-20.0, 0.0], high: vec![20.0, 1.5] });
        for text in ["", "5", "1:1", "2:1", "-inf:1", "a:b", "-1:1,"] {
            assert!(parse_range(text).is_err(), "{text}");
        }
        let file = Path::new("arm.hdf5");
        assert_eq!(range_of(&parse_range("-2:2").unwrap(), 3, file).unwrap().high, [2.0; 3]);
        assert_eq!(range_of(&range, 2, file).unwrap(), range);
        assert!(range_of(&range, 3, file).unwrap_err().contains("found 2 pairs, expected one, or 3"));
    }

    #[test]
    fn ids_are_those_of_minari() {
        for (path, id) in [
            ("sets/lab/arm-v0", "lab/arm-v0"),
            ("sets/lab/arm", "lab/arm-v0"),
            ("out", "tce/out-v0"),
            ("a/b c-v2", "tce/b-c-v2"),
        ] {
            assert_eq!(id_of(Path::new(path)), id);
            assert_eq!(parse_id(id), Ok(id.to_owned()));
        }
        for id in ["bad id", "", "noversion", "../x-v0", "w/o-v0", "lab/-v0", "lab//x-v0"] {
            assert!(parse_id(id).is_err(), "{id}");
        }
    }

    #[test]
    fn only_a_data_set_gives_way_to_a_data_set() {
        let dir = tempfile::tempdir().unwrap();
        let place = |name: &str| dir.path().join(name);
        let mut rows = Transitions::new(1, 1);
        (0..3).for_each(|i| rows.push(&[i as f32], &[0.0], 0.0, &[i as f32 + 1.0], false, i == 2));
        let write = |format, name: &str| {
            let writing = Writing { format, id: None, force: true };
            writing.write(&place(name), &rows, None, &BTreeMap::new(), &[]).map_err(|e| e.to_string())
        };
        fs::write(place("file"), "mine").unwrap();
        for folder in ["empty", "half/data", "mixed/data"] {
            fs::create_dir_all(place(folder)).unwrap();
        }
        for file in ["half/data/metadata.json", "mixed/data/main_data.hdf5", "mixed/data/raw.hdf5"] {
            fs::write(place(file), "mine").unwrap();
        }
        for (format, name, found) in [
            (DataFormat::D4rl, "empty", "found a folder"),
            (DataFormat::Minari, "file", "found a file"),
            (DataFormat::Minari, "half", "found no main_data.hdf5 in it"),
            (DataFormat::Minari, "mixed", "found raw.hdf5 in it"),
        ] {
            let refused = write(format, name).unwrap_err();
            assert!(refused.contains(found) && refused.contains("choose another name"), "{name}: {refused}");
        }
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 4, "nothing is left behind");
        assert_eq!(fs::read(place("mixed/data/raw.hdf5")).unwrap(), b"mine");
        // An empty folder is filled, and what was written is written again.
        for _ in 0..2 {
            write(DataFormat::Minari, "empty").unwrap();
            assert_eq!(fs::read_dir(place("empty")).unwrap().count(), 1);
            assert_eq!(fs::read_dir(place("empty/data")).unwrap().count(), 2);
        }
    }

    #[test]
    fn a_benchmark_robot_has_its_limit_and_its_dimensions() {
        let own = Own { env: Some((Agent::Hopper, Shift::Morph)), ..Own::default() };
        assert_eq!((own.load_options().dims, own.limit()), (Some((11, 3)), Some(1000)));
        assert_eq!(Own { step_limit: Some(50), ..own }.limit(), Some(50));
        assert_eq!((Own::default().load_options().dims, Own::default().limit()), (None, None));
    }
}
