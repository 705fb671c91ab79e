//! Temporary directories that are named by their process. Leftovers of killed processes can be told from the work of running ones, and
//! are removed.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::{FileError, Owner, create_folder};

/// The folder of attempts, beside what they are to become: its entries are named by their [`Owner`].
pub const ATTEMPTS: &str = "attempts";

/// A directory of this process; it goes when this is dropped.
#[derive(Debug)]
pub struct Scratch {
    directory: PathBuf,
}

impl Scratch {
    /// One in `beside`.
    pub fn new(beside: &Path) -> Result<Self, FileError> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let name = format!("{}.{}", Owner::this(), COUNT.fetch_add(1, Ordering::Relaxed));
        let directory = beside.join(ATTEMPTS).join(name);
        create_folder(&directory)?;
        Ok(Self { directory })
    }

    /// The path of `name` in it.
    pub fn file(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    /// Removes what dead processes of this machine left in `beside`.
    pub fn tidy(beside: &Path) {
        let attempts = beside.join(ATTEMPTS);
        for entry in fs::read_dir(&attempts).into_iter().flatten().flatten() {
            if Owner::of(&entry.path()).is_some_and(|owner| owner.dead()) {
                let _ = fs::remove_dir_all(entry.path());
            }
        }
        // Only if nothing is left in it.
        let _ = fs::remove_dir(attempts);
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.directory);
        if let Some(attempts) = self.directory.parent() {
            let _ = fs::remove_dir(attempts);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whoever removes the last attempt removes their folder, which another one may be about to use.
    #[test]
    fn the_folder_of_attempts_may_go_while_another_begins() {
        let dir = tempfile::tempdir().unwrap();
        let come_and_go = || (0..2_000).for_each(|_| drop(Scratch::new(dir.path()).unwrap()));
        std::thread::scope(|scope| (0..3).for_each(|_| drop(scope.spawn(come_and_go))));
        assert!(!dir.path().join(ATTEMPTS).exists());
    }

    #[test]
    fn what_the_dead_left_goes_and_what_the_living_have_stays() {
        let dir = tempfile::tempdir().unwrap();
        let mine = Scratch::new(dir.path()).unwrap();
        fs::write(mine.file("rows"), b"rows").unwrap();
        // A process cannot have started at 1: whoever had this number is gone.
        let (machine, _) = mine.directory.file_name().unwrap().to_str().unwrap().split_once('.').unwrap();
        let dead = dir.path().join(ATTEMPTS).join(format!("{machine}.{}.1.0", std::process::id()));
        fs::create_dir_all(&dead).unwrap();
        Scratch::tidy(dir.path());
        assert!(mine.file("rows").exists() && !dead.exists());
        drop(mine);
        assert!(!dir.path().join(ATTEMPTS).exists());
    }
}
