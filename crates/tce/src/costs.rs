//! What work costs on this machine, in seconds of one core.
//!
//! A piece of work is a number of updates, rows and steps, which its configuration tells. How many of them a core does in a second is
//! measured by the workloads of `tce bench`.

use std::collections::BTreeMap;

use tce_run::config::{Algorithm, Config, GeneratedRows, SourceRows};
use tce_run::error::Result;
use tce_sim::EPISODE_LIMIT;

use crate::bench::{Measured, On, measure};

/// Seconds of each measurement that is made for an estimate.
const SECONDS: f64 = 0.2;

/// Units a second of one core, by workload, each measured once.
pub struct Rates {
    on: On,
    known: BTreeMap<String, f64>,
}

/// What is measured, a second of one core.
fn of_a_core(measured: &Measured) -> f64 {
    measured.per_second / rayon::current_num_threads() as f64
}

impl Rates {
    /// Rates of the CPU. What `measured` does not hold is measured when it is asked for.
    pub fn new(measured: &[Measured]) -> Self {
        let known = measured.iter().map(|m| (m.name.clone(), of_a_core(m))).collect();
        Self { on: On { device: tce_nn::cpu(), seeds: 1 }, known }
    }

    /// Seconds that `units` of the workload `name` take.
    pub fn seconds(&mut self, name: &str, units: f64) -> Result<f64> {
        if let Some(rate) = self.known.get(name) {
            return Ok(units / rate);
        }
        let before = tce_base::set_quiet(true);
        let measured = measure(name, 1, SECONDS, &self.on);
        tce_base::set_quiet(before);
        let rate = of_a_core(&measured?);
        self.known.insert(name.to_owned(), rate);
        Ok(units / rate)
    }

    /// Training of the models that make rows, and sampling.
    pub fn augmentation(&mut self, config: &Config) -> Result<f64> {
        let g = &config.generator;
        Ok(match config.mixture.generated {
            GeneratedRows::None => self.seconds("labels", config.labels.training.steps as f64)?,
            GeneratedRows::Tce => {
                // A network that trains until it is done is taken to need all that it may.
                let updates = g.state_steps.given().unwrap_or(g.until_done.state_limit)
                    + g.transition_steps.given().unwrap_or(g.until_done.transition_limit);
                let rows = g.rows_beside(config.mixture.lambda, config.source.rows) as f64;
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

    /// The learner's updates.
    pub fn training(&mut self, config: &Config) -> Result<f64> {
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

    /// The learned dynamics that policies are tried in.
    pub fn dynamics(&mut self, config: &Config) -> Result<f64> {
        let d = &config.dynamics;
        self.seconds("bc", d.steps as f64 * d.members as f64 * d.batch as f64 / 256.0)
    }

    /// The source rows' distances to the target.
    pub fn distances(&mut self, config: &Config) -> Result<f64> {
        let workload = if config.mixture.source == SourceRows::Transport { "transport" } else { "nearest" };
        self.seconds(workload, config.source.rows as f64)
    }

    /// The evaluation of one policy in `environment`, a workload's name.
    pub fn evaluation(&mut self, environment: &str, config: &Config) -> Result<f64> {
        // The policy takes about as long as the robot.
        self.seconds(environment, 2.0 * (config.evaluation.episodes * EPISODE_LIMIT) as f64)
    }
}
