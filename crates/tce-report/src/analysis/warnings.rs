//! What a reader must know before believing a figure.

use std::collections::{BTreeMap, BTreeSet};

use tce_base::counted;
use tce_data::Task;

use super::{Aggregate, Comparison, DIVERGED, ENOUGH_SEEDS, Finding, Warning, gap_words};
use crate::folder::Verdict;
use crate::study::{Run, Study};

fn list<'a>(names: impl IntoIterator<Item = &'a str>) -> String {
    names.into_iter().collect::<Vec<_>>().join(", ")
}

/// Adds a warning.
fn warn(out: &mut Vec<Warning>, text: String, details: Vec<String>) {
    out.push(Warning { text, details });
}

pub(super) fn warnings(
    study: &Study,
    tasks: &[Task],
    scores: &[Vec<Vec<f64>>],
    comparison: Option<&Comparison>,
    published: &[bool],
) -> Vec<Warning> {
    let mut out = Vec::new();
    of_runs(study, &mut out);
    of_settings(study, &mut out);
    of_methods(study, tasks, scores, published, &mut out);
    match comparison {
        None => warn(&mut out, "No run has a score: there are no statistics.".into(), Vec::new()),
        Some(comparison) => of_comparison(study, tasks, scores, comparison, &mut out),
    }
    let programs: BTreeSet<&str> = study.runs.iter().map(|r| r.folder.program.as_str()).collect();
    if programs.len() > 1 {
        let text = format!("The runs were made by different programs: {}.", list(programs));
        warn(&mut out, text, Vec::new());
    }
    for note in &study.notes {
        warn(&mut out, note.clone(), Vec::new());
    }
    out
}

/// Runs without a result, with two, or without a score.
fn of_runs(study: &Study, out: &mut Vec<Warning>) {
    if !study.missing.is_empty() {
        let all = study.runs.len() + study.missing.len();
        warn(
            out,
            format!(
                "Partial results: {} of {all} runs have no result. They are counted nowhere; where they are not missing at random, \
                 the figures are biased.",
                study.missing.len()
            ),
            study.missing.iter().map(|m| format!("{}: {}", m.what, m.why)).collect(),
        );
    }
    if !study.conflicts.is_empty() {
        warn(out,
            "Two copies of the same work came to different results; the first one is shown. This is a fault of determinism, unless they were \
             done on different processors or by different versions of the program."
                .into(),
            study.conflicts.clone(),
        );
    }
    let cases = |wanted: &dyn Fn(&Run) -> Option<String>| -> Vec<String> {
        let case = |r: &Run| Some(format!("{}, {}, seed {}: {}", r.method, r.task, r.member.seed, wanted(r)?));
        study.runs.iter().filter_map(case).collect()
    };
    let diverged = cases(&|r| match &r.member.verdict {
        Verdict::Diverged(why) => Some(why.clone()),
        _ => None,
    });
    if !diverged.is_empty() {
        warn(
            out,
            format!(
                "{} could not act to the end of {} evaluation: counted as {DIVERGED} points, a random policy's score, and marked † in \
                 the tables.",
                counted(diverged.len(), "policy", "policies"),
                if diverged.len() == 1 { "its" } else { "their" },
            ),
            diverged,
        );
    }
    let unstable = cases(&|r| match r.member.unstable {
        0 => None,
        n => Some(format!("{n} of {} episodes", r.member.returns.len())),
    });
    if !unstable.is_empty() {
        let text = "The physics became unstable in some episodes, which ended there. Their returns count up to that step and may mean nothing.";
        warn(out, text.into(), unstable);
    }
    let unscored = cases(&|r| (r.member.verdict == Verdict::Unscored).then(|| "no score".into()));
    if !unscored.is_empty() {
        let n = counted(unscored.len(), "run has", "runs have");
        warn(
            out,
            format!("{n} no score, for lack of reference returns or of a simulator, and are counted nowhere."),
            unscored,
        );
    }
}

/// Methods whose runs have different settings, where a mean over tasks is of no one method.
fn of_settings(study: &Study, out: &mut Vec<Warning>) {
    for method in &study.methods {
        let mut tasks: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        for run in study.runs.iter().filter(|r| r.method == method.id && r.recipe.preset.is_some()) {
            tasks.entry(run.recipe.told()).or_default().insert(run.task.to_string());
        }
        if tasks.len() > 1 {
            let text = format!(
                "{} has different settings on different tasks: its means over tasks are of no one method.",
                method.title
            );
            let told = |(settings, tasks): (&String, &BTreeSet<String>)| {
                format!("{settings}: {}", list(tasks.iter().map(String::as_str)))
            };
            warn(out, text, tasks.iter().map(told).collect());
        }
    }
}

