//! The policies of a training run, each with a card.

use std::path::Path;

use tce_base::{PROGRAM, mean_std};
use tce_learn::Policy;

use super::ledger::EvaluationSummary;
use super::settings::{Origin, Settings};
use crate::actors::Evaluation;
use crate::error::Result;
use crate::exhibits::Card;

/// An evaluation at `step`, for the ledger.
pub(super) fn summarise(evaluation: &Evaluation, step: u64) -> EvaluationSummary {
    let (mean, std) = mean_std(&evaluation.returns);
    EvaluationSummary { step, mean, std, length: evaluation.mean_length(), score: evaluation.score }
}

/// Writes `policy` to `path`, with its card.
pub(super) fn save_card(policy: &Policy, path: &Path, settings: &Settings, summary: &EvaluationSummary) -> Result<()> {
    let card = Card {
        agent: settings.agent,
        shift: settings.shift,
        role: None,
        seed: settings.seed,
        steps: summary.step,
        updates: summary.step.saturating_sub(settings.start) / settings.steps_per_update,
        batch: settings.batch,
        from: settings.from.as_ref().map(Origin::describe),
        cloned_from: None,
        episodes: settings.episodes,
        mean: summary.mean,
        std: summary.std,
        length: summary.length,
        score: summary.score,
        program: PROGRAM.into(),
    };
    let mut parameters = policy.to_parameters();
    card.attach(&mut parameters);
    Ok(parameters.save(path)?)
}
