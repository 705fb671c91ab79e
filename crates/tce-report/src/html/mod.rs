//! The report as one HTML file: no script, no network, and every text from a file escaped by [`maud`].

use std::collections::BTreeSet;

use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::analysis::{Analysis, opening};
use crate::stats::Estimate;
use crate::study::{Study, shift_title};
use crate::svg::{Axis, Series, minus};

mod cost;
mod curves;
mod findings;
mod methods;
mod runs;
mod scores;
mod statistics;
mod words;

pub(crate) use words::term;

/// The page's text.
pub fn page(study: &Study, analysis: &Analysis) -> String {
    let title = format!("{} · tce report", study.name);
    let mut sections = vec![
        ("findings", "Findings", findings::findings(study, analysis)),
        ("scores", "Scores by task", scores::tables(analysis)),
        ("statistics", "Statistics over tasks", statistics::statistics(analysis)),
        ("curves", "Learning curves", curves::curves(study, analysis)),
        ("cost", "Time and memory", cost::cost(study)),
        ("runs", "Runs and provenance", runs::runs(study)),
        ("methods", "How the figures are made", methods::methods(analysis)),
    ];
    if !study.diagnoses.is_empty() {
        sections.insert(
            3,
            ("diagnoses", "Generated rows and real source rows", crate::diagnosis::section(study, analysis)),
        );
    }
    if let Some(section) = crate::sensitivity::section(study, analysis) {
        sections.insert(2, ("sensitivity", "Sensitivity", section));
    }
    let body = html! {
        (head(study, analysis))
        (warnings(analysis))
        nav aria-label="Sections" {
            @for (id, title, _) in &sections { a href=(format!("#{id}")) { (title) } }
            a href="#words" { "Words" }
        }
        @for (id, title, body) in &sections {
            section id=(id) { h2 { (title) } (body) }
        }
    };
    document(&title, body)
}

/// A whole page around `body`, with the words that it links to explained at its end.
pub(crate) fn document(title: &str, body: Markup) -> String {
    let words = words::list(&body.0);
    let markup = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                // The page promises to need no network: the browser holds it to that.
                meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'";
                title { (title) }
                style { (PreEscaped(include_str!("../page.css"))) }
            }
            body {
                main {
                    (body)
                    section id="words" { h2 { "Words" } (words) }
                    footer class="note" { "Made by " (concat!("tce ", env!("CARGO_PKG_VERSION"))) "." }
                }
            }
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

/// With its sign.
fn signed(value: f64) -> String {
    if value > 0.0 { format!("+{value:.1}") } else { one(value) }
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
        let (count, letter, hues) = if m.floor { (&mut floors, 'f', 5) } else { (&mut others, 'm', 8) };
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

fn head(study: &Study, analysis: &Analysis) -> Markup {
    let tasks: BTreeSet<String> =
        analysis.tables.iter().flat_map(|t| t.rows.iter().map(|r| r.task.to_string())).collect();
    let seeds: BTreeSet<u64> = study.runs.iter().map(|r| r.member.seed).collect();
    let floors = analysis.methods.iter().filter(|m| m.floor).count();
    let all = study.runs.len() + study.missing.len();
    let hours = study.runs.iter().map(|r| r.folder.seconds / r.folder.members.len() as f64).sum::<f64>();
    let shifts: Vec<String> = analysis.tables.iter().map(|t| shift_title(t.shift).to_lowercase()).collect();
    let presets = analysis.recipes.presets.len();
    let sentences = opening(analysis);
    html! {
        header {
            p class="eyebrow" { (if study.sweep { "Sweep" } else { "Runs" }) " · " (shifts.join(" · ")) }
            h1 { (study.name) }
            p class="lede" { (sentences[0]) }
            @for text in &sentences[1..] { p { (text) } }
            @if analysis.comparison.is_some() {
                p class="note" {
                    "Points are of the " (term("score", "normalised score")) ": a random policy has 0, an expert of the target robot 100. A "
                    (term("baseline", "baseline")) " is a simple method that a result has to beat"
                    @if analysis.methods.iter().any(|m| m.floor && m.title.starts_with("BC")) {
                        "; BC is " (term("bc", "behaviour cloning"))
                    }
                    ". Methods are compared by their "
                    (term("iqm", "interquartile mean")) ", the mean of the middle half of their runs; a run is one policy of one "
                    (term("seed", "seed")) "."
                    @if !analysis.recommendations.is_empty() {
                        " A recommendation is made from the data alone; its " (term("regret", "regret"))
                        " is what a choice by the scores would have brought in addition."
                    }
                }
            }
            ul class="facts" {
                li { b { (analysis.recipes.names()) } (term("preset", if presets == 1 { "preset" } else { "presets" })) }
                @if let Some(updates) = analysis.recipes.updates() { li { b { (updates) } (term("updates", "learner updates")) } }
                li { b { (tasks.len()) } (if tasks.len() == 1 { "task" } else { "tasks" }) }
                li { b { (analysis.methods.len() - floors) " + " (floors) } "methods + baselines" }
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

fn percent(analysis: &Analysis) -> String {
    format!("{:.0} %", 100.0 * analysis.level)
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
