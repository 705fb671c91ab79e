//! DmC's learner (ECAI 2025): IQL on target rows and on the better half of source and generated rows, each with a score of how
//! target-like it is.
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
//! Nothing else differs between the two.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `mode` | corrected | - |
//! | cut | `cut_off` | .5 | DmC |
//! | β_reg | `beta_reg` | .1 | DmC's scripts |
//! | n | the buffer's batch | 128 of 256 | DmC, OTDF |
//! | c | [`crate::Member::row_scores`] | - | [`tce_data::density`] |
//! | τ, β, cap, γ, ρ, networks | those of [`IqlConfig`] | - | OTDF |

use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tce_nn::{Device, NamedParameters, NetworkError, tensor};

use crate::actor::{ActionReduction, ActorConfig};
use crate::buffer::{Buffer, Minibatch, Pick};
use crate::error::{LearnError, within};
use crate::iql::{Iql, IqlConfig, PolicyExtraction};
use crate::policy::Policy;
use crate::regulariser::{Regulariser, RegulariserConfig, RegulariserKind};
use crate::training::{Learner, Meter, PolicyLearner};

/// Whose DmC; see the [module](self).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DmcMode {
    /// As its code runs.
    Published,
    /// As it is meant.
    #[default]
    Corrected,
}

/// The configuration of [`Dmc`], besides [`IqlConfig`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DmcConfig {
    /// Whose.
    pub mode: DmcMode,
    /// Share of the other rows of a batch that is left out.
    pub cut_off: f64,
    /// β_reg
    pub beta_reg: f64,
}

impl Default for DmcConfig {
    fn default() -> Self {
        Self { mode: DmcMode::default(), cut_off: 0.5, beta_reg: 0.1 }
    }
}

impl DmcConfig {
    /// Refuses numbers out of range.
    ///
    /// # Errors
    /// Names the field.
    pub fn check(&self) -> Result<(), LearnError> {
        within("cut_off", self.cut_off, 0.0..=1.0)?;
        within("beta_reg", self.beta_reg, 0.0..=1e6)
    }

    /// `base` with what DmC prescribes: OTDF's policy and regulariser, squared errors summed over an action's components, β_reg,
    /// and the policy extraction of the mode.
    pub fn iql(&self, base: &IqlConfig) -> IqlConfig {
        let policy_extraction = match self.mode {
            DmcMode::Published => PolicyExtraction::MeanWeight,
            DmcMode::Corrected => PolicyExtraction::AwrMse,
        };
        IqlConfig {
            policy_extraction,
            regulariser: RegulariserKind::Otdf,
            beta_reg: self.beta_reg,
            actor: ActorConfig { action_reduction: ActionReduction::Sum, ..base.actor.clone() },
            ..base.clone()
        }
    }

    /// `base` with the training of the behaviour CVAE that the mode has: none in `published`.
    pub fn behaviour(&self, base: &RegulariserConfig) -> RegulariserConfig {
        let mut behaviour = base.clone();
        if self.mode == DmcMode::Published {
            behaviour.cvae.steps = 0;
        }
        behaviour
    }
}

/// DmC's learner of a population.
pub struct Dmc {
    iql: Iql,
    cut_off: f64,
    /// Of the rows of part 1, per member.
    scores: Vec<Arc<Vec<f32>>>,
}

impl Dmc {
    /// New networks for the members of `buffer`, to be trained for `steps` steps, after the behaviour model that the mode asks for
    /// is trained on the target rows. None if the user interrupted that.
    ///
    /// # Errors
    /// If the configuration cannot be used, or a member has no other rows, more than one part of them, or no scores of theirs.
    pub fn new(
        buffer: &Buffer,
        config: &DmcConfig,
        iql: &IqlConfig,
        behaviour: &RegulariserConfig,
        steps: u64,
        device: &Device,
    ) -> Result<Option<Self>, LearnError> {
        config.check()?;
        let scores = scores(buffer)?;
        let behaviour = config.behaviour(behaviour);
        let Some(regulariser) = Regulariser::prepare(RegulariserKind::Otdf, buffer, &behaviour, device)? else {
            return Ok(None);
        };
        let iql = Iql::new(buffer, &config.iql(iql), regulariser, steps, device)?;
        Ok(Some(Self { iql, cut_off: config.cut_off, scores }))
    }
}

