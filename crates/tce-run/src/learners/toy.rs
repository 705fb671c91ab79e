//! A learner in one file, which a line in the registry makes known: what a further method looks like.

use std::path::Path;
use std::sync::Arc;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use tce_data::Transitions;
use tce_learn::{
    About, Bc, BcConfig, Built, LearnError, LearnedRows, Learner, Meter, Method, Minibatch, OtherRows, Policy,
    PolicyLearner, RowScores, Setup,
};
use tce_nn::{NamedParameters, NetworkError};

use super::{Algorithm, LearnerConfig};
use crate::config::EvaluationConfig;
use crate::error::Result;
use crate::keys::{explain, presets, schema};
use crate::layers::{Layered, Preset};
use crate::policy_training::{MemberData, learn};

/// Behaviour cloning that skips steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ToyConfig {
    /// One step of so many is done. Source: own.
    #[schemars(range(min = 1, max = 10))]
    pub stride: u64,
}

impl Default for ToyConfig {
    fn default() -> Self {
        Self { stride: 2 }
    }
}

impl Method for ToyConfig {
    fn about(&self) -> About {
        About {
            name: "toy",
            title: "Toy",
            description: "behaviour cloning that skips steps",
            reference: "nobody",
            published: None,
            table: "toy",
            needs: OtherRows::Any,
            episodes: false,
            scores: RowScores::None,
        }
    }

    fn check(&self) -> Result<(), LearnError> {
        match self.stride {
            1..=10 => Ok(()),
            n => Err(LearnError::invalid("stride", n.to_string(), "1 to 10", "choose one of them")),
        }
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let bc = Bc::new(on.buffer, &BcConfig::default(), on.steps, on.device)?;
        Ok(Some(Box::new(Toy { bc, stride: self.stride })))
    }
}

struct Toy {
    bc: Bc,
    stride: u64,
}

impl Learner for Toy {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        if step.is_multiple_of(self.stride) {
            self.bc.update(batch, step, meter);
        }
    }

    fn state(&self) -> NamedParameters {
        self.bc.state()
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.bc.restore(state, path)
    }
}

impl PolicyLearner for Toy {
    fn policies(&self) -> Vec<Policy> {
        self.bc.policies()
    }
}

fn config(sets: &[&str]) -> Result<LearnerConfig> {
    let sets: Vec<String> = sets.iter().map(|s| (*s).to_owned()).collect();
    Ok(Layered::new(Preset::Quick, None, None, None, &sets)?.config()?.learner)
}

#[test]
fn a_line_makes_it_known_everywhere() {
    // On the command line and in the list.
    assert_eq!(Algorithm::from_str("toy", false), Ok(Algorithm::Toy));
    assert!(Algorithm::ALL.iter().any(|a| a.about().description == "behaviour cloning that skips steps"));
    // In configurations: no preset has its table.
    let own = config(&["learner.algorithm=toy"]).unwrap();
    assert_eq!((own.algorithm, own.toy.stride), (Algorithm::Toy, 2));
    let own = config(&["learner.algorithm=toy", "learner.toy.stride=3"]).unwrap();
    assert_eq!(own.toy.stride, 3);
    let refused = |sets: &[&str]| config(sets).unwrap_err().to_string();
    assert!(refused(&["learner.toy.strid=3"]).contains("did you mean `learner.toy.stride`?"));
    assert!(refused(&["learner.toy.stride=11"]).contains("learner.toy: "));
    let layered = Layered::new(Preset::Quick, None, None, None, &[]).unwrap();
    let explained = explain(&layered, &presets().unwrap(), &schema(), "learner.toy.stride").unwrap();
    assert_eq!(
        (explained.what.as_str(), explained.range.as_deref()),
        ("One step of so many is done.", Some("1 to 10"))
    );
    // In the keys of runs: its own keys alone, and only where it is the one that learns.
    let used = own.used(LearnedRows::Mixed);
    assert_eq!((&used["toy"]["stride"], used.get("iql"), used.get("bc")), (&3.into(), None, None));
    assert!(config(&["learner.algorithm=bc"]).unwrap().used(LearnedRows::Mixed).get("toy").is_none());
    // A sweep that was planned before knows nothing of it.
    let mut before = toml::Value::try_from(&own).unwrap();
    before.as_table_mut().unwrap().remove("toy");
    assert_eq!(before.try_into::<LearnerConfig>().unwrap().toy, ToyConfig::default());
}

#[test]
fn it_learns_like_any_other() {
    let mut rows = Transitions::new(2, 1);
    (0..64).for_each(|i| rows.push(&[i as f32, -(i as f32)], &[0.5], 1.0, &[i as f32 + 1.0, 0.0], false, i % 16 == 15));
    let rows = Arc::new(rows);
    let data = |seed| MemberData {
        seed,
        target: rows.clone(),
        extra: Some(rows.clone()),
        row_scores: None,
        trajectories: vec![rows.clone()],
    };
    let learner = config(&["learner.algorithm=toy", "learner.steps=6", "learner.batch=8"]).unwrap();
    let evaluation = EvaluationConfig { episodes: 1, every: 0, scores: Default::default() };
    let train = || {
        let (dir, mut policies) = (tempfile::tempdir().unwrap(), Vec::new());
        let place = (dir.path(), "key");
        let keep = |p: &[Policy]| {
            policies.extend(p.iter().map(|p| p.to_parameters().to_bytes()));
            Ok(())
        };
        let _ = learn(vec![data(0), data(1)], &learner, &evaluation, None, place, &tce_nn::cpu(), keep).unwrap();
        policies
    };
    let first = train();
    assert_eq!((first.len(), &first), (2, &train()), "the same seeds give the same policies");
    assert_ne!(first[0], first[1]);
}
