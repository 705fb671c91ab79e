//! What determines a training run, and when it ends.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tce_base::read_json;
use tce_data::{Agent, Shift};
use tce_learn::sac::SacConfig;

use crate::error::{Error, Result};

/// The settings in a training run's directory.
pub(super) const FILE: &str = "settings.json";
/// What to do about a damaged file.
pub(super) const REMEDY: &str = "the file is damaged";

/// All settings that determine a training run. Its goal may change when it is resumed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// The robot.
    pub agent: Agent,
    /// The domain.
    pub shift: Shift,
    /// The seed of all random numbers.
    pub seed: u64,
    /// Steps before the first update. They are uniformly random if the networks are new.
    pub start: u64,
    /// Environment steps per update.
    pub steps_per_update: u64,
    /// Share of uniformly random actions until the policy's first update, if the policy is not new. They show the
    /// critics the effects of actions other than the policy's own.
    #[serde(default, skip_serializing_if = "no_exploration")]
    pub explore: f64,
    /// Rows per update.
    pub batch: usize,
    /// The networks that it started from, if they are not new.
    pub from: Option<Origin>,
    /// Steps between evaluations.
    pub evaluate_every: u64,
    /// Episodes of an evaluation, with sampled actions.
    pub episodes: usize,
    /// The learner.
    pub sac: SacConfig,
}

fn no_exploration(share: &f64) -> bool {
    *share == 0.0
}

/// When a training run ends, and which policies it keeps.
#[derive(Clone, Debug, PartialEq)]
pub struct Goal {
    /// Total number of environment steps.
    pub steps: u64,
    /// Stop at the first evaluation with this score.
    pub until: Option<f64>,
    /// Keep the policy of the first evaluation at or above each of these scores.
    pub snapshots: Vec<f64>,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
}

/// What a training run started from, if not from new networks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Origin {
    /// All networks of another training run.
    Training {
        /// The directory of that run.
        directory: PathBuf,
        /// `hopper-source seed 0, step 300000`.
        training: String,
        /// The file with its networks in that directory.
        file: String,
        /// SHA-256 of that file.
        sha256: String,
    },
    /// A policy; critics and temperature are new.
    Actor {
        /// Its file, or `zoo:NAME`.
        actor: PathBuf,
        /// SHA-256 of that file.
        sha256: String,
    },
}

impl Origin {
    /// The path that the user gave.
    pub(super) fn path(&self) -> &Path {
        match self {
            Self::Training { directory: path, .. } | Self::Actor { actor: path, .. } => path,
        }
    }

    /// The text for a card.
    pub(super) fn describe(&self) -> String {
        match self {
            Self::Training { training, .. } => training.clone(),
            Self::Actor { actor, .. } => actor.display().to_string(),
        }
    }
}

impl Settings {
    /// The settings of the training run in `directory`; `None` if there are none.
    ///
    /// # Errors
    /// If they are damaged.
    pub(super) fn read(directory: &Path) -> Result<Option<Self>> {
        Ok(read_json(&directory.join(FILE), REMEDY)?)
    }

    /// The settings of the run in `directory` that is to be resumed with these, and from `from` if given.
    ///
    /// # Errors
    /// If that run has other settings or another origin.
    pub(super) fn resuming(mut self, directory: &Path, from: Option<&Path>) -> Result<Self> {
        let path = directory.join(FILE);
        let found = Self::read(directory)?.ok_or_else(|| {
            Error::Failed(format!("{}: missing, beside a checkpoint; restore the directory", path.display()))
        })?;
        if let (Some(from), Some(found)) = (from, &found.from)
            && from != found.path()
        {
            return Err(Error::Usage(format!(
                "{}: the training there began with {}, not {}",
                path.display(),
                found.path().display(),
                from.display()
            )));
        }
        self.from.clone_from(&found.from);
        if found != self || (from.is_some() && found.from.is_none()) {
            return Err(Error::Usage(format!(
                "{}: the training there has other settings; give another --out, or the settings it began with",
                path.display()
            )));
        }
        Ok(self)
    }
}
