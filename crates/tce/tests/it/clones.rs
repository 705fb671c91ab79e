//! Other rows with the actions of clones of the target rows (`mixture.actions = "clones"`), through the real binary.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use crate::common::{TINY, data_pair, message, random_rows, tce, tce_json};
use tce_data::{Agent, Shift, save_d4rl};
use tce_learn::{Policy, PolicyKind};

const CLONES: [&str; 2] = ["--set", "mixture.actions=clones"];

fn policy(folder: &Path) -> Vec<u8> {
    fs::read(folder.join("policy-seed0.safetensors")).unwrap()
}

/// The clones are those of the baseline: they are learned once, by whichever comes first.
#[test]
fn a_run_shares_its_clones_with_the_baseline() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let run = |variant: &str, more: &[&str]| {
        let mut args =
            vec!["run", "hopper-morph/medium/expert", "--variant", variant, "--no-baselines", "--no-verdict"];
        args.extend(["--source", source.to_str().unwrap(), "--target", target.to_str().unwrap(), "--out", "out"]);
        let row = tce_json(dir.path(), &[&args, TINY, more].concat())["rows"][0].clone();
        let folder = dir.path().join(row["directory"].as_str().unwrap());
        (row, folder)
    };
    let (row, by_clones) = run("tce-clones", &[]);
    let differ = row["action_distances"][0].as_f64().unwrap();
    assert!(differ > 0.01, "random actions are not what a clone says: {differ}");
    let folders = || fs::read_dir(dir.path().join("out/hopper-morph_medium-to-expert")).unwrap().count();
    assert_eq!(folders(), 2, "the clones, and the policy");
    let before = fs::metadata(&by_clones).unwrap().modified().unwrap();

    // With and without the setting the clones of the target rows are the same run.
    let (alone, clones) = run("bc-ensemble", &[]);
    assert_eq!(run("bc-ensemble", &CLONES).1, clones);
    assert_eq!((folders(), alone["action_distances"].is_null()), (2, true));
    let (row, own) = run("tce-og", &[]);
    assert!(row["action_distances"].is_null() && folders() == 3);
    assert!(policy(&own) != policy(&by_clones) && policy(&clones) != policy(&by_clones));
    assert!(policy(&run("tce-og", &CLONES).1) == policy(&by_clones), "the variant is this setting");
    assert_eq!(fs::metadata(&by_clones).unwrap().modified().unwrap(), before, "it is done once");

    // The source's states get the actions of the same clones, without a generator.
    let before = folders();
    let (row, by_source) = run("source-clones", &[]);
    assert!(row["action_distances"][0].as_f64().unwrap() > 0.01 && folders() == before + 1, "{row}");
    assert!(policy(&by_source) != policy(&by_clones) && policy(&by_source) != policy(&clones));
}

/// What the rows of a third file did does not matter then, only where they were.
#[test]
fn a_training_on_own_files_takes_no_notice_of_the_rows_actions() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    data_pair(dir, Agent::Hopper, Shift::Morph);
    let rows = random_rows(Agent::Hopper, Shift::Morph, 300, 5);
    let mut others = rows.clone();
    others.actions.iter_mut().for_each(|a| *a = -*a);
    save_d4rl(&dir.join("rows.hdf5"), &rows, &BTreeMap::new(), &[]).unwrap();
    save_d4rl(&dir.join("others.hdf5"), &others, &BTreeMap::new(), &[]).unwrap();
    let learn = |extra: &str, out: &str, more: &[&str]| {
        let args = ["learn", "--target", "target.hdf5", "--extra", extra, "--out", out, "--learner", "bc"];
        tce(dir, &[&args, TINY, more].concat())
    };
    let learned = |extra: &str, out: &str, more: &[&str]| {
        let output = learn(extra, out, more);
        assert!(output.status.success(), "{}", message(&output));
        (policy(&dir.join(out)), message(&output))
    };
    let alone = ["--no-verdict"];
    let (by_clones, told) = learned("rows.hdf5", "a", &[&CLONES[..], &alone].concat());
    assert!(told.contains("other rows have the actions of clones of the target rows, which are 0."), "{told}");
    assert!(dir.join("a/baseline").is_dir(), "the clones are the baseline");
    assert!(by_clones == learned("others.hdf5", "b", &[&CLONES[..], &alone].concat()).0);
    assert!(learned("rows.hdf5", "c", &alone).0 != learned("others.hdf5", "d", &alone).0);

    // Observations are scaled as for the baseline, whatever the other rows are, unless it is said otherwise.
    let scale = |folder: &str| match Policy::load(&dir.join(folder).join("policy-seed0.safetensors")).unwrap().kind() {
        PolicyKind::Mlp(policy) => policy.spec().standardizer.clone(),
        PolicyKind::Sequence(_) => panic!("a clone has no memory"),
    };
    learned("rows.hdf5", "e", &[&alone[..], &["--set", "learner.bc.scale_by=all"]].concat());
    assert_eq!((scale("a"), scale("c")), (scale("a/baseline"), scale("a/baseline")));
    assert_ne!(scale("e"), scale("c"));

    // With a verdict it is the same policy beside the same baseline, and clones are learned once.
    let (compared, told) = learned("rows.hdf5", "a", &CLONES);
    assert!(compared == by_clones && told.contains("cloning the target rows: learned before"), "{told}");
    let summary: serde_json::Value = serde_json::from_slice(&fs::read(dir.join("a/summary.json")).unwrap()).unwrap();
    assert_eq!(summary["verdict"]["tried"].as_array().unwrap().len(), 2, "{summary}");
}

