//! `tce sweep plan`, `launch`, `run-one`, `status`, `gather` and `export`.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use serde::Serialize;
use tce_base::{counted, interrupted};
use tce_nn::Device;
use tce_run::device_kind::DeviceKind;
use tce_run::error::{Error, Result};
use tce_run::sweep::local::Share;
use tce_run::sweep::slurm::{Array, Submission};
use tce_run::sweep::work::Taken;
use tce_run::sweep::{Check, Kind, Manifest, Sweep};

use crate::output::{Output, fit, table};
use estimate::TierCost;

mod estimate;
mod render;

/// The commands of `sweep`.
#[derive(Debug, Subcommand)]
pub enum SweepCommand {
    /// Turn a description (tasks × variants × overrides × seeds) into a list of work that does not change any more.
    Plan(Plan),
    /// Do what is missing, on this machine or on Slurm. To be called again after any accident, and on several machines at once.
    Launch(Launch),
    /// Do pieces of work by their number in the manifest.
    RunOne(RunOne),
    /// What is done, who is at work, what failed, the scores so far.
    Status(StatusArgs),
    /// Verify everything that is done and make a table of it.
    Gather(Gather),
    /// Write what was found to one small file that outlives the machine: scores, returns, settings, hashes.
    Export(Export),
}

/// Arguments of `sweep plan`.
#[derive(Debug, Args)]
pub struct Plan {
    /// The description: TOML, see examples/sweep.toml.
    description: PathBuf,
    /// The sweep's folder (default: runs/sweeps/NAME).
    #[arg(long)]
    out: Option<PathBuf>,
    /// Only tell what would be planned.
    #[arg(long)]
    dry_run: bool,
    /// Measure this machine for some seconds, and tell how many hours of one core the work will take, by tier.
    #[arg(long)]
    estimate: bool,
}

/// Who does the work.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Launcher {
    /// Processes of this machine.
    Local,
    /// Array jobs.
    Slurm,
}

/// Arguments of `sweep launch`.
#[derive(Debug, Args)]
pub struct Launch {
    /// The sweep's folder.
    directory: PathBuf,
    /// Who does the work.
    #[arg(long, value_enum, default_value = "local")]
    launcher: Launcher,
    /// local: processes at a time (default: one a core).
    #[arg(long, help_heading = "On this machine")]
    workers: Option<usize>,
    /// Threads of each process.
    #[arg(long, default_value_t = 1)]
    threads_each: usize,
    /// local: how often work is tried again after a failure.
    #[arg(long, default_value_t = 2, help_heading = "On this machine")]
    retries: usize,
    /// slurm: pieces of work in one array element, one after the other; for work of less than a minute.
    #[arg(long, default_value_t = 1, help_heading = "On Slurm")]
    pack: usize,
    /// slurm: seconds before the time limit at which the work writes its checkpoint and asks for another turn.
    #[arg(long, default_value_t = 120, help_heading = "On Slurm")]
    grace: u32,
    /// slurm: an argument for sbatch, such as --sbatch=--time=04:00:00; may be given several times.
    #[arg(long, value_name = "ARGUMENT", allow_hyphen_values = true, help_heading = "On Slurm")]
    sbatch: Vec<String>,
    /// Read every file of what is done, and do again what was changed since. Work whose files are gone is done again in any case.
    #[arg(long)]
    verify: bool,
    /// Only tell what would be done.
    #[arg(long)]
    dry_run: bool,
}

/// Arguments of `sweep run-one`.
#[derive(Debug, Args)]
pub struct RunOne {
    /// The sweep's folder.
    directory: PathBuf,
    /// Numbers of pieces of work.
    #[arg(required = true)]
    indices: Vec<usize>,
    /// Leave work alone that another process is doing, and do not wait for it.
    #[arg(long)]
    leave_running: bool,
}

/// Arguments of `sweep status`.
#[derive(Debug, Args)]
pub struct StatusArgs {
    /// The sweep's folder.
    directory: PathBuf,
    /// Show it again and again, until everything is done.
    #[arg(long)]
    watch: bool,
    /// Seconds between two looks.
    #[arg(long, default_value_t = 5.0)]
    every: f64,
}

/// Arguments of `sweep gather`.
#[derive(Debug, Args)]
pub struct Gather {
    /// The sweep's folder.
    directory: PathBuf,
    /// Make a table of what there is, although something is missing, corrupt or in conflict.
    #[arg(long)]
    partial: bool,
}

/// Arguments of `sweep export`.
#[derive(Debug, Args)]
pub struct Export {
    /// A sweep's folder, a folder with runs of `tce run`, or an earlier record. Several become one record.
    #[arg(required = true, value_name = "PLACE")]
    places: Vec<PathBuf>,
    /// The record, JSON Lines; `tce report` reads it.
    #[arg(long)]
    out: PathBuf,
    /// Replace an existing file.
    #[arg(long)]
    force: bool,
}

