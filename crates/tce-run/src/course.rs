//! The steps of commands with several steps, for the line above the progress bars ([`tce_base::course`]).
//!
//! The cost of each step is stored in `costs.json` in the folder of runs: seconds by kind. A kind names the machine, the number of threads
//! and every setting that the cost depends on. The second run of a kind can therefore estimate its time from the start.

use std::path::Path;

use serde_json::{Value, json};
use tce_base::{OrAuto, Step, plan_course, sha256_hex};
use tce_learn::LearnedRows;
use tce_nn::Device;

use crate::config::{Algorithm, Config, GeneratedRows, SourceRows};
use crate::device_kind::DeviceKind;
use crate::variant::Variant;

/// The file with costs, in the folder of runs.
const COSTS: &str = "costs.json";

/// Makes the steps of a command.
pub struct Course<'a> {
    /// What the sizes of networks depend on: the robot, or the columns of the data.
    robot: String,
    seeds: usize,
    device: DeviceKind,
    root: &'a Path,
    steps: Vec<Step>,
}

impl<'a> Course<'a> {
    /// No steps yet; costs are stored in `root`.
    pub fn new(robot: impl ToString, seeds: usize, device: &Device, root: &'a Path) -> Self {
        Self { robot: robot.to_string(), seeds, device: device.into(), root, steps: Vec::new() }
    }

    /// Begins.
    pub fn plan(self) {
        plan_course(self.steps, Some(self.root.join(COSTS)));
    }

    /// A step whose cost depends on `of`.
    pub fn step(&mut self, name: &str, of: Value) -> &mut Step {
        let machine = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        let of = json!([name, of, self.robot, self.seeds, self.device, machine.trim(), rayon::current_num_threads()]);
        let kind = format!("{name} {}", &sha256_hex(of.to_string().as_bytes())[..8]);
        self.steps.push(Step::new(name, kind));
        self.steps.last_mut().expect("it was pushed")
    }

    /// The steps that make generated rows; those that an earlier method of the command has made are there already.
    pub fn generating(&mut self, config: &Config) {
        let before = self.steps.len();
        if config.mixture.source == SourceRows::Relabelled && config.mixture.generated != GeneratedRows::Tce {
            self.step("label models", json!(config.labels));
        }
        match config.mixture.generated {
            GeneratedRows::None => {}
            GeneratedRows::Tce => {
                let g = &config.generator;
                let labels = json!(config.labels);
                let networks = json!([
                    g.process,
                    g.target,
                    g.state_steps,
                    g.transition_steps,
                    g.until_done,
                    g.batch,
                    g.source_states
                ]);
                // Label models decide when q_tran is done, so that they are trained first.
                if g.transition_steps == OrAuto::Auto {
                    self.step("label models", labels);
                    self.step("score networks", networks);
                } else {
                    self.step("score networks", networks);
                    self.step("label models", labels);
                }
                if config.filter.by_dynamics() {
                    self.step("learned dynamics", json!(config.dynamics));
                }
                self.step("generated rows", json!([g.sampler, g.rows, g.support]));
            }
            GeneratedRows::Synther | GeneratedRows::Dmc => {
                self.step("single-stage network", json!(config.single_stage));
                self.step("generated rows", json!([config.single_stage.sampler, config.single_stage.rows]));
            }
        }
        self.done_before(before);
    }

    /// Of the steps from `before` on, those that an earlier method of the command has done cost nothing.
    fn done_before(&mut self, before: usize) {
        let (earlier, own) = self.steps.split_at_mut(before);
        for step in own {
            if earlier.iter().any(|e| (&e.name, &e.kind) == (&step.name, &step.kind)) {
                step.size = 0.0;
            }
        }
    }

    /// The training of a policy on `rows`, by its name in [`training_step`]; what an earlier method of the command has trained is there
    /// already.
    pub fn training(&mut self, name: &str, config: &Config, rows: LearnedRows) {
        // As in the costs of earlier commands.
        let mixed = rows == LearnedRows::Mixed;
        let learner = &config.learner;
        let mut of = learner.used(rows);
        of["steps"] = Value::Null;
        let step = self.step(&training_step(name), json!([of, mixed, config.evaluation.episodes]));
        step.size = learner.steps(rows) as f64;
        // The other learners train something else before, with bars of its own.
        step.last_bar = (learner.algorithm == Algorithm::Bc).then_some("learn ");
        // The cost depends on the settings, not on the name.
        let name = step.name.clone();
        if let Some(kind) = step.kind.strip_prefix(&name) {
            step.kind = format!("learn{kind}");
        }
        self.done_before(self.steps.len() - 1);
    }

    /// The clones whose actions other rows get, where `config` says so.
    pub fn clones(&mut self, config: &Config) {
        if config.mixture.by_clones() {
            self.training(Variant::BcEnsemble.name(), &config.of_clones(), LearnedRows::Target);
        }
    }

    /// The comparison of `policies` policies.
    pub fn verdict(&mut self, config: &Config, policies: usize) {
        let dynamics = json!(config.dynamics);
        self.step("learned dynamics", dynamics.clone());
        self.step("verdict", json!([dynamics, "a policy"])).size = policies as f64;
    }

    /// Fitted Q evaluation of `policies` policies.
    pub fn fitted_q(&mut self, config: &Config, policies: usize) {
        if config.fitted_q.steps > 0 {
            self.step("fitted Q", json!([config.fitted_q, policies]));
        }
    }
}

/// What the step is called in which the policy of `name` is trained.
pub fn training_step(name: &str) -> String {
    format!("learn {name}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::{Layered, Preset};

    #[test]
    fn what_an_earlier_method_has_made_costs_nothing() {
        let device = tce_nn::cpu();
        let mut course = Course::new("hopper", 1, &device, Path::new("runs"));
        for variant in [Variant::Bc, Variant::TceOg, Variant::TceNn, Variant::SourceClones, Variant::BcEnsemble] {
            let config = Layered::new(Preset::Quick, None, Some(variant), None, &[]).unwrap().config().unwrap();
            course.generating(&config);
            course.clones(&config);
            course.training(variant.name(), &config, config.mixture.learned_rows());
        }
        let steps: Vec<_> = course.steps.iter().map(|s| (s.name.as_str(), s.size)).collect();
        let expected = [
            ("learn bc", 12_000.0),
            ("label models", 1.0),
            ("score networks", 1.0),
            ("generated rows", 1.0),
            ("learn tce-og", 12_000.0),
            ("label models", 0.0),
            ("score networks", 0.0),
            ("generated rows", 0.0),
            ("learn tce-nn", 12_000.0),
            ("learn bc-ensemble", 12_000.0),
            ("learn source-clones", 12_000.0),
            ("learn bc-ensemble", 0.0),
        ];
        assert_eq!(steps, expected);
    }
}
