//! Sweeps on a real Slurm: two nodes on this machine, which lose power, their daemon, their controller, their time and their space.
//!
//! Needs Slurm 22.05 or later and munge (`apt-get install slurm-wlm munge`), and root for name spaces of processes; skipped
//! where they are not. One test, because the nodes are what its parts share.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use crate::common::sweeps::{describe, outcomes};
use crate::common::{Tmpfs, program, tce};
use serde_json::Value;

/// Two nodes, each in a name space of processes of its own, so that its end is the end of all that runs on it.
struct Cluster {
    base: PathBuf,
    nodes: BTreeMap<&'static str, Child>,
}

fn quiet(command: &mut Command) -> Output {
    command.stdin(Stdio::null()).output().unwrap_or_else(|e| panic!("{command:?}: {e}"))
}

fn wait_for(what: &str, seconds: u64, mut ready: impl FnMut() -> bool) {
    let until = Instant::now() + Duration::from_secs(seconds);
    while !ready() {
        assert!(Instant::now() < until, "{what}: not within {seconds} s");
        std::thread::sleep(Duration::from_millis(100));
    }
}

impl Cluster {
    /// None, and a line that says so, where there is no Slurm.
    fn start(base: &Path) -> Option<Self> {
        let there = |program: &str| Command::new(program).arg("-V").output().is_ok();
        let missing: Vec<_> =
            ["slurmctld", "slurmd", "sbatch", "munged", "unshare"].into_iter().filter(|p| !there(p)).collect();
        let root = quiet(Command::new("id").arg("-u")).stdout == b"0\n";
        if !missing.is_empty() || !root {
            eprintln!("SKIPPED: needs Slurm and root; root: {root}, missing: {missing:?}");
            return None;
        }
        for folder in ["run", "state", "log", "spool/n1", "spool/n2"] {
            fs::create_dir_all(base.join(folder)).unwrap();
        }
        // munge refuses folders that others may write to.
        assert!(Command::new("chmod").args(["755"]).args([base, &base.join("run")]).status().unwrap().success());
        let host = String::from_utf8(quiet(&mut Command::new("hostname")).stdout).unwrap();
        let config = CONFIG.replace("BASE", base.to_str().unwrap()).replace("HOST", host.trim());
        fs::write(base.join("slurm.conf"), config).unwrap();
        let key = base.join("munge.key");
        // Nothing secret: it lives as long as the test.
        fs::write(&key, [7; 1024]).unwrap();
        assert!(Command::new("chmod").arg("600").arg(&key).status().unwrap().success());
        let mut cluster = Self { base: base.to_owned(), nodes: BTreeMap::new() };
        let munged = quiet(
            Command::new("munged")
                .arg("--force")
                .arg(format!("--key-file={}", key.display()))
                .arg(format!("--socket={}", base.join("run/munge.sock").display()))
                .arg(format!("--pid-file={}", base.join("run/munged.pid").display()))
                .arg(format!("--log-file={}", base.join("log/munged.log").display()))
                .arg(format!("--seed-file={}", base.join("run/munged.seed").display())),
        );
        assert!(munged.status.success(), "{}", String::from_utf8_lossy(&munged.stderr));
        cluster.start_controller();
        for node in ["n1", "n2"] {
            cluster.start_node(node);
        }
        cluster.wait_for_nodes();
        Some(cluster)
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("SLURM_CONF", self.base.join("slurm.conf"));
        command
    }

    fn call(&self, program: &str, args: &[&str]) -> String {
        String::from_utf8_lossy(&quiet(self.command(program).args(args)).stdout).into_owned()
    }

    fn start_controller(&self) {
        assert!(quiet(&mut self.command("slurmctld")).status.success());
        wait_for("the controller", 20, || self.call("scontrol", &["ping"]).contains(" UP"));
    }

    fn start_node(&mut self, node: &'static str) {
        let child = self
            .command("unshare")
            .args(["--pid", "--fork", "--kill-child=KILL", "--mount-proc", "sh", "-c"])
            .args(["slurmd -D -N $0; while :; do sleep 1; done", node])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        self.nodes.insert(node, child);
    }

    fn wait_for_nodes(&self) {
        wait_for("both nodes", 60, || {
            let states = self.call("sinfo", &["-hN", "-o", "%T"]);
            states.lines().count() == 2 && states.lines().all(|s| ["idle", "mixed", "allocated"].contains(&s))
        });
    }

