//! Who does a piece of work: one process at a time, of all that share the sweep's folder.
//!
//! A process announces itself with a file of its own in `active/`. Behind that it looks for others. Two that come in the same moment have
//! both announced themselves before they look, so that at most one of them sees nobody. The file is touched as long as the process
//! works. A process counts as lost, and its work as free, if it has certainly ended (known of those of this machine), or if its file was not
//! touched for a minute. Machines that share a folder therefore need clocks that agree to some seconds. A process that was taken for lost and lives
//! after all does no harm (see [`super::work`]).

use std::collections::BTreeMap;
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};
use tce_base::{Owner, write_json};

use super::{Entry, Sweep};
use crate::error::Result;

/// Seconds between two heartbeats.
const BEAT: Duration = Duration::from_secs(10);
/// A process without a heartbeat for so long counts as lost.
const SILENCE: Duration = Duration::from_secs(60);
/// How often a process announces itself before it leaves the work to others.
const TURNS: usize = 5;

/// A running process.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Active {
    /// Machine and process.
    pub owner: String,
    /// The batch system's job.
    pub job: Option<String>,
    /// Seconds since 1970.
    pub since: u64,
}

/// Seconds since 1970.
pub(super) fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// Some milliseconds, which differ between processes. No result depends on them.
fn moment() -> Duration {
    let nanoseconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.subsec_nanos());
    Duration::from_millis(u64::from(nanoseconds ^ std::process::id().wrapping_mul(0x9e37_79b9)) % 50)
}

/// The right to do a piece of work, until this is dropped: a file in `active/` with a heartbeat.
pub(super) struct Claim {
    path: PathBuf,
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Claim {
    fn announce(path: PathBuf, owner: &str) -> Result<Self> {
        let job = std::env::var("SLURM_JOB_ID").ok();
        write_json(&path, &Active { owner: owner.to_owned(), job, since: now() })?;
        let stop = Arc::new(AtomicBool::new(false));
        let (flag, file) = (stop.clone(), path.clone());
        let thread = std::thread::spawn(move || {
            let mut last = Instant::now();
            while !flag.load(Ordering::Relaxed) {
                std::thread::park_timeout(BEAT);
                if last.elapsed() >= BEAT {
                    last = Instant::now();
                    // A full disk must not end the work; the sign of life comes back with the space.
                    let _ =
                        fs::File::options().append(true).open(&file).and_then(|f| f.set_modified(SystemTime::now()));
                }
            }
        });
        Ok(Self { path, stop, thread: Some(thread) })
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
        let _ = fs::remove_file(&self.path);
    }
}

/// What a file in `active/` says, and when it was last touched.
fn read(path: &Path) -> Option<(Active, SystemTime)> {
    // A network file system asks for the time anew where a file is opened.
    let mut file = fs::File::open(path).ok()?;
    let touched = file.metadata().and_then(|m| m.modified()).unwrap_or(UNIX_EPOCH);
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).ok()?;
    Some((serde_json::from_slice(&bytes).ok()?, touched))
}

impl Sweep {
    /// Running processes, by the work's id.
    pub(super) fn active(&self) -> BTreeMap<String, Vec<Active>> {
        let mut out: BTreeMap<String, Vec<Active>> = BTreeMap::new();
        for file in fs::read_dir(self.directory.join("active")).into_iter().flatten().flatten() {
            let name = file.file_name().to_string_lossy().into_owned();
            let Some((id, owner)) = name.split_once('.').filter(|(id, _)| !id.is_empty()) else { continue };
            let Some((active, touched)) = read(&file.path()) else { continue };
            let silent = SystemTime::now().duration_since(touched).is_ok_and(|d| d > SILENCE);
            // Of a process of this machine it is known at once.
            let lost = silent || Owner::of(Path::new(owner)).is_some_and(|owner| owner.dead());
            if !lost {
                out.entry(id.to_owned()).or_default().push(active);
            }
        }
        out
    }

    /// Machine and process of another one than this that does a piece of work.
    pub(super) fn other_at(&self, entry: &Entry) -> Option<String> {
        self.other_than(entry, &Owner::this().to_string())
    }

    fn other_than(&self, entry: &Entry, this: &str) -> Option<String> {
        let mut owners = self.active().remove(&entry.id)?.into_iter().map(|active| active.owner);
        owners.find(|owner| owner != this)
    }

