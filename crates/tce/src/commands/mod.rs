//! The command line: one file a command.

use std::path::Path;

use clap::{Parser, Subcommand};
use tce_base::{ensure_folder, ensure_writable};

use crate::error::{Error, Result};
use crate::output::Output;
use crate::processor::Processor;

mod augment;
mod bench;
mod collect;
mod config;
mod data;
mod diagnose;
mod evaluate;
mod judge;
mod learn;
mod report;
mod run;
mod sweep;
mod train_sac;
mod zoo;

/// Cross-domain offline reinforcement learning: a policy for a changed robot from many transitions of the old one and
/// few of the new one.
#[derive(Debug, Parser)]
#[command(name = "tce", version, propagate_version = true)]
pub struct Cli {
    /// Print one JSON document instead of tables.
    #[arg(long, global = true)]
    json: bool,
    /// Threads to use (default: all cores). The results do not depend on it.
    #[arg(long, global = true, value_name = "N")]
    threads: Option<usize>,
    /// Seconds between two checkpoints of a long stage. What a killed command loses, not what it computes, depends on it.
    #[arg(long, global = true, value_name = "SECONDS", default_value_t = 60.0)]
    save_every: f64,
    /// What computes the networks.
    #[arg(long, global = true, value_enum, default_value_t)]
    device: Processor,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// The whole pipeline on a benchmark task: data, augmentation, policy, evaluation, floors.
    Run(run::Run),
    /// Widen a target data set of your own with the help of a source data set; no simulator needed.
    Augment(augment::Augment),
    /// Learn a policy from data sets.
    Learn(learn::Learn),
    /// Roll a policy out and report its returns.
    Evaluate(evaluate::Evaluate),
    /// Compare policies by the two data sets alone, in learned dynamics; no simulator needed.
    Judge(judge::JudgeArgs),
    /// Train agents by soft actor-critic in the simulator: actors for data of any quality.
    TrainSac(train_sac::TrainSac),
    /// The actors that come with the program.
    #[command(subcommand)]
    Zoo(zoo::Zoo),
    /// Roll trained actors out into a data set.
    Collect(collect::Collect),
    /// Look at, check and convert data sets.
    #[command(subcommand)]
    Data(data::Data),
    /// Show the configuration and where every value comes from.
    #[command(subcommand)]
    Config(config::Config),
    /// Measure what a stage of the pipeline does.
    Diagnose(Box<diagnose::Diagnose>),
    /// Many runs: planned once, done on one machine or on Slurm, gathered into a table.
    #[command(subcommand)]
    Sweep(sweep::SweepCommand),
    /// Statistics, tables beside the paper's, and a page that shows them, of a sweep or of a folder of runs.
    Report(report::Report),
    /// Measure how fast the program's hot loops run on this machine.
    Bench(bench::Bench),
}

impl Cli {
    /// Runs the command.
    pub fn run(self) -> Result<()> {
        if let Some(threads) = self.threads {
            if threads == 0 {
                return Err(Error::Usage("--threads 0: expected at least 1".into()));
            }
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
            pool.map_err(|e| Error::Failed(format!("cannot start {threads} threads: {e}")))?;
        }
        if self.save_every.is_nan() || self.save_every < 0.0 {
            return Err(Error::Usage(format!("--save-every {}: expected a number of seconds", self.save_every)));
        }
        tce_nn::set_checkpoint_seconds(self.save_every);
        // Opened by the commands that compute networks; the others need none.
        let device = || self.device.device();
        let output = Output { json: self.json };
        match self.command {
            Command::Run(args) => args.run(output, &device()?),
            Command::Augment(args) => args.run(output, &device()?),
            Command::Learn(args) => args.run(output, &device()?),
            Command::Evaluate(args) => args.run(output),
            Command::Judge(args) => args.run(output, &device()?),
            Command::TrainSac(args) => args.run(output, &device()?),
            Command::Zoo(command) => command.run(output),
            Command::Collect(args) => args.run(output),
            Command::Data(command) => command.run(output),
            Command::Config(command) => command.run(output),
            Command::Diagnose(command) => command.run(output, &device()?),
            Command::Sweep(command) => command.run(output, self.save_every, self.device),
            Command::Report(args) => args.run(output),
            Command::Bench(args) => args.run(output, self.device, &device()?),
        }
    }
}

/// Refuses a folder for results that cannot be written, or that lies in a sweep's, whose files are all accounted for.
fn refuse_folder(out: &Path) -> Result<()> {
    match crate::sweep::around(&out.join("x")) {
        Some(sweep) => Err(Error::Usage(format!(
            "--out {}: found the folder of a sweep, {}; what lies there is the sweep's own. Choose another folder",
            out.display(),
            sweep.display()
        ))),
        None => Ok(ensure_folder(out)?),
    }
}

/// Refuses to write over what is read.
fn refuse_inputs(out: &Path, inputs: &[&Path]) -> Result<()> {
    let same = |input: &&&Path| out.canonicalize().is_ok_and(|out| input.canonicalize().is_ok_and(|i| i == out));
    match inputs.iter().find(same) {
        Some(input) => Err(Error::Usage(format!(
            "--out {}: found one of the inputs, {}; choose another name",
            out.display(),
            input.display()
        ))),
        None => Ok(()),
    }
}

/// An output that exists is only replaced when the user says so.
fn refuse_existing(path: &Path, force: bool) -> Result<()> {
    ensure_writable(path)?;
    if path.exists() && !force {
        return Err(Error::Usage(format!(
            "{} exists; choose another name, or say --force to replace it",
            path.display()
        )));
    }
    Ok(())
}
