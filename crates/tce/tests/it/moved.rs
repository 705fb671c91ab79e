//! A program that was copied elsewhere: what it does without MuJoCo, and where it finds MuJoCo.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::common::{data_pair, files, message};
use tce_data::{Agent, Shift};

const LIBRARY: &str = "libmujoco.so.3.17.0";

/// An episode in the simulator.
const EVALUATE: [&str; 6] = ["evaluate", "zoo:hopper-source-medium", "--env", "hopper", "--episodes", "1"];

/// `tce` alone in `folder`, which is made.
fn copied_to(folder: &Path) -> PathBuf {
    fs::create_dir_all(folder).unwrap();
    let copy = folder.join("tce");
    fs::copy(env!("CARGO_BIN_EXE_tce"), &copy).unwrap();
    copy
}

/// The library of this build.
fn library() -> PathBuf {
    let path = tce_sim::open_library().unwrap();
    assert!(path.is_absolute(), "the build's own library, found {}", path.display());
    path
}

/// Runs `program` in its folder; no variable leads it to the simulator.
fn run(program: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(program);
    command.args(args).current_dir(program.parent().unwrap()).env_remove("TCE_MUJOCO_LIB");
    command.env_remove("LD_LIBRARY_PATH").env("TCE_SHARED", "no-shared-folder").output().unwrap()
}

/// Runs `program` in its folder, told of a library that does not exist. Nothing else is tried then.
fn run_without(program: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(program);
    command.args(args).current_dir(program.parent().unwrap()).env("TCE_MUJOCO_LIB", "/not/there/libmujoco.so");
    command.env("TCE_SHARED", "no-shared-folder").output().unwrap()
}

#[test]
fn without_mujoco_data_are_checked_and_learned_from() {
    let dir = tempfile::tempdir().unwrap();
    let program = copied_to(&dir.path().join("elsewhere"));
    let (source, target) = data_pair(program.parent().unwrap(), Agent::Hopper, Shift::Morph);
    let (source, target) = (source.to_str().unwrap(), target.to_str().unwrap());
    let short = ["--set", "learner.steps=20", "--set", "dynamics.steps=20", "--set", "fitted_q.steps=20"];
    let learn: &[&str] = &["learn", "--learner", "bc", "--source", source, "--target", target, "--out", "policy"];
    for args in [
        &["data", "check", target][..],
        &[learn, &short].concat(),
        &[
            "compare",
            "policy/policy.safetensors",
            "--source",
            source,
            "--target",
            target,
            "--dynamics-steps",
            "20",
            "--fitted-q-steps",
            "0",
        ],
        &["zoo", "list"],
        &["config", "show"],
    ] {
        let output = run_without(&program, args);
        assert!(output.status.success(), "tce {args:?}: {}", message(&output));
    }
}

#[test]
fn commands_that_simulate_say_so_before_they_begin() {
    let dir = tempfile::tempdir().unwrap();
    let program = copied_to(dir.path());
    let (_, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let before = files(dir.path());
    for args in [
        &EVALUATE[..],
        &["run", "hopper-morph:medium->expert", "--preset", "quick"],
        &["collect", "--env", "hopper", "--quality", "medium", "--out", "rows.hdf5"],
        &["train-sac", "hopper", "--steps", "1000"],
        &["zoo", "rollout", "hopper-source-medium"],
        &["data", "check", "--replay", "--env", "hopper-morph", target.to_str().unwrap()],
        &["diagnose", "generator", "hopper-morph:medium->expert"],
        &["bench", "env-hopper"],
    ] {
        let output = run_without(&program, args);
        let said = message(&output);
        assert_eq!(output.status.code(), Some(1), "tce {args:?}: {said}");
        assert!(said.contains("TCE_MUJOCO_LIB is `/not/there/libmujoco.so`: found no such file"), "{said}");
        assert!(said.contains("pip install") && said.contains("mujoco==3.17.0"), "{said}");
    }
    assert_eq!(files(dir.path()), before, "nothing was begun");
}

#[test]
fn the_library_is_taken_from_beside_the_program_or_from_lib() {
    let dir = tempfile::tempdir().unwrap();
    let program = copied_to(&dir.path().join("bin"));
    for folder in ["lib", "bin"] {
        let library_here = dir.path().join(folder).join(LIBRARY);
        fs::create_dir_all(library_here.parent().unwrap()).unwrap();
        // That this one is taken shows when it is bad: the build's own would do.
        fs::write(&library_here, "not a library").unwrap();
        let output = run(&program, &EVALUATE);
        let said = message(&output).replace(' ', "");
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains(library_here.to_str().unwrap()), "{said}");
        fs::copy(library(), &library_here).unwrap();
        let output = run(&program, &EVALUATE);
        assert!(output.status.success(), "{}", message(&output));
    }
}

#[test]
fn where_there_is_none_every_place_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let program = copied_to(&dir.path().join("bin"));
    // In a mount name space of its own, the build's library is covered by an empty folder.
    let hidden = library().parent().unwrap().to_owned();
    let inside = |script: &str| {
        let mut command = Command::new("unshare");
        command.args(["--map-root-user", "--mount", "sh", "-c", script]).arg(&hidden).arg(&program).args(EVALUATE);
        command.env_remove("TCE_MUJOCO_LIB").env_remove("LD_LIBRARY_PATH").output()
    };
    if !inside(r#"mount -t tmpfs none "$0""#).is_ok_and(|o| o.status.success()) {
        eprintln!("SKIPPED: where_there_is_none_every_place_is_told needs the right to mount a tmpfs");
        return;
    }
    let output = inside(r#"mount -t tmpfs none "$0" && exec "$@""#).unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", message(&output));
    let said = message(&output).replace(' ', "");
    for place in [&dir.path().join("bin"), &dir.path().join("lib"), &hidden] {
        assert!(said.contains(place.join(LIBRARY).to_str().unwrap()), "{}: {said}", place.display());
    }
    assert!(said.contains("TCE_MUJOCO_LIB:notset") && said.contains("LD_LIBRARY_PATH"), "{said}");
}

#[test]
fn another_version_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let (source, other) = (dir.path().join("other.c"), dir.path().join("libmujoco.so.3.16.0"));
    fs::write(&source, "const char *mj_versionString(void) { return \"3.16.0\"; }").unwrap();
    let compiled = Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&other).arg(&source).status();
    assert!(compiled.unwrap().success(), "the C toolchain that linked this test");
    let mut command = crate::common::program(dir.path(), &EVALUATE);
    let output = command.env("TCE_MUJOCO_LIB", &other).output().unwrap();
    let said = message(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("libmujoco.so.3.16.0: found MuJoCo 3.16.0, expected 3.17.0"), "{said}");
}
