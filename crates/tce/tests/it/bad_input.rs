//! Bad input: one clear message, the right exit code, nothing half-written.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use crate::common::{TINY, Tmpfs, data_pair, message, random_rows, tce};
use tce_data::{Agent, Shift, save_d4rl};

/// Runs `augment` and returns its exit code and message; the output must not exist afterwards.
fn augment(dir: &Path, source: &str, target: &str, more: &[&str]) -> (i32, String) {
    let mut args = vec!["augment", "--source", source, "--target", target, "--out", "out.hdf5"];
    args.extend(TINY);
    args.extend(more);
    let output = tce(dir, &args);
    assert!(!dir.join("out.hdf5").exists(), "no output after a failure");
    let parts: Vec<_> = fs::read_dir(dir)
        .unwrap()
        .filter(|e| e.as_ref().unwrap().file_name().to_string_lossy().contains(".part"))
        .collect();
    assert!(parts.is_empty(), "nothing half-written: {parts:?}");
    (output.status.code().unwrap(), message(&output))
}

#[test]
fn unusable_data_is_refused_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    data_pair(dir, Agent::Hopper, Shift::Morph);

    fs::write(dir.join("empty.hdf5"), b"").unwrap();
    let whole = fs::read(dir.join("target.hdf5")).unwrap();
    fs::write(dir.join("truncated.hdf5"), &whole[..whole.len() / 2]).unwrap();
    fs::write(dir.join("text.hdf5"), b"not a data set at all").unwrap();
    let mut nan = random_rows(Agent::Hopper, Shift::Morph, 50, 3);
    nan.rewards[7] = f32::NAN;
    save_d4rl(&dir.join("nan.hdf5"), &nan, &BTreeMap::new(), &[]).unwrap();
    let mut lacking = hdf5_pure::FileBuilder::new();
    for (name, columns) in [("observations", 11), ("actions", 3), ("next_observations", 11)] {
        lacking.create_dataset(name).with_f32_data(&vec![0.5; 20 * columns]).with_shape(&[20, columns as u64]);
    }
    lacking.create_dataset("terminals").with_f32_data(&[0.0; 20]);
    lacking.write(dir.join("lacking.hdf5")).unwrap();
    let mut wide = hdf5_pure::FileBuilder::new();
    for (name, columns) in [("observations", 11), ("actions", 3), ("next_observations", 12)] {
        wide.create_dataset(name).with_f32_data(&vec![0.5; 20 * columns]).with_shape(&[20, columns as u64]);
    }
    wide.create_dataset("rewards").with_f32_data(&[0.0; 20]);
    wide.create_dataset("terminals").with_f32_data(&[0.0; 20]);
    wide.write(dir.join("wide.hdf5")).unwrap();
    let other = random_rows(Agent::HalfCheetah, Shift::Morph, 100, 3);
    save_d4rl(&dir.join("other.hdf5"), &other, &BTreeMap::new(), &[]).unwrap();

    for (file, words) in [
        ("missing.hdf5", vec!["missing.hdf5"]),
        ("empty.hdf5", vec!["empty.hdf5"]),
        ("truncated.hdf5", vec!["truncated.hdf5"]),
        ("text.hdf5", vec!["text.hdf5"]),
        ("nan.hdf5", vec!["nan.hdf5", "rewards", "7"]),
        ("lacking.hdf5", vec!["lacking.hdf5", "rewards"]),
        ("wide.hdf5", vec!["wide.hdf5", "next_observations", "12", "11"]),
        ("other.hdf5", vec!["different robots"]),
    ] {
        let (code, message) = augment(dir, "source.hdf5", file, &[]);
        assert_eq!(code, 1, "{file}: {message}");
        for word in words {
            assert!(message.contains(word), "{file}: no `{word}` in: {message}");
        }
        assert!(!dir.join("runs").exists(), "{file}: refused before any work");
    }
}

#[test]
fn wrong_calls_end_with_code_2() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    data_pair(dir, Agent::Hopper, Shift::Morph);
    let (code, message) = augment(dir, "source.hdf5", "target.hdf5", &["--set", "generator.ymax=0.3"]);
    assert_eq!(code, 2);
    assert!(message.contains("unknown key `generator.ymax`") && message.contains("y_max"), "{message}");
    fs::write(dir.join("mine.toml"), "[learner]\nstep = 3\n").unwrap();
    let (code, message) = augment(dir, "source.hdf5", "target.hdf5", &["--config", "mine.toml"]);
    assert_eq!(code, 2);
    assert!(message.contains("mine.toml") && message.contains("learner.step"), "{message}");
    for args in [
        &["run", "hopper:medium->expert"][..],
        &["run", "frog-morph:medium->expert"],
        &["nonsense"],
        &["evaluate", "--env", "hopper"],
        &["run", "hopper-morph:medium->expert", "--seeds", "0", "--target", "target.hdf5", "--source", "source.hdf5"],
    ] {
        assert_eq!(tce(dir, args).status.code(), Some(2), "{args:?}");
    }
    // Data that are simply not there are no wrong call.
    let output = tce(dir, &["run", "ant-gravity-5/medium/expert"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("TCE_SHARED"));
}

