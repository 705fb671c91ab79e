//! The pipeline end to end, through the real binary, on data that the tests make themselves.

use std::fs;
use std::path::{Path, PathBuf};

use crate::common::{TINY, data_pair, files, tce, tce_json};
use tce_data::{Agent, LoadOptions, Shift, load};

/// All files under `root` that are results: data sets and policies, by name relative to it.
fn results(root: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let result = |p: &PathBuf| p.extension().is_some_and(|e| e == "hdf5" || e == "safetensors");
    let found = files(root).into_iter().filter(result);
    found.map(|p| (p.strip_prefix(root).unwrap().to_owned(), fs::read(&p).unwrap())).collect()
}

#[test]
fn the_same_seed_gives_the_same_bytes_at_any_thread_count() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let run = |out: &str, threads: &str| {
        let mut args = vec!["run", "hopper-morph:medium->expert", "--variant", "tce-og,tce-nn", "--seeds", "2"];
        args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()]);
        args.extend(["--out", out, "--threads", threads]);
        args.extend(TINY);
        tce_json(dir.path(), &args)
    };
    let (first, again, two) = (run("one", "1"), run("again", "1"), run("two", "2"));
    let scores =
        |v: &serde_json::Value| v["rows"].as_array().unwrap().iter().map(|r| r["scores"].clone()).collect::<Vec<_>>();
    assert_eq!(scores(&first).len(), 7, "five baselines and two variants");
    assert_eq!(scores(&first), scores(&again));
    assert_eq!(scores(&first), scores(&two));
    let [a, b, c] = ["one", "again", "two"].map(|o| results(&dir.path().join(o)));
    assert!(a.iter().any(|(p, _)| p.to_string_lossy().contains("generated-seed1")), "generated rows are kept");
    assert!(a.iter().any(|(p, _)| p.to_string_lossy().contains("policy-seed1")), "policies are kept");
    for ((a, b), c) in a.iter().zip(&b).zip(&c) {
        assert_eq!((&a.0, &a.0), (&b.0, &c.0));
        assert!(a.1 == b.1, "{} differs between two runs", a.0.display());
        assert!(a.1 == c.1, "{} differs between one and two threads", a.0.display());
    }

    // A second call takes everything from where it is.
    let places: Vec<_> =
        first["rows"].as_array().unwrap().iter().map(|r| dir.path().join(r["directory"].as_str().unwrap())).collect();
    let times = || places.iter().map(|p| fs::metadata(p).unwrap().modified().unwrap()).collect::<Vec<_>>();
    let before = times();
    assert_eq!(scores(&run("one", "2")), scores(&first));
    assert_eq!(times(), before);
    fs::rename(dir.path().join("two"), dir.path().join("moved")).unwrap();
    let moved = run("moved", "2")["rows"].clone();
    assert!(
        moved.as_array().unwrap().iter().all(|r| r["directory"].as_str().unwrap().starts_with("moved/")),
        "{moved}"
    );

    // A result that was tampered with is noticed.
    let policy = a.iter().find(|(p, _)| p.to_string_lossy().contains("policy-seed0")).unwrap();
    let path = dir.path().join("one").join(&policy.0);
    let mut bytes = policy.1.clone();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&path, bytes).unwrap();
    let mut args =
        vec!["run", "hopper-morph:medium->expert", "--variant", "tce-og,tce-nn", "--seeds", "2", "--out", "one"];
    args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()]);
    args.extend(TINY);
    let output = tce(dir.path(), &args);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("changed"));
}

