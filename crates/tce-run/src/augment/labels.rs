//! The stage of the label models.

use std::path::Path;

use serde::Serialize;
use tce_augment::config::{LabelsConfig, Terminal};
use tce_augment::finish::{fit_labels, label_members};
use tce_learn::{LabelConfig, LabelErrors, LabelModels, Learner};
use tce_nn::{Device, NamedParameters};

use crate::error::Result;
use crate::inputs::{Domains, InputSpec, Inputs};
use crate::stage::Stage;

/// The inverse dynamics and reward models of a whole population: trained on the target rows, or taken from their stage.
pub fn label_models(
    inputs: &Inputs,
    config: &LabelsConfig,
    seeds: &[u64],
    root: &Path,
    device: &Device,
) -> Result<(LabelModels, Stage, Vec<Option<LabelErrors>>)> {
    #[derive(Serialize)]
    struct Spec<'a> {
        inputs: InputSpec,
        seeds: &'a [u64],
        labels: &'a LabelConfig,
    }
    let learn_terminals = terminals(inputs, config) == Terminal::Learned;
    let labels = LabelConfig { learn_terminals, ..config.training.clone() };
    let spec = Spec { inputs: inputs.spec(Domains::with_source(learn_terminals)), seeds, labels: &labels };
    tce_base::begin_step("label models");
    let stage = Stage::open(root, "stages/labels", &spec, device)?;
    let source = inputs.source.as_ref().filter(|_| learn_terminals).map(|s| s.rows.clone());
    let members = label_members(inputs.target.rows.clone(), source, seeds);
    let file = "labels.safetensors";
    let path = stage.file(file);
    if let Some(errors) = stage.summary::<Vec<Option<LabelErrors>>>()? {
        let mut models = LabelModels::new(&members, &labels, device)?;
        models.restore(&NamedParameters::load(&path)?, &path)?;
        return Ok((models, stage, errors));
    }
    let attempt = stage.attempt()?;
    let models = fit_labels(&members, &labels, &mut attempt.checkpoints("labels")?, device)?;
    let errors = models.errors();
    models.state().save(&attempt.file(file))?;
    attempt.finish(&[file.to_owned()], &errors)?;
    Ok((models, stage, errors))
}

/// Where terminal flags of generated rows come from, for these files: a benchmark robot's rule only where the user named the robot.
pub(super) fn terminals(inputs: &Inputs, config: &LabelsConfig) -> Terminal {
    let any = std::iter::once(&inputs.target).chain(&inputs.source).any(|t| t.rows.terminals.contains(&true));
    config.terminal_for(inputs.agent.is_some(), any)
}
