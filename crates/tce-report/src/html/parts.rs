//! What several sections are made of: the page around them, numbers as text, colours of methods.

use maud::{DOCTYPE, Markup, PreEscaped, html};
use tce_data::Task;

use super::words;
use crate::analysis::Analysis;
use crate::stats::Estimate;
use crate::study::{shift_title, short};
use crate::svg::{Axis, Series, minus};

/// A whole page around `body`, with the words that it links to explained at its end.
pub(crate) fn document(title: &str, body: Markup) -> String {
    let words = words::list(&body.0);
    let markup = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                // The page promises to need no network: the browser holds it to that.
                meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'";
                title { (title) }
                style { (PreEscaped(include_str!("../page.css"))) }
            }
            body {
                main {
                    (body)
                    section id="words" { h2 { "Words" } (words) }
                    footer class="note" { "Made by " (concat!("tce ", env!("CARGO_PKG_VERSION"))) "." }
                }
            }
        }
    };
    markup.into_string()
}

pub(crate) fn one(value: f64) -> String {
    minus(format!("{value:.1}"))
}

pub(crate) fn range(interval: Option<(f64, f64)>, decimals: usize) -> String {
    interval.map_or_else(String::new, |(low, high)| {
        minus(format!("[{low:.decimals$}")) + &minus(format!(", {high:.decimals$}]"))
    })
}

pub(crate) fn estimate(e: &Estimate, decimals: usize) -> Markup {
    html! { (minus(format!("{:.decimals$}", e.point))) " " small { (range(e.interval, decimals)) } }
}

/// With a capital letter.
pub(crate) fn capital(text: &str) -> String {
    let mut rest = text.chars();
    rest.next().map_or_else(String::new, |first| first.to_uppercase().chain(rest).collect())
}

/// With its sign.
pub(crate) fn signed(value: f64) -> String {
    if value > 0.0 { format!("+{value:.1}") } else { one(value) }
}

pub(crate) fn said(e: &Estimate, decimals: usize) -> String {
    format!("{} {}", minus(format!("{:.decimals$}", e.point)), range(e.interval, decimals)).trim_end().to_owned()
}

/// Colour and dashes of every method: baselines are grey.
pub(crate) fn classes(analysis: &Analysis) -> Vec<Series> {
    let (mut baselines, mut others) = (0, 0);
    let class = |m: &crate::study::Method| {
        let (count, letter, hues) = if m.baseline { (&mut baselines, 'f', 5) } else { (&mut others, 'm', 8) };
        let k = *count;
        *count += 1;
        let again = if k >= hues { " again" } else { "" };
        Series { title: m.title.clone(), class: format!("{letter}{}{again}", k % hues) }
    };
    analysis.methods.iter().map(class).collect()
}

pub(crate) fn title_cell(analysis: &Analysis, m: usize) -> Markup {
    html! {
        (analysis.methods[m].title)
        @if analysis.needs_mark(m) { " " span class="badge" { "published mode" } }
    }
}

/// The caption of a task's figure; with the shift, where the report has several.
pub(crate) fn task_caption(analysis: &Analysis, task: &Task) -> Markup {
    html! {
        figcaption {
            (short(task))
            @if analysis.tables.len() > 1 { br; span { (shift_title(task.shift)) } }
        }
    }
}

pub(crate) fn percent(analysis: &Analysis) -> String {
    format!("{:.0} %", 100.0 * analysis.level)
}

/// An axis of whole powers of ten.
pub(crate) fn decades(exponents: impl Iterator<Item = f64>) -> Axis {
    let (low, high) = exponents.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
    let (low, high) = if low > high { (0.0, 1.0) } else { (low.floor(), high.ceil().max(low.floor() + 1.0)) };
    let step = ((high - low) / 5.0).ceil().max(1.0);
    let ticks: Vec<f64> = (0..=((high - low) / step) as usize).map(|k| low + k as f64 * step).collect();
    Axis::fixed(low, high, &ticks)
}

/// `2 h 05 min`, `18 min`, `42 s`.
pub(crate) fn duration(seconds: f64) -> String {
    match seconds {
        s if s >= 3600.0 => format!("{:.0} h {:02.0} min", (s / 3600.0).floor(), (s % 3600.0 / 60.0).floor()),
        s if s >= 600.0 => format!("{:.0} min", s / 60.0),
        s if s >= 60.0 => format!("{:.1} min", s / 60.0),
        s if s >= 10.0 => format!("{s:.0} s"),
        s => format!("{s:.1} s"),
    }
}