impl SweepCommand {
    /// Runs the command.
    pub fn run(self, output: Output, save_every: f64, device: DeviceKind) -> Result<()> {
        match self {
            SweepCommand::Plan(args) => args.run(output),
            SweepCommand::Launch(args) => args.run(output, save_every, device),
            SweepCommand::RunOne(args) => args.run(output, &device.device()?),
            SweepCommand::Status(args) => args.run(output),
            SweepCommand::Gather(args) => args.run(output),
            SweepCommand::Export(args) => args.run(output),
        }
    }
}

#[derive(Serialize)]
struct Planned {
    directory: PathBuf,
    source: usize,
    target: usize,
    distances: usize,
    augment: usize,
    run: usize,
    verdict: usize,
    /// What it will cost, where that was asked.
    #[serde(skip_serializing_if = "Option::is_none")]
    costs: Option<Vec<TierCost>>,
}

impl Plan {
    fn run(self, output: Output) -> Result<()> {
        let manifest = Manifest::plan(&self.description)?;
        let directory = self.out.unwrap_or_else(|| PathBuf::from("runs/sweeps").join(&manifest.header.name));
        let count = |kind| manifest.entries.iter().filter(|e| e.kind == kind).count();
        let planned = Planned {
            source: count(Kind::Source),
            target: count(Kind::Target),
            distances: count(Kind::Distances),
            augment: count(Kind::Augment),
            run: count(Kind::Run),
            verdict: count(Kind::Verdict),
            costs: self.estimate.then(|| estimate::costs(&manifest)).transpose()?,
            directory,
        };
        if let Some(other) = tce_run::sweep::around(&planned.directory) {
            return Err(Error::Usage(format!(
                "--out {}: found the folder of another sweep, {}; choose a folder outside of it",
                planned.directory.display(),
                other.display()
            )));
        }
        if !self.dry_run {
            Sweep::create(&planned.directory, manifest)?;
        }
        output.print(&planned, |p| {
            let rows = [
                ("source data", p.source),
                ("target data", p.target),
                ("distances", p.distances),
                ("generated rows", p.augment),
                ("runs", p.run),
                ("verdicts", p.verdict),
            ];
            let mut text = table(&["work", "pieces"], rows.map(|(what, n)| [what.to_owned(), n.to_string()]));
            if let Some(costs) = &p.costs {
                let hours = |h: f64| if h < 10.0 { format!("{h:.1}") } else { format!("{h:.0}") };
                let all = TierCost {
                    tier: "all".into(),
                    pieces: costs.iter().map(|c| c.pieces).sum(),
                    core_hours: costs.iter().map(|c| c.core_hours).sum(),
                };
                let rows = costs.iter().filter(|c| !c.tier.is_empty()).chain([&all]);
                let rows = rows.map(|c| [c.tier.clone(), c.pieces.to_string(), hours(c.core_hours)]);
                text += &format!("\n{}", table(&["tier", "pieces", "core-hours, about"], rows));
            }
            format!("{text}\n{}", p.directory.display())
        });
        Ok(())
    }
}

#[derive(Serialize)]
struct Submitted {
    arrays: Vec<Array>,
}

impl Launch {
    fn run(self, output: Output, save_every: f64, device: DeviceKind) -> Result<()> {
        if self.threads_each == 0 || self.workers == Some(0) || self.pack == 0 {
            return Err(Error::Usage("--workers, --threads-each and --pack must be at least 1".into()));
        }
        let sweep = Sweep::open(&self.directory)?;
        if !self.dry_run {
            for what in sweep.take_back_damaged(if self.verify { Check::Content } else { Check::Existence })? {
                tce_base::note!("to be done again: {what}");
            }
        }
        match self.launcher {
            Launcher::Slurm => {
                let arrays = sweep.launch_slurm(&Submission {
                    pack: self.pack,
                    threads: self.threads_each,
                    save_every,
                    device,
                    grace: self.grace,
                    arguments: self.sbatch,
                    dry_run: self.dry_run,
                })?;
                output.print(&Submitted { arrays }, |s| {
                    let rows = s.arrays.iter().map(|a| {
                        let pieces: usize = a.elements.iter().map(Vec::len).sum();
                        [
                            a.job.clone().unwrap_or("-".into()),
                            a.elements.len().to_string(),
                            pieces.to_string(),
                            a.command.join(" "),
                        ]
                    });
                    table(&["job", "elements", "pieces of work", "command"], rows)
                });
                Ok(())
            }
            Launcher::Local if self.dry_run => {
                let missing: Vec<String> = sweep.missing()?.iter().map(ToString::to_string).collect();
                output.print(&missing, |m| m.join("\n"));
                Ok(())
            }
            Launcher::Local => {
                if !sweep.missing()?.is_empty() {
                    tce_sim::open_library()?;
                }
                let cores = std::thread::available_parallelism().map_or(1, usize::from);
                // Several programs on one GPU take each other's time.
                let fitting = if device == DeviceKind::Cpu { (cores / self.threads_each).max(1) } else { 1 };
                let workers = self.workers.unwrap_or(fitting);
                let share = Share { workers, threads: self.threads_each, retries: self.retries, save_every, device };
                let failed = sweep.launch_here(share)?;
                let status = sweep.status()?;
                output.print(&status, render::status);
                match failed {
                    0 => Ok(()),
                    n => {
                        status.healthy()?;
                        let are = if n == 1 { "is" } else { "are" };
                        Err(Error::Failed(format!("{n} of the sweep's pieces of work {are} not done; launch it again")))
                    }
                }
            }
        }
    }
}

