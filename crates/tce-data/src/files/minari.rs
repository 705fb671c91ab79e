//! Minari's layout (format `hdf5`, versions 0.4 and 0.5): one group `episode_N` per episode, with N + 1 `observations`
//! for N `actions`, `rewards`, `terminations` and `truncations`. Spaces of kind Dict and Tuple are groups of arrays.
//!
//! A data set is a folder with `NAME/data/main_data.hdf5` and `metadata.json` beside it. The user may pass the folder,
//! its `data` folder, or the file.

use std::path::{Path, PathBuf};

use super::episodes_in_groups::{Together, field, numbered, unless_empty};
use super::formats::{Format, Raw};
use super::hdf5::{Beside, Hdf5};
use super::options::LoadOptions;
use super::report::Layout;
use crate::{DataError, Problem};

/// See the [module](self).
pub(super) struct Minari;

const MAIN_FILE: &str = "main_data.hdf5";

/// The file of a data set given as a folder (Minari's); any other path unchanged. [`load`](crate::load) accepts both.
pub fn main_file(path: &Path) -> PathBuf {
    let candidates = [path.join("data").join(MAIN_FILE), path.join(MAIN_FILE)];
    candidates.into_iter().find(|file| file.is_file()).unwrap_or_else(|| path.to_owned())
}

impl Format for Minari {
    fn recognises(&self, file: &Hdf5) -> bool {
        !numbered(file, "", "episode_").is_empty()
    }

    fn read(&self, file: &Hdf5, options: &LoadOptions) -> Result<Raw, DataError> {
        let (mut all, mut empty) = (Together::default(), 0);
        for episode in numbered(file, "", "episode_") {
            let at = |name: &str| format!("{episode}/{name}");
            let Some(actions) = unless_empty(field(file, &at("actions")), &mut empty)? else { continue };
            let states = field(file, &at("observations"))?;
            let beside = Beside { field: &at("actions"), rows: actions.rows };
            let rewards = file.vector(&at("rewards"), beside)?;
            let flags = |name: &str| file.flags(&at(name), beside);
            let (terminations, truncations) = (flags("terminations")?, flags("truncations")?);
            all.same(file, &episode, &states, &actions)?;
            let (n, d) = (actions.rows, states.dim());
            for (name, rows, expected) in [
                ("observations", states.rows, n + 1),
                ("rewards", rewards.rows, n),
                ("terminations", terminations.len(), n),
                ("truncations", truncations.len(), n),
            ] {
                if rows != expected {
                    let (found, expected) = (format!("{rows} rows"), format!("{expected}, for {n} actions"));
                    return Err(file.invalid(
                        Problem::RowCount,
                        &at(name),
                        found,
                        expected,
                        "Write the data set again",
                    ));
                }
            }
            all.observations.extend_from_slice(&states.data[..n * d]);
            all.next_observations.extend_from_slice(&states.data[d..]);
            all.actions.extend(actions.data);
            all.rewards.extend(rewards.data);
            // If the collector did not mark an end, the episode was cut at its last row.
            all.timeouts.extend((0..n).map(|i| !terminations[i] && (truncations[i] || i + 1 == n)));
            all.terminals.extend(terminations);
        }
        all.finish(empty, options);
        Ok(all.raw(Layout::Minari))
    }
}
