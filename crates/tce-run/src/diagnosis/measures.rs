//! Every figure of a diagnosis.

use rand::seq::SliceRandom;
use tce_augment::score_training::held_out_rows;
use tce_augment::units::Units;
use tce_base::random::choose;
use tce_base::{Streams, begin_step};
use tce_data::{NeighbourOptions, Rows, Transitions, nn_distances, zscore_keep};
use tce_diagnosis::bounds::calibration;
use tce_diagnosis::{
    AtBound, Bounds, Choice, Coverage, Curve, Diagnosis, Embedding, ErrorOverDistance, Group, Histogram, Implied,
    Labels, Rated, Reliability, Sampled, Spread, coverage, gaussian, memorisation,
};
use tce_learn::{Densities, rmse};
use tce_nn::Device;
use tce_zoo::actors::Arena;

use super::implied::{DRAWS, ImpliedActor, implied_actions, rollout_implied};
use super::models::{Models, finite};
use super::rows::Batch;
use super::work::{Sources, Work, few};
use super::{Subject, generator};
use crate::config::SourceRows;
use crate::error::Result;
use crate::mixture::distances;

/// Reference states of each domain behind a coverage.
const REFERENCE: usize = 2000;
/// The steps of a diagnosis, after those of the run.
pub const PARTS: [&str; 5] =
    ["rows to measure", "transition models", "coverage and reliability", "choice of λ", "pictures and implied policy"];
/// Points of each group in a picture.
const POINTS: usize = 400;
/// Source rows behind Theorem 1.
const SOURCES: usize = 20_000;
/// The share of source rows that is called nearest where the run itself has no λ.
const NEAREST: f64 = 0.05;

/// Equally many states of each domain that coverage is counted over, and target rows that are none of them.
struct References {
    rows: usize,
    target: coverage::Reference,
    source: Option<coverage::Reference>,
    other_target: Transitions,
    /// Whether the other target rows are of other episodes.
    by_episode: bool,
}

impl References {
    /// Coverage by `covering`; None if they are fewer than the reference rows.
    fn covered_by(&self, covering: &Transitions, units: &Units, streams: &Streams) -> Result<Option<Coverage>> {
        if covering.len() < self.rows {
            return Ok(None);
        }
        let states = units.states(&few(covering, self.rows, streams, "covering").observations);
        let source = self.source.as_ref().map(|s| s.covered_by(&states)).transpose()?;
        Ok(Some(Coverage { target: self.target.covered_by(&states)?, source }))
    }
}

