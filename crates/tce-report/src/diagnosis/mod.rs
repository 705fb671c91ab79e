//! What `tce diagnose` found, as a section of the report and as a page of its own: the paper's Fig. 1a, Fig. 3, Appendix F, and
//! Theorem 1 over λ.

use maud::{Markup, html};
use tce_diagnosis::{Choice, Coverage, Diagnosis};

use crate::analysis::Analysis;
use crate::html::document;
use crate::study::{Study, order, short};
use crate::svg::minus;

mod explanation;
mod figures;
mod lambda;
mod table;

use explanation::explanation;
use figures::{copies, coverage, distance, histograms, picture, reliability, theorem};
use lambda::lambdas;
use table::{implied, table};

/// The page of one diagnosis.
pub fn page(diagnosis: &Diagnosis) -> String {
    let title = format!("{} · tce diagnosis", diagnosis.of);
    document(
        &title,
        html! {
            header {
                p class="eyebrow" { "Diagnosis" @if let Some(task) = diagnosis.task { " · " (task) } }
                h1 { (diagnosis.of) }
                p class="lede" { (lede(diagnosis)) }
            }
            section { (one(diagnosis)) }
            section { h2 { "How the figures are made" } (explanation()) }
        },
    )
}

/// All of a study's diagnoses.
pub fn section(study: &Study, analysis: &Analysis) -> Markup {
    let mut all: Vec<&Diagnosis> = study.diagnoses.iter().collect();
    all.sort_by_key(|d| (d.task.as_ref().map(order), d.of.clone(), d.seed));
    html! {
        (lambdas(study, analysis, &all))
        @for (k, d) in all.iter().enumerate() {
            details open[k == 0] {
                summary { b { (d.task.map_or_else(|| d.of.clone(), |t| short(&t))) } " · " (d.of) ", seed " (d.seed) }
                div class="inner" { p { (lede(d)) } (one(d)) }
            }
        }
        (explanation())
    }
}

fn number(value: f64) -> String {
    let text = match value.abs() {
        0.0 => "0".into(),
        v if v >= 100.0 => format!("{value:.0}"),
        v if v >= 1.0 => format!("{value:.2}"),
        v if v >= 0.001 => format!("{value:.3}"),
        _ => format!("{value:.1e}"),
    };
    minus(text)
}

/// A setting as it was written.
fn plain(value: f64) -> String {
    minus(format!("{value}"))
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

/// The diagnosis in a few sentences.
fn lede(d: &Diagnosis) -> String {
    let mut text = String::new();
    if let (Some(zero), Some(own)) = (d.at(0.0), d.at_own_bound()) {
        let target = |c: Option<Coverage>| c.map_or("–".into(), |c| percent(c.target));
        let source = |c: Option<Coverage>| c.and_then(|c| c.source).map_or("–".into(), percent);
        text += &format!(
            "With y_max = {} generated rows cover {} of the target's and {} of the source's states ({} and {} at y_max = 0; as many \
             {} {} and {}).",
            plain(d.y_max),
            target(own.coverage),
            source(own.coverage),
            target(zero.coverage),
            source(zero.coverage),
            if d.covered_by_fresh { "rows of other target episodes" } else { "other target rows" },
            target(d.covered_by_target),
            source(d.covered_by_target),
        );
        if let Some(c) = own.kept.consistency {
            text += &format!(
                " Their successors are {} of a step away from the target's dynamics (median).",
                number(c.median)
            );
        }
    }
    if let Some(m) = d.at_own_bound().and_then(|b| b.memorisation) {
        text += &format!(" {}.", m.to_string().replacen("generated", "Generated", 1));
    }
    if let Some(c) = &d.choice {
        text += &match c {
            Choice { told: false, .. } => {
                " The data alone do not say which λ is best: models of the target rows, or the samples, are too much in doubt."
                    .to_owned()
            }
            Choice { lambda: 0.0, .. } => " The data alone say: λ = 0, generated rows without source rows.".to_owned(),
            c => format!(" The data alone say: λ = {}, with the nearest source rows.", plain(c.lambda)),
        };
    }
    text
}

fn one(d: &Diagnosis) -> Markup {
    html! {
        h3 { "Coverage and reliability over y" sub { "max" } }
        div class="panels small" { (coverage(d)) (copies(d)) (reliability(d)) }
        @if let Some(i) = &d.implied { h3 { "The policy that the generator implies" } (implied(i)) }
        @if let Some(e) = &d.error_over_distance {
            h3 { "Generated rows near the data and far from them" }
            div class="panels small" { (distance(e)) }
        }
        h3 { "Pictures" }
        div class="panels small" {
            @if let Some(e) = &d.transitions { (picture("Transitions (s, s')", &format!("y_max = {}", plain(d.y_max)), e)) }
            @for (y, e) in &d.states { (picture("States", &format!("y_max = {}", plain(*y)), e)) }
        }
        h3 { "Labels ŷ, z-scores" }
        div class="panels small" { (histograms(d)) }
        @if let Some(b) = &d.theorem {
            h3 { "Theorem 1 over λ" }
            div class="panels small" { (theorem(b)) }
        }
        (table(d))
        @if !d.notes.is_empty() { ul class="note" { @for n in &d.notes { li { (n) } } } }
    }
}
