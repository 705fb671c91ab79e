//! Tables that fit where they are shown.
//!
//! A table that is too wide is tried in four other forms, in this order: with its texts broken between words, without blanks around its
//! cells, on its side (a column for each row), and as a list with a line for each cell. Words, numbers and paths are never broken: they are read, compared and copied.

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{Attribute, Cell, CellAlignment, Color, ColumnConstraint, ContentArrangement, Table, Width};
use console::measure_text_width;

use tce_base::wrap::break_line;

/// Stands before a cell that is the best of its kind; a character that no text has.
const BEST: char = '\u{e000}';
/// Blanks on both sides of a cell.
const BLANKS: usize = 1;

/// A cell that [`table`] shows as the best of its kind, where there are colours.
fn best(text: &str) -> String {
    format!("{BEST}{text}")
}

/// Marks the cells with the greatest number at their beginning, where there are several to choose from.
pub fn mark_best<'a>(cells: impl Iterator<Item = &'a mut String>) {
    let number = |cell: &str| cell.split_whitespace().next()?.parse::<f64>().ok();
    let mut cells: Vec<_> = cells.filter_map(|cell| Some((number(cell)?, cell))).collect();
    let greatest = cells.iter().map(|(n, _)| *n).fold(f64::NEG_INFINITY, f64::max);
    if cells.len() > 1 {
        cells.iter_mut().filter(|(n, _)| *n == greatest).for_each(|(_, cell)| **cell = best(cell));
    }
}

/// A line above a table.
pub fn heading(text: &str) -> String {
    console::style(text).bold().to_string()
}

/// A table as wide as the terminal allows. The first column is text; others stand right-aligned where there are numbers in them.
pub fn table<R, C>(header: &[&str], rows: impl IntoIterator<Item = R>) -> String
where
    R: IntoIterator<Item = C>,
    C: Into<String>,
{
    let rows: Vec<Vec<String>> = rows.into_iter().map(|row| row.into_iter().map(Into::into).collect()).collect();
    let header: Vec<String> = header.iter().map(|h| (*h).to_owned()).collect();
    fitted(&header, &rows, super::width(), console::colors_enabled())
}

/// The rows one below the other, with a line for each cell: for long texts. The first cell is the title.
pub fn list<R, C>(header: &[&str], rows: impl IntoIterator<Item = R>) -> String
where
    R: IntoIterator<Item = C>,
    C: Into<String>,
{
    let rows: Vec<Vec<String>> = rows.into_iter().map(|row| row.into_iter().map(Into::into).collect()).collect();
    let header: Vec<String> = header.iter().map(|h| (*h).to_owned()).collect();
    listed(&header, &rows, super::width(), console::colors_enabled())
}

fn fitted(header: &[String], rows: &[Vec<String>], width: Option<usize>, coloured: bool) -> String {
    let natural = columns(header, rows, measure);
    let Some(width) = width else { return drawn(header, rows, &natural, BLANKS, coloured) };
    if total(&natural, BLANKS) <= width {
        return drawn(header, rows, &natural, BLANKS, coloured);
    }
    let mut broken = columns(header, rows, longest_word);
    if let Some(blanks) = [BLANKS, 0].into_iter().find(|blanks| total(&broken, *blanks) <= width) {
        // What is left goes to the columns that lack most.
        for _ in total(&broken, blanks)..width {
            let Some(i) = (0..broken.len()).max_by_key(|i| natural[*i].saturating_sub(broken[*i])) else { break };
            broken[i] += usize::from(broken[i] < natural[i]);
        }
        return drawn(header, rows, &broken, blanks, coloured);
    }
    let side = |i: usize| std::iter::once(header[i].clone()).chain(rows.iter().map(move |row| row[i].clone()));
    let (first, others) =
        (side(0).collect::<Vec<_>>(), (1..header.len()).map(|i| side(i).collect()).collect::<Vec<_>>());
    let natural = columns(&first, &others, measure);
    if total(&natural, BLANKS) <= width {
        return drawn(&first, &others, &natural, BLANKS, coloured);
    }
    listed(header, rows, Some(width), coloured)
}

