//! Long work: a bar with an ETA on a terminal, a plain line now and then elsewhere; and the wish to stop.

use std::io::IsTerminal;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use signal_hook::consts::{SIGINT, SIGTERM, SIGUSR1};
use signal_hook::iterator::Signals;

/// Time between two plain lines where there is no terminal.
const PLAIN_INTERVAL: Duration = Duration::from_secs(15);

/// The progress of one piece of work of known length. Cheap to call often; safe to share between threads.
pub struct Progress {
    label: String,
    unit: &'static str,
    total: u64,
    bar: Option<ProgressBar>,
    started: Instant,
    quiet: bool,
    plain: Mutex<Plain>,
}

struct Plain {
    done: u64,
    last: Instant,
    message: String,
}

impl Progress {
    /// Starts a bar for `total` units of `unit` ("rows", "steps").
    pub fn new(label: impl Into<String>, total: u64, unit: &'static str) -> Self {
        let label = label.into();
        let quiet = QUIET.load(Ordering::Relaxed);
        let bar = (!quiet && std::io::stderr().is_terminal()).then(|| {
            let style = "{prefix:<22} {bar:30} {human_pos}/{human_len} {per_sec:>12} {eta:>5} {msg}";
            let bar = ProgressBar::new(total).with_prefix(label.clone());
            bar.set_style(ProgressStyle::with_template(style).expect("a constant template"));
            bar
        });
        let now = Instant::now();
        Self {
            label,
            unit,
            total,
            bar,
            started: now,
            quiet,
            plain: Mutex::new(Plain { done: 0, last: now, message: String::new() }),
        }
    }

    /// Reports that `n` more units are done.
    pub fn inc(&self, n: u64) {
        if let Some(bar) = &self.bar {
            bar.inc(n);
            return;
        }
        let mut plain = self.plain.lock().expect("progress is never poisoned");
        plain.done += n;
        if !self.quiet && plain.last.elapsed() >= PLAIN_INTERVAL {
            plain.last = Instant::now();
            let seconds = self.started.elapsed().as_secs_f64();
            let rate = plain.done as f64 / seconds;
            let left = self.total.saturating_sub(plain.done) as f64 / rate.max(1e-9);
            eprintln!(
                "{}: {}/{} {} ({:.0}/s, {} left) {}",
                self.label,
                plain.done,
                self.total,
                self.unit,
                rate,
                duration(left),
                plain.message
            );
        }
    }

    /// Shows `message` behind the bar (a loss, a score).
    pub fn message(&self, message: impl Into<String>) {
        match &self.bar {
            Some(bar) => bar.set_message(message.into()),
            None => self.plain.lock().expect("progress is never poisoned").message = message.into(),
        }
    }

    /// Ends the bar and returns the seconds it took.
    pub fn finish(&self) -> f64 {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
        let seconds = self.started.elapsed().as_secs_f64();
        let rate = self.total as f64 / seconds.max(1e-9);
        if !self.quiet {
            eprintln!("{}: {} {} in {} ({:.0}/s)", self.label, self.total, self.unit, duration(seconds), rate);
        }
        seconds
    }
}

fn duration(seconds: f64) -> String {
    match seconds {
        s if s < 60.0 => format!("{s:.1} s"),
        s if s < 5400.0 => format!("{:.0} min {:02.0} s", (s / 60.0).floor(), s % 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

static QUIET: AtomicBool = AtomicBool::new(false);

/// Whether progress that starts from now on is shown at all.
pub fn set_quiet(quiet: bool) {
    QUIET.store(quiet, Ordering::Relaxed);
}

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// From now on SIGINT, SIGTERM and SIGUSR1 (a batch system's warning before its time limit) set a flag that long work looks at
/// ([`interrupted`]). A SIGINT or SIGTERM more than a second later ends the process.
pub fn listen_for_interrupts() {
    let Ok(mut signals) = Signals::new([SIGINT, SIGTERM, SIGUSR1]) else { return };
    let listen = move || {
        let mut first = None;
        for signal in signals.forever() {
            // One wish to stop is often two signals at once: `timeout` sends one to the process and one to its group.
            let patience = first.get_or_insert_with(Instant::now).elapsed();
            if signal != SIGUSR1 && patience > Duration::from_secs(1) {
                signal_hook::low_level::exit(130);
            }
            INTERRUPTED.store(true, Ordering::Relaxed);
        }
    };
    let _ = std::thread::Builder::new().name("signals".into()).spawn(listen);
}

/// Whether the user asked to stop. Long loops ask once per step and leave at the next safe point.
pub fn interrupted() -> bool {
    INTERRUPTED.load(Ordering::Relaxed)
}

#[cfg(test)]
mod tests {
    #[test]
    fn durations_read_well() {
        assert_eq!(super::duration(3.25), "3.2 s");
        assert_eq!(super::duration(125.0), "2 min 05 s");
        assert_eq!(super::duration(7200.0), "2.0 h");
    }
}
