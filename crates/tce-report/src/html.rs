//! The report as one HTML file: no script, no network, and every text from a file escaped by [`maud`].

use std::collections::{BTreeMap, BTreeSet};

use maud::{DOCTYPE, Markup, PreEscaped, html};
use tce_data::{Agent, Shift, Task};

use crate::analysis::{Aggregate, Analysis, Cell, Comparison, Finding, ShiftTable, Total, score};
use crate::folder::Verdict;
use crate::paper;
use crate::stats::Estimate;
use crate::study::{Cost, Run, Study, agent_title, order, shift_title, short};
use crate::svg::{self, Axis, Frame, Interval, Line, Point, Series, minus};

/// Points of a curve; more would be finer than the pixels.
const CURVE_POINTS: usize = 60;

/// The page's text.
pub fn page(study: &Study, analysis: &Analysis) -> String {
    let title = format!("{} · tce report", study.name);
    let mut sections = vec![
        ("findings", "Findings", findings(study, analysis)),
        ("scores", "Scores by task", tables(analysis)),
        ("statistics", "Statistics over tasks", statistics(analysis)),
        ("curves", "Learning curves", curves(study, analysis)),
        ("cost", "Time and memory", cost(study)),
        ("runs", "Runs and provenance", runs(study)),
        ("methods", "How the figures are made", methods(analysis)),
    ];
    if !study.diagnoses.is_empty() {
        sections.insert(3, ("diagnoses", "Generated rows and λ", crate::diagnosis::section(study, analysis)));
    }
    if let Some(section) = crate::sensitivity::section(study, analysis) {
        sections.insert(2, ("sensitivity", "Sensitivity", section));
    }
    let body = html! {
        (head(study, analysis))
        (warnings(analysis))
        nav aria-label="Sections" {
            @for (id, title, _) in &sections { a href=(format!("#{id}")) { (title) } }
        }
        @for (id, title, body) in &sections {
            section id=(id) { h2 { (title) } (body) }
        }
        footer class="note" {
            "Made by " (concat!("tce ", env!("CARGO_PKG_VERSION"))) " from " code { (study.directory) } "."
        }
    };
    document(&title, body)
}

/// A whole page around `body`.
pub(crate) fn document(title: &str, body: Markup) -> String {
    let markup = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                // The page promises to need no network: the browser holds it to that.
                meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'";
                title { (title) }
                style { (PreEscaped(include_str!("page.css"))) }
            }
            body { main { (body) } }
        }
    };
    markup.into_string()
}

fn one(value: f64) -> String {
    minus(format!("{value:.1}"))
}

fn range(interval: Option<(f64, f64)>, decimals: usize) -> String {
    interval.map_or_else(String::new, |(low, high)| {
        minus(format!("[{low:.decimals$}")) + &minus(format!(", {high:.decimals$}]"))
    })
}

fn estimate(e: &Estimate, decimals: usize) -> Markup {
    html! { (minus(format!("{:.decimals$}", e.point))) " " small { (range(e.interval, decimals)) } }
}

fn said(e: &Estimate, decimals: usize) -> String {
    format!("{} {}", minus(format!("{:.decimals$}", e.point)), range(e.interval, decimals)).trim_end().to_owned()
}

pub(crate) fn counted(n: usize, one: &str, many: &str) -> String {
    if n == 1 { format!("1 {one}") } else { format!("{n} {many}") }
}

/// Colour and dashes of every method: floors are grey.
fn classes(analysis: &Analysis) -> Vec<Series> {
    let (mut floors, mut others) = (0, 0);
    let class = |m: &crate::study::Method| {
        let (count, letter, hues) = if m.floor { (&mut floors, 'f', 4) } else { (&mut others, 'm', 8) };
        let k = *count;
        *count += 1;
        let again = if k >= hues { " again" } else { "" };
        Series { title: m.title.clone(), class: format!("{letter}{}{again}", k % hues) }
    };
    analysis.methods.iter().map(class).collect()
}

fn title_cell(analysis: &Analysis, m: usize) -> Markup {
    html! {
        (analysis.methods[m].title)
        @if analysis.needs_mark(m) { " " span class="badge" { "published mode" } }
    }
}

