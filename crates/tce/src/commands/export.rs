//! `tce export`.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use tce_learn::onnx;
use tce_run::error::Result;
use tce_zoo::actors::read_policy;

use crate::output::Output;

/// Arguments of `export`.
#[derive(Debug, Args)]
pub struct Export {
    /// The policy: a file of `tce learn` or `tce run`, or zoo:NAME.
    policy: PathBuf,
    /// The ONNX model to write: input `observation` [batch, d_s], output `action` [batch, d_a], both float32 in the units of the log.
    #[arg(long, value_name = "FILE")]
    onnx: PathBuf,
    /// Replace what is there.
    #[arg(long)]
    force: bool,
}

#[derive(Serialize)]
struct Exported {
    onnx: PathBuf,
    observations: usize,
    actions: usize,
}

impl Export {
    /// Runs the command.
    pub fn run(self, output: Output) -> Result<()> {
        super::refuse::existing(&self.onnx, self.force)?;
        super::refuse::inputs_as_output(&self.onnx, &[&self.policy])?;
        let policy = read_policy(&self.policy)?;
        onnx::save(&policy, &self.onnx)?;
        let (observations, actions) = policy.dims();
        output.print(&Exported { onnx: self.onnx, observations, actions }, |e| {
            format!("{}: observation [batch, {}] -> action [batch, {}]", e.onnx.display(), e.observations, e.actions)
        });
        Ok(())
    }
}
