//! The one writer for stderr, which bars, the line above them and notes share.

use std::io::IsTerminal;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{LazyLock, PoisonError, RwLock};
use std::time::Instant;

use console::{Term, style};
use indicatif::MultiProgress;

/// All lines that change in place. They have one writer, so that bars side by side and notes between them leave no line behind.
pub(crate) static LINES: LazyLock<MultiProgress> = LazyLock::new(MultiProgress::new);

static QUIET: AtomicBool = AtomicBool::new(false);

/// Whether progress that starts from now on is shown at all. Returns what held before.
pub fn set_quiet(quiet: bool) -> bool {
    QUIET.swap(quiet, Ordering::Relaxed)
}

/// Whether progress that starts now is not shown.
pub(crate) fn quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// Whether lines can change in place.
pub(crate) fn in_place() -> bool {
    static TERMINAL: LazyLock<bool> =
        LazyLock::new(|| std::io::stderr().is_terminal() && std::env::var_os("TERM").is_none_or(|term| term != "dumb"));
    *TERMINAL && !quiet()
}

/// The columns of the terminal on stderr, at least 40; None where stderr is none.
pub fn columns() -> Option<usize> {
    Term::stderr().size_checked().map(|(_, columns)| usize::from(columns).max(40))
}

/// Who gets the notes in place of stderr.
type Listener = Box<dyn Fn(&str) + Send + Sync>;

static LISTENER: RwLock<Option<Listener>> = RwLock::new(None);

/// From now on notes go to `listener` instead of stderr; None: to stderr again. For a host with a log of its own, such as Python.
pub fn set_listener(listener: Option<Listener>) {
    *LISTENER.write().unwrap_or_else(PoisonError::into_inner) = listener;
}

/// A line of text on stderr, above all bars. Written by [`note!`](crate::note).
#[doc(hidden)]
pub fn say(text: &str) {
    if let Some(listener) = &*LISTENER.read().unwrap_or_else(PoisonError::into_inner) {
        return listener(text);
    }
    let columns = if in_place() { columns() } else { None };
    let text = columns.map_or_else(|| text.to_owned(), |columns| crate::wrap::text(text, columns));
    let print = || match text.strip_prefix("warning:") {
        Some(rest) => eprintln!("{}{rest}", style("warning:").for_stderr().yellow().bold()),
        None => eprintln!("{text}"),
    };
    // Without bars there is nothing to put aside.
    if in_place() { LINES.suspend(print) } else { print() }
}

/// `eprintln!` for notes beside the results: where bars are drawn, the note stands above them.
#[macro_export]
macro_rules! note {
    ($($text:tt)*) => { $crate::terminal::say(&format!($($text)*)) };
}

/// The progress of a piece of work. Separate from the bar, because the line above the bars asks while they are drawn.
pub(crate) struct Counter {
    pub(crate) label: String,
    pub(crate) total: u64,
    pub(crate) done: AtomicU64,
    pub(crate) started: Instant,
}

impl Counter {
    /// Seconds that are left at the rate so far; None where that says nothing yet.
    pub(crate) fn left(&self) -> Option<f64> {
        let (done, seconds) = (self.done.load(Ordering::Relaxed), self.started.elapsed().as_secs_f64());
        (done > 0 && seconds > 2.0).then(|| self.total.saturating_sub(done) as f64 * seconds / done as f64)
    }
}
