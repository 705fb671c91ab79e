//! docs/metrics.md says what is in `metrics.jsonl`: every line that runs write obeys it.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;

use crate::common::{TINY, files, tce};
use serde_json::Value;

const DOCUMENTED: &str = include_str!("../../../../docs/metrics.md");

/// The metrics of every stage; `*` in a metric stands for anything.
fn documented() -> BTreeMap<String, Vec<String>> {
    let section = DOCUMENTED.split("## Metrics").nth(1).expect("the section of metrics");
    let names = |cell: &str| cell.split('`').skip(1).step_by(2).map(str::to_owned).collect::<Vec<_>>();
    let mut stages: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for row in section.lines().filter(|l| l.starts_with("| `")) {
        let cells: Vec<&str> = row.split(" | ").collect();
        assert_eq!(cells.len(), 4, "{row}");
        assert!(cells[3].trim_end_matches(" |").len() > 5, "{row}: what is it?");
        for stage in names(cells[0]) {
            stages.entry(stage).or_default().extend(names(cells[1]));
        }
    }
    stages
}

fn is_documented(metrics: &[String], name: &str) -> bool {
    metrics.iter().any(|f| match f.split_once('*') {
        Some((start, end)) => name.starts_with(start) && name.ends_with(end),
        None => f == name,
    })
}

#[test]
fn lines_of_metrics_obey_their_documentation() {
    let dir = tempfile::tempdir().unwrap();
    let stages = documented();
    // A second of each kind of training: clones, IQL with its behaviour model, every prior method, both generators, both kinds of lengths.
    let methods = "tce-og,target-only,dara,srpo,igdf,otdf,bosa,td3-bc,rebrac,meta-dt,synther,dmc";
    let small = [
        "--set",
        "single_stage.steps=40",
        "--set",
        "single_stage.rows=600",
        "--set",
        "single_stage.width=32",
        "--set",
        "learner.bosa.cvae.steps=20",
        "--set",
        "learner.igdf.steps=20",
        "--set",
        "learner.meta_dt.world_model.steps=10",
        "--set",
        "evaluation.episodes=1",
        "--set",
        "evaluation.every=30",
        "--no-verdict",
        "--no-baselines",
    ];
    let (source, target) = crate::common::data_pair(dir.path(), tce_data::Agent::Hopper, tce_data::Shift::Morph);
    let (source, target) = (source.display().to_string(), target.display().to_string());
    let task = ["run", "hopper-morph:medium->expert", "--source", &source, "--target", &target, "--variant"];
    let until_done = [
        "--set",
        "generator.transition_steps=auto",
        "--set",
        "generator.state_steps=auto",
        "--set",
        "generator.until_done={first=100,state_limit=100,transition_limit=100,gain=0.1,held_out=0.05}",
        "--out",
        "until-done",
    ];
    for args in [
        [&task[..], &[methods], TINY, &small].concat(),
        [&task[..], &["tce-og"], TINY, &small, &until_done].concat(),
        vec![
            "train-sac",
            "hopper",
            "--steps",
            "300",
            "--start",
            "100",
            "--evaluate-every",
            "100",
            "--episodes",
            "1",
            "--batch",
            "16",
        ],
    ] {
        let output = tce(dir.path(), &args);
        assert!(output.status.success(), "tce {args:?}:\n{}", String::from_utf8_lossy(&output.stderr));
    }
    let mut seen = BTreeSet::new();
    for path in files(dir.path()).into_iter().filter(|p| p.ends_with("metrics.jsonl")) {
        for line in fs::read_to_string(&path).unwrap().lines() {
            let told = format!("{}: {line}", path.display());
            let line: Value = serde_json::from_str(line).unwrap();
            let object = line.as_object().expect(&told);
            let stage = object["stage"].as_str().expect(&told);
            assert!(object["step"].is_u64() && object["member"].is_u64(), "{told}");
            let metrics = stages.get(stage).unwrap_or_else(|| panic!("{told}: the stage is not documented"));
            for (name, value) in object.iter().filter(|(n, _)| !["stage", "step", "member"].contains(&n.as_str())) {
                assert!(is_documented(metrics, name), "{told}: {name} is not documented");
                assert!(value.is_number() || value.is_null(), "{told}");
                seen.insert((stage.to_owned(), name.clone()));
            }
        }
    }
    // Nothing is documented that nobody writes.
    for (stage, metrics) in &stages {
        for metric in metrics {
            let written = seen.iter().any(|(s, name)| s == stage && is_documented(std::slice::from_ref(metric), name));
            let elsewhere = stage == "learn" && metric == "critic_penalty"
                || (stage == "state" && metric == "implied_action_error");
            assert!(written || elsewhere, "{stage}: {metric} is documented, and was not written");
        }
    }
}
