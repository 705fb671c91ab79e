//! A sweep on this machine: some processes at a time, each with its share of the cores.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tce_base::format::about;
use tce_base::{FileError, Headline, Progress, interrupted};

use super::{Entry, Sweep};
use crate::device_kind::DeviceKind;
use crate::error::{Error, Result};

/// Time between two estimates of the time left.
const LOOK: Duration = Duration::from_secs(3);

/// How to share the machine.
#[derive(Clone, Copy, Debug)]
pub struct Share {
    /// Processes at a time.
    pub workers: usize,
    /// Threads of each.
    pub threads: usize,
    /// How often a piece of work is tried again after a failure.
    pub retries: usize,
    /// Seconds between checkpoints.
    pub save_every: f64,
    /// What computes the networks.
    pub device: DeviceKind,
}

impl Sweep {
    /// Does unfinished work, and returns how many pieces are unfinished at the end. Interrupted work resumes from its checkpoint;
    /// pieces that others need come first.
    ///
    /// # Errors
    /// If a process cannot be started, or the user interrupts; the processes are then given the time to write their checkpoints.
    pub fn launch_here(&self, share: Share) -> Result<usize> {
        let mut running = BTreeMap::new();
        let failed = self.share_out(share, &mut running);
        // Nobody would wait for them, and a second launch would compete with them.
        stop(running);
        failed
    }

    /// Starts processes and waits for them, until nothing is left to do; those that are `running` at an error are the caller's.
    fn share_out(&self, share: Share, running: &mut BTreeMap<usize, Child>) -> Result<usize> {
        // Once: the program may be replaced on the way.
        let program = std::env::current_exe().map_err(|e| Error::Failed(format!("cannot find this program: {e}")))?;
        let mut todo: BTreeSet<usize> = self.missing()?.iter().map(|e| e.index).collect();
        let headline = Arc::new(Mutex::new(String::new()));
        let shown = headline.clone();
        let _line = Headline::drawn_by(move || shown.lock().unwrap_or_else(PoisonError::into_inner).clone());
        let all = todo.len();
        let mut looked: Option<Instant> = None;
        let progress = Progress::uneven("sweep", todo.len() as u64, "pieces of work");
        let mut tries: BTreeMap<usize, usize> = BTreeMap::new();
        // The last message of each piece: one that fails twice in the same words fails a third time, too.
        let mut messages: BTreeMap<usize, String> = BTreeMap::new();
        let mut failed = 0;
        while !(todo.is_empty() && running.is_empty()) {
            if interrupted() {
                return Err(Error::interrupted());
            }
            while running.len() < share.workers.max(1) {
                // What it needs is done, or has failed: then it tries by itself.
                let ready = |i: &&usize| {
                    self.entries()[**i].needs.iter().all(|n| !todo.contains(n) && !running.contains_key(n))
                };
                let Some(&next) = todo.iter().find(ready) else { break };
                todo.remove(&next);
                running.insert(next, self.start(&program, &self.entries()[next], share)?);
            }
            // Every record is read for it, so not at every turn.
            if looked.is_none_or(|at| at.elapsed() > LOOK) {
                let left = self.status().ok().and_then(|s| s.seconds_left);
                let text = headline_of(all - todo.len() - running.len(), running.len(), all, left);
                *headline.lock().unwrap_or_else(PoisonError::into_inner) = text;
                looked = Some(Instant::now());
            }
            std::thread::sleep(Duration::from_millis(50));
            let mut ended = Vec::new();
            for (&index, child) in running.iter_mut() {
                let status = child.try_wait().map_err(|e| Error::Failed(format!("cannot wait for a process: {e}")))?;
                if let Some(status) = status {
                    ended.push((index, status));
                }
            }
            for (index, status) in ended {
                running.remove(&index);
                let entry = &self.entries()[index];
                if self.outcome(entry)?.is_some() {
                    progress.inc(1);
                    continue;
                }
                let tries = tries.entry(index).or_default();
                *tries += 1;
                let words = self.failure(entry).map(|f| f.error);
                let reason = words.clone().unwrap_or_else(|| status.to_string());
                let before = messages.insert(index, reason.clone());
                // Many pieces fail for one cause: it is told once.
                let told =
                    messages.iter().any(|(i, m)| *i != index && *m == reason) || before.as_ref() == Some(&reason);
                match told {
                    false => tce_base::note!("{entry}: failed: {reason}; its log: {}", self.log(entry).display()),
                    true => tce_base::note!("{entry}: failed, with the same message"),
                }
                // A process that was killed has no words, and is tried as often as was said.
                let again = words.is_none() || before != words;
                if again && *tries <= share.retries {
                    todo.insert(index);
                } else {
                    if words.is_none() {
                        self.note_failure(entry, &reason)?;
                    }
                    failed += 1;
                    progress.inc(1);
                }
            }
        }
        progress.finish();
        Ok(failed)
    }

    fn log(&self, entry: &Entry) -> PathBuf {
        self.file("logs", &format!("{}.log", entry.id))
    }

    fn start(&self, program: &Path, entry: &Entry, share: Share) -> Result<Child> {
        self.forget_failure(entry);
        let path = self.log(entry);
        let directory = self.directory.join("logs");
        fs::create_dir_all(&directory).map_err(|e| FileError::new(&directory, "create the directory", e))?;
        let log = File::options().create(true).append(true).open(&path);
        let log = log.map_err(|e| FileError::new(&path, "open", e))?;
        let mut command = Command::new(program);
        command.args(["--threads", &share.threads.to_string(), "--save-every", &share.save_every.to_string()]);
        command.args(["--device", &share.device.to_string()]);
        command.args(["sweep", "run-one"]).arg(&self.directory).arg(entry.index.to_string());
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
        // A signal to the terminal's group would reach the workers twice, and a second one ends them at once.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        command.spawn().map_err(|e| Error::Failed(format!("cannot start a process: {e}")))
    }
}

/// Which pieces of work are running, and the time left, where it is known.
fn headline_of(done: usize, running: usize, all: usize, left: Option<f64>) -> String {
    let pieces = match running {
        0 | 1 => format!("piece {}", (done + running).max(1)),
        n => format!("pieces {} to {}", done + 1, done + n),
    };
    let left = left.map_or_else(String::new, |s| format!(", {} left", about(s)));
    format!("{pieces} of {all}{left}")
}

/// Asks the processes to stop at their next safe point, and waits for them.
fn stop(running: BTreeMap<usize, Child>) {
    if running.is_empty() {
        return;
    }
    tce_base::note!("stopping {} processes at their next checkpoint ...", running.len());
    for child in running.values() {
        terminate(child);
    }
    for (_, mut child) in running {
        let _ = child.wait();
    }
}

#[cfg(unix)]
fn terminate(child: &Child) {
    // The number of a child that was not waited for is its own.
    let _ = Command::new("kill").args(["-TERM", &child.id().to_string()]).status();
}

#[cfg(not(unix))]
fn terminate(_: &Child) {}

#[cfg(test)]
mod tests {
    use super::headline_of;

    #[test]
    fn the_line_above_the_bar_tells_pieces_and_time() {
        assert_eq!(headline_of(4, 1, 12, Some(240.0)), "piece 5 of 12, about 4 min left");
        assert_eq!(headline_of(4, 2, 12, None), "pieces 5 to 6 of 12");
    }
}
