//! How an error is told on stderr: a cross, a bar in front of further lines, and what lies behind it.

use std::error::Error;
use std::io::IsTerminal;

use terminal_size::terminal_size_of;

/// The text for `error`: wrapped and red on a terminal, plain elsewhere, so that logs can be searched.
pub fn told(error: &dyn Error) -> String {
    let stderr = std::io::stderr();
    let width = terminal_size_of(&stderr).map_or(usize::MAX, |(width, _)| usize::from(width.0).max(40));
    let red = stderr.is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty());
    let text = laid_out(error, width);
    if red { text.replacen('×', "\x1b[31m×\x1b[0m", 1) } else { text }
}

fn laid_out(error: &dyn Error, width: usize) -> String {
    let mut out = String::new();
    let mut add = |text: &str, first: &str, further: &str| {
        let lines = text.lines().flat_map(|line| wrapped(line, width.saturating_sub(further.chars().count())));
        for (k, line) in lines.enumerate() {
            out += if k == 0 { first } else { further };
            out += &line;
            out.push('\n');
        }
    };
    let mut cause = error.source();
    add(&error.to_string(), "  × ", if cause.is_some() { "  │ " } else { "    " });
    while let Some(this) = cause {
        cause = this.source();
        match cause {
            Some(_) => add(&this.to_string(), "  ├─▶ ", "  │   "),
            None => add(&this.to_string(), "  ╰─▶ ", "      "),
        }
    }
    out
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
    struct Link(&'static str, #[source] Option<Box<Link>>);

    #[test]
    fn causes_hang_on_the_error() {
        let error =
            Link("it failed\nDo this.", Some(Box::new(Link("between", Some(Box::new(Link("at the end", None)))))));
        assert_eq!(laid_out(&error, 80), "  × it failed\n  │ Do this.\n  ├─▶ between\n  ╰─▶ at the end\n");
        assert_eq!(laid_out(&Link("alone\nand more", None), 80), "  × alone\n    and more\n");
    }

    #[test]
    fn prose_is_wrapped_and_commands_stay_whole() {
        let error = Link("one two three four\n  pip install one two three", None);
        assert_eq!(laid_out(&error, 14), "  × one two\n    three four\n      pip install one two three\n");
        assert_eq!(
            laid_out(&Link("a-word-longer-than-the-line b", None), 10),
            "  × a-word-longer-than-the-line\n    b\n"
        );
    }
}
