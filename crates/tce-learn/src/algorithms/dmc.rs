//! DmC's learner (ECAI 2025): IQL on target rows and on the better half of source and generated rows. Each of these has
//! a score that says how target-like it is.
//!
//! ```text
//! batch  n target rows, n others (source ∪ generated rows), c(x) ∈ (0, 1] the score of an other row
//! kept   the target rows, and of the others the ⌊(1 − cut) n⌋ of highest c
//! w      = 1 of a target row, c(x) of another one
//! L_Q    = mean w (Q1 − y)² + mean w (Q2 − y)²       over the kept rows; V, y and L_V as in [`crate::iql`], unweighted
//! L_π    = mean min(exp(β u), cap) Σ_d (tanh μ_d − a_d)² − β_reg mean log β(ã|s), ã ~ π(·|s)          [corrected]
//! L_π    = mean min(exp(β u), cap) · mean Σ_d (tanh μ_d − a_d)² − β_reg mean log β₀(ã|s)              [published]
//! ```
//!
//! π is OTDF's tanh-Gaussian and log β its behaviour term ([`crate::regulariser`], kind `otdf`), over all kept rows.
//!
//! | what | `published` | `corrected` |
//! |---|---|---|
//! | weights of L_π | a column times a row of losses: every action is cloned with the mean weight | each row's own |
//! | behaviour CVAE | β₀, as it was initialised: the published script trains it under a condition that is never met | β, trained on the target rows |
//!
//! The modes do not differ in anything else.
//!
//! Where s' is unknown, at terminal rows of logs without next states, there is no score: the row borrows that of another
//! source or generated row of the batch (`lend_scores` in [`crate::selection`]). The scores of the others are those of
//! rows with s' alone.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `mode` | corrected | - |
//! | cut | `cut_off` | .5 | DmC |
//! | β_reg | `beta_reg` | .1 | DmC's scripts |
//! | n | the buffer's batch | 128 of 256 | DmC, OTDF |
//! | c | [`crate::Member::row_scores`] | - | [`tce_data::density`] |
//! | τ, β, cap, γ, ρ, networks | those of [`IqlConfig`] | - | OTDF |

use serde::{Deserialize, Serialize};
use tce_nn::{Device, Tensor};

use crate::buffer::{Buffer, Minibatch};
use crate::error::{LearnError, within};
use crate::iql::{Iql, IqlConfig};
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::mode::Mode;
use crate::on_iql::{BatchTransform, OnIql};
use crate::otdf::otdf_policy;
use crate::regulariser::{Regulariser, RegulariserConfig};
use crate::selection::{Scores, Selected};
use crate::training::Meter;

const ABOUT: About = About {
    name: "dmc",
    title: "DmC",
    description: "OTDF's policy; source and guided generated rows chosen and weighed by nearest neighbours",
    reference: "DmC, ECAI 2025",
    published: Some("OTDF's broadcast, and a behaviour model that is never trained"),
    table: "dmc",
    needs: OtherRows::Scored,
    episodes: false,
    scores: RowScores::Density,
};

impl Method for DmcConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        within("cut_off", self.cut_off, 0.0..=1.0)?;
        within("beta_reg", self.beta_reg, 0.0..=1e6)
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let Some(regulariser) = on.regulariser(self)? else { return Ok(None) };
        Ok(Some(Box::new(Dmc::new(on.buffer, self, on.iql, regulariser, on.steps, on.device)?)))
    }

    fn mode(&self) -> Option<Mode> {
        Some(self.mode)
    }

    fn backbone(&self, iql: &IqlConfig) -> Option<IqlConfig> {
        Some(self.backbone(iql))
    }

    fn behaviour(&self, base: &RegulariserConfig) -> RegulariserConfig {
        let mut behaviour = base.clone();
        // The public code never trains the behaviour CVAE.
        if self.mode == Mode::Published {
            behaviour.cvae.steps = 0;
        }
        behaviour
    }
}

/// The configuration of [`Dmc`], besides [`IqlConfig`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DmcConfig {
    /// Whose form: weights for each row and a trained behaviour model, or what the public code does.
    pub mode: Mode,
    /// Share of the source and generated rows of a batch that is left out, those with the lowest scores. Source: DmC.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub cut_off: f64,
    /// β_reg, the weight of the behaviour term in the policy's loss. Source: DmC's scripts.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub beta_reg: f64,
}

impl Default for DmcConfig {
    fn default() -> Self {
        Self { mode: Mode::default(), cut_off: 0.5, beta_reg: 0.1 }
    }
}

impl DmcConfig {
    /// `base` with the parts that DmC takes from OTDF: policy and regulariser, and the mode's policy extraction.
    pub fn backbone(&self, base: &IqlConfig) -> IqlConfig {
        otdf_policy(base, self.mode, self.beta_reg)
    }
}

/// DmC's learner of a population.
pub type Dmc = OnIql<Scored>;

/// Keeps the rows with the highest scores.
pub struct Scored {
    config: DmcConfig,
    scores: Scores,
}

impl Dmc {
    /// New networks for the members of `buffer`, to be trained for `steps` steps. `regulariser` is of the kind `otdf`, made from
    /// [`DmcConfig::behaviour`].
    ///
    /// # Errors
    /// If a configuration cannot be used, or there are no other rows or they have no scores.
    pub fn new(
        buffer: &Buffer,
        config: &DmcConfig,
        iql: &IqlConfig,
        regulariser: Regulariser,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        config.check()?;
        let scores = Scores::new("DmC", buffer)?;
        let iql = Iql::new(buffer, &config.backbone(iql), regulariser, steps, device)?;
        Ok(OnIql { iql, transform: Scored { config: config.clone(), scores } })
    }
}

impl BatchTransform for Scored {
    fn transform(
        &mut self,
        _iql: &Iql,
        batch: &Minibatch,
        _step: u64,
        meter: &mut Meter,
    ) -> (Minibatch, Option<Tensor<3>>) {
        let scores = self.scores.of_others(batch);
        Selected::new(batch, &scores, 1.0 - self.config.cut_off, |score| score).recorded(meter)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::iql::PolicyExtraction;
    use crate::regulariser::RegulariserKind;

    #[test]
    fn the_modes_differ_in_two_things_only() {
        let (base, regulariser) = (IqlConfig::paper(), RegulariserConfig::paper());
        let config = |mode| DmcConfig { mode, ..DmcConfig::default() };
        let (published, corrected) = (config(Mode::Published), config(Mode::Corrected));
        let (a, b) = (published.backbone(&base), corrected.backbone(&base));
        assert_eq!(a.policy_extraction, PolicyExtraction::MeanWeight);
        assert_eq!(b.policy_extraction, PolicyExtraction::AwrMse);
        assert_eq!(IqlConfig { policy_extraction: b.policy_extraction, ..a }, b);
        assert_eq!((b.beta_reg, b.regulariser), (0.1, RegulariserKind::Otdf));
        let (a, b) = (published.behaviour(&regulariser), corrected.behaviour(&regulariser));
        assert_eq!((a.cvae.steps, &b), (0, &regulariser));
        let mut trained = a;
        trained.cvae.steps = b.cvae.steps;
        assert_eq!(trained, b);
    }
}
