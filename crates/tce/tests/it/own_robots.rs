//! People's own robots through the real binary: nothing is assumed of them but what their files say.

use std::collections::BTreeMap;
use std::path::Path;

use crate::common::{TINY, message, tce};
use rand::RngExt;
use tce_base::Streams;
use tce_data::{LoadOptions, Transitions, load, save_d4rl};
use tce_learn::Policy;

/// A joint that moves where the action pushes it, in `obs_dim` columns; `episodes` of `length` steps, actions in ±`torque`.
fn arm(obs_dim: usize, act_dim: usize, (episodes, length): (usize, usize), torque: f32, seed: u64) -> Transitions {
    let mut rng = Streams::new(seed).stream("arm");
    let mut t = Transitions::new(obs_dim, act_dim);
    for _ in 0..episodes {
        let mut s: Vec<f32> = (0..obs_dim).map(|_| rng.random_range(-0.5f32..0.5)).collect();
        for step in 0..length {
            let a: Vec<f32> = (0..act_dim).map(|_| rng.random_range(-torque..torque)).collect();
            let mut next = s.clone();
            next.iter_mut().enumerate().for_each(|(d, x)| *x = 0.98 * *x + 0.05 * a[d % act_dim] / torque);
            t.push(&s, &a, -next[0].abs(), &next, false, step + 1 == length);
            s = next;
        }
    }
    t
}

fn save(dir: &Path, name: &str, t: &Transitions) {
    save_d4rl(&dir.join(name), t, &BTreeMap::new(), &[]).unwrap();
}

fn pair(dir: &Path, source: &Transitions, target: &Transitions) {
    save(dir, "source.hdf5", source);
    save(dir, "target.hdf5", target);
}

/// Runs `augment` and returns the rows of the file that it wrote, with its message.
#[track_caller]
fn augment(dir: &Path, more: &[&str]) -> (Transitions, String) {
    let mut args =
        vec!["augment", "--source", "source.hdf5", "--target", "target.hdf5", "--out", "out.hdf5", "--force"];
    args.extend(TINY);
    args.extend(more);
    let output = tce(dir, &args);
    assert!(output.status.success(), "{}", message(&output));
    (load(&dir.join("out.hdf5"), &LoadOptions::default()).unwrap().transitions, message(&output))
}

/// An arm of Hopper's dimensions never falls: none of its generated rows is terminal.
#[test]
fn an_arm_of_hoppers_dimensions_is_no_hopper() {
    let dir = tempfile::tempdir().unwrap();
    pair(dir.path(), &arm(11, 3, (4, 100), 1.0, 1), &arm(11, 3, (2, 50), 1.0, 2));
    let (rows, _) = augment(dir.path(), &[]);
    assert!(rows.len() > 100 && !rows.terminals.contains(&true));
    // Named, it is a hopper that lies on the ground: no row begins there.
    let output = tce(
        dir.path(),
        &[
            &[
                "augment",
                "--source",
                "source.hdf5",
                "--target",
                "target.hdf5",
                "--out",
                "named.hdf5",
                "--env",
                "hopper-morph",
            ],
            TINY,
        ]
        .concat(),
    );
    assert!(!output.status.success(), "{}", message(&output));
    assert!(message(&output).contains("rejected"), "{}", message(&output));
}

#[test]
fn a_turned_base_does_not_make_another_robot() {
    let dir = tempfile::tempdir().unwrap();
    let mut source = arm(17, 6, (3, 60), 1.0, 1);
    // As high as a walker's torso, and as slow.
    source.observations.chunks_exact_mut(17).for_each(|row| row[0] += 1.3);
    source.next_observations.chunks_exact_mut(17).for_each(|row| row[0] += 1.3);
    pair(dir.path(), &source, &arm(17, 6, (2, 50), 1.0, 2));
    let (rows, text) = augment(dir.path(), &[]);
    assert!(rows.len() > 100);
    assert!(text.contains("note: source.hdf5 looks like walker2d"), "{text}");
}

