//! From a configuration to a learner, and the scores of rows by which it chooses.

use std::sync::Arc;

use tce_augment::single_stage::{enough_to_score, score_streams};
use tce_data::{Rows, Transitions, TransportOptions, density_scores, transport_costs};
use tce_learn::{Buffer, Place, PolicyLearner, RowScores, Setup};
use tce_nn::Device;

use crate::config::{Config, LearnerConfig};
use crate::error::{Error, Result};

/// A learner for the members of `buffer`, before its first step; what it needs for that is trained here.
///
/// # Errors
/// If the configuration or the data cannot be used, or the user interrupted a preparation.
pub fn build(
    buffer: &Buffer,
    config: &LearnerConfig,
    place: Place<'_>,
    device: &Device,
) -> Result<Box<dyn PolicyLearner>> {
    let LearnerConfig { steps, iql, behaviour, .. } = config;
    let on = Setup { buffer, steps: *steps, iql, behaviour, place, device };
    config.own().build(&on)?.ok_or_else(Error::interrupted)
}

/// One score per row of `others` whose s' is known, for learners that choose rows by scores; a higher score is closer to the target. None for other
/// learners.
///
/// # Errors
/// If there are too few rows, or the user interrupts it.
pub fn row_scores(config: &Config, target: &Transitions, others: &Transitions) -> Result<Option<Arc<Vec<f32>>>> {
    let (rows, near) = (Rows::transitions(others), Rows::transitions(target));
    Ok(match config.learner.algorithm.about().scores {
        RowScores::Transport => Some(negated_costs(transport_costs(&rows, &near, &TransportOptions::default())?)),
        RowScores::Density => {
            let options = &config.single_stage.scores;
            enough_to_score(rows.len(), near.len(), options)?;
            Some(Arc::new(density_scores(&rows, &near, options, &score_streams())?.source))
        }
        RowScores::None => None,
    })
}

/// Costs as scores: higher is closer.
pub fn negated_costs(costs: Vec<f32>) -> Arc<Vec<f32>> {
    Arc::new(costs.into_iter().map(|c| -c).collect())
}
