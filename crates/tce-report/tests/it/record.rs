//! Records: results without the folders that they came from.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use crate::common::{add, hopper, method, one_task, quick, write_folder};
use tce_data::{Agent, Task};
use tce_report::folder::Verdict;
use tce_report::{Change, Missing, Recipe, Study, analyse, merge, record};

const SCORES: [f64; 3] = [80.0, 81.0, 82.5];

/// A study of one task, with everything that a record keeps.
fn study(root: &Path) -> Study {
    let mut study = one_task(root, &[("bc", "BC", &[70.0, 71.0, 72.0]), ("tce-og", "TCE(OG)", &SCORES)]);
    study.directory = root.display().to_string();
    study.missing.push(Missing {
        task: hopper(),
        method: "tce-og".into(),
        seed: Some(7),
        what: "tce-og, seed 7".into(),
        why: "not done".into(),
    });
    study
}

/// `study` written to a record and read again.
fn read_again(study: &Study, path: &Path) -> Study {
    record::write(study, path).unwrap();
    record::read(path).unwrap()
}

#[test]
fn a_record_gives_the_same_figures_as_the_folders() {
    let root = tempfile::tempdir().unwrap();
    let study = study(root.path());
    let path = root.path().join("results.jsonl");
    let again = read_again(&study, &path);
    let figures = |s: &Study| serde_json::to_value(analyse(s, &quick()).unwrap()).unwrap();
    assert_eq!(figures(&again), figures(&study));
    let run = &again.runs[4];
    assert_eq!((run.member.seed, &run.member.verdict), (1, &Verdict::Score(81.0)));
    assert_eq!(run.member.returns, [810.0, 972.0]);
    assert_eq!((run.folder.directory.to_str(), run.folder.config.as_str()), (Some("tce-og"), "a = 1\n"));
    assert_eq!(run.folder.files.len(), 1, "hashes stay");
    // Written from the record, it is the record: folders are named relative to where they were.
    assert_eq!(record::to_text(&Study { directory: "x".into(), ..again }), fs::read_to_string(&path).unwrap());
}

#[test]
fn runs_that_two_records_have_count_once() {
    let root = tempfile::tempdir().unwrap();
    let study = study(root.path());
    let record = read_again(&study, &root.path().join("a.jsonl"));
    let both = merge(vec![study.clone(), record.clone()]);
    assert_eq!((both.runs.len(), both.missing.len(), both.methods.len()), (6, 1, 2));
    assert!(both.conflicts.is_empty() && both.notes.is_empty());
    // The run that the record lacks is in the second study, and another score of a run is a fault of determinism.
    let mut later = one_task(&root.path().join("b"), &[("bc", "BC", &[70.0, 71.0, 73.0])]);
    later.methods.push(method("tce-og", "TCE(OG)", false));
    let directory = root.path().join("seven");
    write_folder(&directory, &[(7, Some(85.0))], "a = 1\n");
    add(&mut later, hopper(), "tce-og", &directory);
    let both = merge(vec![record, later]);
    assert_eq!((both.runs.len(), both.missing.len(), both.conflicts.len()), (7, 0, 1), "{:?}", both.conflicts);
    assert!(
        both.conflicts[0].starts_with("bc, hopper-morph/medium/expert, seed 2: 72.0 (bc, tce 0.1.0, ), and 73.0 ("),
        "{:?}",
        both.conflicts
    );
    let first: Vec<f64> = both
        .runs
        .iter()
        .filter_map(|r| if let Verdict::Score(s) = r.member.verdict { Some(s) } else { None })
        .collect();
    assert_eq!(first, [70.0, 71.0, 72.0, 80.0, 81.0, 82.5, 85.0]);
}

/// Of a folder with three members a merge may keep two; its record has these.
#[test]
fn a_record_of_a_merge_has_every_run_once() {
    let root = tempfile::tempdir().unwrap();
    let mut one = one_task(root.path(), &[("bc", "BC", &[70.0])]);
    one.name = "one".into();
    let three = one_task(&root.path().join("b"), &[("bc", "BC", &[70.0, 71.0, 72.0])]);
    let both = merge(vec![one, three]);
    let again = read_again(&both, &root.path().join("both.jsonl"));
    let scores = |s: &Study| s.runs.iter().map(|r| (r.member.seed, r.member.verdict.clone())).collect::<Vec<_>>();
    assert_eq!(
        scores(&again),
        [70.0, 71.0, 72.0].iter().zip(0..).map(|(s, k)| (k, Verdict::Score(*s))).collect::<Vec<_>>()
    );
    // A run that is there twice would count as two seeds.
    let text = record::to_text(&both);
    let run = text.lines().find(|l| l.starts_with("{\"run\"")).unwrap();
    let path = root.path().join("twice.jsonl");
    fs::write(&path, format!("{text}{run}\n")).unwrap();
    let error = record::read(&path).unwrap_err().to_string();
    assert!(error.contains("a second run of bc, hopper-morph/medium/expert, seed 0"), "{error}");
}

