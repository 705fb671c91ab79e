//! The list of work of a sweep, which is made once from its description and does not change.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tce_base::{FileError, PROGRAM, sha256_file, sha256_hex};
use tce_data::{Task, main_file};

use crate::config::{Config, GeneratedRows, SourceRows, used_of_single_stage};
use crate::error::{Error, Result};
use crate::inputs::{DataArgs, ensure_data};
use crate::layers::Layered;
use crate::variant::Variant;

use super::description::{Description, Files, Override, Unavailable};

/// Version of the format. Increase it when older manifests cannot be read.
const FORMAT: u32 = 1;

/// What a piece of work is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Source rows from the zoo.
    Source,
    /// Target rows from the zoo.
    Target,
    /// Distances of source rows to the target's, which several runs share.
    Distances,
    /// Networks, label models and generated rows, which several runs share.
    // The name in manifests, from which ids of work are hashed.
    #[serde(rename = "expand")]
    Augment,
    /// A policy and its score.
    Run,
    /// The recommendation of one of a task's policies of one seed.
    Verdict,
}

/// One piece of work.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Its place in the manifest.
    pub index: usize,
    /// Cache key: hash of all inputs of its result.
    pub id: String,
    /// What it is.
    pub kind: Kind,
    /// The task, or the first of those that share it.
    pub task: Task,
    /// The method, for runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub variant: Option<Variant>,
    /// The override's name, for runs of one.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub label: String,
    /// The seed.
    pub seed: u64,
    /// Hash of its configuration.
    pub config: String,
    /// The tier that it belongs to, the first of those that share it; empty without tiers.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub tier: String,
    /// Indices of work that should be done before. If it is not, this piece does it itself.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub needs: Vec<usize>,
}

impl Entry {
    /// The method's column in tables.
    pub fn column(&self) -> String {
        let variant = self.variant.map(Variant::name).unwrap_or_default();
        if self.label.is_empty() { variant.to_owned() } else { format!("{variant} {}", self.label) }
    }
}

impl fmt::Display for Entry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { index, kind, task, seed, .. } = self;
        match kind {
            Kind::Source => write!(f, "{index}: source rows, {}-{}", task.agent, task.source),
            Kind::Target => write!(f, "{index}: target rows, {}-{}-{}", task.agent, task.shift, task.target),
            Kind::Distances => write!(f, "{index}: distances of source rows, {task}"),
            Kind::Augment => write!(f, "{index}: generated rows, {task}, seed {seed}"),
            Kind::Run => write!(f, "{index}: {}, {task}, seed {seed}", self.column()),
            Kind::Verdict => write!(f, "{index}: verdict, {task}, seed {seed}"),
        }
    }
}

/// The part of a manifest that all pieces of work share.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    format: u32,
    /// The sweep's name: its description's.
    pub name: String,
    /// The program that planned it.
    pub program: String,
    /// Collect what is not given by the zoo's actors only.
    pub from_zoo: bool,
    /// Data files.
    pub data: BTreeMap<Task, Files>,
    /// SHA-256 of the data files, when the sweep was planned.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub hashes: BTreeMap<PathBuf, String>,
    /// Configurations, TOML, by their hash.
    pub configs: BTreeMap<String, String>,
    /// Pieces of work.
    pub entries: usize,
}

impl Header {
    /// Where the data of a task come from.
    pub(super) fn data_of(&self, task: Task) -> DataArgs {
        let Files { source, target } = self.data.get(&task).cloned().unwrap_or_default();
        DataArgs { source, target, from_zoo: self.from_zoo, out: PathBuf::new() }
    }
}

/// The policies that verdicts choose among, while a plan is made.
#[derive(Default)]
struct Verdicts {
    /// The runs of a task and a seed so far, of all tiers.
    policies: BTreeMap<(Task, u64), Vec<usize>>,
    /// What has a verdict already.
    given: BTreeSet<(Task, u64)>,
}

impl Verdicts {
    /// A run of a task and a seed. Several tiers may share it; it is one policy.
    fn add(&mut self, of: (Task, u64), run: usize) {
        let policies = self.policies.entry(of).or_default();
        if !policies.contains(&run) {
            policies.push(run);
        }
    }

    /// Tasks and seeds that have a baseline and a method now, and had not before: what `tce run` chooses among.
    fn ready(&mut self, entries: &[Entry]) -> Vec<(Task, u64, Vec<usize>)> {
        let baseline = |run: &usize| entries[*run].variant.is_some_and(|v| Variant::BASELINES.contains(&v));
        let both = |runs: &[usize]| runs.iter().any(baseline) && !runs.iter().all(baseline);
        let ready = self.policies.iter().filter(|(key, runs)| !self.given.contains(key) && both(runs));
        let ready: Vec<_> = ready.map(|(&(task, seed), runs)| (task, seed, runs.clone())).collect();
        self.given.extend(ready.iter().map(|(task, seed, _)| (*task, *seed)));
        ready
    }
}

