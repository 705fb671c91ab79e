//! `tce diagnose RUN`: what a run's generator does, measured (the paper's Fig. 1a, Fig. 3, Appendix F, Theorem 1), as one stage.
//!
//! | piece | file |
//! |---|---|
//! | rows over y_max: sampled, filtered, labelled, simulated | `rows.rs` |
//! | abundant target rows, and the models that are compared | `models.rs` |
//! | every metric of a diagnosis | `measures.rs` |
//! | the policy that the generator implies | `implied.rs` |
//! | the networks at the ends of q_tran's cycles (`tce diagnose generator --cycles`) | `cycles.rs` |
//! | one sampler beside others (`tce diagnose generator`) | `generator.rs` |
//! | the measures themselves | the crate `tce-diagnosis` |
//!
//! Everything is drawn from streams that no training uses. Where the simulator cannot be used (somebody's own robot), or must not be
//! (`simulator = false`), what needs it is left out and named in the notes; λ is chosen without it in any case.

use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::json;
use tce_base::write_json;
use tce_data::Task;
use tce_diagnosis::Diagnosis;
use tce_nn::Device;

use crate::augment::{filtering_models, finisher, label_models, networks, support};
use crate::config::{Config, GeneratedRows};
use crate::course::Course;
use crate::error::{Error, Result};
use crate::inputs::{Domains, InputSpec, Inputs};
use crate::stage::Stage;

pub mod cycles;
pub mod generator;
pub mod implied;
pub(crate) mod measures;
mod models;
mod notes;
mod references;
mod rows;
mod subject;
mod work;

use rows::Sampler;
pub use subject::{Options, Subject};
use work::Work;

/// Changes when the same rows would give other metrics.
const VERSION: u32 = 7;
/// With fewer target rows neighbourhoods mean nothing.
const FEWEST: usize = 100;

/// Refuses a run without coverage expansion, before its data are read or collected.
///
/// # Errors
/// If the run has no generated rows of TCE.
pub fn can_be_diagnosed(of: &str, config: &Config) -> Result<()> {
    match config.mixture.generated {
        GeneratedRows::Tce => Ok(()),
        other => Err(Error::Usage(format!(
            "{of}: found mixture.generated = {other:?}, expected \"tce\": there is no coverage expansion to diagnose; choose a run of \
             tce-og or another variant with generated rows"
        ))),
    }
}

/// The place of `seed` among a run's seeds.
///
/// # Errors
/// If it is none of them.
pub fn member_of(seeds: &[u64], seed: u64) -> Result<usize> {
    let place = seeds.iter().position(|s| *s == seed);
    place.ok_or_else(|| Error::Usage(format!("--seed {seed}: the run's seeds are {seeds:?}; choose one of them")))
}

/// Refuses tables of which nothing can be told.
fn ensure_enough(inputs: &Inputs) -> Result<()> {
    let source = inputs.source.as_ref().map(|s| ("source", s));
    for (name, table) in [("target", &inputs.target)].into_iter().chain(source) {
        let found = table.rows.len();
        if found < FEWEST {
            return Err(Error::Usage(format!(
                "{}: found {found} {name} rows, expected at least {FEWEST}: nothing can be said of generated rows beside so few",
                table.file.display()
            )));
        }
    }
    Ok(())
}

/// What decides a diagnosis.
#[derive(Serialize)]
struct Spec<'a> {
    version: u32,
    of: &'a str,
    task: Option<Task>,
    inputs: InputSpec,
    config: serde_json::Value,
    seeds: &'a [u64],
    seed: u64,
    options: &'a Options,
}

impl<'a> Spec<'a> {
    fn new(subject: &'a Subject, options: &'a Options) -> Self {
        let Subject { inputs, config, seeds, seed, .. } = *subject;
        let mut used = json!({
            "generator": config.generator, "filter": config.filter, "labels": config.labels, "mixture": config.mixture,
            "iql": config.learner.iql, "batch": config.learner.batch, "scores": config.evaluation.scores,
        });
        if config.filter.by_dynamics() {
            used["dynamics"] = json!(config.dynamics);
        }
        Self {
            version: VERSION,
            of: &subject.of,
            task: subject.task,
            inputs: inputs.spec_imitated(Domains::Both, &config.target),
            config: used,
            seeds,
            seed,
            options,
        }
    }
}

/// Diagnoses, or takes the result from its stage under `root`. Returns it with the stage's directory.
///
/// # Errors
/// If the run has no generated rows of TCE, or a part of the work fails.
pub fn diagnose(subject: &Subject, options: &Options, root: &Path, device: &Device) -> Result<(Diagnosis, PathBuf)> {
    let Subject { inputs, config, seeds, seed, .. } = *subject;
    can_be_diagnosed(&subject.of, config)?;
    let member = member_of(seeds, seed)?;
    ensure_enough(inputs)?;
    let stage = Stage::open(root, "stages/diagnosis", &Spec::new(subject, options), device)?;
    let file = "diagnosis.json".to_owned();
    if stage.summary::<serde_json::Value>()?.is_some() {
        return Ok((read(&stage.file(&file))?, stage.directory().to_owned()));
    }
    let mut course = Course::new(
        format!("{}x{}", inputs.target.rows.obs_dim, inputs.target.rows.act_dim),
        seeds.len(),
        device,
        root,
    );
    course.generating(config);
    for part in measures::PARTS {
        course.step(part, json!([options, inputs.target.rows.len()]));
    }
    course.plan();
    // The run's own networks have seen no source where it has no use for one; the measures compare with the source in any case.
    let seen = &*inputs.seen_by(config);
    let (generator, ..) = networks(seen, config, seeds, root, device)?;
    let (models, _, errors) = label_models(seen, &config.labels, seeds, root, device)?;
    let finisher = finisher(&generator.units, &models, config, seen);
    let place = (inputs.agent, inputs.shift);
    let simulator = match place {
        (Some(agent), Some(shift)) if options.simulator => Some((agent, shift)),
        _ => None,
    };
    let imitated = inputs.imitated(&config.target);
    let sampler = Sampler {
        generator: &generator,
        finisher: &finisher,
        config,
        target: &imitated,
        support: support(seen, config),
        evaluator: filtering_models(seen, config, root, device)?,
        seeds,
        member,
        simulator,
    };
    let attempt = stage.attempt()?;
    let work = Work { subject, options, root, sampler: &sampler, simulator };
    let diagnosis = work.done(errors[member], &attempt, device)?;
    write_json(&attempt.file(&file), &diagnosis)?;
    // The summary says what the report looks for, without reading every diagnosis.
    attempt.finish(
        std::slice::from_ref(&file),
        serde_json::json!({ "of": subject.of, "task": subject.task, "seed": seed }),
    )?;
    Ok((diagnosis, stage.directory().to_owned()))
}

/// A diagnosis from its file.
///
/// # Errors
/// If it cannot be read.
pub fn read(path: &Path) -> Result<Diagnosis> {
    let bytes = std::fs::read(path).map_err(|e| tce_base::FileError::new(path, "read", e))?;
    serde_json::from_slice(&bytes).map_err(|e| {
        Error::Failed(format!(
            "{}: {e}; it was written by another version of tce: remove the directory and diagnose again",
            path.display()
        ))
    })
}
