//! What a command prints: a table for people, JSON for programs.

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{Cell, CellAlignment, ContentArrangement, Table};
use serde::Serialize;

/// Where and how results are printed. Progress and notes go to stderr, results to stdout.
#[derive(Clone, Copy, Debug)]
pub struct Output {
    /// One JSON document instead of tables.
    pub json: bool,
}

impl Output {
    /// Prints `value` as JSON, or what `render` makes of it.
    pub fn print<T: Serialize>(&self, value: &T, render: impl FnOnce(&T) -> String) {
        use std::io::Write;
        let text = if self.json {
            serde_json::to_string_pretty(value).expect("results are plain data")
        } else {
            render(value)
        };
        // A closed pipe (`tce ... | head`) is not an error of the command.
        let _ = writeln!(std::io::stdout(), "{}", text.trim_end());
    }
}

/// A table: the first column is text, the others are numbers and stand right-aligned.
pub fn table<R, C>(header: &[&str], rows: impl IntoIterator<Item = R>) -> String
where
    R: IntoIterator<Item = C>,
    C: Into<String>,
{
    let mut table = Table::new();
    table.load_preset(UTF8_FULL_CONDENSED).set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(header.iter().map(Cell::new));
    for row in rows {
        table.add_row(row.into_iter().enumerate().map(|(i, cell)| {
            let cell = Cell::new(cell.into());
            if i == 0 { cell } else { cell.set_alignment(CellAlignment::Right) }
        }));
    }
    table.to_string()
}

/// Mean and sample standard deviation.
pub fn mean_std(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n.max(1.0);
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    (mean, variance.sqrt())
}

/// `61.7 ± 4.2`, or without the spread for one value.
pub fn plus_minus(values: &[f64]) -> String {
    let (mean, std) = mean_std(values);
    if values.len() > 1 { format!("{mean:.1} ± {std:.1}") } else { format!("{mean:.1}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreads_are_those_of_a_sample() {
        assert_eq!(mean_std(&[1.0, 2.0, 3.0]), (2.0, 1.0));
        assert_eq!(plus_minus(&[1.0, 2.0, 3.0]), "2.0 ± 1.0");
        assert_eq!(plus_minus(&[61.7]), "61.7");
    }

    #[test]
    fn tables_hold_every_cell() {
        let text = table(&["set", "score"], [["hopper", "100.1"]]);
        assert!(text.contains("set") && text.contains("hopper") && text.contains("100.1"), "{text}");
    }
}
