//! What `tce diagnose` found, as a section of the report and as a page of its own: the paper's Fig. 1a, Fig. 3, Appendix F, and
//! Theorem 1 over λ.

use maud::{Markup, html};
use tce_data::Task;
use tce_diagnosis::bounds::GRID;
use tce_diagnosis::coverage::NEIGHBOUR;
use tce_diagnosis::memorisation::BESIDE;
use tce_diagnosis::{
    AtBound, Bounds, Choice, Coverage, Curve, Diagnosis, Embedding, ErrorOverDistance, Group, Implied, Memorisation,
    Reliability, Spread,
};

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

fn y_axis(d: &Diagnosis) -> Axis {
    Axis::within(d.bounds_of_y.iter().map(|b| b.y_max), 5)
}

fn coverage(d: &Diagnosis) -> Markup {
    let over = |f: &dyn Fn(&AtBound) -> Option<f64>| {
        d.bounds_of_y.iter().map(|b| f(b).and_then(|v| bare(b.y_max, v))).collect::<Vec<_>>()
    };
    let without = |of: &dyn Fn(Coverage) -> Option<f64>| {
        let value = d.covered_by_target.and_then(of);
        d.bounds_of_y.iter().map(|b| value.and_then(|v| bare(b.y_max, v))).collect::<Vec<_>>()
    };
    let others =
        if d.covered_by_fresh { "the same by rows of other target episodes" } else { "the same by other target rows" };
    figure(
        "Coverage",
        "of states, by generated rows",
        ("y_max", y_axis(d)),
        "share",
        false,
        vec![
            line("target states", "m0", over(&|b| b.coverage.map(|c| c.target)).into_iter()),
            line(others, "f0", without(&|c| Some(c.target)).into_iter()),
            line("source states", "m1", over(&|b| b.coverage.and_then(|c| c.source)).into_iter()),
            line(others, "f1", without(&|c| c.source).into_iter()),
        ],
    )
}

fn copies(d: &Diagnosis) -> Markup {
    let over = |f: &dyn Fn(&Memorisation) -> f64| {
        d.bounds_of_y.iter().map(|b| b.memorisation.as_ref().and_then(|m| bare(b.y_max, f(m)))).collect::<Vec<_>>()
    };
    figure(
        "Copies",
        "rows that pass the filter, against held-out rows",
        ("y_max", y_axis(d)),
        "P(nearer to training rows)",
        false,
        vec![
            line("generated rows", "m0", over(&|m| m.probability).into_iter()),
            line("copies", "f1", over(&|m| m.of_copies).into_iter()),
            line("fresh rows", "f0", over(&|_| 0.5).into_iter()),
        ],
    )
}