#[test]
fn every_variant_runs_and_leaves_its_specification() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Kinematic);
    let variants = "tce-ot,simple-aug,target-source,iql-swt,tce-no-filter,tce-no-reg,bc-raw";
    let mut args = vec!["run", "hopper-kinematic:medium->medium", "--variant", variants, "--out", "out"];
    args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()]);
    args.extend(TINY);
    let report = tce_json(dir.path(), &args);
    let rows = report["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 11);
    for row in rows {
        assert!(row["scores"][0].is_number(), "{row}");
        let directory = dir.path().join(row["directory"].as_str().unwrap());
        for file in ["spec.json", "config.toml", "metrics.jsonl", "done.json", "policy-seed0.safetensors"] {
            assert!(directory.join(file).exists(), "{} has no {file}", directory.display());
        }
        assert!(directory.join("tensorboard").is_dir());
        let metrics = fs::read_to_string(directory.join("metrics.jsonl")).unwrap();
        assert!(metrics.lines().all(|l| serde_json::from_str::<serde_json::Value>(l).is_ok()));
    }
    let rows_of =
        |variant: &str| rows.iter().find(|r| r["variant"] == variant).unwrap()["extra_rows"].as_u64().unwrap();
    assert_eq!(rows_of("target-source"), 1500);
    assert_eq!(rows_of("iql-swt"), 1500);
    assert_eq!(rows_of("bc-raw"), 0);
    // Without a filter all rows stay but those that begin where a hopper has fallen.
    let whole = rows_of("tce-no-filter");
    assert!((570..=600).contains(&whole), "{whole}");
    assert_eq!(rows_of("tce-no-reg"), whole, "no filter by default");
    let at = args.iter().position(|a| *a == variants).unwrap();
    args[at] = "tce-no-reg";
    args.extend(["--no-baselines", "--set", "filter.enabled=true"]);
    let filtered = tce_json(dir.path(), &args)["rows"][0]["extra_rows"].as_u64().unwrap();
    assert!(filtered < whole && filtered > 0, "the filter rejects something, not all: {filtered}");
}

/// What a variant does not look at must not decide its result, whatever runs beside it.
#[test]
fn a_variant_alone_gives_what_it_gives_beside_others() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Kinematic);
    let policy = |variants: &str, out: &str| {
        let mut args = vec![
            "run",
            "hopper-kinematic:medium->medium",
            "--no-baselines",
            "--no-verdict",
            "--variant",
            variants,
            "--out",
            out,
        ];
        args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()]);
        args.extend(TINY);
        let report = tce_json(dir.path(), &args);
        let row = report["rows"].as_array().unwrap().iter().find(|r| r["variant"] == "simple-aug").unwrap();
        fs::read(dir.path().join(row["directory"].as_str().unwrap()).join("policy-seed0.safetensors")).unwrap()
    };
    assert!(policy("simple-aug", "alone") == policy("tce-og,simple-aug", "beside"));
}

