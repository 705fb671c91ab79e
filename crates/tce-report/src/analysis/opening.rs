//! What came out, in sentences: the gap first, the doubt after it.

use std::collections::BTreeMap;

use super::{Aggregate, Analysis, Comparison, Finding, Recommendation};
use crate::stats::mean_of;
use crate::study::{order, short};

/// Gaps below this print as 0.0.
const LEVEL: f64 = 0.05;

/// A small number in words.
fn words(n: usize) -> String {
    const WORDS: [&str; 11] = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"];
    WORDS.get(n).map_or_else(|| n.to_string(), |w| (*w).to_owned())
}

/// `two seeds`, `1 to 3 seeds`: of the method and the baseline, whichever has fewer or more.
fn seeds(a: &Aggregate, baseline: &Aggregate) -> String {
    match (a.seeds.0.min(baseline.seeds.0), a.seeds.1.max(baseline.seeds.1)) {
        (1, 1) => "one seed".into(),
        (least, most) if least == most => format!("{} seeds", words(least)),
        (least, most) => format!("{least} to {most} seeds"),
    }
}

/// `94.9 points below`, `level with`: where a score lies that is `gap` points above another.
pub fn gap_words(gap: f64) -> String {
    let size = gap.abs();
    let unit = if format!("{size:.1}") == "1.0" { "point" } else { "points" };
    match gap {
        _ if size < LEVEL => "level with".into(),
        g if g > 0.0 => format!("{size:.1} {unit} above"),
        _ => format!("{size:.1} {unit} below"),
    }
}

/// Whether that gap is more than chance, as the end of a sentence: `two seeds cannot prove it`. None for baselines.
pub fn verdict_words(c: &Comparison, a: &Aggregate) -> Option<String> {
    let (estimate, finding) = c.improvement(a)?;
    let (gap, seeds) = (c.gap(a)?, seeds(a, c.standard()?));
    let it = if gap.abs() < LEVEL { "a difference" } else { "it" };
    let p = match a.p_value {
        Some(p) if p < 0.001 => " (p < 0.001)".to_owned(),
        Some(p) => format!(" (p = {p:.3})"),
        None => String::new(),
    };
    // Means and single runs can disagree: a few very bad runs pull a mean down that is otherwise ahead.
    let pairs = |only: &str| {
        let count = format!("{:.0} of 100", 100.0 * estimate.point);
        format!("yet its run is the higher one in {only}{count} pairs of runs, and that is more than chance{p}")
    };
    Some(match finding {
        Finding::Better if gap >= 0.0 => format!("that is more than chance{p}"),
        Finding::Worse if gap <= 0.0 => format!("that is more than chance{p}"),
        Finding::Better => pairs(""),
        Finding::Worse => pairs("only "),
        Finding::Open | Finding::Few | Finding::Unknown => format!("{seeds} cannot prove {it}"),
    })
}

/// One method against the best baseline.
fn against(analysis: &Analysis, c: &Comparison, a: &Aggregate) -> Option<String> {
    let baseline = c.standard()?;
    let title = |m: usize| analysis.methods[m].title.as_str();
    let (own, other) = (a.over_seeds[0].point, baseline.over_seeds[0].point);
    Some(format!(
        "{} is {} the best baseline, {} ({own:.1} against {other:.1}); {}.",
        title(a.method),
        gap_words(c.gap(a)?),
        title(baseline.method),
        verdict_words(c, a)?,
    ))
}

