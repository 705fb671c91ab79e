//! `tce completions`.

use clap::Args;
use clap_complete::Shell;
use tce_run::error::Result;

/// Arguments of `completions`.
#[derive(Debug, Args)]
pub struct Completions {
    /// The shell.
    #[arg(value_enum)]
    shell: Shell,
}

impl Completions {
    /// Prints the script.
    pub fn run(self, mut command: clap::Command) -> Result<()> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut command, "tce", &mut script);
        // A closed pipe is not an error of the command.
        let _ = std::io::Write::write_all(&mut std::io::stdout(), &script);
        Ok(())
    }
}
