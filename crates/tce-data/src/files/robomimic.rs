//! robomimic's layout: a group `data` with one group `demo_N` per demonstration. Each has `obs` and `next_obs` (groups
//! of arrays), `actions`, `rewards` and `dones`.
//!
//! `dones` are terminals, as in robomimic's own algorithms. A demonstration without a `done` at its end was cut there.
//! Without `next_obs`, s' is the next row's state, and the last row of a demonstration has none.

use super::episodes_in_groups::{Together, field, numbered, unless_empty};
use super::formats::{Format, Raw};
use super::hdf5::{Beside, Hdf5};
use super::options::LoadOptions;
use super::report::Layout;
use crate::{DataError, Problem};

/// See the [module](self).
pub(super) struct Robomimic;

impl Format for Robomimic {
    fn recognises(&self, file: &Hdf5) -> bool {
        file.has("data") && !numbered(file, "data", "demo_").is_empty()
    }

    fn read(&self, file: &Hdf5, options: &LoadOptions) -> Result<Raw, DataError> {
        let (mut all, mut empty) = (Together::default(), 0);
        let (mut known, mut lacking) = (Vec::new(), 0usize);
        for demo in numbered(file, "data", "demo_") {
            let demo = format!("data/{demo}");
            let at = |name: &str| format!("{demo}/{name}");
            let Some(actions) = unless_empty(field(file, &at("actions")), &mut empty)? else { continue };
            let states = field(file, &at("obs"))?;
            let members = file.names_in(&demo)?.unwrap_or_default();
            let has = |name: &str| members.iter().any(|m| m == name);
            let next = if has("next_obs") { Some(field(file, &at("next_obs"))?) } else { None };
            let n = actions.rows;
            let beside = Beside { field: &at("actions"), rows: n };
            let rewards = if has("rewards") { file.vector(&at("rewards"), beside)?.data } else { vec![0.0; n] };
            let dones = if has("dones") { file.flags(&at("dones"), beside)? } else { vec![false; n] };
            all.same(file, &demo, &states, &actions)?;
            let mut counts = vec![("obs", states.rows), ("rewards", rewards.len()), ("dones", dones.len())];
            counts.extend(next.as_ref().map(|f| ("next_obs", f.rows)));
            if let Some((name, rows)) = counts.into_iter().find(|c| c.1 != n) {
                let (found, expected) = (format!("{rows} rows"), format!("{n}, as in `actions`"));
                return Err(file.invalid(Problem::RowCount, &at(name), found, expected, "Write the file again"));
            }
            if next.as_ref().is_some_and(|f| f.parts != states.parts) {
                let found = "other columns than `obs`";
                return Err(file.invalid(
                    Problem::Dimension,
                    &at("next_obs"),
                    found,
                    "the same",
                    "Write the file again",
                ));
            }
            let d = states.dim();
            match next {
                Some(next) => {
                    all.next_observations.extend(next.data);
                    known.resize(known.len() + n, true);
                }
                None => {
                    all.next_observations.extend_from_slice(&states.data[d..]);
                    all.next_observations.extend_from_slice(&states.data[(n - 1) * d..]);
                    known.resize(known.len() + n - 1, true);
                    known.push(false);
                    lacking += 1;
                }
            }
            all.observations.extend(states.data);
            all.actions.extend(actions.data);
            all.rewards.extend(rewards);
            all.timeouts.extend((0..n).map(|i| i + 1 == n && !dones[i]));
            all.terminals.extend(dones);
        }
        if lacking > 0 {
            all.warnings.push(format!(
                "{lacking} demonstrations have no `next_obs`: s' is the next row's state, and their last rows have none"
            ));
        }
        all.finish(empty, options);
        let mut raw = all.raw(Layout::Robomimic);
        raw.known = Some(known);
        Ok(raw)
    }
}
