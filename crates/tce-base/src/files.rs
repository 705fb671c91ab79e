//! Files that are either whole or absent: written beside their final place, flushed to disk, then renamed.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;
use sha2::{Digest, Sha256};
use tempfile::{NamedTempFile, TempDir};

use crate::owner::Owner;

/// What the names of temporary files begin with; their owner follows.
const PREFIX: &str = ".tce-";
const SUFFIX: &str = ".part";

/// A file could not be read or written.
#[derive(Debug, thiserror::Error)]
#[error("{}: cannot {action}: {}", path.display(), in_words(source))]
pub struct FileError {
    /// The file in question (its final name, not the temporary one).
    pub path: PathBuf,
    /// What was being done.
    pub action: &'static str,
    /// The system's own message.
    pub source: io::Error,
}

/// What the system says, without its numbers.
fn in_words(error: &io::Error) -> String {
    let known = match error.kind() {
        io::ErrorKind::NotFound => "there is no such file or folder",
        io::ErrorKind::PermissionDenied => "you have no right to; change the permissions, or choose another place",
        io::ErrorKind::IsADirectory => "it is a folder, not a file",
        io::ErrorKind::NotADirectory => "a part of the path is a file, not a folder",
        io::ErrorKind::StorageFull => "no space is left on the device; make room, or choose another place",
        io::ErrorKind::ReadOnlyFilesystem => "the file system is read-only; choose another place",
        // What is no error of the system has words of its own.
        _ => return error.to_string(),
    };
    // Words of this program (`io::Error::other` and the like) say more than the kind.
    if error.get_ref().is_some() { error.to_string() } else { known.to_owned() }
}

impl FileError {
    /// An error while doing `action` to `path`.
    pub fn new(path: &Path, action: &'static str, source: io::Error) -> Self {
        Self { path: path.to_owned(), action, source }
    }
}

/// How often a folder is made anew that other processes remove from above.
const TRIES: usize = 100;

/// Makes `folder` and the folders above it, where they are missing. Other processes may remove empty ones of these meanwhile, as that of
/// [attempts](crate::ATTEMPTS) with the last attempt: they are made again.
///
/// # Errors
/// The system's error, under the name `folder`.
pub fn create_folder(folder: &Path) -> Result<(), FileError> {
    let mut made = fs::create_dir_all(folder);
    for _ in 1..TRIES {
        match &made {
            // It was there, and was no folder a moment later; or one above it was gone. A file in its place fails every time.
            Err(e) if matches!(e.kind(), io::ErrorKind::AlreadyExists | io::ErrorKind::NotFound) => {
                made = fs::create_dir_all(folder);
            }
            _ => break,
        }
    }
    made.map_err(|e| FileError::new(folder, "create the directory", e))
}

/// Checks that `path` can be written, with a temporary file in the nearest existing folder above it. Call it before long work whose
/// result goes there.
///
/// # Errors
/// The system's error, under the name `path`.
pub fn ensure_writable(path: &Path) -> Result<(), FileError> {
    let whole = std::path::absolute(path).map_err(|e| FileError::new(path, "write", e))?;
    try_nearest(whole.parent().unwrap_or(&whole)).map_err(|e| FileError::new(path, "write", e))
}

/// [`ensure_writable`] for a folder that is filled: where it exists, it is its own place.
///
/// # Errors
/// As [`ensure_writable`]; if there is a file of that name.
pub fn ensure_folder(path: &Path) -> Result<(), FileError> {
    let action = if path.exists() { "write into" } else { "write" };
    std::path::absolute(path).and_then(|whole| try_nearest(&whole)).map_err(|e| FileError::new(path, action, e))
}

/// Makes a temporary file in the first of `folder` and those above it that exists.
fn try_nearest(folder: &Path) -> io::Result<()> {
    let nearest = folder.ancestors().find(|p| p.exists()).unwrap_or(Path::new("/"));
    match nearest.is_dir() {
        true => tempfile::tempfile_in(nearest).map(drop),
        false => Err(io::ErrorKind::NotADirectory.into()),
    }
}

