//! `tce data inspect | check | convert`.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use serde::Serialize;
use tce_base::counted;
use tce_data::{
    Agent, Check, EpisodeEnds, Finding, Inspection, LoadReport, Loaded, ScoreTable, Severity, Transitions,
    infer_agents, reference_scores,
};
use tce_run::error::{Error, Result};
use tce_run::own::{Own, range_of};
use tce_sim::{ReplayReport, replay};

use crate::output::{Output, table};

mod convert;
mod reading;

use convert::Convert;
use reading::{named_by_file, read};

/// Look at, check and convert data sets.
#[derive(Debug, Subcommand)]
pub enum Data {
    /// Rows, episodes, returns, ranges, dead dimensions.
    Inspect(Inspect),
    /// Check a data set; with --replay, replay every transition in its environment.
    Check(CheckArgs),
    /// Write a data set in D4RL's layout.
    Convert(Convert),
}

/// Arguments of `inspect`.
#[derive(Debug, Args)]
pub struct Inspect {
    /// Data sets: HDF5 files, or folders of Minari.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Show every dimension.
    #[arg(long)]
    dimensions: bool,
    #[command(flatten)]
    own: Own,
}

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Data sets: HDF5 files, or folders of Minari.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Simulate every transition and compare s', r and terminal.
    #[arg(long)]
    replay: bool,
    #[command(flatten)]
    own: Own,
}

/// What `one` makes of the files, up to the first on which it fails, and why it does.
fn each<T>(files: &[PathBuf], one: impl Fn(&Path) -> Result<T>) -> (Vec<T>, Option<Error>) {
    let mut all = Vec::new();
    for file in files {
        match one(file) {
            Ok(made) => all.push(made),
            Err(error) => return (all, Some(error)),
        }
    }
    (all, None)
}

impl Data {
    /// Runs the subcommand.
    pub fn run(self, output: Output) -> Result<()> {
        match self {
            Data::Inspect(args) => args.run(output),
            Data::Check(args) => args.run(output),
            Data::Convert(args) => args.run(output),
        }
    }
}

#[derive(Serialize)]
struct Inspected {
    load: LoadReport,
    environment: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    note: Option<String>,
    looks_like: Vec<Agent>,
    normalised_score: Option<f64>,
    content: Inspection,
}

impl Inspect {
    fn one(&self, file: &Path) -> Result<Inspected> {
        let (own, Loaded { transitions, report, .. }) = read(&self.own, file)?;
        let content = tce_data::inspect(&transitions, own.limit());
        let reference = own.env.and_then(|(a, s)| reference_scores(a, s, ScoreTable::default()));
        Ok(Inspected {
            load: report,
            environment: own.env.map(|(a, s)| format!("{a}-{s}")),
            note: named_by_file(&self.own, &own),
            looks_like: infer_agents(&transitions),
            normalised_score: content.normalised_score(reference),
            content,
        })
    }

    fn run(self, output: Output) -> Result<()> {
        let (all, failed) = each(&self.files, |file| self.one(file));
        // One file that cannot be read does not hide what was read before it.
        if !all.is_empty() {
            output.print(&all, |all| render_inspected(all, self.dimensions));
        }
        failed.map_or(Ok(()), Err)
    }
}

/// One line a file, what is to be told of it, and, if wanted, its dimensions.
fn render_inspected(all: &[Inspected], dimensions: bool) -> String {
    let rows = all.iter().map(|i| {
        let c = &i.content;
        [
            i.load.file.file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned()),
            i.load.layout.to_string(),
            c.rows.to_string(),
            i.load.dropped.total().to_string(),
            format!("{}x{}", c.obs_dim, c.act_dim),
            c.episodes.to_string(),
            c.terminals.to_string(),
            format!("{:.0}", c.lengths.mean),
            format!("{:.1} ± {:.1}", c.returns.mean, c.returns.std),
            format!("{:.1}", c.returns.min),
            format!("{:.1}", c.returns.max),
            i.normalised_score.map_or("-".into(), |s| format!("{s:.1}")),
            c.observations.dead.len().to_string(),
            (c.observations.nan + c.actions.nan + c.rewards.nan).to_string(),
        ]
    });
    let header = [
        "file",
        "layout",
        "rows",
        "dropped",
        "dims",
        "episodes",
        "terminals",
        "length",
        "return",
        "min",
        "max",
        "score",
        "dead",
        "NaN",
    ];
    let mut text = table(&header, rows);
    for i in all {
        text.extend(i.note.iter().map(|note| format!("\nnote: {}: {note}\n", i.load.file.display())));
    }
    for i in all.iter().filter(|_| dimensions) {
        let dims = |name: &str, d: &tce_data::DimensionSummary| {
            let rows = (0..d.mean.len()).map(|k| {
                [
                    format!("{name}[{k}]"),
                    format!("{:.4}", d.mean[k]),
                    format!("{:.4}", d.std[k]),
                    format!("{:.4}", d.min[k]),
                    format!("{:.4}", d.max[k]),
                ]
            });
            table(&["dimension", "mean", "std", "min", "max"], rows)
        };
        text += &format!("\n{}\n", i.load);
        text += &dims("s", &i.content.observations);
        text += "\n";
        text += &dims("a", &i.content.actions);
        text += "\n";
    }
    text
}

