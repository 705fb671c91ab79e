//! What a report is made from: sweeps' folders, folders with runs of `tce run`, and records of either.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde_json::Value;
use tce_base::FileError;
use tce_data::{Task, parse_agent};
use tce_diagnosis::Diagnosis;
use tce_learn::Mode;
use tce_report::folder::Verdict;
use tce_report::{Cost, Method, Missing, Recommended, ReportError, RunFolder, Study, merge, record};

use crate::config::Config;
use crate::diagnosis;
use crate::error::{Error, Result};
use crate::recipe::Recipes;
use crate::sweep::gather::Checked;
use crate::sweep::{Entry, Kind, Sweep};
use crate::variant::Variant;

mod columns;
use columns::{Finished, columns};

/// Everything that `places` hold for a report, as one study: sweeps' folders, folders of `tce run`, records, and folders of records.
///
/// # Errors
/// If one of them is none of these, or a file in it is damaged.
pub fn of_places(places: &[PathBuf]) -> Result<Study> {
    let (mut studies, mut recipes) = (Vec::new(), Recipes::default());
    for place in places {
        if place.join("manifest.jsonl").exists() {
            studies.push(of_sweep(&Sweep::open(place)?, &mut recipes)?);
            continue;
        }
        let records = records(place)?;
        // A folder may hold both.
        if records.is_empty() || (place.is_dir() && directories(place)?.iter().any(|d| task_of(d).is_some())) {
            studies.push(of_runs(place, &mut recipes)?);
        }
        for path in records {
            let mut study = record::read(&path)?;
            // Beside the presets of this program: those of the one that wrote the record may have been others.
            // Without its settings a run has the recipe that was written down.
            for run in study.runs.iter_mut().filter(|r| !r.folder.config.is_empty()) {
                let variant = study.methods.iter().find(|m| m.id == run.method).map_or("", |m| m.variant.as_str());
                run.recipe = recipes.of(run.task, variant, &run.folder);
            }
            studies.push(study);
        }
    }
    Ok(merge(studies))
}

/// The records at `place`: the file itself, or all `*.jsonl` of a folder.
fn records(place: &Path) -> Result<Vec<PathBuf>> {
    if place.is_file() {
        // Whatever else it is, the reader of records says.
        return Ok(vec![place.to_owned()]);
    }
    let mut found: Vec<PathBuf> = entries(place)?;
    found.retain(|p| p.extension().is_some_and(|e| e == "jsonl") && !name_of(p).starts_with('.'));
    found.sort();
    Ok(found)
}

/// A column; `config` is that of one of its runs, the variant's own without.
fn method(variant: Variant, label: &str, config: Option<&Config>) -> Method {
    let baseline = Variant::BASELINES.contains(&variant);
    let title = config.map_or_else(|| variant.own_title(), |c| variant.row_title(c));
    let (id, title) = match label {
        "" => (variant.name().to_owned(), title),
        label => (format!("{variant} {label}"), format!("{title}, {label}")),
    };
    Method {
        id,
        title,
        variant: variant.name().to_owned(),
        base: variant.base().to_owned(),
        published: variant.mode() == Mode::Published,
        baseline,
        plain: label.is_empty(),
    }
}

/// A column of runs that the user gave a `name`.
fn named(id: &str, name: &str) -> Method {
    Method {
        id: id.to_owned(),
        title: id.to_owned(),
        variant: name.to_owned(),
        base: name.to_owned(),
        published: false,
        baseline: false,
        plain: false,
    }
}

/// Baselines first, and all four of them: a table without a baseline shows that it lacks it.
fn in_order(mut methods: Vec<Method>) -> Vec<Method> {
    for baseline in Variant::BASELINES {
        if !methods.iter().any(|m| m.variant == baseline.name()) {
            methods.push(method(baseline, "", None));
        }
    }
    let place = |m: &Method| Variant::BASELINES.iter().position(|f| f.name() == m.variant).unwrap_or(usize::MAX);
    methods.sort_by_key(place);
    methods
}

