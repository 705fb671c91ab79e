//! Forty mistakes that people make, and what each is told: a snapshot of all messages, and what holds for every one of them.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use crate::common::{data_pair, program, random_rows};
use tce_data::{Agent, Shift, save_d4rl};

/// Calls, one a line, in a folder with `source.hdf5`, `target.hdf5` and `ant.hdf5`, a folder `folder` with one data set, and a file `notes.txt`.
const CALLS: &str = "
run hopper-morph:medium-
run hopper-morph:medium-expert
run hoper-morph/medium/expert
run hopper-morf/medium/expert
run hopper/medium/expert
run hopper-morph/medium/exprt
run hopper-morph/medium/
run hopper-morph
run hopper-morph/medium/expert --preset defualt
run hopper-morph/medium/expert --set learner.step=5
run hopper-morph/medium/expert --set temperature=5
run hopper-morph/medium/expert --set learner.steps=many
run hopper-morph/medium/expert --set learner.steps=-5
run hopper-morph/medium/expert --set learner.steps=0
run hopper-morph/medium/expert --set learner.steps=2.5
run hopper-morph/medium/expert --set learner.algorithm=td3bc
run hopper-morph/medium/expert --set filter.enabled=maybe
run hopper-morph/medium/expert --learner cql
run hopper-morph/medium/expert --learner iql --set mixture.actions=clones
run hopper-morph/medium/expert --seeds 0
run hopper-morph/medium/expert --config nofile.toml
run hopper-morph/medium/expert --out notes.txt
run ant-gravity/medium/expert --target nofile.hdf5
learn --target target.hdf5
learn --target folder --out out
learn --target nofile.hdf5 --out out
learn --target notes.txt --out out
learn --target target.hdf5 --out notes.txt
learn --target target.hdf5 --out notes.txt/out
learn --target target.hdf5 --out out --learner dara
learn --target target.hdf5 --source ant.hdf5 --out out
learn --target target.hdf5 --extra target.hdf5 --out out
learn --target target.hdf5 --extra source.hdf5 --out out --learner iql --set mixture.actions=clones --set mixture.generated=none
learn --target target.hdf5 --out out --actions both
learn --target target.hdf5 --extra source.hdf5 --out out --actions both --no-verdict
learn --target target.hdf5 --out out --set target.rows=3
learn --target target.hdf5 --out out --set learner.bc.actor.hidden=[256,0]
augment --source target.hdf5 --target target.hdf5 --out wider.hdf5
augment --source source.hdf5 --target ant.hdf5 --out wider.hdf5
augment --source source.hdf5 --target target.hdf5 --out target.hdf5
augment --source source.hdf5 --target target.hdf5 --out notes.txt/wider.hdf5
evaluate zoo:hopper-source-expert --env hoper
evaluate zoo:hopper-expert --env hopper
evaluate zoo:ant-source-expert --env hopper
evaluate target.hdf5 --env hopper
evaluate nofile.safetensors --env hopper
collect --env hopper --quality good --out rows.hdf5
collect --env hopper --quality medium --out target.hdf5
sweep plan nofile.toml
sweep status nowhere
report nowhere
diagnose nowhere
train-sac hopper --steps 0
train-sac hopper --from nowhere
rnu hopper-morph/medium/expert
";

/// The message without the terminal's frame and line breaks, and without what differs from machine to machine.
fn message(stderr: &[u8], folder: &Path) -> String {
    let text = String::from_utf8_lossy(stderr).replace(&*folder.to_string_lossy(), "HERE");
    text.replace('│', " ").replace('×', "error: ").split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn every_mistake_is_told_in_words_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    data_pair(dir, Agent::Hopper, Shift::Morph);
    save_d4rl(&dir.join("ant.hdf5"), &random_rows(Agent::Ant, Shift::Morph, 100, 3), &Default::default(), &[]).unwrap();
    fs::write(dir.join("notes.txt"), "none of the program's").unwrap();
    fs::create_dir(dir.join("folder")).unwrap();
    fs::copy(dir.join("target.hdf5"), dir.join("folder/rows.hdf5")).unwrap();
    let before = crate::common::files(dir);
    let mut all = String::new();
    for call in CALLS.lines().filter(|l| !l.is_empty()) {
        let args: Vec<&str> = call.split(' ').collect();
        let output = program(dir, &args).env("COLUMNS", "100").output().unwrap();
        let (code, text) = (output.status.code(), message(&output.stderr, dir));
        assert!(matches!(code, Some(1 | 2)), "tce {call}: {code:?}: {text}");
        assert!(output.stdout.is_empty(), "tce {call}: something on stdout");
        assert_eq!(crate::common::files(dir), before, "tce {call}: left files behind");
        for inner in ["attempts/", ".part", "os error", "u64", "panicked", "thread '"] {
            assert!(!text.contains(inner), "tce {call}: `{inner}` in: {text}");
        }
        // What is told is told once.
        let sentence = text.split_once("error: ").map_or(text.as_str(), |(_, told)| told);
        let half = &sentence[..sentence.floor_char_boundary(sentence.len() / 2)];
        let tail = &half[half.floor_char_boundary(half.len().saturating_sub(40))..];
        assert!(tail.len() < 30 || sentence.matches(tail).count() == 1, "tce {call}: told twice: {text}");
        writeln!(all, "tce {call}\n  {}: {text}\n", code.unwrap()).unwrap();
    }
    assert!(CALLS.lines().filter(|l| !l.is_empty()).count() >= 40);
    insta::assert_snapshot!(all);
}
