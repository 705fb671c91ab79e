//! What a plan will cost on this machine: hours of one core, by tier.
//!
//! A piece of work is a number of updates, rows and steps, which its configuration tells; how many of them a core does in a second is
//! measured now, for a fraction of a second each, by the workloads of `tce bench`. They have HalfCheetah's sizes, so that the estimate is
//! good to a factor of about two.

use std::collections::BTreeMap;

use serde::Serialize;
use tce_run::config::{Algorithm, Config, GeneratedRows, SourceRows};
use tce_run::error::Result;
use tce_run::sweep::{Entry, Kind, Manifest};
use tce_sim::EPISODE_LIMIT;

use crate::bench::{On, measure};

/// Seconds of each measurement.
const SECONDS: f64 = 0.2;

/// The cost of a tier.
#[derive(Debug, Serialize)]
pub(super) struct TierCost {
    /// Its name; empty where there are no tiers.
    pub tier: String,
    /// Pieces of work.
    pub pieces: usize,
    /// Hours of one core.
    pub core_hours: f64,
}

/// Units a second of one core, by workload, each measured once.
struct Rates {
    on: On,
    known: BTreeMap<String, f64>,
}

impl Rates {
    /// Seconds that `units` of the workload `name` take.
    fn seconds(&mut self, name: &str, units: f64) -> Result<f64> {
        if let Some(rate) = self.known.get(name) {
            return Ok(units / rate);
        }
        let before = tce_base::set_quiet(true);
        let measured = measure(name, 1, SECONDS, &self.on);
        tce_base::set_quiet(before);
        let measured = measured?;
        let rate = measured.per_second / rayon::current_num_threads() as f64;
        self.known.insert(name.to_owned(), rate);
        Ok(units / rate)
    }

    fn piece(&mut self, entry: &Entry, config: &Config) -> Result<f64> {
        let environment = format!("env-{}", entry.task.agent);
        Ok(match entry.kind {
            Kind::Source => self.seconds(&environment, config.source.rows as f64)?,
            Kind::Target => self.seconds(&environment, tce_zoo::recipes::TARGET_ROWS as f64)?,
            Kind::Distances => {
                let workload = if config.mixture.source == SourceRows::Transport { "transport" } else { "nearest" };
                self.seconds(workload, config.source.rows as f64)?
            }
            Kind::Augment => self.augmentation(config)?,
            Kind::Run => self.training(config)? + self.evaluation(&environment, config)?,
            Kind::Verdict => {
                let d = &config.dynamics;
                self.seconds("bc", d.steps as f64 * d.members as f64 * d.batch as f64 / 256.0)?
            }
        })
    }

    fn augmentation(&mut self, config: &Config) -> Result<f64> {
        let g = &config.generator;
        Ok(match config.mixture.generated {
            GeneratedRows::None => self.seconds("labels", config.labels.training.steps as f64)?,
            GeneratedRows::Tce => {
                // A network that trains until it is done is taken to need all that it may.
                let updates = g.state_steps.most(g.until_done.state_limit)
                    + g.transition_steps.most(g.until_done.transition_limit);
                let rows =
                    if g.rows == 0 { (1.0 - config.mixture.lambda) * config.source.rows as f64 } else { g.rows as f64 };
                self.seconds("score-train", updates as f64)?
                    + self.seconds("labels", config.labels.training.steps as f64)?
                    + self.seconds("sample", 2.0 * rows)?
            }
            GeneratedRows::Synther | GeneratedRows::Dmc => {
                let s = &config.single_stage;
                self.seconds("score-train", s.steps as f64)? + self.seconds("sample", s.rows as f64)?
            }
        })
    }

    fn training(&mut self, config: &Config) -> Result<f64> {
        let learner = &config.learner;
        let steps = learner.steps(config.mixture.learned_rows()) as f64;
        Ok(match learner.algorithm {
            // The workload is one clone of two layers.
            Algorithm::Bc => {
                let width = |hidden: &[usize]| hidden.windows(2).map(|w| (w[0] * w[1]) as f64).sum::<f64>();
                let layers = width(&learner.bc.actor.hidden) / width(&[256, 256]);
                self.seconds("bc", steps * layers * learner.bc.ensemble as f64 * learner.batch() as f64 / 256.0)?
            }
            Algorithm::MetaDt => {
                self.seconds("meta-dt", steps)?
                    + self.seconds("meta-dt-world", learner.meta_dt.world_model.steps as f64)?
            }
            algorithm => self.seconds(algorithm.about().name, steps)?,
        })
    }

    fn evaluation(&mut self, environment: &str, config: &Config) -> Result<f64> {
        // The policy takes about as long as the robot.
        self.seconds(environment, 2.0 * (config.evaluation.episodes * EPISODE_LIMIT) as f64)
    }
}

/// The cost of every tier of `manifest`, in their order.
///
/// # Errors
/// If a configuration cannot be read, or the user interrupts.
pub(super) fn costs(manifest: &Manifest) -> Result<Vec<TierCost>> {
    tce_sim::open_library()?;
    let mut rates = Rates { on: On { device: tce_nn::cpu(), seeds: 1 }, known: BTreeMap::new() };
    let mut configs: BTreeMap<&str, Config> = BTreeMap::new();
    let tier = |name: &str| TierCost { tier: name.to_owned(), pieces: 0, core_hours: 0.0 };
    let mut tiers: Vec<TierCost> = manifest.tiers().into_iter().map(tier).collect();
    for entry in &manifest.entries {
        if !configs.contains_key(entry.config.as_str()) {
            configs.insert(&entry.config, manifest.config(entry)?);
        }
        let seconds = rates.piece(entry, &configs[entry.config.as_str()])?;
        for tier in tiers.iter_mut().filter(|t| t.tier == entry.tier) {
            tier.pieces += 1;
            tier.core_hours += seconds / 3600.0;
        }
    }
    Ok(tiers)
}
