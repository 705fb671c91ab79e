//! The two data sets of a run: found, loaded, and refused together if they do not fit.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use serde::Serialize;
use tce_base::sha256_file;
use tce_data::{
    Agent, Choice, LoadOptions, Loaded, Quality, ReferenceScores, ScoreTable, Shift, Task, Transitions,
    choose_trajectories, ensure_same_agent, infer_agents, load, reference_scores,
};
use tce_sim::EPISODE_LIMIT;

use crate::actors::{Cast, Recipe};
use crate::config::{Config, TargetConfig, Trajectories};
use crate::error::{Error, Result};
use crate::stand_ins::{self, shared_folder};
use crate::zoo;

/// The files of a benchmark task, and where results go.
#[derive(Clone, Debug, clap::Args)]
pub struct DataArgs {
    /// Source data (default: collected from the zoo's actors, or from those in TCE_SHARED where the zoo lacks one).
    #[arg(long, value_name = "FILE")]
    pub source: Option<PathBuf>,
    /// Target data (default: OTDF's public file if TCE_SHARED has it, otherwise collected from the zoo's actors).
    #[arg(long, value_name = "FILE")]
    pub target: Option<PathBuf>,
    /// Do not look into TCE_SHARED: what is not given as a file is collected from the zoo.
    #[arg(long)]
    pub from_zoo: bool,
    /// Where results and finished stages are kept.
    #[arg(long, default_value = "runs")]
    pub out: PathBuf,
}

/// Source and target, and what is known about where they come from.
#[derive(Debug)]
pub struct Inputs {
    /// The robot, where it is one of the benchmark's.
    pub agent: Option<Agent>,
    /// The target's shift, where the simulator can be used for it.
    pub shift: Option<Shift>,
    /// Target rows.
    pub target: Table,
    /// Source rows; variants that do not look at them can do without.
    pub source: Option<Table>,
}

/// A loaded file.
#[derive(Debug)]
pub struct Table {
    /// The rows.
    pub rows: Transitions,
    /// The file.
    pub file: PathBuf,
    /// SHA-256 of the file, and how many of its rows these are, if not all.
    pub hash: String,
}

/// What a data set is, and how good the policy was that collected it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Behaviour {
    /// The file.
    pub file: PathBuf,
    /// Its rows.
    pub rows: usize,
    /// Whole episodes.
    pub episodes: usize,
    /// Their mean return.
    pub mean: f64,
    /// The spread of their returns.
    pub std: f64,
    /// The mean return, normalised in the domain that the rows come from; None if no episode came to its end.
    pub score: Option<f64>,
}

impl Table {
    fn behaviour(&self, reference: Option<ReferenceScores>) -> Behaviour {
        let content = tce_data::inspect(&self.rows, EPISODE_LIMIT);
        let (returns, score) = (&content.returns, content.normalised_score(reference));
        Behaviour {
            file: self.file.clone(),
            rows: self.rows.len(),
            episodes: returns.count,
            mean: returns.mean,
            std: returns.std,
            score,
        }
    }
}

/// What identifies the inputs in a specification.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct InputSpec {
    agent: Option<Agent>,
    shift: Option<Shift>,
    target: String,
    source: Option<String>,
    /// The rows that are imitated, where they are not all.
    #[serde(skip_serializing_if = "Option::is_none")]
    chosen: Option<String>,
}

fn table(path: &Path, dims: Option<(usize, usize)>) -> Result<Table> {
    let Loaded { transitions, report, .. } = load(path, &LoadOptions { dims, ..LoadOptions::default() })?;
    eprintln!("{report}");
    Ok(Table { rows: transitions, file: path.to_owned(), hash: sha256_file(path)? })
}

/// The first `rows` rows, the last of which ends its episode; None where those are all (0 means all of them, too).
pub(crate) fn first_rows(t: &Transitions, rows: usize) -> Option<Transitions> {
    (rows > 0 && rows < t.len()).then(|| {
        let mut first = t.select(&(0..rows).collect::<Vec<_>>());
        first.timeouts[rows - 1] = !first.terminals[rows - 1];
        first
    })
}

