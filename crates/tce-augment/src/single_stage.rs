//! Rows of one network over whole transitions x = [s, a, r, s', terminal]: what SynthER and DmC train policies with.
//!
//! | | SynthER | DmC |
//! |---|---|---|
//! | trained on | target rows | source rows |
//! | condition | none | the row's score ([`tce_data::density`]), left out with probability `guidance.dropout` |
//! | drawn under | none | c: one of the percentiles `guidance.from` to 99 % of the training scores; D = D∅ + w (D_c − D∅) |
//! | standardised | every dimension by its mean and spread over the training rows, but not the terminal flag | the same |
//! | afterwards | actions clipped to the box, terminal where the flag is above ½ | the same |
//!
//! DmC's target rows are in the scores alone, and a generated row has the score that it was drawn under: it ranks with the best tenth of
//! the source rows, whatever came of it. `guidance.rescore` measures its score instead.
//!
//! The networks are [`tce_diffusion`]'s, and so is their training: narrower than the published ones, with Adam's usual β₂, no clipping of
//! gradients, and a sampler of fewer steps without churn (settings of the preset `paper`: the published sizes, rows and steps).
//!
//! Dimensions that are constant in the training rows (Ant's contact slots, the flag of a robot that never falls) are left out
//! and put back. Rows with a number that is not finite are dropped; there is no other filter.

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_data::{DensityOptions, DensityScale, Rows, Standardizer, Transitions, further_scores};
use tce_diffusion::{
    Balance, Condition, NetworkConfig, Part, Request, ScoreData, ScoreModel, Target, TrainConfig, Trainer, present,
    uniform_labels,
};

use crate::config::SingleStageConfig;
use crate::error::{Error, Result};
use crate::score_training::{Course, Ready, progress, run, start_rows};
use crate::work::Work;

/// Between transitions and the rows of the network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RowUnits {
    obs_dim: usize,
    act_dim: usize,
    /// s', or s' − s, in the row.
    target: Target,
    /// Of whole rows; the terminal flag stays as it is.
    all: Standardizer,
    /// The dimensions that the network sees.
    live: Vec<usize>,
}

impl RowUnits {
    /// The units in which the rows of `t` have mean 0 and variance 1.
    pub fn fit(t: &Transitions, target: Target) -> Self {
        let width = t.obs_dim + t.act_dim + 1;
        let mut head = Vec::with_capacity(t.len() * width);
        for i in 0..t.len() {
            head.extend_from_slice(t.observation(i));
            head.extend_from_slice(t.action(i));
            head.push(t.rewards[i]);
        }
        let (tail, flags) = (tail(t, target), flags(t));
        let rows = Rows::join(&[(&head, width), (&tail, t.obs_dim), (&flags, 1)]);
        let mut all = Standardizer::fit_on(&[rows]);
        let flag = all.dim() - 1;
        if !all.dead.contains(&flag) {
            (all.mean[flag], all.std[flag]) = (0.0, 1.0);
        }
        let (obs_dim, act_dim, live) = (t.obs_dim, t.act_dim, all.live());
        Self { obs_dim, act_dim, target, all, live }
    }

    /// Live, standardised dimensions of every row, `[len, live]`.
    pub fn encode(&self, t: &Transitions) -> Vec<f32> {
        let tail = tail(t, self.target);
        let d = t.obs_dim;
        let mut row = Vec::with_capacity(self.all.dim());
        let mut out = Vec::with_capacity(t.len() * self.live.len());
        for i in 0..t.len() {
            row.clear();
            row.extend_from_slice(t.observation(i));
            row.extend_from_slice(t.action(i));
            row.push(t.rewards[i]);
            row.extend_from_slice(&tail[i * d..(i + 1) * d]);
            row.push(if t.terminals[i] { 1.0 } else { 0.0 });
            self.all.apply_row(&mut row);
            out.extend(self.live.iter().map(|&k| row[k]));
        }
        out
    }

