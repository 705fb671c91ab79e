//! Long calls: without Python's lock, with progress, and with an ear for Ctrl-C.

use std::any::Any;
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError, TryLockError};
use std::time::Duration;
use std::{process, thread};

use pyo3::marker::Ungil;
use pyo3::prelude::*;
use tce_run::Error;

use crate::errors::{exception, raised};

/// Time between two looks at signals and progress.
const TICK: Duration = Duration::from_millis(100);
/// Stack of the thread that works: that of a main thread.
const STACK: usize = 8 << 20;

/// Long calls take turns: each uses all cores, and there is one flag that stops them.
static TURN: Mutex<()> = Mutex::new(());

/// How a call shows how far it is: whether by bars and lines on stderr, and what is called with label, units done, all units, unit and
/// seconds, for every piece of work under way.
#[derive(FromPyObject)]
pub struct Progress(bool, Option<Py<PyAny>>);

/// The process whose threads compute. A fork of it has none of them, and would wait for them for ever.
static OWNER: OnceLock<u32> = OnceLock::new();

/// Refuses to work in a fork of a process that has worked.
fn ensure_not_forked(py: Python<'_>) -> PyResult<()> {
    let (owner, own) = (*OWNER.get_or_init(process::id), process::id());
    if owner == own {
        return Ok(());
    }
    let words = format!(
        "found a process ({own}) that was forked from one that had computed ({owner}), expected one of its own: the threads were not copied. \
         Use multiprocessing.get_context(\"spawn\"), or fork before the first call"
    );
    Err(exception(py, "Error", words))
}

enum Message {
    Note(String),
    Done,
}

/// Short work on all cores, without Python's lock.
pub fn aside<T: Ungil>(py: Python<'_>, work: impl FnOnce() -> T + Ungil) -> PyResult<T> {
    ensure_not_forked(py)?;
    Ok(py.detach(work))
}

/// Waits until no other long call is under way.
fn turn(py: Python<'_>) -> PyResult<MutexGuard<'static, ()>> {
    loop {
        match TURN.try_lock() {
            Ok(guard) => return Ok(guard),
            Err(TryLockError::Poisoned(poisoned)) => return Ok(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => {
                py.detach(|| thread::sleep(TICK));
                py.check_signals()?;
            }
        }
    }
}

/// Does `work` on a thread of its own. This one, which is Python's, hands notes to `logging`, tells `progress`, and has the work stop at its
/// next checkpoint when a signal handler raises (Ctrl-C: KeyboardInterrupt) or `progress` does.
pub fn attended<T: Send>(
    py: Python<'_>,
    progress: Progress,
    work: impl FnOnce() -> Result<T, Error> + Send,
) -> PyResult<T> {
    ensure_not_forked(py)?;
    let _turn = turn(py)?;
    let (sender, messages) = channel();
    // Waited for without Python's lock, which only what threads may share can be.
    let messages = Mutex::new(messages);
    let notes = sender.clone();
    let listener = move |text: &str| drop(notes.send(Message::Note(text.to_owned())));
    tce_base::set_interrupted(false);
    tce_base::set_listener(Some(Box::new(listener)));
    tce_base::set_quiet(!progress.0);
    let (result, stopped) = thread::scope(|scope| {
        let worker = thread::Builder::new().name("tce".into()).stack_size(STACK).spawn_scoped(scope, move || {
            let result = work();
            let _ = sender.send(Message::Done);
            result
        });
        let worker = match worker {
            Ok(worker) => worker,
            Err(e) => return (Ok(Err(Error::Failed(format!("cannot start a thread: {e}")))), None),
        };
        let mut stopped = None;
        while !worker.is_finished() {
            let told = attend(py, &messages, &progress);
            if let (Err(error), None) = (told, &stopped) {
                tce_base::set_interrupted(true);
                stopped = Some(error);
            }
        }
        (py.detach(|| worker.join()), stopped)
    });
    let done = result.as_ref().is_ok_and(Result::is_ok);
    tce_base::end_course(if done { tce_base::LastStep::Done } else { tce_base::LastStep::BrokenOff });
    tce_base::set_interrupted(false);
    tce_base::set_listener(None);
    let messages = messages.into_inner().unwrap_or_else(PoisonError::into_inner);
    let rest = messages.try_iter().try_for_each(|message| log(py, &message));
    match (result, stopped) {
        (Err(panic), _) => Err(exception(py, "Error", format!("a fault of the program: {}", words(&*panic)))),
        // What asked to stop is told, unless it came too late.
        (Ok(Err(error)), Some(cause)) if error.exit_code() == 130 => Err(interrupted(py, &error, cause)),
        (Ok(Err(error)), _) => Err(raised(py, &error)),
        (Ok(Ok(value)), None) => rest.map(|()| value),
        (Ok(Ok(_)), Some(cause)) => Err(cause),
    }
}

/// Waits for a note or the end, at most a tick, and looks after everything.
fn attend(py: Python<'_>, messages: &Mutex<Receiver<Message>>, progress: &Progress) -> PyResult<()> {
    let message = py.detach(|| messages.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(TICK));
    message.map_or(Ok(()), |message| log(py, &message))?;
    py.check_signals()?;
    if let Some(call) = &progress.1 {
        for r in tce_base::running() {
            call.call1(py, (r.label, r.done, r.total, r.unit, r.seconds))?;
        }
    }
    Ok(())
}

/// A note for the logger `tce`.
fn log(py: Python<'_>, message: &Message) -> PyResult<()> {
    let Message::Note(text) = message else { return Ok(()) };
    let logger = py.import("logging")?.call_method1("getLogger", ("tce",))?;
    match text.strip_prefix("warning: ") {
        Some(warning) => logger.call_method1("warning", (warning,))?,
        None => logger.call_method1("info", (text,))?,
    };
    Ok(())
}

/// The exception of a call that was stopped by `cause`: what is no wish to stop is raised as it is.
fn interrupted(py: Python<'_>, error: &Error, cause: PyErr) -> PyErr {
    if !cause.is_instance_of::<pyo3::exceptions::PyKeyboardInterrupt>(py) {
        return cause;
    }
    let raised = raised(py, error);
    raised.set_cause(py, Some(cause));
    raised
}

fn words(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic").to_owned()
}
