//! `tce learn`.

use std::path::{Path, PathBuf};

use clap::Args;
use tce_base::plus_minus;
use tce_learn::{About, LearnedRows};
use tce_nn::Device;
use tce_run::config::Algorithm;
use tce_run::error::{Error, Result};
use tce_run::inputs::Inputs;
use tce_run::layers::ConfigArgs;
use tce_run::own::Own;
use tce_run::pipeline::seeds;
use tce_run::training_run::{Comparison, Trained, TrainingRun, TriedActions, ensure_fits, ensure_own_folder};

use crate::estimates::{Estimated, estimates};
use crate::output::{Output, list as listed, table};

/// Arguments of `learn`.
#[derive(Debug, Args)]
pub struct Learn {
    /// Print all learners: what they are, whose, and how their public code differs.
    #[arg(long)]
    list: bool,
    /// The rows to learn from (HDF5). With --extra a batch begins half target rows, half extra rows; clones end with target rows alone (learner.bc.fade).
    #[arg(long, value_name = "FILE", required_unless_present = "list")]
    target: Option<PathBuf>,
    /// Further rows: the source's, generated ones, or a mixture of both.
    #[arg(long, value_name = "FILE")]
    extra: Option<PathBuf>,
    /// The learner (default: the configuration's).
    #[arg(long, value_enum, alias = "algorithm", help_heading = "What is learned")]
    learner: Option<Algorithm>,
    /// bc: clone the best trajectories only, this share of them.
    #[arg(long, value_name = "SHARE", help_heading = "What is learned")]
    top: Option<f64>,
    /// bc with --extra: which actions the extra rows are cloned with (default: both are tried and compared, unless mixture.actions is "clones").
    #[arg(long, value_enum, value_name = "WHOSE", help_heading = "What is learned")]
    actions: Option<TriedActions>,
    /// Policies to learn; all of them are one training.
    #[arg(long, default_value_t = 1, help_heading = "What is learned")]
    seeds: usize,
    /// The first seed.
    #[arg(long, default_value_t = 0, help_heading = "What is learned")]
    seed: u64,
    /// The source's rows, to try the policies in learned dynamics of both robots. Without them the target's rows alone are known.
    #[arg(long, value_name = "FILE", help_heading = "Verdict")]
    source: Option<PathBuf>,
    /// Do not learn a baseline from the target rows alone (unless the extra rows get its actions), do not try the policies, and recommend none.
    #[arg(long, help_heading = "Verdict")]
    no_verdict: bool,
    /// Directory for policies and metrics.
    #[arg(long, required_unless_present = "list")]
    out: Option<PathBuf>,
    #[command(flatten)]
    own: Own,
    #[command(flatten)]
    config: ConfigArgs,
}

impl Learn {
    /// Runs the command.
    pub fn run(mut self, output: Output, device: &Device) -> Result<()> {
        // clap asks for the files unless the list is wanted.
        let (Some(target), Some(out)) = (self.target.take(), self.out.take()) else {
            let all: Vec<About> = Algorithm::ALL.iter().map(|a| a.about()).collect();
            output.print(&all, |all| list(all));
            return Ok(());
        };
        self.config = self.config.with_own_tables(self.learner, self.top);
        let mut config = self.config.layered(None, None)?.config()?;
        let seeds = seeds(self.seed, self.seeds)?;
        let rows = LearnedRows::with(self.extra.as_ref());
        let comparison = Comparison::choose(&mut config, self.actions, rows, !self.no_verdict)?;
        ensure_fits(&config, rows)?;
        super::refuse::folder(&out)?;
        self.config.config.as_deref().map_or(Ok(()), |config| ensure_config_stays(config, &out))?;
        ensure_own_folder(&out)?;
        // Everything is read before anything is computed: a file that does not fit is no surprise after hours.
        let source = self.source.as_deref().filter(|_| !self.no_verdict);
        let inputs = Inputs::of_files(source, &target, self.extra.as_deref(), &self.own)?;
        let inputs = inputs.with_target_rows(config.target.rows)?;
        let run = TrainingRun { config: &config, seeds: &seeds, own: &self.own, comparison, out: &out };
        output.print(&run.run(&inputs, device)?, render);
        Ok(())
    }
}

/// Refuses the file of `--config` in the place of the settings that the training writes.
fn ensure_config_stays(config: &Path, out: &Path) -> Result<()> {
    let written = out.join("config.toml");
    match super::refuse::is_same(&written, config) {
        true => Err(Error::Usage(format!(
            "--config {}: found the file in which this training writes all of its settings, expected another one; choose another --out \
             than {}, or copy the file",
            config.display(),
            out.display()
        ))),
        false => Ok(()),
    }
}

fn render(report: &Trained) -> String {
    let mut text = String::new();
    // Without a simulator there are no returns, and a table of dashes says nothing.
    if report.learned.evaluations.iter().any(|e| e.failed.is_none()) {
        let rows = report.policies.iter().enumerate().map(|(m, path)| {
            let evaluation = report.learned.evaluations.get(m);
            [
                path.display().to_string(),
                evaluation.filter(|e| e.failed.is_none()).map_or("-".into(), |e| plus_minus(&e.returns)),
                evaluation.and_then(|e| e.score).map_or("-".into(), |s| format!("{s:.1}")),
            ]
        });
        text += &table(&["policy", "return", "score"], rows);
    } else {
        text.extend(report.policies.iter().map(|p| format!("{}\n", p.display())));
    }
    for (m, seed) in report.seeds.iter().enumerate() {
        let broken = report.learned.metrics.iter().filter(|(_, values)| values.get(m).is_some_and(Option::is_none));
        let names: Vec<_> = broken.map(|(name, _)| name.as_str()).collect();
        if !names.is_empty() {
            text += &format!("\nDIVERGED: seed {seed}: {} not finite at the end", names.join(", "));
        }
    }
    // A single policy is taken without being tried, and so is a baseline where rewards tell nothing.
    if let Some(kept) = report.verdict.as_ref().filter(|kept| !kept.verdict.tried.is_empty()) {
        let rows = kept.verdict.tried.iter().map(|t| Estimated {
            policy: if t.baseline { format!("{} (baseline)", t.name) } else { t.name.clone() },
            imagined_return: t.imagined_return,
            supported_return: t.supported_return.unwrap_or(t.imagined_return),
            standard_error: t.standard_error,
            support: t.support,
            fitted_q: t.fitted_q,
            action_error: t.action_error,
        });
        text += &format!("\n{}", estimates(rows, kept.verdict.behaviour_value));
    }
    if let Some(kept) = &report.verdict {
        text += &format!("\n{}", kept.sentences());
    }
    text
}

fn list(methods: &[About]) -> String {
    let rows = methods.iter().map(|m| {
        let modes = m.published.map_or_else(String::new, |what| format!("published: {what}"));
        [m.name, m.description, m.reference, &m.needs.to_string(), &modes].map(str::to_owned)
    });
    let text =
        listed(&["learner", "what it is", "reference", "besides target rows", "mode (default: corrected)"], rows);
    format!(
        "{text}\nSettings: learner.NAME, with _ for - (tce config show); a mode is chosen by --set learner.dara.mode=published"
    )
}