#[test]
fn torques_stay_torques() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    pair(dir, &arm(4, 2, (4, 100), 20.0, 1), &arm(4, 2, (2, 60), 20.0, 2));
    let (rows, text) = augment(dir, &[]);
    assert!(text.contains("actions range over"), "{text}");
    let target = load(&dir.join("target.hdf5"), &LoadOptions::default()).unwrap().transitions;
    assert!(
        rows.actions[..240].iter().zip(&target.actions).all(|(a, b)| (a - b).abs() < 1e-4),
        "target rows as they were"
    );
    let generated = rows.actions[240..].iter().fold(0f32, |m, a| m.max(a.abs()));
    assert!((2.0..=20.0).contains(&generated), "{generated}");

    let learn = |out: &str, more: &[&str]| {
        let args = ["learn", "--target", "target.hdf5", "--extra", "out.hdf5", "--learner", "bc", "--out", out];
        let sets = ["--set=learner.steps=300", "--set=learner.batch=32", "--no-verdict"];
        let output = tce(dir, &[&args[..], &sets, more].concat());
        assert!(output.status.success(), "{}", message(&output));
        Policy::load(&dir.join(out).join("policy-seed0.safetensors")).unwrap()
    };
    let policy = learn("policy", &[]);
    let range = policy.action_range().expect("the policy acts in the user's units").clone();
    assert!(range.high.iter().all(|h| (19.0..=20.0).contains(h)), "{range}");
    let mut actions = vec![0.0; target.actions.len()];
    policy.act(&target.observations, None, &mut actions);
    assert!(actions.iter().all(|a| a.abs() <= 20.0) && actions.iter().any(|a| a.abs() > 1.0), "{actions:?}");
    let wide = learn("wide", &["--action-range", "-25:25"]);
    assert_eq!(wide.action_range().unwrap().high, [25.0; 2]);
    let output = tce(
        dir,
        &[
            "compare",
            "policy/policy-seed0.safetensors",
            "--target",
            "target.hdf5",
            "--dynamics-steps",
            "20",
            "--fitted-q-steps",
            "20",
        ],
    );
    assert!(output.status.success(), "{}", message(&output));
}

#[test]
fn a_minari_set_is_written_and_replaced_without_touching_its_neighbours() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    save(dir, "arm.hdf5", &arm(4, 2, (3, 40), 20.0, 1));
    let convert = |more: &[&str]| {
        tce(dir, &[&["data", "convert", "arm.hdf5", "sets/lab/arm-v0", "--format", "minari"], more].concat())
    };
    assert!(convert(&[]).status.success());
    let metadata = std::fs::read_to_string(dir.join("sets/lab/arm-v0/data/metadata.json")).unwrap();
    assert!(metadata.contains("\"lab/arm-v0\""), "{metadata}");
    std::fs::write(dir.join("sets/lab/arm-v0/notes.txt"), b"mine").unwrap();
    assert_eq!(convert(&[]).status.code(), Some(2));
    assert!(convert(&["--force"]).status.success());
    assert!(dir.join("sets/lab/arm-v0/notes.txt").exists());
    assert_eq!(std::fs::read_dir(dir.join("sets/lab")).unwrap().count(), 1);
    let output = convert(&["--force", "--id", "w/o-v0"]);
    assert!(message(&output).contains("expected NAMESPACE/NAME-v0"), "{}", message(&output));
}

#[test]
fn wild_actions_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let mut target = arm(4, 2, (2, 60), 1.0, 2);
    target.actions[14] = 1e6;
    pair(dir.path(), &arm(4, 2, (4, 100), 1.0, 1), &target);
    let (rows, text) = augment(dir.path(), &[]);
    assert!(text.contains("action columns [0] have values more than ten times"), "{text}");
    assert_eq!(rows.actions[..240], target.actions);
    let (_, text) = augment(dir.path(), &["--action-range", "-1:1"]);
    assert!(text.contains("1 action value lies outside of --action-range"), "{text}");
    target.actions.iter_mut().for_each(|a| *a *= 3e38);
    target.actions[14] = -3e38;
    target.actions[0] = 3e38;
    save(dir.path(), "target.hdf5", &target);
    let args = ["augment", "--source", "source.hdf5", "--target", "target.hdf5", "--out", "huge.hdf5"];
    let output = tce(dir.path(), &[&args[..], TINY].concat());
    assert!(message(&output).contains("expected a range that float32 can hold"), "{}", message(&output));
}