fn of_sweep(sweep: &Sweep, recipes: &mut Recipes) -> Result<Study> {
    let runs = || sweep.entries().iter().filter(|e| e.kind == Kind::Run);
    let mut methods: Vec<Method> = Vec::new();
    for (variant, entry) in runs().filter_map(|e| Some((e.variant?, e))) {
        if !methods.iter().any(|m| m.id == entry.column()) {
            // Another version's configuration may have other keys; its runs are no worse for it.
            methods.push(method(variant, &entry.label, sweep.manifest.config(entry).ok().as_ref()));
        }
    }
    let mut notes = Vec::new();
    let diagnoses = diagnoses(&sweep.directory.join("runs"), &mut notes);
    let recommended = verdicts(sweep, &mut notes);
    let mut study = Study {
        sweep: true,
        methods: in_order(methods),
        conflicts: sweep.conflicts().iter().map(|p| p.display().to_string()).collect(),
        notes,
        diagnoses,
        recommended,
        ..Study::new(sweep.manifest.header.name.clone(), sweep.directory.display().to_string())
    };
    for entry in runs() {
        let mut missing = |why: String| {
            let (method, seed) = (entry.column(), Some(entry.seed));
            study.missing.push(Missing { task: entry.task, method, seed, what: entry.to_string(), why });
        };
        match sweep.check(entry) {
            Checked::Missing => missing(match sweep.failure(entry) {
                Some(failure) => format!("failed: {}", failure.error),
                None => "not done".into(),
            }),
            Checked::Corrupt(what) => missing(format!("corrupt: {what}")),
            Checked::Done(outcome) => {
                let directory = sweep.directory.join(&outcome.place);
                match RunFolder::read(&directory)? {
                    None => missing(format!("corrupt: {} has no done.json", directory.display())),
                    Some(folder) => {
                        agree(sweep, entry, outcome.score, &folder)?;
                        study.costs.push(Cost {
                            stage: training_stage(&method_title(&study.methods, &entry.column())),
                            agent: entry.task.agent,
                            seconds: folder.learning_seconds,
                            seeds: folder.members.len(),
                            memory: outcome.memory,
                        });
                        let variant = entry.variant.map(Variant::name).unwrap_or_default();
                        let recipe = recipes.of(entry.task, variant, &folder);
                        study.add(entry.task, &entry.column(), folder, &recipe);
                    }
                }
            }
        }
    }
    let networks = networks(&sweep.directory.join("runs"));
    study.costs.splice(0..0, networks.values().cloned());
    let mut at = networks.len();
    for entry in sweep.entries().iter().filter(|e| e.kind == Kind::Augment) {
        // Only its time is of interest here: the rows themselves are verified by whoever reads them.
        let Ok(Some(outcome)) = sweep.outcome(entry) else { continue };
        // The record is of the whole augmentation; the networks have a record of their own.
        let stage = sweep.directory.join(&outcome.place);
        let training = networks_of(&stage).and_then(|name| networks.get(&name)).map_or(0.0, |cost| cost.seconds);
        let rest = outcome.seconds - training;
        let cost = Cost {
            stage: "Labels, sampling, filter".into(),
            agent: entry.task.agent,
            // Networks that were there already took none of this time.
            seconds: if rest > 0.0 { rest } else { outcome.seconds },
            seeds: 1,
            memory: outcome.memory,
        };
        study.costs.insert(at, cost);
        at += 1;
    }
    Ok(study)
}

/// The kind of work in costs; records have it, so that it does not change.
fn training_stage(title: &str) -> String {
    format!("Learning and evaluation, {title}")
}

fn method_title(methods: &[Method], id: &str) -> String {
    methods.iter().find(|m| m.id == id).map_or_else(|| id.to_owned(), |m| m.title.clone())
}

