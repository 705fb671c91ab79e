//! Where the data of a benchmark task come from: files, or actors that collect them.

use std::collections::BTreeMap;
use std::path::PathBuf;

use tce_base::sha256_file;
use tce_data::{Agent, LoadOptions, Quality, Shift, Task, Transitions, load};
use tce_zoo::actors::cached;
use tce_zoo::exhibits;
use tce_zoo::recipes::{Cast, Recipe};
use tce_zoo::stand_ins::{self, shared_folder};

use crate::error::{Error, Result};

/// The files of a benchmark task, and where results go.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Data")]
pub struct DataArgs {
    /// Source data (default: collected from the zoo's actors, or from those in TCE_SHARED where the zoo lacks one).
    #[arg(long, value_name = "FILE")]
    pub source: Option<PathBuf>,
    /// Target data (default: OTDF's public file if TCE_SHARED has it, a medium-expert set joined of its medium and expert files, or else rows of the
    /// zoo's actors).
    #[arg(long, value_name = "FILE")]
    pub target: Option<PathBuf>,
    /// Do not look into TCE_SHARED: what is not given as a file is collected from the zoo.
    #[arg(long)]
    pub from_zoo: bool,
    /// Where results and finished stages are kept.
    #[arg(long, default_value = "runs")]
    pub out: PathBuf,
}

/// Whose actors collect rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Actors {
    /// The zoo's.
    Zoo,
    /// The zoo's, and those of the shared folder for what the zoo lacks.
    ZooOrShared,
}

impl DataArgs {
    /// Whose actors may be used.
    pub fn actors(&self) -> Actors {
        if self.from_zoo { Actors::Zoo } else { Actors::ZooOrShared }
    }
}

/// Where the data of a task come from.
enum Origin {
    /// A file that is there.
    File(PathBuf),
    /// Files of which it is joined.
    Joined(Joined),
    /// Actors that collect it.
    Collected(Recipe),
}

/// A medium-expert set of a medium and an expert one.
struct Joined {
    medium: PathBuf,
    expert: PathBuf,
}

/// Trajectories of a medium-expert set, as OTDF's have them.
const MEDIUM_TRAJECTORIES: usize = 2;
const EXPERT_TRAJECTORIES: usize = 3;

impl Joined {
    /// Of OTDF's public files, for a task whose own file is not there.
    fn of(task: Task) -> Option<Self> {
        let file = |target| Task { target, ..task }.target_file(&shared_folder());
        let joined = Self { medium: file(Quality::Medium), expert: file(Quality::Expert) };
        (task.target == Quality::MediumExpert && joined.medium.exists() && joined.expert.exists()).then_some(joined)
    }

    /// The file with the first trajectories of both, written now unless it is there.
    fn file(&self, task: Task, args: &DataArgs) -> Result<PathBuf> {
        let parts = [("medium", &self.medium, MEDIUM_TRAJECTORIES), ("expert", &self.expert, EXPERT_TRAJECTORIES)];
        let mut attributes = BTreeMap::new();
        for (name, file, count) in parts {
            attributes
                .insert(name.to_owned(), format!("the first {count} trajectories of the file {}", sha256_file(file)?));
        }
        let dims = task.agent.dims();
        let options = LoadOptions { dims: Some(dims), ..LoadOptions::default() };
        let join = || {
            let mut rows = Transitions::new(dims.0, dims.1);
            for (_, file, count) in parts {
                let all = load(file, &options)?.transitions;
                let end = all.episodes().get(count - 1).map_or(all.len(), |e| e.end);
                rows.extend(&all.select(&(0..end).collect::<Vec<_>>()));
            }
            Ok(rows)
        };
        Ok(cached(&args.out.join("data"), &data_name(task.agent, task.shift, task.target), &attributes, join)?)
    }
}

fn target_origin(task: Task, args: &DataArgs) -> Result<Origin> {
    let Task { agent, shift, target, .. } = task;
    let public = task.target_file(&shared_folder());
    match &args.target {
        Some(path) => Ok(Origin::File(path.clone())),
        None if !args.from_zoo && public.exists() => Ok(Origin::File(public)),
        None => {
            if let Some(joined) = Joined::of(task).filter(|_| !args.from_zoo) {
                return Ok(Origin::Joined(joined));
            }
            let recipe = exhibits::cast(agent, shift)?.target(agent, shift, target, 0);
            Ok(Origin::Collected(recipe.ok_or_else(|| missing(shift, target, agent, "--target"))?))
        }
    }
}

fn source_origin(task: Task, args: &DataArgs, rows: usize) -> Result<Origin> {
    match &args.source {
        Some(path) => Ok(Origin::File(path.clone())),
        None => Ok(Origin::Collected(d4rl_recipe(task.agent, task.source, rows, 0, args.actors())?)),
    }
}

/// The target data of a task, collected now if it has to be; see [`crate::inputs::Inputs::of_task`].
///
/// # Errors
/// If the zoo lacks an actor, or the rows cannot be written.
pub fn target_file(task: Task, args: &DataArgs) -> Result<PathBuf> {
    target_origin(task, args)?.file(task, task.target, args)
}

/// The source data of a task, of which `rows` is the size of a medium set, collected now if it has to be.
///
/// # Errors
/// As for [`target_file`].
pub fn source_file(task: Task, args: &DataArgs, rows: usize) -> Result<PathBuf> {
    source_origin(task, args, rows)?.file(task, task.source, args)
}

impl Origin {
    /// The file, made now if it has to be.
    fn file(self, task: Task, quality: Quality, args: &DataArgs) -> Result<PathBuf> {
        match self {
            Origin::File(path) => Ok(path),
            Origin::Joined(joined) => joined.file(task, args),
            Origin::Collected(recipe) => collected(&recipe, quality, args),
        }
    }
}

/// Whether the data of a task can be had; of the source only where `source_rows` are needed. Nothing is collected.
///
/// # Errors
/// What is missing, and where it was looked for.
pub fn ensure_data(task: Task, args: &DataArgs, source_rows: Option<usize>) -> Result<()> {
    let origins = std::iter::once(target_origin(task, args)).chain(source_rows.map(|n| source_origin(task, args, n)));
    for origin in origins {
        if let Origin::File(path) = origin?
            && !path.exists()
        {
            return Err(Error::missing(&path, format!("there is no such file; {task} needs it")));
        }
    }
    Ok(())
}

fn collected(recipe: &Recipe, quality: Quality, args: &DataArgs) -> Result<PathBuf> {
    Ok(recipe.cached(&args.out.join("data"), &data_name(recipe.agent, recipe.shift, quality))?)
}

fn data_name(agent: Agent, shift: Shift, quality: Quality) -> String {
    format!("{agent}-{shift}-{quality}")
}

/// Source data of this quality at D4RL's specification: from the zoo, or from the stand-ins of the shared folder for what the zoo
/// lacks, if `actors` may be of both.
///
/// # Errors
/// If an actor is missing in both.
pub fn d4rl_recipe(agent: Agent, quality: Quality, rows: usize, seed: u64, actors: Actors) -> Result<Recipe> {
    let of = |cast: Cast| cast.source(agent, Shift::Source, quality, rows, seed);
    let recipe = of(exhibits::cast(agent, Shift::Source)?);
    let recipe = recipe.or_else(|| match actors {
        Actors::Zoo => None,
        Actors::ZooOrShared => of(stand_ins::cast(agent, &shared_folder())),
    });
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
