//! The tables of the paper, as printed, from files beside this crate's sources.

use std::sync::LazyLock;

use serde::Serialize;
use tce_data::{Agent, Quality, Shift, Task};

/// A mean and the standard deviation over five seeds, as printed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Printed {
    /// The mean.
    pub mean: f64,
    /// The standard deviation.
    pub std: f64,
}

/// A method's column.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// The method's name in the paper.
    pub method: String,
    /// The table's number.
    pub table: String,
    /// The total as printed, over all tasks of the table.
    pub total: Option<f64>,
}

/// The paper's figures for one shift.
#[derive(Clone, Debug, PartialEq)]
pub struct PaperTable {
    /// The shift.
    pub shift: Shift,
    /// Methods.
    pub columns: Vec<Column>,
    /// Tasks, and a figure for every column that has one.
    pub rows: Vec<(Task, Vec<Option<Printed>>)>,
    /// What the file says about itself.
    pub notes: Vec<String>,
}

impl PaperTable {
    /// The row of a task.
    pub fn row(&self, task: &Task) -> Option<&[Option<Printed>]> {
        self.rows.iter().find(|(t, _)| t == task).map(|(_, cells)| &cells[..])
    }

    /// The column of the method that is called so in the paper.
    pub fn column(&self, method: &str) -> Option<usize> {
        self.columns.iter().position(|c| c.method == method)
    }
}

/// The tables for `shift`; the paper has none for an unchanged robot.
pub fn table(shift: Shift) -> Option<&'static PaperTable> {
    static TABLES: LazyLock<Vec<PaperTable>> = LazyLock::new(|| {
        [
            (Shift::Morph, include_str!("../paper/morph.tsv")),
            (Shift::Kinematic, include_str!("../paper/kinematic.tsv")),
            (Shift::Gravity, include_str!("../paper/gravity.tsv")),
            (Shift::Gravity5, include_str!("../paper/gravity-5.tsv")),
        ]
        .map(|(shift, text)| parse(shift, text).expect("the crate's own files are tested"))
        .to_vec()
    });
    TABLES.iter().find(|t| t.shift == shift)
}

/// The paper's name for a method of ours (`Method::base`).
pub fn counterpart(method: &str) -> Option<&'static str> {
    Some(match method {
        "tce-og" => "TCE(OG)",
        "tce-nn" => "TCE(NN)",
        "tce-ot" => "TCE(OT)",
        "simple-aug" => "Simple Aug.",
        "tce-no-filter" => "TCE(OG) w/o Filtering",
        "tce-no-reg" => "TCE(OG) w/o Policy Reg.",
        "target-only" => "Target Only",
        "target-source" | "iql" => "IQL*",
        "iql-swt" => "IQL*(SwT)",
        "dara" => "DARA",
        "bosa" => "BOSA",
        "srpo" => "SRPO",
        "igdf" => "IGDF",
        "otdf" => "OTDF",
        "dmc" => "DmC",
        "meta-dt" => "Meta-DT*",
        _ => return None,
    })
}

/// Table 3: averages over the 36 morphology tasks.
pub fn components() -> &'static [(String, Printed)] {
    static ROWS: LazyLock<Vec<(String, Printed)>> = LazyLock::new(|| {
        let lines = include_str!("../paper/components.tsv").lines().filter(|l| !l.starts_with('#'));
        let row = |line: &str| {
            let (method, cell) = line.split_once('\t')?;
            Some((method.to_owned(), printed(cell)??))
        };
        lines.map(|l| row(l).expect("the crate's own files are tested")).collect()
    });
    &ROWS
}

/// Table E.1, as printed: a header and rows.
pub fn runtime() -> Vec<Vec<&'static str>> {
    let lines = include_str!("../paper/runtime.tsv").lines().filter(|l| !l.starts_with('#'));
    lines.map(|l| l.split('\t').collect()).collect()
}

/// `44.1±0.2`, or `-`; None for anything else.
fn printed(cell: &str) -> Option<Option<Printed>> {
    match cell.split_once('±') {
        None => (cell == "-").then_some(None),
        Some((mean, std)) => Some(Some(Printed { mean: mean.parse().ok()?, std: std.parse().ok()? })),
    }
}

fn parse(shift: Shift, text: &str) -> Option<PaperTable> {
    let (notes, lines): (Vec<&str>, Vec<&str>) = text.lines().partition(|l| l.starts_with('#'));
    let cells: Vec<Vec<&str>> = lines.iter().map(|l| l.split('\t').collect()).collect();
    let [tables, totals, head, rows @ ..] = &cells[..] else { return None };
    let columns: Vec<Column> = head[3..]
        .iter()
        .zip(&tables[3..])
        .zip(&totals[3..])
        .map(|((method, table), total)| Column {
            method: (*method).to_owned(),
            table: (*table).to_owned(),
            total: total.parse().ok(),
        })
        .collect();
    let row = |cells: &Vec<&str>| {
        let task = Task {
            agent: Agent::ALL.into_iter().find(|a| a.name() == cells[0])?,
            shift,
            source: cells[1].parse::<Quality>().ok()?,
            target: cells[2].parse::<Quality>().ok()?,
        };
        let figures = cells[3..].iter().map(|c| printed(c)).collect::<Option<Vec<_>>>()?;
        (figures.len() == columns.len()).then_some((task, figures))
    };
    let rows = rows.iter().map(row).collect::<Option<Vec<_>>>()?;
    let notes = notes.iter().map(|n| n.trim_start_matches(['#', ' ']).to_owned()).collect();
    Some(PaperTable { shift, columns, rows, notes })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Copied figures are checked by the sums that the paper prints, where all rows are there. Two of the paper's own sums are
    /// off by .4 and .5, as the files say.
    #[test]
    fn the_rows_sum_to_the_printed_totals() {
        let mut complete = 0;
        for shift in [Shift::Morph, Shift::Kinematic, Shift::Gravity, Shift::Gravity5] {
            let table = table(shift).unwrap();
            assert_eq!(table.rows.len(), if shift == Shift::Gravity5 { 6 } else { 36 });
            for (k, column) in table.columns.iter().enumerate() {
                let figures: Option<Vec<f64>> = table.rows.iter().map(|(_, c)| c[k].map(|p| p.mean)).collect();
                if let (Some(figures), Some(total)) = (figures, column.total) {
                    let sum: f64 = figures.iter().sum();
                    assert!((sum - total).abs() < 0.55, "{shift} {}: {sum}, printed {total}", column.method);
                    complete += 1;
                }
            }
        }
        assert_eq!(complete, 7 + 6 + 8 + 3);
    }

    #[test]
    fn single_figures_are_found() {
        let task =
            Task { agent: Agent::Hopper, shift: Shift::Morph, source: Quality::MediumReplay, target: Quality::Medium };
        let morph = table(Shift::Morph).unwrap();
        let og = morph.row(&task).unwrap()[morph.column("TCE(OG)").unwrap()];
        assert_eq!(og, Some(Printed { mean: 49.5, std: 0.1 }));
        assert_eq!(components().iter().find(|c| c.0 == "Target Only").unwrap().1.mean, 41.4);
        assert_eq!(runtime()[1][0], "IQL*");
        assert!(table(Shift::Source).is_none());
        assert_eq!(counterpart("otdf"), Some("OTDF"));
        assert_eq!(counterpart("bc"), None);
    }
}
