//! Stages of SynthER and DmC ([`tce_augment::single_stage`]): scores of source rows, the network, generated rows.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use serde::Serialize;
use tce_augment::config::{GuidanceConfig, SingleStageConfig};
use tce_augment::single_stage::{
    SingleStage, Trained, Under, enough_to_score, evaluations, rescored, score_streams, training_of,
};
use tce_augment::work::Work;
use tce_data::{
    DensityOptions, DensityScale, DensityScores, LoadOptions, Rows, Transitions, density_scores, load, save_d4rl,
};
use tce_diffusion::{Process, Sampler, ScoreModel, Target, TrainConfig};
use tce_nn::{Device, NamedParameters, cpu};

use super::augmentation::{Augmentation, Generated};
use crate::config::{Config, GeneratedRows};
use crate::error::{Error, Result};
use crate::inputs::{Domains, InputSpec, Inputs};
use crate::kept::Kept;
use crate::stage::Stage;

/// The column of scores in the files of generated rows.
const SCORE: &str = "score";

/// DmC's scores of the source rows; computed once per pair of data sets.
pub fn scores(inputs: &Inputs, options: &DensityOptions, root: &Path) -> Result<DensityScores> {
    #[derive(Serialize)]
    struct Spec<'a> {
        inputs: InputSpec,
        options: &'a DensityOptions,
    }
    let file = "scores.safetensors";
    let stage =
        Stage::open(root, "stages/source-scores", &Spec { inputs: inputs.spec(Domains::Both), options }, &cpu())?;
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

/// The rows that the network learns, and that a process with `start = "data"` starts from: the source's under scores, else the target's.
fn learned(inputs: &Inputs, scored: bool) -> Result<&Transitions> {
    if scored { inputs.source_rows() } else { Ok(&inputs.target.rows) }
}

/// The trained network, from its stage if it is there.
fn train(
    inputs: &Inputs,
    kind: GeneratedRows,
    config: &SingleStageConfig,
    scored: Option<&DensityScores>,
    seeds: &[u64],
    root: &Path,
    device: &Device,
) -> Result<(SingleStage, Stage)> {
    #[derive(Serialize)]
    struct Spec<'a> {
        inputs: InputSpec,
        seeds: &'a [u64],
        kind: GeneratedRows,
        rows: &'static str,
        process: Process,
        target: Target,
        sizes: [usize; 3],
        steps: u64,
        training: TrainConfig,
        dropout: Option<f64>,
        scores: Option<&'a DensityOptions>,
    }
    let spec = Spec {
        inputs: inputs.spec(Domains::with_source(scored.is_some())),
        seeds,
        kind,
        rows: if scored.is_some() { "source" } else { "target" },
        process: config.process,
        target: config.target,
        sizes: [config.width, config.embedding, config.blocks],
        steps: config.steps,
        training: training_of(config),
        dropout: scored.map(|_| config.guidance.dropout),
        scores: scored.map(|_| &config.scores),
    };
    let file = "joint.safetensors";
    let stage = Stage::open(root, "stages/joint", &spec, device)?;
    if let Some(trained) = stage.summary::<Trained>()? {
        return Ok((SingleStage { model: ScoreModel::load(&stage.file(file), device)?, trained }, stage));
    }
    let attempt = stage.attempt()?;
    let table = learned(inputs, scored.is_some())?;
    let kept = Kept::new(&attempt);
    let work = Work { seeds, device, keeper: &kept };
    let mut network = SingleStage::fit(table, scored.map(|s| s.source.as_slice()), config, &work)?;
    network.model.save(&attempt.file(file))?;
    network.trained.seconds = attempt.seconds();
    attempt.finish(&[file.to_owned()], &network.trained)?;
    Ok((network, stage))
}

