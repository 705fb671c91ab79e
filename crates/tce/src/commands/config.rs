//! `tce config show`.

use clap::{Args, Subcommand};
use serde::Serialize;
use tce_data::Task;

use crate::error::Result;
use crate::layers::ConfigArgs;
use crate::output::{Output, table};
use crate::variant::Variant;

/// Show the configuration.
#[derive(Debug, Subcommand)]
pub enum Config {
    /// Every value and where it comes from.
    Show(Show),
}

/// Arguments of `show`.
#[derive(Debug, Args)]
pub struct Show {
    /// The task, for the paper's task-specific values.
    task: Option<Task>,
    /// The variant whose changes are to be included.
    #[arg(long, value_enum)]
    variant: Option<Variant>,
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Serialize)]
struct Entry {
    key: String,
    value: String,
    from: String,
}

impl Config {
    /// Runs the subcommand.
    pub fn run(self, output: Output) -> Result<()> {
        let Config::Show(args) = self;
        let layered = args.config.layered(args.task, args.variant)?;
        // A configuration that does not hold together is refused, not shown.
        layered.config()?;
        let entries: Vec<_> =
            layered.values().into_iter().map(|(key, value, from)| Entry { key, value, from }).collect();
        output.print(&entries, |entries| {
            table(&["key", "value", "from"], entries.iter().map(|e| [e.key.clone(), e.value.clone(), e.from.clone()]))
        });
        Ok(())
    }
}
