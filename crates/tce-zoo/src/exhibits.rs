//! The zoo: actors trained by this program itself, by SAC or by cloning, and built into it, each with a card.
//!
//! An actor is a safetensors file in half precision under `crates/tce-zoo/zoo`, named `AGENT-SHIFT-ROLE`. Wherever a
//! policy file is expected, `zoo:NAME` can be used for one of them. Roles are `medium` and `expert` (D4RL's returns in
//! the source domain, OTDF's in the others) and `stage-N`, an earlier policy of the run that led to `medium`, at a
//! score of about N.

use std::path::{Path, PathBuf};

use include_dir::{Dir, include_dir};
use serde::{Deserialize, Serialize};
use tce_base::{did_you_mean, sha256_hex};
use tce_data::{Agent, Shift};
use tce_learn::Policy;
use tce_nn::NamedParameters;

use crate::error::{Error, Result};
use crate::recipes::{Cast, Part};

static FILES: Dir<'_> = include_dir!("$CARGO_MANIFEST_DIR/zoo");

/// Key of the card in a policy file's metadata.
const CARD: &str = "card";

/// The origin of a policy, stored in its file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Card {
    /// The robot.
    pub agent: Agent,
    /// The domain in which it was trained.
    pub shift: Shift,
    /// Its role in the zoo.
    #[serde(default)]
    pub role: Option<String>,
    /// The seed of the training run.
    pub seed: u64,
    /// Environment steps of the training run up to this policy.
    pub steps: u64,
    /// Updates up to this policy.
    pub updates: u64,
    /// Rows per update.
    pub batch: usize,
    /// The training run whose networks this one started from.
    pub from: Option<String>,
    /// The rows from which it was cloned; `None` for SAC.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cloned_from: Option<String>,
    /// Number of episodes with sampled actions in the metrics below.
    pub episodes: usize,
    /// Mean return.
    pub mean: f64,
    /// Standard deviation of the returns.
    pub std: f64,
    /// Mean length.
    pub length: f64,
    /// Normalised score of the mean return; `None` if no reference returns are published.
    pub score: Option<f64>,
    /// The program that trained it.
    pub program: String,
}

impl Card {
    /// The card of a policy cloned from the rows that `cloned_from` describes, before it has been evaluated.
    pub fn of_clone(agent: Agent, shift: Shift, cloned_from: String, seed: u64, updates: u64, batch: usize) -> Self {
        Self {
            agent,
            shift,
            role: None,
            seed,
            steps: 0,
            updates,
            batch,
            from: None,
            cloned_from: Some(cloned_from),
            episodes: 0,
            mean: f64::NAN,
            std: f64::NAN,
            length: f64::NAN,
            score: None,
            program: tce_base::PROGRAM.into(),
        }
    }

    /// The card in a policy file, if it has one.
    ///
    /// # Errors
    /// If the card cannot be read.
    pub fn of(parameters: &NamedParameters, path: &Path) -> Result<Option<Self>> {
        let Some(text) = parameters.metadata.get(CARD) else { return Ok(None) };
        let card = serde_json::from_str(text);
        card.map(Some).map_err(|e| Error::Failed(format!("{}: field 'card': {e}", path.display())))
    }

    /// Adds the card to a policy's parameters.
    pub fn attach(&self, parameters: &mut NamedParameters) {
        parameters.metadata.insert(CARD.into(), serde_json::to_string(self).expect("plain data"));
    }

    /// The policy's name in the zoo.
    pub fn name(&self) -> Option<String> {
        Some(format!("{}-{}-{}", self.agent, self.shift, self.role.as_ref()?))
    }
}

/// One actor of the zoo.
#[derive(Clone, Copy, Debug)]
pub struct Exhibit {
    /// `hopper-source-medium`.
    pub name: &'static str,
    bytes: &'static [u8],
}

impl Exhibit {
    /// All actors of the zoo, sorted by name.
    pub fn all() -> Vec<Self> {
        let files = FILES.files().filter(|f| f.path().extension().is_some_and(|e| e == "safetensors"));
        let name = |f: &include_dir::File<'static>| f.path().file_stem().and_then(|s| s.to_str()).expect("plain names");
        let mut all: Vec<_> = files.map(|f| Self { name: name(f), bytes: f.contents() }).collect();
        all.sort_by_key(|e| e.name);
        all
    }

    /// The actor called `name`.
    ///
    /// # Errors
    /// If there is none; the message suggests the most similar name.
    pub fn find(name: &str) -> Result<Self> {
        let all = Self::all();
        all.iter().find(|e| e.name == name).copied().ok_or_else(|| {
            let hint = did_you_mean(name, all.iter().map(|e| e.name));
            Error::Usage(format!("the zoo has no actor `{name}` (tce zoo list shows all){hint}"))
        })
    }

