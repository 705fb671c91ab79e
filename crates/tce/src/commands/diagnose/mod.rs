//! `tce diagnose`.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use serde::Serialize;
use tce_base::{FileError, read_if_there, write_atomically};
use tce_data::Task;
use tce_diagnosis::Diagnosis;
use tce_learn::TransitionConfig;
use tce_nn::Device;
use tce_run::config::Config;
use tce_run::diagnosis::{Options, Subject, can_be_diagnosed, diagnose, member_of};
use tce_run::error::{Error, Result};
use tce_run::inputs::{DataArgs, Inputs};
use tce_run::layers::ConfigArgs;
use tce_run::own::Own;
use tce_run::study::task_of;
use tce_run::variant::Variant;

use crate::output::Output;

mod generator;
mod render;

use generator::GeneratorArgs;

/// Measure what a run's generator does: coverage, reliability, copies, label errors, Theorem 1 and the λ it chooses.
///
/// `tce diagnose RUN` takes the directory of a finished run with generated rows (tce-og, say); `tce diagnose --source old.hdf5 --target
/// new.hdf5` takes two files of your own and needs no simulator.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct Diagnose {
    #[command(subcommand)]
    part: Option<Part>,
    #[command(flatten)]
    run: RunArgs,
}

/// Parts of the pipeline.
#[derive(Debug, Subcommand)]
enum Part {
    /// The generator: every noise process with every sampler, against held-out rows and the simulator.
    Generator(GeneratorArgs),
}

/// What to diagnose.
#[derive(Debug, Args)]
struct RunArgs {
    /// The run's directory, RUNS/TASK/METHOD-KEY as `tce run` prints it.
    #[arg(value_name = "RUN", required_unless_present = "target")]
    run: Option<PathBuf>,
    /// Source data: of the run, where its own is not found; or your own.
    #[arg(long, value_name = "FILE", help_heading = "Data")]
    source: Option<PathBuf>,
    /// Target data: of the run, where its own is not found; or your own.
    #[arg(long, value_name = "FILE", help_heading = "Data")]
    target: Option<PathBuf>,
    /// The run's data were collected with --from-zoo.
    #[arg(long, help_heading = "Data")]
    from_zoo: bool,
    /// Where stages are kept (default: the run's own folder, or runs).
    #[arg(long)]
    out: Option<PathBuf>,
    /// The seed to look at (default: the run's first, or 0).
    #[arg(long)]
    seed: Option<u64>,
    /// Rows behind every metric.
    #[arg(long, default_value_t = Options::default().rows, help_heading = "What is measured")]
    rows: usize,
    /// Label bounds, separated by commas; 0 and the run's own are among them in any case.
    #[arg(long, value_delimiter = ',', default_values_t = Options::default().y_max, help_heading = "What is measured")]
    y_max: Vec<f32>,
    /// Use no simulator, as for a robot of your own.
    #[arg(long, help_heading = "What is measured")]
    no_simulator: bool,
    /// Updates of the transition models.
    #[arg(long, default_value_t = Options::default().transition.steps, help_heading = "What is measured")]
    transition_steps: u64,
    /// Updates of the value function.
    #[arg(long, default_value_t = Options::default().value_steps, help_heading = "What is measured")]
    value_steps: u64,
    /// Abundant target rows to simulate.
    #[arg(long, default_value_t = Options::default().abundant, help_heading = "What is measured")]
    abundant: usize,
    /// Episodes of the policy that the generator implies, in the simulator.
    #[arg(long, default_value_t = Options::default().episodes, help_heading = "What is measured")]
    episodes: usize,
    #[command(flatten)]
    own: Own,
    #[command(flatten)]
    config: ConfigArgs,
}

impl Diagnose {
    /// Runs the command.
    pub fn run(self, output: Output, device: &Device) -> Result<()> {
        match self.part {
            Some(Part::Generator(args)) => args.run(output, device),
            None => self.run.run(output, device),
        }
    }
}

/// A finished run, as its directory tells it.
struct Finished {
    config: Config,
    seeds: Vec<u64>,
    task: Task,
    root: PathBuf,
    target: String,
    source: Option<String>,
    /// Where the run's target and source rows were, where it tells.
    data: Vec<PathBuf>,
}

impl Finished {
    fn read(directory: &Path) -> Result<Self> {
        let read = |name: &str| -> Result<String> {
            let path = directory.join(name);
            match read_if_there(&path)? {
                Some(bytes) => Ok(String::from_utf8_lossy(&bytes).into_owned()),
                None => Err(Error::missing(
                    &path,
                    "no such file; give the directory of a finished run, RUNS/TASK/METHOD-KEY as `tce run` prints it, or two files \
                     of your own with --source and --target",
                )),
            }
        };
        let damaged = |name: &str, why: String| {
            Error::Failed(format!("{}: {why}; is this a run of this version of tce?", directory.join(name).display()))
        };
        let (spec, config) = (read("spec.json")?, read("config.toml")?);
        let done = read("done.json")?;
        let done: serde_json::Value = serde_json::from_str(&done).map_err(|e| damaged("done.json", e.to_string()))?;
        let spec: serde_json::Value = serde_json::from_str(&spec).map_err(|e| damaged("spec.json", e.to_string()))?;
        let (inputs, seeds) = (&spec["spec"]["inputs"], &spec["spec"]["seeds"]);
        let seeds = serde_json::from_value(seeds.clone()).map_err(|e| damaged("spec.json", format!("seeds: {e}")))?;
        let hash = |key: &str| inputs[key].as_str().map(str::to_owned);
        let place = directory.canonicalize().map_err(|e| FileError::new(directory, "find", e))?;
        let folder = place.parent();
        let task = folder.and_then(task_of).ok_or_else(|| {
            let found = folder.map_or_else(String::new, |f| f.display().to_string());
            Error::Usage(format!(
                "{}: found the run in {found}, expected a folder named after its task, as hopper-morph_medium-to-expert",
                directory.display()
            ))
        })?;
        Ok(Self {
            config: toml::from_str(&config).map_err(|e| damaged("config.toml", e.to_string()))?,
            seeds,
            task,
            root: folder.and_then(Path::parent).unwrap_or(Path::new(".")).to_owned(),
            target: hash("target").ok_or_else(|| damaged("spec.json", "inputs.target: missing".into()))?,
            source: hash("source"),
            data: serde_json::from_value(done["summary"]["data"].clone()).unwrap_or_default(),
        })
    }

