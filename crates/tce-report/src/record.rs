//! Results without the folders that they came from: scores, returns, settings and hashes of many runs in one file.
//!
//! The folders of a sweep are large and belong to one machine. What they found is small: `tce sweep export` writes it to a record, and
//! `tce report` reads records beside sweeps. A record is JSON Lines, one object a line, each with one key that tells what it is:
//!
//! | key | content |
//! |---|---|
//! | `record` | first line: version of the format, the study's name, the program that wrote it, whether it was a sweep |
//! | `method` | a column of the tables |
//! | `config` | a configuration as TOML, and its hash |
//! | `run` | a finished run: task, method, recipe, and all that [`RunFolder`] holds but configuration and curves |
//! | `missing`, `conflict`, `note`, `recommended`, `cost` | as in [`Study`] |
//!
//! Lines have a fixed order, so that a record that gains runs changes by added lines.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tce_base::{PROGRAM, read_if_there, write_atomically};
use tce_data::Task;

use crate::error::{ReportError, Result};
use crate::folder::{RunFolder, config_hash};
use crate::study::{Cost, Method, Missing, Recipe, Recommended, Run, Study, order};

/// Version of the format. Increase it when older records cannot be read.
const FORMAT: u32 = 1;
/// What to do about a damaged record.
const AGAIN: &str = "write the record again with `tce sweep export`, or take it back from version control";

/// A line of a record; see the [module](self).
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Line {
    Record { format: u32, name: String, program: String, sweep: bool },
    Method(Method),
    Config { hash: String, toml: String },
    Run { task: Task, method: String, recipe: Recipe, folder: Box<RunFolder> },
    Missing(Missing),
    Conflict(String),
    Note(String),
    Recommended(Recommended),
    Cost(Cost),
}

/// The first line, of any version.
#[derive(Deserialize)]
struct AnyRecord {
    record: AnyHeader,
}

#[derive(Deserialize)]
struct AnyHeader {
    format: u32,
    program: String,
}

/// The record of `study`, as text. Of a run's folder only the name is kept.
pub fn to_text(study: &Study) -> String {
    let header = Line::Record { format: FORMAT, name: study.name.clone(), program: PROGRAM.into(), sweep: study.sweep };
    let mut lines = vec![header];
    let used = |m: &&Method| {
        m.baseline || study.runs.iter().any(|r| r.method == m.id) || study.missing.iter().any(|r| r.method == m.id)
    };
    lines.extend(study.methods.iter().filter(used).cloned().map(Line::Method));
    let configs: BTreeMap<&str, &str> =
        study.runs.iter().map(|r| (r.folder.config_hash.as_str(), r.folder.config.as_str())).collect();
    lines.extend(configs.into_iter().map(|(hash, toml)| Line::Config { hash: hash.into(), toml: toml.into() }));
    // One line a folder, with those of its members that the study has.
    let mut folders: BTreeMap<(*const RunFolder, Task, &str), Vec<&Run>> = BTreeMap::new();
    for run in &study.runs {
        folders.entry((Arc::as_ptr(&run.folder), run.task, &run.method)).or_default().push(run);
    }
    let mut folders: Vec<Vec<&Run>> = folders.into_values().collect();
    folders.sort_by_key(|group| {
        let first = group[0];
        (order(&first.task), first.method.clone(), first.member.seed, first.folder.config_hash.clone())
    });
    lines.extend(folders.into_iter().map(|group| {
        let first = group[0];
        let name = first.folder.directory.file_name().map_or_else(PathBuf::new, PathBuf::from);
        let generated = group.iter().filter_map(|r| r.folder.generated.get(r.index).copied()).collect();
        let members = group.iter().map(|r| r.member.clone()).collect();
        let folder = RunFolder { directory: name, members, generated, curves: Vec::new(), ..(*first.folder).clone() };
        let (method, recipe) = (first.method.clone(), (*first.recipe).clone());
        Line::Run { task: first.task, method, recipe, folder: Box::new(folder) }
    }));
    lines.extend(study.recommended.iter().cloned().map(Line::Recommended));
    lines.extend(study.missing.iter().cloned().map(Line::Missing));
    lines.extend(study.conflicts.iter().cloned().map(Line::Conflict));
    lines.extend(study.notes.iter().cloned().map(Line::Note));
    lines.extend(study.costs.iter().cloned().map(Line::Cost));
    lines.iter().map(|line| serde_json::to_string(line).expect("plain data") + "\n").collect()
}

