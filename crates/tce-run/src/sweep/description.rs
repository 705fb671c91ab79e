//! A sweep's description, `sweep.toml`: what a person writes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use tce_data::Task;

use crate::layers::Preset;
use crate::variant::Variant;

/// More runs than this are taken for a typing error.
const MOST_RUNS: u64 = 100_000;

/// A sweep's description: tasks × variants × overrides × seeds, once or in tiers.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// Tasks, `*` standing for anything: `hopper-*:medium->*`. Tiers may have others.
    #[serde(default)]
    pub tasks: Vec<String>,
    /// Methods. Tiers may have others.
    #[serde(default)]
    pub variants: Vec<Variant>,
    /// Whether the baselines are run beside them.
    #[serde(default = "yes", alias = "floors")]
    pub baselines: bool,
    /// Seeds, one run each.
    #[serde(default = "one")]
    pub seeds: u64,
    /// The first seed.
    #[serde(default)]
    pub first_seed: u64,
    /// Where the configuration starts.
    #[serde(default)]
    pub preset: Preset,
    /// A configuration file on top of it, relative to the description.
    pub config: Option<PathBuf>,
    /// Single keys on top of that, `"learner.steps=100_000"`.
    #[serde(default)]
    pub set: Vec<String>,
    /// Collect what is not given by the zoo's actors only.
    #[serde(default)]
    pub from_zoo: bool,
    /// What becomes of tasks whose data cannot be had.
    #[serde(default)]
    pub unavailable: Unavailable,
    /// Whether the program recommends a policy for every task and seed, from the data alone, as `tce run` does. It chooses in the first tier by
    /// whose end there are a baseline and a method.
    #[serde(default)]
    pub verdicts: bool,
    /// Data files of a task, relative to the description.
    #[serde(default)]
    pub data: BTreeMap<Task, Files>,
    /// Further settings, one column each; empty: one column without a name.
    #[serde(default)]
    pub overrides: Vec<Override>,
    /// Parts that are done one after the other, the most informative first; empty: one part.
    #[serde(default)]
    pub tiers: Vec<Tier>,
}

/// What becomes of tasks whose data cannot be had.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Unavailable {
    /// Nothing is planned.
    #[default]
    Refuse,
    /// They are left out, with all their runs, and named.
    Skip,
}

/// A part of a sweep. What it does not say is as the description has it.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tier {
    /// Its name.
    pub name: String,
    /// Tasks.
    pub tasks: Option<Vec<String>>,
    /// Methods.
    pub variants: Option<Vec<Variant>>,
    /// Whether the baselines are run beside them.
    pub baselines: Option<bool>,
    /// Seeds.
    pub seeds: Option<u64>,
    /// The first seed.
    pub first_seed: Option<u64>,
    /// Further settings, one column each.
    pub overrides: Option<Vec<Override>>,
}

/// Data files of a task.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Files {
    /// Source data.
    pub source: Option<PathBuf>,
    /// Target data.
    pub target: Option<PathBuf>,
}

/// A further column of the table.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Override {
    /// Its name.
    pub name: String,
    /// What it changes.
    pub set: Vec<String>,
}

fn yes() -> bool {
    true
}

fn one() -> u64 {
    1
}

/// A tier with everything in its place.
#[derive(Clone, Debug)]
pub(super) struct Part {
    /// Its name; empty where the description has no tiers.
    pub name: String,
    /// Tasks, in the order of the patterns.
    pub tasks: Vec<Task>,
    /// Methods, the baselines included, each once.
    pub variants: Vec<Variant>,
    /// Columns of each method, at least one.
    pub overrides: Vec<Override>,
    /// Seeds.
    pub seeds: std::ops::Range<u64>,
}

