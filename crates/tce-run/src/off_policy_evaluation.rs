//! Off-policy evaluation: estimates of policies from the two data sets alone, without a simulator.
//!
//! A policy is tried in a learned model of the target's dynamics ([`tce_learn::dynamics`]: both domains' rows, the domain as an
//! input). An imagined episode keeps to one network of the ensemble, and ends where the network says that the state is terminal, where the
//! state has left everything that either robot has been seen in, or after as many steps as the longest target episode has.
//!
//! Imagined episodes begin at target states, and where the source's episodes began, if that is no further from the target's states than three
//! times the median distance between its episodes. A few target episodes have a few first states, which a clone knows by heart; whether it
//! can start elsewhere is what most often decides (bench/expansion.md).
//!
//! The *supported return* counts until the episode is far from every target state ([`FAR`]): beyond, the networks are
//! not to be trusted. Each later step counts the worst reward of the target's rows, if that is below 0: where rewards are costs, leaving early
//! must not pay.
//! Halting where the data end is MOReL's (Kidambi et al. 2020). Verdicts go by it: the networks invent returns where no data are (bench/expansion.md).
//!
//! | metric | meaning |
//! |---|---|
//! | imagined return | mean return of the imagined episodes |
//! | supported return | the same until the episode is far from the target's states |
//! | survival | share of the steps of whole episodes that were reached |
//! | support | the same until the episode is far from the target's states: of how much of an episode the supported return tells |
//! | distance | median distance of the states on the way to the nearest target state, in units of the median distance between target rows of different episodes |
//! | action error | RMSE of the policy's actions at target states against the behaviour's |
//! | fitted Q | discounted return from the starts of the target's episodes, by [`mod@tce_learn::fitted_q`]: no model of the dynamics |

use std::path::{Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_base::{Streams, mean_and_error, mean_std, sha256_hex};
use tce_data::{ActionRange, Transitions, even_standardizer, hold_out_runs};
use tce_learn::{
    Domain, Dynamics, DynamicsConfig, FittedQConfig, FittedValue, Learner, Policy, PolicyActions, discounted_return,
    fitted_q, rmse, train_dynamics,
};
use tce_nn::{Device, NamedParameters};

use crate::error::{Error, Result};
use crate::inputs::{Domains, InputSpec, Inputs};
use crate::stage::Stage;

mod places;
use places::{TargetStates, bounds, episode_starts, median, source_starts, starts};

/// Share of the target rows that the ensemble does not see.
const HELD_OUT: f64 = 0.05;
/// A state is far from the target's states if its distance to the nearest one is more than so many times the median distance between
/// target states of different episodes.
pub const FAR: f64 = 20.0;
/// The quantile of the target's rewards that stands for the worst one: a single odd row decides nothing.
const WORST: f64 = 0.01;

/// The trained ensemble, with its errors on target rows that it has not seen.
pub struct OffPolicyEvaluator {
    /// The ensemble.
    pub dynamics: Dynamics,
    /// Errors of the held-out target rows, ascending, in steps.
    pub held_out: Vec<f64>,
    /// The stage with its files.
    pub stage: Stage,
    root: PathBuf,
    inputs: InputSpec,
    target: Arc<Transitions>,
    /// Its states, to which distances are measured.
    target_states: TargetStates,
    /// With the terminal rows whose s' nobody knows: values do not need it.
    complete: Arc<Transitions>,
    /// The states in which imagined episodes begin.
    starts: Vec<f32>,
    low: Vec<f32>,
    high: Vec<f32>,
    limit: usize,
    /// Whether `limit` is the length of an episode.
    whole: bool,
    /// The units of the policies' actions, where they are not the box.
    actions: Option<ActionRange>,
    /// The reward of a step outside of the models' range.
    worst: f64,
}

/// The estimates of a policy in the learned model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OffPolicyEstimate {
    /// Mean return of the imagined episodes.
    pub imagined_return: f64,
    /// Standard error of it, over the networks and the starts.
    pub standard_error: f64,
    /// Mean return until the episodes are far from the target's states.
    pub supported_return: f64,
    /// Mean share of the steps of a whole episode.
    pub survival: f64,
    /// The same until the episodes are far from the target's states.
    pub support: f64,
    /// Median distance to the nearest target state.
    pub distance: f64,
    /// RMSE of the actions at target states.
    pub action_error: f64,
    /// The return of every imagined episode, networks one after the other.
    pub returns: Vec<f64>,
    /// The supported return of every imagined episode.
    pub supported: Vec<f64>,
}

