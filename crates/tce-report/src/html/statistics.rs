//! Figures over all tasks.

use maud::{Markup, html};

use super::{classes, percent, term};
use crate::analysis::{Aggregate, Analysis, Comparison};
use crate::svg::{self, Axis, Frame, Interval, Line, Point, Scale, Series};

pub(super) fn statistics(analysis: &Analysis) -> Markup {
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
    let profile = profiles(c, &series);
    let ends = [c.thresholds[0], c.thresholds[c.thresholds.len() - 1]];
    html! {
        p {
            "Dots are the figures of the runs as they are. Thick lines are " (percent(analysis)) " " (term("interval", "bootstrap intervals"))
            ": the range that other seeds might have given. Thin lines are wider, because other tasks are drawn as well."
        }
        div class="panels" {
            (panel(0, "Interquartile mean", "mean of the middle half of all runs"))
            (panel(2, "Mean", "over tasks and seeds"))
            (panel(1, "Median", "over tasks, of the mean over seeds"))
            (panel(3, "Optimality gap", "mean shortfall from 100; lower is better"))
        }
        p class="note" {
            "The " (term("gap", "optimality gap")) " is the mean shortfall from 100. The " (term("iqm", "interquartile mean"))
            " leaves out the lowest and the highest quarter of the runs."
        }
        h3 { "Performance profiles and probability of improvement" }
        p class="note" {
            "A " (term("profile", "performance profile")) " shows which share of the runs is above every score: farther to the right is \
             better. The " (term("improvement", "probability of improvement")) " is the share of pairs, a run of the method and one of the \
             best baseline, in which the method's run scores higher: one half, the dashed line, is no difference."
        }
        div class="panels" {
            figure {
                figcaption { "Runs above a score " span { "bands: " (percent(analysis)) ", over seeds" } }
                (svg::lines(&Frame {
                    label: "Performance profiles",
                    size: (440.0, 300.0),
                    x: ("normalised score", Axis::within(ends, 6)),
                    y: ("share of runs, %", Axis::fixed(0.0, 100.0, &[0.0, 25.0, 50.0, 75.0, 100.0])),
                    scale: Scale::Linear,
                }, &profile))
                div class="keys" { @for l in &profile { (svg::key(&l.series)) } }
            }
            @if let (Some(baseline), false) = (c.best_baseline(), better.is_empty()) {
                figure {
                    figcaption { "Probability of improvement on the best baseline " span { (analysis.methods[baseline].title) } }
                    (svg::intervals("Probability of improvement", &better,
                        &Axis::fixed(0.0, 1.0, &[0.0, 0.25, 0.5, 0.75, 1.0]),
                        "share of pairs in which the method is higher", Some(0.5), 2))
                }
            }
        }
    }
}

/// For every method, the share of runs above each threshold.
fn profiles(c: &Comparison, series: &[Series]) -> Vec<Line> {
    let line = |a: &Aggregate| Line {
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
    };
    c.methods.iter().map(line).collect()
}
