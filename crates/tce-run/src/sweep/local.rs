//! A sweep on this machine: some processes at a time, each with its share of the cores.
//!
//! Other launches may be at work in the same folder, here or on other machines. What their processes do is left to them; at the end, this
//! launch waits for it, and does it if they are lost.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tce_base::format::about;
use tce_base::{FileError, Headline, Progress, counted, create_folder, interrupted};

use super::{Entry, Sweep};
use crate::device_kind::DeviceKind;
use crate::error::{Error, Result};

/// Time between two estimates of the time left.
const LOOK: Duration = Duration::from_secs(3);
/// Time between two looks for free work, while processes of others are at work.
const FREE: Duration = Duration::from_secs(1);

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
    /// pieces that others need come first. What processes of other launches are doing is waited for.
    ///
    /// # Errors
    /// If a process cannot be started, or the user interrupts; the processes are then given the time to write their checkpoints.
    pub fn launch_here(&self, share: Share) -> Result<usize> {
        let mut launch = Launch::new(self, share)?;
        let failed = launch.run();
        // Nobody would wait for them.
        stop(launch.running);
        failed
    }

    fn log(&self, entry: &Entry) -> PathBuf {
        self.file("logs", &format!("{}.log", entry.id))
    }

    fn start(&self, program: &Path, entry: &Entry, share: Share) -> Result<Child> {
        self.forget_failure(entry);
        let path = self.log(entry);
        let directory = self.directory.join("logs");
        create_folder(&directory)?;
        let log = File::options().create(true).append(true).open(&path);
        let log = log.map_err(|e| FileError::new(&path, "open", e))?;
        let mut command = Command::new(program);
        command.args(["--threads", &share.threads.to_string(), "--save-every", &share.save_every.to_string()]);
        command.args(["--device", &share.device.to_string()]);
        command.args(["sweep", "run-one"]).arg(&self.directory).arg(entry.index.to_string());
        // Where another launch was faster, there is other work.
        command.arg("--leave-running");
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
        // A signal to the terminal's group would reach the workers twice, and a second one ends them at once.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        command.spawn().map_err(|e| Error::Failed(format!("cannot start a process: {e}")))
    }
}

/// A sweep that processes of this machine are doing.
struct Launch<'a> {
    sweep: &'a Sweep,
    share: Share,
    program: PathBuf,
    /// What is neither done, nor given up, nor running here.
    todo: BTreeSet<usize>,
    running: BTreeMap<usize, Child>,
    tries: BTreeMap<usize, usize>,
    /// The last message of each piece: one that fails twice in the same words fails a third time, too.
    messages: BTreeMap<usize, String>,
    failed: usize,
    /// Whether the user knows that others are waited for.
    told: bool,
}

impl<'a> Launch<'a> {
    fn new(sweep: &'a Sweep, share: Share) -> Result<Self> {
        // Once: the program may be replaced on the way.
        let program = std::env::current_exe().map_err(|e| Error::Failed(format!("cannot find this program: {e}")))?;
        Ok(Self {
            sweep,
            share,
            program,
            todo: sweep.missing()?.iter().map(|e| e.index).collect(),
            running: BTreeMap::new(),
            tries: BTreeMap::new(),
            messages: BTreeMap::new(),
            failed: 0,
            told: false,
        })
    }

    /// Starts processes and waits for them, until nothing is left to do; those that are running at an error are the caller's.
    fn run(&mut self) -> Result<usize> {
        let all = self.todo.len();
        let headline = Arc::new(Mutex::new(String::new()));
        let shown = headline.clone();
        let _line = Headline::drawn_by(move || shown.lock().unwrap_or_else(PoisonError::into_inner).clone());
        let progress = Progress::uneven("sweep", all as u64, "pieces of work");
        let (mut searched, mut looked): (Option<Instant>, Option<Instant>) = (None, None);
        while !(self.todo.is_empty() && self.running.is_empty()) {
            if interrupted() {
                return Err(Error::interrupted());
            }
            // The folder is asked what others do, so not at every turn.
            if searched.is_none_or(|at| at.elapsed() > FREE) {
                self.fill(&progress)?;
                searched = Some(Instant::now());
            }
            // Every record is read for it, so not at every turn.
            if looked.is_none_or(|at| at.elapsed() > LOOK) {
                let left = self.sweep.status().ok().and_then(|s| s.seconds_left);
                let text = headline_of(all - self.todo.len() - self.running.len(), self.running.len(), all, left);
                *headline.lock().unwrap_or_else(PoisonError::into_inner) = text;
                looked = Some(Instant::now());
            }
            std::thread::sleep(Duration::from_millis(50));
            if self.reap(&progress)? {
                searched = None;
            }
        }
        progress.finish();
        Ok(self.failed)
    }