/// Refuses a sweep's record that says something else than the run itself.
fn agree(sweep: &Sweep, entry: &Entry, recorded: Option<f64>, folder: &RunFolder) -> Result<()> {
    let found = match folder.members.iter().find(|m| m.seed == entry.seed).map(|m| &m.verdict) {
        Some(Verdict::Score(score)) => Some(*score),
        Some(_) => None,
        None => {
            let seeds: Vec<u64> = folder.members.iter().map(|m| m.seed).collect();
            return Err(ReportError::field(
                &folder.directory.join("done.json"),
                "summary.seeds",
                format!("{seeds:?}"),
                format!("{} among them, as the manifest has it", entry.seed),
                "remove the run's folder and its record in done/, and launch the sweep again",
            )
            .into());
        }
    };
    if recorded.map(f64::to_bits) == found.map(f64::to_bits) {
        return Ok(());
    }
    let text = |score: Option<f64>| score.map_or("null".to_owned(), |s| s.to_string());
    Err(ReportError::field(
        &sweep.directory.join("done").join(format!("{}.json", entry.id)),
        "score",
        text(recorded),
        format!("{}, as {} has it", text(found), folder.directory.join("done.json").display()),
        "remove the record and launch the sweep again",
    )
    .into())
}

/// What lies in `directory`.
fn entries(directory: &Path) -> Result<Vec<PathBuf>> {
    let entries = fs::read_dir(directory).map_err(|e| FileError::new(directory, "read the directory", e))?;
    Ok(entries.flatten().map(|e| e.path()).collect())
}

/// The directories in `directory`, ascending, without hidden ones.
fn directories(directory: &Path) -> Result<Vec<PathBuf>> {
    let mut found: Vec<PathBuf> = entries(directory)?.into_iter().filter(|p| p.is_dir()).collect();
    found.retain(|p| !name_of(p).starts_with('.'));
    found.sort();
    Ok(found)
}

fn name_of(path: &Path) -> String {
    path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned())
}

/// The task whose [`Task::directory`] this is.
pub fn task_of(directory: &Path) -> Option<Task> {
    name_of(directory).replacen('_', ":", 1).replace("-to-", "->").parse().ok()
}

fn of_runs(directory: &Path, recipes: &mut Recipes) -> Result<Study> {
    let mut finished: Vec<Finished> = Vec::new();
    let mut missing: Vec<Missing> = Vec::new();
    for (of, place) in directories(directory)?.iter().filter_map(|p| Some((task_of(p)?, p))) {
        for run in directories(place)? {
            // METHOD-KEY, as stages are named.
            let full = name_of(&run);
            let Some((name, _)) = full.rsplit_once('-').filter(|_| run.join("spec.json").exists()) else { continue };
            let mut lost = |why: String| {
                let what = format!("{name}, {of}, {}", run.display());
                missing.push(Missing { task: of, method: name.to_owned(), seed: None, what, why });
            };
            match RunFolder::read(&run)? {
                None => lost("not finished: no done.json".into()),
                Some(folder) => match folder.damage() {
                    Some(what) => lost(format!("corrupt: {what}")),
                    None => {
                        let recipe = recipes.of(of, name, &folder);
                        finished.push(Finished { task: of, name: name.to_owned(), folder, recipe });
                    }
                },
            }
        }
    }
    if finished.is_empty() && missing.is_empty() {
        return Err(Error::missing(
            directory,
            "found neither a sweep (manifest.jsonl) nor runs (TASK/METHOD-KEY/spec.json) nor a record of `tce sweep export`; give the \
             folder of `tce sweep plan --out`, that of `tce run --out`, which is runs/ unless told otherwise, or a record",
        ));
    }
    let mut notes = Vec::new();
    let ids = columns(&finished, &mut notes);
    let mut methods: Vec<Method> = Vec::new();
    for (name, id) in finished.iter().map(|f| &f.name).zip(&ids).chain(missing.iter().map(|m| (&m.method, &m.method))) {
        if methods.iter().any(|m| m.id == *id) {
            continue;
        }
        let label = id.strip_prefix(name.as_str()).unwrap_or_default().trim();
        let folder = finished.iter().zip(&ids).find(|(_, of)| *of == id).map(|(run, _)| &run.folder);
        // As above.
        let config = folder.and_then(|f| toml::from_str(&f.config).ok());
        methods.push(match Variant::from_str(name, false) {
            Ok(variant) => Method { id: id.clone(), ..method(variant, label, config.as_ref()) },
            // A name of the user's own.
            Err(_) => named(id, name),
        });
    }
    let methods = in_order(methods);
    let name = directory.canonicalize().map_or_else(|_| name_of(directory), |d| name_of(&d));
    let diagnoses = diagnoses(directory, &mut notes);
    let recommended = recommended(directory, &mut notes);
    let costs = networks(directory).into_values().collect();
    let mut study = Study {
        methods,
        missing,
        notes,
        costs,
        diagnoses,
        recommended,
        ..Study::new(name, directory.display().to_string())
    };
    for (Finished { task, folder, recipe, .. }, id) in finished.into_iter().zip(ids) {
        study.costs.push(Cost {
            stage: training_stage(&method_title(&study.methods, &id)),
            agent: task.agent,
            seconds: folder.learning_seconds,
            seeds: folder.members.len(),
            memory: None,
        });
        study.add(task, &id, folder, &recipe);
    }
    Ok(study)
}

