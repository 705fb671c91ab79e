//! Work that is killed, stopped, copied, or out of space ends with the bytes of undisturbed work.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use crate::common::{Tmpfs, files, message, silent, tce};
use tce_base::{Rng, Streams, sha256_hex};

/// The whole pipeline in some seconds, with every stage long enough to be hit.
const SMALL: &[&str] = &[
    "--set=source.rows=2000",
    "--set=generator.state_steps=300",
    "--set=generator.transition_steps=300",
    "--set=generator.batch=32",
    "--set=generator.rows=5000",
    "--set=generator.sampler.steps=4",
    "--set=labels.training.steps=200",
    "--set=labels.training.batch=32",
    "--set=learner.steps=400",
    "--set=learner.behaviour.cvae.steps=30",
    "--set=learner.behaviour.cvae.hidden=[16]",
    "--set=learner.batch=32",
    "--set=evaluation.episodes=2",
    "--set=evaluation.every=150",
    "--set=dynamics.steps=20",
    "--set=fitted_q.steps=20",
];

/// The program at work, with a checkpoint at every opportunity.
fn start(directory: &Path, args: &[&str]) -> Child {
    silent(directory, args).spawn().expect("the binary runs")
}

fn pipeline(out: &str) -> Vec<&str> {
    let task = ["run", "hopper-morph:medium->expert", "--variant", "tce-og", "--no-baselines", "--out", out];
    [&task[..], SMALL].concat()
}

/// Every file below `root` by its path, as far as it is a result: hashes, for records of times what else they hold.
fn results(root: &Path) -> BTreeMap<String, String> {
    let mut out = BTreeMap::new();
    for path in files(root) {
        let name = path.strip_prefix(root).unwrap().display().to_string();
        // TensorBoard's events hold the time, and so does what steps have cost.
        let no_result = |n: &std::ffi::OsStr| n == "lock" || n == "costs.json";
        if path.iter().any(|part| part == "tensorboard") || path.file_name().is_some_and(no_result) {
            continue;
        }
        let bytes = fs::read(&path).unwrap();
        let content = match path.file_name().unwrap().to_str().unwrap() {
            "done.json" => {
                let done: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
                done["files"].to_string()
            }
            // Two networks that train side by side take turns in it as it comes.
            "metrics.jsonl" => {
                let mut lines: Vec<_> = std::str::from_utf8(&bytes).unwrap().lines().collect();
                lines.sort_unstable();
                lines.join("\n")
            }
            _ => sha256_hex(&bytes),
        };
        out.insert(name, content);
    }
    out
}

fn assert_same(expected: &BTreeMap<String, String>, root: &Path, what: &str) {
    let found = results(root);
    let names = |m: &BTreeMap<String, String>| m.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(expected), names(&found), "{what}: other files");
    for (name, content) in expected {
        assert!(*content == found[name], "{what}: {name} differs:\n{content}\n{}", found[name]);
    }
}

fn below(rng: &mut Rng, n: u64) -> u64 {
    use rand::RngExt;
    rng.random_range(0..n)
}

/// Checkpoints and chunks below `root`.
fn kept(root: &Path) -> Vec<PathBuf> {
    let kept = |p: &PathBuf| p.extension().is_some_and(|e| e == "checkpoint" || e == "chunk");
    files(root).into_iter().filter(kept).collect()
}

/// Cuts a file, or flips a bit of it.
fn damage(path: &Path, rng: &mut Rng) {
    let mut bytes = fs::read(path).unwrap();
    let at = below(rng, bytes.len() as u64) as usize;
    match below(rng, 2) {
        0 => bytes.truncate(at),
        _ => bytes[at] ^= 1 << below(rng, 8),
    }
    fs::write(path, bytes).unwrap();
}

