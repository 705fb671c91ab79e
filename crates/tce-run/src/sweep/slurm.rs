//! A sweep on a Slurm cluster: array jobs of unfinished work.
//!
//! Job numbers are notes only, and `sacct` is not needed: a launch submits work that is neither finished nor, according to
//! `squeue`, submitted. If the queue loses a job, or a node that was given up still runs, another launch does no harm: what a process is
//! doing, a second one waits for, and two copies of the same work are allowed (see [`super::work`]).

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering};

use serde::Serialize;
use tce_base::{Owner, create_folder, sha256_hex, write_atomically};

use super::{Kind, Sweep};
use crate::device_kind::DeviceKind;
use crate::error::{Error, Result};

/// How to submit.
#[derive(Clone, Debug)]
pub struct Submission {
    /// Pieces of work in one element of an array, one after the other: Slurm needs some seconds for each element.
    pub pack: usize,
    /// Threads of each element.
    pub threads: usize,
    /// Seconds between checkpoints.
    pub save_every: f64,
    /// What computes the networks.
    pub device: DeviceKind,
    /// Seconds before the time limit at which the work is warned and writes its checkpoint.
    pub grace: u32,
    /// Further arguments of `sbatch`: partition, time limit, memory, account.
    pub arguments: Vec<String>,
    /// Tell what would be submitted, and submit nothing.
    pub dry_run: bool,
}

/// One array job.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Array {
    /// The call.
    pub command: Vec<String>,
    /// Indices of the pieces of work of each element.
    pub elements: Vec<Vec<usize>>,
    /// The job's number, once it is submitted.
    pub job: Option<String>,
}

/// The numbers that may be used for array elements, from Slurm's own configuration.
fn max_array_size() -> Result<usize> {
    let text = call("scontrol", &["show".into(), "config".into()])?;
    let line = text.lines().find(|l| l.trim_start().starts_with("MaxArraySize"));
    let size = line.and_then(|l| l.split('=').nth(1)).and_then(|v| v.trim().parse().ok());
    size.filter(|&s: &usize| s > 0).ok_or_else(|| {
        Error::Failed(
            "`scontrol show config` tells no MaxArraySize; is this a machine that Slurm's jobs are submitted from?"
                .into(),
        )
    })
}

fn call(program: &str, arguments: &[String]) -> Result<String> {
    let output = Command::new(program).args(arguments).output();
    let output = output.map_err(|e| {
        Error::Failed(format!("{program}: {e}; Slurm's programs must be in PATH, or use --launcher local"))
    })?;
    if !output.status.success() {
        let message = String::from_utf8_lossy(&output.stderr);
        return Err(Error::Failed(format!("{program} {}: {}: {}", arguments.join(" "), output.status, message.trim())));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// The batch script. It starts the work as a child and waits for it: Slurm sends the warning before the time limit to the script
/// alone, and reports nothing of a script that is killed.
fn script(sweep: &Path, list: &Path, program: &Path, options: &Submission) -> String {
    let quoted = |path: &Path| format!("'{}'", path.display().to_string().replace('\'', r"'\''"));
    format!(
        r#"#!/bin/sh
# Written by `tce sweep launch`. Element N of the array does the work in line N of the list.
work=$(sed -n "$((SLURM_ARRAY_TASK_ID + 1))p" {list})
{program} --threads {threads} --save-every {save_every} --device {device} sweep run-one {sweep} $work &
run=$!
warned=0
trap 'warned=1; kill -USR1 $run 2>/dev/null' USR1
trap 'kill -TERM $run 2>/dev/null' TERM
# A signal ends `wait`, not the work.
wait $run
code=$?
while kill -0 $run 2>/dev/null; do
  wait $run
  code=$?
done
# Stopped at a checkpoint because the time limit is near: the rest in another turn.
if [ "$warned" = 1 ] && [ "$code" = 130 ]; then
  scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}}"
fi
exit $code
"#,
        list = quoted(list),
        program = quoted(program),
        sweep = quoted(sweep),
        threads = options.threads,
        save_every = options.save_every,
        device = options.device,
    )
}

