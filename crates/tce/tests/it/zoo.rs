//! The actors that come with the program, through the real binary.

use std::fs;

use crate::common::{TINY, tce, tce_json};

#[test]
fn cards_tell_the_truth() {
    let dir = tempfile::tempdir().unwrap();
    let all = tce_json(dir.path(), &["zoo", "list"]);
    let all = all.as_array().unwrap();
    assert!(all.iter().any(|e| e["name"] == "halfcheetah-source-medium"), "the zoo is empty");
    // HalfCheetah's episodes are all of one length and hardly differ: few of them tell.
    for name in ["halfcheetah-source-medium", "hopper-source-stage-7"] {
        let entry = all.iter().find(|e| e["name"] == name).unwrap();
        let rolled = tce_json(dir.path(), &["zoo", "rollout", name, "--episodes", "8", "--seed", "7"]);
        let returns: Vec<f64> = rolled[0]["returns"].as_array().unwrap().iter().map(|r| r.as_f64().unwrap()).collect();
        let mean = returns.iter().sum::<f64>() / returns.len() as f64;
        let (expected, std) = (entry["mean"].as_f64().unwrap(), entry["std"].as_f64().unwrap());
        assert!(
            (mean - expected).abs() < 4.0 * std / (8f64).sqrt(),
            "{name}: {mean}, its card says {expected} ± {std}"
        );
    }
    let shown = tce(dir.path(), &["zoo", "show", "halfcheetah-source-medium"]);
    let text = String::from_utf8_lossy(&shown.stdout).into_owned();
    assert!(text.contains("zoo:halfcheetah-source-medium") && text.contains("updates"), "{text}");
    let unknown = tce(dir.path(), &["zoo", "show", "frog"]);
    assert_eq!(unknown.status.code(), Some(2));
}

#[test]
fn the_zoos_actors_stand_wherever_a_policy_is_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let collect = |actor: &str, out: &str| {
        let args = ["collect", "--env", "hopper", "--actor", actor, "--rows", "300", "--lanes", "1", "--out", out];
        tce_json(dir.path(), &args)
    };
    let first = collect("zoo:hopper-source-medium", "a.hdf5");
    assert_eq!(first["content"]["rows"], 300);
    collect("zoo:hopper-source-medium", "b.hdf5");
    assert!(fs::read(dir.path().join("a.hdf5")).unwrap() == fs::read(dir.path().join("b.hdf5")).unwrap());
    let args = ["evaluate", "zoo:hopper-source-medium", "--env", "hopper", "--episodes", "1"];
    assert_eq!(tce_json(dir.path(), &args)[0]["returns"].as_array().unwrap().len(), 1);
    let walker = tce(dir.path(), &["evaluate", "zoo:hopper-source-medium", "--env", "walker2d"]);
    assert_eq!(walker.status.code(), Some(1));
    // D4RL's recipes by name.
    let args = ["collect", "--env", "hopper", "--quality", "medium-replay", "--rows", "400", "--out", "replay.hdf5"];
    let replay = tce_json(dir.path(), &args);
    assert!(replay["recipe"]["parts"].as_array().unwrap().len() > 2, "{replay}");
    assert_eq!(replay["content"]["rows"], 400);
}

#[test]
fn a_task_needs_no_files() {
    let dir = tempfile::tempdir().unwrap();
    let run = |out: &str, task: &str| {
        let args =
            ["run", task, "--variant", "target-source", "--no-baselines", "--set", "source.rows=2000", "--out", out];
        tce_json(dir.path(), &[&args[..], TINY].concat())
    };
    let report = run("one", "hopper-morph:medium->expert");
    assert_eq!(report["target"]["rows"], 5000);
    assert_eq!(report["source"]["rows"], 2000);
    assert!(report["target"]["score"].as_f64().unwrap() > 80.0, "{}", report["target"]);
    assert!(report["source"]["file"].as_str().unwrap().starts_with("one/data/hopper-source-medium-"));
    let again = run("two", "hopper-morph:medium->expert");
    let data = |report: &serde_json::Value, side: &str| {
        fs::read(dir.path().join(report[side]["file"].as_str().unwrap())).unwrap()
    };
    for side in ["source", "target"] {
        assert!(data(&report, side) == data(&again, side), "{side} rows differ between two collections");
    }
    assert_eq!(report["rows"][0]["scores"], again["rows"][0]["scores"]);
}

#[test]
fn what_the_zoo_lacks_is_said_before_anything_is_computed() {
    let dir = tempfile::tempdir().unwrap();
    let output = tce(dir.path(), &["collect", "--env", "hopper-gravity-5", "--quality", "expert", "--out", "x.hdf5"]);
    assert_eq!(output.status.code(), Some(2));
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.contains("the zoo has no actors"), "{message}");
    assert!(!dir.path().join("x.hdf5").exists());
}

/// Every task of the paper with medium source data, and Ant under five times its gravity, on a machine that has the program alone.
#[test]
fn the_zoo_has_the_data_of_every_target() {
    let dir = tempfile::tempdir().unwrap();
    let description = r#"
        tasks = ["*-morph/medium/*", "*-kinematic/medium/*", "*-gravity/medium/*", "ant-gravity-5/medium/medium"]
        variants = ["bc"]
        baselines = false
        from_zoo = true
    "#;
    fs::write(dir.path().join("all.toml"), description).unwrap();
    let planned = tce_json(dir.path(), &["sweep", "plan", "all.toml", "--dry-run"]);
    // Three shifts, four robots, three qualities; and one.
    assert_eq!(planned["target"], 37, "{planned}");
}