#[derive(Serialize)]
struct Checked {
    load: LoadReport,
    environment: Option<String>,
    content: Inspection,
    uses: Uses,
    check: Check,
    replay: Option<ReplayReport>,
    passes: bool,
}

/// What rows will be used for.
#[derive(Serialize)]
struct Uses {
    /// Learning policies.
    learning: usize,
    /// Score networks, inverse dynamics, rewards and models of the dynamics: rows whose s' is known.
    dynamics: usize,
    /// Returns of whole episodes, the better trajectories, sequence models: rows of episodes of two steps and more.
    episodes: usize,
    /// Where the terminal flags of generated rows will come from.
    terminals: String,
}

impl Uses {
    fn of(t: &Transitions, report: &LoadReport, agent: Option<Agent>) -> Self {
        let ordered = report.episodes != EpisodeEnds::NoOrder;
        let lengths = t.episodes().into_iter().map(|e| e.end - e.start);
        let terminals = t.terminals.iter().filter(|&&t| t).count();
        // Without s' a terminal row tells a classifier nothing.
        let known = t.terminals.iter().zip(&t.known).filter(|&(&t, &k)| t && k).count();
        Self {
            learning: t.len(),
            dynamics: t.known.iter().filter(|&&k| k).count(),
            episodes: if ordered { lengths.filter(|&n| n > 1).sum() } else { 0 },
            terminals: match (agent, terminals, known) {
                (Some(agent), ..) => format!("{agent}'s rule"),
                (None, 0, _) => "none: no row of this file is terminal".into(),
                (None, 1, 0) => "none: one row is terminal, and it has no next state".into(),
                (None, n, 0) => format!("none: {n} rows are terminal, and none of them has a next state"),
                (None, n, known) if known < n => {
                    let have = if known == 1 { "has" } else { "have" };
                    format!("learned from {known} of the {n} terminal rows, which {have} a next state")
                }
                (None, n, _) => format!("learned from the {}", counted(n, "terminal row", "terminal rows")),
            },
        }
    }
}

impl CheckArgs {
    fn one(&self, file: &Path) -> Result<Checked> {
        let (own, Loaded { transitions, report, .. }) = read(&self.own, file)?;
        let environment = own.env;
        let mut check = tce_data::check(&transitions, own.agent());
        if let Some(message) = named_by_file(&self.own, &own) {
            check.findings.push(Finding { severity: Severity::Note, field: "robot", message });
        }
        if let Some(given) = &own.action_range {
            let range = range_of(given, transitions.act_dim, file).map_err(Error::Usage)?;
            let message = match range.outside(&transitions.actions) {
                0 => format!("taken as {range} (--action-range)"),
                n => format!("taken as {range} (--action-range); {} outside", counted(n, "value lies", "values lie")),
            };
            check.findings.push(Finding { severity: Severity::Note, field: "actions", message });
        }
        let replay = match (self.replay, environment) {
            (false, _) => None,
            (true, Some((agent, shift))) => Some(replay(agent, shift, &transitions, None)?),
            (true, None) => {
                return Err(Error::Usage(format!(
                    "{}: the file's name does not tell its environment; say it with --env, as in --env hopper-morph",
                    file.display()
                )));
            }
        };
        let passes = check.is_ok() && replay.as_ref().is_none_or(ReplayReport::passes);
        let environment = environment.map(|(a, s)| format!("{a}-{s}"));
        let uses = Uses::of(&transitions, &report, own.agent());
        let content = tce_data::inspect(&transitions, own.limit());
        Ok(Checked { load: report, environment, content, uses, check, replay, passes })
    }