/// Every prior method and both of its modes, beside TCE's own rows under another learner.
#[test]
fn every_prior_method_runs_and_says_its_mode() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Kinematic);
    let data = ["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()];
    let run = |rest: &[&str]| {
        let mut args = vec!["run", "hopper-kinematic:medium->medium", "--no-baselines", "--out", "out"];
        args.extend(data);
        args.extend(rest);
        args.extend(TINY);
        args.extend([
            "--set=learner.bosa.cvae.steps=5",
            "--set=learner.bosa.cvae.hidden=[16]",
            "--set=learner.igdf.steps=5",
        ]);
        tce_json(dir.path(), &args)
    };
    let methods = ["dara", "bosa", "srpo", "igdf", "otdf"];
    let both: Vec<String> = methods.iter().flat_map(|r| [r.to_string(), format!("{r}-published")]).collect();
    let report = run(&["--variant", &format!("{},td3-bc,rebrac", both.join(","))]);
    let rows = report["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 12);
    for row in rows {
        assert!(row["scores"][0].is_number(), "{row}");
        let published = row["variant"].as_str().unwrap().ends_with("-published");
        let prior = methods.iter().any(|r| row["variant"].as_str().unwrap().starts_with(r));
        assert_eq!(row["title"].as_str().unwrap().ends_with(" (published)"), published);
        assert_eq!(row["mode"] == "published", published);
        assert_eq!(row["mode"] == "corrected", prior && !published);
        let left = files(&dir.path().join(row["directory"].as_str().unwrap()));
        assert!(left.iter().all(|p| p.extension().is_none_or(|e| e != "checkpoint")), "{left:?}");
        let metrics =
            fs::read_to_string(dir.path().join(row["directory"].as_str().unwrap()).join("metrics.jsonl")).unwrap();
        let prepared = match row["variant"].as_str().unwrap() {
            "bosa" | "bosa-published" => Some("bosa-autoencoders"),
            "igdf" => Some("igdf-encoders"),
            "otdf" | "otdf-published" => Some("behaviour-cvae"),
            _ => None,
        };
        let before: Vec<_> = metrics.lines().take_while(|l| !l.contains(r#""stage":"learn""#)).collect();
        assert_eq!(before.is_empty(), prepared.is_none(), "{row}: {before:?}");
        let stage = prepared.map(|stage| format!(r#""stage":"{stage}""#));
        assert!(before.iter().all(|l| l.contains(stage.as_ref().unwrap())), "{before:?}");
    }
    let config =
        fs::read_to_string(dir.path().join(rows[8]["directory"].as_str().unwrap()).join("config.toml")).unwrap();
    assert!(config.contains("beta_reg = 0.1"), "OTDF's own choice for this shift");

    let other = run(&["--variant", "tce-og", "--learner", "td3-bc"]);
    assert_eq!(other["rows"][0]["title"], "TCE(OG), td3-bc");
    let chosen = run(&["--variant", "tce-og", "--learner", "otdf"]);
    assert!(chosen["rows"][0]["scores"][0].is_number(), "costs of generated rows are computed on the spot");
}

#[test]
fn learners_are_listed_and_learn_from_two_files() {
    let dir = tempfile::tempdir().unwrap();
    let list = tce_json(dir.path(), &["learn", "--list"]);
    let names: Vec<_> = list.as_array().unwrap().iter().map(|m| m["name"].as_str().unwrap().to_owned()).collect();
    assert!(names.len() >= 9 && ["bc", "iql", "otdf", "td3-bc"].iter().all(|n| names.contains(&n.to_string())));
    let text = String::from_utf8(tce(dir.path(), &["learn", "--list"]).stdout).unwrap();
    for method in list.as_array().unwrap() {
        assert!(text.contains(method["name"].as_str().unwrap()));
    }
    assert_eq!(tce(dir.path(), &["learn"]).status.code(), Some(2), "without --list, files are needed");

    data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    for name in &names {
        let mut args =
            vec!["learn", "--learner", name, "--target", "target.hdf5", "--extra", "source.hdf5", "--out", name];
        args.extend(TINY);
        args.extend(["--set=single_stage.scores.reference=500", "--set=learner.steps=3", "--set=learner.igdf.steps=5"]);
        args.extend(["--set=learner.bosa.cvae.steps=5", "--set=learner.meta_dt.world_model.steps=5"]);
        let learned = tce_json(dir.path(), &args);
        assert!(dir.path().join(learned["policies"][0].as_str().unwrap()).exists(), "{name}");
        // No prior method has TCE's own term.
        let config = fs::read_to_string(dir.path().join(name).join("config.toml")).unwrap();
        let plain = config.contains("regulariser = \"none\"");
        assert_eq!(plain, ["dara", "srpo", "igdf"].contains(&name.as_str()), "{name}");
    }
}

/// Prior methods whose rows come from one network over whole transitions: the same bytes at any thread count, one stage for both forms of
/// DmC, scores beside generated rows, and nothing of the source for SynthER.
#[test]
fn prior_methods_of_whole_transitions_run() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Ant, Shift::Morph);
    let run = |out: &str, threads: &str, sets: &[&str]| {
        let mut args =
            vec!["run", "ant-morph:medium->expert", "--variant", "synther,dmc,dmc-published", "--no-baselines"];
        args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()]);
        args.extend(["--out", out, "--threads", threads]);
        args.extend(TINY);
        args.extend(["--set", "single_stage.scores.reference=500", "--set", "learner.behaviour.cvae.hidden=[32]"]);
        args.extend(["--set", "evaluation.episodes=1", "--set", "learner.behaviour.samples=3"]);
        args.extend(sets);
        tce_json(dir.path(), &args)
    };
    let (one, two) = (run("one", "1", &[]), run("two", "2", &[]));
    let rows = one["rows"].as_array().unwrap();
    for (a, b) in rows.iter().zip(two["rows"].as_array().unwrap()) {
        assert!(a["scores"][0].is_number() && a["scores"] == b["scores"], "{a} {b}");
    }
    let [a, b] = ["one", "two"].map(|o| results(&dir.path().join(o)));
    assert_eq!(a.len(), b.len());
    assert!(a.iter().zip(&b).all(|(a, b)| a == b), "another number of threads gave other bytes");

    let of = |variant: &str| rows.iter().find(|r| r["variant"] == variant).unwrap();
    let (synther, dmc, published) = (of("synther"), of("dmc"), of("dmc-published"));
    assert_eq!(
        (&synther["extra_rows"], &dmc["extra_rows"]),
        (&600.into(), &1200.into()),
        "as many source as generated rows"
    );
    assert_eq!((&synther["generated"][0]["evaluations"], &dmc["generated"][0]["evaluations"]), (&4.into(), &8.into()));
    assert_ne!(dmc["scores"], published["scores"], "the modes differ");
    let file = |row: &serde_json::Value, name: &str| dir.path().join(row["directory"].as_str().unwrap()).join(name);
    let generated = |row| fs::read(file(row, "generated-seed0.hdf5")).unwrap();
    assert!(generated(dmc) == generated(published), "and learn from the same rows");
    let options = LoadOptions { columns: vec!["score".into()], ..LoadOptions::default() };
    let loaded = load(&file(dmc, "generated-seed0.hdf5"), &options).unwrap();
    assert!(loaded.columns["score"].iter().all(|s| *s > 0.0 && *s <= 1.0));
    assert!(loaded.transitions.actions.iter().all(|a| a.abs() <= 1.0));
    let tail = loaded.transitions.observations.chunks(111).flat_map(|s| &s[27..]);
    assert!(tail.copied().all(|v| v == 0.0), "Ant's contact slots stay zero");
    let stages = fs::read_dir(dir.path().join("one/stages")).unwrap().flatten();
    let mut kinds: Vec<String> =
        stages.map(|e| e.file_name().to_string_lossy().split('-').next().unwrap().to_owned()).collect();
    kinds.sort();
    assert_eq!(kinds, ["dynamics", "generated", "generated", "joint", "joint", "source"]);
    let spec = fs::read_to_string(file(synther, "spec.json")).unwrap();
    assert!(spec.contains("\"source\": null"), "{spec}");

    // Unscored rows cannot be learned from in DmC's way.
    let mut args = vec!["run", "ant-morph:medium->expert", "--variant", "dmc", "--set", "mixture.generated=tce"];
    args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()]);
    let refused = tce(dir.path(), &args);
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        crate::common::message(&refused).contains("expected rows that have scores"),
        "{}",
        crate::common::message(&refused)
    );
}

