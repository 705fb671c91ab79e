//! Sweeps through the real binary: on this machine, and on a Slurm that is played by scripts.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant, SystemTime};

use crate::common::sweeps::{SETS, describe, outcomes};
use crate::common::{files, message, program, silent, tce, tce_json};
use rand::RngExt;
use tce_base::Streams;

#[test]
fn a_sweep_ends_with_every_result_right() {
    let dir = tempfile::tempdir().unwrap();
    let file = describe(dir.path(), "mine", 2);
    let text = fs::read_to_string(dir.path().join(&file)).unwrap();
    fs::write(dir.path().join(&file), text + "verdicts = true\n").unwrap();
    let planned = tce_json(dir.path(), &["sweep", "plan", &file]);
    assert_eq!(planned["verdict"], 2);
    assert_eq!(
        (&planned["run"], &planned["augment"], &planned["source"], &planned["target"]),
        (&6.into(), &2.into(), &1.into(), &1.into())
    );
    let folder = "runs/sweeps/mine";
    assert!(tce(dir.path(), &["sweep", "plan", &file]).status.success(), "the same plan again is no change");
    let other = describe(dir.path(), "other", 3);
    let refused = tce(dir.path(), &["sweep", "plan", &other, "--out", folder]);
    assert_eq!(refused.status.code(), Some(2));

    let early = tce(dir.path(), &["sweep", "gather", folder]);
    assert_eq!(early.status.code(), Some(1));
    assert!(message(&early).contains("6 not done"), "{}", message(&early));
    let status = tce_json(dir.path(), &["sweep", "launch", folder, "--workers", "2"]);
    assert_eq!(status["kinds"]["run"], serde_json::json!([6, 6]));
    assert_eq!(status["kinds"]["verdict"], serde_json::json!([2, 2]));
    assert_eq!(status["running"], serde_json::json!([]));
    let gathered = tce_json(dir.path(), &["sweep", "gather", folder]);
    assert_eq!(gathered["rows"].as_array().unwrap().len(), 6);

    // Of each seed one policy is recommended, and the best one of that seed is what it is held against.
    let report = tce_json(dir.path(), &["report", folder, "--resamples", "100"]);
    let recommended = report["recommendations"].as_array().unwrap();
    let seeds: Vec<u64> = recommended.iter().map(|r| r["seed"].as_u64().unwrap()).collect();
    assert_eq!(seeds.len(), 2);
    assert!(seeds.contains(&0) && seeds.contains(&1), "{recommended:?}");
    for one in recommended {
        assert_eq!(one["best"]["seed"], one["seed"]);
        assert!(one["best"]["score"].as_f64() >= one["score"].as_f64() && one["score"].is_number(), "{one}");
    }

    // A run of a sweep is a run like any other.
    let alone = {
        let mut args = vec![
            "run",
            "hopper-morph:medium->expert",
            "--variant",
            "tce-og",
            "--no-baselines",
            "--from-zoo",
            "--seed",
            "1",
        ];
        args.extend(SETS.iter().flat_map(|s| ["--set", s]));
        tce_json(dir.path(), &args)
    };
    let of = |seed: u64| {
        let rows = gathered["rows"].as_array().unwrap();
        rows.iter().find(|r| r["method"] == "tce-og" && r["seed"] == seed).unwrap().clone()
    };
    assert_eq!(of(1)["score"], alone["rows"][0]["scores"][0]);
    assert_ne!(of(0)["score"], of(1)["score"]);

    // Nothing is done twice.
    let before = outcomes(&dir.path().join(folder));
    let modified =
        |name: &str| fs::metadata(dir.path().join(folder).join("done").join(name)).unwrap().modified().unwrap();
    let times: Vec<_> = before.keys().map(|n| modified(n)).collect();
    assert!(tce(dir.path(), &["sweep", "launch", folder]).status.success());
    assert_eq!(times, before.keys().map(|n| modified(n)).collect::<Vec<_>>());

    // What was changed or lost is noticed, and only that is done again.
    let policy = dir.path().join(folder).join(of(0)["place"].as_str().unwrap()).join("policy-seed0.safetensors");
    let whole = fs::read(&policy).unwrap();
    let mut bytes = whole.clone();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&policy, bytes).unwrap();
    let corrupt = tce(dir.path(), &["sweep", "gather", folder]);
    assert!(message(&corrupt).contains("1 corrupt"), "{}", message(&corrupt));
    let partial = tce_json(dir.path(), &["sweep", "gather", folder, "--partial"]);
    assert_eq!(partial["rows"].as_array().unwrap().len(), 5);
    // A launch that only looks whether files exist has nothing to do; one that reads them does the run again.
    let launch = |more: &[&str]| {
        let output = tce(dir.path(), &[&["sweep", "launch", folder], more].concat());
        assert!(output.status.success(), "{}", message(&output));
        message(&output)
    };
    assert!(!launch(&[]).contains("to be done again"));
    let redone = launch(&["--verify"]);
    assert!(redone.contains("to be done again") && redone.contains("SHA-256"), "{redone}");
    assert_eq!(fs::read(&policy).unwrap(), whole);
    fs::remove_dir_all(policy.parent().unwrap()).unwrap();
    assert!(launch(&[]).contains("no such file"));
    assert_eq!(fs::read(&policy).unwrap(), whole);
    assert_eq!(outcomes(&dir.path().join(folder)), before);
    let (lost, _) = before.iter().next().unwrap();
    fs::remove_file(dir.path().join(folder).join("done").join(lost)).unwrap();
    assert!(tce(dir.path(), &["sweep", "launch", folder]).status.success());
    assert_eq!(outcomes(&dir.path().join(folder)), before);
}

