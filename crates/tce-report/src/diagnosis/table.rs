//! The tables of a diagnosis.

use maud::{Markup, html};
use tce_diagnosis::bounds::GRID;
use tce_diagnosis::{Diagnosis, Implied};

use super::{number, percent};
use crate::html::counted;

/// Implied actions and their rollout, in a sentence and a table.
pub(super) fn implied(i: &Implied) -> Markup {
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

pub(super) fn table(d: &Diagnosis) -> Markup {
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
