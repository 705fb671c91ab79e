//! Every metric of a diagnosis.

use tce_augment::config::FilterKind;
use tce_augment::score_training::held_out_rows;
use tce_augment::units::Units;
use tce_base::{Streams, begin_step, counted};
use tce_data::{NeighbourOptions, Rows, Transitions, nn_distances, zscore_keep};
use tce_diagnosis::bounds::calibration;
use tce_diagnosis::{
    AtBound, Bounds, Choice, Curve, Diagnosis, Embedding, ErrorOverDistance, Group, Histogram, Implied, Labels, Rated,
    Reliability, Sampled, Spread, Truth, gaussian, memorisation,
};
use tce_learn::{Densities, rmse};
use tce_nn::Device;
use tce_zoo::actors::Arena;

use super::implied::{DRAWS, ImpliedActor, implied_actions, rollout_implied};
use super::models::{Models, finite};
use super::notes::{left_out, lost, of_references, without_simulator};
use super::references::References;
use super::rows::Batch;
use super::work::{Sources, Work, few};
use super::{Subject, generator};
use crate::error::Result;

/// The steps of a diagnosis, after those of the run.
pub const PARTS: [&str; 5] =
    ["rows to measure", "transition models", "coverage and reliability", "choice of λ", "pictures and implied policy"];
/// Points of each group in a picture.
const POINTS: usize = 400;

/// Which generated rows are meant.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Part {
    /// Those that the filter keeps.
    Kept,
    /// Those that it rejects.
    Rejected,
}

/// What is a point of a picture.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Shown {
    States,
    Transitions,
}

/// What every label bound is measured by.
struct Measured<'a> {
    models: &'a Models,
    references: Option<&'a References>,
    held_out: Option<&'a memorisation::HeldOut>,
    step: &'a [f32],
    streams: &'a Streams,
}

