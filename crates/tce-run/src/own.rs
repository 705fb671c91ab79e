//! What a user says of own files: the robot, if it is one of the benchmark's, where the collector cut episodes, and the units of
//! actions.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use clap::Args;
use serde::Serialize;
use tce_base::FileError;
use tce_data::{
    ActionRange, Agent, DataError, LoadOptions, Shift, Transitions, parse_environment, save_d4rl, save_minari,
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

impl Writing {
    /// Writes `rows`, in the units of the user's actions, whose range is `range`. Minari takes no `attributes` and no `columns`.
    ///
    /// # Errors
    /// What [`save_d4rl`] and [`save_minari`] refuse.
    pub fn write(
        &self,
        path: &Path,
        rows: &Transitions,
        range: Option<&ActionRange>,
        attributes: &BTreeMap<String, String>,
        columns: &[(&str, &[f32])],
    ) -> Result<(), DataError> {
        match self.format {
            DataFormat::D4rl => save_d4rl(path, rows, attributes, columns),
            DataFormat::Minari => {
                let id = self.id.clone().unwrap_or_else(|| id_of(path));
                if !self.force || !path.exists() {
                    return save_minari(path, &id, rows, range);
                }
                // The new data first, beside the old; whatever else is in the folder stays.
                let io = |e| FileError::new(path, "replace the data of", e);
                let fresh =
                    path.with_file_name(format!(".{}.new", path.file_name().unwrap_or_default().to_string_lossy()));
                let _ = fs::remove_dir_all(&fresh);
                save_minari(&fresh, &id, rows, range)?;
                let _ = fs::remove_dir_all(path.join("data"));
                fs::rename(fresh.join("data"), path.join("data")).map_err(io)?;
                Ok(fs::remove_dir(&fresh).map_err(io)?)
            }
        }
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
    fn a_benchmark_robot_has_its_limit_and_its_dimensions() {
        let own = Own { env: Some((Agent::Hopper, Shift::Morph)), ..Own::default() };
        assert_eq!((own.load_options().dims, own.limit()), (Some((11, 3)), Some(1000)));
        assert_eq!(Own { step_limit: Some(50), ..own }.limit(), Some(50));
        assert_eq!((Own::default().load_options().dims, Own::default().limit()), (None, None));
    }
}
