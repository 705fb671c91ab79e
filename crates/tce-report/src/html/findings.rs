//! The findings: every method beside the best floor.

use maud::{Markup, html};
use tce_data::Shift;

use super::{counted, estimate, one, said, title_cell};
use crate::analysis::{Aggregate, Analysis, Comparison, Finding};
use crate::paper;
use crate::study::Study;

/// Three digits, or that it is below them.
fn p_value(a: &Aggregate) -> (bool, String) {
    match a.p_value {
        None => (false, "–".into()),
        Some(p) if p < 0.001 => (true, "0.001".into()),
        Some(p) => (false, format!("{p:.3}")),
    }
}

pub(super) fn findings(study: &Study, analysis: &Analysis) -> Markup {
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