#[test]
fn terminals_are_learned_where_there_are_some() {
    let dir = tempfile::tempdir().unwrap();
    let mut source = arm(3, 2, (10, 100), 1.0, 1);
    let ended: Vec<bool> = source.next_observations.chunks_exact(3).map(|s| s[0] > 0.2).collect();
    source.terminals.clone_from(&ended);
    // The target never got that far.
    pair(dir.path(), &source, &arm(3, 2, (2, 60), 1.0, 2));
    let (_, text) = augment(dir.path(), &["--set=labels.training.steps=300", "--set=generator.rows=300"]);
    assert!(!text.contains("panicked"), "{text}");
    let mut specs = std::fs::read_dir(dir.path().join("runs/stages")).unwrap().flatten().map(|e| e.path());
    let labels = specs.find(|p| p.to_string_lossy().contains("labels-")).unwrap();
    let spec = std::fs::read_to_string(labels.join("spec.json")).unwrap();
    assert!(spec.contains("\"learn_terminals\": true"), "{spec}");
}

#[test]
fn little_and_constant_targets_are_used_or_refused_in_words() {
    let dir = tempfile::tempdir().unwrap();
    let source = arm(3, 2, (4, 100), 1.0, 1);
    let mut constant = arm(3, 2, (2, 50), 1.0, 2);
    constant.observations.fill(0.25);
    constant.next_observations.fill(0.25);
    let one = arm(3, 2, (1, 1), 1.0, 2);
    let few = arm(3, 2, (1, 12), 1.0, 2);
    let mut still = arm(3, 2, (2, 50), 1.0, 2);
    still.next_observations.clone_from(&still.observations);
    let mut flat = arm(3, 2, (2, 50), 1.0, 2);
    flat.rewards.fill(0.0);
    flat.actions.fill(0.5);
    let all = [("constant", constant), ("one-row", one), ("twelve-rows", few), ("still", still), ("flat", flat)];
    for (name, target) in all {
        pair(dir.path(), &source, &target);
        let args = ["augment", "--source", "source.hdf5", "--target", "target.hdf5", "--out", "out.hdf5", "--force"];
        let output = tce(dir.path(), &[&args[..], TINY].concat());
        let text = message(&output);
        assert!(!text.contains("panicked"), "{name}: {text}");
        assert!(output.status.success() || text.contains("expected"), "{name}: {text}");
        let learn = ["learn", "--target", "target.hdf5", "--learner", "bc", "--out", name, "--set=learner.steps=5"];
        let output = tce(dir.path(), &[&learn[..], &["--set=dynamics.steps=5", "--set=fitted_q.steps=5"]].concat());
        let text = message(&output);
        assert!(!text.contains("panicked"), "{name}: {text}");
        assert!(output.status.success() || text.contains("expected"), "{name}: {text}");
    }
}

#[test]
fn rows_in_no_order_are_not_taken_for_episodes() {
    let dir = tempfile::tempdir().unwrap();
    let t = arm(4, 2, (10, 60), 1.0, 1);
    // Every third row, from the end: no row follows another.
    let mut shuffled = t.select(&(0..200).map(|i| (i * 397) % 600).collect::<Vec<_>>());
    shuffled.timeouts.fill(false);
    let mut file = hdf5_pure::FileBuilder::new();
    for (name, values, width) in [
        ("observations", &shuffled.observations, 4),
        ("actions", &shuffled.actions, 2),
        ("next_observations", &shuffled.next_observations, 4),
    ] {
        file.create_dataset(name).with_f32_data(values).with_shape(&[200, width]);
    }
    file.create_dataset("rewards").with_f32_data(&shuffled.rewards);
    file.create_dataset("terminals").with_u8_data(&[0; 200]);
    file.write(dir.path().join("target.hdf5")).unwrap();
    let learn = |more: &[&str]| {
        let args =
            ["learn", "--target", "target.hdf5", "--no-verdict", "--set=learner.steps=5", "--set=learner.batch=32"];
        tce(dir.path(), &[&args[..], more].concat())
    };
    for more in
        [["--learner", "bc", "--top", "0.1", "--out", "top"], ["--learner", "meta-dt", "--seeds", "1", "--out", "dt"]]
    {
        let output = learn(&more);
        assert_eq!(output.status.code(), Some(1), "{}", message(&output));
        assert!(message(&output).contains("found rows in no order"), "{}", message(&output));
    }
    let output = learn(&["--learner", "bc", "--out", "all"]);
    assert!(output.status.success(), "{}", message(&output));
    assert!(message(&output).contains("the rows are in no order"), "{}", message(&output));
}

