//! What rows are measured by: transition models of both domains, a reward model and a value function.
//!
//! | model | rows |
//! |---|---|
//! | limited | the target rows |
//! | thirds, three of them | the target rows without a third of the episodes each |
//! | abundant | what the simulator makes of states and actions of target, source and generated rows |
//! | source | source rows |
//! | generated | generated rows |
//! | value | V of IQL on target and generated rows |
//!
//! The limited model is what a user has. The generator saw the rows that it saw, so that both may err alike; the three that lack a third
//! say where what they agree on is no more than what each of them was told, and on the rows that they lack how wrong they are. V is that
//! of implicit Q-learning with standardised states, whatever the run's own learner does.

use std::sync::Arc;

use tce_base::Streams;
use tce_data::{Agent, Shift, Standardizer, Transitions, even_standardizer};
use tce_diagnosis::Rated;
use tce_diagnosis::gaussian::Normals;
use tce_learn::{
    Buffer, Densities, Iql, IqlConfig, LabelConfig, LabelModels, Member, Regulariser, RegulariserKind, Steps,
    TerminalHandling, TransitionModel, map_rows, train, train_labels, train_transition_models,
};
use tce_nn::Device;
use tce_sim::{Simulated, simulate, terminal_rule};

use super::rows::Batch;
use super::work::{Sources, Work, few};
use crate::config::Config;
use crate::error::{Error, Result};
use crate::stage::Attempt;

/// The source's model gets as many rows at least, where there are as many, however few abundant rows are asked for.
const FEWEST_SOURCES: usize = 1000;
/// Parts of the target rows, and models that lack one of them.
const THIRDS: usize = 3;

/// The trained models.
pub struct Models {
    transition: TransitionModel,
    /// Members of the population.
    pub limited: usize,
    thirds: [usize; THIRDS],
    pub generated: usize,
    pub source: Option<usize>,
    pub abundant: Option<usize>,
    /// Live dimensions.
    dim: usize,
    members: usize,
    rewards: Option<LabelModels>,
    value: Iql,
    value_rows: Buffer,
    device: Device,
    /// True target transitions from source states, and from generated ones.
    pub at_source: Option<Transitions>,
    pub at_generated: Option<Transitions>,
}

/// What the target's dynamics do at the states and actions of `t`; rows in which the physics blows up are left out.
fn under_target((agent, shift): (Agent, Shift), t: &Transitions) -> Result<Transitions> {
    let truth = simulate(agent, shift, &t.observations, &t.actions)?;
    let held: Vec<usize> = (0..t.len()).filter(|&i| truth.held(i)).collect();
    let all = Transitions {
        next_observations: truth.next_observations,
        rewards: truth.rewards,
        timeouts: truth.terminals.iter().map(|t| !t).collect(),
        terminals: truth.terminals,
        ..t.clone()
    };
    Ok(all.select(&held))
}

/// What the simulator makes of rows.
#[derive(Default)]
struct Simulation {
    /// True target transitions from source states.
    at_source: Option<Transitions>,
    /// True target transitions from generated states.
    at_generated: Option<Transitions>,
    /// Abundant target rows.
    abundant: Option<Arc<Transitions>>,
}

impl Simulation {
    /// Of the states and actions of target, generated and `source` rows; `sources` are those that are measured.
    fn of(
        work: &Work,
        place: (Agent, Shift),
        sources: Option<&Sources>,
        source: Option<&Transitions>,
        own: &Batch,
        widest: f32,
    ) -> Result<Self> {
        let streams = Streams::new(work.subject.seed).child("diagnosis/models");
        let many = work.options.abundant / 2;
        let wide = work.sampler.sample(many.max(own.len()), widest, "abundant")?.rows;
        let mut all = Transitions::clone(&work.subject.inputs.target.rows);
        all.extend(&under_target(place, &wide)?);
        if let Some(source) = source {
            all.extend(&under_target(place, source)?);
        }
        let at_source = |s: &Sources| under_target(place, &few(&s.sorted, own.len(), &streams, "at source"));
        Ok(Self {
            at_source: sources.map(at_source).transpose()?,
            at_generated: Some(under_target(place, &own.kept_rows())?),
            abundant: Some(Arc::new(all)),
        })
    }
}

