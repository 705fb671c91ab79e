//! `tce diagnose`, through the real binary.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use crate::common::{TINY, data_pair, message, random_rows, tce, tce_json};
use serde_json::Value;
use tce_data::{Agent, Shift, save_d4rl};

const FEW: &[&str] = &[
    "--rows",
    "200",
    "--y-max",
    "0,0.5",
    "--transition-steps",
    "40",
    "--value-steps",
    "20",
    "--abundant",
    "400",
    "--episodes",
    "2",
];

/// A tiny run on Hopper, as its table tells it.
fn finished(directory: &Path, data: &[&str], more: &[&str]) -> Value {
    tce_json(directory, &[&["run", "hopper-morph:medium->expert"], more, data, TINY].concat())
}

/// The metrics at one label bound.
fn at(diagnosis: &Value, y: f64) -> &Value {
    diagnosis["bounds_of_y"].as_array().unwrap().iter().find(|b| b["y_max"] == y).expect("on the grid")
}

fn file(directory: &Path, diagnosis: &Value, name: &str) -> String {
    let files = diagnosis["files"].as_array().unwrap();
    let path = files.iter().map(|f| f.as_str().unwrap()).find(|f| f.ends_with(name)).unwrap();
    fs::read_to_string(directory.join(path)).unwrap()
}

#[test]
fn a_run_is_measured_and_its_report_shows_it() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let data = ["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()];
    let run = finished(dir.path(), &data, &["--variant", "tce-og,target-source", "--out", "out"]);
    let place = |variant: &str| {
        let rows = run["rows"].as_array().unwrap();
        rows.iter().find(|r| r["variant"] == variant).unwrap()["directory"].as_str().unwrap().to_owned()
    };
    let (og, plain) = (place("tce-og"), place("target-source"));
    let diagnose = |run: &str, more: &[&str]| {
        [&["diagnose", run][..], &data, FEW, more].concat().iter().map(|s| s.to_string()).collect::<Vec<_>>()
    };
    let json = |args: &[String]| tce_json(dir.path(), &args.iter().map(String::as_str).collect::<Vec<_>>());

    let found = json(&diagnose(&og, &["--threads", "1"]));
    // The run's own bound is among them.
    for y in [0.0, 0.2, 0.5] {
        let b = at(&found, y);
        let share = |v: &Value| (0.0..=1.0).contains(&v.as_f64().unwrap());
        assert!(share(&b["coverage"]["target"]) && share(&b["coverage"]["source"]) && share(&b["rejected"]), "{b}");
        for metric in ["distance", "transition_kl", "reward_difference", "reward_error", "consistency"] {
            assert!(b["kept"][metric]["median"].as_f64().unwrap() > 0.0, "{metric} at {y}");
        }
    }
    assert_eq!(found["task"], "hopper-morph:medium->expert");
    for bound in ["transition", "value", "transition_alone", "value_alone"] {
        assert_eq!(found["theorem"][bound]["nearest"].as_array().unwrap().len(), 10, "{bound}");
    }
    assert!(found["choice"]["lambda"].is_number() && at(&found, 0.2)["memorisation"]["probability"].is_number());
    assert!(found["transitions"]["groups"].as_array().unwrap().len() == 4);
    let implied = &found["implied"];
    for metric in ["single", "mean", "between_draws", "inverse", "spread"] {
        assert!(implied["actions"]["trained"][metric].as_f64().unwrap() > 0.0, "{metric}: {implied}");
    }
    assert!(implied["actions"]["held_out"].is_null(), "all rows were trained on");
    assert!(implied["rollout"]["episodes"] == 2 && implied["rollout"]["score"][0].is_number(), "{implied}");
    let bins = found["error_over_distance"]["bins"].as_array().unwrap();
    assert!(bins.len() == 10 && bins.iter().all(|b| b["error"]["median"].as_f64().unwrap() > 0.0), "{bins:?}");
    assert_eq!(found["error_over_distance"]["simulated"], true);

    // The terminal says first what to do, in lines of 80 columns but for the files' names.
    let args = diagnose(&og, &[]);
    let said = tce(dir.path(), &args.iter().map(String::as_str).collect::<Vec<_>>());
    let said = String::from_utf8_lossy(&said.stdout).into_owned();
    let first = said.lines().next().unwrap();
    assert!(first.contains("se these rows, because") || first.starts_with("The data do not tell"), "{said}");
    for line in said.lines().filter(|l| !l.contains("/stages/") && !l.contains(", seed ")) {
        assert!(line.chars().count() <= 80, "{line}");
    }

    // The same bytes with two threads, elsewhere; and at once where it is done.
    let bytes = file(dir.path(), &found, "diagnosis.json");
    let elsewhere = json(&diagnose(&og, &["--threads", "2", "--out", "elsewhere"]));
    assert_eq!(file(dir.path(), &elsewhere, "diagnosis.json"), bytes);
    assert_eq!(json(&diagnose(&og, &[])), found);

    let page = file(dir.path(), &found, "diagnosis.html");
    assert!(page.contains("Theorem 1 over λ") && !page.contains("NaN"));
    assert!(page.contains("The action that the generator implies") && page.contains("Label error against distance"));
    // A file from before these were measured.
    let mut old: Value = serde_json::from_str(&bytes).unwrap();
    for field in ["implied", "error_over_distance"] {
        assert!(old.as_object_mut().unwrap().remove(field).is_some(), "{field}");
    }
    let old: tce_diagnosis::Diagnosis = serde_json::from_value(old).unwrap();
    assert!(old.implied.is_none() && old.error_over_distance.is_none());
    tce_json(dir.path(), &["report", "out", "--resamples", "200"]);
    let report = fs::read_to_string(dir.path().join("out/report.html")).unwrap();
    assert!(report.contains("λ from the data alone") && report.contains("Dynamics consistency"));

    // What cannot be diagnosed is refused.
    let refused = |args: &[String], code: i32, expected: &str| {
        let output = tce(dir.path(), &args.iter().map(String::as_str).collect::<Vec<_>>());
        assert_eq!(output.status.code(), Some(code), "{}", message(&output));
        assert!(message(&output).contains(expected), "{}", message(&output));
    };
    refused(&diagnose(&plain, &[]), 2, "found mixture.generated = None, expected \"tce\"");
    refused(
        &["diagnose", &og, "--transition-steps", "0"].map(str::to_owned),
        2,
        "--transition-steps 0: expected at least 1",
    );
    refused(&diagnose("out/nothing", &[]), 1, "spec.json: no such file; give the directory of a finished run");
    // Before its data are looked for.
    let absent = ["diagnose", &og, "--seed", "7", "--source", "absent.hdf5", "--target", "absent.hdf5"];
    refused(&absent.map(str::to_owned), 2, "the run's seeds are [0]");
    refused(&diagnose(&og, &["--set", "learner.steps=1"]), 2, "a run has its configuration");
    let other = ["diagnose", &og, "--source", target.to_str().unwrap(), "--target", source.to_str().unwrap()];
    refused(&other.map(str::to_owned), 2, "name the run's own file with --target");
}