    fn run(self, output: Output) -> Result<()> {
        if self.replay {
            tce_sim::open_library()?;
        }
        let (all, failed) = each(&self.files, |file| self.one(file));
        // One file that cannot be read does not hide what was read before it.
        if !all.is_empty() {
            output.print(&all, |all| render_checks(all));
        }
        if let Some(error) = failed {
            return Err(error);
        }
        match all.iter().filter(|c| !c.passes).count() {
            0 => Ok(()),
            n => {
                let (sets, verb) = (counted(all.len(), "data set", "data sets"), if n == 1 { "does" } else { "do" });
                Err(Error::Failed(format!("{n} of {sets} {verb} not pass")))
            }
        }
    }
}

/// The check of one file, on one screen.
fn render_check(c: &Checked) -> String {
    let (content, uses) = (&c.content, &c.uses);
    let mut text = format!("{}\n", c.load);
    let mut line = |name: &str, value: String| text += &format!("  {name:<11} {value}\n");
    let robot = c.environment.clone().unwrap_or_else(|| "an own one".into());
    let observations = counted(content.obs_dim, "observation", "observations");
    line("robot", format!("{robot}, {observations}, {}", counted(content.act_dim, "action", "actions")));
    let lengths = &content.lengths;
    let order = if c.load.environments > 1 {
        format!(", of {} environments in turn", c.load.environments)
    } else {
        String::new()
    };
    let length = match lengths.min == lengths.max {
        true if lengths.max == 1.0 => "one step each".to_owned(),
        true => format!("{:.0} steps each", lengths.min),
        false => format!("{:.0} to {:.0} steps, {:.0} on average", lengths.min, lengths.max, lengths.mean),
    };
    line(
        "episodes",
        format!("{}, {length}; {} whole{order}; {}", content.episodes, content.complete_episodes, c.load.episodes),
    );
    let ends = (
        counted(content.terminals, "terminal", "terminals"),
        counted(content.timeouts, "time-out or cut", "time-outs or cuts"),
    );
    line("ends", format!("{}, {}", ends.0, ends.1));
    let range = |name: &str, d: &tce_data::DimensionSummary| {
        let (low, high) = (
            d.min.iter().copied().fold(f32::INFINITY, f32::min),
            d.max.iter().copied().fold(f32::NEG_INFINITY, f32::max),
        );
        (name.to_owned(), format!("{low:.4} to {high:.4}"))
    };
    for (name, d) in [("states", &content.observations), ("actions", &content.actions), ("rewards", &content.rewards)] {
        let (name, value) = range(name, d);
        line(&name, value);
    }
    let returns = &content.returns;
    line(
        "returns",
        format!(
            "{:.1} ± {:.1}, {:.1} to {:.1}, of {}",
            returns.mean,
            returns.std,
            returns.min,
            returns.max,
            counted(returns.count, "episode", "episodes")
        ),
    );
    line("duplicates", format!("{:.1} % of the rows", 100.0 * c.check.duplicate_share));
    line(
        "used for",
        format!(
            "{}: learning; {}: networks and models of s'; {}: what follows episodes",
            counted(uses.learning, "row", "rows"),
            uses.dynamics,
            uses.episodes
        ),
    );
    line("terminals", uses.terminals.clone());
    for finding in &c.check.findings {
        text += &format!("  {finding}\n");
    }
    if c.passes && c.replay.is_none() {
        text += "  passes; whether s' follows from s and a is told by --replay, for a robot of the benchmark\n";
    }
    text
}

fn render_checks(all: &[Checked]) -> String {
    let mut text: String = all.iter().map(render_check).collect();
    let rows = all.iter().filter_map(|c| {
        let r = c.replay.as_ref()?;
        Some([
            c.load.file.file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned()),
            r.rows.to_string(),
            r.compared.to_string(),
            r.skipped_clipped.to_string(),
            format!("{:.1e}", r.next_observation.median),
            format!("{:.1e}", r.next_observation.p99),
            format!("{:.1e}", r.next_observation.max),
            format!("{:.1e}", r.reward.p99),
            r.terminal_mismatches.len().to_string(),
            if c.passes { "pass" } else { "FAIL" }.into(),
        ])
    });
    let rows: Vec<_> = rows.collect();
    if !rows.is_empty() {
        let header =
            ["file", "rows", "replayed", "clipped", "s' median", "s' p99", "s' max", "r p99", "terminal", "verdict"];
        text += &table(&header, rows);
    }
    text
}
