//! What a report is about: methods, their runs, and what is missing.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tce_data::{Agent, Quality, Shift, Task};
use tce_diagnosis::Diagnosis;

use crate::folder::{Member, RunFolder};

/// The paper's order: shifts, agents, source and target qualities.
pub fn order(task: &Task) -> (usize, usize, Quality, Quality) {
    let place = |k: Option<usize>| k.unwrap_or(usize::MAX);
    let shift = place(Shift::ALL.iter().position(|s| *s == task.shift));
    (shift, place(Agent::ALL.iter().position(|a| *a == task.agent)), task.source, task.target)
}

/// As in a table of one shift: `Hopper, medium → expert`.
pub fn short(task: &Task) -> String {
    format!("{}, {} → {}", agent_title(task.agent), task.source, task.target)
}

/// The agent's name in print.
pub fn agent_title(agent: Agent) -> &'static str {
    match agent {
        Agent::HalfCheetah => "HalfCheetah",
        Agent::Hopper => "Hopper",
        Agent::Walker2d => "Walker2d",
        Agent::Ant => "Ant",
    }
}

/// The shift's name in headings.
pub fn shift_title(shift: Shift) -> &'static str {
    match shift {
        Shift::Source => "No shift",
        Shift::Morph => "Morphology shift",
        Shift::Kinematic => "Kinematic shift",
        Shift::Gravity => "Gravity shift",
        Shift::Gravity5 => "Gravity shift, fivefold",
    }
}

/// A column of the tables.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Method {
    /// Unique among the methods: `tce-og`, or with the name of a sweep's override `tce-og y0.1`.
    pub id: String,
    /// In print.
    pub title: String,
    /// The variant, without an override's name.
    pub variant: String,
    /// The method of that variant, whichever form of it is run: `dara` of `dara-published`.
    pub base: String,
    /// Whether the variant is the method as its public code has it, faults included.
    pub published: bool,
    /// Whether it is one of the baselines that every result has to beat.
    pub baseline: bool,
    /// Whether nothing but the variant decides its settings, so that the paper's column of this name is its counterpart.
    pub plain: bool,
}

/// Where a run's settings come from, and how long it learned.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Recipe {
    /// The preset that its settings are nearest to; None where they are like none.
    pub preset: Option<String>,
    /// Where it differs from that preset.
    pub changed: Vec<Change>,
    /// What it learned by; None where its settings do not say.
    pub learner: Option<Budget>,
    /// What the same method learns by under the paper's settings.
    pub paper: Option<Budget>,
}

impl Recipe {
    /// [`Run::settings`] of a run in `folder`.
    pub fn settings(&self, folder: &RunFolder) -> String {
        if self.preset.is_some() { self.told() } else { folder.config_hash.clone() }
    }

    /// Its preset and what differs from it, in a line.
    pub fn told(&self) -> String {
        let changes = self.changed.iter().map(|c| format!("{} = {}", c.key, c.value)).collect::<Vec<_>>().join(", ");
        match (&self.preset, changes.as_str()) {
            (None, _) => "settings like none of the presets".into(),
            (Some(preset), "") => format!("preset {preset}"),
            (Some(preset), changes) => format!("preset {preset}, {changes}"),
        }
    }

    /// Whether the settings are the paper's.
    pub fn is_papers(&self) -> bool {
        self.preset.as_deref() == Some("paper") && self.changed.is_empty()
    }
}

/// A setting that differs from its preset's; shown as `learner.steps = 60 (12000)`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Change {
    /// The setting's full name.
    pub key: String,
    /// Its value, as TOML.
    pub value: String,
    /// The preset's.
    pub preset: String,
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} = {} ({})", self.key, self.value, self.preset)
    }
}

/// A learner and how many updates it makes.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Budget {
    /// The learner's name.
    pub learner: String,
    /// Its updates.
    pub updates: u64,
}