    /// Transitions from rows `[n, live]`, every one an episode of its own; rows with a number that is not finite are left out.
    /// Also which rows those are that stay, and the share of action components outside of the box, before clipping.
    pub fn decode(&self, live: &[f32]) -> (Transitions, Vec<usize>, f64) {
        let (d, a) = (self.obs_dim, self.act_dim);
        let mut t = Transitions::with_capacity(d, a, live.len() / self.live.len());
        let (mut kept, mut outside) = (Vec::new(), 0usize);
        // A dead dimension is 0 in these units: its mean is its one value.
        let mut row = vec![0.0; self.all.dim()];
        for (i, values) in live.chunks_exact(self.live.len()).enumerate() {
            if !values.iter().all(|v| v.is_finite()) {
                continue;
            }
            row.fill(0.0);
            self.live.iter().zip(values).for_each(|(&k, &v)| row[k] = v);
            self.all.invert_in_place(&mut row);
            let (s, rest) = row.split_at_mut(d);
            let (action, rest) = rest.split_at_mut(a);
            let (reward, rest) = rest.split_at_mut(1);
            let (s2, flag) = rest.split_at_mut(d);
            self.target.decode(s, s2);
            outside += action.iter().filter(|x| x.abs() > 1.0).count();
            action.iter_mut().for_each(|x| *x = x.clamp(-1.0, 1.0));
            let terminal = flag[0] > 0.5;
            t.push(s, action, reward[0], s2, terminal, !terminal);
            kept.push(i);
        }
        let share = outside as f64 / (t.len() * a).max(1) as f64;
        (t, kept, share)
    }
}

/// What stands for s' in a row.
fn tail(t: &Transitions, target: Target) -> Vec<f32> {
    target.encode(&t.observations, &t.next_observations)
}

fn flags(t: &Transitions) -> Vec<f32> {
    t.terminals.iter().map(|&f| if f { 1.0 } else { 0.0 }).collect()
}

/// Between scores and conditions, which have mean 0 and variance 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoreUnits {
    mean: f32,
    std: f32,
}

impl ScoreUnits {
    /// Mean and spread of `scores`.
    pub fn fit(scores: &[f32]) -> Self {
        let units = Standardizer::fit(scores, 1);
        Self { mean: units.mean[0], std: units.std[0] }
    }

    /// The network's conditions of scores: standardised, and marked as present.
    pub fn conditions(&self, scores: &[f32]) -> Vec<f32> {
        let standard: Vec<f32> = scores.iter().map(|s| (s - self.mean) / self.std).collect();
        present(&standard, 1)
    }
}

/// The whole percentiles of `scores` from `from` to 99 %.
fn best_percentiles(scores: &[f32], from: f64) -> Vec<f32> {
    let mut all = scores.to_vec();
    all.sort_by(f32::total_cmp);
    // As numpy interpolates percentiles.
    let percentile = |p: usize| {
        let at = p as f64 / 100.0 * (all.len() - 1) as f64;
        let (low, high) = (all[at as usize] as f64, all[(at as usize + 1).min(all.len() - 1)] as f64);
        (low + at.fract() * (high - low)) as f32
    };
    let first = (100.0 * from).round() as usize;
    (first..100).map(percentile).collect()
}

/// One of `scores` for each of `uniform` ∈ [0, 1), all equally likely.
fn draw_scores(scores: &[f32], uniform: &[f32]) -> Vec<f32> {
    uniform.iter().map(|u| scores[(u * scores.len() as f32) as usize]).collect()
}

/// The results of training the network, besides it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trained {
    /// The maps between rows and transitions.
    pub units: RowUnits,
    /// The map of scores, where the network has any.
    pub scores: Option<ScoreUnits>,
    /// Last reported loss, per member.
    pub loss: Vec<f32>,
    /// Seconds of training, all members together.
    pub seconds: f64,
}

/// The trained network over whole transitions, of a whole population.
pub struct SingleStage {
    /// The network.
    pub model: ScoreModel,
    /// What it was trained on.
    pub trained: Trained,
}

/// Generated rows of one member.
pub struct Sampled {
    /// Transitions, every one an episode of its own.
    pub rows: Transitions,
    /// The score that each of them was drawn under, where the network has scores.
    pub scores: Option<Vec<f32>>,
    /// Share of action components outside of the box, before clipping.
    pub outside_box: f64,
}

impl SingleStage {
    /// Trains the network on `rows`; under their `scores`, if they have any (DmC), and under nothing otherwise (SynthER).
    ///
    /// # Errors
    /// If the settings cannot be used, the network diverges, or the user interrupts.
    pub fn fit(rows: &Transitions, scores: Option<&[f32]>, config: &SingleStageConfig, work: &Work) -> Result<Self> {
        let units = RowUnits::fit(rows, config.target);
        let rows = units.encode(rows);
        let (d, c) = (units.live.len(), 2);
        let on = scores.map(|scores| {
            let units = ScoreUnits::fit(scores);
            (units, units.conditions(scores))
        });
        let data = match &on {
            // No condition at all is the one that DmC's network learns beside the others.
            None => ScoreData::new(
                vec![Part { rows: &rows, condition: Condition::Constant(vec![0.0; c]) }],
                d,
                c,
                Balance::Rows,
            )?,
            Some((_, on)) => {
                ScoreData::new(vec![Part { rows: &rows, condition: Condition::Rows(on) }], d, c, Balance::Rows)?
                    .with_dropout(config.guidance.dropout)?
            }
        };
        let SingleStageConfig { width, embedding, blocks, process, steps, .. } = *config;
        let network = NetworkConfig { width, embedding, blocks, ..NetworkConfig::new(d, c) };
        let training = training_of(config);
        let mut trainer = Trainer::new("joint", network, process, training, &work.streams(), work.device)?;
        let mut checkpoints = work.keeper.checkpoints("joint")?;
        work.keeper.begin(&[("joint", checkpoints.step().unwrap_or(0))])?;
        let course = Course::Steps(steps);
        let Ready { model, loss, .. } = run(&mut trainer, &data, &course, &mut checkpoints, work.keeper, "joint")?;
        let scores = on.map(|(units, _)| units);
        Ok(Self { model, trained: Trained { units, scores, loss, seconds: 0.0 } })
    }

