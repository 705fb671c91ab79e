//! The two data sets of a run: found, loaded, and refused together if they do not fit.

use std::path::{Path, PathBuf};

use serde::Serialize;
use tce_base::sha256_file;
use tce_data::{
    Agent, LoadOptions, Loaded, ReferenceScores, Shift, Transitions, ensure_same_agent, infer_agents, load,
};

use crate::actors::{shared_folder, stand_in};
use crate::error::{Error, Result};
use crate::task::Task;

/// The files of a benchmark task, and where results go.
#[derive(Clone, Debug, clap::Args)]
pub struct DataArgs {
    /// Source data (default: collected from the actors found in TCE_SHARED).
    #[arg(long, value_name = "FILE")]
    pub source: Option<PathBuf>,
    /// Target data (default: OTDF's file found in TCE_SHARED).
    #[arg(long, value_name = "FILE")]
    pub target: Option<PathBuf>,
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
    /// SHA-256 of the file.
    pub hash: String,
}

/// What identifies the inputs in a specification.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct InputSpec {
    agent: Option<Agent>,
    shift: Option<Shift>,
    target: String,
    source: Option<String>,
}

fn table(path: &Path, dims: Option<(usize, usize)>) -> Result<Table> {
    let Loaded { transitions, report, .. } = load(path, &LoadOptions { dims, ..LoadOptions::default() })?;
    eprintln!("{report}");
    Ok(Table { rows: transitions, hash: sha256_file(path)? })
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

    /// The data of a benchmark task: files where given; otherwise OTDF's file and `source_rows` rows collected from
    /// stand-in actors, both from the shared folder. Collected rows are kept beside the results. Without `source_rows`
    /// no source is looked at.
    pub fn of_task(task: Task, args: &DataArgs, source_rows: Option<usize>) -> Result<Self> {
        let shared = shared_folder();
        let target = args.target.clone().unwrap_or_else(|| task.target_file(&shared));
        if !target.exists() {
            return Err(Error::missing(
                &target,
                "no target data there; set TCE_SHARED to the folder that holds datasets/otdf, or give a file with --target",
            ));
        }
        let dims = Some(task.agent.dims());
        let target = table(&target, dims)?;
        let source: Option<PathBuf> = match (source_rows, &args.source) {
            (None, _) => None,
            (Some(_), Some(path)) => Some(path.clone()),
            (Some(rows), None) => {
                let recipe = stand_in(task.agent, task.source, rows, 0, &shared)?;
                Some(recipe.cached(&args.out.join("data"), &format!("{}-source-{}", task.agent, task.source))?)
            }
        };
        let source = source.map(|s| table(&s, dims)).transpose()?;
        Self { agent: Some(task.agent), shift: Some(task.shift), target, source }.checked()
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

    /// The returns that stand for 0 and 100 in the target domain.
    pub fn reference(&self, table: tce_data::ScoreTable) -> Option<ReferenceScores> {
        tce_data::reference_scores(self.agent?, self.shift?, table)
    }
}