#[test]
fn other_settings_and_other_methods_of_one_name_are_columns_of_their_own() {
    let root = tempfile::tempdir().unwrap();
    let first = study(root.path());
    let mut other = one_task(&root.path().join("b"), &[]);
    other.methods = vec![method("bc", "BC", true), method("tce-og", "another thing", false)];
    other.name = "mine".into();
    for (id, folder) in [("bc", "b/bc"), ("tce-og", "b/og")] {
        let directory = root.path().join(folder);
        write_folder(&directory, &[(0, Some(50.0))], "a = 2\n");
        add(&mut other, hopper(), id, &directory);
    }
    let both = merge(vec![first.clone(), other.clone()]);
    let ids = |study: &Study| study.methods.iter().map(|m| m.id.clone()).collect::<Vec<_>>();
    assert_eq!(ids(&both), ["bc (demo)", "bc (mine)", "tce-og", "tce-og (mine)"]);
    assert_eq!((both.runs[6].method.as_str(), both.runs[7].method.as_str()), ("bc (mine)", "tce-og (mine)"));
    assert!(both.notes[0].starts_with("bc: the studies have it with different settings"), "{:?}", both.notes);
    // Of other seeds, too: they are no further seeds of the same work.
    let mut late = one_task(&root.path().join("c"), &[]);
    late.methods = vec![method("bc", "BC", true)];
    late.name = "late".into();
    let directory = root.path().join("c/bc");
    write_folder(&directory, &[(7, Some(50.0))], "a = 3\n");
    add(&mut late, hopper(), "bc", &directory);
    assert_eq!(ids(&merge(vec![first.clone(), late]))[..2], ["bc (demo)", "bc (late)"]);
    // The record of a study beside it changes nothing.
    let record = read_again(&other, &root.path().join("mine.jsonl"));
    let three = merge(vec![first, other, record]);
    assert_eq!((ids(&three), three.runs.len()), (ids(&both), both.runs.len()));
}

/// Settings that a run does not use make no difference: its recipe decides. What one study lacks is found in another's column.
#[test]
fn runs_of_one_recipe_are_one_column_whatever_study_they_are_from() {
    let root = tempfile::tempdir().unwrap();
    let recipe = |changed: &[&str]| {
        let change = |key: &&str| Change { key: (*key).into(), value: "1".into(), preset: "0".into() };
        Arc::new(Recipe {
            preset: Some("default".into()),
            changed: changed.iter().map(change).collect(),
            ..Recipe::default()
        })
    };
    // One run of `bc` with a configuration of its own.
    let one = |name: &str, seed: u64, config: &str, changed: &[&str]| {
        let mut study = one_task(&root.path().join(name), &[]);
        study.methods = vec![method("bc", "BC", true)];
        study.name = name.into();
        let directory = root.path().join(name).join("bc");
        write_folder(&directory, &[(seed, Some(50.0))], config);
        add(&mut study, hopper(), "bc", &directory);
        study.runs[0].recipe = recipe(changed);
        study
    };
    let columns = |study: &Study| study.runs.iter().map(|r| r.method.clone()).collect::<Vec<_>>();
    let (first, second) = (one("first", 0, "unused = 1\n", &[]), one("second", 1, "unused = 2\n", &[]));
    assert_eq!(columns(&merge(vec![first.clone(), second.clone()])), ["bc", "bc"], "two seeds of one method");
    let mut third = one("third", 0, "fade = 1\n", &["fade"]);
    third.missing.push(Missing {
        task: hopper(),
        method: "bc".into(),
        seed: Some(1),
        what: "bc, seed 1".into(),
        why: "not done".into(),
    });
    let all = merge(vec![first, second, third.clone()]);
    assert_eq!(columns(&all), ["bc (first, second)", "bc (first, second)", "bc (third)"]);
    assert!(all.missing.is_empty(), "the second study has it: {:?}", all.missing);
    // A record of this has columns that are called after studies. Beside further runs they come apart and together again.
    let record = read_again(&all, &root.path().join("all.jsonl"));
    let more = merge(vec![record, one("fourth", 2, "fade = 2\n", &["fade"])]);
    assert_eq!(
        columns(&more),
        ["bc (first, second)", "bc (first, second)", "bc (third, fourth)", "bc (third, fourth)"]
    );
    // In one study on different tasks they stay one column, and the reader is told.
    third.missing.clear();
    let directory = root.path().join("ant");
    write_folder(&directory, &[(0, Some(40.0))], "fade = 0\n");
    add(&mut third, Task { agent: Agent::Ant, ..hopper() }, "bc", &directory);
    third.runs[1].recipe = recipe(&[]);
    let analysis = analyse(&third, &quick()).unwrap();
    let told =
        analysis.warnings.iter().find(|w| w.text.contains("BC has different settings on different tasks")).unwrap();
    assert_eq!(
        told.details,
        ["preset default: ant-morph/medium/expert", "preset default, fade = 1: hopper-morph/medium/expert"]
    );
}

#[test]
fn a_damaged_record_names_its_line() {
    let root = tempfile::tempdir().unwrap();
    let path = root.path().join("results.jsonl");
    record::write(&study(root.path()), &path).unwrap();
    let whole = fs::read_to_string(&path).unwrap();
    let read = |text: String| {
        fs::write(&path, text).unwrap();
        record::read(&path).unwrap_err().to_string()
    };
    for (text, needles) in [
        (whole.replace("a = 1", "a = 2"), ["line 4", "settings with the hash"]),
        (whole.replace("\"format\":1", "\"format\":9"), ["record.format", "found 9, written by tce"]),
        (whole.replace("{\"method\":{\"id\":\"bc\"", "{\"method\":{\"id\":\"other\""), ["line 5", "method \"bc\""]),
        (whole.replace("{\"config\"", "{\"configuration\""), ["line 4", "configuration"]),
        (whole[..whole.len() - 20].to_owned(), ["line 7", "EOF"]),
        ("{}\n".into(), ["line 1", "header of a record"]),
        (String::new(), ["the file is empty", "tce sweep export"]),
    ] {
        let error = read(text);
        assert!(needles.iter().all(|n| error.contains(n)) && error.contains("results.jsonl"), "{error}");
    }
    assert!(record::read(&root.path().join("bc/metrics.jsonl")).is_err(), "metrics are none");
    assert!(record::read(root.path()).is_err());
}