    /// `config.rows` rows for each member. A network with scores draws them under the best percentiles of `scores`, those of its training
    /// rows. `start` are the rows that it was trained on, where a process that starts at data starts.
    ///
    /// # Errors
    /// If no row of a member is finite, or the user interrupts.
    pub fn sample(
        &self,
        scores: Option<&[f32]>,
        start: &Transitions,
        config: &SingleStageConfig,
        work: &Work,
    ) -> Result<Vec<Sampled>> {
        let (units, members, n) = (&self.trained.units, work.streams(), config.rows);
        // Per member, under which scores its rows are drawn.
        let under = scores.map(|scores| -> Vec<Vec<f32>> {
            let best = best_percentiles(scores, config.guidance.from);
            members.iter().map(|m| draw_scores(&best, &uniform_labels(m, "joint", n, 1.0))).collect()
        });
        let condition = match (&under, &self.trained.scores) {
            (Some(scores), Some(units)) => units.conditions(&scores.concat()),
            _ => vec![0.0; 2 * n],
        };
        let first = start_rows(self.model.process(), || units.encode(start), units.live.len(), n, &members, "joint");
        let request = Request {
            start: first.as_deref(),
            kept: work.keeper.chunks(),
            ..request(&condition, config, Under::of(scores))
        };
        let bar = progress("sample transitions", n * members.len(), &config.sampler);
        let sampled = self.model.sample(request, &config.sampler, &members, Some(&bar))?;
        bar.finish();
        let member = |(m, rows): (usize, &[f32])| {
            let (rows, kept, outside_box) = units.decode(rows);
            if rows.is_empty() {
                return Err(Error::Failed(format!(
                    "seed {}: none of {n} generated rows is finite; lower single_stage.learning_rate, or look for huge values in the data",
                    work.seeds[m]
                )));
            }
            let scores = under.as_ref().map(|under| kept.iter().map(|&i| under[m][i]).collect());
            Ok(Sampled { rows, scores, outside_box })
        };
        sampled.chunks(n * units.live.len()).enumerate().map(member).collect()
    }
}

/// What rows are drawn under.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Under {
    /// Nothing (SynthER).
    Nothing,
    /// Scores, with guidance (DmC).
    Scores,
}

impl Under {
    /// `scores`, if there are any.
    pub fn of<T: ?Sized>(scores: Option<&T>) -> Self {
        if scores.is_some() { Self::Scores } else { Self::Nothing }
    }
}

/// What is asked of the network, without where it starts and what is kept.
fn request<'a>(condition: &'a [f32], config: &SingleStageConfig, under: Under) -> Request<'a> {
    let guidance = (under == Under::Scores).then_some(config.guidance.weight).filter(|w| *w != 1.0);
    Request { name: "joint", rows: config.rows, condition, guidance, start: None, kept: None }
}

/// Network evaluations for one row; guidance doubles them.
pub fn evaluations(config: &SingleStageConfig, under: Under) -> usize {
    request(&[], config, under).evaluations(&config.sampler)
}

/// How the network is trained.
pub fn training_of(config: &SingleStageConfig) -> TrainConfig {
    let SingleStageConfig { learning_rate, schedule, batch, ema, .. } = *config;
    TrainConfig { learning_rate, schedule, batch, ema }
}

/// The scores of generated `rows`, measured like those of the source rows, on their `scale`.
///
/// # Errors
/// If there are too few rows.
pub fn rescored(
    rows: &Transitions,
    source: &Transitions,
    target: &Transitions,
    scale: &DensityScale,
    options: &DensityOptions,
) -> Result<Vec<f32>> {
    let [rows, source, target] = [rows, source, target].map(Rows::transitions);
    Ok(further_scores(&rows, &source, &target, scale, options, &score_streams())?)
}

/// Everything random about scores, which belong to a pair of data sets and to no seed.
pub fn score_streams() -> Streams {
    Streams::new(0)
}

