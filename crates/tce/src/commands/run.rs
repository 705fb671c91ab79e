//! `tce run`.

use clap::Args;
use serde::Serialize;
use tce_base::plus_minus;
use tce_data::Task;
use tce_learn::{DynamicsConfig, LabelErrors};
use tce_nn::Device;
use tce_run::config::{Algorithm, Config};
use tce_run::course::Course;
use tce_run::error::{Error, Result};
use tce_run::inputs::{Behaviour, DataArgs, Inputs};
use tce_run::layers::ConfigArgs;
use tce_run::off_policy_evaluation::OffPolicyEvaluator;
use tce_run::pipeline::{Summary, run, seeds};
use tce_run::variant::Variant;
use tce_run::verdict::{Candidate, Kept, keep, recommend_or_only};

use crate::conclusion::{self, Role, Scored};
use crate::output::{Output, heading, mark_best, table};

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct Run {
    /// The task: ROBOT-SHIFT/SOURCE/TARGET, as in hopper-morph/medium/expert.
    task: Task,
    /// The methods, separated by commas (default: tce-og, and tce-clones if the learner is bc and there are baselines).
    #[arg(long, value_enum, value_delimiter = ',', help_heading = "What is learned")]
    variant: Vec<Variant>,
    /// How many seeds; all of them are one training.
    #[arg(long, default_value_t = 1, help_heading = "What is learned")]
    seeds: usize,
    /// The first seed.
    #[arg(long, default_value_t = 0, help_heading = "What is learned")]
    seed: u64,
    #[command(flatten)]
    data: DataArgs,
    /// Leave out the baselines (cloning with raw and with standardised observations, of the best half, by an ensemble of five; IQL on
    /// the target alone).
    #[arg(long, alias = "no-floors", help_heading = "What stands beside it")]
    no_baselines: bool,
    /// Do not try the policies in learned dynamics, and recommend none.
    #[arg(long, help_heading = "What stands beside it")]
    no_verdict: bool,
    /// Another learner for the methods, not for the baselines (`tce learn --list`).
    #[arg(long, value_enum, help_heading = "What is learned")]
    learner: Option<Algorithm>,
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Serialize)]
struct Report {
    task: String,
    source: Option<Behaviour>,
    target: Behaviour,
    rows: Vec<Row>,
    /// The recommended policy; None where `--no-verdict` was said.
    #[serde(skip_serializing_if = "Option::is_none")]
    verdict: Option<Kept>,
    /// What came out, in sentences.
    conclusion: Vec<String>,
}

#[derive(Serialize)]
struct Row {
    title: String,
    variant: Variant,
    baseline: bool,
    #[serde(flatten)]
    summary: Summary,
}

impl Run {
    /// Runs the command.
    pub fn run(mut self, output: Output, device: &Device) -> Result<()> {
        if self.variant.is_empty() {
            self.variant = self.own_methods()?;
        }
        if let (Some(learner), true) = (self.learner, self.variant.iter().all(|v| Variant::BASELINES.contains(v))) {
            return Err(Error::Usage(format!(
                "--learner {}: found baselines alone ({}), which have learners of their own; name a method, or say --set learner.algorithm",
                learner.about().name,
                self.variant.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
            )));
        }
        let mut variants: Vec<(Variant, bool)> = Vec::new();
        if !self.no_baselines {
            let baselines = Variant::BASELINES.into_iter().filter(|f| !self.variant.contains(f));
            variants.extend(baselines.map(|v| (v, true)));
        }
        variants.extend(self.variant.iter().map(|&v| (v, Variant::BASELINES.contains(&v))));
        // Every configuration is read before anything is computed.
        let configs = variants
            .iter()
            .map(|&(variant, baseline)| self.config_of(variant, self.learner.filter(|_| !baseline)))
            .collect::<Result<Vec<_>>>()?;
        let seeds = seeds(self.seed, self.seeds)?;
        super::refuse::folder(&self.data.out)?;
        tce_sim::open_library()?;
        // One loading for all: the methods differ in nothing that decides their data, apart from whether they look at the source.
        let widest = configs.iter().find(|c| c.needs_source()).unwrap_or(&configs[0]);
        self.plan(&variants, &configs, seeds.len(), device);
        tce_base::begin_step("data");
        let inputs = Inputs::of_config(self.task, &self.data, widest)?;
        let mut rows = Vec::new();
        for ((variant, baseline), config) in variants.into_iter().zip(&configs) {
            let place = self.task.directory();
            let summary = run(variant.name(), &inputs, config, &seeds, &self.data.out, &place, device)?;
            rows.push(Row { title: variant.row_title(config), variant, baseline, summary });
        }
        let verdict = match self.no_verdict {
            true => None,
            false => Some(self.verdict(&inputs, &rows, &configs[0].dynamics, device)?),
        };
        let (source, target) = inputs.behaviour(configs[0].evaluation.scores);
        let scored = |row: &Row| {
            let role = if row.baseline { Role::Baseline } else { Role::Method };
            Scored::new(&row.title, role, &row.summary.counted())
        };
        let recommended = verdict.as_ref().map(|v| v.verdict.method.as_str());
        let scored: Vec<_> = rows.iter().map(scored).collect();
        let conclusion = conclusion::sentences(&scored, recommended, self.config.preset);
        output.print(&Report { task: self.task.to_string(), source, target, rows, verdict, conclusion }, render);
        Ok(())
    }
}

