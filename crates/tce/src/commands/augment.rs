//! `tce augment`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_nn::Device;
use tce_run::augment::Generated;
use tce_run::augment::own_tables::{Augmented, joined};
use tce_run::error::Result;
use tce_run::inputs::Inputs;
use tce_run::layers::ConfigArgs;
use tce_run::own::{Own, Writing};

use crate::output::{Output, table};

/// Arguments of `augment`.
#[derive(Debug, Args)]
pub struct Augment {
    /// Many transitions of the unchanged robot (HDF5, D4RL's or OTDF's layout).
    #[arg(long, value_name = "FILE")]
    source: PathBuf,
    /// Few transitions of the changed robot.
    #[arg(long, value_name = "FILE")]
    target: PathBuf,
    /// The file (or, for Minari, the folder) to write: target rows, then generated rows; column `origin` is 0 and 1.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Write the generated rows alone.
    #[arg(long)]
    only_generated: bool,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Where trained networks are kept, for a second call with other settings.
    #[arg(long, default_value = "runs")]
    cache: PathBuf,
    #[command(flatten)]
    writing: Writing,
    #[command(flatten)]
    own: Own,
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Serialize)]
struct Written {
    file: PathBuf,
    target_rows: usize,
    generated: Generated,
}

impl Augment {
    /// Runs the command.
    pub fn run(self, output: Output, device: &Device) -> Result<()> {
        super::refuse::data_set(&self.out, &self.writing)?;
        super::refuse::inputs_as_output(&self.out, &[&self.source, &self.target])?;
        let config = self.config.layered(None, None)?.config()?;
        super::refuse::folder(&self.cache)?;
        let inputs = Inputs::of_files(Some(&self.source), &self.target, None, &self.own)?;
        let inputs = inputs.with_target_rows(config.target.rows)?;
        let augmented = Augmented::new(&inputs, &config, self.seed, &self.cache, device)?;
        let target = &inputs.target_in_own_units();
        let (rows, origin) = match self.only_generated {
            true => {
                let origin = vec![1.0; augmented.generated.len()];
                (augmented.generated, origin)
            }
            false => joined(target, &augmented.generated),
        };
        self.writing.write(&self.out, &rows, inputs.actions.as_ref(), &augmented.attributes, &[("origin", &origin)])?;
        let written = if self.only_generated { 0 } else { target.len() };
        output.print(&Written { file: self.out, target_rows: written, generated: augmented.report }, |a| {
            let g = &a.generated;
            let row = [
                a.file.display().to_string(),
                a.target_rows.to_string(),
                g.kept.to_string(),
                format!("{:.1} %", 100.0 * (1.0 - g.kept as f64 / g.sampled as f64)),
                format!("{:.1} %", 100.0 * g.outside_box),
                g.labels.map_or("-".into(), |l| format!("{:.4}", l.action_rmse)),
                g.labels.map_or("-".into(), |l| format!("{:.4}", l.reward_rmse)),
            ];
            let header = [
                "file",
                "target rows",
                "generated rows",
                "filtered out",
                "actions clipped",
                "action RMSE",
                "reward RMSE",
            ];
            table(&header, [row])
        });
        Ok(())
    }
}