/// Generated tables of SynthER (`mixture.generated` synther) or DmC, one per seed, from their stage if they are there.
pub fn augment_rows(
    inputs: &Inputs,
    config: &Config,
    seeds: &[u64],
    root: &Path,
    device: &Device,
) -> Result<Augmentation> {
    #[derive(Serialize)]
    struct Spec {
        network: String,
        sampler: Sampler,
        rows: usize,
        guidance: Option<GuidanceConfig>,
        /// Tells rows that start at source rows from those of earlier versions, which started at target rows.
        #[serde(skip_serializing_if = "Option::is_none")]
        start: Option<&'static str>,
    }
    let (own, kind) = (&config.single_stage, config.mixture.generated);
    let scored = match kind {
        GeneratedRows::Dmc => Some(scores(inputs, &own.scores, root)?),
        _ => None,
    };
    tce_base::begin_step("single-stage network");
    let (network, place) = train(inputs, kind, own, scored.as_ref(), seeds, root, device)?;
    let guidance = scored.as_ref().map(|_| own.guidance.clone());
    let start = (scored.is_some() && own.process.starts_at_data()).then_some("source");
    let spec = Spec { network: place.name(), sampler: own.sampler, rows: own.rows, guidance, start };
    tce_base::begin_step("generated rows");
    let stage = Stage::open(root, "stages/generated", &spec, device)?;
    if let Some(reports) = stage.summary::<Vec<Generated>>()? {
        return read(stage, reports, scored.is_some());
    }
    let attempt = stage.attempt()?;
    let kept = Kept::new(&attempt);
    let work = Work { seeds, device, keeper: &kept };
    let table = learned(inputs, scored.is_some())?;
    let sampled = network.sample(scored.as_ref().map(|s| s.source.as_slice()), table, own, &work)?;
    let mut reports = Vec::new();
    for (&seed, sampled) in seeds.iter().zip(sampled) {
        let table = sampled.rows;
        let scores = match &scored {
            Some(scored) if own.guidance.rescore => {
                Some(rescored(&table, inputs.source_rows()?, &inputs.target.rows, &scored.scale, &own.scores)?)
            }
            _ => sampled.scores,
        };
        let file = format!("generated-seed{seed}.hdf5");
        let attributes = BTreeMap::from([
            ("spec".to_owned(), serde_json::to_string(&spec).expect("plain data")),
            ("seed".to_owned(), seed.to_string()),
        ]);
        let column = scores.as_deref().map(|s| (SCORE, s));
        save_d4rl(&attempt.file(&file), &table, &attributes, column.as_slice())?;
        reports.push(Generated {
            file,
            sampled: own.rows,
            kept: table.len(),
            outside_box: sampled.outside_box,
            terminal: table.terminals.iter().filter(|t| **t).count() as f64 / table.len() as f64,
            evaluations: evaluations(own, Under::of(scored.as_ref())),
            labels: None,
        });
    }
    let files: Vec<_> = reports.iter().map(|r| r.file.clone()).collect();
    attempt.finish(&files, &reports)?;
    // From the files, as every later run has them.
    read(stage, reports, scored.is_some())
}

fn read(stage: Stage, reports: Vec<Generated>, scored: bool) -> Result<Augmentation> {
    let (mut tables, mut scores) = (Vec::new(), Vec::new());
    for report in &reports {
        let columns = if scored { vec![SCORE.to_owned()] } else { Vec::new() };
        let mut loaded = load(&stage.file(&report.file), &LoadOptions { columns, ..LoadOptions::default() })?;
        tables.push(Arc::new(loaded.transitions));
        scores.push(loaded.columns.remove(SCORE).map(Arc::new));
    }
    Ok(Augmentation { tables, scores, reports, stage })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::own::Own;

    /// A network under scores (DmC's) has learned source rows and starts from them, one without (SynthER's) target rows.
    #[test]
    fn a_network_starts_from_the_rows_that_it_has_learned() {
        let walk = |rows: usize, pace: f32| {
            let mut t = Transitions::new(1, 1);
            for i in 0..rows {
                let x = pace * i as f32;
                t.push(&[x], &[0.5], x, &[x + pace], false, i + 1 == rows);
            }
            Arc::new(t)
        };
        let inputs = Inputs::of_rows(Some(walk(40, 2.0)), walk(20, 1.0), None, &Own::default()).unwrap();
        assert_eq!([true, false].map(|scored| learned(&inputs, scored).unwrap().len()), [40, 20]);
    }
}