impl Run {
    /// The program's own methods, which are meant where none is named.
    fn own_methods(&self) -> Result<Vec<Variant>> {
        let own = self.config_of(Variant::TceOg, self.learner)?;
        if own.learner.algorithm != Algorithm::Bc || self.no_baselines {
            return Ok(vec![Variant::TceOg]);
        }
        // The same states with other actions: the comparison tells which are better. Settings may say one, and then there is one method.
        let clones = self.config_of(Variant::TceClones, self.learner)?;
        Ok(if own.mixture.used() != clones.mixture.used() {
            vec![Variant::TceOg, Variant::TceClones]
        } else if own.mixture.by_clones() {
            vec![Variant::TceClones]
        } else {
            vec![Variant::TceOg]
        })
    }

    /// The settings of a method.
    fn config_of(&self, variant: Variant, learner: Option<Algorithm>) -> Result<Config> {
        self.config.clone().with_learner(learner).layered(Some(self.task), Some(variant))?.config()
    }

    /// Tells the steps that are to come.
    fn plan(&self, variants: &[(Variant, bool)], configs: &[Config], seeds: usize, device: &Device) {
        let mut course = Course::new(self.task.agent, seeds, device, &self.data.out);
        course.step("data", serde_json::json!(self.task));
        for ((variant, _), config) in variants.iter().zip(configs) {
            course.clones(config);
            course.generating(config);
            course.training(variant.name(), config, config.mixture.learned_rows());
        }
        if !self.no_verdict {
            course.verdict(&configs[0], configs.len() * seeds);
        }
        course.plan();
    }

    /// Recommends one of the policies of `rows`, and puts it beside the runs.
    fn verdict(&self, inputs: &Inputs, rows: &[Row], dynamics: &DynamicsConfig, device: &Device) -> Result<Kept> {
        let candidate =
            |row: &Row| Candidate { name: row.title.clone(), baseline: row.baseline, files: row.summary.policies() };
        let evaluator = || OffPolicyEvaluator::train(inputs, dynamics, &self.data.out, device);
        let candidates: Vec<_> = rows.iter().map(candidate).collect();
        let verdict = recommend_or_only(evaluator, &candidates)?;
        keep(verdict, &self.data.out.join(self.task.directory()))
    }
}

