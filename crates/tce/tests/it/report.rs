//! `tce report` through the real binary, on sweeps and run folders whose results are made up here.

use std::fs;
use std::path::{Path, PathBuf};

use crate::common::{message, tce, tce_json};
use serde_json::{Value, json};
use tce_base::sha256_hex;

/// A planned sweep of two tasks, one method and the baselines, without results.
fn plan(directory: &Path) -> Vec<Value> {
    let text = "tasks = [\"hopper-morph:medium->*\"]\nvariants = [\"tce-og\"]\nseeds = 2\npreset = \"quick\"\n\
                [[overrides]]\nname = \"<b>&y\"\nset = [\"generator.y_max=0.1\"]\n";
    fs::write(directory.join("mine.toml"), text).unwrap();
    tce_json(directory, &["sweep", "plan", "mine.toml", "--out", "s"]);
    let manifest = fs::read_to_string(directory.join("s/manifest.jsonl")).unwrap();
    manifest.lines().map(|l| serde_json::from_str(l).unwrap()).collect()
}

/// A run's folder, as the pipeline leaves it. Returns the hashes of its files.
fn write_run(directory: &Path, seeds: &[u64], scores: &[f64], config: &str) -> Value {
    fs::create_dir_all(directory).unwrap();
    let files = json!({ "config.toml": sha256_hex(config.as_bytes()) });
    fs::write(directory.join("config.toml"), config).unwrap();
    let spec = json!({ "format": 2, "spec": { "inputs": { "agent": "hopper", "target": "00" }, "seeds": seeds } });
    fs::write(directory.join("spec.json"), spec.to_string()).unwrap();
    let evaluation = |s: &f64| json!({ "returns": [s], "lengths": [1], "score": s });
    let summary = json!({
        "seeds": seeds, "scores": scores, "extra_rows": 5, "generated": [], "seconds": 4.0,
        "learned": { "evaluations": scores.iter().map(evaluation).collect::<Vec<_>>(), "seconds": 3.0 },
    });
    let done = json!({ "program": "tce 0.1.0", "attempt": "a", "files": files, "summary": summary });
    fs::write(directory.join("done.json"), done.to_string()).unwrap();
    files
}

/// Gives every run of the sweep a result, better for the method than for the baselines. Returns the records.
fn fill(sweep: &Path, manifest: &[Value]) -> Vec<PathBuf> {
    let mut records = Vec::new();
    fs::create_dir_all(sweep.join("done")).unwrap();
    for entry in manifest[1..].iter().filter(|e| e["kind"] == "run") {
        let id = entry["id"].as_str().unwrap();
        let seed = entry["seed"].as_u64().unwrap();
        let base = if entry["variant"] == "tce-og" { 61.5 } else { 20.0 };
        let score = base + seed as f64;
        let place = format!("runs/hopper/{id}");
        let config = manifest[0]["configs"][entry["config"].as_str().unwrap()].as_str().unwrap();
        let files = write_run(&sweep.join(&place), &[seed], &[score], config);
        let outcome = json!({
            "id": id, "score": score, "place": place, "files": files, "seconds": 4.0, "memory": 1u64 << 30,
            "program": "tce 0.1.0",
        });
        records.push(sweep.join("done").join(format!("{id}.json")));
        fs::write(records.last().unwrap(), outcome.to_string()).unwrap();
    }
    records
}

/// No line is wider than a terminal, but for the files' names.
fn fits(text: &str) {
    for line in text.lines().filter(|l| !l.contains("report.")) {
        assert!(line.chars().count() <= 80, "{} columns: {line}", line.chars().count());
    }
}

