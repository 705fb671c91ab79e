//! The report as one HTML file: no script, no network, and every text from a file escaped by [`maud`].

use std::collections::BTreeSet;

use maud::{Markup, html};
use tce_base::counted;

use crate::analysis::{Analysis, opening};
use crate::study::{Study, shift_title};

mod cost;
mod curves;
mod effects;
mod findings;
mod methods;
pub(crate) mod parts;
mod runs;
mod scores;
mod statistics;
pub(crate) mod words;

use parts::{capital, classes, estimate, one, percent, range, said, signed, title_cell};
pub(crate) use parts::{decades, document, duration};
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
            sections.len() - 4,
            ("diagnoses", "Generated rows and real source rows", crate::diagnosis::section(study, analysis)),
        );
    }
    if let Some(section) = effects::effects(analysis) {
        sections.insert(2, ("effects", "Where methods help and harm", section));
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

fn head(study: &Study, analysis: &Analysis) -> Markup {
    let tasks: BTreeSet<String> =
        analysis.tables.iter().flat_map(|t| t.rows.iter().map(|r| r.task.to_string())).collect();
    let seeds: BTreeSet<u64> = study.runs.iter().map(|r| r.member.seed).collect();
    let baselines = analysis.methods.iter().filter(|m| m.baseline).count();
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
                    @if analysis.methods.iter().any(|m| m.baseline && m.title.starts_with("BC")) {
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
                li { b { (analysis.methods.len() - baselines) " + " (baselines) } "methods + baselines" }
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