/// How many methods are what, where there are several.
fn counts(analysis: &Analysis, c: &Comparison, compared: &[(&Aggregate, Finding)]) -> String {
    let named = |of: &dyn Fn(Finding) -> bool| -> Vec<&str> {
        compared.iter().filter(|j| of(j.1)).map(|j| analysis.methods[j.0.method].title.as_str()).collect()
    };
    let part = |names: Vec<&str>, one: &str, many: &str| match names.len() {
        0 => None,
        n => Some(format!("{} {} ({})", words(n), if n == 1 { one } else { many }, names.join(", "))),
    };
    let parts: Vec<String> = [
        part(named(&|f| f == Finding::Better), "is shown to beat it", "are shown to beat it"),
        part(named(&|f| f == Finding::Worse), "is shown to fall short of it", "are shown to fall short of it"),
        part(
            named(&|f| !matches!(f, Finding::Better | Finding::Worse)),
            "is not proved to differ from it",
            "are not proved to differ from it",
        ),
    ]
    .into_iter()
    .flatten()
    .collect();
    let baseline = c.standard().map_or("", |f| analysis.methods[f.method].title.as_str());
    let parts = match &parts[..] {
        [rest @ .., last] if !rest.is_empty() => format!("{}, and {last}", rest.join(", ")),
        _ => parts.join(""),
    };
    format!("Of {} methods compared with {baseline}, {parts}.", words(compared.len()))
}

/// What the recommended policies came to.
fn recommended(all: &[Recommendation]) -> Option<String> {
    let scored: Vec<(&Recommendation, f64, f64)> =
        all.iter().filter_map(|r| Some((r, r.score?, r.regret()?))).collect();
    match &scored[..] {
        [] => None,
        [(r, score, regret)] => {
            let best = match &r.best {
                Some(best) if *regret >= LEVEL => format!(
                    "The best policy here scores {:.1} ({}, seed {}): a regret of {regret:.1} points.",
                    best.score, best.method, best.seed
                ),
                _ => "No policy here scores more: its regret is 0.".into(),
            };
            let doubt = if r.sure { "" } else { " The recommendation was not sure." };
            let seed = r.seed.map_or(String::new(), |s| format!(", seed {s}"));
            Some(format!(
                "On {} the recommended policy is that of {}{seed}. It scores {score:.1}. {best}{doubt}",
                short(&r.task),
                r.method
            ))
        }
        many => {
            // Every task counts the same, however many recommendations it has.
            let mut by_task: BTreeMap<_, Vec<(f64, f64)>> = BTreeMap::new();
            many.iter()
                .for_each(|(r, score, regret)| by_task.entry(order(&r.task)).or_default().push((*score, *regret)));
            let mean = |f: fn(&(f64, f64)) -> f64| mean_of(by_task.values().map(|own| mean_of(own.iter().map(f))));
            let of = match (many.len(), by_task.len()) {
                (all, tasks) if all == tasks => format!("The recommended policies of {tasks} tasks score"),
                (all, 1) => format!("The {all} recommended policies of one task score"),
                (all, tasks) => format!("The {all} recommended policies of {tasks} tasks score"),
            };
            Some(format!(
                "{of} {:.1} on average. The best policies there to choose from score {:.1} points more on average: that is their \
                 mean regret.",
                mean(|r| r.0),
                mean(|r| r.1)
            ))
        }
    }
}

/// The result in a few sentences.
pub fn opening(analysis: &Analysis) -> Vec<String> {
    let first = |text: &str| vec![text.to_owned()];
    let Some(c) = &analysis.comparison else { return first("No run has a score.") };
    let Some(baseline) = c.standard() else {
        return first("There is no baseline to compare with: without one a score says little.");
    };
    let mut compared: Vec<(&Aggregate, Finding)> =
        c.methods.iter().filter_map(|a| Some((a, c.improvement(a)?.1))).collect();
    compared.sort_by(|a, b| b.0.over_seeds[0].point.total_cmp(&a.0.over_seeds[0].point));
    let mut out = match &compared[..] {
        [] if analysis.methods.iter().all(|m| m.baseline) => {
            let score = baseline.over_seeds[0].point;
            vec![format!(
                "Only baselines were run. The best of them is {}: {score:.1}.",
                analysis.methods[baseline.method].title
            )]
        }
        [] => first("No method can be compared with the baselines: they share no task with scores."),
        [(only, _)] => against(analysis, c, only).into_iter().collect(),
        [(highest, _), ..] => {
            let mut text: Vec<String> = against(analysis, c, highest).into_iter().collect();
            text.push(counts(analysis, c, &compared));
            text
        }
    };
    out.extend(recommended(&analysis.recommendations));
    out
}
