//! `tce evaluate`.

#[cfg(feature = "video")]
mod video;

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_base::{Streams, interrupted, mean_std};
use tce_data::{Agent, ScoreTable, Shift, parse_environment};
use tce_run::error::{Error, Result};
#[cfg(feature = "video")]
use tce_zoo::actors::evaluate_recorded;
use tce_zoo::actors::{Actions, Arena, Evaluation, evaluate, load_policy};

use crate::output::{Output, mark_best, table};

/// Arguments of `evaluate`.
#[derive(Debug, Args)]
pub struct Evaluate {
    /// Policies (.safetensors, .npz, or zoo:NAME; see tce zoo list).
    #[arg(required = true)]
    policies: Vec<PathBuf>,
    /// The environment: hopper (source), hopper-morph, ant-gravity, ...
    #[arg(long, value_parser = parse_environment)]
    env: (Agent, Shift),
    /// Episodes.
    #[arg(long, default_value_t = 10)]
    episodes: usize,
    /// Sample actions instead of taking the mean.
    #[arg(long)]
    sample: bool,
    /// Seed of the resets (and of sampled actions).
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[cfg(feature = "video")]
    #[command(flatten)]
    video: video::VideoArgs,
}

#[derive(Serialize)]
struct Evaluated {
    policy: PathBuf,
    environment: String,
    #[serde(flatten)]
    evaluation: Evaluation,
    #[cfg(feature = "video")]
    #[serde(skip_serializing_if = "Option::is_none")]
    video: Option<video::VideoReport>,
}

impl Evaluate {
    /// Runs the command.
    pub fn run(self, output: Output) -> Result<()> {
        if self.episodes == 0 {
            return Err(Error::Usage("--episodes must be at least 1".into()));
        }
        tce_sim::open_library()?;
        let (agent, shift) = self.env;
        let arena = Arena::new(agent, shift, ScoreTable::default());
        #[cfg(feature = "video")]
        let writer = self.video.writer(&self.policies)?;
        let policies: Vec<_> = self.policies.iter().map(|p| load_policy(p, agent)).collect::<tce_zoo::Result<_>>()?;
        #[cfg(feature = "video")]
        if let Some(writer) = writer {
            let roll = |arena, episodes| {
                let streams = Streams::new(self.seed);
                Ok(evaluate_recorded(
                    &policies[0],
                    arena,
                    episodes,
                    streams,
                    Actions::mean_if(!self.sample),
                    interrupted,
                )?)
            };
            let (evaluation, video) = self.video.record(writer, arena, roll, self.episodes)?;
            let environment = format!("{agent}-{shift}");
            let video = Evaluated { policy: self.policies[0].clone(), environment, evaluation, video: Some(video) };
            output.print(&[video], |all| render(all));
            return Ok(());
        }
        let mut all = Vec::new();
        for (path, policy) in self.policies.iter().zip(&policies) {
            let streams = Streams::new(self.seed);
            let evaluation =
                evaluate(policy, arena, self.episodes, streams, Actions::mean_if(!self.sample), interrupted)?;
            all.push(Evaluated {
                policy: path.clone(),
                environment: format!("{agent}-{shift}"),
                evaluation,
                #[cfg(feature = "video")]
                video: None,
            });
        }
        output.print(&all, |all| render(all));
        Ok(())
    }
}

fn render(all: &[Evaluated]) -> String {
    let mut rows: Vec<_> = all
        .iter()
        .map(|e| {
            let (mean, std) = mean_std(&e.evaluation.returns);
            [
                e.policy.display().to_string(),
                e.evaluation.returns.len().to_string(),
                format!("{mean:.1} ± {std:.1}"),
                format!("{:.0}", e.evaluation.mean_length()),
                e.evaluation.score.map_or("-".into(), |s| format!("{s:.1}")),
            ]
        })
        .collect();
    mark_best(rows.iter_mut().map(|row| &mut row[4]));
    table(&["policy", "episodes", "return", "length", "score"], rows)
}
