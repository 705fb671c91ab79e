//! Which policies are compared.

use clap::ValueEnum;
use tce_learn::LearnedRows;

use crate::config::{Algorithm, Config, RowActions};
use crate::error::{Error, Result};

/// Whether the policies are compared, with each other and with a baseline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Comparison {
    /// Learn a baseline from the target rows alone, try all policies in learned dynamics, and recommend one.
    Recommend {
        /// `mixture.actions` is "own": learn further policies from the extra rows, with the baseline's actions.
        both: bool,
    },
    /// Only train the policies.
    Skip,
}

/// Which actions the extra rows are learned with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum TriedActions {
    /// Their own; a generated row's is inferred by the inverse dynamics.
    Own,
    /// Those of clones of the target rows in the same states.
    Clones,
    /// A policy with each; the comparison recommends one.
    Both,
}

impl Comparison {
    /// The comparison of a training on `rows`, where `compare` says that there is one. `actions` goes into `config`; without it clones of extra
    /// rows are compared with both actions, unless `config` says "clones".
    ///
    /// # Errors
    /// If `actions` were said for nothing: there are no extra rows, the learner does not clone, or both are wanted and no comparison.
    pub fn choose(
        config: &mut Config,
        actions: Option<TriedActions>,
        rows: LearnedRows,
        compare: bool,
    ) -> Result<Self> {
        if actions.is_some() && rows == LearnedRows::Target {
            return Err(Error::Usage(
                "actions: found target rows alone, which keep their actions; expected extra rows as well: give them with --extra FILE \
                 (Python: extra=), or leave the option out"
                    .into(),
            ));
        }
        let algorithm = config.learner.algorithm;
        if actions.is_some() && algorithm != Algorithm::Bc {
            return Err(Error::Usage(format!(
                "actions: found the learner {}, expected bc, whose option it is: others learn where the rows' own actions lead to",
                algorithm.about().name
            )));
        }
        let both = match actions {
            Some(TriedActions::Both) if !compare => {
                return Err(Error::Usage(
                    "actions: found both and no comparison, which would recommend one; expected own or clones, or leave --no-verdict out \
                     (Python: compare=False)"
                        .into(),
                ));
            }
            Some(TriedActions::Both) => {
                config.mixture.actions = RowActions::Own;
                true
            }
            Some(TriedActions::Own) => {
                config.mixture.actions = RowActions::Own;
                false
            }
            Some(TriedActions::Clones) => {
                config.mixture.actions = RowActions::Clones;
                false
            }
            None => {
                algorithm == Algorithm::Bc && rows == LearnedRows::Mixed && config.mixture.actions == RowActions::Own
            }
        };
        Ok(if compare { Self::Recommend { both } } else { Self::Skip })
    }

    /// Whether further policies are compared, with the other actions.
    pub fn both(self) -> bool {
        self == Self::Recommend { both: true }
    }
}

#[cfg(test)]
mod tests {
    use LearnedRows::{Mixed, Target};
    use TriedActions::{Both, Clones, Own};

    use super::*;
    use crate::layers::{Layered, Preset};

    #[test]
    fn both_actions_are_tried_where_nothing_else_is_said() {
        let choose = |learner: Algorithm, set: RowActions, said, rows, compare| {
            let mut config = Layered::new(Preset::Quick, None, None, None, &[]).unwrap().config().unwrap();
            (config.learner.algorithm, config.mixture.actions) = (learner, set);
            let chosen = Comparison::choose(&mut config, said, rows, compare);
            chosen.map(|chosen| (chosen, config.mixture.actions)).map_err(|e| e.to_string())
        };
        let (recommend, both) = (Comparison::Recommend { both: false }, Comparison::Recommend { both: true });
        let (own, clones, bc) = (RowActions::Own, RowActions::Clones, Algorithm::Bc);
        assert_eq!(choose(bc, own, None, Mixed, true), Ok((both, own)));
        assert_eq!(choose(bc, clones, Some(Both), Mixed, true), Ok((both, own)));
        // Options say it, and settings do where they say "clones"; "own" is what they say without being asked.
        assert_eq!(choose(bc, clones, None, Mixed, true), Ok((recommend, clones)));
        assert_eq!(choose(bc, own, Some(Clones), Mixed, true), Ok((recommend, clones)));
        assert_eq!(choose(bc, clones, Some(Own), Mixed, true), Ok((recommend, own)));
        // Other learners, other rows, no comparison.
        assert_eq!(choose(Algorithm::Iql, own, None, Mixed, true), Ok((recommend, own)));
        assert_eq!(choose(bc, own, None, Target, true), Ok((recommend, own)));
        assert_eq!(choose(bc, own, None, Mixed, false), Ok((Comparison::Skip, own)));
        assert_eq!(choose(bc, own, Some(Clones), Mixed, false), Ok((Comparison::Skip, clones)));
        for (learner, said, rows, compare, expected) in [
            (bc, Both, Target, true, "found target rows alone"),
            (bc, Own, Target, true, "found target rows alone"),
            (bc, Both, Mixed, false, "found both and no comparison"),
            (Algorithm::Iql, Both, Mixed, true, "found the learner iql, expected bc"),
        ] {
            let error = choose(learner, own, Some(said), rows, compare).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
    }
}
