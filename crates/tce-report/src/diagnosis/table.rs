//! The tables of a diagnosis.

use maud::{Markup, html};
use tce_base::counted;
use tce_diagnosis::advice::percent;
use tce_diagnosis::bounds::GRID;
use tce_diagnosis::memorisation::BESIDE;
use tce_diagnosis::{Bounds, Diagnosis, Implied};

use super::numbers::{number, plain};
use crate::svg::minus;

/// Errors of implied actions in a table.
pub(super) fn implied(i: &Implied) -> Markup {
    let groups = [("at rows that the generator saw", i.actions.trained), ("at rows held out", i.actions.held_out)];
    let groups = || groups.iter().filter_map(|(name, e)| e.map(|e| (name, e)));
    html! {
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

/// A row of the table: what it is, what was found, and what would be good.
type Assessed = (String, String, String);

/// Shares and errors, each beside what would be good.
fn assessed(d: &Diagnosis) -> Vec<Assessed> {
    let mut rows = coverage(d);
    let mut row = |what: &str, here: String, good: String| rows.push((what.to_owned(), here, good));
    if let Some(m) = d.at_own_bound().and_then(|b| b.memorisation) {
        row(
            "Comparisons in which a generated row is nearer to a training row than a real row of another episode is",
            percent(m.probability),
            format!(
                "about 50 %; copies would have {}; below {} they lie beside the data",
                percent(m.of_copies),
                percent(BESIDE)
            ),
        );
        row("Generated rows that are a training row", percent(m.identical), "0 %".into());
    }
    if let Some(at) = d.at_own_bound() {
        if d.z_threshold.is_some() {
            row(
                "Generated rows that the filter rejects",
                percent(at.rejected),
                format!("about {}, its share of real target rows", percent(d.sampled.real_rejected)),
            );
        }
        if let Some(s) = at.kept.consistency {
            row(
                "Error of a step beside the simulator, in usual steps (median)",
                number(s.median),
                "0; 1 is as wrong as a whole step".into(),
            );
        }
    }
    if let Some((mean, std)) = d.implied.as_ref().and_then(|i| i.rollout.as_ref()?.score) {
        row(
            "Score of the policy that the rows teach",
            minus(format!("{mean:.1} ± {std:.1}")),
            d.implied
                .as_ref()
                .and_then(|i| i.behaviour_score)
                .map_or("–".into(), |s| format!("{s:.1}: the target data's")),
        );
    }
    rows.extend(labels(d));
    rows
}

/// How much of both domains generated rows reach.
fn coverage(d: &Diagnosis) -> Vec<Assessed> {
    let mut rows: Vec<Assessed> = Vec::new();
    let mut row = |what: &str, here: String, good: String| rows.push((what.to_owned(), here, good));
    let second = if d.covered_by_fresh { "other target episodes" } else { "the same target episodes" };
    let mut bounds = vec![d.y_max];
    if d.y_max != 0.0 {
        bounds.push(0.0);
    }
    for y in bounds {
        let Some(c) = d.at(y).and_then(|b| b.coverage) else { continue };
        let good = d.covered_by_target;
        row(
            &format!("Target states reached, y_max = {}", plain(y)),
            percent(c.target),
            good.map_or("–".into(), |g| format!("{}, which as many rows of {second} reach", percent(g.target))),
        );
        if let Some(source) = c.source {
            row(
                &format!("Source states reached, y_max = {}", plain(y)),
                percent(source),
                good.and_then(|g| g.source).map_or("–".into(), |s| {
                    format!("more than {}, which as many rows of {second} reach", percent(s))
                }),
            );
        }
    }
    rows
}

/// Errors of the label models.
fn labels(d: &Diagnosis) -> Vec<Assessed> {
    let mut rows: Vec<Assessed> = Vec::new();
    let mut row = |what: &str, here: String, good: String| rows.push((what.to_owned(), here, good));
    let l = &d.labels;
    for (what, value) in [("action", l.held_out_action), ("reward", l.held_out_reward)] {
        if let Some((error, spread)) = value {
            row(
                &format!("RMSE of the inferred {what} on held-out target rows"),
                number(error),
                format!("far below {}, the spread of the {what}s", number(spread)),
            );
        }
    }
    for (place, value) in [
        ("true steps from generated states", l.at_generated),
        ("the source's states under the target's dynamics", l.at_source),
    ] {
        for (what, error, own) in
            value.into_iter().flat_map(|(a, r)| [("action", a, l.held_out_action), ("reward", r, l.held_out_reward)])
        {
            row(
                &format!("RMSE of the inferred {what} on {place}"),
                number(error),
                own.map_or("–".into(), |(e, _)| format!("near {}, that on held-out target rows", number(e))),
            );
        }
    }
    if let Some(t) = l.terminal {
        row("Generated rows whose terminal flag is not the simulator's", percent(t), "0 %".into());
    }
    rows
}

/// [`assessed`] as a table.
pub(super) fn figures_and_good(d: &Diagnosis) -> Markup {
    html! {
        div class="scroll" {
            table class="assessed" {
                thead { tr { th class="first" { "Figure" } th { "Here" } th class="text" { "Good" } } }
                tbody {
                    @for (what, here, good) in assessed(d) {
                        tr { th scope="row" { (what) } td { (here) } td class="text" { (good) } }
                    }
                }
            }
        }
    }
}

/// The bounds of Theorem 1 in numbers, and the λ that they speak for.
pub(super) fn bounds_table(d: &Diagnosis, b: &Bounds) -> Markup {
    let mut rows: Vec<(&str, String)> = Vec::new();
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
    rows.extend(b.held_out.map(|(gap, doubt)| (text, format!("{} / {}", number(gap), number(doubt)))));
    rows.extend(d.choice.as_ref().map(|c| ("λ of the rule, from the data alone", c.to_string())));
    rows.extend(d.choice_by_simulator.as_ref().map(|c| ("λ of the rule where the simulator measures", c.to_string())));
    html! {
        div class="scroll" {
            table class="assessed" {
                thead { tr { th class="first" { "|ΔV|: difference of the values of two next states" } th { "Figure" } } }
                tbody { @for (name, value) in &rows { tr { th scope="row" { (name) } td { (value) } } } }
            }
        }
    }
}
