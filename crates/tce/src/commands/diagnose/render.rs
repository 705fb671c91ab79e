//! A diagnosis in a terminal of 80 columns.

use std::path::PathBuf;

use tce_diagnosis::advice::percent;
use tce_diagnosis::{AtBound, Diagnosis, Reliability, Spread};

use crate::output::{prose, table};

/// What to do with the rows, the metrics behind it, and where the rest is.
pub fn render(d: &Diagnosis, files: &[PathBuf]) -> String {
    let mut parts = Vec::new();
    let mut advice = prose(&d.advice().to_string(), 0);
    advice.extend(d.choice.iter().map(|c| format!("\n{}", prose(&c.sentence(), 0))));
    parts.push(advice);
    parts.push(format!("{}, seed {}, {} generated rows behind every metric", d.of, d.seed, d.rows));
    parts.push(reach(d));
    parts.push(errors(d));
    parts.push(rest(d));
    parts.extend((!d.notes.is_empty()).then(|| {
        let notes: Vec<String> = d.notes.iter().map(|n| prose(&format!("note: {n}"), 2)).collect();
        notes.join("\n")
    }));
    parts.push(files.iter().map(|f| f.display().to_string()).collect::<Vec<_>>().join("\n"));
    parts.join("\n\n") + "\n"
}

/// `0.2 (own)`
fn bound(d: &Diagnosis, b: &AtBound) -> String {
    if (b.y_max - d.y_max).abs() < 1e-9 { format!("{} (own)", b.y_max) } else { b.y_max.to_string() }
}

/// Shares over y_max, and what would be good.
fn reach(d: &Diagnosis) -> String {
    let filtered = d.z_threshold.is_some();
    let share = |s: Option<f64>| s.map_or("-".into(), percent);
    let rows = d.bounds_of_y.iter().map(|b| {
        [
            bound(d, b),
            share(b.coverage.map(|c| c.target)),
            share(b.coverage.and_then(|c| c.source)),
            if filtered { percent(b.rejected) } else { "none".into() },
            share(b.memorisation.map(|m| m.probability)),
        ]
    });
    let copies = d.at_own_bound().and_then(|b| b.memorisation);
    let good = [
        "good".to_owned(),
        share(d.covered_by_target.map(|c| c.target)),
        d.covered_by_target.and_then(|c| c.source).map_or("-".into(), |s| format!("above {}", percent(s))),
        if filtered { percent(d.sampled.real_rejected) } else { "-".into() },
        copies.map_or("-".into(), |m| format!("50 %, copies {}", percent(m.of_copies))),
    ];
    let header = ["y_max", "target reached", "source reached", "rejected", "nearer than fresh"];
    let second = if d.covered_by_fresh { "other target episodes" } else { "other target rows" };
    let text = format!(
        "Shares, by how far rows reach towards the source (y_max). Reached: real states with a generated one near; good is what {second} \
         reach. Rejected: by the filter, if there is one; good is its share of real target rows. Nearer than fresh: how often a generated row is nearer to a \
         training row than a held-out row is.",
    );
    format!("{}\n{}", prose(&text, 0), table(&header, rows.chain([good])))
}

/// Errors over y_max, of kept rows and of rejected ones.
fn errors(d: &Diagnosis) -> String {
    let metric = |s: Option<Spread>| s.map_or("-".into(), |s| format!("{:.3}", s.median));
    let row = |b: &AtBound, name: &str, r: &Reliability| {
        let metrics = [r.distance, r.transition_kl, r.reward_difference, r.reward_error, r.consistency];
        std::iter::once(format!("{}{name}", bound(d, b))).chain(metrics.map(metric)).collect::<Vec<_>>()
    };
    let rows = d.bounds_of_y.iter().flat_map(|b| {
        let rejected = b.outliers.as_ref().map(|r| row(b, ", rejected", r));
        std::iter::once(row(b, "", &b.kept)).chain(rejected)
    });
    let distance = d.error_over_distance.as_ref().filter(|e| e.by_episode);
    let good = ["good".to_owned(), distance.map_or("-".into(), |e| format!("{:.3}", e.unit))]
        .into_iter()
        .chain(std::iter::repeat_n("0".to_owned(), 4));
    let header = ["y_max", "distance", "KL", "reward model", "reward error", "step error"];
    let text = "Medians. Distance: to the nearest real state, in standard deviations; good is what other target episodes have, and larger \
                is farther into the unknown. KL and reward model: how far models of few and of many target rows differ. Reward and step \
                error: beside the simulator; a step error of 1 is a whole step.";
    format!("{}\n{}", prose(text, 0), table(&header, rows.chain([good.collect()])))
}

/// What is a sentence.
fn rest(d: &Diagnosis) -> String {
    let mut lines = Vec::new();
    lines.extend(d.at_own_bound().and_then(|b| b.memorisation).map(|m| format!("copies: {m}")));
    lines.extend(d.implied.as_ref().map(|i| format!("implied policy: {}", i.sentence())));
    if let Some((first, last)) = d.error_over_distance.as_ref().and_then(|e| e.bins.first().zip(e.bins.last())) {
        lines.push(format!(
            "label error against distance: {:.3} usual steps at {:.1} times the usual distance between target states, {:.3} at {:.1} times \
             (medians)",
            first.error.median, first.distance, last.error.median, last.distance
        ));
    }
    lines.extend(d.choice.as_ref().map(|c| {
        format!(
            "share of source rows (λ), from the data alone: {c}; least discrepancy of values {:.4} at λ = {}, with generated rows alone \
             {:.4}",
            c.least_bound, c.least, c.generated_alone
        )
    }));
    lines.extend(d.choice_by_simulator.as_ref().map(|c| format!("λ by the simulator: {c}")));
    lines.iter().map(|l| prose(l, 2)).collect::<Vec<_>>().join("\n")
}
