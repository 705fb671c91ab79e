//! Where the data of a benchmark task come from: files, or actors that collect them.

use std::path::PathBuf;

use tce_data::{Agent, Quality, Shift, Task};
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

/// Where the data of a task come from.
enum Origin {
    /// A file that is there.
    File(PathBuf),
    /// Actors that collect it.
    Collected(Recipe),
}

fn target_origin(task: Task, args: &DataArgs) -> Result<Origin> {
    let Task { agent, shift, target, .. } = task;
    let public = task.target_file(&shared_folder());
    match &args.target {
        Some(path) => Ok(Origin::File(path.clone())),
        None if !args.from_zoo && public.exists() => Ok(Origin::File(public)),
        None => {
            let recipe = exhibits::cast(agent, shift)?.target(agent, shift, target, 0);
            Ok(Origin::Collected(recipe.ok_or_else(|| missing(shift, target, agent, "--target"))?))
        }
    }
}

fn source_origin(task: Task, args: &DataArgs, rows: usize) -> Result<Origin> {
    match &args.source {
        Some(path) => Ok(Origin::File(path.clone())),
        None => Ok(Origin::Collected(d4rl_recipe(task.agent, task.source, rows, 0, args.from_zoo)?)),
    }
}

/// The target data of a task, collected now if it has to be; see [`crate::inputs::Inputs::of_task`].
///
/// # Errors
/// If the zoo lacks an actor, or the rows cannot be written.
pub fn target_file(task: Task, args: &DataArgs) -> Result<PathBuf> {
    match target_origin(task, args)? {
        Origin::File(path) => Ok(path),
        Origin::Collected(recipe) => collected(&recipe, task.target, args),
    }
}

/// The source data of a task, of which `rows` is the size of a medium set, collected now if it has to be.
///
/// # Errors
/// As for [`target_file`].
pub fn source_file(task: Task, args: &DataArgs, rows: usize) -> Result<PathBuf> {
    match source_origin(task, args, rows)? {
        Origin::File(path) => Ok(path),
        Origin::Collected(recipe) => collected(&recipe, task.source, args),
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
    Ok(recipe.cached(&args.out.join("data"), &format!("{}-{}-{quality}", recipe.agent, recipe.shift))?)
}

/// Source data of this quality at D4RL's specification: from the zoo, or from the stand-ins of the shared folder for what the zoo
/// lacks, unless `from_zoo`.
///
/// # Errors
/// If an actor is missing in both.
pub fn d4rl_recipe(agent: Agent, quality: Quality, rows: usize, seed: u64, from_zoo: bool) -> Result<Recipe> {
    let of = |cast: Cast| cast.source(agent, Shift::Source, quality, rows, seed);
    let recipe = of(exhibits::cast(agent, Shift::Source)?);
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