impl Work<'_> {
    fn units(&self) -> &Units {
        &self.sampler.generator.units
    }

    /// Trains the models, and measures.
    pub fn done(
        &self,
        label_errors: Option<tce_learn::LabelErrors>,
        attempt: &crate::stage::Attempt,
        device: &Device,
    ) -> Result<Diagnosis> {
        let Self { subject, options, sampler, .. } = self;
        let Subject { inputs, config, seed, .. } = **subject;
        let streams = Streams::new(seed).child("diagnosis");
        let target = &inputs.target.rows;
        let mut notes = Vec::new();
        let mut grid = options.y_max.clone();
        grid.extend([0.0, config.generator.y_max]);
        grid.sort_by(f32::total_cmp);
        grid.dedup();
        begin_step(PARTS[0]);
        let batches = grid.iter().map(|&y| sampler.sample(options.rows, y, "figures")).collect::<Result<Vec<_>>>()?;
        let at = |y: f32| grid.iter().position(|g| *g == y).expect("on the grid");
        let own = &batches[at(config.generator.y_max)];
        own.ensure_kept(&config.filter)?;
        for (y, batch) in grid.iter().zip(&batches).filter(|(_, b)| b.lost > 0) {
            notes.push(format!(
                "{} of {} rows generated with y_max = {y} hold numbers that are not finite. They count as rejected, and are part of no \
                 other figure.",
                batch.lost, options.rows
            ));
        }
        let sources = self.sources(&streams)?;
        begin_step(PARTS[1]);
        let models = Models::train(self, sources.as_ref(), own, *grid.last().expect("a grid"), attempt, device)?;
        if self.simulator.is_none() {
            let why =
                if options.simulator { "its task is not one of the benchmark's" } else { "it was not to be used" };
            notes.push(format!(
                "Without the simulator ({why}) there are no abundant target rows: no transition KL, no reward error, no consistency, \
                 and Theorem 1 by models of the target rows alone."
            ));
        }
        begin_step(PARTS[2]);
        // As many as every bound has, but for those of which the filter leaves next to nothing.
        let kept = batches.iter().map(Batch::kept).filter(|k| 2 * k >= own.kept()).min().expect("the run's own");
        let references = self.references(&streams, sources.as_ref(), kept)?;
        match &references {
            None => notes.push("There are too few rows for a coverage.".into()),
            Some(r) if !r.by_episode => notes.push(
                "The target's episodes cannot be split into halves: its coverage by other target rows is by rows of the same episodes, \
                 and more than fresh rows would cover."
                    .into(),
            ),
            Some(_) => (),
        }
        let covered =
            |rows: &Transitions| references.as_ref().map_or(Ok(None), |r| r.covered_by(rows, self.units(), &streams));
        let covered_by_target = references.as_ref().map_or(Ok(None), |r| covered(&r.other_target))?;
        let held_out = self.held_out()?;
        if held_out.is_none() {
            notes.push("One episode has most of the target rows: there are no held-out rows to tell copies by.".into());
        }
        let distances = self.distances_to_real(&batches)?;
        let step = generator::step_std(target, &self.units().live);
        let mut bounds_of_y = Vec::new();
        for ((&y, batch), distances) in grid.iter().zip(&batches).zip(&distances) {
            let figures = Figures::of(batch, distances, &models, &step, &self.units().live)?;
            let kept = batch.kept_rows();
            let judge = |h: &memorisation::HeldOut| h.judge(&pairs(self.units(), &kept), &streams);
            let coverage = covered(&kept)?;
            if references.is_some() && coverage.is_none() {
                notes.push(format!("With y_max = {y} the filter leaves {} rows: too few for a coverage.", kept.len()));
            }
            bounds_of_y.push(AtBound {
                y_max: decimal(y),
                lost: batch.lost,
                coverage,
                rejected: batch.rejected(),
                memorisation: held_out.as_ref().map(judge).transpose()?.flatten(),
                kept: figures.reliability(batch, true),
                outliers: (batch.kept() < batch.len()).then(|| figures.reliability(batch, false)),
            });
        }
        begin_step(PARTS[3]);
        let theorem = sources.as_ref().map(|s| self.theorem(s, own, &models, &streams)).transpose()?;
        if theorem.is_none() {
            notes.push("Without source rows there is no λ to choose.".into());
        }
        notes.extend(left_out(own, theorem.as_ref(), self.simulator.is_some()));
        begin_step(PARTS[4]);
        let mut states = Vec::new();
        for y in [0.0, config.generator.y_max, *grid.last().expect("a grid")] {
            if states.iter().all(|(other, _)| *other != decimal(y)) {
                let picture = self.picture(&batches[at(y)], sources.as_ref(), &streams, false);
                states.extend(picture.map(|p| (decimal(y), p)));
            }
        }
        Ok(Diagnosis {
            of: subject.of.clone(),
            task: subject.task,
            seed,
            y_max: decimal(config.generator.y_max),
            z_threshold: config.filter.enabled.then_some(config.filter.z_threshold),
            lambda: config.mixture.lambda,
            rows: options.rows,
            target_rows: target.len(),
            coverage_rows: references.as_ref().map_or(0, |r| r.rows),
            covered_by_target,
            covered_by_fresh: references.as_ref().is_some_and(|r| r.by_episode),
            bounds_of_y,
            sampled: self.sampled(own),
            transitions: self.picture(own, sources.as_ref(), &streams, true),
            states,
            labels: self.labels(label_errors, own, &models)?,
            implied: Some(self.implied(device)?),
            error_over_distance: self.error_over_distance(&batches, &models, &step)?,
            choice: theorem.as_ref().and_then(|t| t.value_alone.as_ref()).map(Choice::of),
            choice_by_simulator: theorem.as_ref().and_then(|t| t.value.as_ref()).map(Choice::of),
            theorem,
            notes,
        })
    }

    /// A sample of the source rows in the order of their distances to the target (Eq. 9), and of the nearest share.
    fn sources(&self, streams: &Streams) -> Result<Option<Sources>> {
        let Subject { inputs, config, .. } = *self.subject;
        let Some(source) = &inputs.source else { return Ok(None) };
        let (all, distances) = (&source.rows, distances(inputs, SourceRows::Nearest, self.root)?);
        let mut order: Vec<usize> = (0..all.len()).collect();
        order.sort_by(|&a, &b| distances[a].total_cmp(&distances[b]).then(a.cmp(&b)));
        let pick = |from: &[usize], name: &str| {
            let places = choose(&mut streams.stream(name), from.len(), SOURCES.min(all.len() / 2).max(1));
            places.into_iter().map(|i| from[i]).collect::<Vec<_>>()
        };
        let share =
            if config.mixture.lambda > 0.0 && config.mixture.lambda < 1.0 { config.mixture.lambda } else { NEAREST };
        let near = ((share * all.len() as f64).round() as usize).clamp(1, all.len());
        let measured = pick(&order, "sources");
        Ok(Some(Sources {
            sorted: all.select(&measured),
            episodes: episodes_of(all, &measured),
            nearest: all.select(&pick(&order[..near], "nearest")),
            others: all.select(&others(all.len(), &measured)),
        }))
    }

    /// As many rows as there are of each kind, `kept` of them generated; None where that is too few for neighbourhoods.
    fn references(&self, streams: &Streams, sources: Option<&Sources>, kept: usize) -> Result<Option<References>> {
        let target = &self.subject.inputs.target.rows;
        let (first, second, by_episode) = halves(target, streams);
        let enough = first.len().min(second.len()).min(kept).min(sources.map_or(usize::MAX, |s| s.sorted.len()));
        let rows = REFERENCE.min(enough);
        if rows <= coverage::NEIGHBOUR {
            return Ok(None);
        }
        let reference =
            |t: &Transitions| coverage::Reference::new(self.units().states(&t.observations), self.units().live.len());
        let source = sources.map(|s| reference(&few(&s.sorted, rows, streams, "reference/source"))).transpose()?;
        Ok(Some(References {
            rows,
            target: reference(&few(&target.select(&first), rows, streams, "reference/target"))?,
            source,
            other_target: target.select(&second),
            by_episode,
        }))
    }

    /// For every batch, the distance of every row's state to the nearest one of target and source.
    fn distances_to_real(&self, batches: &[Batch]) -> Result<Vec<Vec<f32>>> {
        let (units, inputs) = (self.units(), self.subject.inputs);
        let d = units.live.len();
        let mut real = units.states(&inputs.target.rows.observations);
        if let Some(source) = &inputs.source {
            real.extend(units.states(&source.rows.observations));
        }
        let all: Vec<f32> = batches.iter().flat_map(|b| units.states(&b.rows.observations)).collect();
        let nearest = nn_distances(&Rows::new(&all, d), &Rows::new(&real, d), &NeighbourOptions::default())?;
        let mut rest = &nearest[..];
        let mut take = |b: &Batch| {
            let (own, others) = rest.split_at(b.len());
            rest = others;
            own.to_vec()
        };
        Ok(batches.iter().map(&mut take).collect())
    }

    /// Target rows to tell copies by.
    fn held_out(&self) -> Result<Option<memorisation::HeldOut>> {
        let (units, target) = (self.units(), &self.subject.inputs.target.rows);
        let episodes = target.episodes().iter().map(|e| e.start..e.end).collect();
        Ok(memorisation::HeldOut::new(pairs(units, target), 2 * units.live.len(), episodes)?)
    }

    fn sampled(&self, own: &Batch) -> Sampled {
        let Subject { inputs, config, .. } = *self.subject;
        let units = self.units();
        let y_max = decimal(config.generator.y_max).max(1e-6);
        let labels = |kept: bool| {
            let of = own.labels.iter().zip(&own.keep).filter(|(_, k)| **k == kept).map(|(y, _)| f64::from(*y));
            Histogram::of(of.collect::<Vec<_>>(), 0.0, y_max, 20)
        };
        let z = |t: &Transitions| {
            let (s, s2, d) = (units.take(&t.observations), units.take(&t.next_observations), units.live.len());
            let rows = Rows::join(&[(&s, d), (&s2, d)]);
            let kept = zscore_keep(&rows, config.filter.z_threshold);
            let rejected = kept.iter().filter(|k| !**k).count() as f64 / kept.len().max(1) as f64;
            (Histogram::of(tce_data::largest_z(&rows), 0.0, 8.0, 32), rejected)
        };
        let (z_real, real_rejected) = z(&inputs.target.rows);
        Sampled { y_kept: labels(true), y_rejected: labels(false), z: z(&own.rows).0, z_real, real_rejected }
    }

    /// Points of the groups: whole transitions with the nearest source rows among them, or states without.
    fn picture(
        &self,
        batch: &Batch,
        sources: Option<&Sources>,
        streams: &Streams,
        transitions: bool,
    ) -> Option<Embedding> {
        let units = self.units();
        let points = |t: &Transitions, name: &str| {
            let rows = few(t, POINTS, streams, &format!("picture/{name}"));
            if transitions { pairs(units, &rows) } else { units.states(&rows.observations) }
        };
        let mut groups = Vec::new();
        if let Some(s) = sources {
            groups.push((Group::Source, points(&s.sorted, "source")));
            if transitions {
                groups.push((Group::NearestSource, points(&s.nearest, "nearest source")));
            }
        }
        groups.push((Group::Target, points(&self.subject.inputs.target.rows, "target")));
        groups.push((Group::Generated, points(&batch.kept_rows(), "generated")));
        Embedding::of(&groups, if transitions { 2 } else { 1 } * units.live.len(), streams)
    }

    fn labels(&self, held_out: Option<tce_learn::LabelErrors>, own: &Batch, models: &Models) -> Result<Labels> {
        let errors = |rows: Option<&Transitions>| -> Result<Option<(f64, f64)>> {
            let Some(rows) = rows.filter(|r| !r.is_empty()) else { return Ok(None) };
            let found = self.sampler.label(&rows.observations, &rows.next_observations)?;
            Ok(finite((rmse(&found.actions, &rows.actions), rmse(&found.rewards, &rows.rewards))))
        };
        let terminal = own.simulated.as_ref().and_then(|s| {
            let known: Vec<usize> = (0..own.len()).filter(|&i| own.keep[i] && s.held(i)).collect();
            let wrong = known.iter().filter(|&&i| own.rows.terminals[i] != s.terminals[i]).count();
            (!known.is_empty()).then(|| wrong as f64 / known.len() as f64)
        });
        Ok(Labels {
            held_out_action: held_out.and_then(|e| finite((e.action_rmse, e.action_std))),
            held_out_reward: held_out.and_then(|e| finite((e.reward_rmse, e.reward_std))),
            at_source: errors(models.at_source.as_ref())?,
            at_generated: errors(models.at_generated.as_ref())?,
            terminal,
        })
    }

    /// The policy that the generator implies.
    fn implied(&self, device: &Device) -> Result<Implied> {
        let Self { subject, options, sampler, .. } = self;
        let Subject { inputs, config, seed, .. } = **subject;
        let target = &inputs.target.rows;
        let (generator, models) = (sampler.generator, sampler.finisher.models);
        let actor = ImpliedActor::new(generator, models, sampler.member, config.generator.sampler, target, device);
        let streams = Streams::new(seed).child("diagnosis/implied");
        let (trained, held_out) = held_out_rows(target.len(), &config.generator);
        let actions = implied_actions(&actor, target, (&trained, &held_out), DRAWS, &streams)?;
        let scores = config.evaluation.scores;
        let rollout = match self.simulator {
            Some((agent, shift)) if options.episodes > 0 => {
                let arena = Arena::new(agent, shift, scores);
                Some(rollout_implied(&actor, arena, options.episodes, streams.child("rollout"))?)
            }
            _ => None,
        };
        Ok(Implied { actions, rollout, behaviour_score: inputs.behaviour(scores).1.score })
    }

    /// Errors of the rows that pass the filter, under all bounds together, over the distance of ŝ to the nearest target state.
    fn error_over_distance(
        &self,
        batches: &[Batch],
        models: &Models,
        step: &[f32],
    ) -> Result<Option<ErrorOverDistance>> {
        let (units, target) = (self.units(), &self.subject.inputs.target.rows);
        let (d, real) = (units.live.len(), units.states(&target.observations));
        let mut pairs = Vec::new();
        for batch in batches.iter().filter(|b| b.kept() > 0) {
            let kept = batch.kept_rows();
            let states = units.states(&kept.observations);
            let nearest = nn_distances(&Rows::new(&states, d), &Rows::new(&real, d), &NeighbourOptions::default())?;
            let errors = match &batch.simulated {
                Some(s) => {
                    let all = generator::step_errors(&s.next_observations, &batch.rows, step, &units.live);
                    all.into_iter().zip(&batch.keep).filter(|(_, keep)| **keep).map(|(e, _)| e).collect()
                }
                None => models.successors_apart(&kept, step, &units.live),
            };
            pairs.extend(nearest.into_iter().map(f64::from).zip(errors));
        }
        let episodes = target.episodes().iter().map(|e| e.start..e.end).collect();
        let unit = memorisation::HeldOut::new(real, d, episodes)?.and_then(|h| h.median_distance());
        Ok(ErrorOverDistance::of(pairs, unit, self.simulator.is_some()))
    }

    /// Theorem 1 over λ.
    fn theorem(&self, sources: &Sources, own: &Batch, models: &Models, streams: &Streams) -> Result<Bounds> {
        let Subject { inputs, config, .. } = *self.subject;
        let generated = own.kept_rows();
        let of_sources = models.densities(&sources.sorted.observations, &sources.sorted.actions);
        let of_generated = models.densities(&generated.observations, &generated.actions);
        let tv = |truth: usize| -> Option<Curve> {
            let against = |densities: &[Densities], own: usize| {
                let [p, q] = [own, truth].map(|member| models.normals(&densities[member]));
                gaussian::total_variation(p, q, streams)
            };
            let rated = |densities: &[Densities], own: usize| Rated::certain(against(densities, own));
            let of_sources = rated(&of_sources, models.source?).grouped(&sources.episodes);
            Curve::of(&of_sources, &rated(&of_generated, models.generated))
        };
        let transition = models.abundant.and_then(tv);
        let value = match (self.simulator, &own.simulated) {
            (Some((agent, shift)), Some(at_generated)) => {
                let s = &sources.sorted;
                let at_source = tce_sim::simulate(agent, shift, &s.observations, &s.actions)?;
                let of_sources = Rated::certain(models.value_gap(s, &at_source)).grouped(&sources.episodes);
                let gaps = models.value_gap(&own.rows, at_generated).into_iter().zip(&own.keep);
                Curve::of(&of_sources, &Rated::certain(gaps.filter(|(_, keep)| **keep).map(|(gap, _)| gap).collect()))
            }
            _ => None,
        };
        let held_out = models.held_out(&inputs.target.rows, inputs.agent);
        let alone = |t: &Transitions, densities: &[Densities]| {
            let mut rated = models.value_gap_alone(t, densities, inputs.agent);
            rated.doubt.iter_mut().for_each(|u| *u *= calibration(held_out));
            rated
        };
        Ok(Bounds {
            discount: config.learner.iql.discount,
            r_max: inputs.target.rows.rewards.iter().fold(0.0, |m, r| f64::from(r.abs()).max(m)),
            transition,
            value,
            transition_alone: tv(models.limited),
            value_alone: Curve::of(
                &alone(&sources.sorted, &of_sources).grouped(&sources.episodes),
                &alone(&generated, &of_generated),
            ),
            held_out,
        })
    }
}