impl Sweep {
    /// The name of this sweep's jobs.
    pub fn job_name(&self) -> String {
        let place = self.directory.canonicalize().unwrap_or_else(|_| self.directory.clone());
        let safe: String =
            self.manifest.header.name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
        format!("tce-{safe}-{}", &sha256_hex(place.display().to_string().as_bytes())[..8])
    }

    /// Submits what is missing; returns the arrays, one after the other.
    ///
    /// # Errors
    /// If Slurm refuses; what was submitted before stays, and another launch submits the rest.
    pub fn launch_slurm(&self, options: &Submission) -> Result<Vec<Array>> {
        let limit = max_array_size()?;
        let queued = match self.queued() {
            Ok(queued) => queued,
            Err(e) => {
                tce_base::note!(
                    "{e}; what is in the queue is not known, and may be submitted a second time, which is harmless"
                );
                BTreeSet::new()
            }
        };
        let directory =
            self.directory.canonicalize().map_err(|e| tce_base::FileError::new(&self.directory, "find", e))?;
        let program = std::env::current_exe().map_err(|e| Error::Failed(format!("cannot find this program: {e}")))?;
        let folder = directory.join("slurm");
        let missing = self.missing()?;
        let mut arrays: Vec<Array> = Vec::new();
        let mut before: Vec<String> = Vec::new();
        let rounds: [&[Kind]; 4] =
            [&[Kind::Source, Kind::Target], &[Kind::Distances, Kind::Augment], &[Kind::Run], &[Kind::Verdict]];
        for kinds in rounds {
            let due = missing.iter().filter(|e| kinds.contains(&e.kind) && !queued.contains(&e.index));
            let due: Vec<usize> = due.map(|e| e.index).collect();
            let elements: Vec<Vec<usize>> = due.chunks(options.pack.max(1)).map(<[_]>::to_vec).collect();
            let mut jobs = Vec::new();
            for elements in elements.chunks(limit) {
                let stem = folder.join(unique());
                let (list, file) = (stem.with_extension("list"), stem.with_extension("sh"));
                let mut command: Vec<String> = vec![
                    "sbatch".into(),
                    "--parsable".into(),
                    format!("--array=0-{}", elements.len() - 1),
                    format!("--job-name={}", self.job_name()),
                    "--requeue".into(),
                    "--open-mode=append".into(),
                    format!("--signal=B:USR1@{}", options.grace),
                    format!("--cpus-per-task={}", options.threads),
                    format!("--output={}", directory.join("logs/slurm-%A_%a.log").display()),
                ];
                if !before.is_empty() {
                    // Whatever became of it: a run whose rows are missing makes them itself.
                    command.push(format!("--dependency=afterany:{}", before.join(":")));
                }
                command.extend(options.arguments.iter().cloned());
                command.push(file.display().to_string());
                let job = match options.dry_run {
                    true => None,
                    false => {
                        elements.iter().flatten().for_each(|&index| self.forget_failure(&self.entries()[index]));
                        create_folder(&directory.join("logs"))?;
                        let lines = elements.iter().fold(String::new(), |mut text, indices| {
                            let words: Vec<_> = indices.iter().map(ToString::to_string).collect();
                            let _ = writeln!(text, "{}", words.join(" "));
                            text
                        });
                        write_atomically(&list, lines.as_bytes())?;
                        write_atomically(&file, script(&directory, &list, &program, options).as_bytes())?;
                        let answer = call("sbatch", &command[1..])?;
                        let job = job_of(&answer)?;
                        write_atomically(&stem.with_extension("job"), job.as_bytes())?;
                        Some(job)
                    }
                };
                jobs.extend(job.clone());
                arrays.push(Array { command, elements: elements.to_vec(), job });
            }
            if options.dry_run && !elements.is_empty() {
                jobs.push("JOB".into());
            }
            if !jobs.is_empty() {
                before = jobs;
            }
        }
        Ok(arrays)
    }

