//! The zoo: actors that this very program trained, by SAC or by cloning, shipped inside it, with a card each.
//!
//! An actor is a safetensors file in half precision under `crates/tce-zoo/zoo`, named `AGENT-SHIFT-ROLE`. Wherever a policy's file is
//! asked for, `zoo:NAME` stands for one of them. Roles are `medium` and `expert` (D4RL's returns in the source domain, OTDF's
//! in the others) and `stage-N`, an earlier policy of the training that led to `medium`, at a score of about N.

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

/// What a policy's file says about where it comes from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Card {
    /// The robot.
    pub agent: Agent,
    /// The domain it was trained in.
    pub shift: Shift,
    /// What it is in the zoo for.
    #[serde(default)]
    pub role: Option<String>,
    /// Of the training.
    pub seed: u64,
    /// Environment steps of the training until then.
    pub steps: u64,
    /// Updates until then.
    pub updates: u64,
    /// Rows per update.
    pub batch: usize,
    /// The training whose networks this one began with.
    pub from: Option<String>,
    /// The rows whose behaviour it was cloned from; none for SAC.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cloned_from: Option<String>,
    /// Episodes with sampled actions behind the next metrics.
    pub episodes: usize,
    /// Mean return.
    pub mean: f64,
    /// Standard deviation of the returns.
    pub std: f64,
    /// Mean length.
    pub length: f64,
    /// Normalised score of the mean return; none where nobody publishes references.
    pub score: Option<f64>,
    /// The program that trained it.
    pub program: String,
}

impl Card {
    /// The card of a clone of the rows that `cloned_from` describes, before anyone has evaluated it.
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
    /// If it cannot be read.
    pub fn of(parameters: &NamedParameters, path: &Path) -> Result<Option<Self>> {
        let Some(text) = parameters.metadata.get(CARD) else { return Ok(None) };
        let card = serde_json::from_str(text);
        card.map(Some).map_err(|e| Error::Failed(format!("{}: field 'card': {e}", path.display())))
    }

    /// Puts the card into a policy's parameters.
    pub fn attach(&self, parameters: &mut NamedParameters) {
        parameters.metadata.insert(CARD.into(), serde_json::to_string(self).expect("plain data"));
    }

    /// The name in the zoo.
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
    /// All of them, by name.
    pub fn all() -> Vec<Self> {
        let files = FILES.files().filter(|f| f.path().extension().is_some_and(|e| e == "safetensors"));
        let name = |f: &include_dir::File<'static>| f.path().file_stem().and_then(|s| s.to_str()).expect("plain names");
        let mut all: Vec<_> = files.map(|f| Self { name: name(f), bytes: f.contents() }).collect();
        all.sort_by_key(|e| e.name);
        all
    }

    /// The one called `name`.
    ///
    /// # Errors
    /// If there is none; the message names the one that is most like it.
    pub fn find(name: &str) -> Result<Self> {
        let all = Self::all();
        all.iter().find(|e| e.name == name).copied().ok_or_else(|| {
            let hint = did_you_mean(name, all.iter().map(|e| e.name));
            Error::Usage(format!("the zoo has no actor `{name}` (tce zoo list shows all){hint}"))
        })
    }

    /// The one that a path of the form `zoo:NAME` stands for; none for any other path.
    ///
    /// # Errors
    /// If the zoo has none of that name.
    pub fn at(path: &Path) -> Result<Option<Self>> {
        path.to_str().and_then(|p| p.strip_prefix("zoo:")).map(Self::find).transpose()
    }

    /// The path that stands for it.
    pub fn path(&self) -> PathBuf {
        PathBuf::from(format!("zoo:{}", self.name))
    }

    /// SHA-256 of its file.
    pub fn sha256(&self) -> String {
        sha256_hex(self.bytes)
    }

    /// Bytes of its file.
    pub fn size(&self) -> usize {
        self.bytes.len()
    }

    /// Its weights and metadata.
    pub fn parameters(&self) -> Result<NamedParameters> {
        Ok(NamedParameters::from_bytes(self.bytes, &self.path())?)
    }

    /// Ready to act.
    pub fn policy(&self) -> Result<Policy> {
        Ok(Policy::from_parameters(&self.parameters()?, &self.path())?)
    }

    /// Where it comes from, and what it does.
    pub fn card(&self) -> Result<Card> {
        let card = Card::of(&self.parameters()?, &self.path())?;
        card.ok_or_else(|| Error::Failed(format!("{}: has no card", self.path().display())))
    }
}

/// The actors of one robot in one domain. A part that the zoo lacks is empty.
///
/// In the replay mixture an actor stands for the training steps that are nearer to its own than to the other stages', so
/// that the mixture's shares are those of a replay buffer filled until the medium level.
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

/// The training steps up to the last stage that each of `steps` (ascending) is nearest to.
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
        assert!(all.iter().map(Exhibit::size).sum::<usize>() <= 8 << 20, "the zoo has more than 8 MiB");
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
