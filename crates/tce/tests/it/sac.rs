//! Agents that act and learn, through the real binary.

use std::fs;

use crate::common::{message, tce, tce_json};
use tce_data::{LoadOptions, load};

const SMALL: &[&str] = &["--start", "120", "--evaluate-every", "100", "--episodes", "2", "--checkpoint-every", "60"];

#[test]
fn a_training_in_two_pieces_ends_with_the_bytes_of_one_in_one_piece() {
    let dir = tempfile::tempdir().unwrap();
    let train = |out: &str, steps: &str, threads: &str| {
        let args = ["train-sac", "hopper", "--steps", steps, "--out", out, "--threads", threads, "--replay"];
        tce_json(dir.path(), &[&args[..], SMALL, &["--snapshot-scores", "-50,0"]].concat())
    };
    let whole = train("whole", "400", "1");
    let first = train("pieces", "200", "2");
    assert!(first[0]["step"].as_u64().unwrap() < whole[0]["step"].as_u64().unwrap());
    let second = train("pieces", "400", "2");
    for key in ["step", "episode", "evaluations", "snapshots", "files"] {
        assert_eq!(whole[0][key], second[0][key], "{key}");
    }
    assert!(whole[0]["evaluations"].as_array().unwrap().len() >= 4);
    for file in ["policy.safetensors", "policy--50.safetensors", "medium-replay.hdf5"] {
        let bytes =
            ["whole", "pieces"].map(|o| fs::read(dir.path().join(o).join("hopper-source-seed0").join(file)).unwrap());
        assert!(bytes[0] == bytes[1], "{file} differs");
    }
    let place = dir.path().join("whole/hopper-source-seed0");
    let replay = load(&place.join("medium-replay.hdf5"), &LoadOptions::default()).unwrap().transitions;
    assert_eq!(replay.len() as u64, whole[0]["step"].as_u64().unwrap());
    // Every checkpoint but the last two is gone.
    let kept = fs::read_dir(&place)
        .unwrap()
        .filter(|e| e.as_ref().unwrap().file_name().to_string_lossy().starts_with("replay-"));
    assert_eq!(kept.count(), 2);
    // With the last one damaged the training goes on from the one before.
    let newest = whole[0]["files"][0][0].as_str().unwrap();
    fs::write(place.join(newest), b"damaged").unwrap();
    let again = train("whole", "400", "1");
    for key in ["step", "episode", "evaluations", "snapshots", "files"] {
        assert_eq!(whole[0][key], again[0][key], "{key} after damage");
    }

    // The policy is one like any other.
    let policy = place.join("policy.safetensors");
    let evaluated = tce_json(dir.path(), &["evaluate", policy.to_str().unwrap(), "--env", "hopper", "--episodes", "2"]);
    assert_eq!(evaluated[0]["returns"].as_array().unwrap().len(), 2);
}

#[test]
fn another_training_in_the_same_place_and_a_damaged_checkpoint_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let args = |start: &'static str| {
        ["train-sac", "hopper", "--steps", "60", "--episodes", "1", "--evaluate-every", "50", "--start", start].to_vec()
    };
    assert!(tce(dir.path(), &args("40")).status.success());
    let other = tce(dir.path(), &args("41"));
    assert_eq!(other.status.code(), Some(2));
    assert!(message(&other).contains("the training there has other settings"), "{}", message(&other));

    let place = dir.path().join("runs/sac/hopper-source-seed0");
    let mut files = fs::read_dir(&place).unwrap().map(|e| e.unwrap().path());
    let learner = files.find(|p| p.to_string_lossy().contains("learner-")).unwrap();
    let mut bytes = fs::read(&learner).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&learner, bytes).unwrap();
    let damaged = tce(dir.path(), &args("40"));
    assert_eq!(damaged.status.code(), Some(1));
    assert!(message(&damaged).contains("not what the ledger says"), "{}", message(&damaged));
}

