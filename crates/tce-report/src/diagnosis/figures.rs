//! The figures of a diagnosis.

use maud::{Markup, html};
use tce_diagnosis::bounds::GRID;
use tce_diagnosis::{
    AtBound, Bounds, Coverage, Curve, Diagnosis, Embedding, ErrorOverDistance, Group, Memorisation, Reliability, Spread,
};

use super::numbers::number;
use crate::html::parts::decades;
use crate::svg::{self, Axis, Cloud, Frame, Line, Point, Scale, Series, Steps};

const SIZE: (f64, f64) = (320.0, 220.0);

fn class(title: &str, class: &str) -> Series {
    Series { title: title.into(), class: class.into() }
}

fn line(title: &str, style: &str, points: impl Iterator<Item = Option<Point>>) -> Option<Line> {
    let points: Vec<Point> = points.flatten().filter(|p| p.y.is_finite()).collect();
    (!points.is_empty()).then(|| Line { series: class(title, style), points })
}

fn bare(x: f64, y: f64) -> Option<Point> {
    Some(Point { x, y, band: None })
}

/// A figure with its key.
fn figure(title: &str, note: &str, x: (&str, Axis), y_unit: &str, scale: Scale, lines: Vec<Option<Line>>) -> Markup {
    let lines: Vec<Line> = lines.into_iter().flatten().collect();
    if lines.is_empty() {
        return html! {};
    }
    let heights = || lines.iter().flat_map(|l| &l.points).flat_map(|p| [p.y, p.range().0, p.range().1]);
    let y = if scale == Scale::Log { decades(heights()) } else { Axis::around(heights().chain([0.0]), 4) };
    html! {
        figure {
            figcaption { (title) @if !note.is_empty() { " " span { (note) } } }
            div class="keys" { @for l in &lines { (svg::key(&l.series)) } }
            (svg::lines(&Frame { label: title, size: SIZE, x, y: (y_unit, y), scale }, &lines))
        }
    }
}

fn y_axis(d: &Diagnosis) -> Axis {
    Axis::within(d.bounds_of_y.iter().map(|b| b.y_max), 5)
}

pub(super) fn coverage(d: &Diagnosis) -> Markup {
    let over = |f: &dyn Fn(&AtBound) -> Option<f64>| {
        d.bounds_of_y.iter().map(|b| f(b).and_then(|v| bare(b.y_max, v))).collect::<Vec<_>>()
    };
    let without = |of: &dyn Fn(Coverage) -> Option<f64>| {
        let value = d.covered_by_target.and_then(of);
        d.bounds_of_y.iter().map(|b| value.and_then(|v| bare(b.y_max, v))).collect::<Vec<_>>()
    };
    let second = if d.covered_by_fresh { "other target episodes" } else { "other target rows" };
    figure(
        "Coverage",
        "share of real states that are reached",
        ("y_max", y_axis(d)),
        "share",
        Scale::Linear,
        vec![
            line("target states, by generated rows", "m0", over(&|b| b.coverage.map(|c| c.target)).into_iter()),
            line(
                &format!("target states, by {second} (good: as high)"),
                "f0",
                without(&|c| Some(c.target)).into_iter(),
            ),
            line("source states, by generated rows", "m1", over(&|b| b.coverage.and_then(|c| c.source)).into_iter()),
            line(&format!("source states, by {second} (good: above it)"), "f2", without(&|c| c.source).into_iter()),
        ],
    )
}

pub(super) fn copies(d: &Diagnosis) -> Markup {
    let over = |f: &dyn Fn(&Memorisation) -> f64| {
        d.bounds_of_y.iter().map(|b| b.memorisation.as_ref().and_then(|m| bare(b.y_max, f(m)))).collect::<Vec<_>>()
    };
    figure(
        "Copies",
        "how often a row that passes the filter is nearer to a training row than a held-out row is",
        ("y_max", y_axis(d)),
        "share of comparisons",
        Scale::Linear,
        vec![
            line("generated rows", "m0", over(&|m| m.probability).into_iter()),
            line("if all were copies", "m1", over(&|m| m.of_copies).into_iter()),
            line("fresh rows (good)", "f0", over(&|_| 0.5).into_iter()),
        ],
    )
}

pub(super) fn reliability(d: &Diagnosis) -> Markup {
    let few = format!("a model of {} target rows against one of many simulated rows", d.target_rows);
    type Get = fn(&Reliability) -> Option<Spread>;
    let panels: [(&str, &str, &str, Scale, Get); 5] = [
        ("Distance of ŝ", "to the nearest real state", "standard deviations", Scale::Linear, |r| r.distance),
        ("Transition KL", &few, "nats per dimension (logarithmic)", Scale::Log, |r| r.transition_kl),
        ("Reward difference", &few, "|ΔR| (logarithmic)", Scale::Log, |r| r.reward_difference),
        ("Reward error", "against the simulator at (ŝ, â)", "|r̂ − r| (logarithmic)", Scale::Log, |r| {
            r.reward_error
        }),
        ("Dynamics consistency", "ŝ' against the simulator", "steps (logarithmic)", Scale::Log, |r| r.consistency),
    ];
    let points = |of: fn(&AtBound) -> Option<&Reliability>, get: Get, scale: Scale| {
        let point = |b: &AtBound| {
            let s = get(of(b)?)?;
            let map = |v: f64| if scale == Scale::Log { v.max(1e-9).log10() } else { v };
            Some(Point { x: b.y_max, y: map(s.median), band: Some((map(s.p10), map(s.p90))) })
        };
        d.bounds_of_y.iter().map(point).collect::<Vec<_>>()
    };
    html! {
        @for (title, note, unit, scale, get) in panels {
            (figure(title, note, ("y_max", y_axis(d)), unit, scale, vec![
                line("kept", "m0", points(|b| Some(&b.kept), get, scale).into_iter()),
                line("rejected by the filter", "m1", points(|b| b.outliers.as_ref(), get, scale).into_iter()),
            ]))
        }
    }
}