fn reliability(d: &Diagnosis) -> Markup {
    let few = format!("{} against abundant target rows", d.target_rows);
    type Get = fn(&Reliability) -> Option<Spread>;
    let panels: [(&str, &str, &str, bool, Get); 5] = [
        ("Distance of ŝ", "to the nearest real state", "standard deviations", false, |r| r.distance),
        ("Transition KL", &few, "nats per dimension (logarithmic)", true, |r| r.transition_kl),
        ("Reward difference", &few, "|ΔR| (logarithmic)", true, |r| r.reward_difference),
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

/// Implied actions and their rollout, in a sentence and a table.
fn implied(i: &Implied) -> Markup {
    let groups = [("at rows that the generator saw", i.actions.trained), ("at rows held out", i.actions.held_out)];
    let groups = || groups.iter().filter_map(|(name, e)| e.map(|e| (name, e)));
    html! {
        p { (i.sentence()) }
        @if groups().next().is_some() {
            div class="scroll" {
                table {
                    thead { tr {
                        th class="first" { "Actions, RMS over rows and components" }
                        th { "one draw − behaviour" } th { "mean of draws − behaviour" } th { "between draws" }
                        th { "inferred from real s' − behaviour" } th { "spread of the behaviour" }
                    } }
                    tbody { @for (name, e) in groups() { tr {
                        th scope="row" { (name) " (" (counted(e.rows, "row", "rows")) ", " (counted(e.draws, "draw", "draws")) ")" }
                        @for v in [e.single, e.mean, e.between_draws, e.inverse, e.spread] { td { (number(v)) } }
                    } } }
                }
            }
        }
    }
}

/// Label error against distance.
fn distance(e: &ErrorOverDistance) -> Markup {
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
        true,
        vec![line(series, "m0", points)],
    )
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
            &format!("without its factor, {}", number(factor)),
            ("λ", lambdas()),
            unit,
            false,
            vec![
                curve("nearest source rows", "m0", truth, |c| &c.nearest),
                curve("all source rows", "m1", truth, |c| &c.all),
                doubted("nearest, by the data alone", "m0 again", alone),
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
    if let Some(m) = d.at_own_bound().and_then(|b| b.memorisation) {
        rows.push((
            "Nearest training row: generated rows / rows of other episodes",
            format!("{} / {}", number(m.generated.median), number(m.held_out.median)),
        ));
        rows.push((
            "Probability that the generated row is the nearer one",
            format!("{:.2} (fresh rows .5, copies {:.2})", m.probability, m.of_copies),
        ));
        rows.push(("Generated rows that are a training row", percent(m.identical)));
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
    if let Some(at) = d.at_own_bound() {
        rows.push(("Generated rows that it rejects", percent(at.rejected)));
    }
    if let Some(b) = &d.theorem {
        for (text, curve) in [
            ("|ΔV| of generated / nearest 2.5 % / all source rows, by the simulator", &b.value),
            ("|ΔV| of generated / nearest 2.5 % / all source rows, by the data alone", &b.value_alone),
        ] {
            let Some(c) = curve else { continue };
            let all = c.all.last().copied().unwrap_or(f64::NAN);
            let generated = c.generated.mean();
            rows.push((text, format!("{} / {} / {}", number(generated), number(c.source(1).mean()), number(all))));
        }
        if let Some(c) = &b.value_alone {
            let whole = c.source(GRID.len() - 1);
            let all = [c.generated.mean_doubt(), c.source(1).mean_doubt(), whole.mean_doubt()].map(number).join(" / ");
            rows.push((
                "Doubt of the latter: how far models that lack a third of the rows are apart, scaled by the next line",
                all,
            ));
        }
        let text = "|ΔV| of target rows by models that lack them / how far those are there from models that do not";
        rows.extend(b.held_out.map(|p| (text, pair(p))));
    }
    if let Some(c) = &d.choice {
        rows.push(("λ of the rule, from the data alone", c.to_string()));
    }
    if let Some(c) = &d.choice_by_simulator {
        rows.push(("λ of the rule where the simulator measures", c.to_string()));
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

/// A run of TCE's mixture: its λ, its title and mean score, and the configuration but for λ.
struct Mixed {
    rest: toml::Table,
    lambda: f64,
    title: String,
    score: f64,
    seeds: usize,
}

/// The study's mixtures of generated and nearest source rows on `task` that differ from the diagnosed run in λ alone; where that run is
/// not of the study, of its largest group.
fn mixtures(study: &Study, analysis: &Analysis, task: Task, d: &Diagnosis) -> Vec<Mixed> {
    let of = |(m, method): (usize, &crate::study::Method)| -> Option<Mixed> {
        let row = analysis.tables.iter().flat_map(|t| &t.rows).find(|r| r.task == task)?;
        let cell = row.cells[m].as_ref()?;
        let run = study.runs.iter().find(|r| r.task == task && r.method == method.id)?;
        let config: toml::Table = toml::from_str(&run.folder.config).ok()?;
        let mixture = config.get("mixture")?.clone();
        let text = |key: &str| mixture.get(key).and_then(toml::Value::as_str);
        let lambda = match (text("generated")?, text("source")?) {
            ("tce", "none") => 0.0,
            ("tce", "nearest") => mixture.get("lambda")?.as_float()?,
            _ => return None,
        };
        Some(Mixed {
            rest: without_mixture(config),
            lambda,
            title: method.title.clone(),
            score: cell.mean,
            seeds: cell.seeds,
        })
    };
    let own = study.runs.iter().find(|r| r.task == task && r.folder.directory.file_name().is_some_and(|n| *n == *d.of));
    let own = own.and_then(|r| toml::from_str(&r.folder.config).ok()).map(without_mixture);
    alike(analysis.methods.iter().enumerate().filter_map(of).collect(), own)
}

/// Those that differ in λ alone, from `own` if there is one: otherwise the most of one kind, those of the first method among equals. The
/// others say nothing of λ.
fn alike(all: Vec<Mixed>, own: Option<toml::Table>) -> Vec<Mixed> {
    let like = |rest: &toml::Table| all.iter().filter(|m| m.rest == *rest).count();
    // The first of the greatest: `max_by_key` takes the last.
    let largest = || all.iter().rev().max_by_key(|m| like(&m.rest)).map(|m| m.rest.clone());
    let Some(rest) = own.or_else(largest) else { return all };
    all.into_iter().filter(|m| m.rest == rest).collect()
}

/// Everything but what decides on source rows.
fn without_mixture(mut config: toml::Table) -> toml::Table {
    if let Some(mixture) = config.get_mut("mixture").and_then(toml::Value::as_table_mut) {
        mixture.remove("source");
        mixture.remove("lambda");
    }
    config
}

/// What the rule picks, beside what was best in hindsight.
fn lambdas(study: &Study, analysis: &Analysis, all: &[&Diagnosis]) -> Markup {
    let rows: Vec<(Task, &Diagnosis, &Choice)> =
        all.iter().filter_map(|d| Some((d.task?, *d, d.choice.as_ref()?))).collect();
    if rows.is_empty() {
        return html! {};
    }
    html! {
        h3 { "λ from the data alone" }
        p {
            "The rule takes the λ with the least bound of Theorem 1 on values, measured by models of the target rows alone. Where the bounds \
             differ by no more than these models and the samples are in doubt, it cannot tell, and λ = 0 stands by default. Beside it, what the simulator \
             would have said, and in hindsight the mixture of this study with the highest mean score, where there are two that differ in \
             λ alone."
        }
        div class="scroll" {
            table {
                thead { tr {
                    th class="first" { "Task" } th class="text" { "Diagnosis" } th class="text" { "λ of the rule" } th { "Least bound at" } th class="text" { "By the simulator" }
                    th class="edge text" { "Scores by λ" } th class="text" { "Best in hindsight" }
                } }
                tbody {
                    @for (task, d, choice) in &rows {
                        @let mixed = mixtures(study, analysis, *task, d);
                        @let several = mixed.iter().any(|m| m.lambda != mixed[0].lambda);
                        @let best = mixed.iter().max_by(|a, b| a.score.total_cmp(&b.score)).filter(|_| several);
                        tr {
                            th scope="row" { (short(task)) }
                            td class="text" { (d.of) ", seed " (d.seed) }
                            td class="text" { (choice.to_string()) }
                            td { (plain(choice.least)) }
                            td class="text" { (d.choice_by_simulator.as_ref().map_or("–".into(), Choice::to_string)) }
                            td class="edge text" {
                                @for m in &mixed {
                                    div { (m.title) ", λ = " (plain(m.lambda)) ": " (minus(format!("{:.1}", m.score))) " (" (counted(m.seeds, "seed", "seeds")) ")" }
                                }
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
                 curve. All sets have the same number of rows, so that rows of the very same distribution cover 97 %. What is covered of the \
                 target is one half of its rows, and the covering target rows are of the other half: whole episodes where they can be split \
                 evenly. The generator saw both."
            }
            p {
                b { "Reliability. " } "Lines are medians, bands reach from the 10th to the 90th percentile. Abundant rows are what the \
                 simulator makes of states and actions of target, source and generated rows (a sample that is not measured). The kept and \
                 the rejected rows are two parts of one sample."
            }
            p {
                b { "Copies. " } "The rows of every episode, and as large a share of the generated rows, are measured by their nearest training row of \
                 the other episodes (after Meehan et al. 2020). P is the probability that the generated row is the nearer one: one half for \
                 fresh rows. Rows are called copies from half the way between that and what copies get, and beside the data below "
                (BESIDE) ". Exact copies are counted as well. Where every episode is a place of its own, fresh rows get the P of copies."
            }
            p {
                b { "Implied policy. " } "At a real target state s the generator draws a successor ŝ', and the inverse dynamics model infers \
                 the action that leads there. Whoever learns from generated rows imitates these actions: rows may agree with the physics \
                 and still belong to a behaviour that nobody had. The difference holds the noise of the behaviour's own actions, which \
                 no generator can foresee; a draw of exactly the behaviour's noise is √2 times as far from it as the noise is wide. Networks \
                 that were trained too briefly draw actions that are farther apart than the behaviour's, and the rollout scores less."
            }
            p {
                b { "Label error against distance. " } "Rows that pass the filter under all y_max together, in bins of as many rows each; the \
                 line is the median of a bin, the band reaches from the 10th to the 90th percentile. The unit of distance is the median distance of a \
                 target state to the nearest one of another episode. The error is the difference between the generated successor and what \
                 the simulator does at (ŝ, â), in units of the spread of the target's steps: 1 is as wrong as a whole step. Without a \
                 simulator it is how far models that lack a third of the target rows each are apart."
            }
            p {
                b { "Theorem 1. " } "Expectations over ρ" sub { "mix" } " are means over source rows for the first term and over generated rows for the \
                 second; V at one generated successor stands for its expectation, so that the second is an upper estimate. V is that of implicit Q-learning on target and generated \
                 rows. By the data alone, the target's dynamics are models of the target rows: for values three that lack a third of the \
                 rows each, whole episodes where they are even enough, V at the step that they predict, and for total variation one of all rows. Otherwise they are the simulator, and \
                 for total variation a model of abundant rows. The band is the doubt: the rule tells a λ from 0 where \
                 the bound at 0 lies outside of it. It holds the errors of finite samples, in which every trajectory counts once, for nine \
                 comparisons at once, and for values how far the three models are apart; for total variation, samples alone. In a \
                 deterministic world the total variation of sharp models is near 1 wherever they differ at all: the bound on values is the one \
                 that tells rows apart."
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hindsight_compares_what_differs_in_lambda_alone() {
        let mixed = |title: &str, config: &str| Mixed {
            rest: without_mixture(toml::from_str(config).unwrap()),
            lambda: 0.0,
            title: title.into(),
            score: 0.0,
            seeds: 1,
        };
        let titled = |all, own| alike(all, own).into_iter().map(|m| m.title).collect::<Vec<_>>();
        let titles = |all| titled(all, None);
        let og =
            || mixed("og", "generator.y_max = 0.2\nmixture = { generated = 'tce', source = 'none', lambda = 0.0 }");
        let nn =
            || mixed("nn", "generator.y_max = 0.2\nmixture = { generated = 'tce', source = 'nearest', lambda = 0.1 }");
        let wide =
            || mixed("wide", "generator.y_max = 0.5\nmixture = { generated = 'tce', source = 'none', lambda = 0.0 }");
        let weighed = || {
            mixed(
                "x",
                "generator.y_max = 0.2\nmixture = { generated = 'tce', source = 'none', lambda = 0.0, weight = 2 }",
            )
        };
        assert_eq!(titles(vec![wide(), og(), weighed(), nn()]), ["og", "nn"]);
        assert_eq!(titles(vec![wide(), og()]), ["wide"], "nothing to compare");
        assert!(titles(vec![]).is_empty());
        // The diagnosed run's own kind, however many there are of others.
        assert_eq!(titled(vec![wide(), og(), nn()], Some(wide().rest)), ["wide"]);
    }
}
