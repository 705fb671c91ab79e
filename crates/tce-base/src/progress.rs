//! Progress of long work: a bar with the time left on a terminal, a plain line at intervals elsewhere.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressState, ProgressStyle};

use crate::course;
use crate::format::{count, duration, rate};
use crate::terminal::{Counter, LINES, in_place, quiet, say};

/// Time between two plain lines where there is no terminal.
const PLAIN_INTERVAL: Duration = Duration::from_secs(15);
/// Interval at which a bar without progress is drawn again, so that its time left is updated.
const TICK: Duration = Duration::from_millis(500);

/// Work that has begun and is not finished.
static RUNNING: Mutex<Vec<(Weak<Counter>, &'static str)>> = Mutex::new(Vec::new());

/// The progress of a piece of work.
#[derive(Clone, Debug, PartialEq)]
pub struct Running {
    /// What it is.
    pub label: String,
    /// Finished units.
    pub done: u64,
    /// All units.
    pub total: u64,
    /// What is counted ("rows", "steps").
    pub unit: &'static str,
    /// Seconds since it began.
    pub seconds: f64,
}

/// The running pieces of work, the oldest first: for a host that shows progress in its own way.
pub fn running() -> Vec<Running> {
    let running = RUNNING.lock().unwrap_or_else(PoisonError::into_inner);
    let tell = |(counter, unit): &(Weak<Counter>, &'static str)| {
        let counter = counter.upgrade()?;
        let (done, seconds) = (counter.done.load(Ordering::Relaxed), counter.started.elapsed().as_secs_f64());
        Some(Running { label: counter.label.clone(), done, total: counter.total, unit, seconds })
    };
    running.iter().filter_map(tell).collect()
}

/// The progress of one piece of work of known length. Cheap to call often; safe to share between threads. A bar that is dropped before
/// its end leaves no line.
pub struct Progress {
    unit: &'static str,
    counter: Arc<Counter>,
    /// Whether every unit costs the same, so that the time left follows from the rate.
    even: bool,
    bar: Option<ProgressBar>,
    quiet: bool,
    plain: Mutex<Plain>,
}

struct Plain {
    last: Instant,
    message: String,
}

impl Progress {
    /// Starts a bar for `total` units of `unit` ("rows", "steps").
    pub fn new(label: impl Into<String>, total: u64, unit: &'static str) -> Self {
        Self::start(label.into(), total, unit, true)
    }

    /// The same for units of different cost (pieces of a sweep, say), whose number does not tell what is left.
    pub fn uneven(label: impl Into<String>, total: u64, unit: &'static str) -> Self {
        Self::start(label.into(), total, unit, false)
    }

    fn start(label: String, total: u64, unit: &'static str, even: bool) -> Self {
        let started = Instant::now();
        let counter = Arc::new(Counter { label, total, done: AtomicU64::new(0), started });
        course::works(&counter);
        let mut running = RUNNING.lock().unwrap_or_else(PoisonError::into_inner);
        running.retain(|(counter, _)| counter.strong_count() > 0);
        running.push((Arc::downgrade(&counter), unit));
        drop(running);
        let bar = in_place().then(|| {
            let bar = ProgressBar::new(total).with_prefix(counter.label.clone()).with_style(bar_style(even));
            let bar = LINES.add(bar);
            bar.enable_steady_tick(TICK);
            bar
        });
        let plain = Mutex::new(Plain { last: started, message: String::new() });
        Self { unit, counter, even, bar, quiet: quiet(), plain }
    }

    /// Reports that `n` more units are done.
    pub fn inc(&self, n: u64) {
        let done = self.counter.done.fetch_add(n, Ordering::Relaxed) + n;
        if let Some(bar) = &self.bar {
            bar.inc(n);
            return;
        }
        if self.quiet {
            return;
        }
        let mut plain = self.plain.lock().expect("progress is never poisoned");
        if plain.last.elapsed() >= PLAIN_INTERVAL {
            plain.last = Instant::now();
            let Counter { label, total, started, .. } = &*self.counter;
            let per_second = done as f64 / started.elapsed().as_secs_f64();
            let left = total.saturating_sub(done) as f64 / per_second.max(1e-9);
            let pace = match self.even {
                true => format!("({}, {} left) {}", rate(per_second), duration(left), plain.message),
                false => String::new(),
            };
            let line = format!("{label}: {}/{} {} {pace}", count(done), count(*total), self.unit);
            say(line.trim_end());
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
        self.clear();
        let Counter { label, total, started, .. } = &*self.counter;
        let seconds = started.elapsed().as_secs_f64();
        if !self.quiet {
            say(&done_line(label, *total, self.unit, seconds));
        }
        seconds
    }

    fn clear(&self) {
        if let Some(bar) = &self.bar
            && !bar.is_finished()
        {
            bar.finish_and_clear();
            LINES.remove(bar);
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.clear();
    }
}

/// One line of at most the terminal's width: a longer one would wrap, and leave a line behind whenever it is drawn anew.
fn bar_style(even: bool) -> ProgressStyle {
    let template = match even {
        true => "{prefix:22!} {wide_bar:.cyan/dim} {human_pos}/{human_len} {rate:>9} {left:>12} {msg:11!}",
        false => "{prefix:22!} {wide_bar:.cyan/dim} {human_pos}/{human_len}",
    };
    let style = ProgressStyle::with_template(template).expect("a constant template");
    // What cannot be written into a line is left out of it.
    let write_rate = |state: &ProgressState, out: &mut dyn std::fmt::Write| {
        let _ = out.write_str(&rate(state.per_sec()));
    };
    let write_left = |state: &ProgressState, out: &mut dyn std::fmt::Write| {
        // At the beginning nobody knows.
        let known = state.pos() > 0 && state.elapsed() > Duration::from_secs(1);
        let left = if known { short(state.eta().as_secs_f64()) } else { String::new() };
        let _ = out.write_str(&left);
    };
    style.with_key("rate", write_rate).with_key("left", write_left).progress_chars("━━─")
}

/// What is left of a bar.
fn short(seconds: f64) -> String {
    match seconds {
        s if s < 60.0 => format!("{s:.0} s left"),
        s if s < 5400.0 => format!("{:.0} min left", s / 60.0),
        s => format!("{:.1} h left", s / 3600.0),
    }
}

/// What was done, and the time it took.
fn done_line(label: &str, total: u64, unit: &str, seconds: f64) -> String {
    match total {
        0 => format!("{label}: nothing was left to do"),
        n => format!("{label}: {} {unit} in {} ({})", count(n), duration(seconds), rate(n as f64 / seconds.max(1e-9))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_done_line_says_the_total_and_the_time() {
        assert_eq!(done_line("learn bc [0]", 12_000, "steps", 5.4225), "learn bc [0]: 12,000 steps in 5.4 s (2,213/s)");
        assert_eq!(done_line("sweep", 3, "pieces of work", 400.0), "sweep: 3 pieces of work in 6 min 40 s (27.0/h)");
        assert_eq!(done_line("train q_mix", 0, "steps", 0.0), "train q_mix: nothing was left to do");
    }

    #[test]
    fn what_runs_is_told_until_it_is_over() {
        let own = || running().into_iter().find(|r| r.label == "a test of running");
        let progress = Progress::new("a test of running", 10, "rows");
        progress.inc(3);
        let told = own().unwrap();
        assert_eq!((told.done, told.total, told.unit), (3, 10, "rows"));
        drop(progress);
        assert_eq!(own(), None);
    }

    #[test]
    fn what_is_left_is_short() {
        assert_eq!([4.2, 125.0, 7200.0].map(short), ["4 s left", "2 min left", "2.0 h left"]);
    }

    #[test]
    fn the_templates_are_such() {
        let _ = [true, false].map(bar_style);
    }
}
