//! What a command prints: a table for people, JSON or CSV for programs.

use std::io::IsTerminal;
use std::sync::{Mutex, PoisonError};

use serde::Serialize;

mod csv;
mod table;

pub use table::{heading, list, mark_best, table};
pub use tce_base::wrap::{break_line, prose};

/// The form of the results.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// Tables and sentences.
    Text,
    /// One JSON document.
    Json,
    /// The rows of the JSON document, see [`csv`].
    Csv,
}

/// Where and how results are printed. Progress and notes go to stderr, results to stdout.
#[derive(Clone, Copy, Debug)]
pub struct Output<'a> {
    /// In which form.
    pub form: Form,
    /// Where results go instead of stdout.
    pub into: Option<&'a Mutex<String>>,
}

impl Output<'_> {
    /// Prints `value` as JSON or CSV, or what `render` makes of it.
    pub fn print<T: Serialize>(&self, value: &T, render: impl FnOnce(&T) -> String) {
        use std::io::Write;
        // The command is at its end, and so are its steps.
        tce_base::end_course(tce_base::LastStep::Done);
        let text = match self.form {
            Form::Json => serde_json::to_string_pretty(value).expect("results are plain data"),
            Form::Csv => csv::of(&serde_json::to_string(value).expect("results are plain data")),
            Form::Text => fit(&render(value)),
        };
        if let Some(into) = self.into {
            into.lock().unwrap_or_else(PoisonError::into_inner).push_str(&text);
            return;
        }
        // A closed pipe (`tce ... | head`) is not an error of the command.
        let _ = writeln!(std::io::stdout(), "{}", text.trim_end());
    }
}

/// `text` with lines no longer than they may be.
pub fn fit(text: &str) -> String {
    width().map_or_else(|| text.to_owned(), |width| tce_base::wrap::text(text, width))
}

/// The columns that a line may have: `COLUMNS`, else the terminal's; None where results go to a file or a pipe, whose lines may be as long
/// as they are.
pub fn width() -> Option<usize> {
    let told = std::env::var("COLUMNS").ok().and_then(|c| c.parse().ok()).filter(|c| *c >= 20);
    let terminal = || {
        let terminal = std::io::stdout().is_terminal().then(console::Term::stdout)?;
        terminal.size_checked().map(|(_, columns)| usize::from(columns))
    };
    told.or_else(terminal)
}