fn render(report: &Report) -> String {
    let lines = report.rows.iter().map(|r| {
        let returns: Vec<f64> = r
            .summary
            .learned
            .evaluations
            .iter()
            .filter(|e| e.failed.is_none())
            .map(|e| e.returns.iter().sum::<f64>() / e.returns.len() as f64)
            .collect();
        let scores = r.summary.counted();
        let seeds = r.summary.seeds.len();
        let failed = r.summary.learned.evaluations.iter().filter(|e| e.failed.is_some()).count();
        [
            if r.baseline { format!("{} (baseline)", r.title) } else { r.title.clone() },
            plus_minus(&scores),
            plus_minus(&returns),
            if failed > 0 { format!("{seeds} ({failed} diverged)") } else { seeds.to_string() },
            r.summary.extra_rows.to_string(),
            format!("{:.0} s", r.summary.seconds),
        ]
        .to_vec()
    });
    let behaviour = |title: &str, b: &Behaviour| {
        let score = b.score.map_or("-".into(), |s| format!("{s:.1}"));
        let figures = [score, format!("{:.1} ± {:.1}", b.mean, b.std), "-".into(), b.rows.to_string(), "-".into()];
        std::iter::once(title.to_owned()).chain(figures).collect::<Vec<_>>()
    };
    let mut lines: Vec<_> = lines.collect();
    mark_best(lines.iter_mut().map(|line| &mut line[1]));
    let lines = lines
        .into_iter()
        .chain(report.source.iter().map(|b| behaviour("source behaviour", b)))
        .chain([behaviour("target behaviour", &report.target)]);
    let header = ["method", "score", "return", "seeds", "other rows", "time"];
    let mut text = format!("{}\n{}\n", heading(&report.task.to_string()), table(&header, lines));
    let generated = report.rows.iter().filter(|r| !r.summary.generated.is_empty()).map(|r| {
        let mean = |f: &dyn Fn(&tce_run::augment::Generated) -> f64| {
            r.summary.generated.iter().map(f).sum::<f64>() / r.summary.generated.len() as f64
        };
        // Where the generator makes whole transitions there are no label models.
        let rmse = |f: &dyn Fn(&LabelErrors) -> f64| {
            let value = mean(&|g| g.labels.as_ref().map_or(f64::NAN, f));
            if value.is_finite() { format!("{value:.4}") } else { "-".into() }
        };
        [
            r.title.clone(),
            format!("{:.0}", mean(&|g| g.sampled as f64)),
            format!("{:.1} %", 100.0 * mean(&|g| 1.0 - g.kept as f64 / g.sampled as f64)),
            format!("{:.1} %", 100.0 * mean(&|g| g.outside_box)),
            format!("{:.2} %", 100.0 * mean(&|g| g.terminal)),
            rmse(&|l| l.action_rmse),
            rmse(&|l| l.reward_rmse),
        ]
    });
    let generated: Vec<_> = generated.collect();
    if !generated.is_empty() {
        let header =
            ["generated", "sampled", "filtered out", "actions clipped", "terminal", "action RMSE", "reward RMSE"];
        text += &table(&header, generated);
        text += "\n";
    }
    for row in &report.rows {
        text += &format!("{}: {}\n", row.title, row.summary.directory.display());
    }
    for (name, b) in report.source.iter().map(|b| ("source", b)).chain([("target", &report.target)]) {
        text += &format!("{name} rows: {}\n", b.file.display());
    }
    // Last, where the eye is when the command ends.
    text += "\n";
    for sentence in &report.conclusion {
        text += &format!("{sentence}\n");
    }
    if let Some(kept) = &report.verdict {
        text += &kept.sentences();
        text += "\n";
    }
    text
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Call {
        #[command(flatten)]
        run: Run,
    }

    #[test]
    fn learners_that_clone_are_tried_with_both_actions() {
        let methods = |more: &[&str]| {
            let call = Call::parse_from([&["tce", "hopper-morph/medium/expert"], more].concat());
            call.run.own_methods().unwrap()
        };
        assert_eq!(methods(&[]), [Variant::TceOg, Variant::TceClones]);
        assert_eq!(methods(&["--learner", "iql"]), [Variant::TceOg]);
        assert_eq!(methods(&["--preset", "paper"]), [Variant::TceOg]);
        assert_eq!(methods(&["--preset", "paper", "--learner", "bc"]), [Variant::TceOg, Variant::TceClones]);
        // The clones are a baseline: who wants none gets none.
        assert_eq!(methods(&["--no-baselines"]), [Variant::TceOg]);
        // Settings win over a variant's own.
        assert_eq!(methods(&["--set", "mixture.actions=clones"]), [Variant::TceClones]);
        assert_eq!(methods(&["--set", "mixture.actions=own"]), [Variant::TceOg]);
        assert_eq!(methods(&["--set", "mixture.generated=none"]), [Variant::TceOg]);
    }
}