#[test]
fn options_that_would_do_something_else_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    data_pair(dir, Agent::Hopper, Shift::Morph);
    let (learn, task) = (["learn", "--target", "target.hdf5", "--out", "out"], "hopper-morph:medium->expert");
    let before = fs::read(dir.join("source.hdf5")).unwrap();
    for (args, words) in [
        (
            &["augment", "--source", "source.hdf5", "--target", "target.hdf5", "--out", "./source.hdf5", "--force"][..],
            "one of the inputs",
        ),
        (&[&learn[..], &["--learner", "iql", "--top", "0.1"]].concat(), "expected bc"),
        (&[&learn[..], &["--learner", "dara"]].concat(), "--extra FILE"),
        (&["run", task, "--variant", "target-only,bc", "--learner", "td3-bc"], "found baselines alone"),
    ] {
        let output = tce(dir, args);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {}", message(&output));
        assert!(message(&output).contains(words), "{args:?}: {}", message(&output));
    }
    assert!(fs::read(dir.join("source.hdf5")).unwrap() == before);
    assert!(!dir.join("out").exists() && !dir.join("runs").exists(), "before any work");
}

/// The settings that a training writes never take the place of the user's.
#[test]
fn settings_of_the_users_own_are_not_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    data_pair(dir, Agent::Hopper, Shift::Morph);
    let (config, text) = (dir.join("out/config.toml"), "[learner]\nsteps = 5\n");
    fs::create_dir(dir.join("out")).unwrap();
    fs::write(&config, text).unwrap();
    let refused = |more: &[&str], words: &str| {
        let before = crate::common::files(dir);
        let output = tce(dir, &[&["learn", "--target", "target.hdf5", "--out", "out"], more].concat());
        assert_eq!(output.status.code(), Some(2), "{}", message(&output));
        assert!(message(&output).contains(words), "{}", message(&output));
        assert_eq!(crate::common::files(dir), before);
        assert_eq!(fs::read_to_string(&config).unwrap(), text);
    };
    refused(&[], "out/config.toml: found a file that no training wrote");
    refused(&["--config", "out/config.toml"], "--config out/config.toml: found the file in which this training writes");
    // The folder of a training is none for a copy of its settings.
    fs::write(dir.join("out/spec.json"), "{}").unwrap();
    refused(&["--config", "./out/config.toml"], "choose another --out than out, or copy the file");
}

#[test]
fn nothing_to_generate_is_told_before_any_training() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    data_pair(dir, Agent::Hopper, Shift::Morph);
    let sets = ["--set", "generator.rows=0", "--set", "mixture.lambda=0.9999"];
    let (code, message) = augment(dir, "source.hdf5", "target.hdf5", &sets);
    assert_eq!(code, 2, "{message}");
    assert!(message.contains("found none of 1500 at mixture.lambda = 0.9999"), "{message}");
    assert!(!dir.join("runs/stages").exists(), "nothing is trained");
}

/// On a file system of a few pages the output does not fit: one message, exit code 1, nothing left behind.
#[test]
fn a_full_disk_leaves_nothing_behind() {
    let dir = tempfile::tempdir().unwrap();
    let mount = dir.path().join("small");
    let Some(disk) = Tmpfs::mount(&mount, 16, "a_full_disk_leaves_nothing_behind") else { return };
    data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let out = mount.join("out.hdf5");
    let mut args =
        vec!["augment", "--source", "source.hdf5", "--target", "target.hdf5", "--out", out.to_str().unwrap()];
    args.extend(TINY);
    let output = tce(dir.path(), &args);
    let left = fs::read_dir(&mount).unwrap().count();
    drop(disk);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.to_lowercase().contains("space"), "{message}");
    assert_eq!(left, 0, "nothing half-written");
}

#[cfg(not(feature = "vulkan"))]
#[test]
fn a_gpu_that_the_program_was_not_built_for_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let output = tce(dir.path(), &["--device", "vulkan", "run", "hopper-morph:medium->expert"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(message(&output).contains("--features vulkan"), "{}", message(&output));
    assert_eq!(crate::common::files(dir.path()), Vec::<std::path::PathBuf>::new());
}
