//! D_mix^λ: which rows join the target rows (Section 4.4), besides or instead of generated ones.
//!
//! | rows | meaning |
//! |---|---|
//! | nearest | λ-quantile of the distance to the nearest target row in [s, a, s'] (Eq. 9) |
//! | transport | λ share with the least optimal-transport cost, in OTDF's blocks |
//! | all | D_src as it is (IQL*) |
//! | relabelled | D_src with the actions that the target's inverse dynamics infers (SwT) |
//!
//! Source and generated rows stand λ : (1 − λ) in the mixture. The paper generates (1 − λ)|D_src| rows; where fewer are
//! generated, the mixture shrinks and its ratio stays.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Serialize;
use tce_base::Streams;
use tce_base::random::choose;
use tce_data::{
    NeighbourOptions, Rows, Transitions, TransportOptions, lambda_quantile_select, nn_distances, transport_costs,
};
use tce_learn::{LabelModels, TerminalHandling};
use tce_nn::{NamedParameters, cpu};

use crate::config::{Config, SourceRows};
use crate::error::{Error, Result};
use crate::inputs::Inputs;
use crate::stage::Stage;

/// Rows that are no target rows, and perhaps a number for each.
#[derive(Clone, Debug)]
pub struct Extra {
    /// The rows.
    pub rows: Arc<Transitions>,
    /// One number per row.
    pub scores: Option<Arc<Vec<f32>>>,
}

/// The rows at `indices`, with their numbers.
fn select(rows: &Transitions, scores: Option<&Vec<f32>>, indices: &[usize]) -> Extra {
    let scores = scores.map(|s| Arc::new(indices.iter().map(|&i| s[i]).collect()));
    Extra { rows: Arc::new(rows.select(indices)), scores }
}

impl From<Arc<Transitions>> for Extra {
    fn from(rows: Arc<Transitions>) -> Self {
        Self { rows, scores: None }
    }
}

/// The rows of a mixture that are not target rows, per member; `None` for target rows alone. `source_scores` are numbers of all
/// source rows.
pub fn extra_rows(
    inputs: &Inputs,
    config: &Config,
    generated: Option<&[Extra]>,
    labels: Option<&LabelModels>,
    source_scores: Option<Arc<Vec<f32>>>,
    seeds: &[u64],
    root: &Path,
) -> Result<Option<Vec<Extra>>> {
    let mixture = &config.mixture;
    let selected: Option<Vec<Extra>> = match mixture.source {
        SourceRows::None => None,
        SourceRows::All => {
            let rows = match config.learner.algorithm.looks_at_successors() {
                true => inputs.source_rows()?,
                false => inputs.source()?.complete(),
            };
            let all = Extra { rows: Arc::new(rows.clone()), scores: source_scores };
            Some(vec![all; seeds.len()])
        }
        SourceRows::Relabelled => {
            let models = labels.ok_or_else(|| Error::Failed("relabelling needs the label models".into()))?;
            let source = inputs.source_rows()?;
            let pairs = vec![(source.observations.clone(), source.next_observations.clone()); seeds.len()];
            // Only the actions are inferred; everything else stays as the source has it.
            let labelled = models.label(&pairs, TerminalHandling::None)?;
            let table = |l: tce_learn::Labelled| {
                Arc::new(Transitions { actions: l.transitions.actions, ..source.clone() }).into()
            };
            Some(labelled.into_iter().map(table).collect())
        }
        SourceRows::Nearest | SourceRows::Transport => {
            let source = inputs.source_rows()?;
            let indices = lambda_quantile_select(&distances(inputs, mixture.source, root)?, mixture.lambda);
            let selected = select(source, source_scores.as_deref(), &indices);
            Some(vec![selected; seeds.len()])
        }
    };
    Ok(match (generated, selected) {
        (None, selected) => selected,
        (Some(generated), None) => Some(generated.to_vec()),
        (Some(generated), Some(selected)) => Some(
            generated.iter().zip(&selected).zip(seeds).map(|((g, s), &seed)| mix(s, g, mixture.lambda, seed)).collect(),
        ),
    })
}