/// What is said of rows that are no part of a figure, and of bounds that there are none of.
fn left_out(own: &Batch, theorem: Option<&Bounds>, simulator: bool) -> Vec<String> {
    let mut notes = Vec::new();
    let lost = own.simulated.as_ref().map_or(0, |s| (0..own.len()).filter(|&i| !s.held(i)).count());
    if lost > 0 {
        notes.push(format!(
            "The simulator's physics blew up in {lost} generated rows at the run's own y_max; medians and percentiles leave them out."
        ));
    }
    let Some(theorem) = theorem else { return notes };
    let Bounds { value, value_alone, transition, transition_alone, .. } = theorem;
    for (what, curve, expected) in [
        ("on values by the simulator", value, simulator),
        ("on values by the data alone", value_alone, true),
        ("on transitions by the simulator", transition, simulator),
        ("on transitions by the data alone", transition_alone, true),
    ] {
        match curve {
            None if expected => notes.push(format!(
                "Theorem 1's bound {what} is missing: the discrepancy is a finite number in no source row, or in no generated one; \
                 a model has diverged."
            )),
            Some(c) if c.lost != (0, 0) => notes.push(format!(
                "Theorem 1's bound {what} leaves out {} source and {} generated rows, whose discrepancy is no finite number.",
                c.lost.0, c.lost.1
            )),
            _ => (),
        }
    }
    let single = |c: &Curve| c.generated_error.is_none() || c.errors[0].iter().any(Option::is_none);
    if value_alone.as_ref().is_some_and(single) {
        notes.push(
            "The source's nearest rows, or the generated ones, are of a single trajectory, which says nothing of others: λ = 0 cannot be \
             told from every other λ."
                .into(),
        );
    }
    notes
}

