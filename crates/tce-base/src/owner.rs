//! The owner of a temporary file: leftovers of killed processes can be told from the work of running ones.

use std::fs;
use std::path::Path;
use std::sync::OnceLock;

/// The process that owns a temporary file or directory: machine, process and its start time, because process numbers are reused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Owner {
    machine: String,
    process: u32,
    started: u64,
}

impl std::fmt::Display for Owner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}.{}.{}", self.machine, self.process, self.started)
    }
}

impl Owner {
    /// This process.
    pub fn this() -> Self {
        // Asked for by every file that is written, and always the same.
        static THIS: OnceLock<Owner> = OnceLock::new();
        let find = || {
            let process = std::process::id();
            Self { machine: machine(), process, started: started(process).unwrap_or(0) }
        };
        THIS.get_or_init(find).clone()
    }

    /// The one in the name of a file or directory: `OWNER.x`, where x is what tells the owner's works apart.
    pub fn of(attempt: &Path) -> Option<Self> {
        let name = attempt.file_name()?.to_str()?;
        let mut parts = name.rsplitn(4, '.');
        let _count = parts.next()?;
        let started = parts.next()?.parse().ok()?;
        let process = parts.next()?.parse().ok()?;
        Some(Self { machine: parts.next()?.to_owned(), process, started })
    }

    /// Whether the process has certainly ended. Nothing is certain of a process on another machine.
    pub fn dead(&self) -> bool {
        let known = self.started != 0 && self.machine == Self::this().machine;
        known && started(self.process) != Some(self.started)
    }
}

/// The machine's name, the id of its present boot and the name space of processes: after a restart, and in every container, numbers of
/// processes begin anew.
fn machine() -> String {
    let read = |path: &str| fs::read_to_string(path).unwrap_or_default().trim().to_owned();
    let name = read("/proc/sys/kernel/hostname").replace(['.', '/'], "-");
    let boot = read("/proc/sys/kernel/random/boot_id");
    let space = fs::read_link("/proc/self/ns/pid").unwrap_or_default();
    let space: String = space.to_string_lossy().chars().filter(char::is_ascii_digit).collect();
    format!("{name}-{}-{space}", boot.get(..8).unwrap_or("unknown"))
}

/// When a process of this machine began, in ticks since the boot; none if there is no such process.
fn started(process: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The second field is the program's name in brackets, which may hold anything.
    let rest = &stat[stat.rfind(')')? + 1..];
    let mut fields = rest.split_whitespace();
    if fields.next() == Some("Z") {
        return None;
    }
    // The state was the third field; the start is the twenty-second.
    fields.nth(18)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_owner_is_read_from_a_name_and_only_who_is_certainly_gone_is_dead() {
        // A process cannot have started at 1: whoever had this number is gone.
        let dead = Owner { started: 1, ..Owner::this() };
        assert!(dead.dead() && !Owner::this().dead());
        assert!(!Owner { machine: "elsewhere".into(), ..dead.clone() }.dead());
        assert_eq!(Owner::of(Path::new(&format!("attempts/{dead}.0"))), Some(dead));
        for other in ["", "notes.txt", "a.b.c.d", ".tce-Xy12.part"] {
            assert_eq!(Owner::of(Path::new(other)), None, "{other}");
        }
    }
}
