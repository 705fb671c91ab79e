//! Which presets the runs are of, how long they learned, and what that means beside the paper's figures.

use std::collections::BTreeMap;

use serde::Serialize;
use tce_base::counted;
use tce_data::Shift;

use super::ENOUGH_SEEDS;
use crate::paper;
use crate::study::{Budget, Recipe, Run, Study};

/// Presets and learner updates of all runs.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Recipes {
    /// Presets, each with its runs: `quick`, `quick with changes`, `settings of its own`.
    pub presets: BTreeMap<String, usize>,
    /// Fewest and most updates of a learner.
    pub updates: Option<(u64, u64)>,
}

/// `12 000`.
pub fn thousands(n: u64) -> String {
    let digits = n.to_string();
    let mut out = String::new();
    for (k, c) in digits.chars().enumerate() {
        // A space that does not break the line.
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            out.push('\u{a0}');
        }
        out.push(c);
    }
    out
}

/// `12 000`, `60 to 12 000`.
fn range((low, high): (u64, u64)) -> String {
    if low == high { thousands(low) } else { format!("{} to {}", thousands(low), thousands(high)) }
}

impl Recipe {
    /// Its preset in print.
    fn name(&self) -> String {
        match (&self.preset, self.changed.is_empty()) {
            (Some(preset), true) => preset.clone(),
            (Some(preset), false) => format!("{preset} with changes"),
            (None, _) => "settings of its own".into(),
        }
    }
}

impl Recipes {
    /// Of all runs.
    pub fn of(study: &Study) -> Self {
        let mut presets = BTreeMap::new();
        for run in &study.runs {
            *presets.entry(run.recipe.name()).or_insert(0) += 1;
        }
        let updates = study.runs.iter().filter_map(|r| Some(r.recipe.learner.as_ref()?.updates));
        let updates = updates.fold(None, |seen: Option<(u64, u64)>, u| {
            Some(seen.map_or((u, u), |(low, high)| (low.min(u), high.max(u))))
        });
        Self { presets, updates }
    }

    /// The presets, joined.
    pub fn names(&self) -> String {
        self.presets.keys().map(String::as_str).collect::<Vec<_>>().join(" · ")
    }

    /// The updates in print.
    pub fn updates(&self) -> Option<String> {
        self.updates.map(range)
    }
}

/// `learner bc, 12 000 updates`; of several, all of them.
fn budgets<'a>(all: impl Iterator<Item = &'a Budget>) -> Option<String> {
    let mut by_learner: BTreeMap<&str, (u64, u64)> = BTreeMap::new();
    for b in all {
        let (low, high) = by_learner.entry(&b.learner).or_insert((b.updates, b.updates));
        (*low, *high) = ((*low).min(b.updates), (*high).max(b.updates));
    }
    let texts: Vec<String> = by_learner.into_iter().map(|(l, r)| format!("{} updates of {l}", range(r))).collect();
    (!texts.is_empty()).then(|| texts.join(" or "))
}

/// `a`, `a and b`, `a, b and c`.
fn joined(names: &[&str]) -> String {
    match names {
        [rest @ .., last] if !rest.is_empty() => format!("{} and {last}", rest.join(", ")),
        _ => names.concat(),
    }
}

/// Why the figures of a shift are not to be compared with the paper's as they stand: what differs, by method. None where every run of a
/// method of the paper's has the paper's settings, and as many seeds.
pub fn doubt(study: &Study, shift: Shift) -> Option<String> {
    paper::table(shift)?;
    // Methods that differ in the same way share a sentence.
    let mut parts: Vec<(String, Vec<&str>)> = Vec::new();
    for method in study.methods.iter().filter(|m| paper::counterpart(&m.base).is_some()) {
        let runs: Vec<&Run> = study.runs.iter().filter(|r| r.task.shift == shift && r.method == method.id).collect();
        let mut by_task: BTreeMap<_, usize> = BTreeMap::new();
        runs.iter().for_each(|r| *by_task.entry(r.task.to_string()).or_default() += 1);
        let Some(fewest) = by_task.values().min().copied() else { continue };
        if runs.iter().all(|r| r.recipe.is_papers()) && fewest >= ENOUGH_SEEDS {
            continue;
        }
        let mut names: Vec<String> = runs.iter().map(|r| r.recipe.name()).collect();
        names.sort();
        names.dedup();
        let preset = |n: String| if n.starts_with("settings") { n } else { format!("preset {n}") };
        let names: Vec<String> = names.into_iter().map(preset).collect();
        let seeds = counted(fewest, "seed", "seeds");
        let ours = budgets(runs.iter().filter_map(|r| r.recipe.learner.as_ref()));
        let paper = budgets(runs.iter().filter_map(|r| r.recipe.paper.as_ref()));
        let ours = [Some(names.join(" and ")), ours, Some(seeds)].into_iter().flatten().collect::<Vec<_>>().join(", ");
        let paper = paper.map_or_else(String::new, |p| format!("{p}, "));
        let text = format!("{ours}; in the paper: {paper}{ENOUGH_SEEDS} seeds.");
        match parts.iter_mut().find(|p| p.0 == text) {
            Some((_, titles)) => titles.push(&method.title),
            None => parts.push((text, vec![&method.title])),
        }
    }
    let parts: Vec<String> = parts.iter().map(|(text, titles)| format!("{} here: {text}", joined(titles))).collect();
    (!parts.is_empty()).then(|| {
        format!(
            "Do not compare the paper's figures with ours as they stand: they were made with other settings or more seeds. {} A \
             difference may come from that alone.",
            parts.join(" ")
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_and_names_are_grouped() {
        let spaced = |n: u64| thousands(n).replace('\u{a0}', " ");
        assert_eq!([7, 60, 12_000, 1_000_000].map(spaced), ["7", "60", "12 000", "1 000 000"]);
        assert_eq!([&["a"][..], &["a", "b"], &["a", "b", "c"]].map(joined), ["a", "a and b", "a, b and c"]);
    }
}