impl RunOne {
    fn run(self, output: Output, device: &Device) -> Result<()> {
        let sweep = Sweep::open(&self.directory)?;
        let count = sweep.entries().len();
        if let Some(index) = self.indices.iter().find(|i| **i >= count) {
            let pieces = counted(count, "piece of work", "pieces of work");
            return Err(Error::Usage(format!("{index}: the manifest has {pieces}, numbered from 0")));
        }
        let mut outcomes = Vec::new();
        let mut failed = None;
        let mut todo = self.indices;
        // What others are doing is waited for behind everything else.
        let turns: &[Taken] = if self.leave_running { &[Taken::Leave] } else { &[Taken::Leave, Taken::Wait] };
        for &taken in turns {
            for index in std::mem::take(&mut todo) {
                match sweep.work(&sweep.entries()[index], taken, device) {
                    Ok(Some(outcome)) => outcomes.push(outcome),
                    Ok(None) => todo.push(index),
                    // The work's own checkpoint is written; the rest of the list comes in the next turn.
                    Err(e) if e.exit_code() == 130 => return Err(e),
                    Err(e) => {
                        tce_base::note!("{}: {e}", sweep.entries()[index]);
                        failed = Some(e);
                    }
                }
            }
        }
        for index in todo {
            tce_base::note!("{}: another process is doing it", sweep.entries()[index]);
        }
        match failed {
            Some(e) => Err(e),
            None => {
                output.print(&outcomes, |all| {
                    let rows = all.iter().map(|o| {
                        let score = o.score.map_or("-".into(), |s| format!("{s:.1}"));
                        [o.id.clone(), score, format!("{:.0} s", o.seconds), o.place.display().to_string()]
                    });
                    table(&["work", "score", "time", "place"], rows)
                });
                Ok(())
            }
        }
    }
}

impl StatusArgs {
    fn run(self, output: Output) -> Result<()> {
        let sweep = Sweep::open(&self.directory)?;
        loop {
            let status = sweep.status()?;
            if !self.watch {
                output.print(&status, render::status);
                return status.healthy();
            }
            let mut out = std::io::stdout().lock();
            // On a terminal the next look takes the place of the last one.
            let clear = if out.is_terminal() { "\x1b[H\x1b[2J" } else { "" };
            let _ = writeln!(out, "{clear}{}", fit(&render::status(&status))).and_then(|()| out.flush());
            drop(out);
            if status.complete() || status.stuck() {
                return status.healthy();
            }
            let until = std::time::Instant::now() + Duration::from_secs_f64(self.every.clamp(0.1, 3600.0));
            while std::time::Instant::now() < until {
                if interrupted() {
                    return Err(Error::interrupted());
                }
                std::thread::sleep(Duration::from_millis(50));
            }
        }
    }
}

impl Gather {
    fn run(self, output: Output) -> Result<()> {
        let gathered = Sweep::open(&self.directory)?.gather()?;
        if !self.partial {
            gathered.whole()?;
        }
        tce_base::write_json(&self.directory.join("results.json"), &gathered)?;
        output.print(&gathered, render::gathered);
        Ok(())
    }
}

#[derive(Serialize)]
struct Exported {
    file: PathBuf,
    bytes: u64,
    tasks: usize,
    runs: usize,
    missing: usize,
}

impl Export {
    fn run(self, output: Output) -> Result<()> {
        // A record may be among what it is made from: it is read before it is replaced.
        crate::commands::refuse::existing(&self.out, self.force)?;
        let study = tce_run::study::of_places(&self.places)?;
        if study.runs.is_empty() {
            return Err(Error::Usage(
                "found no finished run to export; make some with `tce sweep launch` or `tce run`".into(),
            ));
        }
        tce_report::record::write(&study, &self.out)?;
        let tasks: std::collections::BTreeSet<_> = study.runs.iter().map(|r| r.task).collect();
        let exported = Exported {
            bytes: std::fs::metadata(&self.out).map_or(0, |m| m.len()),
            file: self.out,
            tasks: tasks.len(),
            runs: study.runs.len(),
            missing: study.missing.len(),
        };
        output.print(&exported, |e| {
            let missing = match e.missing {
                0 => String::new(),
                n => format!(", {} no result", counted(n, "more has", "more have")),
            };
            let (file, kib) = (e.file.display(), e.bytes.div_ceil(1024));
            let (runs, tasks) = (counted(e.runs, "run", "runs"), counted(e.tasks, "task", "tasks"));
            format!("{file}: {runs} of {tasks}, {kib} KiB{missing}\nread it with: tce report {file}")
        });
        Ok(())
    }
}