/// Source and generated rows in the ratio λ : (1 − λ), as many as there are of both; what is too many is left out at
/// random.
fn mix(source: &Extra, generated: &Extra, lambda: f64, seed: u64) -> Extra {
    let (sources, others) = (source.rows.len() as f64, generated.rows.len() as f64);
    let total = (sources / lambda).min(others / (1.0 - lambda));
    let (n_source, n_generated) = ((lambda * total).round() as usize, ((1.0 - lambda) * total).round() as usize);
    let source = subset(source, n_source, Streams::new(seed), "mixture/source");
    let generated = subset(generated, n_generated, Streams::new(seed), "mixture/generated");
    let mut rows = Arc::unwrap_or_clone(source.rows);
    rows.extend(&generated.rows);
    let scores = source.scores.zip(generated.scores).map(|(s, g)| Arc::new([s.as_slice(), g.as_slice()].concat()));
    Extra { rows: Arc::new(rows), scores }
}

/// `n` rows at random, in their order.
fn subset(rows: &Extra, n: usize, streams: Streams, name: &str) -> Extra {
    if n >= rows.rows.len() {
        return rows.clone();
    }
    select(&rows.rows, rows.scores.as_deref(), &choose(&mut streams.stream(name), rows.rows.len(), n))
}

#[derive(Serialize)]
struct DistanceSpec {
    inputs: crate::inputs::InputSpec,
    kind: SourceRows,
}

/// One number per source row, the smaller the closer to the target; computed once per pair of data sets.
pub fn distances(inputs: &Inputs, kind: SourceRows, root: &Path) -> Result<Vec<f32>> {
    Ok(distances_stage(inputs, kind, root)?.0)
}

/// [`distances`], and the directory where they are.
pub fn distances_stage(inputs: &Inputs, kind: SourceRows, root: &Path) -> Result<(Vec<f32>, PathBuf)> {
    let stage = Stage::open(root, "stages/distances", &DistanceSpec { inputs: inputs.spec(true), kind }, &cpu())?;
    let file = stage.file("distances.safetensors");
    if stage.summary::<usize>()?.is_some() {
        let mut loaded = NamedParameters::load(&file)?;
        let remedy = "no tensor `distances`; remove the directory to compute it again";
        let (_, values) = loaded.tensors.remove("distances").ok_or_else(|| Error::missing(&file, remedy))?;
        return Ok((values, stage.directory().to_owned()));
    }
    let (source, target) = (Rows::transitions(inputs.source_rows()?), Rows::transitions(&inputs.target.rows));
    let values = match kind {
        SourceRows::Transport => transport_costs(&source, &target, &TransportOptions::default())?,
        _ => nn_distances(&source, &target, &NeighbourOptions::default())?,
    };
    let mut out = NamedParameters::default();
    out.tensors.insert("distances".into(), (vec![values.len()], values.clone()));
    let attempt = stage.attempt()?;
    out.save(&attempt.file("distances.safetensors"))?;
    attempt.finish(&["distances.safetensors".into()], values.len())?;
    Ok((values, stage.directory().to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(value: f32, n: usize) -> Arc<Transitions> {
        let mut t = Transitions::new(1, 1);
        for _ in 0..n {
            t.push(&[value], &[0.0], 0.0, &[value], false, false);
        }
        Arc::new(t)
    }

    #[test]
    fn the_ratio_is_kept_whatever_is_scarce() {
        for (n_source, n_generated) in [(1000, 900), (10, 900), (1000, 18)] {
            let extra =
                |value: f32, n: usize| Extra { scores: Some(Arc::new(vec![value; n])), ..rows(value, n).into() };
            let mixed = mix(&extra(1.0, n_source), &extra(0.0, n_generated), 0.1, 0);
            assert_eq!(mixed.rows.observations, *mixed.scores.unwrap(), "scores stay with their rows");
            let mixed = mixed.rows;
            let share = mixed.observations.iter().sum::<f32>() / mixed.len() as f32;
            assert!((share - 0.1).abs() < 0.03, "{n_source} {n_generated}: {share}");
            assert!(mixed.len() >= 20);
        }
    }

    #[test]
    fn a_subset_is_reproducible_and_without_repetition() {
        let mut t = Transitions::new(1, 1);
        (0..100).for_each(|i| t.push(&[i as f32], &[0.0], 0.0, &[0.0], false, false));
        let t = Extra::from(Arc::new(t));
        let a = subset(&t, 30, Streams::new(1), "x").rows;
        assert_eq!(a, subset(&t, 30, Streams::new(1), "x").rows);
        assert!(a.observations.windows(2).all(|w| w[0] < w[1]));
    }
}
