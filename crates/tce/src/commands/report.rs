//! `tce report`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_report::{Analysis, Options, analyse};

use crate::error::{Error, Result};
use crate::output::{Output, table};
use crate::study::of_directory;

/// Arguments of `report`.
#[derive(Debug, Args)]
pub struct Report {
    /// A sweep's folder, done or not, or a folder with runs of `tce run`.
    directory: PathBuf,
    /// Where report.html, report.md and report.tex go (default: the folder itself).
    #[arg(long)]
    out: Option<PathBuf>,
    /// Resamples of the bootstrap behind the intervals.
    #[arg(long, default_value_t = Options::default().resamples)]
    resamples: usize,
}

#[derive(Serialize)]
struct Written {
    files: Vec<PathBuf>,
    #[serde(flatten)]
    analysis: Analysis,
}

impl Report {
    /// Runs the command.
    pub fn run(self, output: Output) -> Result<()> {
        if self.resamples < 100 {
            return Err(Error::Usage(format!(
                "--resamples {}: expected at least 100; the ends of an interval are quantiles of as many draws",
                self.resamples
            )));
        }
        let study = of_directory(&self.directory)?;
        let analysis = analyse(&study, &Options { resamples: self.resamples, ..Options::default() })?;
        let files = tce_report::write(&study, &analysis, self.out.as_deref().unwrap_or(&self.directory))?;
        output.print(&Written { files, analysis }, render);
        Ok(())
    }
}

fn render(written: &Written) -> String {
    let Written { files, analysis } = written;
    let mut text = String::new();
    if let Some(c) = &analysis.comparison {
        let rows = c.methods.iter().map(|a| {
            let [iqm, ..] = a.over_seeds;
            let range = |i: Option<(f64, f64)>, d: usize| i.map_or("-".into(), |(l, h)| format!("{l:.d$} to {h:.d$}"));
            let improvement = c.improvement(a);
            [
                analysis.methods[a.method].title.clone(),
                a.runs.to_string(),
                format!("{:.1}", iqm.point),
                range(iqm.interval, 1),
                improvement.map_or("-".into(), |(p, _)| format!("{:.2}", p.point)),
                improvement.map_or("-".into(), |(p, _)| range(p.interval, 2)),
                improvement.map_or("floor".into(), |(_, finding)| finding.word().into()),
            ]
        });
        let header = ["method", "runs", "IQM", "95 %", "P(> best floor)", "95 %", "finding"];
        text += &format!("{} tasks\n{}\n", c.tasks.len(), table(&header, rows));
    }
    for warning in &analysis.warnings {
        text += &format!("warning: {}\n", warning.text);
    }
    for file in files {
        text += &format!("{}\n", file.display());
    }
    text
}