#[test]
fn check_says_on_one_screen_what_was_made_of_a_file() {
    let dir = tempfile::tempdir().unwrap();
    save(dir.path(), "hopper.hdf5", &arm(4, 2, (20, 100), 20.0, 1));
    let output = tce(dir.path(), &["data", "check", "hopper.hdf5"]);
    assert!(output.status.success(), "{}", message(&output));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    for part in [
        "robot       an own one, 4 observations, 2 actions",
        "episodes    20, 100 steps each; 20 whole; episodes end where the file marks it",
        "used for    2000 rows: learning; 2000: networks and models of s'; 2000: what follows episodes",
        "terminals   none: no row of this file is terminal",
        "note: actions: they range over -",
    ] {
        assert!(text.contains(part), "`{part}` is not in:\n{text}");
    }
    assert!(text.lines().count() < 24, "one screen:\n{text}");
}

/// `augment` writes the target rows, too. `learn` has them already, and takes the generated ones of that file alone.
#[test]
fn rows_of_augment_are_not_learned_from_twice() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    pair(dir, &arm(3, 2, (4, 60), 1.0, 1), &arm(3, 2, (2, 40), 1.0, 2));
    let (rows, _) = augment(dir, &[]);
    let learn = |extra: &str, out: &str| {
        let args = ["learn", "--target", "target.hdf5", "--extra", extra, "--out", out, "--no-verdict"];
        tce(dir, &[&args[..], TINY].concat())
    };
    let whole = learn("out.hdf5", "whole");
    assert!(whole.status.success(), "{}", message(&whole));
    let words = format!("80 of its {} rows are target rows and are left out", rows.len());
    assert!(message(&whole).contains(&words), "{}", message(&whole));
    // Without the column that says so (Minari has none) the same rows are found by their numbers.
    save(dir, "plain.hdf5", &rows);
    let plain = learn("plain.hdf5", "plain");
    assert!(message(&plain).contains(&words), "{}", message(&plain));
    // The generated rows alone: the same policy.
    save(dir, "generated.hdf5", &rows.select(&(80..rows.len()).collect::<Vec<_>>()));
    let generated = learn("generated.hdf5", "generated");
    assert!(!message(&generated).contains("left out"), "{}", message(&generated));
    let policy = |out: &str| std::fs::read(dir.join(out).join("policy-seed0.safetensors")).unwrap();
    assert!(policy("whole") == policy("generated") && policy("whole") == policy("plain"));
    // The column counts where the numbers tell nothing, too.
    let args = ["learn", "--target", "source.hdf5", "--extra", "out.hdf5", "--out", "other", "--no-verdict"];
    let other = tce(dir, &[&args[..], TINY].concat());
    assert!(message(&other).contains(&words), "{}", message(&other));
}

/// A column of that name in a file that `augment` did not write says nothing of target rows.
#[test]
fn a_column_origin_of_the_users_own_drops_no_rows() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let extra = arm(3, 2, (4, 60), 1.0, 1);
    let origin: Vec<f32> = (0..extra.len()).map(|i| (i % 3) as f32).collect();
    pair(dir, &extra, &arm(3, 2, (2, 40), 1.0, 2));
    save_d4rl(&dir.join("named.hdf5"), &extra, &BTreeMap::new(), &[("origin", &origin)]).unwrap();
    let learn = |extra: &str, out: &str| {
        let args = ["learn", "--target", "target.hdf5", "--extra", extra, "--out", out, "--no-verdict"];
        let output = tce(dir, &[&args[..], TINY].concat());
        assert!(output.status.success() && !message(&output).contains("left out"), "{}", message(&output));
        std::fs::read(dir.join(out).join("policy-seed0.safetensors")).unwrap()
    };
    assert!(learn("named.hdf5", "named") == learn("source.hdf5", "plain"));
}