#[test]
fn a_sweep_becomes_a_page() {
    let dir = tempfile::tempdir().unwrap();
    let manifest = plan(dir.path());
    let sweep = dir.path().join("s");
    let empty = tce(dir.path(), &["report", "s"]);
    assert_eq!(empty.status.code(), Some(1));
    assert!(message(&empty).contains("found no finished run, expected at least one"), "{}", message(&empty));

    let records = fill(&sweep, &manifest);
    assert_eq!(records.len(), 3 * 6 * 2);
    let report = tce_json(dir.path(), &["report", "s", "--resamples", "200"]);
    assert_eq!(report["files"], json!(["s/report.html", "s/report.md", "s/report.tex"]));
    assert_eq!(report["comparison"]["tasks"].as_array().unwrap().len(), 3);
    let warnings = report["warnings"].to_string();
    assert!(warnings.contains("Few seeds: 2") && !warnings.contains("Partial"), "{warnings}");
    // The override is a change of the preset where a method generates rows, and the paper's figures are doubted where they stand.
    assert_eq!(report["recipes"]["presets"], json!({ "quick": 30, "quick with changes": 6 }));
    assert!(report["recipes"]["updates"][1].as_u64() > Some(0));
    let doubt = report["tables"][0]["doubt"].as_str().unwrap();
    assert!(
        doubt.contains("preset quick with changes") && doubt.contains("in the paper: 1\u{a0}000\u{a0}000"),
        "{doubt}"
    );
    let page = fs::read_to_string(sweep.join("report.html")).unwrap();
    for text in ["TCE(OG), &lt;b&gt;&amp;y", "that is more than chance", "62.0", "1.0 GiB", "Table 1", "y_max = 0.1"] {
        assert!(page.contains(text), "{text}");
    }
    assert!(!page.contains("<b>&y") && !page.contains("http:") && !page.contains("https:"));

    // Partial results: one run was never done, the files of another were changed.
    fs::remove_file(&records[0]).unwrap();
    let second: Value = serde_json::from_slice(&fs::read(&records[1]).unwrap()).unwrap();
    let changed = sweep.join(second["place"].as_str().unwrap()).join("config.toml");
    let whole = fs::read(&changed).unwrap();
    fs::write(&changed, "a = 1\n").unwrap();
    let partial = tce(dir.path(), &["report", "s", "--resamples", "200"]);
    assert!(partial.status.success());
    let text = String::from_utf8_lossy(&partial.stdout).into_owned();
    assert!(text.contains("warning: Partial results: 2 of 36 runs"), "{text}");
    fits(&text);
    let page = fs::read_to_string(sweep.join("report.html")).unwrap();
    assert!(page.contains("Partial results: 2 of 36") && page.contains("corrupt: ") && page.contains("not done"));
    fs::write(&changed, whole).unwrap();

    // A record that says something else than the run is no result.
    let mut third: Value = serde_json::from_slice(&fs::read(&records[2]).unwrap()).unwrap();
    third["score"] = json!(99.0);
    fs::write(&records[2], third.to_string()).unwrap();
    let refused = tce(dir.path(), &["report", "s"]);
    assert_eq!(refused.status.code(), Some(1));
    for word in ["field `score`", "found 99", "expected 20", "launch the sweep again"] {
        assert!(message(&refused).contains(word), "{}", message(&refused));
    }
}