/// A reward model of the abundant rows.
fn abundant_rewards(
    rows: &Arc<Transitions>,
    config: &Config,
    streams: &Streams,
    attempt: &Attempt,
    device: &Device,
) -> Result<LabelModels> {
    let member = Member {
        streams: streams.child("abundant rewards"),
        parts: vec![rows.clone()],
        standardizer: Standardizer::identity(rows.obs_dim),
        reward_scale: 1.0,
        row_scores: None,
    };
    let labels = LabelConfig { learn_terminals: false, ..config.labels.training.clone() };
    let trained = train_labels(&[member], &labels, &mut attempt.checkpoints("abundant-labels")?, device)?;
    trained.ok_or_else(Error::interrupted)
}

/// V of IQL on target and generated rows, and these rows.
fn value_function(
    work: &Work,
    target: &Arc<Transitions>,
    generated: &Arc<Transitions>,
    streams: &Streams,
    attempt: &Attempt,
    device: &Device,
) -> Result<(Iql, Buffer)> {
    let config = work.subject.config;
    let member = Member {
        streams: streams.child("value"),
        standardizer: even_standardizer(target, Some(generated)),
        parts: vec![target.clone(), generated.clone()],
        reward_scale: 1.0,
        row_scores: None,
    };
    let rows = Buffer::new(vec![member], config.learner.batch)?;
    let iql = IqlConfig { regulariser: RegulariserKind::None, ..config.learner.iql.clone() };
    let mut value = Iql::new(&rows, &iql, Regulariser::None, work.options.value_steps, device)?;
    let steps = Steps::new(work.options.value_steps, 0);
    let mut checkpoints = attempt.checkpoints("value")?;
    let outcome = train(&mut value, &rows, steps, "value", &mut checkpoints, device, |_, _| Ok::<_, Error>(()))?;
    match outcome.interrupted {
        true => Err(Error::interrupted()),
        false => Ok((value, rows)),
    }
}

impl Models {
    /// Trains them all. `own` are generated rows under the run's own bound; the abundant rows reach up to the bound `widest`.
    pub fn train(
        work: &Work,
        sources: Option<&Sources>,
        own: &Batch,
        widest: f32,
        attempt: &Attempt,
        device: &Device,
    ) -> Result<Self> {
        let (inputs, config, options) = (work.subject.inputs, work.subject.config, work.options);
        let streams = Streams::new(work.subject.seed).child("diagnosis/models");
        let target = Arc::new(inputs.target.rows.clone());
        let many = options.abundant / 2;
        // Other rows than those that are measured: a model must not be asked about what it was trained on.
        let generated = work.sampler.sample(many.max(own.len()), config.generator.y_max, "training")?;
        generated.ensure_kept(&config.filter)?;
        let generated = generated.kept_rows();
        let source = sources.map(|s| few(&s.others, many.max(FEWEST_SOURCES), &streams, "source rows"));
        let Simulation { at_source, at_generated, abundant } = match work.simulator {
            Some(place) => Simulation::of(work, place, sources, source.as_ref(), own, widest)?,
            None => Simulation::default(),
        };
        let standardizer = even_standardizer(&inputs.target.rows, inputs.source.as_ref().map(|s| &*s.rows));
        let mut members = Vec::new();
        let mut add = |name: &str, rows: &Arc<Transitions>| {
            members.push(Member {
                streams: streams.child(name),
                parts: vec![rows.clone()],
                standardizer: standardizer.clone(),
                reward_scale: 1.0,
                row_scores: None,
            });
            members.len() - 1
        };
        let limited = add("limited", &target);
        let third_of = thirds(&target);
        let thirds = [0, 1, 2].map(|k| {
            let others: Vec<usize> = (0..target.len()).filter(|&i| third_of[i] != k).collect();
            add(&format!("without third {k}"), &Arc::new(target.select(&others)))
        });
        let generated = Arc::new(generated);
        let of_generated = add("generated", &generated);
        let of_source = source.map(|s| add("source", &Arc::new(s)));
        let of_abundant = abundant.as_ref().map(|a| add("abundant", a));
        let count = members.len();
        let mut checkpoints = attempt.checkpoints("transition-models")?;
        let transition = train_transition_models(members, &options.transition, &mut checkpoints, device)?;
        let transition = transition.ok_or_else(Error::interrupted)?;

        let rewards = match &abundant {
            None => None,
            Some(rows) => Some(abundant_rewards(rows, config, &streams, attempt, device)?),
        };
        let (value, value_rows) = value_function(work, &target, &generated, &streams, attempt, device)?;
        Ok(Self {
            dim: transition.dim(),
            transition,
            limited,
            thirds,
            generated: of_generated,
            source: of_source,
            abundant: of_abundant,
            members: count,
            rewards,
            value,
            value_rows,
            device: device.clone(),
            at_source,
            at_generated,
        })
    }