/// Kills the command at random times, `kills` times in all, beginning anew whenever it came to its end; now and then a file that
/// was kept is damaged. Returns how many times it came to its end.
fn kill_loop(directory: &Path, args: &[&str], out: &str, kills: usize, seed: u64) -> usize {
    let whole_time = Instant::now();
    let whole = start(directory, args).wait_with_output().unwrap();
    let whole_time = whole_time.elapsed().as_millis() as u64;
    assert!(whole.status.success(), "{}", String::from_utf8_lossy(&whole.stderr));
    let root = directory.join(out);
    let expected = results(&root);
    assert!(expected.keys().all(|name| !name.contains("attempts")), "{expected:?}");
    let mut rng = Streams::new(seed).stream("kill");
    let (mut done, mut ends) = (0, 0);
    fs::remove_dir_all(&root).unwrap();
    while done < kills {
        let mut child = start(directory, args);
        // Short enough that most rounds are hit several times, long enough that none is hit for ever.
        std::thread::sleep(Duration::from_millis(20 + below(&mut rng, whole_time / 2)));
        match child.try_wait().unwrap() {
            None => {
                child.kill().unwrap();
                child.wait().unwrap();
                done += 1;
                let files = kept(&root);
                if done % 5 == 0 && !files.is_empty() {
                    damage(&files[below(&mut rng, files.len() as u64) as usize], &mut rng);
                }
            }
            Some(status) => {
                let output = child.wait_with_output().unwrap();
                assert!(status.success(), "{}", String::from_utf8_lossy(&output.stderr));
                assert_same(&expected, &root, "after kills");
                ends += 1;
                fs::remove_dir_all(&root).unwrap();
            }
        }
    }
    let last = start(directory, args).wait_with_output().unwrap();
    assert!(last.status.success(), "{}", String::from_utf8_lossy(&last.stderr));
    assert_same(&expected, &root, "at the end");
    ends + 1
}

/// How many kills: `TCE_KILLS`, for the longer loop of CONTRIBUTING.md.
fn kills(usual: usize) -> usize {
    std::env::var("TCE_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(usual)
}

#[test]
fn a_run_killed_anywhere_ends_with_the_bytes_of_an_undisturbed_one() {
    let dir = tempfile::tempdir().unwrap();
    let ends = kill_loop(dir.path(), &pipeline("runs"), "runs", kills(25), 1);
    eprintln!("{ends} runs came to their end");
}

/// What BOSA, IGDF and Meta-DT train before their first step is resumed too.
#[test]
fn prior_methods_killed_anywhere_learn_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let task = [
        "run",
        "hopper-morph:medium->expert",
        "--variant",
        "bosa,igdf,otdf,meta-dt",
        "--no-baselines",
        "--out",
        "runs",
    ];
    let own = [
        "--set=learner.bosa.cvae.steps=150",
        "--set=learner.bosa.cvae.hidden=[16]",
        "--set=learner.bosa.cvae.batch=32",
        "--set=learner.igdf.steps=200",
        "--set=learner.meta_dt.world_model.steps=60",
        "--set=learner.meta_dt.embed=16",
        "--set=learner.meta_dt.batch=16",
        "--set=learner.steps=100",
    ];
    kill_loop(dir.path(), &[&task[..], SMALL, &own].concat(), "runs", kills(8), 3);
}

#[test]
fn a_diagnosis_killed_anywhere_measures_the_same() {
    let dir = tempfile::tempdir().unwrap();
    crate::common::data_pair(dir.path(), tce_data::Agent::Hopper, tce_data::Shift::Morph);
    let files = ["diagnose", "--source", "source.hdf5", "--target", "target.hdf5", "--out", "runs"];
    let few =
        ["--rows", "200", "--y-max", "0", "--transition-steps", "100", "--value-steps", "100", "--abundant", "400"];
    kill_loop(dir.path(), &[&files[..], &few, SMALL].concat(), "runs", kills(10), 4);
}

#[test]
fn an_agent_killed_anywhere_learns_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let args = [
        &[
            "train-sac",
            "hopper",
            "--steps",
            "700",
            "--start",
            "100",
            "--batch",
            "32",
            "--episodes",
            "1",
            "--out",
            "sac",
        ][..],
        &["--evaluate-every", "100", "--checkpoint-every", "50", "--snapshot-scores", "-50,0"],
    ]
    .concat();
    kill_loop(dir.path(), &args, "sac", kills(10), 2);
}

