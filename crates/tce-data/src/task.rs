//! The tasks of the benchmark, for example `halfcheetah-morph/medium/expert`.

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use tce_base::did_you_mean;

use crate::{Agent, Quality, Shift};

/// One transfer problem: an agent, the difference between target and source, and the quality of both data sets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Task {
    /// The robot.
    pub agent: Agent,
    /// The change in the target domain.
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

    /// The name as a directory. The arrow becomes `-to-`, because `halfcheetah-morph-medium-expert` would be ambiguous.
    pub fn directory(&self) -> String {
        format!("{}-{}_{}-to-{}", self.agent, self.shift, self.source, self.target)
    }

    /// Path under `shared` (`$TCE_SHARED`) of OTDF's file with this task's target data.
    pub fn target_file(&self, shared: &Path) -> PathBuf {
        let quality = self.target.name().replace('-', "_");
        shared.join(format!("datasets/otdf/{}_{}_{quality}.hdf5", self.agent, self.shift.file_name()))
    }
}

impl fmt::Display for Task {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&format!("{}-{}/{}/{}", self.agent, self.shift, self.source, self.target))
    }
}

impl Task {
    /// `halfcheetah-morph:medium->expert`: the older form of the name. Files keep it, so that files of all versions are
    /// the same. In a command, the shell would interpret the `>`.
    pub fn with_arrow(&self) -> String {
        format!("{}-{}:{}->{}", self.agent, self.shift, self.source, self.target)
    }
}

impl From<Task> for String {
    fn from(task: Task) -> String {
        task.with_arrow()
    }
}

impl TryFrom<String> for Task {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

/// Parses an agent's name, for clap and for tasks.
pub fn parse_agent(text: &str) -> Result<Agent, String> {
    Agent::ALL.into_iter().find(|a| a.name() == text).ok_or_else(|| {
        let hint = did_you_mean(text, Agent::ALL.map(Agent::name));
        format!("`{text}` is no robot; expected halfcheetah, hopper, walker2d or ant{hint}")
    })
}

/// Parses `hopper-morph`, or `hopper` for the source domain.
pub fn parse_environment(text: &str) -> Result<(Agent, Shift), String> {
    match text.split_once(['-', '_']) {
        None => Ok((parse_agent(text)?, Shift::Source)),
        Some((agent, shift)) => Ok((parse_agent(agent)?, shift.parse()?)),
    }
}

/// Splits `ROBOT-SHIFT/SOURCE/TARGET` or `ROBOT-SHIFT:SOURCE->TARGET` into robot with shift, source and target.
fn parts(text: &str) -> Option<[&str; 3]> {
    let (environment, data) = text.split_once(['/', ':'])?;
    let (source, target) = data.split_once("->").or_else(|| data.split_once('/'))?;
    Some([environment, source, target].map(str::trim))
}

/// The error message for a text that is not a task name.
fn no_task(text: &str) -> String {
    let expected = "expected ROBOT-SHIFT/SOURCE/TARGET, as in hopper-morph/medium/expert";
    // The shell leaves this of `hopper-morph:medium->expert` without quotes.
    if let Some(source) = text.strip_suffix('-').filter(|t| t.contains(':')) {
        return format!(
            "`{text}` is no task: the shell took the `>` and what follows for a file's name (such a file may be here now); \
             write {}/TARGET",
            source.replacen(':', "/", 1)
        );
    }
    let all: Vec<String> = Task::all().iter().map(Task::to_string).collect();
    // `hopper-morph:medium-expert` means medium and expert; the target is not missing.
    let mut guess = text.replacen(':', "/", 1);
    if guess.matches('/').count() == 1
        && let Some((environment, data)) = guess.split_once('/')
        && let Some((source, target)) = data.rsplit_once('-')
    {
        guess = format!("{environment}/{source}/{target}");
    }
    let hint = did_you_mean(&guess, all.iter().map(String::as_str).filter(|_| guess.matches('/').count() == 2));
    format!("`{text}` is no task; {expected}{hint}")
}

impl FromStr for Task {
    type Err = String;

    /// Parses both forms of the name, and the paper's short ones (`ant-gravity_0.5:m-r->m-e`).
    fn from_str(text: &str) -> Result<Self, String> {
        let [environment, source, target] = parts(text).ok_or_else(|| no_task(text))?;
        let of = |e: String| format!("`{text}` is no task: {e}");
        let (agent, shift) = parse_environment(environment).map_err(of)?;
        if shift == Shift::Source {
            return Err(format!(
                "`{text}`: the target domain must differ from the source domain; name a shift, as in {agent}-morph"
            ));
        }
        let quality = |part: &str, role: &str| {
            if part.is_empty() {
                return Err(format!("`{text}` is no task: its {role} is missing; expected ROBOT-SHIFT/SOURCE/TARGET"));
            }
            part.parse::<Quality>().map_err(of)
        };
        Ok(Task { agent, shift, source: quality(source, "source")?, target: quality(target, "target")? })
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
            assert_eq!(task.with_arrow().parse(), Ok(task));
            assert_eq!(serde_json::to_value(task).unwrap(), task.with_arrow());
        }
    }

    #[test]
    fn the_papers_short_names_are_read() {
        let task: Task = "ant-gravity_0.5:m-r->m-e".parse().unwrap();
        assert_eq!(task.to_string(), "ant-gravity/medium-replay/medium-expert");
        assert_eq!(task.target_file(Path::new("/s")), Path::new("/s/datasets/otdf/ant_gravity_0.5_medium_expert.hdf5"));
    }

    #[test]
    fn nonsense_is_refused_with_the_form_expected() {
        let form = "expected ROBOT-SHIFT/SOURCE/TARGET, as in hopper-morph/medium/expert";
        for (text, words) in [
            ("", form),
            ("hopper", form),
            ("hopper-morph", form),
            ("hopper-morph:medium", form),
            ("hopper-morph:medium-expert", "did you mean `hopper-morph/medium/expert`?"),
            ("hoper-morph:medium-replay-expert", "did you mean `hopper-morph/medium-replay/expert`?"),
            ("hopper-morph:medium-", "write hopper-morph/medium/TARGET"),
            ("hopper-morph/medium/", "its target is missing"),
            ("frog-morph:medium->expert", "`frog` is no robot; expected halfcheetah, hopper, walker2d or ant"),
            ("hoper-morph/medium/expert", "did you mean `hopper`?"),
            ("hopper-morf/medium/expert", "did you mean `morph`?"),
            ("hopper-morph/medium/exprt", "did you mean `expert`?"),
            ("hopper-source:medium->expert", "name a shift, as in hopper-morph"),
            ("hopper/medium/expert", "name a shift, as in hopper-morph"),
        ] {
            let message = text.parse::<Task>().unwrap_err();
            assert!(message.contains(words), "{text}: {message}");
        }
    }
}
