//! `tce data inspect | check | convert`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::{Args, Subcommand};
use serde::Serialize;
use tce_data::{
    Agent, Check, Inspection, LoadOptions, LoadReport, Loaded, ScoreTable, Severity, Shift, infer_agents, load,
    parse_environment, reference_scores, save_d4rl,
};
use tce_sim::{EPISODE_LIMIT, ReplayReport, replay};

use crate::error::{Error, Result};
use crate::output::{Output, table};

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
    /// HDF5 files in D4RL's or OTDF's layout.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// The environment, for normalised scores (hopper, hopper-morph, ...); by default read from the file's name.
    #[arg(long, value_parser = parse_environment)]
    env: Option<(Agent, Shift)>,
    /// Show every dimension.
    #[arg(long)]
    dimensions: bool,
}

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// HDF5 files in D4RL's or OTDF's layout.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Simulate every transition and compare s', r and terminal.
    #[arg(long)]
    replay: bool,
    /// The environment (hopper, hopper-morph, ...); by default read from the file's name.
    #[arg(long, value_parser = parse_environment)]
    env: Option<(Agent, Shift)>,
}

/// Arguments of `convert`.
#[derive(Debug, Args)]
pub struct Convert {
    /// The file to read.
    input: PathBuf,
    /// The file to write.
    output: PathBuf,
    /// Replace an existing file.
    #[arg(long)]
    force: bool,
}

/// The environment that a file's name tells: `ant_gravity_0.5_medium.hdf5`, `hopper-morph-....hdf5`.
fn environment_of(path: &std::path::Path) -> Option<(Agent, Shift)> {
    let name = path.file_stem()?.to_str()?;
    let agent = Agent::ALL.into_iter().find(|a| name.starts_with(a.name()))?;
    let rest = &name[agent.name().len()..];
    let rest = rest.strip_prefix(['-', '_']).unwrap_or(rest);
    let shifts = [Shift::Gravity5, Shift::Gravity, Shift::Morph, Shift::Kinematic];
    let shift = shifts.into_iter().find(|s| rest.starts_with(s.file_name()) || rest.starts_with(s.name()));
    Some((agent, shift.unwrap_or(Shift::Source)))
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
    looks_like: Vec<Agent>,
    normalised_score: Option<f64>,
    content: Inspection,
}

impl Inspect {
    fn run(self, output: Output) -> Result<()> {
        let mut all = Vec::new();
        for file in &self.files {
            let Loaded { transitions, report, .. } = load(file, &LoadOptions::default())?;
            let content = tce_data::inspect(&transitions, EPISODE_LIMIT);
            let environment = self
                .env
                .or_else(|| environment_of(file))
                .filter(|(a, _)| a.dims() == (transitions.obs_dim, transitions.act_dim));
            let reference = environment.and_then(|(a, s)| reference_scores(a, s, ScoreTable::default()));
            all.push(Inspected {
                load: report,
                environment: environment.map(|(a, s)| format!("{a}-{s}")),
                looks_like: infer_agents(&transitions),
                normalised_score: content.normalised_score(reference),
                content,
            });
        }
        output.print(&all, |all| {
            let rows = all.iter().map(|i| {
                let c = &i.content;
                [
                    i.load.file.file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned()),
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
            for i in all.iter().filter(|_| self.dimensions) {
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
        });
        Ok(())
    }
}

#[derive(Serialize)]
struct Checked {
    load: LoadReport,
    environment: Option<String>,
    check: Check,
    replay: Option<ReplayReport>,
    passes: bool,
}

impl CheckArgs {
    fn run(self, output: Output) -> Result<()> {
        let mut all = Vec::new();
        for file in &self.files {
            let environment = self.env.or_else(|| environment_of(file));
            let options = LoadOptions { dims: environment.map(|(a, _)| a.dims()), ..LoadOptions::default() };
            let Loaded { transitions, report, .. } = load(file, &options)?;
            let check = tce_data::check(&transitions, environment.map(|(a, _)| a));
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
            all.push(Checked { load: report, environment, check, replay, passes });
        }
        output.print(&all, render_checks);
        match all.iter().filter(|c| !c.passes).count() {
            0 => Ok(()),
            n => Err(Error::Failed(format!("{n} of {} data sets do not pass", all.len()))),
        }
    }
}

fn render_checks(all: &Vec<Checked>) -> String {
    let mut text = String::new();
    for c in all {
        text += &format!("{}\n", c.load);
        for finding in c.check.findings.iter().filter(|f| f.severity > Severity::Note) {
            text += &format!("  {}: {}\n", finding.field, finding.message);
        }
        if c.passes && c.replay.is_none() {
            text +=
                "  passes: shapes, numbers, ranges and episodes; whether s' follows from s and a is told by --replay\n";
        }
    }
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

impl Convert {
    fn run(self, output: Output) -> Result<()> {
        super::refuse_existing(&self.output, self.force)?;
        let Loaded { transitions, report, .. } = load(&self.input, &LoadOptions::default())?;
        save_d4rl(&self.output, &transitions, &BTreeMap::from([("origin".into(), report.to_string())]), &[])?;
        output.print(&report, |r| format!("{r}\nwritten to {}", self.output.display()));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn file_names_tell_environments() {
        let env = |name: &str| environment_of(Path::new(name));
        assert_eq!(env("/x/ant_gravity_0.5_medium.hdf5"), Some((Agent::Ant, Shift::Gravity)));
        assert_eq!(env("hopper_morph_expert.hdf5"), Some((Agent::Hopper, Shift::Morph)));
        assert_eq!(env("halfcheetah_medium-v2.hdf5"), Some((Agent::HalfCheetah, Shift::Source)));
        assert_eq!(env("ant_gravity_5.0_medium.hdf5"), Some((Agent::Ant, Shift::Gravity5)));
        assert_eq!(env("mine.hdf5"), None);
    }
}
