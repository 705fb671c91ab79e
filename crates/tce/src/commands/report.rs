//! `tce report`.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use tce_base::counted;
use tce_report::analysis::{Aggregate, Comparison, opening};
use tce_report::{Analysis, Options, analyse};
use tce_run::error::{Error, Result};
use tce_run::study::of_places;

use crate::output::{Output, prose, table};

/// Arguments of `report`.
#[derive(Debug, Args)]
pub struct Report {
    /// A sweep's folder, done or not, a folder with runs of `tce run`, a record of `tce sweep export`, or a folder of records. Several
    /// are reported as one.
    #[arg(required = true, value_name = "PLACE")]
    places: Vec<PathBuf>,
    /// Where report.html, report.md and report.tex go (default: the first place that is a folder, else the working directory).
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
        let folder = self.places.iter().find(|p| p.is_dir()).map_or(Path::new("."), PathBuf::as_path);
        let folder = self.out.as_deref().unwrap_or(folder);
        tce_base::ensure_folder(folder)?;
        let study = of_places(&self.places)?;
        let analysis = analyse(&study, &Options { resamples: self.resamples, ..Options::default() })?;
        let files = tce_report::write(&study, &analysis, folder)?;
        output.print(&Written { files, analysis }, render);
        Ok(())
    }
}

fn render(written: &Written) -> String {
    let Written { files, analysis } = written;
    let mut text = prose(&opening(analysis).join(" "), 0) + "\n\n";
    if let Some(c) = &analysis.comparison {
        text += &comparison(analysis, c);
    }
    let updates = analysis.recipes.updates().map_or_else(String::new, |u| format!(", {u} learner updates"));
    text += &prose(&format!("preset {}{updates}", analysis.recipes.names()), 2);
    text.push('\n');
    for doubt in analysis.tables.iter().filter_map(|t| t.doubt.as_ref()) {
        text += &prose(&format!("warning: {doubt}"), 2);
        text.push('\n');
    }
    for warning in &analysis.warnings {
        text += &prose(&format!("warning: {}", warning.text), 2);
        text.push('\n');
    }
    for file in files {
        text += &format!("{}\n", file.display());
    }
    text
}

/// Scores of all methods, and how the others lie beside the best baseline: two tables, so that a line has 80 columns.
fn comparison(analysis: &Analysis, c: &Comparison) -> String {
    let range = |i: Option<(f64, f64)>, d: usize| i.map_or("-".into(), |(l, h)| format!("{l:.d$} to {h:.d$}"));
    let title = |a: &Aggregate| lines(&analysis.methods[a.method].title, TITLE);
    let scores = c.methods.iter().map(|a| {
        let [iqm, _, mean, _] = a.over_seeds;
        let (least, most) = a.seeds;
        [
            title(a),
            if least == most { least.to_string() } else { format!("{least} to {most}") },
            format!("{:.1}", mean.point),
            format!("{:.1}", iqm.point),
            range(iqm.interval, 1),
            if analysis.methods[a.method].baseline { "baseline".into() } else { "method".into() },
        ]
    });
    let interval = format!("{:.0} % interval", 100.0 * c.level);
    let header = ["method", "seeds", "mean", "IQM", &interval, "kind"];
    let tasks = counted(c.tasks.len(), "task", "tasks");
    let scores = table(&header, scores);
    let mut text = format!(
        "{}\n{scores}\n",
        prose(
            &format!(
                "Normalised scores over {tasks} (0: a random policy, 100: an expert). IQM: interquartile mean, the mean of the middle half of \
                 the runs."
            ),
            0
        )
    );
    if let Some(baseline) = c.standard() {
        let rows: Vec<_> = c
            .methods
            .iter()
            .filter_map(|a| {
                let (p, finding) = c.improvement(a)?;
                Some([
                    title(a),
                    format!("{:+.1}", c.gap(a)?),
                    format!("{:.2}", p.point),
                    range(p.interval, 2),
                    a.p_value.map_or("-".into(), |p| format!("{p:.3}")),
                    finding.word().to_owned(),
                ])
            })
            .collect();
        if !rows.is_empty() {
            let header = ["method", "points", "P(higher)", &interval, "p", "finding"];
            text += &format!(
                "{}\n{}\n",
                prose(
                    &format!(
                        "Against the best baseline, {}. points: above it. P(higher): share of pairs of runs in which the method's is \
                         higher, 0.5 is no difference. p: how often chance alone does that.",
                        analysis.methods[baseline.method].title
                    ),
                    0
                ),
                table(&header, rows)
            );
        }
    }
    text
}

/// The most columns of a method's name.
const TITLE: usize = 24;

/// `text` in lines of at most `most` characters, broken at spaces where there are any.
fn lines(text: &str, most: usize) -> String {
    let mut out: Vec<String> = Vec::new();
    for word in text.split(' ') {
        match out.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= most => *line += &format!(" {word}"),
            _ => out.push(word.to_owned()),
        }
    }
    out.join("\n")
}