/// What scores, seeds and baselines of the methods lack.
fn of_methods(study: &Study, tasks: &[Task], scores: &[Vec<Vec<f64>>], published: &[bool], out: &mut Vec<Warning>) {
    let title = |m: usize| study.methods[m].title.as_str();
    let modes: Vec<&str> = (0..published.len()).filter(|m| published[*m]).map(title).collect();
    if !modes.is_empty() {
        warn(
            out,
            format!(
                "Published mode: {} follow the published code, its known faults included. They stand for what was published, not \
                 for what the method can do.",
                list(modes)
            ),
            Vec::new(),
        );
    }
    let counts: BTreeSet<usize> = scores.iter().flatten().map(Vec::len).filter(|n| *n > 0).collect();
    if let (Some(least), Some(most)) = (counts.first(), counts.last()) {
        if *least < ENOUGH_SEEDS {
            warn(
                out,
                format!(
                    "Few seeds: {} for each task and method, where the paper has {ENOUGH_SEEDS}. Intervals from so few seeds are too \
                     narrow{}.",
                    if least == most { least.to_string() } else { format!("{least} to {most}") },
                    if *least == 1 { ", and a task with one seed does not widen them" } else { "" },
                ),
                Vec::new(),
            );
        }
        if least != most {
            warn(
                out,
                format!(
                    "Unequal numbers of seeds, {least} to {most}. Every task counts the same in a mean, however many runs it has."
                ),
                Vec::new(),
            );
        }
    }
    // Without `--no-baselines` all four are there: a table without them is a choice that a reader has to know.
    let bare: BTreeMap<&str, usize> = study
        .methods
        .iter()
        .enumerate()
        .filter(|(_, method)| method.baseline)
        .map(|(m, method)| (method.title.as_str(), scores.iter().filter(|t| t[m].is_empty()).count()))
        .filter(|(_, missing)| *missing > 0)
        .collect();
    if !bare.is_empty() {
        let part = |(title, n): (&&str, &usize)| format!("{title} on {n} of {}", tasks.len());
        let parts: Vec<String> = bare.iter().map(part).collect();
        warn(
            out,
            format!(
                "Baselines are missing: {}. A score says little without the baselines it has to beat.",
                parts.join("; ")
            ),
            Vec::new(),
        );
    }
}

/// What means over tasks leave out, and what is not proved.
fn of_comparison(study: &Study, tasks: &[Task], scores: &[Vec<Vec<f64>>], c: &Comparison, out: &mut Vec<Warning>) {
    let title = |m: usize| study.methods[m].title.as_str();
    if c.tasks.len() < tasks.len() {
        warn(
            out,
            format!(
                "Means over tasks are of the {} of {} tasks on which every compared method has a score.",
                c.tasks.len(),
                tasks.len()
            ),
            Vec::new(),
        );
    }
    if !c.left_out.is_empty() {
        let with_tasks = |m: &usize| {
            let count = scores.iter().filter(|t| !t[*m].is_empty()).count();
            format!("{} ({})", title(*m), counted(count, "task", "tasks"))
        };
        let names: Vec<String> = c.left_out.iter().map(with_tasks).collect();
        let names = list(names.iter().map(String::as_str));
        let text =
            format!("Left out of the means over tasks, because they share too few tasks with the others: {names}.");
        warn(out, text, Vec::new());
    }
    let finding = |wanted: Finding| -> Vec<String> {
        let is = |a: &&Aggregate| c.improvement(a).is_some_and(|(_, f)| f == wanted);
        let gap = |a: &Aggregate| match gap_words(c.gap(a).unwrap_or(f64::NAN)) {
            level if level.starts_with("level") => "level".to_owned(),
            gap => gap,
        };
        c.methods.iter().filter(is).map(|a| format!("{} ({})", title(a.method), gap(a))).collect()
    };
    if let Some(baseline) = c.best_baseline() {
        let worse = finding(Finding::Worse);
        let open = [Finding::Open, Finding::Few, Finding::Unknown].map(finding).concat();
        if !worse.is_empty() {
            let names = list(worse.iter().map(String::as_str));
            warn(out, format!("Shown to fall short of the best baseline, {}: {names}.", title(baseline)), Vec::new());
        }
        if !open.is_empty() {
            let names = list(open.iter().map(String::as_str));
            warn(
                out,
                format!("Not proved to differ from the best baseline, {}: {names}.", title(baseline)),
                Vec::new(),
            );
        }
    }
}