impl Inputs {
    /// A user's own two files.
    pub fn of_files(source: Option<&Path>, target: &Path) -> Result<Self> {
        let target = table(target, None)?;
        let source = source.map(|s| table(s, None)).transpose()?;
        let agents = infer_agents(&target.rows);
        let agent = if let [agent] = agents[..] { Some(agent) } else { None };
        Self { agent, shift: None, target, source }.checked()
    }

    /// The data of a benchmark task: files where given; otherwise OTDF's public target file if the shared folder has it, and
    /// what the zoo's actors (or those of the shared folder) collect: 5000 target rows, and source rows by D4RL's recipe of
    /// which `source_rows` is the size of a medium set. Collected rows are kept beside the results. Without `source_rows` no
    /// source is looked at.
    pub fn of_task(task: Task, args: &DataArgs, source_rows: Option<usize>) -> Result<Self> {
        let Task { agent, shift, .. } = task;
        let dims = Some(agent.dims());
        let target = table(&target_file(task, args)?, dims)?;
        let source = source_rows.map(|rows| table(&source_file(task, args, rows)?, dims)).transpose()?;
        Self { agent: Some(agent), shift: Some(shift), target, source }.checked()
    }

    /// [`Inputs::of_task`] as `config` wants them: without source rows if it has no use for them, with as many target rows as it says.
    pub fn of_config(task: Task, args: &DataArgs, config: &Config) -> Result<Self> {
        let rows = config.needs_source().then_some(config.source.rows);
        Ok(Self::of_task(task, args, rows)?.with_target_rows(config.target.rows))
    }

    /// The first `rows` target rows alone, as if the log had ended there; 0, or more than there are, means all of them.
    pub fn with_target_rows(mut self, rows: usize) -> Self {
        if let Some(first) = first_rows(&self.target.rows, rows) {
            self.target.rows = first;
            self.target.hash = format!("{}, the first {rows} rows", self.target.hash);
        }
        self
    }

    /// The trajectories to imitate, where `config` wants the better ones and the returns show two behaviours; None: all of them.
    pub fn choice(&self, config: &TargetConfig) -> Option<Choice> {
        let wanted = config.trajectories == Trajectories::Auto;
        wanted.then(|| choose_trajectories(&self.target.rows)).filter(Choice::is_selective)
    }

    /// The target rows that are imitated: by the generator, and by learners. What only has to know the dynamics (label models, learned
    /// dynamics) takes all target rows.
    pub fn imitated(&self, config: &TargetConfig) -> Cow<'_, Transitions> {
        match self.choice(config) {
            Some(choice) => Cow::Owned(self.target.rows.select(&choice.rows)),
            None => Cow::Borrowed(&self.target.rows),
        }
    }

    /// [`Inputs::spec`] of work that sees the imitated rows alone.
    pub fn spec_imitated(&self, with_source: bool, config: &TargetConfig) -> InputSpec {
        let chosen = self.choice(config).map(|c| format!("the better trajectories, {} rows", c.rows.len()));
        InputSpec { chosen, ..self.spec(with_source) }
    }

    fn checked(self) -> Result<Self> {
        if let Some(source) = &self.source {
            ensure_same_agent(&source.rows, &self.target.rows)?;
        }
        Ok(self)
    }

    /// What identifies these inputs; with `source` left out for stages that do not look at it.
    pub fn spec(&self, with_source: bool) -> InputSpec {
        InputSpec {
            agent: self.agent,
            shift: self.shift,
            target: self.target.hash.clone(),
            source: self.source.as_ref().filter(|_| with_source).map(|s| s.hash.clone()),
            chosen: None,
        }
    }

    /// The source rows.
    ///
    /// # Errors
    /// If the run has none.
    pub fn source_rows(&self) -> Result<&Transitions> {
        let source = self.source.as_ref().map(|s| &s.rows);
        source.ok_or_else(|| Error::Usage("this configuration needs source data; give a file with --source".into()))
    }

    /// How good the policies were that collected the source and the target rows.
    pub fn behaviour(&self, table: ScoreTable) -> (Option<Behaviour>, Behaviour) {
        let of_source = self.agent.and_then(|agent| reference_scores(agent, Shift::Source, table));
        let source = self.source.as_ref().map(|s| s.behaviour(of_source));
        (source, self.target.behaviour(self.reference(table)))
    }

    /// The returns that stand for 0 and 100 in the target domain.
    pub fn reference(&self, table: ScoreTable) -> Option<ReferenceScores> {
        reference_scores(self.agent?, self.shift?, table)
    }
}

