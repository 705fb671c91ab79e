//! `tce diagnose`, through the real binary.

mod common;

use std::fs;
use std::path::Path;

use common::{TINY, data_pair, message, tce, tce_json};
use serde_json::Value;
use tce_data::{Agent, Shift};

const FEW: &[&str] =
    &["--rows", "200", "--y-max", "0,0.5", "--transition-steps", "40", "--value-steps", "20", "--abundant", "400"];

/// The figures at one label bound.
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
    let mut args = vec!["run", "hopper-morph:medium->expert", "--variant", "tce-og,target-source", "--out", "out"];
    args.extend(data);
    args.extend(TINY);
    let run = tce_json(dir.path(), &args);
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
        for figure in ["distance", "transition_kl", "reward_difference", "reward_error", "consistency"] {
            assert!(b["kept"][figure]["median"].as_f64().unwrap() > 0.0, "{figure} at {y}");
        }
    }
    assert_eq!(found["task"], "hopper-morph:medium->expert");
    for bound in ["transition", "value", "transition_alone", "value_alone"] {
        assert_eq!(found["theorem"][bound]["nearest"].as_array().unwrap().len(), 10, "{bound}");
    }
    assert!(found["choice"]["lambda"].is_number() && found["memorisation"]["probability"].is_number());
    assert!(found["transitions"]["groups"].as_array().unwrap().len() == 4);

    // The same bytes with two threads, elsewhere; and at once where it is done.
    let bytes = file(dir.path(), &found, "diagnosis.json");
    let elsewhere = json(&diagnose(&og, &["--threads", "2", "--out", "elsewhere"]));
    assert_eq!(file(dir.path(), &elsewhere, "diagnosis.json"), bytes);
    assert_eq!(json(&diagnose(&og, &[])), found);

    let page = file(dir.path(), &found, "diagnosis.html");
    assert!(page.contains("Theorem 1 over λ") && !page.contains("NaN"));
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
    refused(&diagnose("out/nothing", &[]), 1, "spec.json: no such file; give the directory of a finished run");
    refused(&diagnose(&og, &["--seed", "7"]), 2, "the run's seeds are [0]");
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
    assert!(found["theorem"]["value"].is_null() && found["theorem"]["value_alone"]["generated"].is_number());
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