/// The paper's process, sampler and learner, cut short; rows as many as the paper generates, (1 - λ) |D_src|.
#[test]
fn the_papers_preset_runs() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Ant, Shift::Morph);
    let mut args =
        vec!["run", "ant-morph:medium->expert", "--preset", "paper", "--variant", "tce-nn", "--no-baselines"];
    args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()]);
    args.extend(TINY);
    args.extend(["--set", "generator.rows=0", "--set", "learner.behaviour.cvae.hidden=[32]"]);
    let report = tce_json(dir.path(), &args);
    let generated = &report["rows"][0]["generated"][0];
    assert_eq!(generated["sampled"], 1350, "λ = .1 of 1500 source rows");
    assert_eq!(generated["evaluations"], 14, "two stages of four predictor and three corrector steps");
    assert_eq!(generated["terminal"], 0.0);
    let rows = load(
        &dir.path().join(report["rows"][0]["directory"].as_str().unwrap()).join("generated-seed0.hdf5"),
        &LoadOptions::default(),
    );
    let rows = rows.unwrap().transitions;
    let tail = rows.observations.chunks(111).flat_map(|s| &s[27..]);
    assert!(tail.copied().all(|v| v == 0.0), "Ant's contact slots stay zero");
}

#[test]
fn augment_learn_evaluate_and_collect_work_on_peoples_own_files() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::HalfCheetah, Shift::Morph);
    let mut args = vec!["augment", "--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()];
    args.extend(["--out", "wide.hdf5"]);
    args.extend(&TINY[..10]);
    let report = tce_json(dir.path(), &args);
    let wide =
        load(&dir.path().join("wide.hdf5"), &LoadOptions { columns: vec!["origin".into()], ..LoadOptions::default() })
            .unwrap();
    let kept = report["generated"]["kept"].as_u64().unwrap() as usize;
    assert_eq!(wide.transitions.len(), 600 + kept);
    assert_eq!(wide.columns["origin"].iter().sum::<f32>() as usize, kept);
    let original = load(&target, &LoadOptions::default()).unwrap().transitions;
    assert_eq!(wide.transitions.observations[..original.observations.len()], original.observations);
    assert!(wide.transitions.actions.iter().all(|a| a.abs() <= 1.0));

    // An existing output is not overwritten by accident.
    assert_eq!(tce(dir.path(), &args).status.code(), Some(2));

    let mut args = vec![
        "learn",
        "--target",
        "target.hdf5",
        "--extra",
        "wide.hdf5",
        "--env",
        "halfcheetah-morph",
        "--out",
        "policy",
    ];
    args.extend(["--seeds", "2"]);
    args.extend(&TINY[10..]);
    let learned = tce_json(dir.path(), &args);
    assert_eq!(learned["policies"].as_array().unwrap().len(), 2);
    // The recommended policy is one of those that were tried: of the learner's, or of the baseline.
    let verdict = &learned["verdict"];
    assert_eq!(verdict["tried"].as_array().unwrap().len(), 3, "{verdict}");
    let recommended = fs::read(dir.path().join("policy/policy.safetensors")).unwrap();
    assert!(recommended == fs::read(dir.path().join(verdict["policy"].as_str().unwrap())).unwrap());
    assert!(verdict["reason"].as_str().unwrap().contains("is recommended"), "{verdict}");
    let both = ["policy/policy-seed0.safetensors", "policy/policy.safetensors"];
    let data =
        ["--source", "source.hdf5", "--target", "target.hdf5", "--dynamics-steps", "20", "--fitted-q-steps", "0"];
    let compared = tce_json(dir.path(), &[&["compare"][..], &both, &data].concat());
    assert!(compared["policies"].as_array().unwrap().len() == 2 && compared["held_out"][0].is_number(), "{compared}");
    let lanes = compared["policies"][0]["returns"].as_array().unwrap().len();
    assert_eq!(
        lanes,
        3 * (32 + 4),
        "three networks, 32 target states, and the first states of the source's four episodes"
    );
    let of_the_zoo = tce_json(dir.path(), &[&["compare", "zoo:halfcheetah-source-medium"][..], &data].concat());
    assert_eq!(of_the_zoo["policies"][0]["policy"], "zoo:halfcheetah-source-medium");
    let foreign = tce(dir.path(), &[&["compare", "zoo.safetensors"][..], &data].concat());
    assert_eq!(foreign.status.code(), Some(1), "no such policy");

    let policy = "policy/policy-seed1.safetensors";
    let evaluated =
        tce_json(dir.path(), &["evaluate", policy, "--env", "halfcheetah-morph", "--episodes", "2", "--seed", "1"]);
    assert_eq!(
        evaluated[0]["returns"], learned["evaluations"][1]["returns"],
        "a saved policy acts like the learned one"
    );

    let mixture =
        ["collect", "--env", "halfcheetah-morph", "--actor", policy, "--actor", "policy/policy-seed0.safetensors:3"];
    let collected =
        tce_json(dir.path(), &[&mixture[..], &["--rows", "500", "--lanes", "4", "--out", "c.hdf5"]].concat());
    assert_eq!(collected["content"]["rows"], 500);
    let checked = tce_json(dir.path(), &["data", "check", "c.hdf5", "--replay", "--env", "halfcheetah-morph"]);
    assert_eq!(checked[0]["passes"], true, "{checked}");
    let wrong = tce(dir.path(), &["data", "check", "c.hdf5", "--replay", "--env", "halfcheetah"]);
    assert_eq!(wrong.status.code(), Some(1), "rows of the morphed robot do not replay in the source robot");
    let inspected = tce_json(dir.path(), &["data", "inspect", "c.hdf5", "target.hdf5"]);
    assert_eq!(inspected.as_array().unwrap().len(), 2);
}