/// Label error against distance.
pub(super) fn distance(e: &ErrorOverDistance) -> Markup {
    let log = |v: f64| v.max(1e-9).log10();
    let points = e.bins.iter().map(|b| {
        let s = b.error;
        Some(Point { x: b.distance, y: log(s.median), band: Some((log(s.p10), log(s.p90))) })
    });
    let what = match e.simulated {
        true => "how wrong generated rows are",
        false => "how far three models of the target's steps disagree",
    };
    let unit = match e.by_episode {
        true => "1: as far as target states of different episodes usually are",
        false => "in standard deviations",
    };
    let note = format!("{what}, by how far their state is from the data ({unit})");
    let series = if e.simulated { "error against the physics" } else { "disagreement of the models" };
    figure(
        "Label error against distance",
        &note,
        ("distance of ŝ to the target's states", Axis::around(e.bins.iter().map(|b| b.distance).chain([0.0]), 5)),
        "error in steps (logarithmic)",
        Scale::Log,
        vec![line(series, "m0", points)],
    )
}

pub(super) fn picture(title: &str, note: &str, e: &Embedding) -> Markup {
    let style = |g: Group| match g {
        Group::Source => "f2",
        Group::NearestSource => "m2",
        Group::Target => "m1",
        Group::Generated => "m0",
    };
    let clouds: Vec<Cloud> = (e.groups.iter())
        .map(|(g, points)| Cloud { series: class(g.title(), style(*g)), points: points.clone() })
        .collect();
    html! {
        figure {
            figcaption { (title) " " span { (note) } }
            div class="keys" { @for c in &clouds { (svg::dot_key(&c.series)) } }
            (svg::clouds(&format!("{title}, {note}"), SIZE, &clouds))
        }
    }
}

pub(super) fn histograms(d: &Diagnosis) -> Markup {
    let s = &d.sampled;
    let steps = |title: &str, style: &str, h: &tce_diagnosis::Histogram| Steps {
        series: class(title, style),
        low: h.low,
        high: h.high,
        counts: h.counts.clone(),
    };
    let panel = |title: &str, note: &str, unit: &str, mark: Option<f64>, all: &[Steps]| {
        let counts = || all.iter().flat_map(|s| s.shares());
        let x = Axis::within(all.iter().flat_map(|s| [s.low, s.high]), 5);
        let frame = Frame {
            label: title,
            size: SIZE,
            x: (unit, x),
            y: ("share of rows", Axis::around(counts().chain([0.0]), 4)),
            scale: Scale::Linear,
        };
        html! {
            figure {
                figcaption { (title) " " span { (note) } }
                div class="keys" { @for s in all { (svg::key(&s.series)) } }
                (svg::steps(&frame, all, mark))
            }
        }
    };
    let mut labels = vec![steps("kept", "m0", &s.y_kept)];
    if s.y_rejected.counts.iter().any(|c| *c > 0) {
        labels.push(steps("rejected", "m1", &s.y_rejected));
    }
    html! {
        (panel("ŷ", "of rows at the run's own y_max", "ŷ", None, &labels))
        (panel("Largest |z|", "over the dimensions of (s, s')", "z", d.z_threshold, &[
            steps("generated", "m0", &s.z),
            steps("real target rows", "f0", &s.z_real),
        ]))
    }
}

pub(super) fn theorem(b: &Bounds) -> Markup {
    let lambdas = || Axis::fixed(0.0, 1.0, &[0.0, 0.25, 0.5, 0.75, 1.0]);
    let curve = |title: &str, style: &str, c: Option<&Curve>, of: fn(&Curve) -> &Vec<f64>| {
        c.and_then(|c| line(title, style, GRID.iter().zip(of(c)).map(|(x, y)| bare(*x, *y))))
    };
    // How far each λ has to be from λ = 0 to be told from it.
    let doubted = |title: &str, style: &str, c: Option<&Curve>| {
        let point = |c: &Curve, k: usize| {
            let (y, doubt) = (c.nearest[k], if k == 0 { Some(0.0) } else { c.doubt_between(0, k) });
            Some(Point { x: GRID[k], y, band: doubt.map(|d| (y - d, y + d)) })
        };
        c.and_then(|c| line(title, style, (0..GRID.len()).map(|k| point(c, k))))
    };
    let panel = |title: &str, factor: f64, unit: &str, truth: Option<&Curve>, alone: Option<&Curve>| {
        figure(
            title,
            &format!("(the bound is {} times this)", number(factor)),
            ("λ", lambdas()),
            unit,
            Scale::Linear,
            vec![
                curve("nearest source rows, by the simulator", "m0", truth, |c| &c.nearest),
                curve("all source rows, by the simulator", "m1", truth, |c| &c.all),
                doubted("nearest source rows, by the data alone", "m2", alone),
                curve("all source rows, by the data alone", "m3", alone, |c| &c.all),
            ],
        )
    };
    html! {
        (panel("Value discrepancy (Eq. 4)", b.value_factor(), "|ΔV|", b.value.as_ref(), b.value_alone.as_ref()))
        (panel("Transition dynamics (Eq. 3)", b.transition_factor(), "total variation", b.transition.as_ref(), b.transition_alone.as_ref()))
    }
}