/// The result in one sentence.
pub(crate) fn headline(analysis: &Analysis) -> String {
    let Some(comparison) = &analysis.comparison else {
        return "No run has a score.".into();
    };
    let title = |m: usize| analysis.methods[m].title.as_str();
    let Some(floor) = comparison.best_floor() else {
        return "There is no floor to compare with: without one a score says little.".into();
    };
    let judged: Vec<(usize, Finding)> =
        comparison.methods.iter().filter_map(|a| Some((a.method, comparison.improvement(a)?.1))).collect();
    let better: Vec<&str> = judged.iter().filter(|j| j.1 == Finding::Better).map(|j| title(j.0)).collect();
    let floor = title(floor);
    match (judged.len(), better.len()) {
        (0, _) if analysis.methods.iter().all(|m| m.floor) => {
            format!("Only floors were run; the best of them is {floor}.")
        }
        (0, _) => "No method can be compared with the floors: they share no task with scores.".into(),
        (1, 1) => format!("{} beats the best floor, {floor}.", better[0]),
        (1, _) => format!("{} is not shown to beat the best floor, {floor}.", title(judged[0].0)),
        (n, 0) => format!("None of the {n} methods is shown to beat the best floor, {floor}."),
        (n, k) if n == k => format!("All {n} methods beat the best floor, {floor}."),
        (n, k) => {
            let verb = if k == 1 { "beats" } else { "beat" };
            format!("{k} of {n} methods {verb} the best floor, {floor}: {}.", better.join(", "))
        }
    }
}

fn head(study: &Study, analysis: &Analysis) -> Markup {
    let tasks: BTreeSet<String> =
        analysis.tables.iter().flat_map(|t| t.rows.iter().map(|r| r.task.to_string())).collect();
    let seeds: BTreeSet<u64> = study.runs.iter().map(|r| r.member.seed).collect();
    let floors = analysis.methods.iter().filter(|m| m.floor).count();
    let all = study.runs.len() + study.missing.len();
    let hours = study.runs.iter().map(|r| r.folder.seconds / r.folder.members.len() as f64).sum::<f64>();
    let shifts: Vec<String> = analysis.tables.iter().map(|t| shift_title(t.shift).to_lowercase()).collect();
    html! {
        header {
            p class="eyebrow" { (if study.sweep { "Sweep" } else { "Runs" }) " · " (shifts.join(" · ")) }
            h1 { (study.name) }
            p class="lede" { (headline(analysis)) }
            ul class="facts" {
                li { b { (tasks.len()) } (if tasks.len() == 1 { "task" } else { "tasks" }) }
                li { b { (analysis.methods.len() - floors) " + " (floors) } "methods + floors" }
                li { b { (seeds.len()) } (if seeds.len() == 1 { "seed" } else { "seeds" }) }
                li { b { (study.runs.len()) " / " (all) } "runs with a result" }
                li { b { (duration(hours)) } "run time in all" }
            }
        }
    }
}