    /// Indices of the work that the queue knows and will do.
    fn queued(&self) -> Result<BTreeSet<usize>> {
        let name = self.job_name();
        let states = "PENDING,RUNNING,CONFIGURING,COMPLETING,SUSPENDED,REQUEUED,REQUEUE_HOLD,RESIZING,STOPPED";
        let arguments = ["-h", "-r", "-t", states, "-n", &name, "-o", "%F|%K|%r"].map(String::from);
        let text = call("squeue", &arguments)?;
        let folder = self.directory.join("slurm");
        let mut lists: BTreeMap<String, Vec<Vec<usize>>> = BTreeMap::new();
        for path in fs::read_dir(&folder).into_iter().flatten().flatten().map(|e| e.path()) {
            if path.extension().is_some_and(|e| e == "job") {
                lists.insert(fs::read_to_string(&path).unwrap_or_default(), list(&path.with_extension("list")));
            }
        }
        let mut out = BTreeSet::new();
        for line in text.lines() {
            let mut fields = line.trim().split('|');
            let (Some(job), Some(element), Some(reason)) = (fields.next(), fields.next(), fields.next()) else {
                continue;
            };
            // A controller that lost its memory gives numbers out twice; the node refuses the second job of a number, and Slurm
            // holds it for ever. Whoever held a job by hand has a reason of his own, which is another word.
            if reason.contains("requeued held") || reason.contains("requeued in held") {
                tce_base::note!(
                    "job {job}_{element} is held ({reason}): it is cancelled, and its work submitted again"
                );
                let _ = call("scancel", &[format!("{job}_{element}")]);
                continue;
            }
            let elements = lists.get(job).zip(element.parse::<usize>().ok());
            out.extend(elements.and_then(|(l, k)| l.get(k)).into_iter().flatten().copied());
        }
        Ok(out)
    }
}

fn list(path: &Path) -> Vec<Vec<usize>> {
    let text = fs::read_to_string(path).unwrap_or_default();
    text.lines().map(|line| line.split(' ').filter_map(|word| word.parse().ok()).collect()).collect()
}

/// The job's number in what `sbatch --parsable` printed: a line `NUMBER` or `NUMBER;CLUSTER`, after whatever banner the site prints.
fn job_of(answer: &str) -> Result<String> {
    let number = |line: &str| {
        let id = line.trim().split(';').next().unwrap_or_default();
        (!id.is_empty() && id.bytes().all(|b| b.is_ascii_digit())).then(|| id.to_owned())
    };
    answer.lines().rev().find_map(number).ok_or_else(|| {
        Error::Failed(format!(
            "sbatch: found {answer:?}, expected a job's number in a line of its own; the job may be in the queue (squeue), which is \
             harmless: launch again"
        ))
    })
}

/// A name that no other submission has: the process's, and a number of its own.
fn unique() -> String {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    // Without the dots, behind which an extension would begin.
    format!("{}-{}", Owner::this(), COUNT.fetch_add(1, Ordering::Relaxed)).replace('.', "-")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_banner_is_no_job() {
        for answer in
            ["17", "17;alpha\n", "Welcome to cluster 9!\nquota: 5 of 10\n17\n", "note\n17;alpha\n\n", "17\nsee you;\n"]
        {
            assert_eq!(job_of(answer).unwrap(), "17", "{answer}");
        }
        for answer in ["", "Welcome;17", "Submitted batch job"] {
            assert!(job_of(answer).unwrap_err().to_string().contains("expected a job's number"), "{answer}");
        }
    }

    #[test]
    fn the_script_hands_on_how_the_work_is_to_be_done() {
        let options = Submission {
            pack: 1,
            threads: 3,
            save_every: 20.0,
            device: DeviceKind::Vulkan,
            grace: 60,
            arguments: vec![],
            dry_run: false,
        };
        let text = script(Path::new("/it's here"), Path::new("/list"), Path::new("/bin/tce"), &options);
        let call = r"'/bin/tce' --threads 3 --save-every 20 --device vulkan sweep run-one '/it'\''s here' $work &";
        assert!(text.lines().any(|line| line == call), "{text}");
    }
}
