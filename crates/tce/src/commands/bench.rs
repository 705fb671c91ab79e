//! `tce bench`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_base::{set_quiet, write_json};
use tce_nn::Device;
use tce_run::device_kind::DeviceKind;
use tce_run::error::{Error, Result};
use tce_run::layers::{Layered, Preset};

use crate::bench::{Measured, On, measure, names, simulates};
use crate::output::{Output, table};

/// Arguments of `bench`.
#[derive(Debug, Args)]
pub struct Bench {
    /// What to measure (default: everything).
    #[arg(value_parser = clap::builder::PossibleValuesParser::new(names()))]
    workloads: Vec<String>,
    /// Repeats of each; the table shows their median.
    #[arg(long, default_value_t = 7, help_heading = "What is measured")]
    repeats: usize,
    /// Seconds a repeat takes.
    #[arg(long, default_value_t = 0.5, help_heading = "What is measured")]
    seconds: f64,
    /// Seeds of IQL and of the learners on its networks (iql, iql-kl, dara ... rebrac); every member's update counts.
    #[arg(long, default_value_t = 1, help_heading = "What is measured")]
    seeds: u64,
    /// Write the results to this file as JSON, too.
    #[arg(long)]
    out: Option<PathBuf>,
}

#[derive(Serialize)]
struct Report {
    program: String,
    processor: String,
    /// What computed the networks.
    device: DeviceKind,
    seeds: u64,
    instructions: &'static str,
    threads: usize,
    /// GFLOP/s of one core in products of 256 × 256 matrices, the best of the whole run.
    core_gflops: f64,
    workloads: Vec<Measured>,
    whole_task: Option<WholeTask>,
}

/// Seconds that the `default` preset takes for one seed at the paper's size: 1M generated rows and 1M updates.
#[derive(Serialize)]
struct WholeTask {
    score_training: f64,
    label_models: f64,
    sampling: f64,
    behaviour_model: f64,
    policy: f64,
    total: f64,
}

impl Bench {
    /// Runs the command.
    pub fn run(self, output: Output, kind: DeviceKind, device: &Device) -> Result<()> {
        if self.repeats == 0 || self.seeds == 0 || self.seconds.is_nan() || self.seconds < 0.0 {
            return Err(Error::Usage("--repeats and --seeds must be at least 1, --seconds not negative".into()));
        }
        set_quiet(true);
        let names: Vec<&str> = match self.workloads.is_empty() {
            true => names().collect(),
            false => self.workloads.iter().map(String::as_str).collect(),
        };
        if names.iter().any(|n| simulates(n)) {
            tce_sim::open_library()?;
        }
        let on = On { device: device.clone(), seeds: self.seeds };
        let mut core_gflops = tce_nn::product_rate(0.1);
        let mut workloads = Vec::new();
        for name in names {
            tce_base::note!("{name} ...");
            workloads.push(measure(name, self.repeats, self.seconds, &on)?);
            core_gflops = core_gflops.max(tce_nn::product_rate(0.05));
        }
        let report = Report {
            program: tce_base::PROGRAM.to_owned(),
            processor: tce_nn::processor(),
            device: kind,
            seeds: self.seeds,
            instructions: tce_nn::instructions(),
            threads: rayon::current_num_threads(),
            core_gflops,
            whole_task: if kind == DeviceKind::Cpu && self.seeds == 1 { whole_task(&workloads)? } else { None },
            workloads,
        };
        if let Some(path) = &self.out {
            write_json(path, &report)?;
        }
        output.print(&report, render);
        Ok(())
    }
}

fn whole_task(measured: &[Measured]) -> Result<Option<WholeTask>> {
    let rate = |name: &str| measured.iter().find(|m| m.name == name).map(|m| m.per_second);
    let config = Layered::new(Preset::Default, None, None, None, &[])?.config()?;
    let g = &config.generator;
    let (Some(score), Some(sample), Some(labels), Some(cvae), Some(iql)) =
        (rate("score-train"), rate("sample"), rate("labels"), rate("cvae"), rate("iql-kl"))
    else {
        return Ok(None);
    };
    // Two threads train the two networks side by side.
    // A network that trains until it is done takes as long as its limit at most.
    let (a, b) = (
        g.state_steps.most(g.until_done.state_limit) as f64 / score,
        g.transition_steps.most(g.until_done.transition_limit) as f64 / score,
    );
    let score_training = if rayon::current_num_threads() > 1 { a.max(b) } else { a + b };
    let (label_models, behaviour_model) =
        (config.labels.training.steps as f64 / labels, config.learner.behaviour.cvae.steps as f64 / cvae);
    let (sampling, policy) = (2.0 * 1e6 / sample, 1e6 / iql);
    let total = score_training + label_models + sampling + behaviour_model + policy;
    Ok(Some(WholeTask { score_training, label_models, sampling, behaviour_model, policy, total }))
}

fn render(report: &Report) -> String {
    let rows = report.workloads.iter().map(|m| {
        let number = |x: f64| if x >= 1000.0 { format!("{x:.0}") } else { format!("{x:.1}") };
        let products = |text: String| if m.gflops > 0.0 { text } else { "-".into() };
        // The CPU's rate is no measure of a GPU.
        let share = if report.device == DeviceKind::Cpu { format!("{:.0} %", 100.0 * m.share) } else { "-".into() };
        [
            m.name.clone(),
            format!("{} {}/s", number(m.per_second), m.unit),
            format!("{} .. {}", number(m.range[0]), number(m.range[1])),
            products(format!("{:.1}", m.gflops)),
            products(share),
        ]
    });
    let header = ["workload", "rate", "range", "GFLOP/s", "of the cores' own"];
    let mut text = format!(
        "{}, {}, {} threads, {:.1} GFLOP/s a core in 256 x 256 products\n{}\n",
        report.processor,
        report.instructions,
        report.threads,
        report.core_gflops,
        table(&header, rows)
    );
    if let Some(t) = &report.whole_task {
        let minutes = |s: f64| s / 60.0;
        text += &format!(
            "a whole default task, one seed, 1M rows generated, 1M updates: {:.0} min (score networks {:.1}, labels {:.1}, \
             sampling {:.1}, behaviour model {:.1}, policy {:.1})\n",
            minutes(t.total),
            minutes(t.score_training),
            minutes(t.label_models),
            minutes(t.sampling),
            minutes(t.behaviour_model),
            minutes(t.policy)
        );
    }
    text
}