fn warnings(analysis: &Analysis) -> Markup {
    html! {
        @if !analysis.warnings.is_empty() {
            aside class="warn" {
                h2 { "Before you read on" }
                ul {
                    @for w in &analysis.warnings {
                        li {
                            (w.text)
                            @if !w.details.is_empty() {
                                details {
                                    summary { (counted(w.details.len(), "case", "cases")) }
                                    ul { @for d in &w.details { li { (d) } } }
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Three digits, or that it is below them.
fn p_value(a: &Aggregate) -> (bool, String) {
    match a.p_value {
        None => (false, "–".into()),
        Some(p) if p < 0.001 => (true, "0.001".into()),
        Some(p) => (false, format!("{p:.3}")),
    }
}

fn findings(study: &Study, analysis: &Analysis) -> Markup {
    let Some(c) = &analysis.comparison else {
        return html! { p { "There is nothing to compare: no run has a score." } };
    };
    let title = |m: usize| analysis.methods[m].title.as_str();
    let percent = (100.0 * analysis.level).round();
    let floor = c.best_floor().and_then(|m| c.methods.iter().find(|a| a.method == m));
    let others: Vec<usize> = (0..c.floors.len()).filter(|k| Some(*k) != c.best_floor).collect();
    let sentence = |a: &Aggregate| -> Option<String> {
        let (p, finding) = c.improvement(a)?;
        let closing = match finding {
            Finding::Better => "it beats that floor.",
            Finding::Worse => "it falls short of that floor.",
            Finding::Few => "with so few runs chance alone often does that.",
            Finding::Open => "the interval holds one half, so that no difference is shown.",
            Finding::Unknown => "with one seed there is no interval.",
        };
        let [iqm, ..] = a.over_seeds;
        let (below, digits) = p_value(a);
        Some(format!(
            "{}: interquartile mean {}. One of its runs outscores one of the best floor's with probability {} \
             (permutation test: p {} {digits}); {closing}",
            title(a.method),
            said(&iqm, 1),
            said(&p, 2),
            if below { "<" } else { "=" },
        ))
    };
    html! {
        p {
            "Compared on " (counted(c.tasks.len(), "task", "tasks")) ", on which " (counted(c.methods.len(), "method", "methods"))
            " have scores. "
            @if let Some(f) = floor {
                "The best floor is " (title(f.method)) ", interquartile mean " (said(&f.over_seeds[0], 1)) ". "
            }
            "Brackets hold " (percent) " % intervals."
        }
        ul class="said" { @for text in c.methods.iter().filter_map(sentence) { li { (text) } } }
        div class="scroll" {
            table {
                thead {
                    tr class="groups" {
                        th class="first" {}
                        th colspan="2" {}
                        @if let Some(f) = floor {
                            th class="edge" colspan="3" { "Against the best floor, " (title(f.method)) }
                        }
                        th class="edge" colspan="3" { "Over " (counted(c.tasks.len(), "task", "tasks")) }
                        @if !others.is_empty() {
                            th class="edge" colspan=(others.len()) { "Probability of outscoring the other floors" }
                        }
                    }
                    tr {
                        th class="first" { "Method" }
                        th { "Runs" } th { "Interquartile mean" }
                        @if floor.is_some() { th class="edge" { "Outscores it" } th { "p" } th class="text" { "Finding" } }
                        th class="edge" { "Mean" } th { "Median" } th { "Total" }
                        @for (n, k) in others.iter().enumerate() {
                            th class=[(n == 0).then_some("edge")] { (title(c.floors[*k])) }
                        }
                    }
                }
                tbody {
                    @for a in &c.methods {
                        tr {
                            th scope="row" { (title_cell(analysis, a.method)) }
                            td { (a.runs) }
                            td { (estimate(&a.over_seeds[0], 1)) }
                            @match (floor, c.improvement(a)) {
                                (None, _) => {}
                                (_, Some((e, finding))) => {
                                    td class="edge" { (estimate(&e, 2)) }
                                    @let (below, digits) = p_value(a);
                                    td { @if below { "<" } (digits) }
                                    td class=(format!("text {}", match finding {
                                        Finding::Better => "better", Finding::Worse => "worse", _ => "",
                                    })) { (finding.word()) }
                                }
                                (Some(f), None) => {
                                    td class="edge" { "–" }
                                    td {}
                                    td class="text" { @if f.method == a.method { "the best floor" } @else { "floor" } }
                                }
                            }
                            td class="edge" { (estimate(&a.over_seeds[2], 1)) }
                            td { (estimate(&a.over_seeds[1], 1)) }
                            td { (estimate(&a.total, 1)) }
                            @for (n, k) in others.iter().enumerate() {
                                td class=[(n == 0).then_some("edge")] {
                                    @match &a.over_floors { Some(over) => (estimate(&over[*k], 2)), None => "–" }
                                }
                            }
                        }
                    }
                }
            }
        }
        (components(study, analysis, c))
    }
}

/// Table 3 of the paper beside ours, where all 36 morphology tasks are there.
fn components(study: &Study, analysis: &Analysis, c: &Comparison) -> Markup {
    let whole = c.tasks.len() == 36 && c.tasks.iter().all(|t| t.shift == Shift::Morph);
    let pairs: Vec<_> = c
        .methods
        .iter()
        .filter(|a| whole && study.methods[a.method].plain)
        .filter_map(|a| {
            let name = paper::counterpart(&study.methods[a.method].variant)?;
            Some((a, paper::components().iter().find(|p| p.0 == name)?))
        })
        .collect();
    html! {
        @if !pairs.is_empty() {
            h3 { "Averages over the 36 morphology tasks, beside the paper's Table 3" }
            div class="scroll" {
                table {
                    thead { tr { th class="first" { "Method" } th { "Ours" } th class="from-paper" { "Paper" } } }
                    tbody {
                        @for (a, (_, printed)) in &pairs {
                            tr {
                                th scope="row" { (title_cell(analysis, a.method)) }
                                td { (estimate(&a.over_seeds[2], 1)) }
                                td class="from-paper" { (one(printed.mean)) " " small { "±" (one(printed.std)) } }
                            }
                        }
                    }
                }
            }
        }
    }
}

fn cell(cell: Option<&Cell>, class: &str) -> Markup {
    let Some(c) = cell else { return html! { td class=(class) { "–" } } };
    let mut class = class.to_owned();
    if c.best {
        class += " best";
    }
    if c.above_floors == Some(true) {
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

fn tables(analysis: &Analysis) -> Markup {
    html! {
        p {
            "Normalised scores: 0 is a random policy, 100 the expert of the target domain. Mean ± standard deviation over seeds. "
            span class="above" {} "above every floor of the task; " b { "bold" } ": highest mean of ours. "
            "Shaded columns are the paper's own figures, over five seeds of other code."
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
    let methods = &analysis.methods;
    let papers = t.paper.map_or(&[][..], |p| &p.columns[..]);
    // The paper's figures for a method stand right beside ours, the rest of the paper behind them.
    let mut beside: Vec<Column> = Vec::new();
    let mut used: BTreeSet<usize> = BTreeSet::new();
    for m in (0..methods.len()).filter(|m| !methods[*m].floor) {
        beside.push(Column::Ours(m));
        let name = t.against.iter().find(|a| a.method == m).map(|a| a.paper_method.as_str());
        let column = name.and_then(|name| t.paper?.column(name)).filter(|c| used.insert(*c));
        beside.extend(column.map(Column::Paper));
    }
    let groups: [(&str, Vec<Column>); 3] = [
        ("Floors", (0..methods.len()).filter(|m| methods[*m].floor).map(Column::Ours).collect()),
        (if used.is_empty() { "Methods" } else { "Methods, ours and the paper's" }, beside),
        ("Others in the paper", (0..papers.len()).filter(|c| !used.contains(c)).map(Column::Paper).collect()),
    ];
    let columns: Vec<(Column, String)> = groups
        .iter()
        .flat_map(|(_, columns)| columns.iter().enumerate())
        .map(|(k, c)| {
            let class = if let Column::Paper(_) = c { "from-paper" } else { "" };
            (*c, format!("{class}{}", if k == 0 { " edge" } else { "" }).trim().to_owned())
        })
        .collect();
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
    html! {
        h3 { (shift_title(t.shift)) }
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
                    @for (r, row) in t.rows.iter().enumerate() {
                        @let before = r.checked_sub(1).map(|k| t.rows[k].task);
                        @if before.is_none_or(|b| b.agent != row.task.agent) {
                            tr class="group" {
                                th { (agent_title(row.task.agent)) }
                                @for (_, class) in &columns { td class=(class) {} }
                            }
                        }
                        tr class=[before.is_some_and(|b| b.agent == row.task.agent && b.source != row.task.source).then_some("break")] {
                            th scope="row" { span class="nb" { (row.task.source) " →" } " " span class="nb" { (row.task.target) } }
                            @for (c, class) in &columns {
                                @match *c {
                                    Column::Ours(m) => (cell(row.cells[m].as_ref(), class)),
                                    Column::Paper(c) => td class=(class) {
                                        @match row.paper[c] { None => "–", Some(p) => { (one(p.mean)) small { " ±" (one(p.std)) } } }
                                    }
                                }
                            }
                        }
                    }
                    tr class="sum" {
                        th scope="row" { "Total" }
                        @for (c, class) in &columns { td class=(class) { (total(*c)) } }
                    }
                    @if t.paper.is_some_and(|p| p.rows.len() == t.rows.len()) {
                        tr {
                            th scope="row" { "as printed" }
                            @for (c, class) in &columns {
                                td class=(class) {
                                    @if let Column::Paper(c) = *c { (papers[c].total.map_or("–".into(), one)) }
                                }
                            }
                        }
                    }
                }
            }
        }
        @if !t.against.is_empty() {
            p class="note" { "Totals of a method and of the paper's column of its name, over the tasks that have both:" }
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
        @if let Some(paper) = t.paper {
            @for note in &paper.notes { p class="note" { (note) } }
        }
    }
}

fn signed(value: f64) -> String {
    if value > 0.0 { format!("+{value:.1}") } else { one(value) }
}

fn statistics(analysis: &Analysis) -> Markup {
    let Some(c) = &analysis.comparison else { return html! { p { "No run has a score." } } };
    let series = classes(analysis);
    let row = |a: &Aggregate, k: usize| Interval {
        series: series[a.method].clone(),
        inner: a.over_seeds[k],
        outer: a.over_tasks[k].interval,
    };
    let panel = |k: usize, title: &str, hint: &str| {
        let rows: Vec<Interval> = c.methods.iter().map(|a| row(a, k)).collect();
        let ends = rows.iter().flat_map(|r| {
            let (low, high) = r.inner.interval.unwrap_or((r.inner.point, r.inner.point));
            let (outer_low, outer_high) = r.outer.unwrap_or((low, high));
            [r.inner.point, low, high, outer_low, outer_high]
        });
        let axis = Axis::around(ends, 4);
        html! {
            figure {
                figcaption { (title) " " span { (hint) } }
                (svg::intervals(title, &rows, &axis, "normalised score", None, 1))
            }
        }
    };
    let better: Vec<Interval> = c
        .methods
        .iter()
        .filter_map(|a| {
            let (inner, _) = c.improvement(a)?;
            Some(Interval { series: series[a.method].clone(), inner, outer: None })
        })
        .collect();
    let profile: Vec<Line> = c
        .methods
        .iter()
        .map(|a| Line {
            series: series[a.method].clone(),
            points: c
                .thresholds
                .iter()
                .zip(&a.profile)
                .map(|(t, e)| {
                    let band = e.interval.map(|(l, h)| (100.0 * l, 100.0 * h));
                    Point { x: *t, y: 100.0 * e.point, band }
                })
                .collect(),
        })
        .collect();
    let ends = [c.thresholds[0], c.thresholds[c.thresholds.len() - 1]];
    html! {
        p {
            "Dots are the figures of the runs as they are. Thick lines: " (percent(analysis)) " intervals when seeds are drawn anew "
            "within every task, that is, what other seeds would have given. Thin lines: tasks are drawn anew, too."
        }
        div class="panels" {
            (panel(0, "Interquartile mean", "mean of the middle half of all runs"))
            (panel(2, "Mean", "over tasks and seeds"))
            (panel(1, "Median", "over tasks, of the mean over seeds"))
            (panel(3, "Optimality gap", "mean shortfall from 100; lower is better"))
        }
        h3 { "Performance profiles and probability of improvement" }
        div class="panels" {
            figure {
                figcaption { "Runs above a score " span { "bands: " (percent(analysis)) ", over seeds" } }
                (svg::lines(&Frame {
                    label: "Performance profiles",
                    size: (440.0, 300.0),
                    x: ("normalised score", Axis::within(ends, 6)),
                    y: ("share of runs, %", Axis::fixed(0.0, 100.0, &[0.0, 25.0, 50.0, 75.0, 100.0])),
                    log: false,
                }, &profile))
                div class="keys" { @for l in &profile { (svg::key(&l.series)) } }
            }
            @if let (Some(floor), false) = (c.best_floor(), better.is_empty()) {
                figure {
                    figcaption { "Probability of outscoring the best floor " span { (analysis.methods[floor].title) } }
                    (svg::intervals("Probability of improvement", &better,
                        &Axis::fixed(0.0, 1.0, &[0.0, 0.25, 0.5, 0.75, 1.0]),
                        "probability that a run outscores a run of the floor", Some(0.5), 2))
                }
            }
        }
    }
}

fn percent(analysis: &Analysis) -> String {
    format!("{:.0} %", 100.0 * analysis.level)
}

/// Mean and extremes over seeds, at steps that all of them have, at most [`CURVE_POINTS`] of them.
fn mean_curve(curves: &[&[(f64, f64)]], map: impl Fn(f64) -> f64) -> Vec<Point> {
    let mut at: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for &(step, value) in curves.iter().copied().flatten() {
        let value = map(value);
        if value.is_finite() {
            at.entry(step.max(0.0) as u64).or_default().push(value);
        }
    }
    let most = at.values().map(Vec::len).max().unwrap_or(0);
    let steps: Vec<(u64, Vec<f64>)> = at.into_iter().filter(|(_, v)| v.len() == most).collect();
    let stride = steps.len().div_ceil(CURVE_POINTS).max(1);
    let last = steps.len().saturating_sub(1);
    let kept = steps.into_iter().enumerate().filter(|(k, _)| k % stride == 0 || *k == last);
    kept.map(|(_, (step, values))| {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        Point { x: step as f64, y: mean, band: (values.len() > 1).then_some((low, high)) }
    })
    .collect()
}

fn curves(study: &Study, analysis: &Analysis) -> Markup {
    let series = classes(analysis);
    let tasks: Vec<Task> = analysis.tables.iter().flat_map(|t| t.rows.iter().map(|r| r.task)).collect();
    let lines = |name: &str, map: &dyn Fn(f64) -> f64| -> Vec<(Task, Vec<Line>)> {
        let of = |task: &Task| -> Vec<Line> {
            let line = |(m, method): (usize, &crate::study::Method)| {
                let runs = study.runs.iter().filter(|r| r.task == *task && r.method == method.id);
                let points: Vec<&[(f64, f64)]> =
                    runs.filter_map(|r| r.folder.curves.get(r.index)?.get(name)).map(Vec::as_slice).collect();
                let points = mean_curve(&points, map);
                (!points.is_empty()).then(|| Line { series: series[m].clone(), points })
            };
            analysis.methods.iter().enumerate().filter_map(line).collect()
        };
        tasks.iter().map(|t| (*t, of(t))).filter(|(_, lines)| !lines.is_empty()).collect()
    };
    let scores = lines("evaluate/score", &|v| v);
    let on_the_way = scores.iter().flat_map(|(_, l)| l).any(|l| l.points.len() > 1);
    let everything = lines("learn/policy_loss", &|v| v);
    let positive = everything.iter().flat_map(|(_, l)| l).flat_map(|l| &l.points).all(|p| p.range().0 > 0.0);
    let losses = if positive { lines("learn/policy_loss", &f64::log10) } else { everything };
    let several = tasks.iter().map(|t| t.shift).collect::<BTreeSet<_>>().len() > 1;
    let panels = |figures: &[(Task, Vec<Line>)], y_unit: &str, log: bool| {
        html! {
            div class="panels small" {
                @for (task, lines) in figures {
                    @let points = || lines.iter().flat_map(|l| &l.points);
                    @let heights = points().flat_map(|p| [p.y, p.range().0, p.range().1]);
                    @let y = if log { decades(heights) } else { Axis::around(heights, 4) };
                    figure {
                        figcaption {
                            (short(task))
                            @if several { br; span { (shift_title(task.shift)) } }
                        }
                        (svg::lines(&Frame {
                            label: &format!("{y_unit}, {task}"),
                            size: (320.0, 210.0),
                            x: ("update steps", Axis::within(points().map(|p| p.x).chain([0.0]), 5)),
                            y: (y_unit, y),
                            log,
                        }, lines))
                    }
                }
            }
        }
    };
    let keys = |figures: &[(Task, Vec<Line>)]| {
        let used = |s: &&Series| figures.iter().flat_map(|(_, l)| l).any(|l| l.series.title == s.title);
        html! { div class="keys" { @for s in series.iter().filter(used) { (svg::key(s)) } } }
    };
    html! {
        p { "Lines are means over seeds, bands reach from the lowest to the highest seed." }
        @if on_the_way {
            h3 { "Score during training" }
            (keys(&scores))
            (panels(&scores, "normalised score", false))
        } @else {
            p class="note" {
                "These runs were judged at the end only. Scores on the way come with "
                code { "--set evaluation.every=STEPS" } "."
            }
        }
        @if losses.is_empty() {
            p class="note" { "There are no figures of training: the runs have no metrics.jsonl." }
        } @else {
            h3 { "Policy loss" }
            p class="note" {
                "The algorithms' losses are not on one scale: compare the course of a line, not the height of two."
            }
            (keys(&losses))
            (panels(&losses, if positive { "policy loss (logarithmic)" } else { "policy loss" }, positive))
        }
    }
}

/// An axis of whole powers of ten.
pub(crate) fn decades(exponents: impl Iterator<Item = f64>) -> Axis {
    let (low, high) = exponents.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
    let (low, high) = if low > high { (0.0, 1.0) } else { (low.floor(), high.ceil().max(low.floor() + 1.0)) };
    let step = ((high - low) / 5.0).ceil().max(1.0);
    let ticks: Vec<f64> = (0..=((high - low) / step) as usize).map(|k| low + k as f64 * step).collect();
    Axis::fixed(low, high, &ticks)
}

/// `2 h 05 min`, `18 min`, `42 s`.
pub(crate) fn duration(seconds: f64) -> String {
    match seconds {
        s if s >= 3600.0 => format!("{:.0} h {:02.0} min", (s / 3600.0).floor(), (s % 3600.0 / 60.0).floor()),
        s if s >= 600.0 => format!("{:.0} min", s / 60.0),
        s if s >= 60.0 => format!("{:.1} min", s / 60.0),
        s if s >= 10.0 => format!("{s:.0} s"),
        s => format!("{s:.1} s"),
    }
}

fn bytes(memory: u64) -> String {
    let gib = memory as f64 / f64::from(1u32 << 30);
    if gib >= 1.0 { format!("{gib:.1} GiB") } else { format!("{:.0} MiB", gib * 1024.0) }
}

fn cost(study: &Study) -> Markup {
    // Groups of one stage together, in the order in which stages come; agents in the paper's.
    let mut stages: Vec<&str> = Vec::new();
    let mut groups: BTreeMap<(usize, Option<usize>, usize), Vec<&Cost>> = BTreeMap::new();
    for cost in &study.costs {
        let stage = stages.iter().position(|s| *s == cost.stage).unwrap_or_else(|| {
            stages.push(&cost.stage);
            stages.len() - 1
        });
        let agent = Agent::ALL.iter().position(|a| *a == cost.agent);
        groups.entry((stage, agent, cost.seeds)).or_default().push(cost);
    }
    let groups: Vec<Vec<&Cost>> = groups.into_values().collect();
    let paper = paper::runtime();
    html! {
        p {
            "Times on the clock of single pieces of work, on whatever machine did them and whatever else ran there. Memory is the most \
             that the process had at a time; where one process trained the networks and sampled from them, it stands with the sampling."
        }
        @if groups.is_empty() { p class="note" { "No stage has a time." } } @else {
            div class="scroll" {
                table {
                    thead {
                        tr {
                            th class="first" { "Stage" } th class="text" { "Agent" } th { "Seeds at once" } th { "Pieces" }
                            th { "Median" } th { "Shortest to longest" } th { "Most memory" }
                        }
                    }
                    tbody {
                        @for (k, list) in groups.iter().enumerate() {
                            @let mut times: Vec<f64> = list.iter().map(|c| c.seconds).collect();
                            @let () = times.sort_by(f64::total_cmp);
                            @let Cost { stage, agent, seeds, .. } = list[0];
                            @let first = k == 0 || groups[k - 1][0].stage != *stage;
                            tr class=[first.then_some("break")] {
                                th scope="row" { @if first { (stage) } }
                                td class="text" { (agent_title(*agent)) }
                                td { (seeds) } td { (list.len()) }
                                td { (duration(crate::stats::quantile(&times, 0.5))) }
                                td { (duration(times[0])) " to " (duration(times[times.len() - 1])) }
                                td { (list.iter().filter_map(|c| c.memory).max().map_or("not noted".into(), bytes)) }
                            }
                        }
                    }
                }
            }
        }
        p class="note" { "The paper's Table E.1, as printed (morphology shift, medium to expert, one GPU):" }
        div class="scroll" {
            table {
                thead { tr { @for (k, h) in paper[0].iter().enumerate() { th class=(if k == 0 { "first" } else { "from-paper" }) { (h) } } } }
                tbody {
                    @for row in &paper[1..] {
                        tr {
                            @for (k, c) in row.iter().enumerate() {
                                @if k == 0 { th scope="row" { (c) } } @else { td class="from-paper" { (c) } }
                            }
                        }
                    }
                }
            }
        }
    }
}

fn runs(study: &Study) -> Markup {
    let mut tasks: Vec<Task> = study.runs.iter().map(|r| r.task).collect();
    tasks.sort_by_key(order);
    tasks.dedup();
    let mut configs: BTreeMap<&str, (&str, BTreeSet<&str>)> = BTreeMap::new();
    for run in &study.runs {
        let entry = configs.entry(&run.folder.config_hash).or_insert((&run.folder.config, BTreeSet::new()));
        entry.1.insert(&run.method);
    }
    html! {
        p { "Every score with what decided it: seed, configuration, hashes of data and results, and the program." }
        @for task in &tasks {
            @let list: Vec<&Run> = study.methods.iter().flat_map(|m| study.runs.iter().filter(move |r| r.task == *task && r.method == m.id)).collect();
            details {
                summary { (task) " · " (counted(list.len(), "run", "runs")) }
                div class="inner scroll" {
                    table {
                        thead {
                            tr {
                                th class="first" { "Method" } th { "Seed" } th { "Score" } th { "Episodes" } th { "Returns" }
                                th { "Other rows" } th { "Time" } th class="text" { "Program" } th class="text" { "Settings" }
                                th class="text" { "Folder and hashes" }
                            }
                        }
                        tbody { @for run in list { (run_row(run)) } }
                    }
                }
            }
        }
        h3 { "Settings" }
        @for (hash, (text, methods)) in &configs {
            details id=(format!("config-{hash}")) {
                summary { code { (hash) } " · " (methods.iter().copied().collect::<Vec<_>>().join(", ")) }
                div class="inner" { pre { (text) } }
            }
        }
    }
}

fn run_row(run: &Run) -> Markup {
    let folder = &run.folder;
    let returns = &run.member.returns;
    let (low, high) = returns.iter().fold((f64::MAX, f64::MIN), |(l, h), r| (l.min(*r), h.max(*r)));
    html! {
        tr {
            th scope="row" { (run.method) @if folder.published { " " span class="badge" { "published mode" } } }
            td { (run.member.seed) }
            td {
                (score(run).map_or("–".into(), one))
                @if let Verdict::Diverged(why) = &run.member.verdict { span title=(why) { "†" } }
            }
            td { (returns.len()) }
            td { @if returns.is_empty() { "–" } @else { (minus(format!("{low:.0}"))) " to " (minus(format!("{high:.0}"))) } }
            td {
                (folder.extra_rows)
                @if let Some((sampled, kept)) = folder.generated.get(run.index) {
                    " " small { (kept) " kept of " (sampled) " generated" }
                }
            }
            td {
                (duration(folder.seconds))
                @if folder.members.len() > 1 { " " small { "for " (folder.members.len()) " seeds" } }
            }
            td class="text" { (folder.program) }
            td class="text" { a href=(format!("#config-{}", folder.config_hash)) { code { (folder.config_hash) } } }
            td class="text" {
                details {
                    summary { code { (folder.directory.display()) } }
                    table {
                        tbody {
                            @for (name, value) in &folder.inputs { tr { th { "input: " (name) } td class="text" { code { (value) } } } }
                            @for (name, hash) in &folder.files { tr { th { (name) } td class="text" { code { (hash) } } } }
                        }
                    }
                }
            }
        }
    }
}

fn methods(analysis: &Analysis) -> Markup {
    html! {
        p {
            "A run is one policy of one seed. Its score is 100 (J − J" sub { "random" } ") / (J" sub { "expert" } " − J" sub { "random" }
            "), with J the mean undiscounted return of its evaluation episodes after the last update, and the reference returns that its \
             settings name (" code { "evaluation.scores" } ")."
        }
        p {
            b { "Floors. " }
            "Cloning of the target rows with raw and with standardised observations, cloning of the best half of the trajectories, and \
             IQL on the target rows alone. The best floor is the one with the highest interquartile mean on the compared tasks; it is \
             chosen after the fact, which is to the methods' disadvantage if anything."
        }
        p {
            b { "Statistics. " }
            "As in Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice (2021), and their package rliable: \
             interquartile mean, median, mean, optimality gap, performance profiles, probability of improvement (a tie counts one half), \
             and percentile intervals of a bootstrap with " (analysis.resamples) " resamples (a fifth of them for profiles), stratified \
             by task. Every task has the same weight. The paper gives means and deviations only, so that its rows have no interval."
        }
        p {
            b { "Findings. " }
            "A method beats the best floor, or falls short of it, if the interval of its probability of improvement lies on one side of one \
             half, and a permutation test, which deals each task's runs out to both anew, reaches p ≤ " (format!("{:.2}", 1.0 - analysis.level))
            ". The test is there because a bootstrap of few runs can shrink to a point: two runs above two others are nothing \
             extraordinary, for all that the interval says."
        }
        p {
            b { "Missing and failed runs. " }
            "A run that is not done, or whose files are not what they were, is counted nowhere, and listed above. A policy that diverged \
             is a result: it counts as 0 points, a random policy's score. Methods are compared only on tasks that all of them have; where \
             that is fewer than half of what the fullest method has, the method with the fewest tasks is left out, and named. With unequal numbers of seeds every task \
             keeps its weight, and its runs share it."
        }
        p {
            b { "What the intervals do not say. " }
            "They are one by one, not for all methods at once: of twenty true ties one is expected to look like a difference. With few \
             seeds they are too narrow. Tasks that share a robot or a data set are not independent of each other."
        }
    }
}
