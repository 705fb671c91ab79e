//! Actions, rewards and terminals for generated state pairs: â = Inv(s, s'), r̂ = R(s, s') (Section 4.3, B.2).
//!
//! | question | answer |
//! |---|---|
//! | Which data? | the target's rows, except a held-out share to measure errors; for terminals also the source's rows |
//! | Which networks? | two or three [`PairModel`]s (Table B.1), trained together, in two threads if available |
//! | Actions outside the box? | clipped to [-1, 1]; the share of such components is reported (about 6 %) |
//! | Terminals? | not in the paper: [`TerminalHandling`] |
//!
//! | field | default | source |
//! |---|---|---|
//! | `steps` | 39 000 | Table C.4: 1K epochs of 5000 rows in batches of 128 |
//! | `batch` | 128 | Table C.4 |
//! | `held_out` | .05 of the target rows, at random | - |
//! | `model` | see [`crate::pair_model`] | Table B.1 |
//! | `learn_terminals` | no | - |

use std::path::Path;
use std::sync::Arc;

use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};
use tce_data::{Rows, Standardizer, Transitions};
use tce_nn::{Checkpoints, Device, NamedParameters, NetworkError};

use crate::buffer::{Buffer, Member, Minibatch};
use crate::error::{LearnError, within};
use crate::pair_model::{PairConfig, PairModel, PairTarget};
use crate::training::{Learner, Meter, Steps, train};

/// The configuration of [`train_labels`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default = "LabelConfig::paper")]
pub struct LabelConfig {
    /// The networks.
    pub model: PairConfig,
    /// Training steps of inverse dynamics and reward models. Source: Table C.4: 39 000.
    pub steps: u64,
    /// Target rows per step. Source: Table C.4.
    #[schemars(range(min = 1))]
    pub batch: usize,
    /// Share of the target rows on which the errors of the label models are measured.
    pub held_out: f64,
    /// Whether a classifier of terminal rows is trained, too. A run sets it by `labels.terminal`, whatever is written here.
    pub learn_terminals: bool,
}

impl LabelConfig {
    /// The length and batches of Table C.4, with networks on s' - s (the paper's see s').
    pub fn paper() -> Self {
        Self { model: PairConfig::default(), steps: 39_000, batch: 128, held_out: 0.05, learn_terminals: false }
    }
}

/// Whether a generated s' is terminal.
#[derive(Clone, Copy)]
pub enum TerminalHandling<'a> {
    /// Never: every generated row is bootstrapped.
    None,
    /// A known rule on (s, s'), for example the simulator's.
    Rule(&'a (dyn Fn(&[f32], &[f32]) -> bool + Sync)),
    /// If the classifier's probability is above one half.
    Learned,
}

/// Root-mean-square errors of one member on the held-out rows, without clipping.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LabelErrors {
    /// Number of held-out rows.
    pub rows: usize,
    /// Error of the actions, over rows and components.
    pub action_rmse: f64,
    /// Standard deviation of the actions, each component around its own mean, for comparison: the error of always taking the mean action.
    pub action_std: f64,
    /// Share of predicted components outside [-1, 1].
    pub outside_box: f64,
    /// Error of the rewards.
    pub reward_rmse: f64,
    /// Standard deviation of the rewards, for comparison.
    pub reward_std: f64,
    /// Share of rows for which the classifier predicts the wrong terminal flag, if there is a classifier.
    pub terminal_error: Option<f64>,
}

/// Generated pairs with labels.
#[derive(Clone, Debug)]
pub struct Labelled {
    /// Every row is an episode of its own.
    pub transitions: Transitions,
    /// Share of action components that were outside [-1, 1] before clipping.
    pub outside_box: f64,
}

/// The trained models of a population.
pub struct LabelModels {
    /// Target rows without the held-out ones; also holds the standardisation.
    buffer: Buffer,
    held_out: Vec<Transitions>,
    action: PairModel,
    reward: PairModel,
    terminal: Option<PairModel>,
    /// Rows for the classifier, if it learns from more than the target's rows.
    both: Option<Buffer>,
    device: Device,
}

