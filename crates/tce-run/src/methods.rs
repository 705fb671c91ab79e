//! The learners by name: what each of them is, what it needs, and how it is made from a configuration.

use std::sync::Arc;

use serde::Serialize;
use tce_augment::single_stage::{enough_to_score, score_streams};
use tce_data::{Rows, Transitions, TransportOptions, density_scores, transport_costs};
use tce_learn::{
    Bc, Bosa, Buffer, Dara, Dmc, Igdf, Iql, IqlConfig, MetaDt, Otdf, Place, PolicyLearner, Rebrac, Regulariser, Srpo,
    Td3Bc,
};
use tce_nn::Device;

use crate::config::{Algorithm, Config, LearnerConfig};
use crate::error::{Error, Result};

/// [`Method::needs`] of learners that compare the domains.
pub const SOURCE_ROWS: &str = "source rows";

/// What `tce learn --list` prints of a learner.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Method {
    /// Its name on the command line and in `learner.algorithm`.
    pub name: &'static str,
    /// One line.
    pub description: &'static str,
    /// Whose it is.
    pub reference: &'static str,
    /// How `mode = "published"` differs; none where there is one form.
    pub published: Option<&'static str>,
    /// The table of its keys.
    pub table: &'static str,
    /// What the rows besides the target's must have.
    pub needs: &'static str,
}

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
        !matches!(self, Algorithm::Bc | Algorithm::Iql | Algorithm::Td3Bc | Algorithm::Rebrac)
    }

    /// What it is.
    pub fn method(self) -> Method {
        let any = "any rows, or none";
        let source = SOURCE_ROWS;
        let (name, description, reference, published, table, needs) = match self {
            Algorithm::Bc => (
                "bc",
                "behaviour cloning; of the best trajectories with learner.top",
                "Pomerleau 1989",
                None,
                "bc",
                any,
            ),
            Algorithm::Iql => {
                ("iql", "implicit Q-learning, TCE's learner", "Kostrikov et al. 2022; TCE, B.2", None, "iql", any)
            }
            Algorithm::Td3Bc => {
                ("td3-bc", "TD3 with a behaviour-cloning term", "Fujimoto and Gu 2021", None, "td3_bc", any)
            }
            Algorithm::Rebrac => (
                "rebrac",
                "TD3+BC with a penalty in the critics too, and normalised critics",
                "Tarasov et al. 2023",
                None,
                "rebrac",
                any,
            ),
            Algorithm::Dara => (
                "dara",
                "IQL; source rewards lowered where two classifiers tell the domains apart",
                "Liu et al. 2022; ODRL",
                Some("the classifiers' softmax is taken for logits, by their loss and by the rewards"),
                "dara",
                source,
            ),
            Algorithm::Bosa => (
                "bosa",
                "deterministic actor-critic on the support of dynamics and behaviour models",
                "Liu et al. 2024; ODRL",
                Some("critics bootstrap at terminal rows and nowhere else"),
                "bosa",
                source,
            ),
            Algorithm::Srpo => (
                "srpo",
                "IQL; rewards raised where the state looks like one of high value",
                "Xue et al. 2023; IGDF's repository",
                Some("the discriminator's logit is clamped where its odds are meant"),
                "srpo",
                any,
            ),
            Algorithm::Igdf => (
                "igdf",
                "IQL; source rows chosen by a contrastive model of the target's dynamics",
                "Wen et al. 2024; ODRL",
                Some(
                    "the contrastive model is never trained; with code = \"authors\", no row weighs more than another",
                ),
                "igdf",
                source,
            ),
            Algorithm::Otdf => (
                "otdf",
                "IQL; source rows chosen by optimal transport, policy held to the target's behaviour",
                "Lyu et al. 2025",
                Some("advantages have no effect on which action is cloned (a broadcast)"),
                "otdf",
                source,
            ),
            Algorithm::Dmc => (
                "dmc",
                "OTDF's policy; source and guided generated rows chosen and weighed by nearest neighbours",
                "DmC, ECAI 2025",
                Some("OTDF's broadcast, and a behaviour model that is never trained"),
                "dmc",
                "source rows, or rows of mixture.generated = \"dmc\"",
            ),
            Algorithm::MetaDt => (
                "meta-dt",
                "a decision transformer on contexts of a world model, zero-shot",
                "Meta-DT 2024",
                None,
                "meta_dt",
                any,
            ),
        };
        Method { name, description, reference, published, table, needs }
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
