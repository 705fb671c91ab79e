//! What rows are measured by: transition models of both domains, a reward model and a value function.
//!
//! | model | rows |
//! |---|---|
//! | limited, three of them | the target rows |
//! | abundant | what the simulator makes of states and actions of target, source and generated rows |
//! | source | source rows |
//! | generated | generated rows |
//! | value | V of IQL on target and generated rows |
//!
//! The limited model is what a user has. Three of them differ in their initial weights and batches alone.

use std::sync::Arc;

use tce_base::Streams;
use tce_data::{Agent, Standardizer, Transitions};
use tce_diagnosis::gaussian::Normals;
use tce_learn::{
    Buffer, Densities, Iql, IqlConfig, LabelModels, Member, Regulariser, RegulariserKind, Steps, TerminalHandling,
    TransitionModel, map_rows, train, train_labels, train_transition_models,
};
use tce_nn::Device;
use tce_sim::{simulate, terminal_rule};

use super::measures::{Work, few};
use super::rows::Batch;
use crate::error::{Error, Result};
use crate::stage::Attempt;
use crate::units::even_standardizer;

/// Fewer source rows than this make no model.
const FEWEST_SOURCES: usize = 1000;
/// Members of the population that are trained on the target rows.
const LIMITED: usize = 3;

/// The trained models.
pub struct Models {
    transition: TransitionModel,
    /// Members of the population.
    pub limited: [usize; LIMITED],
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
fn under_target((agent, shift): (Agent, tce_data::Shift), t: &Transitions) -> Result<Transitions> {
    let truth = simulate(agent, shift, &t.observations, &t.actions)?;
    let all = Transitions {
        next_observations: truth.next_observations,
        rewards: truth.rewards,
        timeouts: truth.terminals.iter().map(|t| !t).collect(),
        terminals: truth.terminals,
        ..t.clone()
    };
    Ok(all.select(&(0..all.len()).filter(|&i| all.rewards[i].is_finite()).collect::<Vec<_>>()))
}

impl Models {
    /// Trains them all. `own` are generated rows under the run's own bound; the abundant rows reach up to the bound `widest`.
    pub fn train(
        work: &Work,
        sources: Option<&Transitions>,
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
        let generated = work.sampler.sample(many.max(own.len()), config.generator.y_max, "training")?.kept_rows();
        let source = (inputs.source.as_ref()).map(|s| few(&s.rows, many.max(FEWEST_SOURCES), &streams, "source rows"));
        let (mut at_source, mut at_generated, mut abundant) = (None, None, None);
        if let Some(place) = work.simulator {
            let wide = work.sampler.sample(many.max(own.len()), widest, "abundant")?.rows;
            let mut all = inputs.target.rows.clone();
            all.extend(&under_target(place, &wide)?);
            if let Some(source) = &source {
                all.extend(&under_target(place, source)?);
            }
            abundant = Some(Arc::new(all));
            at_source = sources.map(|s| under_target(place, &few(s, own.len(), &streams, "at source"))).transpose()?;
            at_generated = Some(under_target(place, &own.kept_rows())?);
        }
        let standardizer = even_standardizer(&inputs.target.rows, inputs.source.as_ref().map(|s| &s.rows));
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
        let limited = ["limited 0", "limited 1", "limited 2"].map(|name| add(name, &target));
        let generated = Arc::new(generated);
        let of_generated = add("generated", &generated);
        let of_source = source.map(|s| add("source", &Arc::new(s)));
        let of_abundant = abundant.as_ref().map(|a| add("abundant", a));
        let count = members.len();
        let mut checkpoints = attempt.checkpoints("transition-models")?;
        let transition = train_transition_models(members, &options.transition, &mut checkpoints, device)?;
        let transition = transition.ok_or(Error::Interrupted)?;

        let rewards = match &abundant {
            None => None,
            Some(rows) => {
                let member = Member {
                    streams: streams.child("abundant rewards"),
                    parts: vec![rows.clone()],
                    standardizer: Standardizer::identity(target.obs_dim),
                    reward_scale: 1.0,
                    row_scores: None,
                };
                let mut checkpoints = attempt.checkpoints("abundant-labels")?;
                let labels = tce_learn::LabelConfig { learn_terminals: false, ..config.labels.training.clone() };
                let trained = train_labels(&[member], &labels, &mut checkpoints, device)?;
                Some(trained.ok_or(Error::Interrupted)?)
            }
        };

        let member = Member {
            streams: streams.child("value"),
            parts: vec![target.clone(), generated],
            standardizer: Standardizer::fit(&target.observations, target.obs_dim),
            reward_scale: 1.0,
            row_scores: None,
        };
        let value_rows = Buffer::new(vec![member], config.learner.batch)?;
        let iql = IqlConfig { regulariser: RegulariserKind::None, ..config.learner.iql.clone() };
        let mut value = Iql::new(&value_rows, &iql, Regulariser::None, options.value_steps, device)?;
        let steps = Steps::new(options.value_steps, 0);
        let mut checkpoints = attempt.checkpoints("value")?;
        let outcome =
            train(&mut value, &value_rows, steps, "value", &mut checkpoints, device, |_, _| Ok::<_, Error>(()))?;
        if outcome.interrupted {
            return Err(Error::Interrupted);
        }
        Ok(Self {
            dim: transition.dim(),
            transition,
            limited,
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

    /// |V(s') − V(truth)| of every row of `t`.
    pub fn value_gap(&self, t: &Transitions, truth: &[f32], terminals: &[bool]) -> Vec<f64> {
        let (own, other) = (self.values(&t.next_observations, &t.terminals), self.values(truth, terminals));
        own.iter().zip(other).map(|(a, b)| (a - b).abs()).collect()
    }

    /// The same with the truth as the limited models see it: their mean of V at their mean successors. `densities` are those of `t`.
    pub fn value_gap_alone(&self, t: &Transitions, densities: &[Densities], agent: Option<Agent>) -> Vec<f64> {
        let own = self.values(&t.next_observations, &t.terminals);
        let mut mean = vec![0.0; t.len()];
        for &m in &self.limited {
            let next = self.transition.next_observations(&t.observations, &densities[m]);
            let over = |s: &[f32]| agent.is_some_and(|agent| terminal_rule(agent, s));
            let terminals: Vec<bool> = next.chunks_exact(t.obs_dim).map(over).collect();
            let values = self.values(&next, &terminals);
            mean.iter_mut().zip(values).for_each(|(m, v)| *m += v / self.limited.len() as f64);
        }
        own.iter().zip(mean).map(|(a, b)| (a - b).abs()).collect()
    }
}