/// One number per row of a batch, for every figure that can be measured.
#[derive(Default)]
struct Figures {
    distance: Vec<f64>,
    transition_kl: Option<Vec<f64>>,
    reward_difference: Option<Vec<f64>>,
    reward_error: Option<Vec<f64>>,
    consistency: Option<Vec<f64>>,
}

impl Figures {
    /// `step` is the spread of the target's steps in the dimensions `live`.
    fn of(batch: &Batch, distances: &[f32], models: &Models, step: &[f32], live: &[usize]) -> Result<Self> {
        let t = &batch.rows;
        if t.is_empty() {
            return Ok(Self::default());
        }
        let kl = |abundant: usize| {
            let densities = models.densities(&t.observations, &t.actions);
            let (p, q) = (models.normals(&densities[models.limited]), models.normals(&densities[abundant]));
            gaussian::kl(p, q).into_iter().map(|v| v / p.dim as f64).collect()
        };
        let difference = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).collect();
        Ok(Self {
            distance: distances.iter().map(|d| f64::from(*d)).collect(),
            transition_kl: models.abundant.map(kl),
            reward_difference: models.abundant_rewards(t)?.map(|r| difference(&t.rewards, &r)),
            reward_error: batch.simulated.as_ref().map(|s| difference(&t.rewards, &s.rewards)),
            consistency: (batch.simulated.as_ref())
                .map(|s| generator::step_errors(&s.next_observations, t, step, live)),
        })
    }

    fn reliability(&self, batch: &Batch, kept: bool) -> Reliability {
        let chosen = |v: &Vec<f64>| {
            Spread::of(v.iter().zip(&batch.keep).filter(|(_, k)| **k == kept).map(|(v, _)| *v).collect::<Vec<_>>())
        };
        Reliability {
            rows: batch.keep.iter().filter(|k| **k == kept).count(),
            distance: chosen(&self.distance),
            transition_kl: self.transition_kl.as_ref().and_then(chosen),
            reward_difference: self.reward_difference.as_ref().and_then(chosen),
            reward_error: self.reward_error.as_ref().and_then(chosen),
            consistency: self.consistency.as_ref().and_then(chosen),
        }
    }
}