/// Refuses tables with fewer rows than the neighbours that a score looks at.
pub fn enough_to_score(others: usize, target: usize, options: &DensityOptions) -> Result<()> {
    for (what, rows) in [("other", others), ("target", target)] {
        if rows < options.neighbour {
            return Err(Error::Failed(format!(
                "single_stage.scores: found {rows} {what} rows, expected at least single_stage.scores.neighbour = {}; lower it, or give more rows",
                options.neighbour
            )));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    /// Two observations, of which one is constant; the last row of every ten is terminal.
    fn table(rows: usize, falls: bool) -> Transitions {
        let mut rng = Streams::new(1).stream("table");
        let mut t = Transitions::new(3, 2);
        for i in 0..rows {
            let mut draw = |scale: f32| scale * rng.random_range(-1.0f32..1.0);
            let (s, a) = ([draw(100.0), 0.25, draw(0.01)], [draw(1.0), draw(0.5)]);
            let terminal = falls && i % 10 == 9;
            t.push(&s, &a, 5.0 + draw(1.0), &[s[0] + draw(1.0), 0.25, s[2] + draw(0.001)], terminal, !terminal);
        }
        t
    }

    #[test]
    fn decoding_undoes_encoding() {
        for (falls, target) in [(true, Target::Next), (false, Target::Next), (true, Target::Delta)] {
            let t = table(200, falls);
            let units = RowUnits::fit(&t, target);
            // 3 + 2 + 1 + 3 + 1 dimensions, without the constant one of s and s'; without falls the flag is constant, too.
            assert_eq!(units.live.len(), if falls { 8 } else { 7 });
            let rows = units.encode(&t);
            let column = |k: usize| rows.iter().skip(k).step_by(units.live.len()).copied().collect::<Vec<_>>();
            let spread = |x: &[f32]| (x.iter().map(|v| v * v).sum::<f32>() / x.len() as f32).sqrt();
            assert!((0..7).all(|k| (spread(&column(k)) - 1.0).abs() < 0.2), "live dimensions are standardised");
            if falls {
                assert!(column(7).iter().all(|&f| f == 0.0 || f == 1.0), "the flag is not");
            }
            let (back, kept, outside) = units.decode(&rows);
            assert_eq!((back.len(), kept.len(), outside), (200, 200, 0.0));
            assert_eq!((&back.terminals, &back.timeouts), (&t.terminals, &t.timeouts));
            let near = |a: &[f32], b: &[f32], by: f32| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= by);
            assert!(near(&back.observations, &t.observations, 2e-5) && near(&back.rewards, &t.rewards, 1e-5));
            assert!(near(&back.actions, &t.actions, 1e-6));
            assert!(near(&back.next_observations, &t.next_observations, 2e-5));
        }
    }

    #[test]
    fn rows_off_the_box_are_clipped_and_broken_ones_left_out() {
        let t = table(100, true);
        let units = RowUnits::fit(&t, Target::Next);
        let mut rows = units.encode(&t);
        let d = units.live.len();
        rows[2] = 50.0; // a₀ of row 0
        rows[d + 1] = f32::NAN;
        (rows[2 * d + 7], rows[3 * d + 7]) = (0.49, 0.51);
        let (back, kept, outside) = units.decode(&rows);
        assert_eq!((back.len(), &kept[..3]), (99, &[0, 2, 3][..]));
        assert_eq!((back.action(0)[0], outside), (1.0, 1.0 / 198.0));
        assert_eq!(back.terminals[1..3], [false, true]);
    }

    /// Of 0, .001, ..., 1 the percentiles from .9 on are .9, .91, ..., .99: each under a tenth of the rows.
    #[test]
    fn rows_are_drawn_under_the_best_scores() {
        let scores: Vec<f32> = (0..=1000).rev().map(|i| i as f32 / 1e3).collect();
        let uniform: Vec<f32> = (0..1000).map(|i| i as f32 / 1e3).collect();
        let drawn = draw_scores(&best_percentiles(&scores, 0.9), &uniform);
        for (i, drawn) in drawn.iter().enumerate() {
            assert!((drawn - (0.9 + (i / 100) as f32 / 100.0)).abs() < 1e-6, "{i}: {drawn}");
        }
        // Between two rows as numpy does it: numpy.percentile([0, 1], [90, 99]).
        assert_eq!(draw_scores(&best_percentiles(&[1.0, 0.0], 0.9), &[0.0, 0.999]), [0.9, 0.99]);

        let units = ScoreUnits::fit(&scores);
        let on = units.conditions(&[units.mean, units.mean + units.std]);
        assert!(on[0].abs() < 1e-6 && (on[2] - 1.0).abs() < 1e-5 && (on[1], on[3]) == (1.0, 1.0), "{on:?}");
    }
}