#[cfg(unix)]
#[test]
fn a_signal_ends_a_run_between_two_steps() {
    let dir = tempfile::tempdir().unwrap();
    let args = pipeline("runs");
    let whole = start(dir.path(), &args).wait_with_output().unwrap();
    assert!(whole.status.success(), "{}", String::from_utf8_lossy(&whole.stderr));
    let expected = results(&dir.path().join("runs"));
    fs::remove_dir_all(dir.path().join("runs")).unwrap();
    let mut stopped = 0;
    for (k, signal) in ["TERM", "USR1", "INT", "TERM"].iter().enumerate() {
        let child = start(dir.path(), &args);
        std::thread::sleep(Duration::from_millis(250 + 250 * k as u64));
        Command::new("kill").args([&format!("-{signal}"), &child.id().to_string()]).status().unwrap();
        let output = child.wait_with_output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        match output.status.code() {
            Some(0) => {}
            code => {
                // A signal before the program listens ends it as the system does.
                assert!(matches!(code, Some(130) | None), "{code:?} {message}");
                stopped += usize::from(code == Some(130));
            }
        }
    }
    assert!(stopped > 0, "no signal came in time");
    assert!(start(dir.path(), &args).wait().unwrap().success());
    assert_same(&expected, &dir.path().join("runs"), "after signals");
}

#[test]
fn three_copies_at_once_are_harmless() {
    let dir = tempfile::tempdir().unwrap();
    let args = pipeline("alone");
    assert!(start(dir.path(), &args).wait().unwrap().success());
    let together = pipeline("together");
    let copies: Vec<_> = (0..3).map(|_| start(dir.path(), &together)).collect();
    for copy in copies {
        let output = copy.wait_with_output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    assert_same(&results(&dir.path().join("alone")), &dir.path().join("together"), "three copies");
}

#[test]
fn a_full_disk_costs_time_only() {
    let dir = tempfile::tempdir().unwrap();
    assert!(start(dir.path(), &pipeline("whole")).wait().unwrap().success());
    let expected = results(&dir.path().join("whole"));
    let bytes: u64 = files(&dir.path().join("whole")).iter().map(|p| p.metadata().unwrap().len()).sum();
    let size = bytes / 1024;
    let Some(disk) = Tmpfs::mount(&dir.path().join("small"), 64, "a full disk") else { return };
    let args = pipeline("small/runs");
    let mut refused = 0;
    // More and more space, until the whole run fits.
    for share in [10, 30, 50, 70, 90, 110, 400] {
        disk.resize(size * share / 100);
        let output = start(dir.path(), &args).wait_with_output().unwrap();
        if !output.status.success() {
            refused += 1;
            let message = String::from_utf8_lossy(&output.stderr).into_owned();
            assert_eq!(output.status.code(), Some(1), "{message}");
            assert!(message.contains("space"), "{message}");
        }
    }
    assert!(refused >= 3, "only {refused} runs met a full disk of less than {size} kB");
    assert_same(&expected, &dir.path().join("small/runs"), "after full disks");
}

#[test]
fn a_learning_goes_on_where_it_stopped_and_refuses_another() {
    let dir = tempfile::tempdir().unwrap();
    crate::common::data_pair(dir.path(), tce_data::Agent::Hopper, tce_data::Shift::Morph);
    let args = |out: &'static str| {
        let call = ["learn", "--target", "target.hdf5", "--extra", "source.hdf5", "--algorithm", "iql", "--out", out];
        [
            &call[..],
            &[
                "--set=learner.steps=600",
                "--set=learner.batch=32",
                "--set=learner.iql.regulariser=none",
                "--set=dynamics.steps=20",
                "--set=fitted_q.steps=20",
            ],
        ]
        .concat()
    };
    assert!(start(dir.path(), &args("whole")).wait().unwrap().success());
    let mut rng = Streams::new(3).stream("kill");
    for _ in 0..6 {
        let mut child = start(dir.path(), &args("killed"));
        std::thread::sleep(Duration::from_millis(50 + below(&mut rng, 400)));
        let _ = child.kill();
        child.wait().unwrap();
    }
    assert!(start(dir.path(), &args("killed")).wait().unwrap().success());
    for file in ["policy-seed0.safetensors", "metrics.jsonl"] {
        let bytes = ["whole", "killed"].map(|out| fs::read(dir.path().join(out).join(file)).unwrap());
        assert!(bytes[0] == bytes[1], "{file} differs");
    }
    assert!(kept(dir.path()).is_empty());

    // Again, it is done; without its policy it is learned again; another learning has no business here.
    let again = tce(dir.path(), &args("whole"));
    assert!(again.status.success() && message(&again).contains("done before"), "{}", message(&again));
    let refuse = |what: &str| {
        let other = tce(dir.path(), &[&args("whole")[..], &["--set=learner.steps=700"]].concat());
        assert_eq!(other.status.code(), Some(2));
        let expected = format!("found {what} training run with other settings, seeds or files");
        assert!(message(&other).contains(&expected), "{}", message(&other));
    };
    refuse("the results of a");

    // Moved elsewhere, it is still done.
    fs::rename(dir.path().join("whole"), dir.path().join("moved")).unwrap();
    let again = tce(dir.path(), &args("moved"));
    assert!(again.status.success() && message(&again).contains("done before"), "{}", message(&again));
    fs::rename(dir.path().join("moved"), dir.path().join("whole")).unwrap();

    // Interrupted after its trainings, none of them is done again.
    let verdict = fs::read(dir.path().join("whole/verdict.json")).unwrap();
    fs::remove_file(dir.path().join("whole/summary.json")).unwrap();
    let again = tce(dir.path(), &args("whole"));
    assert!(again.status.success(), "{}", message(&again));
    assert_eq!(
        message(&again).matches("learned before").count(),
        2,
        "the policy and the baseline: {}",
        message(&again)
    );
    assert!(fs::read(dir.path().join("whole/verdict.json")).unwrap() == verdict);

    let results = ["policy-seed0.safetensors", "summary.json"].map(|file| dir.path().join("whole").join(file));
    let bytes = fs::read(&results[0]).unwrap();
    for lost in [&results[..1], &results[..]] {
        lost.iter().for_each(|file| fs::remove_file(file).unwrap());
        if lost.len() == 2 {
            refuse("an interrupted");
        }
        assert!(tce(dir.path(), &args("whole")).status.success());
        assert!(fs::read(&results[0]).unwrap() == bytes);
    }
}

