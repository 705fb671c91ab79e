//! What `tce diagnose` found, as a section of the report and as a page of its own: the paper's Fig. 1a, Fig. 3, Appendix F, and
//! Theorem 1 over λ.

use maud::{Markup, html};
use tce_data::Task;
use tce_diagnosis::bounds::GRID;
use tce_diagnosis::coverage::NEIGHBOUR;
use tce_diagnosis::memorisation::COPIES;
use tce_diagnosis::{AtBound, Bounds, Curve, Diagnosis, Embedding, Group, Reliability, Spread};

use crate::analysis::Analysis;
use crate::html::{counted, decades, document};
use crate::study::{Study, order, short};
use crate::svg::{self, Axis, Cloud, Frame, Line, Point, Series, Steps, minus};

const SIZE: (f64, f64) = (320.0, 220.0);

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
    let at = |y: f64| d.bounds_of_y.iter().find(|b| (b.y_max - y).abs() < 1e-9);
    let mut text = String::new();
    if let (Some(zero), Some(own)) = (at(0.0), at(d.y_max)) {
        text += &format!(
            "With y_max = {} generated rows cover {} of the target's and {} of the source's states ({} and {} at y_max = 0; the target \
             rows themselves {} of the source's).",
            plain(d.y_max),
            percent(own.coverage.target),
            own.coverage.source.map_or("–".into(), percent),
            percent(zero.coverage.target),
            zero.coverage.source.map_or("–".into(), percent),
            d.covered_by_target.source.map_or("–".into(), percent),
        );
        if let Some(c) = own.kept.consistency {
            text += &format!(
                " Their successors are {} of a step away from the target's dynamics (median).",
                number(c.median)
            );
        }
    }
    if let Some(m) = &d.memorisation {
        text += if m.copied() {
            " They look like copies of training rows."
        } else {
            " They are no copies of training rows."
        };
    }
    if let Some(c) = &d.choice {
        text += &match c.lambda {
            0.0 => " The data alone say: λ = 0, generated rows without source rows.".to_owned(),
            l => format!(" The data alone say: λ = {}, with the nearest source rows.", plain(l)),
        };
    }
    text
}

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
fn figure(title: &str, note: &str, x: (&str, Axis), y_unit: &str, log: bool, lines: Vec<Option<Line>>) -> Markup {
    let lines: Vec<Line> = lines.into_iter().flatten().collect();
    if lines.is_empty() {
        return html! {};
    }
    let heights = || lines.iter().flat_map(|l| &l.points).flat_map(|p| [p.y, p.range().0, p.range().1]);
    let y = if log { decades(heights()) } else { Axis::around(heights().chain([0.0]), 4) };
    html! {
        figure {
            figcaption { (title) @if !note.is_empty() { " " span { (note) } } }
            div class="keys" { @for l in &lines { (svg::key(&l.series)) } }
            (svg::lines(&Frame { label: title, size: SIZE, x, y: (y_unit, y), log }, &lines))
        }
    }
}

