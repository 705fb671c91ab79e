//! The tables of the paper beside ours.

use std::collections::BTreeSet;

use maud::{Markup, html};
use tce_base::counted;

use super::{estimate, one, range, signed, term, title_cell};
use crate::analysis::{Analysis, Cell, ShiftTable, Total};
use crate::study::{agent_title, shift_title};

fn cell(cell: Option<&Cell>, class: &str) -> Markup {
    let Some(c) = cell else { return html! { td class=(class) { "–" } } };
    let mut class = class.to_owned();
    if c.best {
        class += " best";
    }
    if c.above_baselines == Some(true) {
        class += " above";
    }
    let seeds = counted(c.seeds, "seed", "seeds");
    html! {
        td class=(class.trim()) title=(seeds) {
            (one(c.mean))
            @if let Some(std) = c.std { small { " ±" (one(std)) } }
            @if c.diverged > 0 { "†" }
        }
    }
}

pub(super) fn tables(analysis: &Analysis) -> Markup {
    html! {
        p {
            (term("score", "Normalised scores")) ", mean ± standard deviation over " (term("seed", "seeds")) ". "
            span class="above" {} "marks a mean above that of every " (term("baseline", "baseline")) " of the task, " b { "bold" }
            " the highest mean of ours. Shaded columns are the figures that the paper prints."
        }
        @for t in &analysis.tables { (shift_table(analysis, t)) }
    }
}

/// A column of a shift's table: a method of ours, or one of the paper's.
#[derive(Clone, Copy)]
enum Column {
    Ours(usize),
    Paper(usize),
}

fn shift_table(analysis: &Analysis, t: &ShiftTable) -> Markup {
    let papers = t.paper.map_or(&[][..], |p| &p.columns[..]);
    let (groups, used) = groups(analysis, t);
    let columns: Vec<(Column, String)> = groups
        .iter()
        .flat_map(|(_, columns)| columns.iter().enumerate())
        .map(|(k, c)| {
            let class = if let Column::Paper(_) = c { "from-paper" } else { "" };
            (*c, format!("{class}{}", if k == 0 { " edge" } else { "" }).trim().to_owned())
        })
        .collect();
    html! {
        h3 { (shift_title(t.shift)) }
        @if let Some(doubt) = &t.doubt { p class="doubt" { (doubt) } }
        div class="scroll" {
            table {
                thead {
                    tr class="groups" {
                        th class="first" {}
                        @for (title, columns) in groups.iter().filter(|(_, c)| !c.is_empty()) {
                            th class="edge" colspan=(columns.len()) { (title) }
                        }
                    }
                    tr {
                        th class="first" { "Task" }
                        @for (c, class) in &columns {
                            th class=(class) {
                                @match *c {
                                    Column::Ours(m) => (title_cell(analysis, m)),
                                    Column::Paper(c) if used.contains(&c) => { small { "paper, Table " (papers[c].table) } }
                                    Column::Paper(c) => { (papers[c].method) br; small { "Table " (papers[c].table) } }
                                }
                            }
                        }
                    }
                }
                tbody {
                    (rows(t, &columns))
                    (sums(t, &columns))
                }
            }
        }
        (against(analysis, t))
        @if let Some(paper) = t.paper {
            @for note in &paper.notes { p class="note" { (note) } }
        }
    }
}