fn json(path: &Path) -> Option<Value> {
    serde_json::from_slice(&fs::read(path).ok()?).ok()
}

/// What the trainings of score networks under `root` cost, by the stage's name. A stage that cannot be read has no time: the runs
/// are what counts.
fn networks(root: &Path) -> BTreeMap<String, Cost> {
    let stages = directories(&root.join("stages")).unwrap_or_default();
    let cost = |stage: &PathBuf| {
        let name = name_of(stage);
        let spec = json(&stage.join("spec.json")).filter(|_| name.starts_with("networks-"))?;
        let seconds = json(&stage.join("done.json"))?["summary"]["seconds"].as_f64().filter(|s| *s >= 0.0)?;
        let agent = parse_agent(spec["spec"]["inputs"]["agent"].as_str()?).ok()?;
        let seeds = spec["spec"]["seeds"].as_array().map_or(1, Vec::len);
        Some((name, Cost { stage: "Score networks".into(), agent, seconds, seeds, memory: None }))
    };
    stages.iter().filter_map(cost).collect()
}

/// What `tce diagnose` found about runs under `root`. One that cannot be read is a note: the report is about more than that.
fn diagnoses(root: &Path, notes: &mut Vec<String>) -> Vec<Diagnosis> {
    let stages = directories(&root.join("stages")).unwrap_or_default();
    let finished = stages.iter().filter(|s| name_of(s).starts_with("diagnosis-") && s.join("done.json").exists());
    let read = |stage: &PathBuf| {
        let found = diagnosis::read(&stage.join("diagnosis.json"));
        found.map_err(|e| notes.push(format!("A diagnosis is left out. {e}"))).ok()
    };
    finished.filter_map(read).collect()
}

/// What `tce run` recommended for the tasks under `root`.
fn recommended(root: &Path, notes: &mut Vec<String>) -> Vec<Recommended> {
    let mut out = Vec::new();
    for place in directories(root).unwrap_or_default() {
        if let Some(task) = task_of(&place) {
            out.extend(verdict_of(task, &place.join("verdict.json"), Vec::new(), notes));
        }
    }
    out
}

/// The verdict in the file at `path` on the runs in the folders `among`; None without a file.
fn verdict_of(task: Task, path: &Path, among: Vec<String>, notes: &mut Vec<String>) -> Option<Recommended> {
    if !path.exists() {
        return None;
    }
    let verdict = json(path).unwrap_or_default();
    let (Some(method), Some(policy)) = (verdict["method"].as_str(), verdict["policy"].as_str()) else {
        notes.push(format!("A recommendation is left out: {} names no method and policy.", path.display()));
        return None;
    };
    // RUN/policy-seedN.safetensors
    let policy = Path::new(policy);
    let seed = policy.file_stem().and_then(|n| n.to_str()?.strip_prefix("policy-seed")?.parse().ok());
    Some(Recommended {
        task,
        folder: policy.parent().map(name_of),
        seed,
        method: method.to_owned(),
        sure: verdict["sure"].as_bool().unwrap_or(false),
        among,
    })
}

