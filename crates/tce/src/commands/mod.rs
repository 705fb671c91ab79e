//! The command line: one file a command.

use std::ffi::OsString;
use std::sync::{Mutex, PoisonError};

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use tce_base::counted;
use tce_run::device_kind::DeviceKind;
use tce_run::error::{Error, Result};

use crate::output::{Form, Output};

mod augment;
mod bench;
mod collect;
mod compare;
mod completions;
mod config;
mod data;
mod diagnose;
mod evaluate;
mod export;
mod help;
mod learn;
mod man;
mod refuse;
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
    #[arg(long, global = true, help_heading = "Global options")]
    json: bool,
    /// Print the rows of the JSON document as CSV instead of tables.
    #[arg(long, global = true, conflicts_with = "json", help_heading = "Global options")]
    csv: bool,
    /// Threads to use (default: all cores). The results do not depend on it.
    #[arg(long, global = true, value_name = "N", help_heading = "Global options")]
    threads: Option<usize>,
    /// Seconds between two checkpoints of a long stage. A killed command loses so much; the results do not depend on it.
    #[arg(long, global = true, value_name = "SECONDS", default_value_t = 60.0, help_heading = "Global options")]
    save_every: f64,
    /// What computes the networks.
    #[arg(long, global = true, value_enum, default_value_t, help_heading = "Global options")]
    device: DeviceKind,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Do the whole job on a benchmark task: collect data, widen them, learn policies and compare them with simple ones.
    Run(run::Run),
    /// Widen a target data set of your own with the help of a source data set; no simulator needed.
    Augment(augment::Augment),
    /// Learn a policy from data sets.
    Learn(learn::Learn),
    /// Try policies in the simulator: returns, scores, videos.
    Evaluate(evaluate::Evaluate),
    /// Write a policy as an ONNX model, for other programs.
    Export(export::Export),
    /// Compare policies by the two data sets alone, in learned dynamics; no simulator needed.
    #[command(visible_alias = "judge")]
    Compare(compare::CompareArgs),
    /// Train actors by soft actor-critic in the simulator, for data of any quality.
    TrainSac(train_sac::TrainSac),
    /// Look at and try the actors that come with the program.
    #[command(subcommand)]
    Zoo(zoo::Zoo),
    /// Collect a data set by trained actors.
    Collect(collect::Collect),
    /// Look at, check and convert data sets.
    #[command(subcommand)]
    Data(data::Data),
    /// Show and explain every setting, its value, and where the value comes from.
    #[command(subcommand)]
    Config(config::Config),
    /// Measure how good generated rows are.
    Diagnose(Box<diagnose::Diagnose>),
    /// Plan many runs, do them on one machine or on Slurm, and gather them into a table.
    #[command(subcommand)]
    Sweep(sweep::SweepCommand),
    /// Make a page of a sweep or a folder of runs: statistics, figures, tables beside the paper's.
    Report(report::Report),
    /// Measure how fast the program runs on this machine.
    Bench(bench::Bench),
    /// Print a script with which a shell completes commands and options.
    Completions(completions::Completions),
    /// Write the manual pages.
    Man(man::Man),
}

impl Cli {
    /// clap's command with groups and examples.
    fn described() -> clap::Command {
        help::described(Self::command())
    }

    /// What the user asked for. Help, versions and wrong calls end the process here: a wrong call with exit code 2.
    pub fn of_command_line() -> Self {
        Self::of(std::env::args_os()).unwrap_or_else(|error| {
            if !error.use_stderr() {
                error.exit();
            }
            eprint!("{}", crate::told::wrong_call(&error));
            std::process::exit(error.exit_code())
        })
    }

    /// The call `arguments`, the first of which is the program's name.
    ///
    /// # Errors
    /// Help, versions and wrong calls.
    pub fn of<T: Into<OsString> + Clone>(arguments: impl IntoIterator<Item = T>) -> Result<Self, clap::Error> {
        Self::from_arg_matches(&Self::described().try_get_matches_from(arguments)?)
    }

    /// Runs the command.
    ///
    /// # Errors
    /// Whatever it ends with.
    pub fn run(self) -> Result<()> {
        self.run_into(None)
    }

    /// Runs the command, and returns its result as a JSON document in place of printing it.
    ///
    /// # Errors
    /// Whatever it ends with.
    pub fn json(self) -> Result<String> {
        let result = Mutex::default();
        Self { json: true, csv: false, ..self }.run_into(Some(&result))?;
        Ok(result.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    fn run_into(self, into: Option<&Mutex<String>>) -> Result<()> {
        if let Some(threads) = self.threads {
            if threads == 0 {
                return Err(Error::Usage("--threads 0: expected at least 1".into()));
            }
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
            pool.map_err(|e| Error::Failed(format!("cannot start {}: {e}", counted(threads, "thread", "threads"))))?;
        }
        if self.save_every.is_nan() || self.save_every < 0.0 {
            return Err(Error::Usage(format!("--save-every {}: expected a number of seconds", self.save_every)));
        }
        tce_nn::set_checkpoint_seconds(self.save_every);
        // Opened by the commands that compute networks; the others need none.
        let device = || self.device.device();
        let form = match (self.json, self.csv) {
            (true, _) => Form::Json,
            (false, true) => Form::Csv,
            _ => Form::Text,
        };
        let output = Output { form, into };
        match self.command {
            Command::Run(args) => args.run(output, &device()?).map_err(Error::of_resumable),
            Command::Augment(args) => args.run(output, &device()?).map_err(Error::of_resumable),
            Command::Learn(args) => args.run(output, &device()?).map_err(Error::of_resumable),
            Command::Evaluate(args) => args.run(output),
            Command::Export(args) => args.run(output),
            Command::Compare(args) => args.run(output, &device()?),
            Command::TrainSac(args) => args.run(output, &device()?),
            Command::Zoo(command) => command.run(output),
            Command::Collect(args) => args.run(output),
            Command::Data(command) => command.run(output),
            Command::Config(command) => command.run(output),
            Command::Diagnose(command) => command.run(output, &device()?),
            Command::Sweep(command) => command.run(output, self.save_every, self.device),
            Command::Report(args) => args.run(output),
            Command::Bench(args) => args.run(output, self.device, &device()?),
            Command::Completions(args) => args.run(Self::described()),
            Command::Man(args) => args.run(Self::described()),
        }
    }
}