impl LabelModels {
    /// Untrained models for the target part of each member. States are standardised by the member's target rows,
    /// independent of the member's policy. The classifier of terminals learns from all parts, in equal shares of a
    /// batch: both domains share the rule which states end an episode.
    ///
    /// # Errors
    /// If the configuration or the data cannot be used.
    pub fn new(members: &[Member], config: &LabelConfig, device: &Device) -> Result<Self, LearnError> {
        within("held_out", config.held_out, 0.0..=0.5)?;
        let (mut training, mut held_out, mut with_source) = (Vec::new(), Vec::new(), Vec::new());
        for member in members {
            let Some(target) = member.parts.first() else {
                return Err(LearnError::invalid("members", "no parts", "target rows", "give the target data"));
            };
            let mut rows: Vec<usize> = (0..target.len()).collect();
            rows.shuffle(&mut member.streams.stream("held out"));
            let keep = target.len() - (target.len() as f64 * config.held_out) as usize;
            let (train, held) = rows.split_at(keep);
            held_out.push(target.select(held));
            let own = Member {
                streams: member.streams,
                standardizer: Standardizer::fit(&target.observations, target.obs_dim),
                parts: vec![Arc::new(target.select(train))],
                reward_scale: 1.0,
                row_scores: None,
            };
            if let Some(source) = member.parts.get(1) {
                with_source.push(Member { parts: vec![own.parts[0].clone(), source.clone()], ..own.clone() });
            }
            training.push(own);
        }
        let buffer = Buffer::new(training, config.batch)?.with_stream("label batch");
        let model = |target| PairModel::new(target, &buffer, &config.model, config.steps, device);
        Ok(Self {
            action: model(PairTarget::Action)?,
            reward: model(PairTarget::Reward)?,
            terminal: config.learn_terminals.then(|| model(PairTarget::Terminal)).transpose()?,
            both: match config.learn_terminals && with_source.len() == members.len() {
                true => Some(Buffer::new(with_source, config.batch)?.with_stream("terminal batch")),
                false => None,
            },
            device: device.clone(),
            buffer,
            held_out,
        })
    }

    /// Errors on the held-out rows, per member; `None` if no row was held out.
    pub fn errors(&self) -> Vec<Option<LabelErrors>> {
        let pairs: Vec<_> =
            self.held_out.iter().map(|t| pairs(&t.observations, &t.next_observations, t.obs_dim)).collect();
        let predict = |model: &PairModel| model.predict(&self.buffer, &pairs, &self.device);
        let (actions, rewards, terminals) =
            (predict(&self.action), predict(&self.reward), self.terminal.as_ref().map(predict));
        let error = |(m, t): (usize, &Transitions)| {
            let wrong = |logits: &Vec<Vec<f32>>| {
                logits[m].iter().zip(&t.terminals).filter(|(y, t)| (**y > 0.0) != **t).count() as f64 / t.len() as f64
            };
            (!t.is_empty()).then(|| LabelErrors {
                rows: t.len(),
                action_rmse: rmse(&actions[m], &t.actions),
                action_std: spread(&t.actions, t.act_dim),
                outside_box: outside_box(&actions[m]),
                reward_rmse: rmse(&rewards[m], &t.rewards),
                reward_std: spread(&t.rewards, 1),
                terminal_error: terminals.as_ref().map(wrong),
            })
        };
        self.held_out.iter().enumerate().map(error).collect()
    }

    /// Actions that `member` infers from (s, s'), both `[N, obs_dim]` row-major in original units: `[N, act_dim]`,
    /// clipped to [-1, 1]. Values that are not finite are not changed.
    ///
    /// # Errors
    /// If there is no such member, or the lengths do not fit.
    pub fn actions(&self, member: usize, s: &[f32], s2: &[f32]) -> Result<Vec<f32>, LearnError> {
        let (obs_dim, members) = (self.buffer.obs_dim(), self.held_out.len());
        if member >= members || s.len() != s2.len() || !s.len().is_multiple_of(obs_dim) {
            let found = format!("member {member}, {} and {} numbers", s.len(), s2.len());
            let expected = format!("one of {members} members, and two tables with {obs_dim} columns");
            return Err(LearnError::invalid("pairs", found, expected, "give states and successors"));
        }
        let mut tables = vec![Vec::new(); members];
        tables[member] = pairs(s, s2, obs_dim);
        let mut actions = self.action.predict(&self.buffer, &tables, &self.device).swap_remove(member);
        actions.iter_mut().for_each(|a| *a = a.clamp(-1.0, 1.0));
        Ok(actions)
    }