/// The width of a table with a border before every column and one behind the last.
fn total(columns: &[usize], blanks: usize) -> usize {
    columns.iter().map(|width| width + 2 * blanks + 1).sum::<usize>() + 1
}

fn measure(text: &str) -> usize {
    text.lines().map(|line| measure_text_width(line.trim_start_matches(BEST))).max().unwrap_or(0)
}

/// The least width for a text. What a number belongs to stays with it: only texts of several words without digits are broken.
fn longest_word(text: &str) -> usize {
    match text.chars().next() {
        Some(c) if c.is_ascii_digit() || c == '-' || c == BEST => measure(text),
        _ => text.split_whitespace().map(measure).max().unwrap_or(0),
    }
}

/// The width of every column, by a measure of its texts.
fn columns(header: &[String], rows: &[Vec<String>], measure: impl Fn(&str) -> usize) -> Vec<usize> {
    let column = |i: usize| std::iter::once(&header[i]).chain(rows.iter().filter_map(move |row| row.get(i)));
    (0..header.len()).map(|i| column(i).map(|cell| measure(cell)).max().unwrap_or(0)).collect()
}

fn drawn(header: &[String], rows: &[Vec<String>], columns: &[usize], blanks: usize, coloured: bool) -> String {
    let mut table = Table::new();
    table.load_preset(UTF8_FULL_CONDENSED).set_content_arrangement(ContentArrangement::Dynamic);
    // Without a width of its own the table would ask the terminal.
    table.set_width(total(columns, blanks) as u16);
    if coloured {
        table.enforce_styling();
    } else {
        table.force_no_tty();
    }
    let number = |cell: &str| {
        let mut start = cell.trim_start_matches(BEST).chars();
        match start.next() {
            Some('-' | '+') => start.next().is_none_or(|c| c.is_ascii_digit()),
            first => first.is_some_and(|c| c.is_ascii_digit()),
        }
    };
    let right: Vec<bool> = (0..header.len())
        .map(|i| i > 0 && rows.iter().any(|row| row.get(i).is_some_and(|c| number(c) && c != "-")))
        .collect();
    table.set_header(header.iter().map(|h| Cell::new(h.trim_start_matches(BEST)).add_attribute(Attribute::Bold)));
    for row in rows {
        table.add_row(row.iter().enumerate().map(|(i, text)| {
            let mut cell = Cell::new(text.trim_start_matches(BEST));
            if text.starts_with(BEST) {
                cell = cell.fg(Color::Green).add_attribute(Attribute::Bold);
            }
            if right[i] { cell.set_alignment(CellAlignment::Right) } else { cell }
        }));
    }
    for (column, width) in table.column_iter_mut().zip(columns) {
        column.set_padding((blanks as u16, blanks as u16));
        column.set_constraint(ColumnConstraint::Absolute(Width::Fixed((width + 2 * blanks) as u16)));
    }
    table.to_string()
}

