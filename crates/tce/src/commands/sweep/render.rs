//! How far a sweep is and what came out of it, as text.

use std::collections::BTreeMap;

use tce_base::{counted, plus_minus};
use tce_report::analysis::DIVERGED;
use tce_run::sweep::Kind;
use tce_run::sweep::gather::Gathered;
use tce_run::sweep::status::Status;
use tce_run::variant::Variant;

use crate::conclusion::{Role, Scored, Tally};
use crate::output::{mark_best, table};

/// As a text for a terminal.
pub fn status(status: &Status) -> String {
    let word = |kind: &Kind| match kind {
        Kind::Source => "source data",
        Kind::Target => "target data",
        Kind::Distances => "distances",
        Kind::Augment => "generated rows",
        Kind::Run => "runs",
        Kind::Verdict => "verdicts",
    };
    let rows = status.kinds.iter().map(|(k, (done, all))| [word(k).to_owned(), format!("{done}/{all}")]);
    let mut text = format!("{}\n{}\n", status.name, table(&["work", "done"], rows));
    if !status.tiers.is_empty() {
        let hours = |seconds: f64| format!("{:.1} h", seconds / 3600.0);
        let rows = status.tiers.iter().map(|t| {
            let left = t.seconds_left.map_or("not known yet".into(), hours);
            [t.name.clone(), format!("{}/{}", t.done, t.all), hours(t.seconds), left]
        });
        // One process works at one piece, so that its hours are core-hours where it has one thread.
        text += &format!("{}\n", table(&["tier", "done", "process hours so far", "still to come"], rows));
    }
    let left = match (status.complete(), status.seconds_left) {
        (true, _) => "all runs are done".to_owned(),
        (false, Some(s)) => format!("about {:.0} min left", (s / 60.0).ceil()),
        (false, None) if status.stuck() => "what failed keeps the sweep from its end".to_owned(),
        (false, None) if status.running.is_empty() => "nobody is at work (tce sweep launch)".to_owned(),
        (false, None) => "time left not known".to_owned(),
    };
    text += &format!(
        "{} at work, {} waiting, {} failed, {} of determinism; {left}\n",
        status.running.len(),
        status.waiting.len(),
        status.failed.len(),
        counted(status.faults, "fault", "faults")
    );
    for r in &status.running {
        text += &format!("  {} (for {} s, {})\n", r.what, r.seconds, r.owner);
    }
    for (message, indices) in status.failures() {
        let first = indices.iter().take(5).map(ToString::to_string).collect::<Vec<_>>().join(", ");
        let more = if indices.len() > 5 { ", ..." } else { "" };
        text += &format!("  failed, {} of the work ({first}{more}): {message}\n", indices.len());
    }
    if !status.scores.is_empty() {
        let rows = status.scores.iter().map(|(t, c, s)| [t.clone(), c.clone(), plus_minus(s), s.len().to_string()]);
        text += &format!("{}\n", table(&["task", "method", "score", "seeds"], rows));
    }
    text
}

/// Tasks × methods: mean ± standard deviation over seeds.
pub fn gathered(gathered: &Gathered) -> String {
    let mut methods: Vec<&str> = Vec::new();
    let mut tasks: Vec<&str> = Vec::new();
    let mut cells: BTreeMap<(&str, &str), Vec<f64>> = BTreeMap::new();
    for row in &gathered.rows {
        if !methods.contains(&row.method.as_str()) {
            methods.push(&row.method);
        }
        if !tasks.contains(&row.task.as_str()) {
            tasks.push(&row.task);
        }
        cells.entry((&row.task, &row.method)).or_default().extend(row.counted());
    }
    let header: Vec<&str> = std::iter::once("task").chain(methods.iter().copied()).collect();
    let rows = tasks.iter().map(|task| {
        let cell = |method: &&str| cells.get(&(*task, *method)).map_or("-".into(), |s| plus_minus(s));
        let mut cells: Vec<_> = std::iter::once((*task).to_owned()).chain(methods.iter().map(cell)).collect();
        mark_best(cells.iter_mut().skip(1));
        cells
    });
    let mut text = table(&header, rows);
    for sentence in sentences(&tasks, &methods, &cells) {
        text += &format!("\n{sentence}");
    }
    let diverged = gathered.rows.iter().filter(|row| row.diverged).count();
    if diverged > 0 {
        let policies = counted(diverged, "policy", "policies");
        let (their, counts) = if diverged == 1 { ("its", "it counts") } else { ("their", "each counts") };
        text += &format!("\n{policies} could not act to the end of {their} evaluation: {counts} as {DIVERGED} points.");
    }
    let problems = gathered.missing.len() + gathered.corrupt.len() + gathered.conflicts.len();
    if problems > 0 {
        text += &format!(
            "\nPARTIAL: {} not done, {} corrupt, {} in conflict",
            counted(gathered.missing.len(), "run", "runs"),
            gathered.corrupt.len(),
            gathered.conflicts.len()
        );
    }
    text
}

/// For every method that is no baseline: on how many tasks it is above and below the best baseline, and where that is shown.
fn sentences(tasks: &[&str], methods: &[&str], cells: &BTreeMap<(&str, &str), Vec<f64>>) -> Vec<String> {
    // Without baselines there is nothing to be above of.
    let role = |method: &str| match Variant::BASELINES.iter().any(|f| method.split(' ').next() == Some(f.name())) {
        true => Role::Baseline,
        false => Role::Method,
    };
    let of = |method: &str| {
        Tally::of(tasks.iter().map(|task| {
            let scored = |m: &str| cells.get(&(*task, m)).filter(|s| !s.is_empty()).map(|s| Scored::new(m, role(m), s));
            let baselines: Vec<Scored> =
                methods.iter().filter(|m| role(m) == Role::Baseline).filter_map(|m| scored(m)).collect();
            (scored(method), baselines)
        }))
    };
    methods.iter().filter(|m| role(m) == Role::Method).filter_map(|m| of(m).map(|tally| tally.sentence(m))).collect()
}
