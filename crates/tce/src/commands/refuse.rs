//! Places that results cannot be written to.

use std::path::Path;

use tce_base::{ensure_folder, ensure_writable};
use tce_run::error::{Error, Result};

/// Refuses a folder for results that cannot be written, or that lies in a sweep's, whose files are all accounted for.
pub fn folder(out: &Path) -> Result<()> {
    match tce_run::sweep::around(&out.join("x")) {
        Some(sweep) => Err(Error::Usage(format!(
            "--out {}: found the folder of a sweep, {}; what lies there is the sweep's own. Choose another folder",
            out.display(),
            sweep.display()
        ))),
        None => Ok(ensure_folder(out)?),
    }
}

/// Refuses to write over what is read.
pub fn inputs_as_output(out: &Path, inputs: &[&Path]) -> Result<()> {
    let same = |input: &&&Path| out.canonicalize().is_ok_and(|out| input.canonicalize().is_ok_and(|i| i == out));
    match inputs.iter().find(same) {
        Some(input) => Err(Error::Usage(format!(
            "--out {}: found one of the inputs, {}; choose another name",
            out.display(),
            input.display()
        ))),
        None => Ok(()),
    }
}

/// An output that exists is only replaced when the user says so.
pub fn existing(path: &Path, force: bool) -> Result<()> {
    ensure_writable(path)?;
    if path.exists() && !force {
        return Err(Error::Usage(format!(
            "{} exists; choose another name, or say --force to replace it",
            path.display()
        )));
    }
    Ok(())
}