#[test]
fn a_training_can_begin_with_the_networks_of_another() {
    let dir = tempfile::tempdir().unwrap();
    let train = |out: &str, env: &str, start: &str, more: &[&str]| {
        let args = ["train-sac", env, "--steps", "150", "--out", out, "--steps-per-update", "2", "--batch", "32"];
        let rest = ["--start", start, "--evaluate-every", "100", "--episodes", "2", "--checkpoint-every", "60"];
        tce(dir.path(), &[&args[..], &rest, more].concat())
    };
    let learner = |place: &str| {
        let place = dir.path().join(place);
        let ledger: serde_json::Value = serde_json::from_slice(&fs::read(place.join("ledger.json")).unwrap()).unwrap();
        fs::read(place.join(ledger["files"][1][0].as_str().unwrap())).unwrap()
    };
    let from = ["--from", "first/hopper-source-seed0"];
    assert!(train("first", "hopper", "60", &[]).status.success());
    // No update comes before step 1000: what it ends with is what it began with.
    assert!(train("second", "hopper-morph", "1000", &from).status.success());
    assert!(train("new", "hopper-morph", "1000", &[]).status.success());
    let first = learner("first/hopper-source-seed0");
    assert!(first == learner("second/hopper-morph-seed0"));
    assert!(first != learner("new/hopper-morph-seed0"));
    let settings = fs::read_to_string(dir.path().join("second/hopper-morph-seed0/settings.json")).unwrap();
    assert!(settings.contains("hopper-source seed 0, step 1"), "{settings}");
    // Its first actions are the policy's, not the random ones of new networks.
    let first_action = |place: &str| {
        let mut files = fs::read_dir(dir.path().join(place)).unwrap().map(|e| e.unwrap().path());
        let replay = files.find(|p| p.to_string_lossy().contains("replay-")).unwrap();
        load(&replay, &LoadOptions::default()).unwrap().transitions.actions[..3].to_vec()
    };
    assert_ne!(first_action("second/hopper-morph-seed0"), first_action("new/hopper-morph-seed0"));

    let refused = train("third", "walker2d", "60", &from);
    assert_eq!(refused.status.code(), Some(2));
    assert!(message(&refused).contains("cannot drive another"), "{}", message(&refused));
    let nothing = train("third", "hopper", "60", &["--from", "nowhere"]);
    assert_eq!(nothing.status.code(), Some(2));
    assert!(message(&nothing).contains("no checkpoint of a training here"), "{}", message(&nothing));
}

#[test]
fn a_training_can_begin_with_an_actor_alone() {
    let dir = tempfile::tempdir().unwrap();
    let train = |out: &str, env: &str, more: &[&str]| {
        let args = ["train-sac", env, "--steps", "300", "--out", out, "--from", "zoo:hopper-source-medium"];
        let rest = ["--start", "60", "--batch", "32", "--evaluate-every", "100", "--episodes", "1"];
        tce(dir.path(), &[&args[..], &rest, more].concat())
    };
    let returns = |policy: &str| {
        let args = ["evaluate", policy, "--env", "hopper-morph", "--episodes", "3", "--sample"];
        tce_json(dir.path(), &args)[0]["returns"].clone()
    };
    let actor = returns("zoo:hopper-source-medium");
    // Critics that learn alone leave the policy what it was.
    assert!(train("critics", "hopper-morph", &["--policy-start", "1000", "--critic-norm"]).status.success());
    assert_eq!(returns("critics/hopper-morph-seed0/policy.safetensors"), actor);
    assert!(train("both", "hopper-morph", &["--policy-lr", "0.01"]).status.success());
    assert_ne!(returns("both/hopper-morph-seed0/policy.safetensors"), actor);
    let settings = fs::read_to_string(dir.path().join("both/hopper-morph-seed0/settings.json")).unwrap();
    assert!(settings.contains("zoo:hopper-source-medium") && settings.contains("policy_lr"), "{settings}");
    // Actions are random ones where that is asked for, and only until the policy's first update.
    let first_action = |place: &str| {
        let place = dir.path().join(place).join("hopper-morph-seed0");
        let mut files = fs::read_dir(place).unwrap().map(|e| e.unwrap().path());
        let replay = files.find(|p| p.to_string_lossy().contains("replay-")).unwrap();
        load(&replay, &LoadOptions::default()).unwrap().transitions.actions[..3].to_vec()
    };
    assert!(train("random", "hopper-morph", &["--explore", "1"]).status.success());
    assert_eq!(first_action("critics"), first_action("both"));
    assert_ne!(first_action("random"), first_action("both"));

    let refused = train("ant", "ant-morph", &[]);
    assert!(!refused.status.success() && message(&refused).contains("Choose a policy of this agent"));
    assert_eq!(train("share", "hopper", &["--explore", "2"]).status.code(), Some(2));
}