    /// The power of a node fails: its daemon and everything that it runs are gone at once.
    fn power_off(&mut self, node: &str) {
        let mut child = self.nodes.remove(node).unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// The daemon of a node dies; what it runs lives on.
    fn kill_daemon(&self, node: &str) {
        let pattern = format!("slurmd -D -N {node}");
        // The shell around it has the same words in its own line.
        let found = self.call("pgrep", &["-x", "slurmd"]);
        for pid in found.split_whitespace() {
            let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).unwrap_or_default().replace('\0', " ");
            if line.trim() == pattern {
                assert!(Command::new("kill").args(["-9", pid]).status().unwrap().success());
                return;
            }
        }
        panic!("no daemon of {node} among {found:?}");
    }

    fn kill_controller(&self) {
        let pid = fs::read_to_string(self.base.join("run/slurmctld.pid")).unwrap();
        assert!(Command::new("kill").args(["-9", pid.trim()]).status().unwrap().success());
        std::thread::sleep(Duration::from_millis(300));
    }

    fn tce(&self, directory: &Path, args: &[&str]) -> Output {
        quiet(program(directory, args).args(["--save-every", "0"]).env("SLURM_CONF", self.base.join("slurm.conf")))
    }

    fn launch(&self, directory: &Path, sweep: &str, more: &[&str]) {
        let output = self.tce(directory, &[&["sweep", "launch", sweep, "--launcher", "slurm"], more].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }

    /// Launches again whenever the queue is empty and something is missing, as a user would, until all is done.
    fn finish(&self, directory: &Path, sweep: &str, seconds: u64) {
        let done = || {
            let status = tce(directory, &["sweep", "status", sweep, "--json"]);
            let status: Value = serde_json::from_slice(&status.stdout).expect("a status");
            status["kinds"]["run"][0] == status["kinds"]["run"][1]
        };
        let mut looks = 0;
        wait_for(sweep, seconds, || {
            if done() {
                return true;
            }
            let waiting = self.call("squeue", &["-h", "-r", "-o", "%A %T"]);
            // To launch is harmless at any time, and helps where the queue has forgotten or holds something.
            looks += 1;
            if waiting.trim().is_empty() || looks % 10 == 0 {
                self.launch(directory, sweep, &[]);
                // What an administrator does for a node that was given a number twice.
                for node in ["NodeName=n1", "NodeName=n2"] {
                    self.call("scontrol", &["update", node, "State=RESUME"]);
                }
            }
            // Slurm lets what it requeues wait for two minutes; a test does not.
            for line in waiting.lines().filter(|l| l.ends_with("PENDING")) {
                let job = format!("JobId={}", line.split(' ').next().unwrap());
                self.call("scontrol", &["update", &job, "StartTime=now"]);
            }
            std::thread::sleep(Duration::from_millis(400));
            false
        });
        self.call("scancel", &["-u", "root"]);
        wait_for("an empty queue", 60, || self.call("squeue", &["-h"]).trim().is_empty());
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        for child in self.nodes.values_mut() {
            let _ = child.kill();
            let _ = child.wait();
        }
        for daemon in ["slurmctld", "munged"] {
            if let Ok(pid) = fs::read_to_string(self.base.join(format!("run/{daemon}.pid"))) {
                let _ = Command::new("kill").args(["-9", pid.trim()]).status();
            }
        }
    }
}

const CONFIG: &str = "
ClusterName=tce
SlurmctldHost=HOST(127.0.0.1)
SlurmctldPort=26817
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket=BASE/run/munge.sock
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
StateSaveLocation=BASE/state
SlurmdSpoolDir=BASE/spool/%n
SlurmctldPidFile=BASE/run/slurmctld.pid
SlurmdPidFile=BASE/run/slurmd-%n.pid
SlurmctldLogFile=BASE/log/slurmctld.log
SlurmdLogFile=BASE/log/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=batch_sched_delay=0,sched_min_interval=0,bf_interval=1
MaxArraySize=1001
JobRequeue=1
ReturnToService=2
SlurmdTimeout=5
MessageTimeout=4
TCPTimeout=1
KillWait=5
SlurmdParameters=config_overrides
NodeName=n[1-2] NodeHostname=HOST NodeAddr=127.0.0.1 Port=[27001-27002] CPUs=2 RealMemory=2000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
";

#[test]
fn whatever_happens_to_the_cluster_every_result_is_right() {
    let dir = tempfile::tempdir().unwrap();
    let place = dir.path();
    // Before the nodes: they have mounts of their own, which are those of their beginning.
    let disk = Tmpfs::mount(&place.join("full"), 1024, "the full folder");
    let Some(mut cluster) = Cluster::start(&place.join("slurm")) else { return };
    let file = describe(place, "s", 2);
    let plan = |out: &str| assert!(tce(place, &["sweep", "plan", &file, "--out", out]).status.success());
    plan("local");
    assert!(tce(place, &["sweep", "launch", "local", "--workers", "2"]).status.success());
    let expected = outcomes(&place.join("local"));
    let started = Instant::now();
    let check = |sweep: &str| {
        assert_eq!(outcomes(&place.join(sweep)), expected, "{sweep}");
        let gathered = tce(place, &["sweep", "gather", sweep]);
        assert!(gathered.status.success(), "{sweep}: {}", String::from_utf8_lossy(&gathered.stderr));
        eprintln!(
            "{sweep}: {} results, none lost, none wrong, after {} s",
            expected.len(),
            started.elapsed().as_secs()
        );
    };
    let running =
        |cluster: &Cluster| cluster.call("squeue", &["-h", "-r", "-t", "RUNNING", "-o", "%i"]).lines().count();

    let only = std::env::var("TCE_SLURM_ONLY").ok();
    let wanted = |scenario: &str| only.as_ref().is_none_or(|o| o == scenario);

    // Nothing happens, but the same sweep is launched twice.
    if wanted("launched-twice") {
        plan("launched-twice");
        cluster.launch(place, "launched-twice", &[]);
        cluster.launch(place, "launched-twice", &[]);
        cluster.finish(place, "launched-twice", 120);
        check("launched-twice");
    }

    // A node loses its power in the middle of an array.
    if wanted("power-off") {
        plan("power-off");
        cluster.launch(place, "power-off", &[]);
        wait_for("work", 60, || running(&cluster) > 1);
        std::thread::sleep(Duration::from_millis(700));
        cluster.power_off("n1");
        cluster.finish(place, "power-off", 180);
        check("power-off");
        cluster.start_node("n1");
        cluster.wait_for_nodes();
    }

    // The daemon alone dies: its work lives on, and Slurm starts it a second time.
    if wanted("daemon") {
        plan("daemon");
        cluster.launch(place, "daemon", &[]);
        wait_for("work", 60, || running(&cluster) > 1);
        cluster.kill_daemon("n2");
        cluster.finish(place, "daemon", 180);
        check("daemon");
        cluster.power_off("n2");
        cluster.start_node("n2");
        cluster.wait_for_nodes();
    }

    // The controller is killed after it has taken the jobs.
    if wanted("controller") {
        plan("controller");
        cluster.launch(place, "controller", &[]);
        std::thread::sleep(Duration::from_millis(1200));
        cluster.kill_controller();
        cluster.start_controller();
        cluster.finish(place, "controller", 180);
        check("controller");
    }

    // The time limit is near: Slurm warns the script, and the work goes on in another turn.
    if wanted("time-limit") {
        let text = fs::read_to_string(place.join(&file)).unwrap();
        let longer = text.replace("learner.steps=120", "learner.steps=1500").replace("seeds = 2", "seeds = 1");
        fs::write(place.join("longer.toml"), longer).unwrap();
        for out in ["longer", "time-limit"] {
            assert!(tce(place, &["sweep", "plan", "longer.toml", "--out", out]).status.success());
        }
        assert!(tce(place, &["sweep", "launch", "longer", "--workers", "2"]).status.success());
        cluster.launch(place, "time-limit", &["--grace", "30", "--sbatch=--time=10"]);
        let log = || {
            let logs = fs::read_dir(place.join("time-limit/logs")).unwrap().map(|e| e.unwrap().path());
            logs.map(|p| fs::read_to_string(p).unwrap_or_default()).collect::<String>()
        };
        // The warning as Slurm gives it, without waiting for the last half minute.
        wait_for("a warning in time", 100, || {
            let jobs = cluster.call("squeue", &["-h", "-r", "-t", "RUNNING", "-o", "%i"]);
            for job in jobs.lines().filter(|_| log().contains("learn ")) {
                cluster.call("scancel", &["--batch", "--signal=USR1", job]);
            }
            std::thread::sleep(Duration::from_millis(200));
            log().contains("interrupted")
        });
        cluster.finish(place, "time-limit", 120);
        assert_eq!(outcomes(&place.join("time-limit")), outcomes(&place.join("longer")));
        eprintln!("time-limit: warned, stopped at a checkpoint, and went on to the same bytes");
    }

    // The shared folder is full for a while.
    if let Some(disk) = disk.as_ref().filter(|_| wanted("full")) {
        disk.resize(150);
        plan("full");
        cluster.launch(place, "full", &[]);
        wait_for("an end of what does not fit", 120, || cluster.call("squeue", &["-h"]).trim().is_empty());
        assert!(outcomes(&place.join("full")).len() < expected.len(), "everything fitted into the small folder");
        disk.resize(1 << 20);
        cluster.finish(place, "full", 120);
        check("full");
    }
}
