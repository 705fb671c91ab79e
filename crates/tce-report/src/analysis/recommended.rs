//! What the policies that `tce run` recommended came to.

use serde::Serialize;
use tce_data::Task;

use super::score;
use crate::study::{Recommended, Run, Study};

/// A policy and its score.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scored {
    /// The method, in print.
    pub method: String,
    /// Its seed.
    pub seed: u64,
    /// Its score.
    pub score: f64,
}

/// A recommendation beside what was there to choose from.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Recommendation {
    /// The task.
    pub task: Task,
    /// The method, in print.
    pub method: String,
    /// The policy's seed, where the recommendation names it.
    pub seed: Option<u64>,
    /// Whether the recommendation was sure of itself.
    pub sure: bool,
    /// What the policy scores; None if its run is not here, or has no score.
    pub score: Option<f64>,
    /// The policy with the highest score of all that the report has for the task, or of those that it was chosen among.
    pub best: Option<Scored>,
}

impl Recommendation {
    /// How many points the best policy scores more.
    pub fn regret(&self) -> Option<f64> {
        Some(self.best.as_ref()?.score - self.score?)
    }
}

/// Every recommendation with its score.
pub fn recommendations(study: &Study) -> Vec<Recommendation> {
    let title = |run: &Run| study.methods.iter().find(|m| m.id == run.method).map_or(&run.method, |m| &m.title).clone();
    let of = |r: &Recommended| {
        let name = |run: &Run| run.folder.directory.file_name().and_then(|n| n.to_str()).unwrap_or_default().to_owned();
        // What it did not choose among is no alternative to it.
        let candidate = |run: &&Run| run.task == r.task && (r.among.is_empty() || r.among.contains(&name(run)));
        let runs = || study.runs.iter().filter(candidate);
        let is = |run: &&Run| {
            r.folder.as_deref().is_some_and(|folder| folder == name(run)) && r.seed == Some(run.member.seed)
        };
        let scored =
            runs().filter_map(|run| Some(Scored { method: title(run), seed: run.member.seed, score: score(run)? }));
        Recommendation {
            task: r.task,
            method: runs().find(is).map_or_else(|| r.method.clone(), title),
            seed: r.seed,
            sure: r.sure,
            score: runs().find(is).and_then(score),
            best: scored.max_by(|a, b| a.score.total_cmp(&b.score)),
        }
    };
    study.recommended.iter().map(of).collect()
}