#[test]
fn two_files_of_ones_own_need_no_simulator() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Gravity);
    let mut args = vec!["diagnose", "--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()];
    args.extend(FEW);
    args.extend(TINY);
    let found = tce_json(dir.path(), &args);
    assert!(found["task"].is_null() && found["choice"]["lambda"].is_number());
    assert!(at(&found, 0.0)["kept"]["transition_kl"].is_null(), "no abundant rows without a simulator");
    assert!(
        found["theorem"]["value"].is_null() && found["theorem"]["value_alone"]["generated"]["rows"].as_u64() > Some(0)
    );
    assert!(found["implied"]["actions"]["trained"]["single"].is_number() && found["implied"]["rollout"].is_null());
    assert_eq!(found["error_over_distance"]["simulated"], false);
    let note = found["notes"][0].as_str().unwrap();
    assert!(note.contains("Without the simulator"), "{note}");

    // Fewer target rows: as if the log had ended there.
    args.extend(["--set", "target.rows=150"]);
    assert_eq!(tce_json(dir.path(), &args)["target_rows"], 150);
    *args.last_mut().unwrap() = "target.rows=50";
    let output = tce(dir.path(), &args);
    assert_eq!(output.status.code(), Some(2));
    assert!(message(&output).contains("found 50 target rows, expected at least 100"), "{}", message(&output));
}

/// The wiring of Theorem 1 with a known answer: source rows that the target's dynamics made are at no distance from them, and the
/// simulator takes all of them (λ = 1), while rows of the other dynamics are.
#[test]
fn source_rows_of_the_targets_dynamics_have_no_discrepancy() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let same = dir.path().join("same.hdf5");
    save_d4rl(&same, &random_rows(Agent::Hopper, Shift::Morph, 1500, 3), &BTreeMap::new(), &[]).unwrap();
    let diagnosed = |source: &Path, out: &str| {
        let data = ["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()];
        let run = finished(dir.path(), &data, &["--variant", "tce-og", "--no-baselines", "--out", out]);
        let place = run["rows"][0]["directory"].as_str().unwrap();
        tce_json(dir.path(), &[&["diagnose", place][..], &data, FEW].concat())
    };
    let source_gap = |found: &Value| found["theorem"]["value"]["nearest"][9].as_f64().unwrap();
    let generated = |found: &Value| found["theorem"]["value"]["nearest"][0].as_f64().unwrap();
    let (same, other) = (diagnosed(&same, "same"), diagnosed(&source, "other"));
    assert!(source_gap(&same) < 1e-3 * generated(&same), "{}", same["theorem"]["value"]);
    assert!(source_gap(&other) > 1e-2 * generated(&other), "{}", other["theorem"]["value"]);
    assert_eq!(same["choice_by_simulator"]["lambda"], 1.0);
    assert_eq!(same["choice_by_simulator"]["told"], true);
}

