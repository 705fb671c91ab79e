//! Files that are read back: JSON that may be absent or damaged, and files whose SHA-256 is known.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use crate::files::{FileError, read_if_there, sha256_file};

/// A JSON file could not be read.
#[derive(Debug, thiserror::Error)]
pub enum JsonError {
    /// It could not be read at all.
    #[error(transparent)]
    File(#[from] FileError),
    /// Its content is not what was expected: the file, what is wrong, and what to do.
    #[error("{0}")]
    Damaged(String),
}

/// The value in a JSON file; none if there is no such file. `remedy` tells what to do about a damaged one.
///
/// # Errors
/// If there is one, and it cannot be read or has another content.
pub fn read_json<T: DeserializeOwned>(path: &Path, remedy: &str) -> Result<Option<T>, JsonError> {
    let Some(bytes) = read_if_there(path)? else { return Ok(None) };
    serde_json::from_slice(&bytes)
        .map(Some)
        .map_err(|e| JsonError::Damaged(format!("{}: {e}; {remedy}", path.display())))
}

/// A file is not what it was.
#[derive(Debug, thiserror::Error)]
pub enum Damage {
    /// It cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// It has another content.
    #[error("{}: SHA-256 {found}, expected {expected}", file.display())]
    Changed {
        /// The file.
        file: PathBuf,
        /// Its SHA-256.
        found: String,
        /// The SHA-256 that it had.
        expected: String,
    },
}

/// Compares a file with the SHA-256 that it had.
///
/// # Errors
/// If it is missing, unreadable or changed.
pub fn verify_sha256(file: &Path, expected: &str) -> Result<(), Damage> {
    let found = sha256_file(file)?;
    if found == expected {
        return Ok(());
    }
    Err(Damage::Changed { file: file.to_owned(), found, expected: expected.to_owned() })
}

/// The SHA-256 of the files `names` below `directory`, beside their names.
///
/// # Errors
/// If a file cannot be read.
pub fn sha256_files<C: FromIterator<(String, String)>>(
    directory: &Path,
    names: impl IntoIterator<Item = String>,
) -> Result<C, FileError> {
    names.into_iter().map(|name| sha256_file(&directory.join(&name)).map(|hash| (name, hash))).collect()
}

/// The first of `files` (names below `directory` with their SHA-256) that is missing or changed, and what is wrong; None if all are
/// intact.
pub fn first_damaged(directory: &Path, files: &BTreeMap<String, String>) -> Option<String> {
    let damage = |(name, expected): (&String, &String)| verify_sha256(&directory.join(name), expected).err();
    files.iter().find_map(damage).map(|damage| damage.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::{sha256_hex, write_atomically};

    #[test]
    fn json_is_there_absent_or_damaged() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.json");
        assert_eq!(read_json::<u32>(&path, "remove it").unwrap(), None);
        write_atomically(&path, b"7").unwrap();
        assert_eq!(read_json::<u32>(&path, "remove it").unwrap(), Some(7));
        let message = read_json::<String>(&path, "remove it").unwrap_err().to_string();
        assert!(message.contains("a.json: invalid type") && message.ends_with("; remove it"), "{message}");
        assert!(matches!(read_json::<u32>(dir.path(), "remove it"), Err(JsonError::File(_))));
    }

    #[test]
    fn changed_and_missing_files_are_named() {
        let dir = tempfile::tempdir().unwrap();
        write_atomically(&dir.path().join("a"), b"one").unwrap();
        write_atomically(&dir.path().join("b"), b"two").unwrap();
        let files: BTreeMap<_, _> = sha256_files(dir.path(), ["a", "b"].map(String::from)).unwrap();
        assert_eq!(files["a"], sha256_hex(b"one"));
        assert_eq!(first_damaged(dir.path(), &files), None);
        write_atomically(&dir.path().join("b"), b"Two").unwrap();
        let message = first_damaged(dir.path(), &files).unwrap();
        assert!(message.contains("/b: SHA-256 ") && message.contains(&sha256_hex(b"two")), "{message}");
        std::fs::remove_file(dir.path().join("a")).unwrap();
        assert!(first_damaged(dir.path(), &files).unwrap().contains("there is no such file"));
    }
}
