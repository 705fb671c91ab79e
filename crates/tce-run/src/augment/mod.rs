//! Coverage expansion as one stage (Algorithm 1, lines 2 to 7): networks, samples, filter (Eq. 8), labels; one table of
//! generated transitions per member.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use serde::Serialize;
use tce_augment::augmenter::support_of;
use tce_augment::config::{FilterConfig, Terminal};
use tce_augment::finish::{Finisher, TerminalRule, everything_rejected};
use tce_augment::two_stage::{Draw, Generator};
use tce_augment::units::Units;
use tce_base::Streams;
use tce_data::{LoadOptions, Support, Transitions, load, save_d4rl};
use tce_diffusion::{Chunks, Sampler};
use tce_learn::{LabelErrors, LabelModels, Labelled};
use tce_nn::Device;
use tce_sim::terminal_rule;

use crate::config::{Config, GeneratedRows};
use crate::error::{Error, Result};
use crate::inputs::Inputs;
use crate::off_policy_evaluation::OffPolicyEvaluator;
use crate::stage::{Attempt, Stage};

mod augmentation;
mod labels;
mod networks;
pub mod own_tables;
pub mod single_stage;

pub use augmentation::{Augmentation, Generated};
pub use labels::label_models;
use labels::terminals;
pub use networks::networks;

/// Filters and labels rows of `units` as `config` says, for the data of `inputs`.
pub fn finisher<'a>(units: &'a Units, models: &'a LabelModels, config: &'a Config, inputs: &Inputs) -> Finisher<'a> {
    let rule = |agent| -> TerminalRule { Arc::new(move |state: &[f32]| terminal_rule(agent, state)) };
    let terminal = terminals(inputs, &config.labels);
    Finisher { units, models, filter: &config.filter, terminal, rule: inputs.agent.map(rule) }
}

/// The generated rows that `config.mixture` asks for, made or taken from their stage.
pub fn augment_rows(
    inputs: &Inputs,
    config: &Config,
    seeds: &[u64],
    root: &Path,
    device: &Device,
) -> Result<Augmentation> {
    let inputs = &*inputs.seen_by(config);
    match config.mixture.generated {
        GeneratedRows::Tce => two_stages(inputs, config, seeds, root, device),
        GeneratedRows::Synther | GeneratedRows::Dmc => single_stage::augment_rows(inputs, config, seeds, root, device),
        GeneratedRows::None => Err(Error::Usage(
            "mixture.generated: found \"none\", expected \"tce\", \"synther\" or \"dmc\": there is nothing to generate"
                .into(),
        )),
    }
}

/// What generated rows are made to respect, where `config` says so: what the observations of all data do.
pub fn support(inputs: &Inputs, config: &Config) -> Option<Support> {
    if !config.generator.support {
        return None;
    }
    let tables: Vec<_> = std::iter::once(&inputs.target).chain(&inputs.source).map(|t| &*t.rows).collect();
    let support = support_of(&tables);
    support.describe().iter().for_each(|finding| tce_base::note!("generated rows respect: {finding}"));
    Some(support)
}

/// The learned dynamics that filter generated rows, where `config` says that any do.
pub fn filtering_models(
    inputs: &Inputs,
    config: &Config,
    root: &Path,
    device: &Device,
) -> Result<Option<OffPolicyEvaluator>> {
    match config.filter.by_dynamics() {
        true => OffPolicyEvaluator::train(inputs, &config.dynamics, root, device).map(Some),
        false => Ok(None),
    }
}

/// What decides TCE's generated rows.
#[derive(Serialize)]
struct Spec<'a> {
    networks: String,
    labels: String,
    sampler: Sampler,
    y_max: f32,
    rows: usize,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    support: bool,
    /// The models that filter, where any do.
    #[serde(skip_serializing_if = "Option::is_none")]
    dynamics: Option<String>,
    filter: &'a FilterConfig,
    terminal: Terminal,
}