impl OffPolicyEvaluator {
    /// Trains the ensemble on the target's and, if there are any, the source's rows, or takes it from its stage.
    pub fn train(inputs: &Inputs, config: &DynamicsConfig, root: &Path, device: &Device) -> Result<Self> {
        #[derive(Serialize)]
        struct Spec<'a> {
            inputs: InputSpec,
            config: &'a DynamicsConfig,
            held_out: f64,
        }
        let spec = Spec { inputs: inputs.spec(Domains::Both), config, held_out: HELD_OUT };
        tce_base::begin_step("learned dynamics");
        let stage = Stage::open(root, "stages/dynamics", &spec, device)?;
        let target = &inputs.target.rows;
        let (kept, apart) = hold_out_runs(target.len(), HELD_OUT);
        let source = inputs.source.as_ref().map(|s| s.rows.clone());
        let scale = even_standardizer(target, source.as_deref());
        let training = Arc::new(target.select(&kept));
        let mut dynamics = Dynamics::new(training, source.clone(), scale, Streams::new(0), config, device)?;
        let file = "dynamics.safetensors";
        let path = stage.file(file);
        let held_out = match stage.summary::<Vec<f64>>()? {
            Some(errors) => {
                dynamics.restore(&NamedParameters::load(&path)?, &path)?;
                errors
            }
            None => {
                let attempt = stage.attempt()?;
                let trained = train_dynamics(dynamics, &mut attempt.checkpoints("dynamics")?, device)?;
                dynamics = trained.ok_or_else(Error::interrupted)?;
                let mut errors = dynamics.errors(&target.select(&apart), Domain::Target);
                errors.sort_by(f64::total_cmp);
                dynamics.state().save(&attempt.file(file))?;
                attempt.finish(&[file.to_owned()], &errors)?;
                errors
            }
        };
        let tables: Vec<&Transitions> = std::iter::once(&**target).chain(source.as_deref()).collect();
        let (low, high) = bounds(&tables);
        let complete = inputs.target.all_rows();
        let longest = complete.episodes().iter().map(|e| e.end - e.start).max().unwrap_or(1);
        // Rows in no order do not tell how long an episode is.
        let limit = if inputs.target.has_episodes() { Some(longest) } else { inputs.step_limit() };
        let target_states = TargetStates::of(target)?;
        let mut first = target.select(&starts(target)).observations;
        if let Some(source) = inputs.source.as_ref().filter(|s| s.has_episodes()) {
            first.extend(source_starts(&source.rows, &target_states)?);
        }
        Ok(Self {
            dynamics,
            held_out,
            stage,
            root: root.to_owned(),
            inputs: inputs.spec(Domains::Target),
            starts: first,
            worst: worst_reward(target),
            target: target.clone(),
            target_states,
            complete,
            low,
            high,
            limit: limit.unwrap_or(longest),
            whole: limit.is_some(),
            actions: inputs.actions.clone(),
        })
    }

    /// Of every row, whether its successor is no further from what the ensemble expects than `margin` times what 95 % of held-out real rows are.
    pub fn possible(&self, rows: &Transitions, margin: f64) -> Vec<bool> {
        let threshold = margin * self.held_out_error(0.95);
        self.dynamics.errors(rows, Domain::Target).into_iter().map(|error| error <= threshold).collect()
    }

    /// Why no estimate can be relied on, if so.
    pub fn doubt(&self) -> Option<String> {
        let steps = if self.limit == 1 { "one step".to_owned() } else { format!("{} steps", self.limit) };
        (!self.whole).then(|| {
            format!("The target's rows are in no order, so that policies are tried for {steps} only: give --step-limit N, the length of an episode.")
        })
    }

    /// A quantile of the errors on held-out target rows, in steps.
    pub fn held_out_error(&self, quantile: f64) -> f64 {
        let last = self.held_out.len().saturating_sub(1) as f64;
        self.held_out.get((last * quantile) as usize).copied().unwrap_or(f64::NAN)
    }

    /// Evaluates a policy in the learned model.
    pub fn evaluate(&self, policy: &Policy) -> Result<OffPolicyEstimate> {
        let t = &self.target;
        let networks = self.dynamics.members();
        let (width, act) = (t.obs_dim, t.act_dim);
        let lanes = self.starts.len() / width;
        let mut states = vec![self.starts.clone(); networks];
        let mut memories = vec![vec![policy.start(); lanes]; networks];
        let mut alive = vec![vec![true; lanes]; networks];
        let mut returns = vec![vec![0.0; lanes]; networks];
        let mut steps = vec![vec![0usize; lanes]; networks];
        let mut visited: Vec<f32> = Vec::new();
        // The episode of every visited state, with its return and steps up to there.
        let mut passed: Vec<(usize, Left)> = Vec::new();
        let mut left: Vec<Option<Left>> = vec![None; networks * lanes];
        for step in 0..self.limit {
            if alive.iter().flatten().all(|a| !a) {
                break;
            }
            let act_in = |(states, memories): (&Vec<f32>, &mut Vec<_>)| {
                let mut actions = vec![0.0; lanes * act];
                policy.act_with(states, memories, None, &mut actions);
                self.in_box(actions)
            };
            let actions: Vec<Vec<f32>> = states.par_iter().zip(memories.par_iter_mut()).map(act_in).collect();
            let tables: Vec<(&[f32], &[f32])> =
                states.iter().zip(&actions).map(|(s, a)| (s.as_slice(), a.as_slice())).collect();
            let predictions = self.dynamics.predict(&tables, Domain::Target);
            for (k, prediction) in predictions.into_iter().enumerate() {
                for lane in 0..lanes {
                    if !alive[k][lane] {
                        continue;
                    }
                    let reward = f64::from(prediction.rewards[lane]);
                    let next = &prediction.next_observations[lane * width..][..width];
                    let inside =
                        next.iter().zip(&self.low).zip(&self.high).all(|((x, low), high)| (*low..=*high).contains(x));
                    returns[k][lane] += if reward.is_finite() { reward } else { 0.0 };
                    policy.reward(&mut memories[k][lane], reward);
                    steps[k][lane] += 1;
                    alive[k][lane] = inside && !prediction.terminals[lane];
                    let (episode, here) = (k * lanes + lane, Left { so_far: returns[k][lane], steps: steps[k][lane] });
                    if !inside {
                        left[episode] = Some(here);
                    } else if step % 10 == 0 {
                        visited.extend_from_slice(next);
                        passed.push((episode, here));
                    }
                }
                // Lanes that are over stay where they are: what the networks say of them is not looked at.
                for lane in 0..lanes {
                    if alive[k][lane] {
                        states[k][lane * width..][..width]
                            .copy_from_slice(&prediction.next_observations[lane * width..][..width]);
                    }
                }
            }
        }
        let distances = if visited.is_empty() { Vec::new() } else { self.target_states.distances(&visited)? };
        let (returns, steps) = (returns.concat(), steps.concat());
        let left = self.left(left, &distances, &passed);
        let count = |(whole, left): (&f64, &Option<Left>)| left.map_or(*whole, |l| l.counted(self.worst, self.limit));
        let supported: Vec<f64> = returns.iter().zip(&left).map(count).collect();
        let known: usize = steps.iter().zip(&left).map(|(&all, left)| left.map_or(all, |l| l.steps)).sum();
        let n = returns.len() as f64;
        let share = |steps: usize| steps as f64 / (n * self.limit as f64);
        let (mean, error) = mean_and_error(&returns);
        let actions = self.actions_at(policy, &t.observations);
        Ok(OffPolicyEstimate {
            imagined_return: mean,
            standard_error: error,
            supported_return: mean_std(&supported).0,
            survival: share(steps.iter().sum()),
            support: share(known),
            distance: if visited.is_empty() { f64::INFINITY } else { median(distances) / self.target_states.spacing },
            action_error: rmse(&actions, &t.actions),
            returns,
            supported,
        })
    }
}