/// A file that is being written. Write to [`AtomicFile::path`] or [`AtomicFile::file`]; [`AtomicFile::commit`] gives it its
/// name. Dropped without a commit, it leaves nothing behind.
pub struct AtomicFile {
    target: PathBuf,
    temporary: NamedTempFile,
}

impl AtomicFile {
    /// Starts `target`, in its own directory (created if missing), so that the final rename cannot cross devices.
    pub fn create(target: &Path) -> Result<Self, FileError> {
        let temporary = beside(target, "create a temporary file beside it", |b, directory| b.tempfile_in(directory))?;
        Ok(Self { target: target.to_owned(), temporary })
    }

    /// Where the bytes go until the commit.
    pub fn path(&self) -> &Path {
        self.temporary.path()
    }

    /// The open temporary file.
    pub fn file(&mut self) -> &mut File {
        self.temporary.as_file_mut()
    }

    /// Flushes the bytes to disk, gives the file its final name and flushes the directory.
    pub fn commit(self) -> Result<(), FileError> {
        let Self { target, temporary } = self.complete()?;
        temporary.persist(&target).map_err(|e| FileError::new(&target, "rename into place", e.error))?;
        flush_directory(&target)
    }

    /// As [`Self::commit`], unless the name is taken: the first of several processes gets it. Returns whether this one did.
    pub fn commit_first(self) -> Result<bool, FileError> {
        let Self { target, temporary } = self.complete()?;
        link_first(temporary.path(), &target)
    }

    /// Flushes the bytes to disk.
    fn complete(self) -> Result<Self, FileError> {
        let Self { target, temporary } = self;
        // The content may have been written through another handle (an HDF5 writer opens the path itself), so the
        // file is synced by path.
        File::open(temporary.path())
            .and_then(|f| f.sync_all())
            .map_err(|e| FileError::new(&target, "flush to disk", e))?;
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            // A temporary file is private to its owner; a result is not.
            fs::set_permissions(temporary.path(), fs::Permissions::from_mode(0o644))
                .map_err(|e| FileError::new(&target, "set the permissions", e))?;
        }
        Ok(Self { target, temporary })
    }
}

/// A folder that is being filled, as [`AtomicFile`] is a file that is being written. Dropped without a commit, it leaves nothing behind.
pub struct AtomicFolder {
    target: PathBuf,
    temporary: TempDir,
}

impl AtomicFolder {
    /// Starts `target`, in the folder that it will be in (created if missing).
    pub fn create(target: &Path) -> Result<Self, FileError> {
        let temporary = beside(target, "create a temporary folder beside it", |b, directory| b.tempdir_in(directory))?;
        Ok(Self { target: target.to_owned(), temporary })
    }

    /// Where the files go until the commit. The caller flushes them.
    pub fn path(&self) -> &Path {
        self.temporary.path()
    }

    /// Gives the folder its final name. What has that name, be it a file or a full folder, is not replaced.
    ///
    /// # Errors
    /// If it cannot be renamed.
    pub fn commit(self) -> Result<(), FileError> {
        let Self { target, temporary } = self;
        if target.exists() {
            let taken = io::Error::new(io::ErrorKind::AlreadyExists, "something of that name is there");
            return Err(FileError::new(&target, "rename into place", taken));
        }
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            fs::set_permissions(temporary.path(), fs::Permissions::from_mode(0o755))
                .map_err(|e| FileError::new(&target, "set the permissions", e))?;
        }
        fs::rename(temporary.path(), &target).map_err(|e| FileError::new(&target, "rename into place", e))?;
        // It has another name now; there is nothing left to remove.
        let _ = temporary.keep();
        flush_directory(&target)
    }
}

