//! The findings: every method beside the best baseline.

use maud::{Markup, html};
use tce_base::counted;
use tce_data::Shift;

use super::{capital, estimate, one, said, signed, term, title_cell};
use crate::analysis::{Aggregate, Analysis, Comparison, Finding, gap_words, verdict_words};
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
    let baseline = c.standard();
    let sentence = |a: &Aggregate| -> Option<String> {
        let (p, _) = c.improvement(a)?;
        Some(format!(
            "{}: {} the best baseline, with an interquartile mean of {}. Of all pairs of a run of it and a run of that baseline, the share in which it scores \
             higher is {}. {}.",
            title(a.method),
            gap_words(c.gap(a)?),
            said(&a.over_seeds[0], 1),
            said(&p, 2),
            capital(&verdict_words(c, a)?),
        ))
    };
    html! {
        p {
            "Compared on " (counted(c.tasks.len(), "task", "tasks")) ", on which " (counted(c.methods.len(), "method", "methods"))
            " have scores. "
            @if let Some(f) = baseline {
                "The best " (term("baseline", "baseline")) " is " (title(f.method)) ", with an " (term("iqm", "interquartile mean"))
                " of " (said(&f.over_seeds[0], 1)) ". "
            }
            "Brackets hold " (percent) " % " (term("interval", "bootstrap intervals")) "."
        }
        ul class="said" { @for text in c.methods.iter().filter_map(sentence) { li { (text) } } }
        div class="scroll" {
            table {
                thead {
                    tr class="groups" {
                        th class="first" {}
                        th colspan="2" {}
                        @if let Some(f) = baseline {
                            th class="edge" colspan="4" { "Against the best baseline, " (title(f.method)) }
                        }
                        th class="edge" colspan="3" { "Over " (counted(c.tasks.len(), "task", "tasks")) }
                    }
                    tr {
                        th class="first" { "Method" }
                        th { "Runs" } th { (term("iqm", "Interquartile mean")) }
                        @if baseline.is_some() {
                            th class="edge" { "Points above it" } th { (term("improvement", "Share of pairs higher")) } th { (term("p", "p")) }
                            th class="text" { "Finding" }
                        }
                        th class="edge" { "Mean" } th { "Total" } th { "Mean rank" }
                    }
                }
                tbody { @for a in &c.methods { (row(analysis, c, baseline, a)) } }
            }
        }
        (other_baselines(analysis, c))
        (recommendations(analysis))
        (components(study, analysis, c))
    }
}

/// A method's line.
fn row(analysis: &Analysis, c: &Comparison, baseline: Option<&Aggregate>, a: &Aggregate) -> Markup {
    html! {
        tr {
            th scope="row" { (title_cell(analysis, a.method)) }
            td { (a.runs) }
            td { (estimate(&a.over_seeds[0], 1)) }
            @match (baseline, c.improvement(a)) {
                (None, _) => {}
                (_, Some((e, finding))) => {
                    td class="edge" { (c.gap(a).map_or("–".into(), signed)) }
                    td { (estimate(&e, 2)) }
                    @let (below, digits) = p_value(a);
                    td { @if below { "<" } (digits) }
                    td class=(format!("text {}", match finding {
                        Finding::Better => "better", Finding::Worse => "worse", _ => "",
                    })) { (finding.word()) }
                }
                (Some(f), None) => {
                    td class="edge" { "–" }
                    td { "–" }
                    td {}
                    td class="text" { @if f.method == a.method { "the best baseline" } @else { "baseline" } }
                }
            }
            td class="edge" { (estimate(&a.over_seeds[2], 1)) }
            td { (estimate(&a.total, 1)) }
            td { (one(a.rank)) }
        }
    }
}

/// Methods beside the baselines that are not the best.
fn other_baselines(analysis: &Analysis, c: &Comparison) -> Markup {
    let others: Vec<usize> = (0..c.baselines.len()).filter(|k| Some(*k) != c.best_baseline).collect();
    let compared: Vec<(&Aggregate, &Vec<_>)> =
        c.methods.iter().filter_map(|a| Some((a, a.over_baselines.as_ref()?))).collect();
    html! {
        @if !others.is_empty() && !compared.is_empty() {
            h3 { "Share of pairs in which a method's run scores higher than another baseline's" }
            div class="scroll" {
                table {
                    thead { tr {
                        th class="first" { "Method" }
                        @for k in &others { th { (analysis.methods[c.baselines[*k]].title) } }
                    } }
                    tbody {
                        @for (a, over) in &compared {
                            tr { th scope="row" { (title_cell(analysis, a.method)) } @for k in &others { td { (estimate(&over[*k], 2)) } } }
                        }
                    }
                }
            }
        }
    }
}

/// What the recommended policies came to; one alone stands in the opening.
fn recommendations(analysis: &Analysis) -> Markup {
    let dash = || "–".to_owned();
    html! {
        @if analysis.recommendations.len() > 1 {
            h3 { "Recommended policies and their " (term("regret", "regret")) }
            div class="scroll" {
                table {
                    thead { tr {
                        th class="first" { "Task" } th class="text" { "Recommended" } th { "Its score" } th { "Regret" }
                        th class="text" { "Best policy here" } th { "Its score" }
                    } }
                    tbody { @for r in &analysis.recommendations { tr {
                        th scope="row" { (r.task) }
                        td class="text" {
                            (r.method) @if let Some(seed) = r.seed { ", seed " (seed) } @if !r.sure { " " small { "not sure" } }
                        }
                        td { (r.score.map_or_else(dash, one)) }
                        td { (r.regret().map_or_else(dash, one)) }
                        td class="text" { @match &r.best { Some(b) => { (b.method) ", seed " (b.seed) }, None => "–" } }
                        td { (r.best.as_ref().map_or_else(dash, |b| one(b.score))) }
                    } } }
                }
            }
        }
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
            let name = paper::counterpart(&study.methods[a.method].base)?;
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