impl OffPolicyEvaluator {
    /// Where episodes leave what the models know: where they `left` its bounds, or where one of the states that they `passed` is far from
    /// the target's, whichever comes first. `distances` are those of the passed states, in the order of the steps.
    fn left(&self, mut left: Vec<Option<Left>>, distances: &[f32], passed: &[(usize, Left)]) -> Vec<Option<Left>> {
        for (&distance, &(episode, here)) in distances.iter().zip(passed) {
            let earlier = left[episode].is_none_or(|l| here.steps < l.steps);
            if earlier && f64::from(distance) > FAR * self.target_states.spacing {
                left[episode] = Some(here);
            }
        }
        left
    }

    /// The mean actions of a policy, in the box of the rows. A policy that remembers its episode acts as in a first state.
    fn actions_at(&self, policy: &Policy, observations: &[f32]) -> Vec<f32> {
        let mut actions = vec![0.0; observations.len() / self.target.obs_dim * self.target.act_dim];
        policy.act(observations, None, &mut actions);
        self.in_box(actions)
    }

    /// A policy's actions in the box of the rows.
    fn in_box(&self, mut actions: Vec<f32>) -> Vec<f32> {
        self.actions.iter().for_each(|range| range.to_unit(&mut actions));
        actions.iter_mut().for_each(|a| *a = a.clamp(-1.0, 1.0));
        actions
    }

