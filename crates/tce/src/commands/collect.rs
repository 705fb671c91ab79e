//! `tce collect`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_base::counted;
use tce_data::{Agent, Inspection, Quality, ScoreTable, Shift, parse_environment, reference_scores, save_d4rl};
use tce_run::error::{Error, Result};
use tce_run::inputs::{Actors, d4rl_recipe};
use tce_sim::EPISODE_LIMIT;
use tce_zoo::exhibits;
use tce_zoo::recipes::{Part, Recipe};

use crate::output::{Output, table};

/// Arguments of `collect`.
#[derive(Debug, Args)]
pub struct Collect {
    /// The environment: hopper (source), hopper-morph, ant-gravity, ...
    #[arg(long, value_parser = parse_environment)]
    env: (Agent, Shift),
    /// A policy (.safetensors, .npz, or zoo:NAME), with its share of the rows behind a colon in mixtures: a.npz:0.3. May be repeated.
    #[arg(long = "actor", value_name = "FILE[:WEIGHT]", required_unless_present = "quality")]
    actors: Vec<String>,
    /// Instead of actors: those of the zoo for data of this quality (or stand-ins under TCE_SHARED where it has none).
    #[arg(long, conflicts_with = "actors")]
    quality: Option<Quality>,
    /// Transitions to collect.
    #[arg(long, default_value_t = 1_000_000)]
    rows: usize,
    /// The HDF5 file to write, in D4RL's layout.
    #[arg(long)]
    out: PathBuf,
    /// Take the mean action instead of a sampled one.
    #[arg(long, help_heading = "How rows are collected")]
    mean: bool,
    /// Environments in lockstep; each has its own episodes, so the rows depend on it.
    #[arg(long, default_value_t = 32, help_heading = "How rows are collected")]
    lanes: usize,
    /// Seed of resets and actions.
    #[arg(long, default_value_t = 0, help_heading = "How rows are collected")]
    seed: u64,
    /// Replace an existing file.
    #[arg(long)]
    force: bool,
}

#[derive(Serialize)]
struct Collected {
    file: PathBuf,
    environment: String,
    recipe: Recipe,
    normalised_score: Option<f64>,
    content: Inspection,
    seconds: f64,
}

impl Collect {
    /// Runs the command.
    pub fn run(self, output: Output) -> Result<()> {
        super::refuse::existing(&self.out, self.force)?;
        if self.rows == 0 || self.lanes == 0 {
            return Err(Error::Usage("--rows and --lanes must be at least 1".into()));
        }
        tce_sim::open_library()?;
        let (agent, shift) = self.env;
        let recipe = match self.quality {
            Some(quality) => {
                let recipe = if shift == Shift::Source {
                    d4rl_recipe(agent, quality, self.rows, self.seed, Actors::ZooOrShared)?
                } else {
                    let recipe = exhibits::cast(agent, shift)?.source(agent, shift, quality, self.rows, self.seed);
                    recipe.ok_or_else(|| {
                        let message = "the zoo has no actors for this quality there; name some with --actor";
                        Error::Usage(format!("{agent}-{shift}: {message}"))
                    })?
                };
                Recipe { rows: self.rows, mean: self.mean, lanes: self.lanes, ..recipe }
            }
            None => {
                let parts = self.actors.iter().map(|a| part(a)).collect::<Result<_>>()?;
                let Self { rows, mean, lanes, seed, .. } = self;
                Recipe { agent, shift, parts, rows, mean, lanes, seed }
            }
        };
        let attributes = recipe.attributes()?;
        let started = std::time::Instant::now();
        let data = recipe.collect()?;
        save_d4rl(&self.out, &data, &attributes, &[])?;
        let content = tce_data::inspect(&data, Some(EPISODE_LIMIT));
        if content.complete_episodes == 0 {
            tce_base::note!(
                "no episode came to its end: {} on {} are {} each; for whole episodes take more rows or fewer --lanes",
                counted(self.rows, "row", "rows"),
                counted(self.lanes, "lane", "lanes"),
                counted(self.rows / self.lanes, "step", "steps")
            );
        }
        let reference = reference_scores(agent, shift, ScoreTable::default());
        let collected = Collected {
            file: self.out,
            environment: format!("{agent}-{shift}"),
            recipe,
            normalised_score: content.normalised_score(reference),
            content,
            seconds: started.elapsed().as_secs_f64(),
        };
        output.print(&collected, |c| {
            let row = [
                c.file.display().to_string(),
                c.content.rows.to_string(),
                c.content.episodes.to_string(),
                format!("{:.0}", c.content.lengths.mean),
                format!("{:.1} ± {:.1}", c.content.returns.mean, c.content.returns.std),
                c.normalised_score.map_or("-".into(), |s| format!("{s:.1}")),
                format!("{:.0}", c.content.rows as f64 / c.seconds),
            ];
            table(&["file", "rows", "episodes", "length", "return", "score", "rows/s"], [row])
        });
        Ok(())
    }
}

/// `FILE` or `FILE:WEIGHT`.
fn part(text: &str) -> Result<Part> {
    // A file's own name may hold a colon: only a number behind it is a weight.
    if let Some((file, weight)) = text.rsplit_once(':')
        && let Ok(weight) = weight.parse::<f64>()
    {
        if weight > 0.0 && weight.is_finite() {
            return Ok(Part { actor: file.into(), weight });
        }
        return Err(Error::Usage(format!("--actor {text}: a weight must be a positive number")));
    }
    Ok(Part { actor: text.into(), weight: 1.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_read_behind_the_last_colon() {
        assert_eq!(part("a.npz").unwrap(), Part { actor: "a.npz".into(), weight: 1.0 });
        assert_eq!(part("c:/a.npz:0.5").unwrap(), Part { actor: "c:/a.npz".into(), weight: 0.5 });
        assert!(part("a.npz:-1").is_err());
    }
}
