//! What the end-to-end tests share: the real binary, and small data sets from random actions.

#![allow(dead_code)] // each test file uses its own part

pub mod sweeps;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use tce_base::Streams;
use tce_data::{Agent, Shift, Transitions, save_d4rl};
use tce_sim::{CollectOptions, UniformActor, collect};

/// Runs `tce` in `directory` and returns what it printed and how it ended.
pub fn tce(directory: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tce"))
        .args(args)
        .current_dir(directory)
        // No test may depend on the shared folder by accident.
        .env("TCE_SHARED", directory.join("no-shared-folder"))
        .output()
        .expect("the binary runs")
}

/// The same, for calls that must succeed; standard output as JSON.
pub fn tce_json(directory: &Path, args: &[&str]) -> serde_json::Value {
    let output = tce(directory, &[args, &["--json"]].concat());
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "tce {args:?} failed:\n{stderr}");
    serde_json::from_slice(&output.stdout).expect("one JSON document")
}

/// Transitions of random actions.
pub fn random_rows(agent: Agent, shift: Shift, rows: usize, seed: u64) -> Transitions {
    let options = CollectOptions { lanes: 4, ..CollectOptions::new(rows, Streams::new(seed)) };
    collect(agent, shift, &UniformActor, &options).expect("random actions are harmless")
}

/// A pair of files, source and target, in `directory`.
pub fn data_pair(directory: &Path, agent: Agent, shift: Shift) -> (PathBuf, PathBuf) {
    let (source, target) = (directory.join("source.hdf5"), directory.join("target.hdf5"));
    save_d4rl(&source, &random_rows(agent, Shift::Source, 1500, 1), &BTreeMap::new(), &[]).unwrap();
    save_d4rl(&target, &random_rows(agent, shift, 600, 2), &BTreeMap::new(), &[]).unwrap();
    (source, target)
}

/// Settings under which the whole pipeline takes a second or two.
pub const TINY: &[&str] = &[
    "--set",
    "generator.state_steps=40",
    "--set",
    "generator.transition_steps=40",
    "--set",
    "generator.rows=600",
    "--set",
    "generator.sampler.steps=4",
    "--set",
    "labels.training.steps=40",
    "--set",
    "learner.steps=60",
    "--set",
    "learner.behaviour.cvae.steps=30",
    "--set",
    "learner.batch=32",
    "--set",
    "evaluation.episodes=2",
];
