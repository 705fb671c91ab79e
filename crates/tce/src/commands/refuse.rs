//! Places that results cannot be written to.

use std::path::Path;

use tce_base::{ensure_folder, ensure_writable};
use tce_data::{DataError, main_file};
use tce_run::error::{Error, Result};
use tce_run::own::Writing;

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
    match inputs.iter().find(|input| is_same(out, input)) {
        Some(input) => Err(Error::Usage(format!(
            "{}: found one of the inputs, {}; choose another name",
            out.display(),
            input.display()
        ))),
        None => Ok(()),
    }
}

/// Whether both are the same file, which is there. A Minari data set is its main file, whichever of its folders is named.
pub fn is_same(a: &Path, b: &Path) -> bool {
    let whole = |path: &Path| main_file(path).canonicalize();
    whole(a).is_ok_and(|a| whole(b).is_ok_and(|b| a == b))
}

/// A file that exists is only replaced when the user says so, and a folder never.
pub fn existing(path: &Path, force: bool) -> Result<()> {
    if path.is_dir() {
        return Err(Error::Usage(format!(
            "{}: found a folder, expected the name of a file to write; choose another name",
            path.display()
        )));
    }
    ensure_writable(path)?;
    ensure_meant(path, force)
}

/// [`existing`] for a data set, which may be a file or a folder: what is there has to be of the same kind.
pub fn data_set(path: &Path, writing: &Writing) -> Result<()> {
    writing.ensure_replaceable(path).map_err(|error| match error {
        DataError::Invalid { .. } => Error::Usage(error.to_string()),
        error => error.into(),
    })?;
    match path.is_dir() {
        true => ensure_folder(path)?,
        false => ensure_writable(path)?,
    }
    ensure_meant(path, writing.force)
}

fn ensure_meant(path: &Path, force: bool) -> Result<()> {
    if path.exists() && !force {
        return Err(Error::Usage(format!(
            "{} exists; choose another name, or say --force to replace it",
            path.display()
        )));
    }
    Ok(())
}
