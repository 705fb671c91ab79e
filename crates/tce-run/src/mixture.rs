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
use tce_augment::mixture::{ScoredRows, mix, select};
use tce_data::{
    NeighbourOptions, Rows, Transitions, TransportOptions, lambda_quantile_select, nn_distances, transport_costs,
};
use tce_learn::{LabelModels, TerminalHandling};
use tce_nn::{NamedParameters, cpu};

use crate::config::{Config, SourceRows};
use crate::error::{Error, Result};
use crate::inputs::{Domains, Inputs};
use crate::stage::Stage;

/// The rows of a mixture that are not target rows, per member; `None` for target rows alone. `source_scores` are numbers of
/// all source rows whose s' is known.
pub fn extra_rows(
    inputs: &Inputs,
    config: &Config,
    generated: Option<&[ScoredRows]>,
    labels: Option<&LabelModels>,
    source_scores: Option<Arc<Vec<f32>>>,
    seeds: &[u64],
    root: &Path,
) -> Result<Option<Vec<ScoredRows>>> {
    let mixture = &config.mixture;
    let selected: Option<Vec<ScoredRows>> = match mixture.source {
        SourceRows::None => None,
        SourceRows::All => {
            let all = ScoredRows { rows: inputs.source()?.all_rows(), scores: source_scores };
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

#[derive(Serialize)]
struct DistanceSpec {
    inputs: crate::inputs::InputSpec,
    kind: SourceRows,
}

/// One distance per source row to the target; computed once per pair of data sets.
pub fn distances(inputs: &Inputs, kind: SourceRows, root: &Path) -> Result<Vec<f32>> {
    Ok(distances_stage(inputs, kind, root)?.0)
}

/// [`distances`], and the directory where they are.
pub fn distances_stage(inputs: &Inputs, kind: SourceRows, root: &Path) -> Result<(Vec<f32>, PathBuf)> {
    let stage =
        Stage::open(root, "stages/distances", &DistanceSpec { inputs: inputs.spec(Domains::Both), kind }, &cpu())?;
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