/// The list of work of a sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Manifest {
    /// The shared part.
    pub header: Header,
    /// The work.
    pub entries: Vec<Entry>,
}

impl Manifest {
    /// The work of a description.
    ///
    /// # Errors
    /// [`Error::Usage`] for a description that cannot be read, an unknown key, task or setting, or files that are not there.
    pub fn plan(path: &Path) -> Result<Self> {
        let failed = |e: &dyn fmt::Display| Error::Usage(format!("{}: {e}", path.display()));
        let text = fs::read_to_string(path).map_err(|e| Error::Usage(FileError::new(path, "read", e).to_string()))?;
        let description: Description = toml::from_str(&text).map_err(|e| failed(&e))?;
        let base = path.parent().unwrap_or(Path::new("."));
        let parts = description.parts().map_err(|e| failed(&e))?;
        let (mut data, mut hashes) = (description.data.clone(), BTreeMap::new());
        for (task, files) in &mut data {
            for file in files.source.iter_mut().chain(&mut files.target) {
                let full = main_file(&base.join(&*file));
                *file = full.canonicalize().map_err(|e| failed(&format!("data of {task}: {}: {e}", full.display())))?;
                if !hashes.contains_key(file) {
                    hashes.insert(file.clone(), sha256_file(file)?);
                }
            }
        }
        let file = description.config.as_ref().map(|c| base.join(c));

        let header = Header {
            format: FORMAT,
            name: path.file_stem().map_or_else(String::new, |s| s.to_string_lossy().into_owned()),
            program: PROGRAM.into(),
            from_zoo: description.from_zoo,
            data,
            hashes,
            configs: BTreeMap::new(),
            entries: 0,
        };
        // The runs of every part: task, variant, column and configuration. They are known before the first one is added, because a task
        // whose data cannot be had for one of them is left out as a whole.
        let mut runs = Vec::new();
        let mut lacking: BTreeMap<(Task, Option<usize>), Option<String>> = BTreeMap::new();
        for part in &parts {
            let mut own = Vec::new();
            for (&task, &variant) in part.tasks.iter().flat_map(|t| part.variants.iter().map(move |v| (t, v))) {
                for Override { name, set } in &part.overrides {
                    let sets = [description.set.clone(), set.clone()].concat();
                    let layered = Layered::new(description.preset, Some(task), Some(variant), file.as_deref(), &sets)?;
                    let config = layered.config()?;
                    let rows = config.needs_source().then_some(config.source.rows);
                    let lacks = || ensure_data(task, &header.data_of(task), rows).err().map(|e| e.to_string());
                    lacking.entry((task, rows)).or_insert_with(lacks);
                    own.push((task, variant, name.as_str(), config));
                }
            }
            runs.push(own);
        }
        let without: BTreeSet<Task> =
            lacking.iter().filter(|(_, why)| why.is_some()).map(|((task, _), _)| *task).collect();
        let mut plan = Self { header, entries: Vec::new() };
        let mut known = BTreeMap::new();
        let mut verdicts = Verdicts::default();
        for (part, own) in parts.iter().zip(&runs) {
            for (task, variant, label, config) in own.iter().filter(|r| !without.contains(&r.0)) {
                for seed in part.seeds.clone() {
                    let run = plan.add_run(&mut known, &part.name, (*task, *variant, label), config, seed);
                    verdicts.add((*task, seed), run);
                }
            }
            if description.verdicts {
                for (task, seed, runs) in verdicts.ready(&plan.entries) {
                    plan.add_verdict(&mut known, &part.name, task, seed, runs);
                }
            }
        }
        let lacking: BTreeSet<String> = lacking.into_values().flatten().collect();
        if !lacking.is_empty() {
            let list = lacking.into_iter().collect::<Vec<_>>().join("\n");
            if description.unavailable == Unavailable::Refuse || plan.entries.is_empty() {
                return Err(Error::Failed(format!("{}: not all data can be had:\n{list}", path.display())));
            }
            let tasks = without.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
            let (are, their) = if without.len() == 1 { ("task is", "its") } else { ("tasks are", "their") };
            tce_base::note!("{} {are} left out, because {their} data cannot be had ({tasks}):\n{list}", without.len());
        }
        Ok(plan.with_clones_first().sorted())
    }

