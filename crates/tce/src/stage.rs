//! Stages: a directory per finished piece of work, named by the hash of everything that decides its content.
//!
//! A stage is done when its `done.json` exists, which is written last and lists what the stage holds. A run that needs a
//! stage takes it if it is done and makes it otherwise; two runs with the same needs share it.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use tce_base::{FileError, sha256_file, sha256_hex, write_json};

use crate::error::{Error, Result};

/// Changes when the same specification would give other bytes.
const FORMAT: u32 = 2;

/// What marks a stage as done.
#[derive(Serialize, Deserialize)]
struct Done<T> {
    /// The program that wrote it.
    program: String,
    /// SHA-256 of every file of the stage.
    files: BTreeMap<String, String>,
    /// The stage's own summary.
    summary: T,
}

/// The place of one stage.
#[derive(Clone, Debug)]
pub struct Stage {
    directory: PathBuf,
}

impl Stage {
    /// The stage `name` for `spec` under `root`. The specification is kept beside the results.
    pub fn open<S: Serialize>(root: &Path, name: &str, spec: &S) -> Result<Self> {
        let spec = serde_json::json!({ "format": FORMAT, "stage": name.rsplit('/').next(), "spec": spec });
        let key = sha256_hex(spec.to_string().as_bytes());
        let directory = root.join(format!("{name}-{}", &key[..12]));
        fs::create_dir_all(&directory).map_err(|e| FileError::new(&directory, "create the directory", e))?;
        let path = directory.join("spec.json");
        if !path.exists() {
            write_json(&path, &spec)?;
        }
        Ok(Self { directory })
    }

    /// Where the stage's files are.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// The directory's own name, which holds the hash of the specification.
    pub fn name(&self) -> String {
        self.directory.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned())
    }

    /// A file of the stage.
    pub fn file(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    /// The summary, if the stage is done and its files are what they were.
    ///
    /// # Errors
    /// If a file of a finished stage was changed or removed.
    pub fn summary<T: DeserializeOwned>(&self) -> Result<Option<T>> {
        let path = self.file("done.json");
        let Ok(bytes) = fs::read(&path) else { return Ok(None) };
        let done: Done<T> = serde_json::from_slice(&bytes).map_err(|e| {
            Error::Failed(format!("{}: {e}; remove the directory to do the stage again", path.display()))
        })?;
        for (name, expected) in &done.files {
            let file = self.file(name);
            let found = sha256_file(&file)?;
            if found != *expected {
                return Err(Error::Failed(format!(
                    "{}: SHA-256 {found}, expected {expected}: the file was changed since the stage was done; remove {} to \
                     do it again",
                    file.display(),
                    self.directory.display()
                )));
            }
        }
        Ok(Some(done.summary))
    }

    /// Marks the stage as done, with the hashes of `files`.
    pub fn finish<T: Serialize>(&self, files: &[String], summary: T) -> Result<()> {
        let hashes = files.iter().map(|f| Ok((f.clone(), sha256_file(&self.file(f))?))).collect::<Result<_>>()?;
        let done = Done { program: format!("tce {}", env!("CARGO_PKG_VERSION")), files: hashes, summary };
        Ok(write_json(&self.file("done.json"), &done)?)
    }

    /// Makes `name` in this stage the same file as `from`, without a copy where the file system allows it.
    pub fn link(&self, from: &Path, name: &str) -> Result<()> {
        let to = self.file(name);
        if to.exists() {
            fs::remove_file(&to).map_err(|e| FileError::new(&to, "replace", e))?;
        }
        fs::hard_link(from, &to)
            .or_else(|_| fs::copy(from, &to).map(drop))
            .map_err(|e| FileError::new(&to, "link or copy", e).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_is_done_once_and_damage_is_noticed() {
        let root = tempfile::tempdir().unwrap();
        let stage = Stage::open(root.path(), "stages/test", &("spec", 1)).unwrap();
        assert_eq!(stage.summary::<u32>().unwrap(), None);
        fs::write(stage.file("rows"), b"data").unwrap();
        stage.finish(&["rows".into()], 7u32).unwrap();
        let again = Stage::open(root.path(), "stages/test", &("spec", 1)).unwrap();
        assert_eq!(again.summary::<u32>().unwrap(), Some(7));
        let other = Stage::open(root.path(), "stages/test", &("spec", 2)).unwrap();
        assert_eq!(other.summary::<u32>().unwrap(), None);
        fs::write(stage.file("rows"), b"DATA").unwrap();
        let message = again.summary::<u32>().unwrap_err().to_string();
        assert!(message.contains("rows") && message.contains("changed"), "{message}");
    }
}
