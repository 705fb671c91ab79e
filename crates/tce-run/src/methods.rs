//! The learners by name: what each of them is, what it needs, and how it is made from a configuration.

use std::sync::Arc;

use tce_augment::single_stage::{enough_to_score, score_streams};
use tce_data::{Rows, Transitions, TransportOptions, density_scores, transport_costs};
use tce_learn::algorithms::{bc, bosa, dara, dmc, igdf, iql, meta_dt, otdf, rebrac, srpo, td3_bc};
use tce_learn::{
    About, Bc, Bosa, Buffer, Dara, Dmc, Igdf, Iql, IqlConfig, MetaDt, Otdf, Place, PolicyLearner, Rebrac, Regulariser,
    Srpo, Td3Bc,
};
use tce_nn::Device;

use crate::config::{Algorithm, Config, LearnerConfig};
use crate::error::{Error, Result};

impl Algorithm {
    /// All of them, in the order of the list.
    pub const ALL: [Algorithm; 11] = [
        Algorithm::Bc,
        Algorithm::Iql,
        Algorithm::Td3Bc,
        Algorithm::Rebrac,
        Algorithm::Dara,
        Algorithm::Bosa,
        Algorithm::Srpo,
        Algorithm::Igdf,
        Algorithm::Otdf,
        Algorithm::Dmc,
        Algorithm::MetaDt,
    ];

    /// Whether it looks at s' of terminal rows: it models the dynamics, or compares transitions of two domains.
    pub fn looks_at_successors(self) -> bool {
        self.method().successors
    }

    /// What it is.
    pub fn method(self) -> About {
        match self {
            Algorithm::Bc => bc::ABOUT,
            Algorithm::Iql => iql::ABOUT,
            Algorithm::Td3Bc => td3_bc::ABOUT,
            Algorithm::Rebrac => rebrac::ABOUT,
            Algorithm::Dara => dara::ABOUT,
            Algorithm::Bosa => bosa::ABOUT,
            Algorithm::Srpo => srpo::ABOUT,
            Algorithm::Igdf => igdf::ABOUT,
            Algorithm::Otdf => otdf::ABOUT,
            Algorithm::Dmc => dmc::ABOUT,
            Algorithm::MetaDt => meta_dt::ABOUT,
        }
    }
}

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
    let LearnerConfig { steps, iql, .. } = config;
    let (steps, backbone) = (*steps, config.backbone());
    let regulariser = || -> Result<Regulariser> {
        let kind = backbone.as_ref().map_or(Default::default(), |iql: &IqlConfig| iql.regulariser);
        Regulariser::prepare(kind, buffer, &config.behaviour(), place, device)?.ok_or(Error::Interrupted)
    };
    Ok(match config.algorithm {
        Algorithm::Bc => Box::new(Bc::new(buffer, &config.bc, steps, device)?),
        Algorithm::Iql => Box::new(Iql::new(buffer, iql, regulariser()?, steps, device)?),
        Algorithm::Td3Bc => Box::new(Td3Bc::new(buffer, &config.td3_bc, steps, device)?),
        Algorithm::Rebrac => Box::new(Rebrac::new(buffer, &config.rebrac, steps, device)?),
        Algorithm::Dara => Box::new(Dara::new(buffer, &config.dara, iql, regulariser()?, steps, device)?),
        Algorithm::Srpo => Box::new(Srpo::new(buffer, &config.srpo, iql, regulariser()?, steps, device)?),
        Algorithm::Igdf => {
            let igdf = Igdf::new(buffer, &config.igdf, iql, regulariser()?, steps, place, device)?;
            Box::new(igdf.ok_or(Error::Interrupted)?)
        }
        Algorithm::Otdf => Box::new(Otdf::new(buffer, &config.otdf, iql, regulariser()?, steps, device)?),
        Algorithm::Dmc => Box::new(Dmc::new(buffer, &config.dmc, iql, regulariser()?, steps, device)?),
        Algorithm::MetaDt => Box::new(MetaDt::new(buffer, &config.meta_dt, place, device)?.ok_or(Error::Interrupted)?),
        Algorithm::Bosa => Box::new(Bosa::new(buffer, &config.bosa, steps, place, device)?.ok_or(Error::Interrupted)?),
    })
}

/// The number of every row of `others` that the learner of `config` chooses by, the greater the closer to the target; None if it
/// chooses by none that is computed before.
///
/// # Errors
/// If there are too few rows, or the user interrupts it.
pub fn row_scores(config: &Config, target: &Transitions, others: &Transitions) -> Result<Option<Arc<Vec<f32>>>> {
    let (rows, near) = (Rows::transitions(others), Rows::transitions(target));
    Ok(match config.learner.algorithm {
        Algorithm::Otdf => Some(closeness(transport_costs(&rows, &near, &TransportOptions::default())?)),
        Algorithm::Dmc => {
            let options = &config.joint.scores;
            enough_to_score(others.len(), target.len(), options)?;
            Some(Arc::new(density_scores(&rows, &near, options, &score_streams())?.source))
        }
        _ => None,
    })
}

/// -cost: the greater the closer.
pub fn closeness(costs: Vec<f32>) -> Arc<Vec<f32>> {
    Arc::new(costs.into_iter().map(|c| -c).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::ValueEnum;

    #[test]
    fn the_list_is_whole_and_names_are_those_of_the_command_line() {
        assert_eq!(Algorithm::ALL.len(), Algorithm::value_variants().len());
        for algorithm in Algorithm::ALL {
            let name = algorithm.method().name;
            assert_eq!(algorithm.to_possible_value().unwrap().get_name(), name);
            assert_eq!(serde_json::json!(algorithm), name);
        }
    }
}
