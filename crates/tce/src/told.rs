//! How an error is told on stderr: a cross, and its own words, once. They hold what caused it: the chain of causes would say it again, in
//! the system's words.

use std::error::Error;

use console::style;
use tce_base::terminal::columns;

use crate::output::break_line;

/// In front of all lines but the first.
const INDENT: &str = "    ";

/// The text for `error`: wrapped and red on a terminal, plain elsewhere, so that logs can be searched.
pub fn told(error: &dyn Error) -> String {
    laid_out(error, columns().unwrap_or(usize::MAX)).replacen('×', &style('×').for_stderr().red().to_string(), 1)
}

/// The text of clap for a wrong call, wrapped on a terminal: clap wraps its help, but not its errors.
pub fn wrong_call(error: &clap::Error) -> String {
    let styled = error.render();
    let text = if console::colors_enabled_stderr() { styled.ansi().to_string() } else { styled.to_string() };
    match columns() {
        Some(columns) => wrapped(&text, columns),
        None => text,
    }
}

/// Every line of `text` in at most `width` columns; further lines stand as deep as their first.
fn wrapped(text: &str, width: usize) -> String {
    let depth = |line: &str| line.len() - line.trim_start().len();
    text.lines().map(|line| break_line(line, depth(line), width) + "\n").collect()
}

fn laid_out(error: &dyn Error, width: usize) -> String {
    // A line that is indented is a command or a path, to be copied whole.
    let lines = |line: &str| match line.starts_with("  ") {
        true => line.to_owned(),
        false => break_line(line, 0, width.saturating_sub(INDENT.len())),
    };
    let text = error.to_string().lines().map(lines).collect::<Vec<_>>().join("\n");
    let told = text.lines().enumerate().map(|(k, line)| format!("{}{line}\n", if k == 0 { "  × " } else { INDENT }));
    told.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("{0}")]
    struct Told(&'static str, #[source] Option<Box<Told>>);

    #[test]
    fn an_error_is_told_once() {
        let error = Told("it failed: no space\nDo this.", Some(Box::new(Told("no space", None))));
        assert_eq!(laid_out(&error, 80), "  × it failed: no space\n    Do this.\n");
    }

    #[test]
    fn a_wrong_call_is_wrapped_between_words() {
        assert_eq!(
            wrapped("error: one two\n\n  tip: three four\n", 10),
            "error: one\ntwo\n\n  tip:\n  three\n  four\n"
        );
        assert_eq!(wrapped("\u{1b}[1merror:\u{1b}[0m one two", 14), "\u{1b}[1merror:\u{1b}[0m one two\n");
    }

    #[test]
    fn prose_is_wrapped_and_commands_stay_whole() {
        let error = Told("one two three four\n  pip install one two three", None);
        assert_eq!(laid_out(&error, 14), "  × one two\n    three four\n      pip install one two three\n");
        assert_eq!(
            laid_out(&Told("a-word-longer-than-the-line b", None), 10),
            "  × a-word-longer-than-the-line\n    b\n"
        );
    }
}
