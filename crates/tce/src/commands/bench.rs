//! `tce bench`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_base::{counted, set_quiet, write_json};
use tce_nn::Device;
use tce_run::device_kind::DeviceKind;
use tce_run::error::{Error, Result};
use tce_run::layers::{Layered, Preset};

use crate::bench::{Measured, On, measure, names, simulates};
use crate::costs::Rates;
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

/// Seconds of one core that TCE(OG) of the `default` preset takes for one seed, and its best baseline.
#[derive(Serialize)]
struct WholeTask {
    /// Score networks, label models and sampling. Networks that train until they are done are taken to need all that they may.
    generated_rows: f64,
    policy: f64,
    /// The ensemble of clones of the target's rows.
    baseline: f64,
    /// The dynamics that policies are tried in.
    verdict: f64,
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
            whole_task: match (kind, self.seeds, self.workloads.is_empty()) {
                (DeviceKind::Cpu, 1, true) => Some(whole_task(&workloads)?),
                _ => None,
            },
            workloads,
        };
        if let Some(path) = &self.out {
            write_json(path, &report)?;
        }
        output.print(&report, render);
        Ok(())
    }
}

fn whole_task(measured: &[Measured]) -> Result<WholeTask> {
    let mut rates = Rates::new(measured);
    let config = |set: &[String]| Layered::new(Preset::Default, None, None, None, set)?.config();
    let (own, baseline) = (config(&[])?, config(&["mixture.generated=\"none\"".into()])?);
    let (generated_rows, verdict) = (rates.augmentation(&own)?, rates.dynamics(&own)?);
    let (policy, baseline) = (rates.training(&own)?, rates.training(&baseline)?);
    let total = generated_rows + policy + baseline + verdict;
    Ok(WholeTask { generated_rows, policy, baseline, verdict, total })
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
        "{}, {}, {}, {:.1} GFLOP/s a core in 256 x 256 products\n{}\n",
        report.processor,
        report.instructions,
        counted(report.threads, "thread", "threads"),
        report.core_gflops,
        table(&header, rows)
    );
    if let Some(t) = &report.whole_task {
        let minutes = |s: f64| s / 60.0;
        text += &format!(
            "TCE(OG) of the default preset, one seed, one core: {:.0} min at most (generated rows {:.1}, policy {:.1}, baseline {:.1}, verdict \
             {:.1})\n",
            minutes(t.total),
            minutes(t.generated_rows),
            minutes(t.policy),
            minutes(t.baseline),
            minutes(t.verdict)
        );
    }
    text
}