/// Two halves of the rows in whole episodes, drawn at random, and whether that could be: where one would have less than a third of the rows,
/// rows are drawn instead.
fn halves(t: &Transitions, streams: &Streams) -> (Vec<usize>, Vec<usize>, bool) {
    let mut episodes = t.episodes();
    episodes.shuffle(&mut streams.stream("halves"));
    // The longest first: each goes where there are fewer rows.
    episodes.sort_by_key(|e| std::cmp::Reverse(e.end - e.start));
    let (mut first, mut second) = (Vec::new(), Vec::new());
    for e in episodes {
        let half = if second.len() < first.len() { &mut second } else { &mut first };
        half.extend(e.start..e.end);
    }
    if 3 * second.len().min(first.len()) < t.len() {
        let chosen = choose(&mut streams.stream("halves/rows"), t.len(), t.len() / 2);
        let second = others(t.len(), &chosen);
        return (chosen, second, false);
    }
    first.sort_unstable();
    second.sort_unstable();
    (first, second, true)
}

/// The episode of each of the rows at `places`.
fn episodes_of(t: &Transitions, places: &[usize]) -> Vec<usize> {
    let all: Vec<usize> = t.episodes().iter().enumerate().flat_map(|(k, e)| vec![k; e.end - e.start]).collect();
    places.iter().map(|&i| all[i]).collect()
}