/// The scores of every member's other rows.
fn scores(buffer: &Buffer) -> Result<Vec<Arc<Vec<f32>>>, LearnError> {
    let of = |(k, member): (usize, &crate::buffer::Member)| {
        if member.parts.len() != 2 || member.parts[1].is_empty() {
            let (field, parts) = (format!("member {k}, parts"), member.parts.len());
            let found = format!("{parts}, of {:?} rows", member.parts.iter().map(|p| p.len()).collect::<Vec<_>>());
            let remedy = "give source or generated rows, all in one table";
            return Err(LearnError::invalid(field, found, "2: target rows and others", remedy));
        }
        let field = format!("member {k}, row_scores");
        let Some(scores) = &member.row_scores else {
            let remedy = "compute them with tce_data::density_scores";
            return Err(LearnError::invalid(field, "none", "a score per row of part 1", remedy));
        };
        match scores.iter().position(|s| !(0.0..=1.0).contains(s)) {
            None => Ok(scores.clone()),
            Some(at) => {
                let found = format!("{} of row {at}", scores[at]);
                Err(LearnError::invalid(
                    field,
                    found,
                    "a score in [0, 1]",
                    "compute them with tce_data::density_scores",
                ))
            }
        }
    };
    buffer.members().iter().enumerate().map(of).collect()
}

/// The rows of one member's batch that are kept, ascending, and their weights. `cut` is the share of the other rows (those of part
/// 1) that is left out; of equal scores the earlier rows stay.
fn select(picks: &[Pick], scores: &[f32], cut: f64) -> (Vec<usize>, Vec<f32>) {
    let score = |i: usize| scores[picks[i].row as usize];
    let (mut kept, mut others): (Vec<usize>, Vec<usize>) = (0..picks.len()).partition(|&i| picks[i].part == 0);
    // The sum keeps .2 of 10 from becoming 7.999... of 10.
    let count = ((1.0 - cut) * others.len() as f64 + 1e-9) as usize;
    others.sort_by(|&a, &b| score(b).total_cmp(&score(a)).then(a.cmp(&b)));
    kept.extend(&others[..count]);
    kept.sort_unstable();
    let weights = kept.iter().map(|&i| if picks[i].part == 0 { 1.0 } else { score(i) }).collect();
    (kept, weights)
}

impl Learner for Dmc {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let [p, b, _] = batch.s.dims();
        let members = batch.picks.chunks(b).zip(&self.scores);
        let (rows, weights): (Vec<_>, Vec<_>) = members.map(|(picks, s)| select(picks, s, self.cut_off)).unzip();
        let kept = batch.keep(&rows);
        let targets = kept.target_rows;
        if meter.active() && rows[0].len() > targets {
            let others = |w: &Vec<f32>| w[targets..].iter().map(|w| *w as f64).collect::<Vec<_>>();
            let mean = |w: Vec<f64>| w.iter().sum::<f64>() / w.len() as f64;
            meter.add("score_mean", weights.iter().map(|w| mean(others(w))).collect());
            let least = |w: Vec<f64>| w.into_iter().fold(f64::INFINITY, f64::min);
            meter.add("score_least", weights.iter().map(|w| least(others(w))).collect());
        }
        let weights = tensor(weights.concat(), [p, rows[0].len(), 1], &batch.s.device());
        self.iql.step(&kept, Some(weights), step, meter);
    }

    fn state(&self) -> NamedParameters {
        self.iql.state()
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.iql.restore(state, path)
    }
}

impl PolicyLearner for Dmc {
    fn policies(&self) -> Vec<Policy> {
        self.iql.policies()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use tce_base::Streams;

    #[test]
    fn the_best_scores_are_kept_and_weigh_as_much() {
        let mut rng = Streams::new(1).stream("scores");
        let scores: Vec<f32> = (0..40).map(|_| (rng.random_range(1..9) as f32) / 8.0).collect();
        for (targets, others, cut) in [(4, 10, 0.5), (3, 7, 0.2), (2, 10, 0.2), (1, 6, 0.0), (5, 4, 1.0)] {
            let target = (0..targets).map(|row| Pick { part: 0, row });
            let other = (0..others).map(|_| Pick { part: 1, row: rng.random_range(0..40) }).collect::<Vec<_>>();
            let picks: Vec<_> = target.chain(other).collect();
            let (rows, weights) = select(&picks, &scores, cut);
            // By counting: a row stays if fewer than `count` others come before it.
            let count = ((100.0 * (1.0 - cut)).round() as usize * others) / 100;
            let score = |i: usize| scores[picks[i].row as usize];
            let of_others = targets as usize..picks.len();
            let before = |i: usize| {
                of_others.clone().filter(|&j| score(j) > score(i) || (score(j) == score(i) && j < i)).count()
            };
            let expected: Vec<usize> =
                (0..picks.len()).filter(|&i| i < targets as usize || before(i) < count).collect();
            assert_eq!(rows, expected, "{targets} {others} {cut}");
            let expected: Vec<f32> = rows.iter().map(|&i| if i < targets as usize { 1.0 } else { score(i) }).collect();
            assert_eq!(weights, expected);
        }
    }

    #[test]
    fn the_modes_differ_in_two_things_only() {
        let (base, regulariser) = (IqlConfig::default(), RegulariserConfig::default());
        let config = |mode| DmcConfig { mode, ..DmcConfig::default() };
        let (published, corrected) = (config(DmcMode::Published), config(DmcMode::Corrected));
        let (a, b) = (published.iql(&base), corrected.iql(&base));
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
