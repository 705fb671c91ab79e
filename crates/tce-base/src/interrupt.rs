//! The wish to stop.

use std::borrow::Cow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use signal_hook::consts::{SIGINT, SIGTERM, SIGUSR1};
use signal_hook::iterator::Signals;

/// The user asked to stop ([`interrupted`]), and the work stopped at a safe point. The error of every crate wraps it as `Interrupted`.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Interrupted(Cow<'static, str>);

impl Interrupted {
    /// The exit code of a command that was interrupted.
    pub const EXIT_CODE: i32 = 130;

    /// Nothing of the work is kept.
    pub fn nothing_kept() -> Self {
        Self("interrupted".into())
    }

    /// There are checkpoints: the same command resumes from them.
    pub fn resumable() -> Self {
        Self("interrupted; what was finished is kept, and the same command continues from there".into())
    }

    /// `done` of `total` `unit` of `work` are done.
    pub fn after(work: &str, done: u64, total: u64, unit: &str) -> Self {
        Self(format!("{work}: interrupted after {done} of {total} {unit}").into())
    }
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

/// Asks long work to stop, or takes that back: for a host that has signal handlers of its own, such as Python.
pub fn set_interrupted(stop: bool) {
    INTERRUPTED.store(stop, Ordering::Relaxed);
}

/// Whether the user asked to stop. Long loops ask once per step and leave at the next safe point.
pub fn interrupted() -> bool {
    INTERRUPTED.load(Ordering::Relaxed)
}