/// A policy that remembers its episode goes through files and environments like any other.
#[test]
fn a_policy_with_a_memory_is_learned_evaluated_and_collected_with() {
    let dir = tempfile::tempdir().unwrap();
    data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let learn = |out: &str, threads: &str| {
        let mut args = vec!["learn", "--target", "target.hdf5", "--extra", "source.hdf5", "--algorithm", "meta-dt"];
        args.extend(["--env", "hopper-morph", "--seeds", "2", "--out", out, "--threads", threads]);
        args.extend(["--set", "learner.steps=20", "--set", "learner.meta_dt.world_model.steps=10"]);
        args.extend(["--set", "learner.meta_dt.embed=16", "--set", "evaluation.episodes=2"]);
        args.extend(["--set", "dynamics.steps=20", "--set", "fitted_q.steps=20"]);
        tce_json(dir.path(), &args)
    };
    let learned = learn("one", "1");
    assert_eq!(learned["policies"].as_array().unwrap().len(), 2);
    assert!(learned["metrics"]["policy_loss"][1].is_number());
    assert_eq!(learn("two", "2")["evaluations"], learned["evaluations"]);
    let files = ["one", "two"].map(|o| fs::read(dir.path().join(o).join("policy-seed1.safetensors")).unwrap());
    assert!(files[0] == files[1], "another number of threads gave another policy");

    let policy = "one/policy-seed1.safetensors";
    let evaluated =
        tce_json(dir.path(), &["evaluate", policy, "--env", "hopper-morph", "--episodes", "2", "--seed", "1"]);
    assert_eq!(evaluated[0]["returns"], learned["evaluations"][1]["returns"]);
    let wrong = tce(dir.path(), &["evaluate", policy, "--env", "ant-morph"]);
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("a policy of 11 observations and 3 actions"));
    let collect =
        ["collect", "--env", "hopper-morph", "--actor", policy, "--rows", "200", "--lanes", "4", "--out", "c.hdf5"];
    assert_eq!(tce_json(dir.path(), &collect)["content"]["rows"], 200);
}

