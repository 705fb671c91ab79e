//! One figure that tells where a method helps, does nothing, harms.

use maud::{Markup, html};
use tce_base::counted;
use tce_data::{Quality, Shift};

use super::{capital, one, signed, term, title_cell};
use crate::analysis::{Analysis, Gap};
use crate::difference::{Difference, ENOUGH, Effect, LEAST, SURE};
use crate::stats::Estimate;
use crate::study::agent_title;
use crate::svg::{self, Axis, Interval, Series};

/// A panel for every method, a dot for every task; None without a method that has a baseline beside it.
pub(super) fn effects(analysis: &Analysis) -> Option<Markup> {
    let gaps = &analysis.gaps;
    if gaps.is_empty() {
        return None;
    }
    let methods: Vec<usize> = (0..analysis.methods.len()).filter(|m| gaps.iter().any(|g| g.method == *m)).collect();
    let of = |m: usize| gaps.iter().filter(move |g| g.method == m);
    let ends = gaps.iter().flat_map(|g| {
        let reach = SURE * g.difference.error.unwrap_or(0.0);
        [g.difference.points - reach, g.difference.points + reach, 0.0]
    });
    let axis = Axis::around(ends, 5);
    Some(html! {
        p {
            "How many points a method is above the best " (term("baseline", "baseline")) " of each task, the one with the highest mean there. \
             Bars are two standard errors over " (term("seed", "seeds")) " to either side; a dot without one has a single seed. A method helps or harms \
             where the difference is more than " (SURE) " standard errors and at least " (one(LEAST)) " point, with at least " (ENOUGH) " seeds of \
             either; with fewer it is not shown."
        }
        div class="scroll" {
            table {
                thead { tr {
                    th class="first" { "Method" } th { "Tasks" }
                    @for effect in Effect::ALL { th { (capital(effect.word())) } }
                    th { "Mean difference" } th { "Worst" } th { "Best" }
                } }
                tbody { @for &m in &methods {
                    @let points: Vec<f64> = of(m).map(|g| g.difference.points).collect();
                    tr {
                        th scope="row" { (title_cell(analysis, m)) }
                        td { (points.len()) }
                        @for effect in Effect::ALL { td { (of(m).filter(|g| g.difference.effect == effect).count()) } }
                        td { (signed(points.iter().sum::<f64>() / points.len() as f64)) }
                        td { (signed(points.iter().copied().fold(f64::MAX, f64::min))) }
                        td { (signed(points.iter().copied().fold(f64::MIN, f64::max))) }
                    }
                } }
            }
        }
        div class="keys" { @for effect in Effect::ALL { (svg::dot_key(&Series { title: effect.word().into(), class: class(effect).into() })) } }
        div class="panels" {
            @for &m in &methods {
                @let rows: Vec<Interval> = of(m).map(row).collect();
                figure {
                    figcaption { (analysis.methods[m].title) " " span { (counted(rows.len(), "task", "tasks")) } }
                    (svg::intervals(&format!("{} above the best baseline", analysis.methods[m].title), &rows, &axis,
                        "points above the best baseline", Some(0.0), 1))
                }
            }
        }
    })
}

fn class(effect: Effect) -> &'static str {
    match effect {
        Effect::Helps => "helps",
        Effect::Harms => "harms",
        Effect::Open => "open",
        Effect::FewSeeds => "f3",
    }
}

fn row(gap: &Gap) -> Interval {
    let Difference { points, error, effect, .. } = gap.difference;
    let reach = error.map(|e| SURE * e);
    Interval {
        series: Series { title: name(gap), class: class(effect).into() },
        inner: Estimate { point: points, interval: reach.map(|r| (points - r, points + r)) },
        outer: None,
    }
}

/// The task in few letters: `Cheetah kin. m→e`.
fn name(gap: &Gap) -> String {
    let shift = match gap.task.shift {
        Shift::Source => "",
        Shift::Morph => "morph",
        Shift::Kinematic => "kin.",
        Shift::Gravity => "grav.",
        Shift::Gravity5 => "grav. ×5",
    };
    let robot = agent_title(gap.task.agent).replace("HalfCheetah", "Cheetah");
    let quality = |q: Quality| q.to_string().split('-').filter_map(|w| w.chars().next()).collect::<String>();
    format!("{robot} {shift} {}→{}", quality(gap.task.source), quality(gap.task.target))
}
