//! Figures of training.

use std::collections::BTreeMap;

use maud::{Markup, html};
use tce_data::Task;

use super::parts::task_caption;
use super::{classes, decades, term};
use crate::analysis::Analysis;
use crate::study::Study;
use crate::svg::{self, Axis, Frame, Line, Point, Scale, Series};

/// Points of a curve; more would be finer than the pixels.
const CURVE_POINTS: usize = 60;

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

pub(super) fn curves(study: &Study, analysis: &Analysis) -> Markup {
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
    let scale = if positive { Scale::Log } else { Scale::Linear };
    let panels = |figures: &[(Task, Vec<Line>)], y_unit: &str, scale: Scale| {
        html! {
            div class="panels small" {
                @for (task, lines) in figures {
                    @let points = || lines.iter().flat_map(|l| &l.points);
                    @let heights = points().flat_map(|p| [p.y, p.range().0, p.range().1]);
                    @let y = if scale == Scale::Log { decades(heights) } else { Axis::around(heights, 4) };
                    figure {
                        (task_caption(analysis, task))
                        (svg::lines(&Frame {
                            label: &format!("{y_unit}, {task}"),
                            size: (320.0, 210.0),
                            x: ("update steps", Axis::within(points().map(|p| p.x).chain([0.0]), 5)),
                            y: (y_unit, y),
                            scale,
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
        p { "Lines are means over " (term("seed", "seeds")) ", bands reach from the lowest to the highest seed." }
        @if on_the_way {
            h3 { "Score during training" }
            (keys(&scores))
            (panels(&scores, "normalised score", Scale::Linear))
        } @else {
            p class="note" {
                "These runs were evaluated at the end only. Scores on the way come with "
                code { "--set evaluation.every=STEPS" } "."
            }
        }
        @if losses.is_empty() {
            p class="note" { "There are no figures of training: the runs have no metrics.jsonl." }
        } @else {
            h3 { "Policy loss" }
            p class="note" {
                "Different algorithms have losses on different scales: follow one line over time, and do not compare the height of two."
            }
            (keys(&losses))
            (panels(&losses, if positive { "policy loss (logarithmic)" } else { "policy loss" }, scale))
        }
    }
}