    /// The densities of every member for the same states and actions.
    pub fn densities(&self, states: &[f32], actions: &[f32]) -> Vec<Densities> {
        self.transition.densities(&vec![(states, actions); self.members])
    }

    /// As the measures take them.
    pub fn normals<'a>(&self, densities: &'a Densities) -> Normals<'a> {
        Normals { mean: &densities.mean, log_std: &densities.log_std, dim: self.dim }
    }

    /// R(s, s') of the model of the abundant rows.
    pub fn abundant_rewards(&self, t: &Transitions) -> Result<Option<Vec<f32>>> {
        let Some(models) = &self.rewards else { return Ok(None) };
        let pair = (t.observations.clone(), t.next_observations.clone());
        Ok(Some(models.label(&[pair], TerminalHandling::None)?.remove(0).transitions.rewards))
    }

    /// V(s'), 0 where the episode is over.
    fn values(&self, states: &[f32], terminals: &[bool]) -> Vec<f64> {
        let table = self.value_rows.network_inputs(0, states);
        let width = self.value_rows.inputs().len();
        let values = map_rows(&[table], width, &self.device, |_, s| self.value.values(s)).remove(0);
        values.iter().zip(terminals).map(|(v, t)| if *t { 0.0 } else { f64::from(*v) }).collect()
    }

    /// |V(s') − V(truth)| of every row of `t`; NaN where the physics blew up.
    pub fn value_gap(&self, t: &Transitions, truth: &Simulated) -> Vec<f64> {
        let own = self.values(&t.next_observations, &t.terminals);
        gaps(&own, &self.values(&truth.next_observations, &truth.terminals), truth)
    }

    /// V at the successors that each of the thirds predicts, per model. `densities` are those of `t`.
    fn predicted_values(&self, t: &Transitions, densities: &[Densities], agent: Option<Agent>) -> Vec<Vec<f64>> {
        let of = |&m: &usize| {
            let next = self.transition.next_observations(&t.observations, &densities[m]);
            self.values(&next, &successor_terminals(agent, t, &next))
        };
        self.thirds.iter().map(of).collect()
    }

    /// [`Models::value_gap`] with the truth as the thirds see it, V(μ) of each: the mean of their gaps, and as a doubt how far they are
    /// apart, the mean over their pairs. V at a mean is not the mean of V; where the world is deterministic the two are one.
    pub fn value_gap_alone(&self, t: &Transitions, densities: &[Densities], agent: Option<Agent>) -> Rated {
        let own = self.values(&t.next_observations, &t.terminals);
        let predicted = self.predicted_values(t, densities, agent);
        let gap = |i: usize| predicted.iter().map(|v| (own[i] - v[i]).abs()).sum::<f64>() / predicted.len() as f64;
        let doubt = (0..t.len()).map(|i| disagreement(&predicted, i)).collect();
        Rated { doubt, ..Rated::certain((0..t.len()).map(gap).collect()) }
    }

    /// How far the thirds are apart in the successors of `t`, in steps ([`super::generator::step_errors`]): the mean over their pairs.
    pub fn successors_apart(&self, t: &Transitions, step: &[f32], live: &[usize]) -> Vec<f64> {
        let densities = self.densities(&t.observations, &t.actions);
        let predicted = self.thirds.map(|m| self.transition.next_observations(&t.observations, &densities[m]));
        let of = |a: usize, b: usize| {
            let other = Transitions { next_observations: predicted[b].clone(), ..t.clone() };
            super::generator::step_errors(&predicted[a], &other, step, live)
        };
        let all = [of(1, 0), of(2, 0), of(2, 1)];
        (0..t.len()).map(|i| all.iter().map(|v| v[i]).sum::<f64>() / all.len() as f64).collect()
    }

    /// Mean gap of target rows by the model that lacks them, and how far that is from the other two: how much of a model's error their
    /// disagreement shows.
    pub fn held_out(&self, target: &Transitions, agent: Option<Agent>) -> Option<(f64, f64)> {
        let own = self.values(&target.next_observations, &target.terminals);
        let densities = self.densities(&target.observations, &target.actions);
        finite(held_out_rates(&own, &self.predicted_values(target, &densities, agent), &thirds(target)))
    }
}