fn listed(header: &[String], rows: &[Vec<String>], width: Option<usize>, coloured: bool) -> String {
    let names = header.iter().skip(1).map(|h| measure(h)).max().unwrap_or(0);
    let mut text = String::new();
    for row in rows {
        let title = row.first().map_or("", |t| t.trim_start_matches(BEST));
        text += &console::style(title).bold().force_styling(coloured).to_string();
        text += "\n";
        for (name, cell) in header.iter().zip(row).skip(1).filter(|(_, cell)| !cell.is_empty()) {
            let pad = " ".repeat(names - measure(name));
            let cell = match cell.strip_prefix(BEST) {
                Some(best) => console::style(best).green().bold().force_styling(coloured).to_string(),
                None => cell.clone(),
            };
            let line = format!("  {name}{pad}  {cell}");
            text += &width.map_or(line.clone(), |width| break_line(&line, names + 4, width));
            text += "\n";
        }
    }
    text.trim_end().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(cells: &[&str]) -> Vec<String> {
        cells.iter().map(|c| (*c).to_owned()).collect()
    }

    fn shown(width: Option<usize>) -> String {
        let header = texts(&["method", "score", "other rows"]);
        let rows =
            [texts(&["BC, raw observations (baseline)", "85.4", "0"]), texts(&["TCE(OG)", "95.9 ± 1.2", "16321"])];
        fitted(&header, &rows, width, false)
    }

    #[test]
    fn a_table_that_fits_is_as_wide_as_its_texts() {
        let expected = "\
┌─────────────────────────────────┬────────────┬────────────┐
│ method                          ┆ score      ┆ other rows │
╞═════════════════════════════════╪════════════╪════════════╡
│ BC, raw observations (baseline) ┆       85.4 ┆          0 │
│ TCE(OG)                         ┆ 95.9 ± 1.2 ┆      16321 │
└─────────────────────────────────┴────────────┴────────────┘";
        assert_eq!(shown(None), expected);
        assert_eq!(shown(Some(61)), expected);
    }

    #[test]
    fn texts_are_broken_between_words_and_numbers_are_not() {
        let expected = "\
┌────────────────────┬────────────┬───────┐
│ method             ┆ score      ┆ other │
│                    ┆            ┆ rows  │
╞════════════════════╪════════════╪═══════╡
│ BC, raw            ┆       85.4 ┆     0 │
│ observations       ┆            ┆       │
│ (baseline)         ┆            ┆       │
│ TCE(OG)            ┆ 95.9 ± 1.2 ┆ 16321 │
└────────────────────┴────────────┴───────┘";
        assert_eq!(shown(Some(43)), expected);
    }

    #[test]
    fn a_table_that_almost_fits_goes_without_blanks() {
        let header = texts(&["actor", "return", "length"]);
        let rows = [texts(&["ant-source-expert", "3132 ± 599", "962"])];
        let expected = "\
┌─────────────────┬──────────┬──────┐
│actor            ┆return    ┆length│
╞═════════════════╪══════════╪══════╡
│ant-source-expert┆3132 ± 599┆   962│
└─────────────────┴──────────┴──────┘";
        assert_eq!(fitted(&header, &rows, Some(40), false), expected);
    }

    #[test]
    fn a_table_of_many_columns_is_shown_on_its_side() {
        let header = texts(&["file", "rows", "episodes", "length", "score"]);
        let rows = [texts(&["hopper_morph_expert.hdf5", "5000", "9", "556", "95.0"])];
        let expected = "\
┌──────────┬──────────────────────────┐
│ file     ┆ hopper_morph_expert.hdf5 │
╞══════════╪══════════════════════════╡
│ rows     ┆                     5000 │
│ episodes ┆                        9 │
│ length   ┆                      556 │
│ score    ┆                     95.0 │
└──────────┴──────────────────────────┘";
        assert_eq!(fitted(&header, &rows, Some(40), false), expected);
    }

    #[test]
    fn what_fits_in_no_other_way_is_a_list() {
        let header = texts(&["learner", "what it is", "reference"]);
        let rows = [
            texts(&["bc", "clones the behaviour of the rows", "Pomerleau 1989"]),
            texts(&["iql", "an expectile instead of a maximum", ""]),
        ];
        let expected = "\
bc
  what it is  clones the
              behaviour of
              the rows
  reference   Pomerleau
              1989
iql
  what it is  an expectile
              instead of a
              maximum";
        assert_eq!(fitted(&header, &rows, Some(26), false), expected);
    }

    #[test]
    fn the_best_is_green_where_there_are_colours() {
        let rows = [vec!["a".to_owned(), best("1.0")]];
        let header = texts(&["method", "score"]);
        assert!(!fitted(&header, &rows, None, false).contains('\u{1b}'));
        let coloured = fitted(&header, &rows, None, true);
        assert!(coloured.contains("\u{1b}[38;5;10m") || coloured.contains("\u{1b}[32m"), "{coloured:?}");
        assert!(!coloured.contains(BEST));
        assert!(listed(&header, &rows, Some(80), true).contains("\u{1b}[32m"));
    }
}