#[test]
fn a_folder_of_runs_becomes_a_page() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("runs");
    fs::create_dir_all(root.join("stages")).unwrap();
    let nothing = tce(dir.path(), &["report", "runs"]);
    assert_eq!(nothing.status.code(), Some(1));
    assert!(message(&nothing).contains("found neither a sweep"), "{}", message(&nothing));
    assert!(!tce(dir.path(), &["report", "nowhere"]).status.success());
    assert_eq!(tce(dir.path(), &["report", "runs", "--resamples", "3"]).status.code(), Some(2));

    let place = root.join("hopper-morph_medium-to-expert");
    for (name, score) in [("bc-raw", 17.0), ("bc", 90.0), ("bc-top", 91.0), ("target-only", 80.0), ("tce-og", 70.0)] {
        write_run(
            &place.join(format!("{name}-0123456789ab")),
            &[0, 1, 2, 3, 4],
            &[score, score + 1.0, score + 2.0, score + 3.0, score + 4.0],
            "a = 1\n",
        );
    }
    // Other settings of the same method, task and seeds, or of other seeds; and a run that was killed.
    write_run(&place.join("bc-raw-cccccccccccc"), &[5], &[60.0], "a = 3\n");
    write_run(
        &place.join("tce-og-aaaaaaaaaaaa"),
        &[0, 1, 2, 3, 4],
        &[95.0, 96.0, 97.0, 98.0, 99.0],
        "a = 2\nmode = \"published\"\n",
    );
    fs::create_dir_all(place.join("tce-nn-bbbbbbbbbbbb")).unwrap();
    fs::write(place.join("tce-nn-bbbbbbbbbbbb/spec.json"), "{}").unwrap();
    // The clones' second policy was recommended; the best policy scores 99, so that its regret is 8.
    let verdict = json!({ "method": "BC", "policy": "bc-0123456789ab/policy-seed1.safetensors", "sure": true });
    fs::write(place.join("verdict.json"), verdict.to_string()).unwrap();
    let report = tce_json(dir.path(), &["report", "runs", "--resamples", "200", "--out", "elsewhere"]);
    let recommended = &report["recommendations"][0];
    assert_eq!((&recommended["score"], &recommended["best"]["score"]), (&json!(91.0), &json!(99.0)), "{recommended}");
    let text = tce(dir.path(), &["report", "runs", "--resamples", "200", "--out", "elsewhere"]);
    let text = String::from_utf8_lossy(&text.stdout).into_owned();
    fits(&text);
    assert!(text.replace("\n", " ").contains("a regret of 8.0 points"), "{text}");
    assert_eq!(report["files"][0], "elsewhere/report.html");
    let methods: Vec<&str> = report["methods"].as_array().unwrap().iter().map(|m| m["id"].as_str().unwrap()).collect();
    assert_eq!(methods.iter().filter(|m| m.starts_with("bc-raw ")).count(), 2, "{methods:?}");
    assert_eq!(methods.iter().filter(|m| m.starts_with("tce-og ")).count(), 2, "{methods:?}");
    let warnings = report["warnings"].to_string();
    for text in [
        "Partial results: 1 of 32",
        "several runs with different settings or data",
        "Published mode",
        "Shown to fall short of the best baseline, BC, best half",
    ] {
        assert!(warnings.contains(text), "{text}: {warnings}");
    }
    let page = fs::read_to_string(dir.path().join("elsewhere/report.html")).unwrap();
    assert!(
        page.contains("Of two methods compared with BC, best half, one is shown to beat it")
            && page.contains("97.0")
            && page.contains("99.8")
    );
}

/// What a sweep found stays when its folder goes, and counts once beside the sweep itself.
#[test]
fn results_outlive_their_folders() {
    let dir = tempfile::tempdir().unwrap();
    let manifest = plan(dir.path());
    fill(&dir.path().join("s"), &manifest);
    let report = |places: &[&str]| {
        let args = [&["report"], places, &["--resamples", "200", "--out", "page"]].concat();
        tce_json(dir.path(), &args)
    };
    let before = report(&["s"]);
    let exported = tce_json(dir.path(), &["sweep", "export", "s", "--out", "kept/results.jsonl"]);
    assert_eq!((&exported["runs"], &exported["tasks"], &exported["missing"]), (&json!(36), &json!(3), &json!(0)));
    assert_eq!(report(&["s", "kept/results.jsonl"])["comparison"], before["comparison"]);

    let again = tce(dir.path(), &["sweep", "export", "s", "--out", "kept/results.jsonl"]);
    assert_eq!(again.status.code(), Some(2));
    assert!(message(&again).contains("--force"), "{}", message(&again));
    fs::remove_dir_all(dir.path().join("s")).unwrap();
    // A file, and a folder of records; the figures are those of the sweep.
    for place in ["kept/results.jsonl", "kept"] {
        let after = report(&[place]);
        for key in ["comparison", "tables", "methods", "recipes", "gaps"] {
            assert_eq!(after[key], before[key], "{place}: {key}");
        }
    }
    let page = fs::read_to_string(dir.path().join("page/report.html")).unwrap();
    let command = "tce run hopper-morph/medium/expert --preset quick --variant tce-og --no-baselines --seeds 1 --seed 1 \
                   --set 'generator.y_max=0.1'";
    assert!(page.contains(command), "the call that makes a run again");
    // It may be replaced by itself and more.
    tce_json(dir.path(), &["sweep", "export", "kept", "--out", "kept/results.jsonl", "--force"]);
    assert_eq!(report(&["kept"])["comparison"], before["comparison"]);
    // Half a record is told with its line.
    let text = fs::read_to_string(dir.path().join("kept/results.jsonl")).unwrap();
    fs::write(dir.path().join("kept/results.jsonl"), &text[..text.len() / 2]).unwrap();
    let damaged = tce(dir.path(), &["report", "kept"]);
    assert!(message(&damaged).contains("results.jsonl: field `(line "), "{}", message(&damaged));
}
