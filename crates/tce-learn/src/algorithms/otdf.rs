//! OTDF (Lyu et al. 2025): keeps source rows with a low cost in the optimal transport to the target rows.
//!
//! ```text
//! d_i = -Σ_j P_ij C_ij for every source row, from tce_data::transport_costs on [s, a, s']
//! d̂   = (d - max d) / (max d - min d) over the source rows of a batch; the best share of them is kept
//! w   = exp(d̂) for source rows, 1 for target rows: weights of L_Q                then a step of IQL ([`crate::iql`]) with
//! L_π = mean of min(exp(β u), cap) Σ_d (tanh μ_d(s) - a_d)² - β_reg mean ln β(π(s)|s)    β: the target's behaviour CVAE
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | share | `keep` | .8 | OTDF's command line (its yaml says .25) |
//! | w | `weighted` | true | OTDF |
//! | β_reg | `beta_reg` | .5 | OTDF for morph and gravity; .1 for kinematic |
//! | - | `mode` | corrected | published: every row is cloned with the mean weight of its batch |
//! | β and its CVAE | `learner.behaviour` | - | [`crate::regulariser`], kind `otdf` |
//! | d | `row_scores` of a [`crate::Member`] | - | a number per source row with s' |
//! | everything else | `learner.iql` | - | OTDF's IQL, but for what the preset changes in it (below) |
//!
//! **Published**: the code multiplies a column of weights by a row of losses. The result is filtered cloning with a
//! regulariser: the advantages have no effect on which action is cloned ([`PolicyExtraction::MeanWeight`]).
//!
//! **β_reg is relative to the weights of cloning.** OTDF uses min(exp(3 u), 100) of raw advantages. On HalfCheetah a
//! tenth of these weights are 100, so their mean is 10 or more. The preset `default` uses exp(u / std u), with a mean
//! of 1.2 to 1.5. There the same β_reg constrains the policy several times more. `--preset paper` has OTDF's scale.
//!
//! Where s' is unknown, at terminal rows of logs without next states, there is no cost of transport: the row borrows that
//! of another source row of the batch (`lend_scores` in [`crate::selection`]). The costs of the others are those of rows
//! with s' alone.
//!
//! OTDF's loader also uses the next row as s' across the ends of episodes; this is not repeated here.

use serde::{Deserialize, Serialize};
use tce_nn::{Device, Tensor};

use crate::actor::ActionReduction;
use crate::buffer::{Buffer, Minibatch};
use crate::error::{LearnError, within};
use crate::iql::{Iql, IqlConfig, PolicyExtraction};
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::mode::Mode;
use crate::on_iql::{BatchTransform, OnIql};
use crate::regulariser::{Regulariser, RegulariserKind};
use crate::selection::{Scores, Selected};
use crate::training::Meter;

const ABOUT: About = About {
    name: "otdf",
    title: "OTDF",
    description: "IQL; source rows chosen by optimal transport, policy held to the target's behaviour",
    reference: "Lyu et al. 2025",
    published: Some("advantages have no effect on which action is cloned (a broadcast)"),
    table: "otdf",
    needs: OtherRows::Source,
    episodes: false,
    scores: RowScores::Transport,
};

impl Method for OtdfConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        within("keep", self.keep, 0.0..=1.0)?;
        within("beta_reg", self.beta_reg, 0.0..=1e6)
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let Some(regulariser) = on.regulariser(self)? else { return Ok(None) };
        Ok(Some(Box::new(Otdf::new(on.buffer, self, on.iql, regulariser, on.steps, on.device)?)))
    }

    fn mode(&self) -> Option<Mode> {
        Some(self.mode)
    }

    fn backbone(&self, iql: &IqlConfig) -> Option<IqlConfig> {
        Some(self.backbone(iql))
    }
}