    /// Runs whose other rows get the actions of clones need the run of these clones, where the sweep has one.
    fn with_clones_first(mut self) -> Self {
        let by_clones = |text: &str| toml::from_str::<Config>(text).is_ok_and(|config| config.mixture.by_clones());
        let configs = self.header.configs.iter().filter(|(_, text)| by_clones(text)).map(|(hash, _)| hash);
        let configs: BTreeSet<&String> = configs.collect();
        let clones = |e: &Entry| e.variant == Some(Variant::BcEnsemble) && e.label.is_empty();
        let runs: BTreeMap<(Task, u64), usize> =
            self.entries.iter().enumerate().filter(|(_, e)| clones(e)).map(|(i, e)| ((e.task, e.seed), i)).collect();
        for run in self.entries.iter_mut().filter(|e| e.kind == Kind::Run && configs.contains(&e.config)) {
            run.needs.extend(runs.get(&(run.task, run.seed)));
        }
        self
    }

    /// The place of `entry`, which is added unless it is there.
    fn add(&mut self, known: &mut BTreeMap<String, usize>, entry: Entry) -> usize {
        *known.entry(entry.id.clone()).or_insert_with(|| {
            self.entries.push(entry);
            self.entries.len() - 1
        })
    }

    fn add_run(
        &mut self,
        known: &mut BTreeMap<String, usize>,
        tier: &str,
        (task, variant, label): (Task, Variant, &str),
        config: &Config,
        seed: u64,
    ) -> usize {
        let text = config.to_keyed_toml();
        let hash = sha256_hex(text.as_bytes())[..16].to_owned();
        self.header.configs.insert(hash.clone(), text);
        let (data, from_zoo) = (self.header.data.get(&task).cloned().unwrap_or_default(), self.header.from_zoo);
        let entry = |kind: Kind, spec: serde_json::Value, seed: u64, needs: Vec<usize>| Entry {
            index: 0,
            id: sha256_hex(serde_json::json!({ "kind": kind, "spec": spec }).to_string().as_bytes())[..16].to_owned(),
            kind,
            task,
            variant: None,
            label: String::new(),
            seed,
            config: hash.clone(),
            tier: tier.to_owned(),
            needs,
        };
        let rows = serde_json::json!([config.source, config.target]);
        let mut needs = Vec::new();
        if data.target.is_none() {
            let spec = serde_json::json!([task.agent, task.shift, task.target, from_zoo]);
            needs.push(self.add(known, entry(Kind::Target, spec, 0, Vec::new())));
        }
        if config.needs_source() && data.source.is_none() {
            let spec = serde_json::json!([task.agent, task.source, config.source.rows, from_zoo]);
            needs.push(self.add(known, entry(Kind::Source, spec, 0, Vec::new())));
        }
        if let Some(kind) = config.distances() {
            let spec = serde_json::json!([task, data, from_zoo, rows, kind]);
            let distances = self.add(known, entry(Kind::Distances, spec, 0, needs.clone()));
            needs.push(distances);
        }
        let generated = config.mixture.generated;
        if generated != GeneratedRows::None || config.mixture.source == SourceRows::Relabelled {
            let own = match generated {
                GeneratedRows::Synther | GeneratedRows::Dmc => {
                    serde_json::json!(used_of_single_stage(&config.single_stage, generated, config.learner.algorithm))
                }
                GeneratedRows::Tce | GeneratedRows::None => {
                    let lambda = if config.generator.rows == 0 { config.mixture.lambda } else { 0.0 };
                    let dynamics = config.filter.by_dynamics().then_some(&config.dynamics);
                    let imitated = config.target.trajectories;
                    serde_json::json!([config.generator, config.filter, config.labels, lambda, imitated, dynamics])
                }
            };
            let spec = serde_json::json!([task, data, from_zoo, rows, generated, own, seed]);
            let before = needs.clone();
            needs.push(self.add(known, entry(Kind::Augment, spec, seed, before)));
        }
        let spec = serde_json::json!([task, data, from_zoo, variant, label, hash, seed]);
        let run = entry(Kind::Run, spec, seed, needs);
        self.add(known, Entry { variant: Some(variant), label: label.to_owned(), ..run })
    }

    /// The choice among the policies of `runs`, which are those of a task and a seed.
    fn add_verdict(
        &mut self,
        known: &mut BTreeMap<String, usize>,
        tier: &str,
        task: Task,
        seed: u64,
        runs: Vec<usize>,
    ) {
        let ids: Vec<&str> = runs.iter().map(|&run| self.entries[run].id.as_str()).collect();
        let spec = serde_json::json!({ "kind": Kind::Verdict, "spec": [task, seed, ids] });
        let entry = Entry {
            index: 0,
            id: sha256_hex(spec.to_string().as_bytes())[..16].to_owned(),
            kind: Kind::Verdict,
            task,
            variant: None,
            label: String::new(),
            seed,
            // That of the first run: the learned dynamics are the same in all.
            config: self.entries[runs[0]].config.clone(),
            tier: tier.to_owned(),
            needs: runs,
        };
        self.add(known, entry);
    }

