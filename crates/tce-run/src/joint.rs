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

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_data::{
    DensityOptions, DensityScale, DensityScores, LoadOptions, Rows, Standardizer, Transitions, density_scores,
    further_scores, load, save_d4rl,
};
use tce_diffusion::{
    Chunks, Condition, NetworkConfig, Part, Request, ScoreData, ScoreModel, Target, TrainConfig, Trainer, present,
    uniform_labels,
};
use tce_nn::{Device, NamedParameters, cpu};

use crate::config::{Config, GeneratedRows, GuidanceConfig, JointConfig};
use crate::error::{Error, Result};
use crate::expand::{Expansion, Generated};
use crate::generator::{Course, Ready, progress, run, start_rows};
use crate::inputs::{InputSpec, Inputs};
use crate::stage::Stage;

/// The column of scores in the files of generated rows.
const SCORE: &str = "score";

/// Between transitions and the rows of the network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RowUnits {
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
    fn fit(t: &Transitions, target: Target) -> Self {
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
    fn encode(&self, t: &Transitions) -> Vec<f32> {
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
    fn decode(&self, live: &[f32]) -> (Transitions, Vec<usize>, f64) {
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
struct ScoreUnits {
    mean: f32,
    std: f32,
}

impl ScoreUnits {
    fn fit(scores: &[f32]) -> Self {
        let units = Standardizer::fit(scores, 1);
        Self { mean: units.mean[0], std: units.std[0] }
    }

    /// The network's conditions of scores: standardised, and marked as present.
    fn conditions(&self, scores: &[f32]) -> Vec<f32> {
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

/// What training the network leaves behind.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Trained {
    units: RowUnits,
    scores: Option<ScoreUnits>,
    /// Last reported loss, per member.
    loss: Vec<f32>,
    /// Seconds of training, all members together.
    seconds: f64,
}

/// Everything random about scores, which belong to a pair of data sets and to no seed.
pub(crate) fn score_streams() -> Streams {
    Streams::new(0)
}

/// Refuses tables with fewer rows than the neighbours that a score looks at.
pub(crate) fn enough_to_score(others: usize, target: usize, options: &DensityOptions) -> Result<()> {
    for (what, rows) in [("other", others), ("target", target)] {
        if rows < options.neighbour {
            return Err(Error::Failed(format!(
                "joint.scores: found {rows} {what} rows, expected at least joint.scores.neighbour = {}; lower it, or give more rows",
                options.neighbour
            )));
        }
    }
    Ok(())
}

/// DmC's scores of the source rows; computed once per pair of data sets.
pub fn scores(inputs: &Inputs, options: &DensityOptions, root: &Path) -> Result<DensityScores> {
    #[derive(Serialize)]
    struct Spec<'a> {
        inputs: InputSpec,
        options: &'a DensityOptions,
    }
    let file = "scores.safetensors";
    let stage = Stage::open(root, "stages/source-scores", &Spec { inputs: inputs.spec(true), options }, &cpu())?;
    if let Some(scale) = stage.summary::<DensityScale>()? {
        let path = stage.file(file);
        let mut loaded = NamedParameters::load(&path)?;
        let mut take = |name: &str| {
            let tensor = loaded.tensors.remove(name).map(|(_, values)| values);
            tensor.ok_or_else(|| {
                Error::missing(&path, format!("no tensor `{name}`; remove the directory to compute it again"))
            })
        };
        return Ok(DensityScores { source: take("source")?, scale });
    }
    let (source, target) = (inputs.source_rows()?, &inputs.target.rows);
    enough_to_score(source.len(), target.len(), options)?;
    let scores = density_scores(&Rows::transitions(source), &Rows::transitions(target), options, &score_streams())?;
    let mut out = NamedParameters::default();
    out.tensors.insert("source".into(), (vec![scores.source.len()], scores.source.clone()));
    let attempt = stage.attempt()?;
    out.save(&attempt.file(file))?;
    attempt.finish(&[file.to_owned()], scores.scale)?;
    Ok(scores)
}

/// The trained network, from its stage if it is there.
fn train(
    inputs: &Inputs,
    kind: GeneratedRows,
    j: &JointConfig,
    scored: Option<&DensityScores>,
    seeds: &[u64],
    root: &Path,
    device: &Device,
) -> Result<(ScoreModel, Trained, Stage)> {
    #[derive(Serialize)]
    struct Spec<'a> {
        inputs: InputSpec,
        seeds: &'a [u64],
        kind: GeneratedRows,
        rows: &'static str,
        process: tce_diffusion::Process,
        target: Target,
        sizes: [usize; 3],
        steps: u64,
        training: TrainConfig,
        dropout: Option<f64>,
        scores: Option<&'a DensityOptions>,
    }
    let training = TrainConfig { learning_rate: j.learning_rate, schedule: j.schedule, batch: j.batch, ema: j.ema };
    let spec = Spec {
        inputs: inputs.spec(scored.is_some()),
        seeds,
        kind,
        rows: if scored.is_some() { "source" } else { "target" },
        process: j.process,
        target: j.target,
        sizes: [j.width, j.embedding, j.blocks],
        steps: j.steps,
        training,
        dropout: scored.map(|_| j.guidance.dropout),
        scores: scored.map(|_| &j.scores),
    };
    let file = "joint.safetensors";
    let stage = Stage::open(root, "stages/joint", &spec, device)?;
    if let Some(trained) = stage.summary::<Trained>()? {
        return Ok((ScoreModel::load(&stage.file(file), device)?, trained, stage));
    }
    let started = std::time::Instant::now();
    let attempt = stage.attempt()?;
    let table = if scored.is_some() { inputs.source_rows()? } else { &inputs.target.rows };
    let units = RowUnits::fit(table, j.target);
    let rows = units.encode(table);
    let (d, c) = (units.live.len(), 2);
    let on = scored.map(|s| {
        let units = ScoreUnits::fit(&s.source);
        (units, units.conditions(&s.source))
    });
    let data = match &on {
        // No condition at all is the one that DmC's network learns beside the others.
        None => ScoreData::new(vec![Part { rows: &rows, condition: Condition::Constant(vec![0.0; c]) }], d, c, false)?,
        Some((_, on)) => ScoreData::new(vec![Part { rows: &rows, condition: Condition::Rows(on) }], d, c, false)?
            .with_dropout(j.guidance.dropout)?,
    };
    let network =
        NetworkConfig { width: j.width, embedding: j.embedding, blocks: j.blocks, ..NetworkConfig::new(d, c) };
    let members: Vec<_> = seeds.iter().map(|&s| Streams::new(s)).collect();
    let mut trainer = Trainer::new("joint", network, j.process, training, &members, device)?;
    let mut checkpoints = attempt.checkpoints("joint")?;
    let from = checkpoints.step().unwrap_or(0);
    let metrics = Mutex::new(attempt.metrics(|_, at| at <= from)?);
    let ready = run(&mut trainer, &data, &Course::Steps(j.steps), &mut checkpoints, &metrics, "joint", &attempt)?;
    let Ready { model, loss, .. } = ready;
    model.save(&attempt.file(file))?;
    let scores = on.map(|(units, _)| units);
    let trained = Trained { units, scores, loss, seconds: started.elapsed().as_secs_f64() };
    attempt.finish(&[file.to_owned()], &trained)?;
    Ok((model, trained, stage))
}

/// Generated tables of SynthER (`kind` synther) or DmC, one per seed, from their stage if they are there.
pub fn expand(inputs: &Inputs, config: &Config, seeds: &[u64], root: &Path, device: &Device) -> Result<Expansion> {
    #[derive(Serialize)]
    struct Spec {
        network: String,
        sampler: tce_diffusion::Sampler,
        rows: usize,
        guidance: Option<GuidanceConfig>,
    }
    let (j, kind) = (&config.joint, config.mixture.generated);
    let scored = match kind {
        GeneratedRows::Dmc => Some(scores(inputs, &j.scores, root)?),
        _ => None,
    };
    tce_base::begin_step("joint network");
    let (model, trained, network) = train(inputs, kind, j, scored.as_ref(), seeds, root, device)?;
    let guidance = scored.as_ref().map(|_| j.guidance.clone());
    let spec = Spec { network: network.name(), sampler: j.sampler, rows: j.rows, guidance };
    tce_base::begin_step("generated rows");
    let stage = Stage::open(root, "stages/generated", &spec, device)?;
    if let Some(reports) = stage.summary::<Vec<Generated>>()? {
        return read(stage, reports, scored.is_some());
    }
    let attempt = stage.attempt()?;
    let members: Vec<_> = seeds.iter().map(|&s| Streams::new(s)).collect();
    let units = &trained.units;
    // Per member, under which scores its rows are drawn.
    let under = scored.as_ref().map(|s| -> Vec<Vec<f32>> {
        let best = best_percentiles(&s.source, j.guidance.from);
        let draw = |u: Vec<f32>| draw_scores(&best, &u);
        members.iter().map(|m| draw(uniform_labels(m, "joint", j.rows, 1.0))).collect()
    });
    let condition = match (&under, &trained.scores) {
        (Some(scores), Some(units)) => units.conditions(&scores.concat()),
        _ => vec![0.0; 2 * j.rows],
    };
    let guidance = under.as_ref().map(|_| j.guidance.weight).filter(|w| *w != 1.0);
    let start =
        start_rows(model.process(), || units.encode(&inputs.target.rows), units.live.len(), j.rows, &members, "joint");
    let kept = Some(Chunks { directory: attempt.directory(), key: attempt.key() });
    let request =
        Request { name: "joint", rows: j.rows, condition: &condition, guidance, start: start.as_deref(), kept };
    let bar = progress("sample transitions", j.rows * seeds.len(), &j.sampler);
    let sampled = model.sample(request, &j.sampler, &members, Some(&bar))?;
    bar.finish();
    let mut reports = Vec::new();
    for ((m, &seed), rows) in seeds.iter().enumerate().zip(sampled.chunks(j.rows * units.live.len())) {
        let (table, kept, outside_box) = units.decode(rows);
        if table.is_empty() {
            return Err(Error::Failed(format!(
                "seed {seed}: none of {} generated rows is finite; lower joint.learning_rate, or look for huge values in the data",
                j.rows
            )));
        }
        let file = format!("generated-seed{seed}.hdf5");
        let attributes = BTreeMap::from([
            ("spec".to_owned(), serde_json::to_string(&spec).expect("plain data")),
            ("seed".to_owned(), seed.to_string()),
        ]);
        let scores = match (&scored, &under) {
            (Some(scored), Some(_)) if j.guidance.rescore => {
                let [rows, source, target] =
                    [&table, inputs.source_rows()?, &inputs.target.rows].map(Rows::transitions);
                Some(further_scores(&rows, &source, &target, &scored.scale, &j.scores, &score_streams())?)
            }
            (Some(_), Some(under)) => Some(kept.iter().map(|&i| under[m][i]).collect()),
            _ => None,
        };
        let column = scores.as_deref().map(|s| (SCORE, s));
        save_d4rl(&attempt.file(&file), &table, &attributes, column.as_slice())?;
        reports.push(Generated {
            file,
            sampled: j.rows,
            kept: table.len(),
            outside_box,
            terminal: table.terminals.iter().filter(|t| **t).count() as f64 / table.len() as f64,
            evaluations: request.evaluations(&j.sampler),
            labels: None,
        });
    }
    drop(sampled);
    let files: Vec<_> = reports.iter().map(|r| r.file.clone()).collect();
    attempt.finish(&files, &reports)?;
    // From the files, as every later run has them.
    read(stage, reports, scored.is_some())
}

fn read(stage: Stage, reports: Vec<Generated>, scored: bool) -> Result<Expansion> {
    let (mut tables, mut scores) = (Vec::new(), Vec::new());
    for report in &reports {
        let columns = if scored { vec![SCORE.to_owned()] } else { Vec::new() };
        let mut loaded = load(&stage.file(&report.file), &LoadOptions { columns, ..LoadOptions::default() })?;
        tables.push(Arc::new(loaded.transitions));
        scores.push(loaded.columns.remove(SCORE).map(Arc::new));
    }
    Ok(Expansion { tables, scores, reports, stage })
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