/// What JSON can hold: models that have diverged say nothing.
pub fn finite(pair: (f64, f64)) -> Option<(f64, f64)> {
    (pair.0.is_finite() && pair.1.is_finite()).then_some(pair)
}

/// |own − other| where the physics held; NaN elsewhere, and not the |own| that an episode which is over would leave.
fn gaps(own: &[f64], other: &[f64], truth: &Simulated) -> Vec<f64> {
    let gap = |(i, (a, b)): (usize, (&f64, &f64))| if truth.held(i) { (a - b).abs() } else { f64::NAN };
    own.iter().zip(other).enumerate().map(gap).collect()
}

/// [`Models::held_out`] from numbers. The two models that have seen a row agree on it, as no two models do elsewhere: only their distances
/// from the one that has not seen it count.
fn held_out_rates(own: &[f64], predicted: &[Vec<f64>], lacks: &[usize]) -> (f64, f64) {
    let n = own.len() as f64;
    let without = |i: usize| predicted[lacks[i]][i];
    let gap = (0..own.len()).map(|i| (own[i] - without(i)).abs()).sum::<f64>() / n;
    let apart =
        |i: usize| predicted.iter().map(|v| (v[i] - without(i)).abs()).sum::<f64>() / (predicted.len() - 1) as f64;
    (gap, (0..own.len()).map(apart).sum::<f64>() / n)
}

/// Mean |difference| over the pairs of models in row `i`.
fn disagreement(models: &[Vec<f64>], i: usize) -> f64 {
    let pairs = (0..models.len()).flat_map(|a| (0..a).map(move |b| (a, b)));
    let (sum, count) = pairs.fold((0.0, 0), |(s, n), (a, b)| (s + (models[a][i] - models[b][i]).abs(), n + 1));
    sum / f64::from(count.max(1))
}

/// Whether the episode is over at predicted successors of `t`: by the agent's rule, or, where there is none, wherever `t` itself says
/// so. A model of states alone cannot know; with the same flag on both sides it makes no difference.
fn successor_terminals(agent: Option<Agent>, t: &Transitions, next: &[f32]) -> Vec<bool> {
    match agent {
        Some(agent) => next.chunks_exact(t.obs_dim).map(|s| terminal_rule(agent, s)).collect(),
        None => t.terminals.clone(),
    }
}