    /// Tiers one after the other, in each one seed after the other, and for each seed task after task with what its runs need: whoever stops
    /// early has whole tasks. What several pieces need stands before the first of them.
    fn sorted(mut self) -> Self {
        // Tiers and tasks have the order in which their first work was added.
        let (mut tiers, mut tasks): (BTreeMap<String, usize>, BTreeMap<Task, usize>) = Default::default();
        for entry in &self.entries {
            let (tier, task) = (tiers.len(), tasks.len());
            tiers.entry(entry.tier.clone()).or_insert(tier);
            tasks.entry(entry.task).or_insert(task);
        }
        let mut wanted: Vec<usize> = (0..self.entries.len()).collect();
        wanted.sort_by_key(|&i| {
            let Entry { tier, seed, task, kind, .. } = &self.entries[i];
            (tiers[tier], *seed, tasks[task], *kind, i)
        });
        let mut order = Vec::with_capacity(wanted.len());
        let mut placed = vec![false; wanted.len()];
        wanted.into_iter().for_each(|i| self.place(i, &mut placed, &mut order));
        let mut place = vec![0; order.len()];
        order.iter().enumerate().for_each(|(new, &old)| place[old] = new);
        let mut entries: Vec<Entry> = order.iter().map(|&i| self.entries[i].clone()).collect();
        for (index, entry) in entries.iter_mut().enumerate() {
            entry.index = index;
            entry.needs.iter_mut().for_each(|n| *n = place[*n]);
        }
        self.header.entries = entries.len();
        self.entries = entries;
        self
    }

    /// Appends entry `i` to `order`, and before it what it needs, unless they are there.
    fn place(&self, i: usize, placed: &mut [bool], order: &mut Vec<usize>) {
        if !std::mem::replace(&mut placed[i], true) {
            self.entries[i].needs.iter().for_each(|&n| self.place(n, placed, order));
            order.push(i);
        }
    }

    /// The names of the tiers, in their order; one empty name without tiers.
    pub fn tiers(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for entry in &self.entries {
            if !names.contains(&entry.tier.as_str()) {
                names.push(&entry.tier);
            }
        }
        names
    }

    /// As `manifest.jsonl` has it.
    pub fn to_jsonl(&self) -> String {
        let line = |value: serde_json::Value| format!("{value}\n");
        let entries = self.entries.iter().map(|e| line(serde_json::to_value(e).expect("plain data")));
        std::iter::once(line(serde_json::to_value(&self.header).expect("plain data"))).chain(entries).collect()
    }

    /// Reads what [`Manifest::to_jsonl`] wrote; `path` is for messages.
    ///
    /// # Errors
    /// If it is damaged, or of another version of the program's manifests.
    pub fn parse(text: &str, path: &Path) -> Result<Self> {
        let bad = |line: usize, what: &dyn fmt::Display| {
            Error::Failed(format!("{}: line {line}: {what}; the file is damaged, plan the sweep again", path.display()))
        };
        let mut lines = text.lines().enumerate();
        let (_, first) = lines.next().ok_or_else(|| bad(1, &"found nothing, expected a header"))?;
        let header: Header = serde_json::from_str(first).map_err(|e| bad(1, &e))?;
        if header.format != FORMAT {
            return Err(Error::Failed(format!(
                "{}: found format {}, expected {FORMAT}: it was planned by {}; use that program, or plan it again",
                path.display(),
                header.format,
                header.program
            )));
        }
        for (hash, config) in &header.configs {
            if !sha256_hex(config.as_bytes()).starts_with(hash.as_str()) || hash.len() != 16 {
                return Err(bad(1, &format!("configuration {hash} is not what it was")));
            }
        }
        let mut entries: Vec<Entry> = Vec::new();
        for (n, line) in lines {
            let entry: Entry = serde_json::from_str(line).map_err(|e| bad(n + 1, &e))?;
            let fits = entry.index == entries.len()
                && entry.needs.iter().all(|&k| k < entry.index)
                && header.configs.contains_key(&entry.config)
                && entry.id.len() == 16
                && entry.id.bytes().all(|b| b.is_ascii_hexdigit());
            if !fits {
                return Err(bad(n + 1, &"an entry out of order, or with an unknown configuration"));
            }
            entries.push(entry);
        }
        if entries.len() != header.entries {
            return Err(bad(
                entries.len() + 1,
                &format!("found {} entries, expected {}", entries.len(), header.entries),
            ));
        }
        Ok(Self { header, entries })
    }

    /// The configuration of a piece of work.
    ///
    /// # Errors
    /// If this program's configurations have other keys.
    pub fn config(&self, entry: &Entry) -> Result<Config> {
        let text = &self.header.configs[&entry.config];
        let config: Config = toml::from_str(text).map_err(|e| {
            Error::Failed(format!("a configuration planned by {} is none of this program's: {e}", self.header.program))
        })?;
        config.validate()?;
        Ok(config)
    }
}

#[cfg(test)]
pub(super) mod tests;