impl Work<'_> {
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
        let grid = self.grid();
        begin_step(PARTS[0]);
        let batches = grid.iter().map(|&y| sampler.sample(options.rows, y, "figures")).collect::<Result<Vec<_>>>()?;
        let at = |y: f32| grid.iter().position(|g| *g == y).expect("on the grid");
        let own = &batches[at(config.generator.y_max)];
        own.ensure_kept(&config.filter)?;
        notes.extend(lost(grid.iter().zip(&batches), options.rows));
        let sources = self.sources(&streams)?;
        begin_step(PARTS[1]);
        let models = Models::train(self, sources.as_ref(), own, *grid.last().expect("a grid"), attempt, device)?;
        notes.extend(self.simulator.is_none().then(|| without_simulator(options.simulator)));
        begin_step(PARTS[2]);
        // As many as every bound has, but for those of which the filter leaves next to nothing.
        let kept = batches.iter().map(Batch::kept).filter(|k| 2 * k >= own.kept()).min().expect("the run's own");
        let references = self.references(&streams, sources.as_ref(), kept)?;
        notes.extend(of_references(references.as_ref()).map(str::to_owned));
        let by_target = |r: &References| r.covered_by(&r.other_target, self.units(), &streams);
        let covered_by_target = references.as_ref().map_or(Ok(None), by_target)?;
        let held_out = self.held_out()?;
        if held_out.is_none() {
            notes.push("One episode has most of the target rows: there are no held-out rows to tell copies by.".into());
        }
        let distances = self.distances_to_real(&batches)?;
        let step = generator::step_std(target, &self.units().live);
        let measured = Measured {
            models: &models,
            references: references.as_ref(),
            held_out: held_out.as_ref(),
            step: &step,
            streams: &streams,
        };
        let bounds = grid.iter().zip(&batches).zip(&distances);
        let bounds = bounds.map(|((&y, batch), distances)| self.at_bound(y, batch, distances, &measured, &mut notes));
        let bounds_of_y = bounds.collect::<Result<Vec<_>>>()?;
        begin_step(PARTS[3]);
        let theorem = sources.as_ref().map(|s| self.theorem(s, own, &models, &streams)).transpose()?;
        if theorem.is_none() {
            notes.push("Without source rows there is no λ to choose.".into());
        }
        notes.extend(left_out(own, theorem.as_ref(), self.simulator.is_some()));
        begin_step(PARTS[4]);
        let pictured = [0.0, config.generator.y_max, *grid.last().expect("a grid")];
        let states = self.pictures(&pictured.map(|y| (y, &batches[at(y)])), sources.as_ref(), &streams);
        let by_zscore = config.filter.enabled && config.filter.by == FilterKind::Zscore;
        Ok(Diagnosis {
            of: subject.of.clone(),
            task: subject.task,
            seed,
            y_max: decimal(config.generator.y_max),
            z_threshold: by_zscore.then_some(config.filter.z_threshold),
            lambda: config.mixture.lambda,
            rows: options.rows,
            target_rows: target.len(),
            coverage_rows: references.as_ref().map_or(0, |r| r.rows),
            covered_by_target,
            covered_by_fresh: references.as_ref().is_some_and(|r| r.by_episode),
            bounds_of_y,
            sampled: self.sampled(own),
            transitions: self.picture(own, sources.as_ref(), &streams, Shown::Transitions),
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

    /// The label bounds, ascending: those that were asked for, 0, and the run's own.
    fn grid(&self) -> Vec<f32> {
        let mut grid = self.options.y_max.clone();
        grid.extend([0.0, self.subject.config.generator.y_max]);
        grid.sort_by(f32::total_cmp);
        grid.dedup();
        grid
    }

    /// A picture of the states of each batch, by its bound; equal bounds once.
    fn pictures(
        &self,
        batches: &[(f32, &Batch)],
        sources: Option<&Sources>,
        streams: &Streams,
    ) -> Vec<(f64, Embedding)> {
        let mut states: Vec<(f64, Embedding)> = Vec::new();
        for (y, batch) in batches {
            if states.iter().all(|(other, _)| *other != decimal(*y)) {
                let picture = self.picture(batch, sources, streams, Shown::States);
                states.extend(picture.map(|p| (decimal(*y), p)));
            }
        }
        states
    }

    /// The metrics under one label bound.
    fn at_bound(
        &self,
        y: f32,
        batch: &Batch,
        distances: &[f32],
        measured: &Measured,
        notes: &mut Vec<String>,
    ) -> Result<AtBound> {
        let Measured { models, references, held_out, step, streams } = *measured;
        let metrics = Metrics::of(batch, distances, models, step, &self.units().live)?;
        let kept = batch.kept_rows();
        let compare = |h: &memorisation::HeldOut| h.compare(&pairs(self.units(), &kept), streams);
        let coverage = references.map_or(Ok(None), |r| r.covered_by(&kept, self.units(), streams))?;
        if references.is_some() && coverage.is_none() {
            notes.push(format!(
                "With y_max = {y} the filter leaves {}: too few for a coverage.",
                counted(kept.len(), "row", "rows")
            ));
        }
        Ok(AtBound {
            y_max: decimal(y),
            lost: batch.lost,
            coverage,
            rejected: batch.rejected(),
            memorisation: held_out.map(compare).transpose()?.flatten(),
            kept: metrics.reliability(batch, Part::Kept),
            outliers: (batch.kept() < batch.len()).then(|| metrics.reliability(batch, Part::Rejected)),
        })
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
        let (units, target) = (self.units(), self.sampler.target);
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

    /// Points of the groups; where whole transitions are shown, the nearest source rows are one.
    fn picture(&self, batch: &Batch, sources: Option<&Sources>, streams: &Streams, shown: Shown) -> Option<Embedding> {
        let transitions = shown == Shown::Transitions;
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
        let target = sampler.target;
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
        let truth = if self.simulator.is_some() { Truth::Simulator } else { Truth::Models };
        Ok(ErrorOverDistance::of(pairs, unit, truth))
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

/// One number per row of a batch, for every metric that can be measured.
#[derive(Default)]
struct Metrics {
    distance: Vec<f64>,
    transition_kl: Option<Vec<f64>>,
    reward_difference: Option<Vec<f64>>,
    reward_error: Option<Vec<f64>>,
    consistency: Option<Vec<f64>>,
}

impl Metrics {
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

    fn reliability(&self, batch: &Batch, part: Part) -> Reliability {
        let kept = part == Part::Kept;
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
