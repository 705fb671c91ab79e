//! The stage of TCE's score networks ([`tce_augment::two_stage`]).

use std::path::Path;

use serde::Serialize;
use tce_augment::config::UntilDoneConfig;
use tce_augment::two_stage::{Generator, Trained};
use tce_augment::work::Work;
use tce_base::OrAuto;
use tce_diffusion::{Process, Schedule, ScoreModel, Target};
use tce_nn::Device;

use super::labels::label_models;
use crate::config::Config;
use crate::error::Result;
use crate::inputs::{Domains, InputSpec, Inputs};
use crate::kept::{Kept, cycle_file};
use crate::stage::Stage;

/// What decides the trained networks.
#[derive(Serialize)]
struct Spec<'a> {
    inputs: InputSpec,
    /// The models whose actions measure q_tran.
    #[serde(skip_serializing_if = "Option::is_none")]
    labels: Option<String>,
    seeds: &'a [u64],
    process: Process,
    target: Target,
    state_steps: OrAuto<u64>,
    transition_steps: OrAuto<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    until_done: Option<UntilDoneConfig>,
    batch: usize,
    learning_rate: f64,
    schedule: Schedule,
    ema: f64,
    balanced: bool,
    source_states: bool,
}

/// The trained networks, from their stage under `root` if they are there.
///
/// # Errors
/// If data are missing, a network diverges, or the user interrupts.
pub fn networks(
    inputs: &Inputs,
    config: &Config,
    seeds: &[u64],
    root: &Path,
    device: &Device,
) -> Result<(Generator, Stage, Trained)> {
    let g = &config.generator;
    // Inferred actions tell when q_tran is done.
    let action_models = match g.transition_steps {
        OrAuto::Auto => Some(label_models(inputs, &config.labels, seeds, root, device)?),
        OrAuto::Given(_) => None,
    };
    let spec = Spec {
        inputs: inputs.spec_imitated(Domains::with_source(g.source_states), &config.target),
        labels: action_models.as_ref().map(|(_, stage, _)| stage.name()),
        seeds,
        process: g.process,
        target: g.target,
        state_steps: g.state_steps,
        transition_steps: g.transition_steps,
        until_done: [g.state_steps, g.transition_steps].contains(&OrAuto::Auto).then_some(g.until_done),
        batch: g.batch,
        learning_rate: g.learning_rate,
        schedule: g.schedule,
        ema: g.ema,
        balanced: g.balanced,
        source_states: g.source_states,
    };
    tce_base::begin_step("score networks");
    let stage = Stage::open(root, "stages/networks", &spec, device)?;
    let files = ["state.safetensors", "transition.safetensors"];
    if let Some(trained) = stage.summary::<Trained>()? {
        let [state, transition] = files.map(|f| stage.file(f));
        let generator = Generator {
            units: trained.units.clone(),
            state: ScoreModel::load(&state, device)?,
            transition: ScoreModel::load(&transition, device)?,
        };
        return Ok((generator, stage, trained));
    }
    let attempt = stage.attempt()?;
    let kept = Kept::new(&attempt);
    let work = Work { seeds, device, keeper: &kept };
    let source = if g.source_states { Some(inputs.source_rows()?) } else { None };
    let target = inputs.imitated(&config.target);
    let (generator, mut trained) = Generator::fit(source, &target, g, action_models.as_ref().map(|j| &j.0), &work)?;
    trained.seconds = attempt.seconds();
    generator.state.save(&attempt.file(files[0]))?;
    generator.transition.save(&attempt.file(files[1]))?;
    let cycles = trained.state_curve.iter().map(|end| cycle_file("state", end.step));
    let cycles = cycles.chain(trained.transition_curve.iter().map(|end| cycle_file("transition", end.step)));
    let files: Vec<_> = files.into_iter().map(String::from).chain(cycles).collect();
    attempt.finish(&files, &trained)?;
    Ok((generator, stage, trained))
}
