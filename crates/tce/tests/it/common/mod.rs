//! What the end-to-end tests share: the real binary, and small data sets from random actions.

#![allow(dead_code)] // each test file uses its own part

pub mod sweeps;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use tce_base::Streams;
use tce_data::{Agent, Shift, Transitions, save_d4rl};
use tce_sim::{CollectOptions, UniformActor, collect};

/// `tce` in `directory`, to be run.
pub fn program(directory: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tce"));
    // No test may depend on the shared folder by accident.
    command.args(args).current_dir(directory).env("TCE_SHARED", directory.join("no-shared-folder"));
    command
}

/// Runs `tce` in `directory` and returns what it printed and how it ended.
pub fn tce(directory: &Path, args: &[&str]) -> Output {
    program(directory, args).output().expect("the binary runs")
}

/// `tce` in `directory` with a checkpoint at every opportunity, silent, to be waited for or killed.
pub fn silent(directory: &Path, args: &[&str]) -> Command {
    let mut command = program(directory, args);
    command.args(["--save-every", "0"]).stdout(Stdio::null()).stderr(Stdio::piped());
    command
}

/// What was printed on stderr, with the frame around it and the line breaks taken out.
pub fn message(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).replace('│', " ").split_whitespace().collect::<Vec<_>>().join(" ")
}

/// All files below `root`, ascending; none where there is no such folder.
pub fn files(root: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![root.to_owned()];
    while let Some(directory) = open.pop() {
        for path in fs::read_dir(&directory).into_iter().flatten().map(|e| e.unwrap().path()) {
            if path.is_dir() { open.push(path) } else { found.push(path) }
        }
    }
    found.sort();
    found
}

/// A small file system in memory, until it is dropped.
pub struct Tmpfs(PathBuf);

impl Tmpfs {
    /// None, and a line that says that `what` is skipped, where this user may not mount one.
    pub fn mount(at: &Path, kilobytes: u64, what: &str) -> Option<Self> {
        fs::create_dir_all(at).unwrap();
        let size = format!("size={kilobytes}k");
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs"]).arg(at).output();
        if mounted.is_ok_and(|o| o.status.success()) {
            return Some(Self(at.to_owned()));
        }
        eprintln!("SKIPPED: {what} needs the right to mount a tmpfs");
        None
    }

    /// Gives it another size.
    pub fn resize(&self, kilobytes: u64) {
        let options = format!("remount,size={kilobytes}k");
        assert!(Command::new("mount").args(["-o", &options]).arg(&self.0).status().unwrap().success());
    }
}

impl Drop for Tmpfs {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
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
    "--set",
    "single_stage.steps=40",
    "--set",
    "single_stage.rows=600",
    "--set",
    "single_stage.sampler.steps=4",
    "--set",
    "single_stage.width=32",
    "--set",
    "dynamics.steps=20",
    "--set",
    "fitted_q.steps=20",
];