/// What `make` makes in the directory of `target` (created if missing), under a temporary name of this process.
fn beside<T>(
    target: &Path,
    action: &'static str,
    make: impl FnOnce(&tempfile::Builder<'_, '_>, &Path) -> io::Result<T>,
) -> Result<T, FileError> {
    let directory = parent(target);
    create_folder(directory)?;
    sweep(directory);
    let prefix = format!("{PREFIX}{}.", Owner::this());
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix).suffix(SUFFIX);
    make(&builder, directory).map_err(|e| FileError::new(target, action, e))
}

/// Removes the temporary files and folders that killed processes of this machine left in `directory`. Whatever they were to become is not there,
/// so whoever needs it comes by here to make it.
fn sweep(directory: &Path) {
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let owned = name.to_str().and_then(|n| n.strip_prefix(PREFIX)?.strip_suffix(SUFFIX));
        if owned.and_then(|n| Owner::of(Path::new(n))).is_some_and(|owner| owner.dead()) {
            let path = entry.path();
            let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
        }
    }
}

/// Flushes the directory that `path` is in: its name there survives a loss of power.
fn flush_directory(path: &Path) -> Result<(), FileError> {
    #[cfg(unix)]
    File::open(parent(path))
        .and_then(|d| d.sync_all())
        .map_err(|e| FileError::new(path, "flush the directory of", e))?;
    #[cfg(not(unix))]
    let _ = path;
    Ok(())
}

/// Gives the complete file `own`, flushed to disk, the name `target` on the same file system, in place of what had it.
///
/// # Errors
/// If it cannot be renamed.
pub fn move_into_place(own: &Path, target: &Path) -> Result<(), FileError> {
    fs::rename(own, target).map_err(|e| FileError::new(target, "rename into place", e))?;
    flush_directory(target)
}

/// Links the complete file `own` to the name `target`, unless that name is taken: the first of several processes gets it. Returns whether
/// this one did.
///
/// # Errors
/// If the name is free and cannot be given.
pub fn link_first(own: &Path, target: &Path) -> Result<bool, FileError> {
    match fs::hard_link(own, target) {
        Ok(()) => {}
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists => return Ok(false),
        Err(_) if target.exists() => return Ok(false),
        // A file system without hard links: not atomic against another one that comes in the same moment, but whole.
        Err(_) => fs::rename(own, target).map_err(|e| FileError::new(target, "link or rename into place", e))?,
    }
    flush_directory(target)?;
    Ok(true)
}

/// The content of a file; none if there is no such file.
///
/// # Errors
/// If there is one, and it cannot be read.
pub fn read_if_there(path: &Path) -> Result<Option<Vec<u8>>, FileError> {
    match fs::read(path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(FileError::new(path, "read", e)),
    }
}

fn parent(path: &Path) -> &Path {
    match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    }
}

/// Writes `bytes` to `path`, whole or not at all.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    filled(path, bytes)?.commit()
}

/// The file `path`, not committed yet, with all its bytes.
fn filled(path: &Path, bytes: &[u8]) -> Result<AtomicFile, FileError> {
    let mut file = AtomicFile::create(path)?;
    file.file().write_all(bytes).map_err(|e| FileError::new(path, "write", e))?;
    Ok(file)
}

/// Writes `value` as indented JSON to `path`, whole or not at all.
pub fn write_json<T: Serialize>(path: &Path, value: &T) -> Result<(), FileError> {
    write_atomically(path, &json(path, value)?)
}

/// As [`write_json`], unless there is such a file: the first of several processes writes it. Returns whether this one did.
pub fn write_json_first<T: Serialize>(path: &Path, value: &T) -> Result<bool, FileError> {
    filled(path, &json(path, value)?)?.commit_first()
}

fn json<T: Serialize>(path: &Path, value: &T) -> Result<Vec<u8>, FileError> {
    let mut bytes = serde_json::to_vec_pretty(value).map_err(|e| FileError::new(path, "serialise", e.into()))?;
    bytes.push(b'\n');
    Ok(bytes)
}

