//! `tce man`.

use std::path::PathBuf;

use clap::Args;
use tce_base::{FileError, create_folder, write_atomically};
use tce_run::error::Result;

/// Arguments of `man`.
#[derive(Debug, Args)]
pub struct Man {
    /// The folder for the pages: tce.1, tce-run.1, tce-sweep-plan.1, ...
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl Man {
    /// Writes a page for every command.
    pub fn run(self, command: clap::Command) -> Result<()> {
        create_folder(&self.out)?;
        let mut command = command.disable_help_subcommand(true);
        command.build();
        self.page(command, "tce")
    }

    /// The page of `command`, whose name with those of its parents is `name`, and the pages of those below it.
    fn page(&self, command: clap::Command, name: &str) -> Result<()> {
        for below in command.get_subcommands() {
            self.page(below.clone(), &format!("{name}-{}", below.get_name()))?;
        }
        let path = self.out.join(format!("{name}.1"));
        let mut page = Vec::new();
        let title = clap_mangen::Man::new(command.display_name(name)).title(name.to_uppercase());
        title.render(&mut page).map_err(|e| FileError::new(&path, "write", e))?;
        Ok(write_atomically(&path, &page)?)
    }
}