/// The program in a process group of its own, so that its children outlive it.
fn in_group(directory: &Path, args: &[&str]) -> Child {
    silent(directory, args).process_group(0).spawn().unwrap()
}

#[test]
fn every_example_is_a_plan() {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
    let dir = tempfile::tempdir().unwrap();
    let plans = files(&examples).into_iter().filter(|p| p.extension().is_some_and(|e| e == "toml"));
    let mut seen = 0;
    for plan in plans {
        let planned = tce_json(dir.path(), &["sweep", "plan", plan.to_str().unwrap(), "--dry-run"]);
        assert!(planned["run"].as_u64().unwrap() >= 30, "{}: {planned}", plan.display());
        seen += 1;
    }
    assert!(seen >= 10, "{seen} plans");
}

#[test]
fn a_sweep_survives_its_launcher_and_its_workers() {
    let dir = tempfile::tempdir().unwrap();
    let file = describe(dir.path(), "s", 1);
    for out in ["whole", "killed"] {
        assert!(tce(dir.path(), &["sweep", "plan", &file, "--out", out]).status.success());
    }
    assert!(in_group(dir.path(), &["sweep", "launch", "whole", "--workers", "2"]).wait().unwrap().success());
    let expected = outcomes(&dir.path().join("whole"));
    assert_eq!(expected.len(), 2 + 1 + 3);
    let mut rng = Streams::new(5).stream("kill");
    for round in 0..8 {
        let mut launcher = in_group(dir.path(), &["sweep", "launch", "killed", "--workers", "2"]);
        std::thread::sleep(Duration::from_millis(rng.random_range(50..1200)));
        launcher.kill().unwrap();
        launcher.wait().unwrap();
        // Workers outlive their launcher. Now and then they die with it; otherwise they are the second copy of what the next
        // launcher starts.
        if round % 2 == 0 {
            let _ = Command::new("pkill").args(["-9", "-f", "run-one killed"]).status();
        }
    }
    let last = in_group(dir.path(), &["sweep", "launch", "killed", "--workers", "2"]).wait_with_output().unwrap();
    assert!(last.status.success(), "{}", message(&last));
    let rest = tce_json(dir.path(), &["sweep", "gather", "killed"]);
    assert_eq!(rest["conflicts"], serde_json::json!([]));
    assert_eq!(outcomes(&dir.path().join("killed")), expected);
    // Copies that still run come to their end without harm.
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(outcomes(&dir.path().join("killed")), expected);
}

/// A folder with the plan `out` of a small sweep.
fn planned(out: &str, seeds: u64) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let file = describe(dir.path(), "s", seeds);
    assert!(tce(dir.path(), &["sweep", "plan", &file, "--out", out]).status.success());
    dir
}

/// A piece of work by its kind and method: its place in the list, and its id.
fn piece(sweep: &Path, kind: &str, variant: Option<&str>) -> (usize, String) {
    let manifest = fs::read_to_string(sweep.join("manifest.jsonl")).unwrap();
    let mut entries = manifest.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
    let entry = entries.find(|e| e["kind"] == kind && e["variant"].as_str() == variant).expect("it is planned");
    (entry["index"].as_u64().unwrap() as usize, entry["id"].as_str().unwrap().to_owned())
}

