//! How an error is told on stderr: a cross, and its own words, once. They hold what caused it: the chain of causes would say it again, in
//! the system's words.

use std::error::Error;

use console::{Term, style};

use crate::output::break_line;

/// In front of all lines but the first.
const INDENT: &str = "    ";

/// The text for `error`: wrapped and red on a terminal, plain elsewhere, so that logs can be searched.
pub fn told(error: &dyn Error) -> String {
    let width = Term::stderr().size_checked().map_or(usize::MAX, |(_, columns)| usize::from(columns).max(40));
    laid_out(error, width).replacen('×', &style('×').for_stderr().red().to_string(), 1)
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
    fn prose_is_wrapped_and_commands_stay_whole() {
        let error = Told("one two three four\n  pip install one two three", None);
        assert_eq!(laid_out(&error, 14), "  × one two\n    three four\n      pip install one two three\n");
        assert_eq!(
            laid_out(&Told("a-word-longer-than-the-line b", None), 10),
            "  × a-word-longer-than-the-line\n    b\n"
        );
    }
}