/// The SHA-256 of `bytes` as lower-case hexadecimal.
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// The SHA-256 of `parts`, one behind the other.
pub fn sha256_parts(parts: impl IntoIterator<Item = Vec<u8>>) -> String {
    let mut hash = Sha256::new();
    parts.into_iter().for_each(|part| hash.update(&part));
    hex(&hash.finalize())
}

/// The SHA-256 of a file, read in pieces.
pub fn sha256_file(path: &Path) -> Result<String, FileError> {
    let mut file = File::open(path).map_err(|e| FileError::new(path, "open", e))?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        match file.read(&mut buffer).map_err(|e| FileError::new(path, "read", e))? {
            0 => break,
            n => hash.update(&buffer[..n]),
        }
    }
    Ok(hex(&hash.finalize()))
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_uncommitted_file_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("deep/result.json");
        let mut file = AtomicFile::create(&target).unwrap();
        file.file().write_all(b"half").unwrap();
        drop(file);
        assert_eq!(fs::read_dir(target.parent().unwrap()).unwrap().count(), 0);
    }

    #[test]
    fn the_first_link_gets_the_name() {
        let dir = tempfile::tempdir().unwrap();
        let [a, b, name] = ["a", "b", "name"].map(|n| dir.path().join(n));
        assert_eq!(read_if_there(&name).unwrap(), None);
        fs::write(&a, b"first").unwrap();
        fs::write(&b, b"second").unwrap();
        assert!(link_first(&a, &name).unwrap());
        assert!(!link_first(&b, &name).unwrap());
        assert_eq!(read_if_there(&name).unwrap().unwrap(), b"first");
        assert!(link_first(&b, &dir.path().join("nowhere/name")).is_err());
        assert!(read_if_there(dir.path()).is_err());
    }

    #[test]
    fn what_a_killed_process_left_goes_and_what_a_living_one_writes_stays() {
        let dir = tempfile::tempdir().unwrap();
        let this = Owner::this().to_string();
        let (machine_and_process, _) = this.rsplit_once('.').unwrap();
        // A process cannot have started at 1: whoever had this number is gone.
        let dead = dir.path().join(format!("{PREFIX}{machine_and_process}.1.Ab12Cd{SUFFIX}"));
        let elsewhere = dir.path().join(format!("{PREFIX}other-host.7.1.Ab12Cd{SUFFIX}"));
        let mine = AtomicFile::create(&dir.path().join("slow")).unwrap();
        for path in [&dead, &elsewhere] {
            fs::write(path, b"half").unwrap();
        }
        write_atomically(&dir.path().join("result"), b"whole").unwrap();
        assert!(!dead.exists() && elsewhere.exists() && mine.path().exists());
        mine.commit().unwrap();
    }

    #[test]
    fn a_folder_is_whole_or_absent_and_replaces_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("deep/set");
        let folder = AtomicFolder::create(&target).unwrap();
        fs::write(folder.path().join("a"), b"a").unwrap();
        assert!(!target.exists());
        folder.commit().unwrap();
        assert_eq!(fs::read(target.join("a")).unwrap(), b"a");
        drop(AtomicFolder::create(&target).unwrap());
        assert!(AtomicFolder::create(&target).unwrap().commit().unwrap_err().to_string().contains("is there"));
        assert_eq!(fs::read_dir(dir.path().join("deep")).unwrap().count(), 1);
    }

    #[test]
    fn the_first_of_two_documents_stays() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("done.json");
        assert!(write_json_first(&target, &1).unwrap());
        assert!(!write_json_first(&target, &2).unwrap());
        assert_eq!(fs::read(&target).unwrap(), b"1\n");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_committed_file_replaces_the_old_one() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("result");
        write_atomically(&target, b"old").unwrap();
        write_atomically(&target, b"new").unwrap();
        assert_eq!(fs::read(&target).unwrap(), b"new");
        assert_eq!(sha256_file(&target).unwrap(), sha256_hex(b"new"));
        assert_eq!(sha256_parts([b"n".to_vec(), b"ew".to_vec()]), sha256_hex(b"new"));
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }
}