/// The stage of a run's networks is the one that is looked at, a row for every cycle of q_tran.
#[test]
fn networks_of_every_cycle_are_measured() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let data = ["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap(), "--out", "out"];
    let auto = [
        "--set",
        "generator.transition_steps=\"auto\"",
        "--set",
        "generator.until_done={ first = 20, transition_limit = 60, gain = -100.0, held_out = 0.1 }",
    ];
    let run = ["run", "hopper-morph:medium->expert", "--variant", "tce-og", "--no-baselines"];
    tce_json(dir.path(), &[&run[..], &data, TINY, &auto].concat());
    let stages = || fs::read_dir(dir.path().join("out/stages")).unwrap().count();
    let before = stages();
    let cycles =
        ["diagnose", "generator", "hopper-morph:medium->expert", "--cycles", "--rows", "200", "--episodes", "2"];
    let args = [&cycles[..], &data, TINY, &auto].concat();
    let found = tce_json(dir.path(), &[&args[..], &["--threads", "1"]].concat());
    assert_eq!(stages(), before, "nothing was trained");
    let networks = found["networks"].as_array().unwrap();
    assert_eq!(networks.iter().map(|n| n["updates"].as_u64().unwrap()).collect::<Vec<_>>(), [20, 60]);
    assert_eq!(networks.iter().filter(|n| n["chosen"] == true).count(), 1);
    for n in networks {
        assert!(n["held_out_loss"].is_number() && n["training_loss"].is_number(), "{n}");
        assert!(n["consistency"]["median"].is_number() && n["rollout"]["score"][0].is_number(), "{n}");
        assert!(n["actions"]["trained"]["single"].is_number() && n["actions"]["held_out"]["rows"] == 50, "{n}");
    }
    assert_eq!(tce_json(dir.path(), &[&args[..], &["--threads", "2"]].concat()), found);
}

/// A diagnosis is of the run's own networks, also where they have not seen the source rows that it compares with.
#[test]
fn a_run_that_does_not_see_the_source_is_diagnosed_with_its_own_networks() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let data = ["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()];
    let run = finished(dir.path(), &data, &["--variant", "simple-aug", "--no-baselines", "--out", "out"]);
    let place = run["rows"][0]["directory"].as_str().unwrap();
    let found = tce_json(dir.path(), &[&["diagnose", place][..], &data, FEW].concat());
    assert!(at(&found, 0.0)["coverage"]["source"].is_number(), "{found}");
    let stages = fs::read_dir(dir.path().join("out/stages")).unwrap().map(|e| e.unwrap().file_name());
    let stages: Vec<String> = stages.map(|name| name.into_string().unwrap()).collect();
    for kind in ["networks-", "labels-"] {
        assert_eq!(stages.iter().filter(|s| s.starts_with(kind)).count(), 1, "{kind} of the run alone: {stages:?}");
    }
}

/// One of two seeds is looked at, and not the other.
#[test]
fn the_seed_asked_for_is_the_one_that_is_measured() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let data = ["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()];
    let more = ["--variant", "tce-og", "--no-baselines", "--seeds", "2", "--out", "out"];
    let run = finished(dir.path(), &data, &more);
    let place = run["rows"][0]["directory"].as_str().unwrap();
    // What the label models of each seed got wrong on their own held-out rows.
    let stages = fs::read_dir(dir.path().join("out/stages")).unwrap().map(|e| e.unwrap().path());
    let labels = stages.into_iter().find(|p| p.file_name().unwrap().to_str().unwrap().starts_with("labels-")).unwrap();
    let done: Value = serde_json::from_slice(&fs::read(labels.join("done.json")).unwrap()).unwrap();
    let mut distances = Vec::new();
    for seed in [0, 1] {
        let name = seed.to_string();
        let found = tce_json(dir.path(), &[&["diagnose", place, "--seed", &name][..], &data, FEW].concat());
        assert_eq!(found["seed"], seed);
        let expected = &done["summary"][seed]["action_rmse"];
        assert!(expected.is_number() && found["labels"]["held_out_action"][0] == *expected, "{found}");
        distances.push(at(&found, 0.2)["kept"]["distance"]["median"].as_f64().unwrap());
    }
    assert_ne!(distances[0], distances[1], "rows of the other seed's generator");
}

/// A filter that leaves nothing is refused by name.
#[test]
fn a_filter_that_rejects_everything_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let files = ["diagnose", "--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()];
    let args = [&files[..], FEW, TINY, &["--set", "filter.enabled=true", "--set", "filter.z_threshold=0.1"]].concat();
    let output = tce(dir.path(), &args);
    assert_eq!(output.status.code(), Some(1), "{}", message(&output));
    assert!(message(&output).contains("the filter rejected all 200 generated rows"), "{}", message(&output));
}