    /// Takes a piece of work for this process; None if another one has it.
    ///
    /// # Errors
    /// If the folder cannot be written.
    pub(super) fn claim(&self, entry: &Entry) -> Result<Option<Claim>> {
        self.claim_for(entry, &Owner::this().to_string())
    }

    fn claim_for(&self, entry: &Entry, this: &str) -> Result<Option<Claim>> {
        let path = self.file("active", &format!("{}.{this}.json", entry.id));
        for _ in 0..TURNS {
            if self.other_than(entry, this).is_some() {
                return Ok(None);
            }
            let claim = Claim::announce(path.clone(), this)?;
            if self.other_than(entry, this).is_none() {
                return Ok(Some(claim));
            }
            // Another one came in the same moment, and may step back as well. They come again at different times.
            drop(claim);
            std::thread::sleep(moment());
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;

    use super::*;
    use crate::sweep::manifest::tests::{TWO, plan};

    /// A file in `active/`, as a process leaves it that announced itself so many seconds ago.
    fn announced(sweep: &Sweep, entry: &Entry, owner: &str, ago: u64) -> PathBuf {
        let path = sweep.file("active", &format!("{}.{owner}.json", entry.id));
        write_json(&path, &Active { owner: owner.to_owned(), job: None, since: now() - ago }).unwrap();
        let touched = SystemTime::now() - Duration::from_secs(ago);
        fs::File::options().append(true).open(&path).unwrap().set_modified(touched).unwrap();
        path
    }

    #[test]
    fn work_of_a_living_process_is_not_taken() {
        let dir = tempfile::tempdir().unwrap();
        let sweep = Sweep::create(dir.path(), plan(TWO).unwrap()).unwrap();
        let [entry, other] = [0, 1].map(|i| &sweep.entries()[i]);
        let claim = sweep.claim(entry).unwrap().expect("nobody has it");
        assert_eq!(sweep.active()[&entry.id].len(), 1);
        assert_eq!(sweep.other_at(entry), None, "it is this process");
        drop(claim);
        assert!(sweep.active().is_empty(), "it is free again");

        // On another machine, with a heartbeat.
        let file = announced(&sweep, entry, "elsewhere-1-2.7.1", 20);
        assert!(sweep.claim(entry).unwrap().is_none());
        assert_eq!(sweep.other_at(entry).as_deref(), Some("elsewhere-1-2.7.1"));
        assert_eq!(sweep.active()[&entry.id].len(), 1, "who leaves it leaves nothing behind");
        assert!(sweep.claim(other).unwrap().is_some(), "other work is free");
        fs::remove_file(file).unwrap();

        // Without a heartbeat for too long.
        announced(&sweep, entry, "elsewhere-1-2.7.1", 100);
        assert!(sweep.claim(entry).unwrap().is_some());

        // On this machine, killed a moment ago: a process cannot have started at 1.
        let this = Owner::this().to_string();
        let (machine_and_process, _) = this.rsplit_once('.').unwrap();
        announced(&sweep, entry, &format!("{machine_and_process}.1"), 0);
        assert!(sweep.claim(entry).unwrap().is_some());
    }

    /// Threads stand for processes of other machines.
    #[test]
    fn of_several_in_the_same_moment_at_most_one_gets_it() {
        let dir = tempfile::tempdir().unwrap();
        let sweep = Sweep::create(dir.path(), plan(TWO).unwrap()).unwrap();
        let entry = &sweep.entries()[0];
        let (holders, holdings) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let one = |process: usize| {
            for _ in 0..10 {
                let Some(claim) = sweep.claim_for(entry, &format!("elsewhere-1-2.{process}.1")).unwrap() else {
                    continue;
                };
                assert_eq!(holders.fetch_add(1, Ordering::SeqCst), 0, "two have it");
                holdings.fetch_add(1, Ordering::SeqCst);
                std::thread::sleep(Duration::from_millis(1));
                holders.fetch_sub(1, Ordering::SeqCst);
                drop(claim);
            }
        };
        std::thread::scope(|scope| {
            for process in 1..=3 {
                let one = &one;
                scope.spawn(move || one(process));
            }
        });
        assert!(holdings.load(Ordering::SeqCst) > 0, "somebody gets it");
        assert!(sweep.active().is_empty());
    }
}