impl Description {
    /// The tiers in their order, or the whole description as one.
    ///
    /// # Errors
    /// If there is nothing to run, too much, or two tiers of one name: in words.
    pub(super) fn parts(&self) -> Result<Vec<Part>, String> {
        let whole = Tier::default();
        let tiers = if self.tiers.is_empty() { std::slice::from_ref(&whole) } else { &self.tiers[..] };
        let mut names = BTreeSet::new();
        let mut columns: BTreeMap<String, Vec<String>> = BTreeMap::new();
        let mut runs = 0u64;
        let mut parts = Vec::new();
        for tier in tiers {
            let within = |e: String| if tier.name.is_empty() { e } else { format!("tier {:?}: {e}", tier.name) };
            if !names.insert(&tier.name) || (tier.name.is_empty() && !self.tiers.is_empty()) {
                return Err(format!("tiers: found the name {:?}, expected a different name for every tier", tier.name));
            }
            let part = self.part(tier).map_err(within)?;
            for Override { name, set } in &part.overrides {
                if columns.entry(name.clone()).or_insert_with(|| set.clone()) != set {
                    return Err(within(format!(
                        "overrides: {name:?} sets {set:?} here and {:?} before; a name stands for one column, choose another one",
                        columns[name]
                    )));
                }
            }
            let pieces = [part.tasks.len(), part.variants.len(), part.overrides.len()].iter().product::<usize>() as u64;
            let seeds = part.seeds.end - part.seeds.start;
            runs = pieces.checked_mul(seeds).and_then(|n| runs.checked_add(n)).unwrap_or(u64::MAX);
            if runs > MOST_RUNS {
                return Err(within(format!("{pieces} x {seeds} runs; a sweep has at most {MOST_RUNS}")));
            }
            parts.push(part);
        }
        Ok(parts)
    }

    fn part(&self, tier: &Tier) -> Result<Part, String> {
        let tasks = tasks(tier.tasks.as_ref().unwrap_or(&self.tasks))?;
        let mut variants = tier.variants.as_ref().unwrap_or(&self.variants).clone();
        let (seeds, first) = (tier.seeds.unwrap_or(self.seeds), tier.first_seed.unwrap_or(self.first_seed));
        if variants.is_empty() || seeds == 0 {
            return Err("there is nothing to run; give at least one task, one of `variants`, and seeds > 0".into());
        }
        if tier.baselines.unwrap_or(self.baselines) {
            variants.extend(Variant::BASELINES);
        }
        let mut seen = BTreeSet::new();
        variants.retain(|v| seen.insert(*v));
        let mut overrides = tier.overrides.as_ref().unwrap_or(&self.overrides).clone();
        if overrides.is_empty() {
            overrides.push(Override { name: String::new(), set: Vec::new() });
        }
        let end = first.checked_add(seeds).ok_or_else(|| format!("{seeds} seeds from {first} on; that is too many"))?;
        Ok(Part { name: tier.name.clone(), tasks, variants, overrides, seeds: first..end })
    }
}

/// The tasks that match the patterns, in the order of the patterns.
fn tasks(patterns: &[String]) -> Result<Vec<Task>, String> {
    let mut out: Vec<Task> = Vec::new();
    for pattern in patterns {
        let found: Vec<Task> = if pattern.contains('*') {
            Task::all()
                .into_iter()
                .filter(|t| glob(pattern, &t.to_string()) || glob(pattern, &t.with_arrow()))
                .collect()
        } else {
            vec![pattern.parse()?]
        };
        if found.is_empty() {
            return Err(format!("tasks: `{pattern}` matches none of the 108 tasks ROBOT-SHIFT/SOURCE/TARGET"));
        }
        out.extend(found.into_iter().filter(|t| !out.contains(t)).collect::<Vec<_>>());
    }
    match out.is_empty() {
        true => Err("tasks: none".into()),
        false => Ok(out),
    }
}

fn glob(pattern: &str, text: &str) -> bool {
    match pattern.split_once('*') {
        None => pattern == text,
        Some((head, rest)) => text
            .strip_prefix(head)
            .is_some_and(|tail| (0..=tail.len()).any(|k| tail.is_char_boundary(k) && glob(rest, &tail[k..]))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_match_tasks() {
        let count = |p: &str| tasks(&[p.into()]).unwrap().len();
        assert_eq!((count("*"), count("hopper-*:medium->expert"), count("*-morph:medium->*")), (108, 3, 12));
    }
}
