//! Lines no longer than a terminal is wide.

use console::measure_text_width;

/// The columns of a terminal that nobody has widened.
const PROSE: usize = 80;

/// Sentences in lines of at most 80 columns; lines after the first begin with `indent` spaces.
pub fn prose(text: &str, indent: usize) -> String {
    break_line(text, indent, PROSE)
}

/// `text` with every line that is longer than `width` broken between words. A line of the form `  name   value` goes on below its value.
/// Tables have their width already, and words (paths, say) stay whole.
pub fn text(text: &str, width: usize) -> String {
    let lines = text.lines().map(|line| match line.trim_start().chars().next() {
        Some('│' | '┌' | '╞' | '└' | '├') => line.to_owned(),
        _ if measure_text_width(line) <= width => line.to_owned(),
        _ => break_line(line, hanging(line, width), width),
    });
    lines.collect::<Vec<_>>().join("\n")
}

/// How far the further lines of `line` stand in.
fn hanging(line: &str, width: usize) -> usize {
    let start = line.len() - line.trim_start().len();
    let gap = line[start..].find("  ").map(|at| start + at);
    let value = gap.map(|at| at + line[at..].len() - line[at..].trim_start().len());
    let value = value.map(|at| measure_text_width(&line[..at])).filter(|column| start > 0 && *column < width / 2);
    value.unwrap_or(start + 2)
}

/// Words between which a line may be broken, put into lines of at most `width` columns.
pub fn break_line(line: &str, indent: usize, width: usize) -> String {
    let start = line.len() - line.trim_start().len();
    let mut out = line[..start].to_owned();
    let mut column = start;
    let mut fresh = true;
    let mut rest = &line[start..];
    while !rest.is_empty() {
        let word = rest.find(' ').unwrap_or(rest.len());
        let spaces = rest[word..].len() - rest[word..].trim_start_matches(' ').len();
        let (text, blank) = (&rest[..word], &rest[word..word + spaces]);
        rest = &rest[word + spaces..];
        let columns = measure_text_width(text);
        if !fresh && column + columns > width {
            out.truncate(out.trim_end_matches(' ').len());
            out += "\n";
            out += &" ".repeat(indent);
            column = indent;
        }
        out += text;
        out += blank;
        column += columns + spaces;
        fresh = false;
    }
    out.truncate(out.trim_end_matches(' ').len());
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lines_go_on_below_their_values() {
        let line = "  used for    5000 rows: learning; 4990: networks and models of s'";
        assert_eq!(text(line, 40), "  used for    5000 rows: learning; 4990:\n              networks and models of s'");
        assert_eq!(
            text("The clone stands unless another is ahead.", 24),
            "The clone stands unless\n  another is ahead."
        );
    }

    #[test]
    fn prose_is_broken_at_spaces() {
        let words = "word ".repeat(40);
        let text = prose(&words, 2);
        let lines: Vec<&str> = text.lines().collect();
        // 16 words and 15 spaces are 79 characters; after the indent there is room for 15 words.
        assert_eq!(lines.iter().map(|l| l.matches("word").count()).collect::<Vec<_>>(), [16, 15, 9]);
        assert!(lines[1].starts_with("  word") && lines.iter().all(|l| l.len() <= PROSE));
        assert_eq!(prose(&"x".repeat(100), 2), "x".repeat(100));
        assert_eq!(prose("", 2), "");
    }

    #[test]
    fn short_lines_tables_and_words_stay_whole() {
        let table = "│ a very long row of a table │";
        assert_eq!(text(table, 10), table);
        assert_eq!(text("  a  b\n\nruns/a/very/long/path", 10), "  a  b\n\nruns/a/very/long/path");
    }
}