/// Waits until something holds, with something to do between two looks.
fn wait_for(what: &str, ready: impl Fn() -> bool, between: impl Fn()) {
    let until = Instant::now() + Duration::from_secs(300);
    while !ready() {
        assert!(Instant::now() < until, "no {what} within five minutes");
        between();
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn touch(path: &Path, at: SystemTime) {
    fs::File::options().append(true).open(path).unwrap().set_modified(at).unwrap();
}

#[test]
fn work_of_another_launch_is_left_to_it_and_done_once_that_is_lost() {
    let dir = planned("s", 1);
    let sweep = dir.path().join("s");
    let ((index, source), (_, rows)) = (piece(&sweep, "source", None), piece(&sweep, "expand", None));
    let (_, clones) = piece(&sweep, "run", Some("bc"));
    // A process of another machine that shares the folder collects the source rows.
    let other = sweep.join(format!("active/{source}.elsewhere-1-2.7.1.json"));
    fs::create_dir_all(other.parent().unwrap()).unwrap();
    fs::write(&other, r#"{"owner":"elsewhere-1-2.7.1","job":null,"since":1}"#).unwrap();
    let heartbeat = || touch(&other, SystemTime::now());
    let mut launcher = in_group(dir.path(), &["sweep", "launch", "s", "--workers", "2"]);
    // What does not need them is done meanwhile.
    wait_for("clone", || sweep.join(format!("done/{clones}.json")).exists(), heartbeat);
    heartbeat();
    std::thread::sleep(Duration::from_millis(2500));
    assert!(launcher.try_wait().unwrap().is_none(), "it waits for the other process");
    for id in [&source, &rows] {
        assert!(
            !sweep.join(format!("logs/{id}.log")).exists(),
            "{id} was begun a second time, or without what it needs"
        );
    }
    let left = tce(dir.path(), &["sweep", "run-one", "s", &index.to_string(), "--leave-running"]);
    assert!(left.status.success() && message(&left).contains("another process is doing it"), "{}", message(&left));
    // Nothing was heard of it for two minutes.
    touch(&other, SystemTime::now() - Duration::from_secs(120));
    let ended = launcher.wait_with_output().unwrap();
    assert!(ended.status.success(), "{}", message(&ended));
    assert!(message(&ended).contains("other launches are busy with that"), "{}", message(&ended));
    assert_eq!(outcomes(&sweep).len(), 2 + 1 + 3);
}

#[test]
fn two_launches_share_the_work() {
    let dir = planned("s", 2);
    let launch = ["sweep", "launch", "s", "--workers", "1"];
    for launcher in [(); 2].map(|()| in_group(dir.path(), &launch)) {
        let ended = launcher.wait_with_output().unwrap();
        assert!(ended.status.success(), "{}", message(&ended));
    }
    let sweep = dir.path().join("s");
    let gathered = tce_json(dir.path(), &["sweep", "gather", "s"]);
    assert_eq!(gathered["rows"].as_array().unwrap().len(), 6);
    let mut runs = 0;
    for (name, outcome) in outcomes(&sweep) {
        let place = outcome["place"].as_str().unwrap();
        if !sweep.join(place).join("result.json").exists() {
            continue;
        }
        // Whoever begins a run says where.
        let log = fs::read_to_string(sweep.join("logs").join(name.replace(".json", ".log"))).unwrap();
        assert_eq!(log.matches(place).count(), 1, "{name} was begun more than once:\n{log}");
        runs += 1;
    }
    assert_eq!(runs, 6);
    assert!(files(&sweep.join("active")).is_empty());
}

#[test]
fn work_that_was_killed_counts_the_time_of_all_attempts() {
    let dir = tempfile::tempdir().unwrap();
    let file = describe(dir.path(), "s", 1);
    let text = fs::read_to_string(dir.path().join(&file)).unwrap();
    fs::write(dir.path().join(&file), text.replace("learner.steps=120", "learner.steps=600")).unwrap();
    assert!(tce(dir.path(), &["sweep", "plan", &file, "--out", "s"]).status.success());
    let sweep = dir.path().join("s");
    let (index, id) = piece(&sweep, "run", Some("bc"));
    let index = index.to_string();
    let mut first = in_group(dir.path(), &["sweep", "run-one", "s", &index]);
    let is_checkpoint = |path: &Path| {
        let name = path.file_name().unwrap().to_string_lossy();
        name.starts_with("learner.") && name.ends_with(".checkpoint")
    };
    wait_for("checkpoint", || files(&sweep.join("runs")).iter().any(|p| is_checkpoint(p)), || {});
    first.kill().unwrap();
    first.wait().unwrap();
    // As if it had begun long before.
    let is_note =
        |path: &Path| path.extension().is_some_and(|e| e == "seconds") || path.parent().unwrap().ends_with("spent");
    let notes: Vec<_> = files(&sweep).into_iter().filter(|p| is_note(p)).collect();
    assert_eq!(notes.len(), 3, "of the piece of work, the run and its training: {notes:?}");
    for note in &notes {
        let at = fs::metadata(note).unwrap().modified().unwrap();
        fs::write(note, r#"{"seconds":5000}"#).unwrap();
        touch(note, at);
    }
    let again = tce(dir.path(), &["sweep", "run-one", "s", &index]);
    assert!(again.status.success(), "{}", message(&again));
    let read = |path: &Path| serde_json::from_slice::<serde_json::Value>(&fs::read(path).unwrap()).unwrap();
    let outcome = read(&sweep.join(format!("done/{id}.json")));
    let done = read(&sweep.join(outcome["place"].as_str().unwrap()).join("done.json"));
    for seconds in [&outcome["seconds"], &done["summary"]["seconds"], &done["summary"]["learned"]["seconds"]] {
        let seconds = seconds.as_f64().unwrap();
        assert!((5000.0..6000.0).contains(&seconds), "{seconds} s in {outcome} and {done}");
    }
    assert!(files(&sweep.join("spent")).is_empty(), "nobody will resume it");
}

#[test]
fn one_task_that_is_left_out_is_no_plural() {
    let dir = tempfile::tempdir().unwrap();
    // The zoo has no expert of ant-gravity-5.
    let tasks = "tasks = [\"hopper-morph:medium->expert\", \"ant-gravity-5:medium->expert\"]\nvariants = [\"bc\"]\n";
    fs::write(dir.path().join("s.toml"), format!("{tasks}from_zoo = true\nunavailable = \"skip\"\n")).unwrap();
    let planned = tce(dir.path(), &["sweep", "plan", "s.toml", "--dry-run"]);
    assert!(planned.status.success(), "{}", message(&planned));
    let told = message(&planned);
    assert!(told.contains("1 task is left out, because its data cannot be had (ant-gravity-5"), "{told}");
}

#[test]
fn a_failure_is_kept_and_the_rest_is_done() {
    let dir = tempfile::tempdir().unwrap();
    let file = describe(dir.path(), "s", 1);
    let text = fs::read_to_string(dir.path().join(&file)).unwrap();
    // A threshold that rejects every generated row fails both methods that need them.
    let broken = text.replace("set = [", "set = [\"filter.enabled=true\", \"filter.z_threshold=0.1\", ");
    fs::write(dir.path().join(&file), broken).unwrap();
    assert!(tce(dir.path(), &["sweep", "plan", &file, "--out", "s"]).status.success());
    let launched = tce(dir.path(), &["sweep", "launch", "s", "--workers", "2", "--retries", "0"]);
    assert_eq!(launched.status.code(), Some(1));
    let told = message(&launched);
    // Three pieces fail for one cause, which is told once on the way and once in the end.
    assert_eq!(told.matches("z_threshold").count(), 1, "{told}");
    let shown = tce(dir.path(), &["sweep", "status", "s", "--json"]);
    assert_eq!(shown.status.code(), Some(1), "a sweep with failures is not well");
    let status: serde_json::Value = serde_json::from_slice(&shown.stdout).unwrap();
    assert_eq!(status["kinds"]["run"], serde_json::json!([1, 3]), "{status}");
    assert!(status["seconds_left"].is_null(), "{status}");
    let failed = status["failed"].as_array().unwrap();
    assert_eq!(failed.len(), 3);
    assert!(failed[0][1].as_str().unwrap().contains("z_threshold"), "{failed:?}");
    let shown = tce(dir.path(), &["sweep", "status", "s"]);
    let text = String::from_utf8_lossy(&shown.stdout);
    assert!(text.contains("3 failed") && text.contains("what failed keeps the sweep from its end"), "{text}");
    assert_eq!(text.matches("z_threshold").count(), 1, "equal messages are one: {text}");
}

#[test]
fn a_sweep_whose_workers_are_killed_has_failed_and_says_why() {
    let dir = planned("doomed", 1);
    // What went wrong yesterday is no reason of today's failures.
    let manifest = fs::read_to_string(dir.path().join("doomed/manifest.jsonl")).unwrap();
    let pieces = manifest.lines().filter_map(|line| {
        let entry: serde_json::Value = serde_json::from_str(line).unwrap();
        entry["id"].as_str().map(str::to_owned)
    });
    fs::create_dir_all(dir.path().join("doomed/failed")).unwrap();
    for id in pieces {
        fs::write(dir.path().join(format!("doomed/failed/{id}.json")), r#"{"error":"yesterday","at":1}"#).unwrap();
    }
    let launch = ["sweep", "launch", "doomed", "--workers", "2", "--retries", "0"];
    let mut launcher = program(dir.path(), &launch).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    while launcher.try_wait().unwrap().is_none() {
        let _ = Command::new("pkill").args(["-9", "-f", "run-one doomed"]).status();
        std::thread::sleep(Duration::from_millis(30));
    }
    let ended = launcher.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(1), "{}", message(&ended));
    assert!(!message(&ended).contains("yesterday"), "{}", message(&ended));
    let shown = tce(dir.path(), &["sweep", "status", "doomed", "--json"]);
    let status: serde_json::Value = serde_json::from_slice(&shown.stdout).unwrap();
    assert_eq!((shown.status.code(), &status["running"]), (Some(1), &serde_json::json!([])), "{status}");
    let failed = status["failed"].as_array().unwrap();
    assert!(!failed.is_empty() && failed.iter().all(|f| f[1].as_str().unwrap().contains("signal")), "{status}");
    // Launched again, they are done.
    let again = tce(dir.path(), &launch);
    assert!(again.status.success(), "{}", message(&again));
    assert!(tce(dir.path(), &["sweep", "status", "doomed"]).status.success());
}

#[test]
fn a_file_that_changed_since_the_plan_is_a_failure_with_a_reason() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = crate::common::data_pair(dir.path(), tce_data::Agent::Hopper, tce_data::Shift::Morph);
    let file = describe(dir.path(), "s", 1);
    let text = fs::read_to_string(dir.path().join(&file)).unwrap();
    let data = format!("\n[data.\"hopper-morph:medium->expert\"]\nsource = {source:?}\ntarget = {target:?}\n");
    fs::write(dir.path().join(&file), text.replace("from_zoo = true", "") + &data).unwrap();
    let planned = tce(dir.path(), &["sweep", "plan", &file, "--out", "s"]);
    assert!(planned.status.success(), "{}", message(&planned));
    let mut rows = fs::read(&target).unwrap();
    *rows.last_mut().unwrap() ^= 1;
    fs::write(&target, rows).unwrap();
    assert_eq!(tce(dir.path(), &["sweep", "run-one", "s", "0"]).status.code(), Some(1));
    let shown = tce(dir.path(), &["sweep", "status", "s", "--json"]);
    let status: serde_json::Value = serde_json::from_slice(&shown.stdout).unwrap();
    assert!(status["failed"][0][1].as_str().is_some_and(|e| e.contains("target.hdf5")), "{status}");
}

/// Scripts in place of Slurm's programs.
struct Fake {
    bin: std::path::PathBuf,
}

impl Fake {
    /// `sbatch` notes its arguments and, with `runs`, does the array's elements at once; `squeue` prints the file `queue`.
    fn new(directory: &Path, max_array_size: usize, sbatch: &str) -> Self {
        let bin = directory.join("bin");
        fs::create_dir_all(&bin).unwrap();
        let script = |name: &str, text: String| {
            let path = bin.join(name);
            fs::write(&path, format!("#!/bin/sh\n{text}\n")).unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        };
        let place = directory.display();
        script("scontrol", format!("echo 'MaxArraySize            = {max_array_size}'"));
        script("squeue", format!("cat {place}/queue 2>/dev/null; true"));
        script("sbatch", format!("echo \"$@\" >> {place}/calls\nn=$(wc -l < {place}/calls)\n{sbatch}\necho $n"));
        Self { bin }
    }

    fn tce(&self, directory: &Path, args: &[&str]) -> Output {
        let path = format!("{}:{}", self.bin.display(), std::env::var("PATH").unwrap());
        program(directory, args).env("PATH", path).output().unwrap()
    }
}

#[test]
fn slurm_gets_what_is_missing_in_arrays_that_it_accepts() {
    let dir = planned("s", 4);
    let fake = Fake::new(dir.path(), 3, "");
    let launch = ["sweep", "launch", "s", "--launcher", "slurm", "--pack", "2", "--sbatch=--time=01:00:00", "--json"];
    let dry = fake.tce(dir.path(), &[&launch[..], &["--dry-run"]].concat());
    assert!(dry.status.success(), "{}", message(&dry));
    assert!(!dir.path().join("calls").exists() && !dir.path().join("s/slurm").exists());

    let output = fake.tce(dir.path(), &launch);
    assert!(output.status.success(), "{}", message(&output));
    let calls = fs::read_to_string(dir.path().join("calls")).unwrap();
    let calls: Vec<&str> = calls.lines().collect();
    // 2 data sets, 4 sets of generated rows, 12 runs, two in an element, at most three elements in an array.
    assert_eq!(calls.len(), 1 + 1 + 2, "{calls:#?}");
    for (call, array) in calls.iter().zip(["0-0", "0-1", "0-2", "0-2"]) {
        assert!(call.contains(&format!("--array={array} ")), "{call}");
        assert!(call.contains("--time=01:00:00") && call.contains("--requeue") && call.contains("--signal=B:USR1@120"));
    }
    assert!(!calls[0].contains("--dependency"));
    assert!(calls[1].contains("--dependency=afterany:1 ") && calls[2].contains("--dependency=afterany:2 "));
    assert!(calls[3].contains("--dependency=afterany:2 "));

    // What the queue knows is not submitted again.
    fs::write(dir.path().join("queue"), "1|0|None\n2|0|Priority\n2|1|JobHeldUser\n3|0|\n3|1|None\n3|2|None\n4|0|None\n4|1|launch failed requeued held\n4|2|None\n").unwrap();
    assert!(fake.tce(dir.path(), &launch).status.success());
    let calls = fs::read_to_string(dir.path().join("calls")).unwrap();
    let last = calls.lines().last().unwrap();
    assert_eq!(calls.lines().count(), 5);
    assert!(last.contains("--array=0-0 "), "{last}");
}

#[test]
fn a_refusal_by_slurm_is_told_and_loses_nothing() {
    let dir = planned("s", 1);
    let launch = ["sweep", "launch", "s", "--launcher", "slurm"];
    let refusing = Fake::new(dir.path(), 1001, "echo 'sbatch: error: invalid account' >&2; exit 1");
    let output = refusing.tce(dir.path(), &launch);
    assert_eq!(output.status.code(), Some(1));
    assert!(message(&output).contains("invalid account"), "{}", message(&output));
    let without =
        Command::new(env!("CARGO_BIN_EXE_tce")).args(launch).current_dir(dir.path()).env("PATH", "/nowhere").output();
    assert!(message(&without.unwrap()).contains("--launcher local"));
}

#[test]
fn slurm_and_this_machine_give_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let file = describe(dir.path(), "s", 1);
    for out in ["local", "slurm"] {
        assert!(tce(dir.path(), &["sweep", "plan", &file, "--out", out]).status.success());
    }
    assert!(tce(dir.path(), &["sweep", "launch", "local"]).status.success());
    // The script of every element is run as Slurm would.
    let run = "for last; do :; done\nmax=$(echo \"$@\" | sed 's/.*--array=0-\\([0-9]*\\).*/\\1/')\nk=0\n\
               while [ $k -le $max ]; do SLURM_ARRAY_JOB_ID=$n SLURM_ARRAY_TASK_ID=$k SLURM_JOB_ID=$n sh $last >&2 || exit 1; k=$((k+1)); done";
    let fake = Fake::new(dir.path(), 1001, run);
    let output = fake.tce(dir.path(), &["sweep", "launch", "slurm", "--launcher", "slurm"]);
    assert!(output.status.success(), "{}", message(&output));
    assert!(fake.tce(dir.path(), &["sweep", "gather", "slurm"]).status.success());
    assert_eq!(outcomes(&dir.path().join("local")), outcomes(&dir.path().join("slurm")));
}

/// On a bare machine, with the zoo's actors alone.
#[test]
fn every_example_can_be_planned() {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
    let folders = [examples.clone(), examples.join("sensitivity")];
    let files = folders.iter().flat_map(|folder| fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()));
    let dir = tempfile::tempdir().unwrap();
    let mut planned = 0;
    for file in files.filter(|f| f.extension().is_some_and(|e| e == "toml")) {
        let plan = tce_json(dir.path(), &["sweep", "plan", file.to_str().unwrap(), "--dry-run"]);
        assert!(plan["run"].as_u64() > Some(0), "{}: {plan}", file.display());
        planned += 1;
    }
    assert!(planned > 5 && !dir.path().join("runs").exists(), "{planned} examples");
}