    /// Refuses data that are not the run's.
    fn check(&self, inputs: &Inputs) -> Result<()> {
        let source = self.source.as_ref().zip(inputs.source.as_ref());
        for (name, expected, found) in
            [("target", &self.target, &inputs.target)].into_iter().chain(source.map(|(e, f)| ("source", e, f)))
        {
            if *expected != found.hash {
                return Err(Error::Usage(format!(
                    "{}: SHA-256 {}, but the run's {name} rows have {expected}; name the run's own file with --{name}",
                    found.file.display(),
                    found.hash
                )));
            }
        }
        Ok(())
    }
}

impl RunArgs {
    /// What is measured, and how much of it.
    fn options(&self) -> Result<Options> {
        if let Some(y) = self.y_max.iter().find(|y| !(0.0..=1.0).contains(*y)) {
            return Err(Error::Usage(format!("--y-max {y}: expected label bounds from 0 to 1")));
        }
        let least = 100;
        for (name, value) in [("--rows", self.rows), ("--abundant", self.abundant)] {
            if value < least {
                return Err(Error::Usage(format!(
                    "{name} {value}: expected at least {least}; metrics of fewer rows are noise"
                )));
            }
        }
        for (name, value) in [("--transition-steps", self.transition_steps), ("--value-steps", self.value_steps)] {
            if value == 0 {
                return Err(Error::Usage(format!(
                    "{name} 0: expected at least 1; an untrained model measures nothing"
                )));
            }
        }
        let defaults = Options::default();
        Ok(Options {
            rows: self.rows,
            y_max: self.y_max.clone(),
            simulator: !self.no_simulator,
            transition: TransitionConfig { steps: self.transition_steps, ..defaults.transition },
            value_steps: self.value_steps,
            abundant: self.abundant,
            episodes: self.episodes,
        })
    }

    fn run(self, output: Output, device: &Device) -> Result<()> {
        let options = self.options()?;
        let (diagnosis, place) = match &self.run {
            Some(directory) => {
                let run = Finished::read(directory)?;
                if !self.config.is_empty() {
                    return Err(Error::Usage(
                        "--preset, --config and --set belong to files of your own; a run has its configuration".into(),
                    ));
                }
                can_be_diagnosed(&directory.display().to_string(), &run.config)?;
                if options.simulator {
                    tce_sim::open_library()?;
                }
                let seed = self.seed.unwrap_or(run.seeds[0]);
                member_of(&run.seeds, seed)?;
                let root = self.out.unwrap_or_else(|| run.root.clone());
                let file = |index: usize| run.data.get(index).filter(|file| file.exists()).cloned();
                let data = DataArgs {
                    source: self.source.or_else(|| file(1)),
                    target: self.target.or_else(|| file(0)),
                    from_zoo: self.from_zoo,
                    out: run.root.clone(),
                };
                let inputs = Inputs::of_task(run.task, &data, Some(run.config.source.rows))?;
                let inputs = inputs.with_target_rows(run.config.target.rows)?;
                run.check(&inputs)?;
                let subject = Subject {
                    of: directory.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned()),
                    task: Some(run.task),
                    inputs: &inputs,
                    config: &run.config,
                    seeds: &run.seeds,
                    seed,
                };
                diagnose(&subject, &options, &root, device)?
            }
            None => {
                let config = self.config.layered(None, Some(Variant::TceOg))?.config()?;
                let target = self.target.as_deref().expect("clap asks for it");
                let inputs = Inputs::of_files(self.source.as_deref(), target, None, &self.own)?;
                let inputs = inputs.with_target_rows(config.target.rows)?;
                let seed = self.seed.unwrap_or(0);
                let subject = Subject {
                    of: target.display().to_string(),
                    task: None,
                    inputs: &inputs,
                    config: &config,
                    seeds: &[seed],
                    seed,
                };
                diagnose(&subject, &options, &self.out.unwrap_or_else(|| "runs".into()), device)?
            }
        };
        let page = place.join("diagnosis.html");
        write_atomically(&page, tce_report::diagnosis_page(&diagnosis).as_bytes())?;
        let files = vec![place.join("diagnosis.json"), page];
        output.print(&Written { files, diagnosis }, |w| render::render(&w.diagnosis, &w.files));
        Ok(())
    }
}

#[derive(Serialize)]
struct Written {
    files: Vec<PathBuf>,
    #[serde(flatten)]
    diagnosis: Diagnosis,
}