/// A data set is replaced by a data set of the same layout and by nothing else, and no input by what is made of it.
#[test]
fn what_is_there_is_spared() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    pair(dir, &arm(3, 2, (4, 60), 1.0, 1), &arm(3, 2, (2, 40), 1.0, 2));
    std::fs::create_dir_all(dir.join("proj/data")).unwrap();
    std::fs::copy(dir.join("target.hdf5"), dir.join("proj/data/raw.hdf5")).unwrap();
    std::fs::write(dir.join("proj/data/notes.txt"), "mine").unwrap();
    let convert =
        |input: &str, output: &str, more: &[&str]| tce(dir, &[&["data", "convert", input, output], more].concat());
    let minari = ["--format", "minari", "--force"];
    assert!(convert("target.hdf5", "arm-v0", &minari).status.success());
    let augment = |target: &str, out: &str, more: &[&str]| {
        tce(dir, &[&["augment", "--source", "source.hdf5", "--target", target, "--out", out], more].concat())
    };
    let contents = || -> Vec<_> {
        crate::common::files(dir).into_iter().map(|file| (std::fs::read(&file).unwrap(), file)).collect()
    };
    let (before, main) = (contents(), "arm-v0/data/main_data.hdf5");
    for (output, words) in [
        (convert("proj/data/raw.hdf5", "proj", &minari), "proj/data: field `file`: found notes.txt in it"),
        (convert("target.hdf5", "target.hdf5", &["--force"]), "found one of the inputs"),
        (convert("target.hdf5", "./target.hdf5", &[]), "found one of the inputs"),
        (convert(main, "arm-v0", &minari), "found one of the inputs"),
        (augment(main, "arm-v0", &minari), "found one of the inputs"),
        (convert("target.hdf5", "proj", &["--force"]), "proj: field `file`: found a folder"),
        (augment("target.hdf5", "proj", &["--force"]), "proj: field `file`: found a folder"),
        (convert("source.hdf5", "target.hdf5", &minari), "target.hdf5: field `file`: found a file"),
        (augment("target.hdf5", "proj/data/notes.txt", &minari), "notes.txt: field `file`: found a file"),
    ] {
        assert_eq!(output.status.code(), Some(2), "{words}: {}", message(&output));
        assert!(message(&output).contains(words), "{words}: {}", message(&output));
    }
    assert!(contents() == before);
    assert!(convert("source.hdf5", "arm-v0", &minari).status.success());
    assert_eq!(load(&dir.join("arm-v0"), &LoadOptions::default()).unwrap().transitions.len(), 240);
    for (folder, entries) in [("arm-v0", 1), ("arm-v0/data", 2)] {
        assert_eq!(std::fs::read_dir(dir.join(folder)).unwrap().count(), entries, "{folder}: nothing is left behind");
    }
}

#[test]
fn minari_gets_the_range_of_actions_that_the_user_says() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    save(dir, "arm.hdf5", &arm(11, 3, (2, 40), 20.0, 1));
    for (out, more, low, outside) in [
        ("both-v0", &["--action-range", "-25:25", "--env", "hopper-morph"][..], "[-25.0, -25.0, -25.0]", false),
        ("given-v0", &["--action-range", "-25:25"], "[-25.0, -25.0, -25.0]", false),
        ("robot-v0", &["--env", "hopper-morph"], "[-1.0, -1.0, -1.0]", true),
    ] {
        let output = tce(dir, &[&["data", "convert", "arm.hdf5", out, "--format", "minari"], more].concat());
        assert!(output.status.success(), "{}", message(&output));
        let metadata = std::fs::read_to_string(dir.join(out).join("data/metadata.json")).unwrap();
        assert!(metadata.contains(low), "{out}: {metadata}");
        let told = String::from_utf8_lossy(&output.stdout).contains("action values lie outside of -1:1");
        assert_eq!(told, outside, "{out}");
    }
}

/// What was removed or damaged is made again, and nothing else is.
#[test]
fn a_finished_training_without_its_files_is_not_done() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    pair(dir, &arm(3, 2, (4, 60), 1.0, 1), &arm(3, 2, (2, 40), 1.0, 2));
    let learn = |more: &[&str]| {
        let args = ["learn", "--target", "target.hdf5", "--extra", "source.hdf5", "--out", "out"];
        let few = ["--set=learner.steps=10", "--set=learner.bc.ensemble=2", "--set=fitted_q.steps=0"];
        let output = tce(dir, &[&args[..], TINY, &few, more].concat());
        assert!(output.status.success(), "{}", message(&output));
        message(&output)
    };
    learn(&[]);
    let out = |file: &str| dir.join("out").join(file);
    let read = || {
        let policies = ["policy.safetensors", "policy-seed0.safetensors", "baseline/policy-seed0.safetensors"];
        let further = ["clones-actions/policy-seed0.safetensors", "verdict.json"];
        [&policies[..], &further].concat().into_iter().map(|file| std::fs::read(out(file)).unwrap()).collect::<Vec<_>>()
    };
    let whole = read();
    let remove = |file: &str| std::fs::remove_file(out(file)).unwrap();
    let cut = |file: &str| std::fs::write(out(file), &std::fs::read(out(file)).unwrap()[..100]).unwrap();
    let damages: [(&dyn Fn(), usize); 6] = [
        (&|| remove("policy.safetensors"), 3),
        (&|| cut("policy.safetensors"), 3),
        (&|| remove("verdict.json"), 3),
        (&|| cut("policy-seed0.safetensors"), 2),
        (&|| std::fs::remove_dir_all(out("baseline")).unwrap(), 2),
        (&|| cut("clones-actions/policy-seed0.safetensors"), 2),
    ];
    for (k, (damage, kept)) in damages.into_iter().enumerate() {
        assert!(learn(&[]).contains("done before"), "before damage {k}");
        damage();
        let told = learn(&[]);
        assert!(told.contains("are missing or were changed") && !told.contains("done before"), "{k}: {told}");
        assert_eq!(told.matches("learned before").count(), kept, "{k}: {told}");
        assert!(read() == whole, "damage {k}");
    }
    // Whoever wants no verdict needs the policies alone.
    remove("policy.safetensors");
    assert!(learn(&["--no-verdict"]).contains("done before"));
    assert!(!learn(&[]).contains("done before") && read() == whole);
}