/// Which of 0 .. `count` are not among `places`.
fn others(count: usize, places: &[usize]) -> Vec<usize> {
    let mut free = vec![true; count];
    places.iter().for_each(|&i| free[i] = false);
    (0..count).filter(|&i| free[i]).collect()
}

/// (s, s') of live dimensions in units of the states, `[N, 2 d]`.
pub(crate) fn pairs(units: &Units, t: &Transitions) -> Vec<f32> {
    let d = units.live.len();
    let (s, s2) = (units.states(&t.observations), units.states(&t.next_observations));
    Rows::join(&[(&s, d), (&s2, d)]).to_vec()
}

/// As it is written: .1 and not .10000000149.
fn decimal(y: f32) -> f64 {
    y.to_string().parse().unwrap_or(f64::from(y))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::models::tests::log;

    #[test]
    fn rows_know_their_episode() {
        assert_eq!(episodes_of(&log(&[2, 3, 1]), &[5, 0, 3, 1, 4, 2]), [2, 0, 1, 0, 1, 1]);
    }

    /// Every figure that is missing has a note.
    #[test]
    fn what_is_left_out_is_told() {
        let t = log(&[1, 1]);
        let held = |rewards: Vec<f32>| tce_sim::Simulated { rewards, ..Default::default() };
        let batch =
            |simulated| Batch { rows: t.clone(), keep: vec![true; 2], labels: vec![0.0; 2], simulated, lost: 0 };
        let curve = |sources: &[f64]| Curve::of(&Rated::certain(sources.to_vec()), &Rated::certain(vec![1.0, 2.0]));
        let rows: Vec<f64> = (0..1000).map(f64::from).collect();
        let with = |value: Option<Curve>, value_alone: Option<Curve>| Bounds {
            discount: 0.9,
            r_max: 1.0,
            transition: curve(&rows),
            value,
            transition_alone: curve(&rows),
            value_alone,
            held_out: None,
        };
        let notes = |b: &Batch, t: &Bounds| left_out(b, Some(t), true).join("\n");
        let whole = with(curve(&rows), curve(&rows));
        assert_eq!(notes(&batch(Some(held(vec![1.0, 2.0]))), &whole), "");
        assert!(notes(&batch(Some(held(vec![1.0, f32::NAN]))), &whole).contains("blew up in 1 generated rows"));
        let none = batch(None);
        assert!(
            notes(&none, &with(curve(&[f64::NAN]), curve(&rows))).contains("on values by the simulator is missing")
        );
        assert!(!left_out(&none, Some(&with(None, curve(&rows))), false).join("").contains("missing"));
        let one = notes(&none, &with(curve(&rows), curve(&[&rows[..], &[f64::INFINITY]].concat())));
        assert!(one.contains("on values by the data alone leaves out 1 source and 0 generated rows"), "{one}");
        assert!(notes(&none, &with(curve(&rows), curve(&rows[..50]))).contains("are of a single trajectory"));
    }

    #[test]
    fn halves_are_whole_episodes_where_they_are_even_enough() {
        for (lengths, whole) in [
            (vec![10; 5], true),
            (vec![10, 10], true),
            (vec![30, 10, 10, 10], true),
            (vec![50], false),
            (vec![50, 5], false),
            (vec![997, 1, 1, 1], false),
        ] {
            let t = log(&lengths);
            let (first, second, by_episode) = halves(&t, &Streams::new(1));
            assert_eq!(by_episode, whole, "{lengths:?}");
            let mut all = [first.clone(), second.clone()].concat();
            all.sort_unstable();
            assert_eq!(all, (0..t.len()).collect::<Vec<_>>(), "{lengths:?}: every row once");
            assert!(3 * first.len().min(second.len()) >= t.len(), "{lengths:?}: {} and {}", first.len(), second.len());
            let split = |e: &tce_data::Episode| first.contains(&e.start) != first.contains(&(e.end - 1));
            assert!(!whole || !t.episodes().iter().any(split), "{lengths:?}");
        }
    }
}
