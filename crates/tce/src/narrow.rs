//! Text for terminals of 80 columns.

/// The columns of a terminal that nobody has widened.
pub const COLUMNS: usize = 80;

/// `text` in lines of at most [`COLUMNS`] characters, broken at spaces; lines after the first begin with `indent` spaces. A longer word has
/// a line of its own.
pub fn wrapped(text: &str, indent: usize) -> String {
    let mut out = String::new();
    let mut used = 0;
    for word in text.split(' ').filter(|w| !w.is_empty()) {
        let length = word.chars().count();
        if used > 0 && used + 1 + length > COLUMNS {
            out += &format!("\n{}", " ".repeat(indent));
            used = indent;
        } else if used > 0 {
            out.push(' ');
            used += 1;
        }
        out += word;
        used += length;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_broken_at_spaces() {
        let words = "word ".repeat(40);
        let text = wrapped(&words, 2);
        let lines: Vec<&str> = text.lines().collect();
        // 16 words and 15 spaces are 79 characters; after the indent there is room for 15 words.
        assert_eq!(lines.iter().map(|l| l.matches("word").count()).collect::<Vec<_>>(), [16, 15, 9]);
        assert!(lines[1].starts_with("  word") && lines.iter().all(|l| l.len() <= COLUMNS));
        assert_eq!(wrapped(&"x".repeat(100), 2), "x".repeat(100));
        assert_eq!(wrapped("", 2), "");
    }
}
