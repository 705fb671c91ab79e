//! What `tce diagnose` found, as a section of the report and as a page of its own: the paper's Fig. 1a, Fig. 3, Appendix F, and
//! Theorem 1 over λ.

use maud::{Markup, html};
use tce_base::counted;
use tce_diagnosis::{Choice, Diagnosis};

use crate::analysis::Analysis;
use crate::html::parts::document;
use crate::html::words::term;
use crate::study::{Study, order, short};

mod explanation;
mod figures;
mod lambda;
mod numbers;
mod table;

use explanation::explanation;
use figures::{copies, coverage, distance, histograms, picture, reliability, theorem};
use lambda::lambdas;
use numbers::plain;
use table::{bounds_table, figures_and_good, implied};

/// The page of one diagnosis.
pub fn page(diagnosis: &Diagnosis) -> String {
    let title = format!("{} · tce diagnosis", diagnosis.of);
    document(
        &title,
        html! {
            header {
                p class="eyebrow" { "Diagnosis" @if let Some(task) = diagnosis.task { " · " (task) } }
                h1 { (diagnosis.of) }
                @for (k, text) in lede(diagnosis).iter().enumerate() { p class=[(k == 0).then_some("lede")] { (text) } }
                (introduction(diagnosis))
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
    let name = |d: &Diagnosis| d.task.map_or_else(|| d.of.clone(), |t| short(&t));
    html! {
        ul class="said" {
            @for d in &all { li { b { (name(d)) } " (" (d.of) ", seed " (d.seed) "): " (d.advice().to_string()) } }
        }
        (lambdas(study, analysis, &all))
        @for (k, d) in all.iter().enumerate() {
            details open[k == 0] {
                summary { b { (name(d)) } " · " (d.of) ", seed " (d.seed) }
                div class="inner" {
                    (introduction(d))
                    @if let Some(c) = &d.choice { p { (c.sentence()) } }
                    (one(d))
                }
            }
        }
        (explanation())
    }
}

/// What to do with the rows, and with the source's.
fn lede(d: &Diagnosis) -> Vec<String> {
    std::iter::once(d.advice().to_string()).chain(d.choice.as_ref().map(Choice::sentence)).collect()
}

/// What the words of a diagnosis are of.
fn introduction(d: &Diagnosis) -> Markup {
    html! {
        p {
            "Looked at are " (term("generated", "generated rows")) ": transitions of the " (term("source", "target"))
            " robot that were made up, beside " (counted(d.target_rows, "logged one", "logged ones")) ". They were made with "
            (term("y", "y_max")) " = " (plain(d.y_max)) ": the larger, the farther they reach towards the source robot's states."
        }
    }
}

fn one(d: &Diagnosis) -> Markup {
    html! {
        h3 { "What was found, and what would be good" }
        p class="note" {
            (term("rms", "RMSE")) " is the typical size of an error. Actions are inferred from two states by the "
            (term("inverse", "inverse dynamics model")) "."
        }
        (figures_and_good(d))
        @if let Some(m) = d.at_own_bound().and_then(|b| b.memorisation) { p { "Copies: " (m) "." } }
        @if let Some(i) = &d.implied { p { (term("implied", "Implied policy")) ": " (i.sentence()) } (implied(i)) }
        h3 { "Over y_max: how far rows reach, and how far they can be trusted" }
        p class="note" {
            "Every figure is measured again with rows made for a smaller and for a larger " (term("y", "y_max")) ". Lines are medians, \
             bands reach from the 10th to the 90th percentile. "
            (term("coverage", "Coverage")) ", " (term("kl", "KL")) ", " (term("consistency", "consistency")) " and "
            (term("filter", "filter")) " are explained at the end."
        }
        div class="panels small" { (coverage(d)) (copies(d)) (reliability(d)) }
        @if let Some(e) = &d.error_over_distance {
            h3 { "Generated rows near the data and far from them" }
            div class="panels small" { (distance(e)) }
        }
        h3 { "Pictures" }
        p class="note" {
            (term("tsne", "Maps of rows")) ": what is near in the picture is near in truth. Generated rows should lie among the target's, \
             and with a larger y_max between these and the source's."
        }
        div class="panels small" {
            @if let Some(e) = &d.transitions { (picture("Transitions (s, s')", &format!("y_max = {}", plain(d.y_max)), e)) }
            @for (y, e) in &d.states { (picture("States", &format!("y_max = {}", plain(*y)), e)) }
        }
        h3 { "Labels ŷ and z-scores" }
        p class="note" {
            "The " (term("y", "ŷ")) " that rows were made for, and the largest " (term("filter", "z-score"))
            " of a row. Good are generated rows whose z-scores are like those of real target rows."
        }
        div class="panels small" { (histograms(d)) }
        @if let Some(b) = &d.theorem {
            h3 { "Theorem 1 over λ" }
            p class="note" {
                (term("theorem", "The paper's bound")) " on what a policy can lose, over the share " (term("lambda", "λ"))
                " of real source rows. Lower is better: the lowest point of a line is the λ that it speaks for."
            }
            div class="panels small" { (theorem(b)) }
            (bounds_table(d, b))
        }
        @if !d.notes.is_empty() { ul class="note" { @for n in &d.notes { li { (n) } } } }
    }
}