/// Networks that are trained until they are done, rows filtered by learned dynamics, the better trajectories imitated: all that a
/// default run does and the tiny settings above leave out.
#[test]
fn trainings_end_by_themselves_and_rows_are_filtered_by_learned_dynamics() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Walker2d, Shift::Morph);
    let run = |threads: &str, out: &str| {
        let mut args =
            vec!["run", "walker2d-morph:medium->expert", "--variant", "tce-og", "--no-baselines", "--out", out];
        args.extend(["--threads", threads]);
        args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()]);
        args.extend(TINY);
        args.extend(["--set", "generator.state_steps=\"auto\"", "--set", "generator.transition_steps=\"auto\""]);
        args.extend(["--set", "generator.until_done={first=20,state_limit=60,transition_limit=140,gain=-100.0}"]);
        args.extend(["--set", "filter.enabled=true", "--set", "filter.by=consistency", "--set", "filter.margin=1000"]);
        args.extend(["--seeds", "2"]);
        tce_json(dir.path(), &args)
    };
    let (one, two) = (run("1", "one"), run("2", "two"));
    assert_eq!(one["rows"][0]["scores"], two["rows"][0]["scores"], "the number of threads decides nothing");
    let policies = ["one", "two"]
        .map(|out| fs::read(dir.path().join(out).join("walker2d-morph_medium-to-expert/policy.safetensors")).unwrap());
    assert!(policies[0] == policies[1] && one["verdict"]["tried"].as_array().unwrap().len() == 1);
    let stages = files(&dir.path().join("one/stages"));
    let cycles = |name: &str| {
        let names = stages.iter().filter_map(|p| p.file_name()?.to_str());
        let mut steps: Vec<u64> =
            names.filter_map(|n| n.strip_prefix(name)?.strip_suffix(".safetensors")?.parse().ok()).collect();
        steps.sort_unstable();
        steps
    };
    assert_eq!((cycles("state-"), cycles("transition-")), (vec![20, 60], vec![20, 60, 140]));
    let metrics = stages.iter().find(|p| p.ends_with("metrics.jsonl") && p.to_string_lossy().contains("networks-"));
    let metrics = fs::read_to_string(metrics.unwrap()).unwrap();
    assert!(metrics.contains("implied_action_error") && metrics.contains("held_out_loss"), "{metrics}");
}

/// An interrupted run keeps the stages it finished and takes them up when it is called again.
#[cfg(unix)]
#[test]
fn an_interrupted_run_continues_where_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let mut args = vec!["run", "hopper-morph:medium->expert", "--variant", "tce-og", "--no-baselines", "--out", "out"];
    args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap()]);
    args.extend(TINY);
    let mut endless = args.clone();
    endless.extend(["--set", "learner.steps=100000000"]);
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_tce"))
        .args(&endless)
        .current_dir(dir.path())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let generated = || {
        let stages = fs::read_dir(dir.path().join("out/stages")).into_iter().flatten().flatten();
        stages
            .filter(|e| {
                e.file_name().to_string_lossy().starts_with("generated-") && e.path().join("done.json").exists()
            })
            .count()
    };
    let started = std::time::Instant::now();
    while generated() == 0 {
        assert!(started.elapsed().as_secs() < 100, "the generated stage is finished in time");
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    let kill = std::process::Command::new("kill").arg(child.id().to_string()).status().unwrap();
    assert!(kill.success());
    assert_eq!(child.wait().unwrap().code(), Some(130), "SIGTERM ends the run at a safe point");
    let stamp = || {
        let stages = fs::read_dir(dir.path().join("out/stages")).unwrap().flatten();
        let mut all: Vec<_> =
            stages.map(|e| (e.path(), fs::metadata(e.path().join("done.json")).unwrap().modified().unwrap())).collect();
        all.sort();
        all
    };
    let before = stamp();
    tce_json(dir.path(), &args);
    assert_eq!(stamp(), before, "finished stages are not done again");
}