/// The verdicts of a sweep, whose files are what their records say; a verdict that is missing is a note.
fn verdicts(sweep: &Sweep, notes: &mut Vec<String>) -> Vec<Recommended> {
    let mut out = Vec::new();
    let mut missing = 0;
    for entry in sweep.entries().iter().filter(|e| e.kind == Kind::Verdict) {
        let Checked::Done(outcome) = sweep.check(entry) else {
            missing += 1;
            continue;
        };
        let run = |n: &usize| Some(name_of(&sweep.outcome(&sweep.entries()[*n]).ok()??.place));
        let among = entry.needs.iter().filter_map(run).collect();
        out.extend(verdict_of(entry.task, &sweep.directory.join(outcome.place).join("verdict.json"), among, notes));
    }
    if missing > 0 {
        notes.push(match missing {
            1 => "The recommendation of one task and seed is not made yet, or its files were changed.".into(),
            n => format!("The recommendations of {n} tasks and seeds are not made yet, or their files were changed."),
        });
    }
    out
}

/// The networks that the rows of a stage were generated by.
fn networks_of(generated: &Path) -> Option<String> {
    Some(json(&generated.join("spec.json"))?["spec"]["networks"].as_str()?.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Algorithm;
    use crate::sweep::Manifest;

    #[test]
    fn folders_name_their_task() {
        for task in Task::all() {
            assert_eq!(task_of(Path::new(&task.directory())), Some(task));
        }
        assert_eq!(task_of(Path::new("stages")), None);
        assert_eq!(task_of(Path::new("sac-from")), None);
    }

    #[test]
    fn a_column_is_called_what_its_runs_are() {
        let mut config = Variant::TceOg.own();
        config.learner.algorithm = Algorithm::Td3Bc;
        assert_eq!(method(Variant::TceOg, "", Some(&config)).title, "TCE(OG), td3-bc");
        assert_eq!(method(Variant::TceOg, "y0.1", None).title, "TCE(OG), y0.1");
        assert_eq!(method(Variant::Prior(Algorithm::Dmc, Mode::Published), "", None).title, "DmC (published)");
    }

    /// What another version planned can be reported, though not run.
    #[test]
    fn unknown_keys_of_a_plan_are_no_matter_of_its_report() {
        let dir = tempfile::tempdir().unwrap();
        let description = dir.path().join("old.toml");
        fs::write(&description, "tasks = [\"hopper-morph:medium->expert\"]\nvariants = [\"dara-published\"]\n")
            .unwrap();
        let mut manifest = Manifest::plan(&description).unwrap();
        manifest.header.configs.values_mut().for_each(|config| *config = format!("from_another_version = 1\n{config}"));
        let sweep = Sweep::create(&dir.path().join("sweep"), manifest).unwrap();
        assert!(sweep.manifest.config(&sweep.entries()[0]).is_err());
        let study = of_sweep(&sweep, &mut Recipes::default()).unwrap();
        assert!(study.methods.iter().any(|m| m.title == "DARA (published)"), "{:?}", study.methods);
    }

    #[test]
    fn all_baselines_come_first() {
        let some = [(Variant::TceOg, ""), (Variant::Bc, "y0.1"), (Variant::BcRaw, "")];
        let methods = in_order(some.map(|(variant, label)| method(variant, label, None)).to_vec());
        let ids: Vec<&str> = methods.iter().map(|m| m.id.as_str()).collect();
        assert_eq!(ids, ["bc-raw", "bc y0.1", "bc-top", "target-only", "bc-ensemble", "tce-og"]);
    }
}