fn one(d: &Diagnosis) -> Markup {
    html! {
        h3 { "Coverage and reliability over y" sub { "max" } }
        div class="panels small" { (coverage(d)) (reliability(d)) }
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

fn y_axis(d: &Diagnosis) -> Axis {
    Axis::within(d.bounds_of_y.iter().map(|b| b.y_max), 5)
}

fn coverage(d: &Diagnosis) -> Markup {
    let over = |f: &dyn Fn(&AtBound) -> Option<f64>| {
        d.bounds_of_y.iter().map(|b| f(b).and_then(|v| bare(b.y_max, v))).collect::<Vec<_>>()
    };
    let without = d.bounds_of_y.iter().map(|b| d.covered_by_target.source.and_then(|v| bare(b.y_max, v)));
    figure(
        "Coverage",
        "of states, by generated rows",
        ("y_max", y_axis(d)),
        "share",
        false,
        vec![
            line("target states", "m0", over(&|b| Some(b.coverage.target)).into_iter()),
            line("source states", "m1", over(&|b| b.coverage.source).into_iter()),
            line("source states, by target rows", "f1", without),
        ],
    )
}

fn reliability(d: &Diagnosis) -> Markup {
    type Get = fn(&Reliability) -> Option<Spread>;
    let panels: [(&str, &str, &str, bool, Get); 5] = [
        ("Distance of ŝ", "to the nearest real state", "standard deviations", false, |r| r.distance),
        ("Transition KL", "5k against abundant target rows", "nats per dimension (logarithmic)", true, |r| {
            r.transition_kl
        }),
        ("Reward difference", "5k against abundant target rows", "|ΔR| (logarithmic)", true, |r| r.reward_difference),
        ("Reward error", "against the simulator at (ŝ, â)", "|r̂ − r| (logarithmic)", true, |r| r.reward_error),
        ("Dynamics consistency", "ŝ' against the simulator", "steps (logarithmic)", true, |r| r.consistency),
    ];
    let points = |get: Get, log: bool, outliers: bool| {
        let point = |b: &AtBound| {
            let of = if outliers { b.outliers.as_ref() } else { Some(&b.kept) };
            let s = get(of?)?;
            let map = |v: f64| if log { v.max(1e-9).log10() } else { v };
            Some(Point { x: b.y_max, y: map(s.median), band: Some((map(s.p10), map(s.p90))) })
        };
        d.bounds_of_y.iter().map(point).collect::<Vec<_>>()
    };
    html! {
        @for (title, note, unit, log, get) in panels {
            (figure(title, note, ("y_max", y_axis(d)), unit, log, vec![
                line("kept", "m0", points(get, log, false).into_iter()),
                line("rejected by the filter", "m1", points(get, log, true).into_iter()),
            ]))
        }
    }
}

fn picture(title: &str, note: &str, e: &Embedding) -> Markup {
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

fn histograms(d: &Diagnosis) -> Markup {
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
            log: false,
        };
        html! {
            figure {
                figcaption { (title) " " span { (note) } }
                div class="keys" { @for s in all { (svg::key(&s.series)) } }
                (svg::steps(&frame, all, mark))
            }
        }
    };
    html! {
        (panel("ŷ", "of rows at the run's own y_max", "ŷ", None, &[steps("kept", "m0", &s.y_kept), steps("rejected", "m1", &s.y_rejected)]))
        (panel("Largest |z|", "over the dimensions of (s, s')", "z", d.z_threshold, &[
            steps("generated", "m0", &s.z),
            steps("real target rows", "f0", &s.z_real),
        ]))
    }
}

fn theorem(b: &Bounds) -> Markup {
    let lambdas = || Axis::fixed(0.0, 1.0, &[0.0, 0.25, 0.5, 0.75, 1.0]);
    let curve = |title: &str, style: &str, c: Option<&Curve>, of: fn(&Curve) -> &Vec<f64>| {
        c.and_then(|c| line(title, style, GRID.iter().zip(of(c)).map(|(x, y)| bare(*x, *y))))
    };
    let panel = |title: &str, factor: f64, unit: &str, truth: Option<&Curve>, alone: Option<&Curve>| {
        figure(
            title,
            &format!("without its factor, {}", number(factor)),
            ("λ", lambdas()),
            unit,
            false,
            vec![
                curve("nearest source rows", "m0", truth, |c| &c.nearest),
                curve("all source rows", "m1", truth, |c| &c.all),
                curve("nearest, by the data alone", "m0 again", alone, |c| &c.nearest),
                curve("all, by the data alone", "m1 again", alone, |c| &c.all),
            ],
        )
    };
    html! {
        (panel("Value discrepancy (Eq. 4)", b.value_factor(), "|ΔV|", b.value.as_ref(), b.value_alone.as_ref()))
        (panel("Transition dynamics (Eq. 3)", b.transition_factor(), "total variation", b.transition.as_ref(), b.transition_alone.as_ref()))
    }
}

fn table(d: &Diagnosis) -> Markup {
    let mut rows: Vec<(&str, String)> = Vec::new();
    if let Some(m) = &d.memorisation {
        rows.push((
            "Nearest training row: generated rows / rows of other episodes",
            format!("{} / {}", number(m.generated.median), number(m.held_out.median)),
        ));
        rows.push((
            "Probability that the generated row is the nearer one",
            format!("{:.2}{}", m.probability, if m.copied() { ", copies" } else { "" }),
        ));
    }
    let pair = |p: (f64, f64)| format!("{} / {}", number(p.0), number(p.1));
    let l = &d.labels;
    for (name, value) in [
        ("Action, RMSE on held-out target rows / their spread", l.held_out_action),
        ("Reward, RMSE on held-out target rows / their spread", l.held_out_reward),
        ("RMSE of action / reward at the source's states under the target's dynamics", l.at_source),
        ("RMSE of action / reward on true steps from generated states", l.at_generated),
    ] {
        rows.extend(value.map(|p| (name, pair(p))));
    }
    rows.extend(l.terminal.map(|t| ("Generated rows whose terminal flag is not the simulator's", percent(t))));
    rows.push(("Real target rows that the filter would reject", percent(d.sampled.real_rejected)));
    if let Some(at) = d.bounds_of_y.iter().find(|b| (b.y_max - d.y_max).abs() < 1e-9) {
        rows.push(("Generated rows that it rejects", percent(at.rejected)));
    }
    if let Some(b) = &d.theorem {
        for (text, curve) in [
            ("|ΔV| of generated / nearest 2.5 % / all source rows, by the simulator", &b.value),
            ("|ΔV| of generated / nearest 2.5 % / all source rows, by the data alone", &b.value_alone),
        ] {
            let Some(c) = curve else { continue };
            let all = c.all.last().copied().unwrap_or(f64::NAN);
            rows.push((text, format!("{} / {} / {}", number(c.generated), number(c.source[1]), number(all))));
        }
    }
    html! {
        div class="scroll" {
            table {
                thead { tr { th class="first" { "Copies, labels, filter" } th { "Figure" } } }
                tbody { @for (name, value) in &rows { tr { th scope="row" { (name) } td { (value) } } } }
            }
        }
    }
}

/// A run of TCE's mixture: its λ, its title and mean score.
struct Mixed {
    lambda: f64,
    title: String,
    score: f64,
    seeds: usize,
}

/// The study's mixtures of generated and nearest source rows on `task`.
fn mixtures(study: &Study, analysis: &Analysis, task: Task) -> Vec<Mixed> {
    let of = |(m, method): (usize, &crate::study::Method)| -> Option<Mixed> {
        let row = analysis.tables.iter().flat_map(|t| &t.rows).find(|r| r.task == task)?;
        let cell = row.cells[m].as_ref()?;
        let run = study.runs.iter().find(|r| r.task == task && r.method == method.id)?;
        let config: toml::Table = toml::from_str(&run.folder.config).ok()?;
        let mixture = config.get("mixture")?;
        let text = |key: &str| mixture.get(key).and_then(toml::Value::as_str);
        let lambda = match (text("generated")?, text("source")?) {
            ("tce", "none") => 0.0,
            ("tce", "nearest") => mixture.get("lambda")?.as_float()?,
            _ => return None,
        };
        // Ablations of another part say nothing of λ.
        ["tce-og", "tce-nn"].contains(&method.variant.as_str()).then(|| Mixed {
            lambda,
            title: method.title.clone(),
            score: cell.mean,
            seeds: cell.seeds,
        })
    };
    analysis.methods.iter().enumerate().filter_map(of).collect()
}

/// What the rule picks, beside what was best in hindsight.
fn lambdas(study: &Study, analysis: &Analysis, all: &[&Diagnosis]) -> Markup {
    let rows: Vec<(Task, Vec<&Diagnosis>)> = {
        let mut rows: Vec<(Task, Vec<&Diagnosis>)> = Vec::new();
        for d in all {
            if let (Some(task), Some(_)) = (d.task, &d.choice) {
                match rows.iter_mut().find(|(t, _)| *t == task) {
                    Some((_, list)) => list.push(d),
                    None => rows.push((task, vec![d])),
                }
            }
        }
        rows
    };
    if rows.is_empty() {
        return html! {};
    }
    let list = |values: Vec<String>| values.join(", ");
    html! {
        h3 { "λ from the data alone" }
        p {
            "The rule takes the λ with the least bound of Theorem 1 on values, measured by models of the target rows alone, and a smaller λ \
             where the difference is within its noise. In hindsight: the mixture of this study with the highest mean score."
        }
        div class="scroll" {
            table {
                thead { tr {
                    th class="first" { "Task" } th { "λ of the rule" } th { "Least bound at" } th { "|ΔV| generated" } th { "|ΔV| at the least" }
                    th class="edge text" { "Scores by λ" } th class="text" { "Best in hindsight" }
                } }
                tbody {
                    @for (task, diagnoses) in &rows {
                        @let choices: Vec<_> = diagnoses.iter().filter_map(|d| d.choice).collect();
                        @let mixed = mixtures(study, analysis, *task);
                        @let best = mixed.iter().max_by(|a, b| a.score.total_cmp(&b.score)).filter(|_| mixed.len() > 1);
                        tr {
                            th scope="row" { (short(task)) }
                            td { (list(choices.iter().map(|c| plain(c.lambda)).collect())) }
                            td { (list(choices.iter().map(|c| plain(c.least)).collect())) }
                            td { (list(choices.iter().map(|c| number(c.generated_alone)).collect())) }
                            td { (list(choices.iter().map(|c| number(c.least_bound)).collect())) }
                            td class="edge text" {
                                (list(mixed.iter().map(|m| format!("{} {}: {} ({})", m.title, plain(m.lambda), minus(format!("{:.1}", m.score)), counted(m.seeds, "seed", "seeds"))).collect()))
                            }
                            td class="text" { @match best { Some(m) => { "λ = " (plain(m.lambda)) ", " (m.title) }, None => "–" } }
                        }
                    }
                }
            }
        }
    }
}

fn explanation() -> Markup {
    html! {
        div class="note" {
            p {
                b { "Coverage. " } "A state of either domain is covered if a generated state lies within the distance of its "
                (NEIGHBOUR) "th nearest neighbour among the states of its own domain (Naeem et al. 2020); the paper does not define its \
                 curve. Equally many rows of the very same distribution would cover 97 %."
            }
            p {
                b { "Reliability. " } "Lines are medians, bands reach from the 10th to the 90th percentile. Abundant rows are what the \
                 simulator makes of states and actions of target, source and generated rows (a sample that is not measured). The kept and \
                 the rejected rows are two parts of one sample."
            }
            p {
                b { "Copies. " } "Rows are called copies if they lie nearer to a training row than rows of other episodes do with a probability above "
                (COPIES) " (after Meehan et al. 2020); one half is what a perfect generator gets."
            }
            p {
                b { "Theorem 1. " } "Expectations over ρ" sub { "mix" } " are means over rows. V is that of implicit Q-learning on target and generated \
                 rows. By the data alone, the target's dynamics are three models of the target rows; otherwise they are the simulator. In a \
                 deterministic world the total variation of sharp models is near 1 wherever they differ at all: the bound on values is the one \
                 that tells rows apart."
            }
        }
    }
}