#[test]
fn policies_that_were_not_compared_are_compared_later() {
    let dir = tempfile::tempdir().unwrap();
    crate::common::data_pair(dir.path(), tce_data::Agent::Hopper, tce_data::Shift::Morph);
    let call = ["learn", "--target", "target.hdf5", "--extra", "source.hdf5", "--out", "policies"];
    let small =
        ["--set=learner.steps=40", "--set=learner.batch=32", "--set=dynamics.steps=20", "--set=fitted_q.steps=20"];
    let learn = |more: &[&str]| {
        let output = tce(dir.path(), &[&call[..], &small[..], more].concat());
        (output.status.code(), message(&output))
    };
    assert_eq!(learn(&["--no-verdict"]).0, Some(0));
    let [policy, verdict] = ["policy-seed0.safetensors", "verdict.json"].map(|f| dir.path().join("policies").join(f));
    let (bytes, written) = (fs::read(&policy).unwrap(), policy.metadata().unwrap().modified().unwrap());
    assert!(!verdict.exists());
    // The source helps to compare them and teaches them nothing.
    let (code, said) = learn(&["--source", "source.hdf5"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("learned before") && verdict.exists(), "{said}");
    assert!(fs::read(&policy).unwrap() == bytes && policy.metadata().unwrap().modified().unwrap() == written);
    // Then it is done, with a verdict and without; another source would give another verdict.
    for more in [&["--source", "source.hdf5"][..], &["--no-verdict"]] {
        assert!(learn(more).1.contains("done before"), "{more:?}");
    }
    let (code, said) = learn(&[]);
    assert_eq!(code, Some(2), "{said}");
}