/// The columns by group, and which of the paper's stand beside ours.
fn groups(analysis: &Analysis, t: &ShiftTable) -> ([(&'static str, Vec<Column>); 3], BTreeSet<usize>) {
    let methods = &analysis.methods;
    let papers = t.paper.map_or(&[][..], |p| &p.columns[..]);
    // The paper's figures for a method stand right beside ours, the rest of the paper behind them.
    let mut beside: Vec<Column> = Vec::new();
    let mut used: BTreeSet<usize> = BTreeSet::new();
    for m in (0..methods.len()).filter(|m| !methods[*m].baseline) {
        beside.push(Column::Ours(m));
        let name = t.against.iter().find(|a| a.method == m).map(|a| a.paper_method.as_str());
        let column = name.and_then(|name| t.paper?.column(name)).filter(|c| used.insert(*c));
        beside.extend(column.map(Column::Paper));
    }
    let groups = [
        ("Baselines", (0..methods.len()).filter(|m| methods[*m].baseline).map(Column::Ours).collect()),
        (if used.is_empty() { "Methods" } else { "Methods, ours and the paper's" }, beside),
        ("Others in the paper", (0..papers.len()).filter(|c| !used.contains(c)).map(Column::Paper).collect()),
    ];
    (groups, used)
}

/// A row for every task, under the robots' names.
fn rows(t: &ShiftTable, columns: &[(Column, String)]) -> Markup {
    html! {
        @for (r, row) in t.rows.iter().enumerate() {
            @let before = r.checked_sub(1).map(|k| t.rows[k].task);
            @if before.is_none_or(|b| b.agent != row.task.agent) {
                tr class="group" {
                    th { (agent_title(row.task.agent)) }
                    @for (_, class) in columns { td class=(class) {} }
                }
            }
            tr class=[before.is_some_and(|b| b.agent == row.task.agent && b.source != row.task.source).then_some("break")] {
                th scope="row" { span class="nb" { (row.task.source) " →" } " " span class="nb" { (row.task.target) } }
                @for (c, class) in columns {
                    @match *c {
                        Column::Ours(m) => (cell(row.cells[m].as_ref(), class)),
                        Column::Paper(c) => td class=(class) {
                            @match row.paper[c] { None => "–", Some(p) => { (one(p.mean)) small { " ±" (one(p.std)) } } }
                        }
                    }
                }
            }
        }
    }
}

/// What the columns come to over the tasks.
fn sums(t: &ShiftTable, columns: &[(Column, String)]) -> Markup {
    let of = |n: usize| html! { @if n < t.rows.len() { br; small { "of " (counted(n, "task", "tasks")) } } };
    let total = |c: Column| match c {
        Column::Ours(m) => html! {
            @match &t.totals[m] {
                None => "–",
                Some(Total { estimate, tasks }) => {
                    (one(estimate.point)) br; small { (range(estimate.interval, 1)) } (of(*tasks))
                }
            }
        },
        Column::Paper(c) => match t.paper_totals[c] {
            (_, 0) => html! { "–" },
            (sum, n) => html! { (one(sum)) (of(n)) },
        },
    };
    let iqm = |c: Column| match c {
        Column::Ours(m) => html! {
            @match &t.iqms[m] {
                None => "–",
                Some(Total { estimate, .. }) => { (one(estimate.point)) br; small { (range(estimate.interval, 1)) } }
            }
        },
        // The paper does not print single runs.
        Column::Paper(_) => html! { "–" },
    };
    html! {
        tr class="sum" {
            th scope="row" { "Total" }
            @for (c, class) in columns { td class=(class) { (total(*c)) } }
        }
        @if let Some(paper) = t.paper.filter(|p| p.rows.len() == t.rows.len()) {
            tr {
                th scope="row" { "as printed" }
                @for (c, class) in columns {
                    td class=(class) { @if let Column::Paper(c) = *c { (paper.columns[c].total.map_or("–".into(), one)) } }
                }
            }
        }
        tr {
            th scope="row" { (term("iqm", "Interquartile mean")) }
            @for (c, class) in columns { td class=(class) { (iqm(*c)) } }
        }
    }
}

/// Our sums beside the paper's.
fn against(analysis: &Analysis, t: &ShiftTable) -> Markup {
    html! {
        @if !t.against.is_empty() {
            p class="note" { "Sums over tasks, of a method and of the paper's column of its name, for the tasks that have both:" }
            div class="scroll" {
                table {
                    thead {
                        tr {
                            th class="first" { "Method" } th { "Tasks" } th { "Ours" }
                            th class="from-paper" { "Paper" } th { "Difference" }
                        }
                    }
                    tbody {
                        @for a in &t.against {
                            tr {
                                th scope="row" { (title_cell(analysis, a.method)) }
                                td { (a.ours.tasks) }
                                td { (estimate(&a.ours.estimate, 1)) }
                                td class="from-paper" { (one(a.paper)) " " small { (a.paper_method) } }
                                td { (signed(a.ours.estimate.point - a.paper)) }
                            }
                        }
                    }
                }
            }
        }
    }
}
