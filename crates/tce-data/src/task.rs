//! The benchmark's tasks: `halfcheetah-morph:medium->expert`.

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::{Agent, Quality, Shift};
use serde::{Deserialize, Serialize};

/// One transfer problem: an agent, how the target differs from the source, and the quality of both data sets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Task {
    /// The robot.
    pub agent: Agent,
    /// What the target domain changes.
    pub shift: Shift,
    /// Quality of the source data.
    pub source: Quality,
    /// Quality of the target data.
    pub target: Quality,
}

impl Task {
    /// The 108 tasks of the paper: 3 shifts × 4 agents × 3 source × 3 target qualities.
    pub fn all() -> Vec<Task> {
        let mut tasks = Vec::new();
        for shift in [Shift::Morph, Shift::Kinematic, Shift::Gravity] {
            for agent in Agent::ALL {
                for source in [Quality::Medium, Quality::MediumReplay, Quality::MediumExpert] {
                    for target in [Quality::Medium, Quality::MediumExpert, Quality::Expert] {
                        tasks.push(Task { agent, shift, source, target });
                    }
                }
            }
        }
        tasks
    }

    /// The name as a directory: `halfcheetah-morph-medium-expert` would be ambiguous, so the arrow stays as `-to-`.
    pub fn directory(&self) -> String {
        format!("{}-{}_{}-to-{}", self.agent, self.shift, self.source, self.target)
    }

    /// OTDF's file with this task's target data under `shared` (`$TCE_SHARED`).
    pub fn target_file(&self, shared: &Path) -> PathBuf {
        let quality = self.target.name().replace('-', "_");
        shared.join(format!("datasets/otdf/{}_{}_{quality}.hdf5", self.agent, self.shift.file_name()))
    }
}

impl fmt::Display for Task {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&format!("{}-{}:{}->{}", self.agent, self.shift, self.source, self.target))
    }
}

impl From<Task> for String {
    fn from(task: Task) -> String {
        task.to_string()
    }
}

impl TryFrom<String> for Task {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

/// An agent's name, for clap and for tasks.
pub fn parse_agent(text: &str) -> Result<Agent, String> {
    Agent::ALL
        .into_iter()
        .find(|a| a.name() == text)
        .ok_or_else(|| format!("`{text}` is no agent; expected halfcheetah, hopper, walker2d or ant"))
}

/// `hopper-morph`, or `hopper` for the source domain.
pub fn parse_environment(text: &str) -> Result<(Agent, Shift), String> {
    match text.split_once(['-', '_']) {
        None => Ok((parse_agent(text)?, Shift::Source)),
        Some((agent, shift)) => Ok((parse_agent(agent)?, shift.parse()?)),
    }
}

impl FromStr for Task {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let form =
            || format!("`{text}` is no task; expected AGENT-SHIFT:SOURCE->TARGET, as in hopper-morph:medium->expert");
        let (environment, data) = text.split_once(':').ok_or_else(form)?;
        let (source, target) = data.split_once("->").ok_or_else(form)?;
        let (agent, shift) = parse_environment(environment).map_err(|e| format!("{}: {e}", form()))?;
        if shift == Shift::Source {
            return Err(format!(
                "`{text}`: the target domain must differ from the source domain; name a shift, as in {agent}-morph"
            ));
        }
        let task = Task { agent, shift, source: source.trim().parse()?, target: target.trim().parse()? };
        Ok(task)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_task_reads_back() {
        let tasks = Task::all();
        assert_eq!(tasks.len(), 108);
        for task in tasks {
            assert_eq!(task.to_string().parse(), Ok(task));
        }
    }

    #[test]
    fn the_papers_short_names_are_read() {
        let task: Task = "ant-gravity_0.5:m-r->m-e".parse().unwrap();
        assert_eq!(task.to_string(), "ant-gravity:medium-replay->medium-expert");
        assert_eq!(task.target_file(Path::new("/s")), Path::new("/s/datasets/otdf/ant_gravity_0.5_medium_expert.hdf5"));
    }

    #[test]
    fn nonsense_is_refused_with_the_form_expected() {
        for text in [
            "",
            "hopper",
            "hopper-morph",
            "hopper-morph:medium",
            "frog-morph:medium->expert",
            "hopper-source:medium->expert",
        ] {
            assert!(text.parse::<Task>().is_err(), "{text}");
        }
    }
}