/// Where nothing else is said, the extra rows' own actions and the clones' are tried, and the comparison tells which.
#[test]
fn both_actions_are_compared() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let (source, _) = data_pair(dir, Agent::Hopper, Shift::Morph);
    save_d4rl(&dir.join("rows.hdf5"), &random_rows(Agent::Hopper, Shift::Morph, 300, 5), &BTreeMap::new(), &[])
        .unwrap();
    let few = ["--set=learner.steps=10", "--set=learner.bc.ensemble=2", "--set=fitted_q.steps=0"];
    let files = ["--target", "target.hdf5", "--extra", "rows.hdf5", "--source", source.to_str().unwrap()];
    let call = |out: &'static str, more: &[&'static str]| {
        [&["learn", "--learner", "bc", "--out", out], &files[..], TINY, &few, more].concat()
    };
    let file = |out: &str, name: &str| fs::read(dir.join(out).join(name)).unwrap();
    let learn = |out: &'static str, more: &[&'static str]| {
        let output = tce(dir, &call(out, more));
        assert!(output.status.success(), "{}", message(&output));
        let summary: serde_json::Value = serde_json::from_slice(&file(out, "summary.json")).unwrap();
        let tried = summary["verdict"]["tried"].as_array().cloned().unwrap_or_default();
        (summary, tried.iter().map(|t| t["name"].as_str().unwrap().to_owned()).collect::<Vec<_>>(), message(&output))
    };
    let (baseline, own) = ("cloning the target rows", "bc with the extra rows");
    let clones = "bc with the extra states and the baseline's actions";
    let (summary, tried, _) = learn("both", &[]);
    assert_eq!(tried, [baseline, own, clones]);
    assert_eq!(summary["other_policies"], serde_json::json!(["clones-actions/policy-seed0.safetensors"]));

    // They are the policies of the settings, one by one.
    assert_eq!(learn("own", &["--actions", "own"]).1, [baseline, own]);
    assert_eq!(learn("clones", &["--actions", "clones"]).1, [baseline, clones]);
    let both = dir.join("both");
    assert!(policy(&both) == policy(&dir.join("own")));
    assert!(policy(&both.join("clones-actions")) == policy(&dir.join("clones")));
    assert!(policy(&both.join("baseline")) == policy(&dir.join("own/baseline")));

    // A finished training is taken as it is. One that compared fewer policies goes on, also where that was interrupted after its policies were
    // learned, with the results of the earlier call still there; and the other way round.
    assert!(learn("both", &[]).2.contains("done before"));
    let results = ["summary.json", "verdict.json"];
    let two = results.map(|name| file("own", name));
    let (_, tried, told) = learn("own", &[]);
    assert!(tried.len() == 3 && told.contains("bc: learned before") && !told.contains("done before"), "{told}");
    let three = results.map(|name| file("own", name));
    for (earlier, more, expected) in [(&two, &[][..], 3), (&three, &["--actions", "own"], 2)] {
        results.iter().zip(earlier).for_each(|(name, bytes)| fs::write(dir.join("own").join(name), bytes).unwrap());
        let (_, tried, told) = learn("own", more);
        assert!(tried.len() == expected && !told.contains("done before"), "{told}");
    }

    // What is lost is made again, and whoever asks for the training alone gets it, and nothing of the rest.
    fs::remove_file(both.join("clones-actions/policy-seed0.safetensors")).unwrap();
    let alone = tce_json(dir, &call("both", &["--no-verdict"]));
    assert!(alone["other_policies"].is_null() && alone["policies"].as_array().unwrap().len() == 1, "{alone}");
    let (_, tried, told) = learn("both", &[]);
    assert!(tried.len() == 3 && told.contains("bc: learned before"), "{told}");
    assert!(policy(&both.join("clones-actions")) == policy(&dir.join("clones")));
}