/// The target data of a task, collected now if it has to be; see [`Inputs::of_task`].
///
/// # Errors
/// If the zoo lacks an actor, or the rows cannot be written.
pub fn target_file(task: Task, args: &DataArgs) -> Result<PathBuf> {
    let Task { agent, shift, target, .. } = task;
    let public = task.target_file(&shared_folder());
    match &args.target {
        Some(path) => Ok(path.clone()),
        None if !args.from_zoo && public.exists() => Ok(public),
        None => {
            let recipe = zoo::cast(agent, shift)?.target(agent, shift, target, 0);
            collected(&recipe.ok_or_else(|| missing(shift, target, agent, "--target"))?, target, args)
        }
    }
}

/// The source data of a task, of which `rows` is the size of a medium set, collected now if it has to be.
///
/// # Errors
/// As for [`target_file`].
pub fn source_file(task: Task, args: &DataArgs, rows: usize) -> Result<PathBuf> {
    match &args.source {
        Some(path) => Ok(path.clone()),
        None => collected(&d4rl_recipe(task.agent, task.source, rows, 0, args.from_zoo)?, task.source, args),
    }
}

fn collected(recipe: &Recipe, quality: Quality, args: &DataArgs) -> Result<PathBuf> {
    recipe.cached(&args.out.join("data"), &format!("{}-{}-{quality}", recipe.agent, recipe.shift))
}

/// Source data of this quality at D4RL's specification: from the zoo, or from the stand-ins of the shared folder for what the zoo
/// lacks, unless `from_zoo`.
///
/// # Errors
/// If an actor is missing in both.
pub fn d4rl_recipe(agent: Agent, quality: Quality, rows: usize, seed: u64, from_zoo: bool) -> Result<Recipe> {
    let of = |cast: Cast| cast.source(agent, Shift::Source, quality, rows, seed);
    let recipe = of(zoo::cast(agent, Shift::Source)?);
    let recipe = recipe.or_else(|| if from_zoo { None } else { of(stand_ins::cast(agent, &shared_folder())) });
    recipe.ok_or_else(|| missing(Shift::Source, quality, agent, "--source"))
}

fn missing(shift: Shift, quality: Quality, agent: Agent, option: &str) -> Error {
    Error::missing(
        &shared_folder(),
        format!(
            "no {quality} data of {agent}-{shift}: the zoo has no actors for it (tce zoo list), and neither has this folder; \
             give a file with {option}, or set TCE_SHARED to the folder that holds datasets/otdf and policies"
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_target_rows_are_as_if_the_log_had_ended() {
        let mut t = Transitions::new(1, 1);
        (0..10).for_each(|i| t.push(&[i as f32], &[0.0], i as f32, &[i as f32 + 1.0], i == 4, i == 9));
        let table = |rows: &Transitions| Table { rows: rows.clone(), hash: "h".into(), file: "t.hdf5".into() };
        let inputs = |rows: usize| {
            let all = Inputs { agent: None, shift: None, target: table(&t), source: Some(table(&t)) };
            all.with_target_rows(rows)
        };
        let few = inputs(7);
        assert_eq!(few.target.rows.rewards, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(few.target.rows.episodes().iter().map(|e| e.end).collect::<Vec<_>>(), [5, 7]);
        assert!(few.target.rows.timeouts[6] && !few.target.rows.terminals[6]);
        assert_eq!(few.target.hash, "h, the first 7 rows");
        // An episode that is over is not cut off.
        let ended = inputs(5).target.rows;
        assert!(ended.terminals[4] && !ended.timeouts[4]);
        for rows in [0, 10, 11] {
            assert_eq!((inputs(rows).target.rows.len(), inputs(rows).target.hash.as_str()), (10, "h"), "{rows}");
        }
        assert_eq!(few.source.unwrap().rows.len(), 10, "the source stays");
    }
}