    /// The actor that a path of the form `zoo:NAME` refers to; `None` for any other path.
    ///
    /// # Errors
    /// If the zoo has no actor of that name.
    pub fn at(path: &Path) -> Result<Option<Self>> {
        path.to_str().and_then(|p| p.strip_prefix("zoo:")).map(Self::find).transpose()
    }

    /// The path `zoo:NAME` that refers to it.
    pub fn path(&self) -> PathBuf {
        PathBuf::from(format!("zoo:{}", self.name))
    }

    /// SHA-256 of the actor's file.
    pub fn sha256(&self) -> String {
        sha256_hex(self.bytes)
    }

    /// Size of the actor's file in bytes.
    pub fn size(&self) -> usize {
        self.bytes.len()
    }

    /// The actor's weights and metadata.
    pub fn parameters(&self) -> Result<NamedParameters> {
        Ok(NamedParameters::from_bytes(self.bytes, &self.path())?)
    }

    /// The policy, ready to act.
    pub fn policy(&self) -> Result<Policy> {
        Ok(Policy::from_parameters(&self.parameters()?, &self.path())?)
    }

    /// The actor's origin and its results.
    pub fn card(&self) -> Result<Card> {
        let card = Card::of(&self.parameters()?, &self.path())?;
        card.ok_or_else(|| Error::Failed(format!("{}: has no card", self.path().display())))
    }
}

/// The actors of one robot in one domain. A part that the zoo does not have is empty.
///
/// In the replay mixture, an actor represents the training steps that are closer to its own step than to those of the
/// other stages. So the shares of the mixture are those of a replay buffer filled until the medium level.
pub fn cast(agent: Agent, shift: Shift) -> Result<Cast> {
    let mut found = Vec::new();
    for exhibit in Exhibit::all() {
        let card = exhibit.card()?;
        if card.agent == agent && card.shift == shift {
            found.push((exhibit, card));
        }
    }
    let with_role = |role: &str| -> Vec<Part> {
        let parts = found.iter().filter(|(_, card)| card.role.as_deref() == Some(role));
        parts.map(|(exhibit, _)| Part { actor: exhibit.path(), weight: 1.0 }).collect()
    };
    let (medium, expert) = (with_role("medium"), with_role("expert"));
    let is = |card: &Card, role: &str| card.role.as_deref().is_some_and(|r| r.starts_with(role));
    let mut stages: Vec<_> = found.iter().filter(|(_, c)| is(c, "stage-") || is(c, "medium")).collect();
    stages.sort_by_key(|(_, card)| card.steps);
    let steps: Vec<u64> = stages.iter().map(|(_, card)| card.steps).collect();
    let complete = stages.len() > 1 && !medium.is_empty();
    let replay = if complete { shares(&steps) } else { Vec::new() };
    let replay =
        stages.iter().zip(replay).map(|((exhibit, _), weight)| Part { actor: exhibit.path(), weight }).collect();
    Ok(Cast { medium, expert, replay })
}

/// For each of `steps` (ascending): the number of training steps, up to the last stage, that are nearest to it.
fn shares(steps: &[u64]) -> Vec<f64> {
    let middle = |k: usize| (steps[k] + steps[k + 1]) as f64 / 2.0;
    let last = steps.len() - 1;
    let upper = |k: usize| if k == last { steps[last] as f64 } else { middle(k) };
    (0..steps.len()).map(|k| upper(k) - if k == 0 { 0.0 } else { middle(k - 1) }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_share_the_steps_of_a_training() {
        assert_eq!(shares(&[10, 20, 60]), [15.0, 25.0, 20.0]);
        assert_eq!(shares(&[7]), [7.0]);
    }

    #[test]
    fn every_exhibit_is_what_its_name_says_and_the_zoo_stays_small() {
        let all = Exhibit::all();
        assert!(all.iter().map(Exhibit::size).sum::<usize>() <= 9 << 20, "the zoo has more than 9 MiB");
        for exhibit in all {
            let card = exhibit.card().unwrap();
            assert_eq!(card.name().as_deref(), Some(exhibit.name));
            let policy = exhibit.policy().unwrap();
            assert_eq!(policy.dims(), card.agent.dims(), "{}", exhibit.name);
            assert!(card.std >= 0.0 && card.episodes >= 20 && card.mean.is_finite(), "{}", exhibit.name);
            assert_eq!(Exhibit::at(&exhibit.path()).unwrap().unwrap().sha256(), exhibit.sha256());
        }
    }

    #[test]
    fn a_name_that_is_not_there_is_refused_with_where_to_look() {
        let message = Exhibit::at(Path::new("zoo:frog")).unwrap_err().to_string();
        assert!(message.contains("`frog`") && message.contains("tce zoo list"), "{message}");
        assert!(Exhibit::at(Path::new("frog.npz")).unwrap().is_none());
    }
}