/// Runs, or takes from its stage, TCE's whole augmentation.
fn two_stages(inputs: &Inputs, config: &Config, seeds: &[u64], root: &Path, device: &Device) -> Result<Augmentation> {
    let rows = rows_of(inputs, config)?;
    let (generator, place, _) = networks(inputs, config, seeds, root, device)?;
    let (models, labels, label_errors) = label_models(inputs, &config.labels, seeds, root, device)?;
    let evaluator = filtering_models(inputs, config, root, device)?;
    let spec = Spec {
        networks: place.name(),
        labels: labels.name(),
        dynamics: evaluator.as_ref().map(|j| j.stage.name()),
        sampler: config.generator.sampler,
        y_max: config.generator.y_max,
        rows,
        support: config.generator.support,
        filter: &config.filter,
        terminal: config.labels.terminal,
    };
    tce_base::begin_step("generated rows");
    let stage = Stage::open(root, "stages/generated", &spec, device)?;
    let (reports, tables) = match stage.summary::<Vec<Generated>>()? {
        Some(reports) => {
            let read = |g: &Generated| Ok(Arc::new(load(&stage.file(&g.file), &LoadOptions::default())?.transitions));
            let tables = reports.iter().map(read).collect::<Result<Vec<_>>>()?;
            (reports, tables)
        }
        None => {
            let attempt = stage.attempt()?;
            let finisher = finisher(&generator.units, &models, config, inputs);
            let finished = sampled(&generator, &finisher, evaluator.as_ref(), (inputs, config, seeds, rows), &attempt)?;
            write(finished, &spec, seeds, &label_errors, attempt)?
        }
    };
    let scores = vec![None; tables.len()];
    Ok(Augmentation { tables, scores, reports, stage })
}

/// How many rows are generated for every seed.
///
/// # Errors
/// If there are none.
fn rows_of(inputs: &Inputs, config: &Config) -> Result<usize> {
    let source = if config.generator.rows == 0 { inputs.source_rows()?.len() } else { 0 };
    match config.generator.rows_beside(config.mixture.lambda, source) {
        0 => Err(Error::Usage(format!(
            "generator.rows = 0 means (1 - mixture.lambda) times the source rows: found none of {source} at mixture.lambda = {}, expected at least one; \
             give a number of rows",
            config.mixture.lambda
        ))),
        rows => Ok(rows),
    }
}

/// `rows` rows for every seed, sampled, filtered and labelled.
fn sampled(
    generator: &Generator,
    finisher: &Finisher,
    evaluator: Option<&OffPolicyEvaluator>,
    (inputs, config, seeds, rows): (&Inputs, &Config, &[u64], usize),
    attempt: &Attempt,
) -> Result<Vec<Labelled>> {
    let members: Vec<_> = seeds.iter().map(|&s| Streams::new(s)).collect();
    let target = &*inputs.imitated(&config.target);
    let support = support(inputs, config);
    let chunks = Chunks { directory: attempt.directory(), key: attempt.key() };
    let draw = Draw::new(&config.generator.sampler, &members, target).within(support.as_ref()).keeping(chunks);
    let (states, successors) = generator.sample_pairs(rows, config.generator.y_max, &draw)?;
    let per_member = rows * generator.units.live.len();
    let pairs: Vec<_> = states.chunks(per_member).zip(successors.chunks(per_member)).collect();
    let mut finished = finisher.finish(&pairs)?;
    if let Some(evaluator) = evaluator {
        for labelled in &mut finished {
            let possible = evaluator.possible(&labelled.transitions, config.filter.margin);
            let keep: Vec<usize> = (0..possible.len()).filter(|&i| possible[i]).collect();
            if keep.is_empty() {
                return Err(everything_rejected(rows, &config.filter).into());
            }
            labelled.transitions = labelled.transitions.select(&keep);
        }
    }
    Ok(finished)
}

/// Writes a file for every seed, and marks the stage as done.
fn write(
    finished: Vec<Labelled>,
    spec: &Spec,
    seeds: &[u64],
    errors: &[Option<LabelErrors>],
    attempt: Attempt,
) -> Result<(Vec<Generated>, Vec<Arc<Transitions>>)> {
    let (mut reports, mut tables) = (Vec::new(), Vec::new());
    for ((&seed, labelled), errors) in seeds.iter().zip(finished).zip(errors) {
        let table = labelled.transitions;
        let file = format!("generated-seed{seed}.hdf5");
        let attributes = BTreeMap::from([
            ("spec".to_owned(), serde_json::to_string(spec).expect("plain data")),
            ("seed".to_owned(), seed.to_string()),
        ]);
        save_d4rl(&attempt.file(&file), &table, &attributes, &[])?;
        let terminals = table.terminals.iter().filter(|t| **t).count();
        reports.push(Generated {
            file,
            sampled: spec.rows,
            kept: table.len(),
            outside_box: labelled.outside_box,
            terminal: terminals as f64 / table.len() as f64,
            evaluations: 2 * spec.sampler.evaluations(),
            labels: *errors,
        });
        tables.push(Arc::new(table));
    }
    let files: Vec<_> = reports.iter().map(|r| r.file.clone()).collect();
    attempt.finish(&files, &reports)?;
    Ok((reports, tables))
}