/// The configuration of [`Otdf`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OtdfConfig {
    /// Whether every row is cloned with its own weight, or, as the public code has it, with the mean weight of its batch.
    pub mode: Mode,
    /// Share of a batch's source rows that are learned from: those with the least cost of transport to the target. Source: OTDF's
    /// command line; its file says .25.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub keep: f64,
    /// Whether a source row's cost of transport decides its weight in the critics' loss. Source: OTDF.
    pub weighted: bool,
    /// β_reg, the weight of the behaviour term in the policy's loss. Source: OTDF; .1 for the kinematic shift.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub beta_reg: f64,
}

impl Default for OtdfConfig {
    fn default() -> Self {
        Self { mode: Mode::default(), keep: 0.8, weighted: true, beta_reg: 0.5 }
    }
}

impl OtdfConfig {
    /// The IQL configuration that this configuration derives from `iql`.
    pub fn backbone(&self, iql: &IqlConfig) -> IqlConfig {
        otdf_policy(iql, self.mode, self.beta_reg)
    }
}

/// IQL with the policy of OTDF, which DmC also uses: a tanh-Gaussian, squared errors summed over the action's
/// components, and the behaviour CVAE as its regulariser.
pub(crate) fn otdf_policy(iql: &IqlConfig, mode: Mode, beta_reg: f64) -> IqlConfig {
    let policy_extraction = match mode {
        Mode::Published => PolicyExtraction::MeanWeight,
        Mode::Corrected => PolicyExtraction::AwrMse,
    };
    let mut iql = IqlConfig { policy_extraction, regulariser: RegulariserKind::Otdf, beta_reg, ..iql.clone() };
    iql.actor.action_reduction = ActionReduction::Sum;
    iql
}

/// OTDF of a population.
pub type Otdf = OnIql<Transported>;

/// Keeps the source rows with a low cost of transport.
pub struct Transported {
    config: OtdfConfig,
    scores: Scores,
}

impl Otdf {
    /// New networks for the members of `buffer`, to be trained for `steps` steps. `regulariser` is of the kind `otdf`.
    ///
    /// # Errors
    /// If a configuration cannot be used, or there are no source rows or they have no costs.
    pub fn new(
        buffer: &Buffer,
        config: &OtdfConfig,
        iql: &IqlConfig,
        regulariser: Regulariser,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        config.check()?;
        let scores = Scores::new("OTDF", buffer)?;
        let iql = Iql::new(buffer, &config.backbone(iql), regulariser, steps, device)?;
        Ok(OnIql { iql, transform: Transported { config: config.clone(), scores } })
    }
}

/// Replaces d by d̂ for the `others` source rows of every member; 0 for all if they are equal.
pub fn normalise(d: &mut [f32], others: usize) {
    for d in d.chunks_mut(others.max(1)) {
        let (low, high) = d.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
        let range = high - low;
        d.iter_mut().for_each(|v| *v = if range > 0.0 { (*v - high) / range } else { 0.0 });
    }
}

impl BatchTransform for Transported {
    fn transform(
        &mut self,
        _iql: &Iql,
        batch: &Minibatch,
        _step: u64,
        meter: &mut Meter,
    ) -> (Minibatch, Option<Tensor<3>>) {
        let c = &self.config;
        let mut d = self.scores.of_others(batch);
        normalise(&mut d, batch.s.dims()[1] - batch.target_rows);
        Selected::new(batch, &d, c.keep, |d| if c.weighted { d.exp() } else { 1.0 }).recorded(meter)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn costs_are_normalised_within_a_member() {
        let mut d = [-3.0, -1.0, -2.0, 5.0, 5.0, 5.0];
        normalise(&mut d, 3);
        assert_eq!(d, [-1.0, 0.0, -0.5, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn the_modes_differ_in_policy_extraction_alone() {
        let iql = IqlConfig::paper();
        let of = |mode| OtdfConfig { mode, ..OtdfConfig::default() }.backbone(&iql);
        let (published, corrected) = (of(Mode::Published), of(Mode::Corrected));
        assert_eq!(published.policy_extraction, PolicyExtraction::MeanWeight);
        assert_eq!(corrected.policy_extraction, PolicyExtraction::AwrMse);
        assert_eq!(IqlConfig { policy_extraction: PolicyExtraction::AwrMse, ..published }, corrected);
    }
}