/// The policy that `tce run` recommended for a task, before anybody looked at scores.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Recommended {
    /// The task.
    pub task: Task,
    /// The run's folder, by its name; None for a run that is not here.
    pub folder: Option<String>,
    /// The policy's seed.
    pub seed: Option<u64>,
    /// The method, as the recommendation names it.
    pub method: String,
    /// Whether the recommendation was sure of itself.
    pub sure: bool,
    /// The folders of the runs that it chose among; empty: all of the task's.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub among: Vec<String>,
}

/// One policy and its score.
#[derive(Clone, Debug)]
pub struct Run {
    /// The task.
    pub task: Task,
    /// The method's id.
    pub method: String,
    /// The seed and its score.
    pub member: Member,
    /// The member's place in its folder.
    pub index: usize,
    /// Its folder, which it may share with other seeds.
    pub folder: Arc<RunFolder>,
    /// Where its settings come from.
    pub recipe: Arc<Recipe>,
}

impl Run {
    /// What tells its settings from those of other runs of its task and method: its recipe, or all of its configuration where that is like
    /// none of the presets. Settings that it does not use make no difference.
    pub fn settings(&self) -> String {
        self.recipe.settings(&self.folder)
    }

    /// The work that it is the result of.
    pub fn work(&self) -> Work {
        Work::of(self.task, &self.method, self.member.seed, &self.recipe, &self.folder)
    }
}

/// What makes two runs the same work; without the seed, what makes them seeds of one work.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Work {
    /// The task.
    pub task: Task,
    /// The method's id.
    pub method: String,
    /// The seed.
    pub seed: u64,
    /// What tells the settings from others ([`Recipe::settings`]).
    pub settings: String,
    /// The data.
    pub inputs: BTreeMap<String, String>,
}

impl Work {
    /// That of `method` with `seed`, whose run is in `folder`.
    pub fn of(task: Task, method: &str, seed: u64, recipe: &Recipe, folder: &RunFolder) -> Self {
        let (settings, inputs) = (recipe.settings(folder), folder.inputs.clone());
        Self { task, method: method.to_owned(), seed, settings, inputs }
    }
}

/// A planned or begun run without a result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Missing {
    /// The task.
    pub task: Task,
    /// The method's id.
    pub method: String,
    /// Its seed, where it has one.
    pub seed: Option<u64>,
    /// What it is, in words.
    pub what: String,
    /// Why there is no result.
    pub why: String,
}

/// What a piece of work cost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// The kind of work, in print.
    pub stage: String,
    /// The robot.
    pub agent: Agent,
    /// Seconds on the clock, of all attempts.
    pub seconds: f64,
    /// Seeds that were done side by side in this time.
    pub seeds: usize,
    /// Most memory of the process, in bytes, where it was noted.
    pub memory: Option<u64>,
}

/// Everything a report is made from.
#[derive(Clone, Debug, Default)]
pub struct Study {
    /// Its name.
    pub name: String,
    /// Whether it is a planned sweep; otherwise it is a folder with runs of `tce run`.
    pub sweep: bool,
    /// Where it is.
    pub directory: String,
    /// Columns, baselines first.
    pub methods: Vec<Method>,
    /// Results.
    pub runs: Vec<Run>,
    /// Runs without a result.
    pub missing: Vec<Missing>,
    /// Results that came later than another of the same work, and differ.
    pub conflicts: Vec<String>,
    /// Anything else a reader has to know.
    pub notes: Vec<String>,
    /// What the stages cost.
    pub costs: Vec<Cost>,
    /// What `tce diagnose` found about its runs.
    pub diagnoses: Vec<Diagnosis>,
    /// The policies that `tce run` recommended.
    pub recommended: Vec<Recommended>,
}

impl Study {
    /// A study without a run.
    pub fn new(name: String, directory: String) -> Self {
        Self { name, directory, ..Self::default() }
    }

    /// Adds all members of a run.
    pub fn add(&mut self, task: Task, method: &str, folder: RunFolder, recipe: &Arc<Recipe>) {
        let folder = Arc::new(folder);
        let run = |(index, member): (usize, &Member)| Run {
            task,
            method: method.to_owned(),
            member: member.clone(),
            index,
            folder: folder.clone(),
            recipe: recipe.clone(),
        };
        self.runs.extend(folder.members.iter().enumerate().map(run));
    }
}