/// Writes the record of `study` to `path`, whole or not at all.
///
/// # Errors
/// If the file cannot be written.
pub fn write(study: &Study, path: &Path) -> Result<()> {
    Ok(write_atomically(path, to_text(study).as_bytes())?)
}

/// Reads a record.
///
/// # Errors
/// If there is no such file, it is damaged, or another version of the program wrote it: which line, and what was expected there.
pub fn read(path: &Path) -> Result<Study> {
    let nothing = |what: String| ReportError::Nothing { path: path.to_owned(), what };
    let bytes = read_if_there(path)?.ok_or_else(|| nothing("there is no such file".into()))?;
    let wrong = |line: usize, found: String, expected: &str| {
        ReportError::field(path, format!("(line {line})"), found, expected, AGAIN)
    };
    let text = String::from_utf8(bytes).map_err(|e| wrong(1, e.to_string(), "text in UTF-8"))?;
    let mut lines = text.lines().enumerate().map(|(n, line)| (n + 1, line));
    let (_, first) = lines.next().ok_or_else(|| nothing(format!("the file is empty; {AGAIN}")))?;
    let header: AnyRecord = serde_json::from_str(first)
        .map_err(|e| wrong(1, e.to_string(), "the header of a record of `tce sweep export`"))?;
    if header.record.format != FORMAT {
        return Err(ReportError::field(
            path,
            "record.format",
            format!("{}, written by {}", header.record.format, header.record.program),
            FORMAT.to_string(),
            "use that program, or write the record again with this one",
        ));
    }
    let parse = |n: usize, line: &str| {
        serde_json::from_str::<Line>(line).map_err(|e| wrong(n, e.to_string(), "a line of a record"))
    };
    let mut study = Study::new(String::new(), path.display().to_string());
    if let Line::Record { name, sweep, .. } = parse(1, first)? {
        (study.name, study.sweep) = (name, sweep);
    }
    let (mut configs, mut seen) = (BTreeMap::new(), BTreeSet::new());
    for (n, line) in lines {
        match parse(n, line)? {
            Line::Record { .. } => return Err(wrong(n, "a second header".into(), "one header, in the first line")),
            Line::Method(method) => {
                if study.methods.iter().any(|m| m.id == method.id) {
                    return Err(wrong(n, format!("a second method {:?}", method.id), "every method once"));
                }
                study.methods.push(method);
            }
            Line::Config { hash, toml } => {
                if config_hash(&toml) != hash {
                    return Err(wrong(
                        n,
                        format!("settings with the hash {}", config_hash(&toml)),
                        &format!("the hash {hash}"),
                    ));
                }
                configs.insert(hash, toml);
            }
            Line::Run { task, method, recipe, folder } => {
                let config = configs.get(&folder.config_hash).cloned();
                let config = config.ok_or_else(|| {
                    let found = format!("settings {}, which no line before has", folder.config_hash);
                    wrong(n, found, "a `config` line before the runs of these settings")
                })?;
                if !study.methods.iter().any(|m| m.id == method) {
                    return Err(wrong(n, format!("method {method:?}"), "a `method` line of this id before the run"));
                }
                let folder = RunFolder { config, ..*folder };
                let twice = folder.members.iter().find(|member| !seen.insert((task, method.clone(), member.seed)));
                if let Some(member) = twice {
                    let found = format!("a second run of {method}, {task}, seed {}", member.seed);
                    return Err(wrong(n, found, "one run for every method, task and seed"));
                }
                study.add(task, &method, folder, &Arc::new(recipe));
            }
            Line::Missing(missing) => study.missing.push(missing),
            Line::Conflict(conflict) => study.conflicts.push(conflict),
            Line::Note(note) => study.notes.push(note),
            Line::Recommended(recommended) => study.recommended.push(recommended),
            Line::Cost(cost) => study.costs.push(cost),
        }
    }
    Ok(study)
}