    /// Estimates the policies' values by fitted Q evaluation on the target's rows, as one stage.
    ///
    /// # Errors
    /// If a file cannot be read or written, or the user interrupts.
    pub fn values(&self, policies: &[Policy], config: &FittedQConfig, device: &Device) -> Result<Vec<FittedValue>> {
        #[derive(Serialize)]
        struct Spec<'a> {
            inputs: &'a InputSpec,
            policies: Vec<String>,
            config: &'a FittedQConfig,
            #[serde(skip_serializing_if = "Option::is_none")]
            complete_rows: Option<usize>,
        }
        let t = &self.complete;
        let starts = episode_starts(t);
        let first = t.select(&starts).observations;
        let actions = |policy: &Policy| PolicyActions {
            next: self.actions_at(policy, &t.next_observations),
            start: self.actions_at(policy, &first),
        };
        let actions: Vec<_> = policies.iter().map(actions).collect();
        let hash = |a: &PolicyActions| {
            sha256_hex(&a.next.iter().chain(&a.start).flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>())
        };
        // Its actions at these rows are all that decides a policy's value.
        let complete_rows = (t.len() > self.target.len()).then_some(t.len());
        let spec = Spec { inputs: &self.inputs, policies: actions.iter().map(hash).collect(), config, complete_rows };
        tce_base::begin_step("fitted Q");
        let stage = Stage::open(&self.root, "stages/fitted-q", &spec, device)?;
        if let Some(values) = stage.summary()? {
            return Ok(values);
        }
        let attempt = stage.attempt()?;
        let mut checkpoints = attempt.checkpoints("fitted-q")?;
        let values = fitted_q(t, &starts, &actions, config, Streams::new(0), &mut checkpoints, device)?;
        let values = values.ok_or_else(Error::interrupted)?;
        attempt.finish(&[], &values)?;
        Ok(values)
    }

    /// The discounted return of the target's episodes as they were logged, to hold fitted values against.
    pub fn behaviour_value(&self, config: &FittedQConfig) -> f64 {
        discounted_return(&self.complete, config.discount)
    }
}

/// Where an imagined episode left the states that the models know.
#[derive(Clone, Copy, Debug)]
struct Left {
    /// Its return up to there.
    so_far: f64,
    /// Its steps up to there.
    steps: usize,
}

impl Left {
    /// Its return, where every further one of `limit` steps is worth `worst`.
    fn counted(self, worst: f64, limit: usize) -> f64 {
        self.so_far + worst * limit.saturating_sub(self.steps) as f64
    }
}

/// The reward of a step that nobody knows anything of: 0, or less where the target's rows have such rewards.
fn worst_reward(target: &Transitions) -> f64 {
    let mut rewards = target.rewards.clone();
    rewards.sort_by(f32::total_cmp);
    rewards.get((rewards.len() as f64 * WORST) as usize).map_or(0.0, |&r| f64::from(r).min(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leaving_the_data_early_never_pays() {
        let rewards = |reward: f32| {
            let mut t = Transitions::new(1, 1);
            (0..200).for_each(|k| t.push(&[0.0], &[0.0], if k == 7 { -1e6 } else { reward }, &[0.0], false, false));
            worst_reward(&t)
        };
        // Rewards above 0: what is left is worth nothing, and one odd row does not change that.
        assert_eq!(Left { so_far: 30.0, steps: 10 }.counted(rewards(3.0), 100), 30.0);
        // Costs: an episode that leaves after 10 steps costs as much as one that stays.
        assert_eq!(Left { so_far: -20.0, steps: 10 }.counted(rewards(-2.0), 100), -200.0);
    }
}