/// The third that each row belongs to: whole episodes, whose rows are alike; equal parts of the log where it has fewer than three, or
/// where whole episodes would leave a model less than half of the rows.
fn thirds(t: &Transitions) -> Vec<usize> {
    let n = t.len();
    let by_place = |i: usize| i * THIRDS / n;
    let equal = || (0..n).map(by_place).collect::<Vec<_>>();
    let episodes = t.episodes();
    if episodes.len() < THIRDS {
        return equal();
    }
    // By the middle of each, so that the parts are as equal as whole episodes allow; every part gets one at least.
    let last = episodes.len() - 1;
    let part = |(k, e): (usize, &tce_data::Episode)| match k {
        0 => 0,
        k if k == last => THIRDS - 1,
        _ => by_place((e.start + e.end) / 2),
    };
    let mut parts: Vec<usize> = episodes.iter().enumerate().map(part).collect();
    if !parts.contains(&1) {
        let place = parts.iter().rposition(|p| *p == 0).filter(|p| *p > 0).unwrap_or(1);
        parts[place] = 1;
    }
    let whole: Vec<usize> = episodes.iter().zip(parts).flat_map(|(e, part)| vec![part; e.end - e.start]).collect();
    let most = (0..THIRDS).map(|k| whole.iter().filter(|p| **p == k).count()).max().expect("parts");
    if 2 * most > n { equal() } else { whole }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A table of episodes of these lengths.
    pub fn log(lengths: &[usize]) -> Transitions {
        let mut t = Transitions::new(1, 1);
        for &length in lengths {
            (0..length).for_each(|i| t.push(&[0.0], &[0.0], 0.0, &[0.0], false, i + 1 == length));
        }
        t
    }

    #[test]
    fn thirds_are_whole_episodes_and_none_is_empty() {
        assert_eq!(thirds(&log(&[2, 2, 2])), [0, 0, 1, 1, 2, 2]);
        assert_eq!(thirds(&log(&[1; 6])), [0, 0, 1, 1, 2, 2]);
        assert_eq!(thirds(&log(&[4, 1, 4])), [[0; 4].as_slice(), &[1], &[2; 4]].concat());
        assert_eq!(thirds(&log(&[4, 2])), [0, 0, 1, 1, 2, 2], "too few episodes");
    }

    /// A model of the few rows that are not in the one long episode would be no model.
    #[test]
    fn no_model_lacks_more_than_half_of_the_rows() {
        for lengths in [[998, 1, 1], [1, 1, 998], [1, 998, 1], [200, 600, 200]] {
            let found = thirds(&log(&lengths));
            let counts = [0, 1, 2].map(|k| found.iter().filter(|p| **p == k).count());
            assert!(counts.iter().all(|c| (333..=334).contains(c)), "{lengths:?}: {counts:?}");
        }
    }

    /// The model of the first row lacks it and is off by 2; the others, which have seen it, are off by 0 and 1, that is 2 and 1 from the first.
    #[test]
    fn held_out_rows_are_rated_by_the_models_that_lack_them() {
        let predicted = [vec![7.0, 3.0], vec![5.0, 3.0], vec![6.0, 3.0]];
        let (gap, apart) = held_out_rates(&[5.0, 4.0], &predicted, &[0, 2]);
        assert!((gap - (2.0 + 1.0) / 2.0).abs() < 1e-12 && (apart - (1.5 + 0.0) / 2.0).abs() < 1e-12, "{gap} {apart}");
    }

    #[test]
    fn rows_in_which_the_physics_blew_up_have_no_gap() {
        let truth = Simulated {
            next_observations: vec![0.0, f32::NAN],
            rewards: vec![1.0, f32::NAN],
            terminals: vec![true, true],
        };
        let found = gaps(&[3.0, 3.0], &[0.0, 0.0], &truth);
        assert!(
            found[0] == 3.0 && found[1].is_nan(),
            "an end by the rule is one, a fault of the physics is none: {found:?}"
        );
    }

    #[test]
    fn the_disagreement_is_the_mean_over_the_pairs() {
        let models = [vec![0.0, 1.0], vec![1.0, 1.0], vec![4.0, 1.0]];
        assert!((disagreement(&models, 0) - (1.0 + 4.0 + 3.0) / 3.0).abs() < 1e-12);
        assert_eq!(disagreement(&models, 1), 0.0);
    }

    /// The same flag on both sides where there is no rule: V of a row that is over is 0 twice.
    #[test]
    fn successors_of_an_own_robot_are_over_where_the_rows_are() {
        let mut t = log(&[2]);
        t.terminals = vec![true, false];
        assert_eq!(successor_terminals(None, &t, &t.next_observations), t.terminals);
        let mut hopper = Transitions::new(11, 3);
        hopper.push(&[0.0; 11], &[0.0; 3], 0.0, &[0.0; 11], false, true);
        assert_eq!(successor_terminals(Some(Agent::Hopper), &hopper, &[0.0; 11]), [true], "it lies on the ground");
    }
}