    /// Starts as many processes as are wanting, for work that nobody does.
    fn fill(&mut self, progress: &Progress) -> Result<()> {
        let most = self.share.workers.max(1);
        if self.running.len() >= most || self.todo.is_empty() {
            return Ok(());
        }
        let sweep = self.sweep;
        let active = sweep.active();
        for index in self.todo.clone() {
            if self.running.len() >= most {
                break;
            }
            let entry = &sweep.entries()[index];
            // What it needs is done, or has failed: then it tries by itself.
            let ready = entry.needs.iter().all(|n| !self.todo.contains(n) && !self.running.contains_key(n));
            if !ready || active.contains_key(&entry.id) {
                continue;
            }
            // Others may have done it.
            if sweep.outcome(entry)?.is_some() {
                progress.inc(1);
            } else {
                self.running.insert(index, sweep.start(&self.program, entry, self.share)?);
            }
            self.todo.remove(&index);
        }
        if self.running.is_empty() && !self.todo.is_empty() && !self.told {
            self.told = true;
            let left = counted(self.todo.len(), "piece of work is", "pieces of work are");
            tce_base::note!("{left} left, and other launches are busy with that; waiting for them");
        }
        Ok(())
    }

    /// Takes note of processes that have ended, and tells whether there are any.
    fn reap(&mut self, progress: &Progress) -> Result<bool> {
        let mut ended = Vec::new();
        for (&index, child) in &mut self.running {
            let status = child.try_wait().map_err(|e| Error::Failed(format!("cannot wait for a process: {e}")))?;
            ended.extend(status.map(|status| (index, status)));
        }
        for &(index, status) in &ended {
            self.running.remove(&index);
            self.settle(index, status, progress)?;
        }
        Ok(!ended.is_empty())
    }

    /// What becomes of a piece of work whose process has ended.
    fn settle(&mut self, index: usize, status: ExitStatus, progress: &Progress) -> Result<()> {
        let sweep = self.sweep;
        let entry = &sweep.entries()[index];
        if sweep.outcome(entry)?.is_some() {
            progress.inc(1);
            return Ok(());
        }
        if status.success() {
            // Another process was faster and is doing it.
            self.todo.insert(index);
            return Ok(());
        }
        let tries = self.tries.entry(index).or_default();
        *tries += 1;
        let words = sweep.failure(entry).map(|f| f.error);
        let reason = words.clone().unwrap_or_else(|| status.to_string());
        let before = self.messages.insert(index, reason.clone());
        // Many pieces fail for one cause: it is told once.
        let told = self.messages.iter().any(|(i, m)| *i != index && *m == reason) || before.as_ref() == Some(&reason);
        match told {
            false => tce_base::note!("{entry}: failed: {reason}; its log: {}", sweep.log(entry).display()),
            true => tce_base::note!("{entry}: failed, with the same message"),
        }
        // A process that was killed has no words, and is tried as often as was said.
        let again = words.is_none() || before != words;
        if again && *tries <= self.share.retries {
            self.todo.insert(index);
        } else {
            if words.is_none() {
                sweep.note_failure(entry, &reason)?;
            }
            self.failed += 1;
            progress.inc(1);
        }
        Ok(())
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
    let processes = counted(running.len(), "process at its", "processes at their");
    tce_base::note!("stopping {processes} next checkpoint ...");
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
