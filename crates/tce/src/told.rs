//! How an error is told on stderr: a cross, and its own words, once. They hold what caused it: the chain of causes would say it again, in
//! the system's words.

use std::error::Error;
use std::io::IsTerminal;

use terminal_size::terminal_size_of;

/// In front of all lines but the first.
const INDENT: &str = "    ";

/// The text for `error`: wrapped and red on a terminal, plain elsewhere, so that logs can be searched.
pub fn told(error: &dyn Error) -> String {
    let stderr = std::io::stderr();
    let width = terminal_size_of(&stderr).map_or(usize::MAX, |(width, _)| usize::from(width.0).max(40));
    let red = stderr.is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty());
    let text = laid_out(error, width);
    if red { text.replacen('×', "\x1b[31m×\x1b[0m", 1) } else { text }
}

fn laid_out(error: &dyn Error, width: usize) -> String {
    let text = error.to_string();
    let lines = text.lines().flat_map(|line| wrapped(line, width.saturating_sub(INDENT.len())));
    let told = lines.enumerate().map(|(k, line)| format!("{}{line}\n", if k == 0 { "  × " } else { INDENT }));
    told.collect()
}

/// `line` in pieces of at most `width` letters, broken at spaces. A line that is indented is a command or a path, to be
/// copied whole.
fn wrapped(line: &str, width: usize) -> Vec<String> {
    if line.starts_with("  ") {
        return vec![line.to_owned()];
    }
    let mut pieces = vec![String::new()];
    for word in line.split(' ') {
        let last = pieces.last_mut().expect("never empty");
        if !last.is_empty() && last.chars().count() + 1 + word.chars().count() > width {
            pieces.push(word.to_owned());
        } else {
            if !last.is_empty() {
                last.push(' ');
            }
            last.push_str(word);
        }
    }
    pieces
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