    /// Labels for generated pairs: per member (s, s'), both `[N, obs_dim]` row-major in original units.
    ///
    /// # Errors
    /// If the number of members or the lengths do not fit, or `terminals` is `Learned` without a classifier.
    pub fn label(
        &self,
        generated: &[(Vec<f32>, Vec<f32>)],
        terminals: TerminalHandling<'_>,
    ) -> Result<Vec<Labelled>, LearnError> {
        let (obs_dim, act_dim) = (self.buffer.obs_dim(), self.buffer.act_dim());
        let fits = |(s, s2): &(Vec<f32>, Vec<f32>)| s.len() == s2.len() && s.len() % obs_dim == 0;
        if generated.len() != self.held_out.len() || !generated.iter().all(fits) {
            let found = format!("{} tables", generated.len());
            let expected = format!("{} pairs of tables with {obs_dim} columns", self.held_out.len());
            return Err(LearnError::invalid("generated", found, expected, "give one pair of tables per member"));
        }
        let pairs: Vec<_> = generated.iter().map(|(s, s2)| pairs(s, s2, obs_dim)).collect();
        let predict = |model: &PairModel| model.predict(&self.buffer, &pairs, &self.device);
        let logits = match (terminals, &self.terminal) {
            (TerminalHandling::Learned, Some(model)) => Some(predict(model)),
            (TerminalHandling::Learned, None) => {
                let expected = "a classifier (learn_terminals = true)";
                return Err(LearnError::invalid("terminals", "learned", expected, "train one, or choose none or rule"));
            }
            _ => None,
        };
        let (actions, rewards) = (predict(&self.action), predict(&self.reward));
        let table = |(m, (s, s2)): (usize, &(Vec<f32>, Vec<f32>))| {
            let rows = s.len() / obs_dim;
            let terminal = |i: usize| match terminals {
                TerminalHandling::None => false,
                TerminalHandling::Rule(rule) => rule(&s[i * obs_dim..][..obs_dim], &s2[i * obs_dim..][..obs_dim]),
                TerminalHandling::Learned => logits.as_ref().is_some_and(|l| l[m][i] > 0.0),
            };
            let terminals: Vec<bool> = (0..rows).map(terminal).collect();
            Labelled {
                outside_box: outside_box(&actions[m]),
                transitions: Transitions {
                    obs_dim,
                    act_dim,
                    observations: s.clone(),
                    actions: actions[m].iter().map(|a| a.clamp(-1.0, 1.0)).collect(),
                    rewards: rewards[m].clone(),
                    next_observations: s2.clone(),
                    timeouts: terminals.iter().map(|t| !t).collect(),
                    known: vec![true; rows],
                    terminals,
                },
            }
        };
        Ok(generated.iter().enumerate().map(table).collect())
    }
}

impl Learner for LabelModels {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let Self { action, reward, terminal, both, device, .. } = self;
        let own = both.as_ref().map(|buffer| buffer.sample(step, device));
        // A small batch uses only one thread, so the models are trained in parallel.
        let (action, (reward, terminal)) = rayon::join(
            || action.update(batch, step),
            || {
                (
                    reward.update(batch, step),
                    terminal.as_mut().map(|model| model.update(own.as_ref().unwrap_or(batch), step)),
                )
            },
        );
        meter.record("action_loss", &action);
        meter.record("reward_loss", &reward);
        if let Some(terminal) = terminal {
            meter.record("terminal_loss", &terminal);
        }
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.action.save(&mut state);
        self.reward.save(&mut state);
        self.terminal.iter().for_each(|model| model.save(&mut state));
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.action.load(state, path)?;
        self.reward.load(state, path)?;
        self.terminal.iter_mut().try_for_each(|model| model.load(state, path))
    }
}

/// Trains the models on each member's target part, resuming from and storing `checkpoints`. `None` if interrupted.
///
/// # Errors
/// If the configuration or the data cannot be used.
pub fn train_labels(
    members: &[Member],
    config: &LabelConfig,
    checkpoints: &mut Checkpoints,
    device: &Device,
) -> Result<Option<LabelModels>, LearnError> {
    let mut models = LabelModels::new(members, config, device)?;
    let (buffer, steps) = (models.buffer.clone(), Steps::new(config.steps, 0));
    let outcome =
        train(&mut models, &buffer, steps, "label models", checkpoints, device, |_, _| Ok::<_, LearnError>(()))?;
    Ok((!outcome.interrupted).then_some(models))
}

/// Rows that hold (s, s').
fn pairs(s: &[f32], s2: &[f32], dim: usize) -> Vec<f32> {
    Rows::join(&[(s, dim), (s2, dim)]).to_vec()
}

/// Root mean square of the differences of two tables of the same shape; NaN if they are empty.
pub fn rmse(predicted: &[f32], actual: &[f32]) -> f64 {
    let sum: f64 = predicted.iter().zip(actual).map(|(p, a)| (*p as f64 - *a as f64).powi(2)).sum();
    (sum / actual.len() as f64).sqrt()
}

/// Root mean square of the differences of a table with `columns` columns from the columns' means.
fn spread(values: &[f32], columns: usize) -> f64 {
    let rows = (values.len() / columns) as f64;
    let mean = |k: usize| values.iter().skip(k).step_by(columns).map(|&v| v as f64).sum::<f64>() / rows;
    let means: Vec<f64> = (0..columns).map(mean).collect();
    let squares = values.iter().enumerate().map(|(i, &v)| (v as f64 - means[i % columns]).powi(2));
    (squares.sum::<f64>() / values.len() as f64).sqrt()
}

fn outside_box(actions: &[f32]) -> f64 {
    actions.iter().filter(|a| a.abs() > 1.0).count() as f64 / actions.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two components around 5 and -5 that differ by 1 from there: the distance of the two is no spread.
    #[test]
    fn the_spread_is_component_by_component() {
        assert_eq!(spread(&[6.0, -4.0, 4.0, -6.0, 6.0, -4.0, 4.0, -6.0], 2), 1.0);
        assert_eq!(spread(&[1.0, 3.0], 1), 1.0);
    }
}