/// Where all rewards are equal, a model of them predicts noise: that must not choose a policy.
#[test]
fn rewards_that_are_all_equal_decide_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let mut target = arm(3, 2, (2, 40), 1.0, 2);
    target.rewards.fill(0.0);
    (target.terminals[39], target.timeouts[39]) = (true, false);
    pair(dir, &arm(3, 2, (4, 60), 1.0, 1), &target);
    let learn = |out: &str| {
        let args = ["learn", "--target", "target.hdf5", "--extra", "source.hdf5", "--out", out];
        let output = tce(dir, &[&args[..], TINY].concat());
        assert!(output.status.success(), "{}", message(&output));
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    let told = learn("zeros");
    for words in ["the target's rewards are all equal (0)", "do not tell for sure", "zeros/policy.safetensors"] {
        assert!(told.contains(words), "no {words:?} in:\n{told}");
    }
    let file = |name: &str| std::fs::read(dir.join("zeros").join(name)).unwrap();
    assert!(file("policy.safetensors") == file("baseline/policy-seed0.safetensors"));
    assert!(!told.contains("imagined return") && !dir.join("zeros/stages").exists(), "nothing is tried:\n{told}");
    // A reward for every step until the end of the robot counts the steps.
    target.rewards.fill(1.0);
    save(dir, "target.hdf5", &target);
    assert!(learn("steps").contains("imagined return"));
}

#[test]
fn messages_name_the_file_and_what_it_is_taken_for() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    save(dir, "arm.hdf5", &arm(3, 2, (2, 40), 1.0, 1));
    save(dir, "other.hdf5", &arm(4, 2, (2, 40), 1.0, 2));
    save(dir, "hopper_morph_expert.hdf5", &arm(11, 3, (2, 40), 1.0, 3));
    for command in ["check", "inspect"] {
        // What could be read is told, whatever comes after it.
        let output = tce(dir, &["data", command, "arm.hdf5", "missing.hdf5"]);
        assert_eq!(output.status.code(), Some(1), "{}", message(&output));
        assert!(String::from_utf8_lossy(&output.stdout).contains("arm.hdf5"), "{command}");
        assert!(message(&output).contains("missing.hdf5: cannot open"), "{}", message(&output));
        let named = |more: &[&str]| {
            let output = tce(dir, &[&["data", command, "hopper_morph_expert.hdf5"], more].concat());
            String::from_utf8_lossy(&output.stdout).contains("taken for hopper-morph, as the file's name says")
        };
        assert!(named(&[]) && !named(&["--env", "hopper-morph"]), "{command}");
    }
    let output = tce(dir, &["learn", "--target", "arm.hdf5", "--extra", "other.hdf5", "--out", "out"]);
    assert_eq!(output.status.code(), Some(1), "{}", message(&output));
    let words =
        "other.hdf5: found extra rows of 4 observations and 2 actions, expected 3 and 2 as in the target, arm.hdf5";
    assert!(message(&output).contains(words), "{}", message(&output));
    assert!(!dir.join("out").exists());
}

/// Nobody can roll out a robot that has no simulator: what learned dynamics tell of the policy stands in the table instead.
#[test]
fn learn_says_what_a_policy_is_worth_without_a_simulator() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    pair(dir, &arm(3, 2, (4, 60), 1.0, 1), &arm(3, 2, (2, 40), 1.0, 2));
    let args = ["learn", "--target", "target.hdf5", "--source", "source.hdf5", "--out", "out"];
    let output = tce(dir, &[&args[..], TINY].concat());
    assert!(output.status.success(), "{}", message(&output));
    let text = String::from_utf8_lossy(&output.stdout);
    for words in ["imagined return", "±", "action error", "recommended policy: out/policy.safetensors"] {
        assert!(text.contains(words), "no {words:?} in:\n{text}");
    }
    assert!(!text.contains("score"), "{text}");
}

#[test]
fn files_that_are_mixed_up_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    pair(dir, &arm(3, 2, (1, 30), 1.0, 1), &arm(3, 2, (2, 40), 1.0, 2));
    let (_, told) = augment(dir, &[]);
    assert!(
        told.contains("the source (source.hdf5) has 30 rows, fewer than the target (target.hdf5) with 80"),
        "{told}"
    );
    // The same rows under another name are the same file.
    std::fs::copy(dir.join("target.hdf5"), dir.join("copy.hdf5")).unwrap();
    let output = tce(dir, &["augment", "--source", "copy.hdf5", "--target", "target.hdf5", "--out", "same.hdf5"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(message(&output).contains("found the same data as source and as target"), "{}", message(&output));
}

/// Results have no place in a sweep's folder, and a sweep none in another's.
#[test]
fn a_sweeps_folder_is_its_own() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    save(dir, "target.hdf5", &arm(3, 2, (2, 40), 1.0, 2));
    std::fs::write(
        dir.join("s.toml"),
        "tasks = [\"hopper-morph/medium/expert\"]\nvariants = [\"bc\"]\nfloors = false\n",
    )
    .unwrap();
    assert!(tce(dir, &["sweep", "plan", "s.toml", "--out", "s"]).status.success());
    for args in [
        &["learn", "--target", "target.hdf5", "--out", "s/runs/mine"][..],
        &["run", "hopper-morph/medium/expert", "--out", "s"],
        &["sweep", "plan", "s.toml", "--out", "s/inner"],
    ] {
        let output = tce(dir, args);
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(message(&output).contains("found the folder of a"), "{args:?}: {}", message(&output));
    }
    // Every task's data are looked for when the sweep is planned.
    std::fs::write(
        dir.join("t.toml"),
        "tasks = [\"hopper-morph/medium/medium-expert\", \"ant-gravity/medium/expert\"]\nvariants = [\"bc\"]\n\
        [data.\"ant-gravity/medium/expert\"]\ntarget = \"gone.hdf5\"\n",
    )
    .unwrap();
    let lacking = tce(dir, &["sweep", "plan", "t.toml", "--out", "t"]);
    assert!(!lacking.status.success() && message(&lacking).contains("gone.hdf5"), "{}", message(&lacking));
    assert!(!dir.join("t").exists());
}

/// Two behaviours in one file: the better trajectories are imitated, as `tce run` does.
#[test]
fn the_better_of_two_behaviours_is_learned() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let better = arm(4, 2, (4, 400), 1.0, 1);
    let mut worse = arm(4, 2, (4, 400), 1.0, 2);
    worse.rewards.iter_mut().for_each(|r| *r -= 5.0);
    let mut mixed = worse;
    mixed.extend(&better);
    save(dir, "better.hdf5", &better);
    save(dir, "mixed.hdf5", &mixed);
    let policy = |target: &str, out: &str, more: &[&str]| {
        let args = ["learn", "--target", target, "--out", out, "--no-verdict"];
        let output = tce(dir, &[&args, TINY, more].concat());
        assert!(output.status.success(), "{}", message(&output));
        (std::fs::read(dir.join(out).join("policy-seed0.safetensors")).unwrap(), message(&output))
    };
    let (of_better, _) = policy("better.hdf5", "better", &["--set", "target.trajectories=all"]);
    let (of_mixed, told) = policy("mixed.hdf5", "mixed", &[]);
    assert!(told.contains("learned from the better four (1600 of 3200 rows)"), "{told}");
    assert_eq!(of_mixed, of_better);
    let (of_all, _) = policy("mixed.hdf5", "all", &["--set", "target.trajectories=all"]);
    assert_ne!(of_all, of_better);
}
