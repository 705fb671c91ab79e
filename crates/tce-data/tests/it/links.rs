//! Tests of names that are links or groups, in old-style and new-style files written by h5py.

use std::fs;
use std::path::Path;
use std::sync::atomic::Ordering::Relaxed;

use crate::common::{LARGEST, assert_refused, load, python};
use tce_data::{LoadOptions, Problem};

/// `write(name, libver, skip)` opens a file of 40 rows in episodes of 10 without the fields in `skip`.
const PREPARE: &str = r#"
import sys, os, h5py, numpy as np
n = 40
i = np.arange(n, dtype=np.float32)
ends = np.arange(n) % 10 == 9
def write(name, libver, skip=(), **options):
    f = h5py.File(os.path.join(sys.argv[1], f"{name}-{libver}.hdf5"), "w", libver=libver, **options)
    for k, v in dict(observations=np.stack([i, -i], 1), actions=np.full((n, 1), .5, np.float32), rewards=i,
                     terminals=np.zeros(n, bool), timeouts=ends).items():
        if k not in skip:
            f[k] = v
    return f
"#;

fn files(dir: &Path, script: &str) -> bool {
    python(&format!("{PREPARE}\nfor libver in ['earliest', 'latest']:{}", script.replace('\n', "\n    ")), dir)
        .is_some()
}

fn both(dir: &Path, name: &str, check: impl Fn(&Path)) {
    for libver in ["earliest", "latest"] {
        check(&dir.join(format!("{name}-{libver}.hdf5")));
    }
}

#[test]
fn soft_links_are_followed() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
f = write("absolute", libver, ["timeouts"]); f["g/t"] = ends; f["timeouts"] = h5py.SoftLink("/g/t")
f = write("relative", libver, ["timeouts"]); f["g/t"] = ends; f["timeouts"] = h5py.SoftLink("g//./t")
f = write("chain", libver, ["timeouts"])
f["g/t"] = ends; f["a"] = h5py.SoftLink("g"); f["g/u"] = h5py.SoftLink("t"); f["g/v"] = h5py.SoftLink("/a/u")
f["timeouts"] = h5py.SoftLink("/a/v")
f = write("hard", libver, ["timeouts"]); f["g/t"] = ends; f["timeouts"] = f["g/t"]
f = write("block", libver, ["timeouts"], userblock_size=1024); f["g/t"] = ends; f["timeouts"] = h5py.SoftLink("/g/t")
for count in [4, 60, 3000]:
    f = write(f"many{count}", libver, ["timeouts"]); f["g/t"] = ends
    for k in range(count):
        f[f"column {k:05}" + "x" * (k % 90)] = h5py.SoftLink("/nowhere")
    f["timeouts"] = h5py.SoftLink("/g/t")
"#;
    if !files(dir.path(), script) {
        return;
    }
    for name in ["absolute", "relative", "chain", "hard", "block", "many4", "many60", "many3000"] {
        both(dir.path(), name, |path| {
            let got = load(path).unwrap();
            let ends = got.report.dropped.time_out;
            assert_eq!((got.report.rows_in_file, ends, got.report.rows_kept), (40, 3, 36), "{}", path.display());
            assert!(got.report.warnings.is_empty(), "{:?}", got.report.warnings);
        });
    }
}

#[test]
fn a_linked_successor_is_a_successor() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
f = write("next", libver); f["g/s"] = np.where(ends, 1000, np.stack([i + 1, -i - 1])).T; f["next_observations"] = h5py.SoftLink("/g/s")
"#;
    if !files(dir.path(), script) {
        return;
    }
    both(dir.path(), "next", |path| {
        let got = load(path).unwrap();
        assert_eq!(got.report.successors, tce_data::Successors::Stored);
        assert_eq!((got.transitions.len(), got.transitions.next_observation(39)), (40, &[1000.0, 1000.0][..]));
    });
}

#[test]
fn links_that_lead_nowhere_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
f = write("dangling", libver, ["timeouts"]); f["timeouts"] = h5py.SoftLink("/g/t")
f = write("through", libver, ["timeouts"]); f["timeouts"] = h5py.SoftLink("/rewards/t")
f = write("circle", libver, ["timeouts"]); f["a"] = h5py.SoftLink("timeouts"); f["timeouts"] = h5py.SoftLink("/a")
f = write("external", libver, ["timeouts"]); f["timeouts"] = h5py.ExternalLink("other.h5", "/g/t")
f = write("behind", libver, ["timeouts"]); f["a"] = h5py.ExternalLink("other.h5", "/g"); f["timeouts"] = h5py.SoftLink("/a/t")
f = write("group", libver, ["timeouts"]); f["timeouts/x"] = 1; f["timeouts/y"] = 2
f = write("togroup", libver, ["timeouts"]); f["g/x"] = 1; f["timeouts"] = h5py.SoftLink("g")
f = write("root", libver, ["timeouts"]); f["timeouts"] = h5py.SoftLink("/")
"#;
    if !files(dir.path(), script) {
        return;
    }
    for (name, problem, parts) in [
        (
            "dangling",
            Problem::MissingField,
            &["a soft link to `/g/t`, which is not in the file", "del file[\"timeouts\"]"][..],
        ),
        ("through", Problem::MissingField, &["a soft link to `/rewards/t`, which is not in the file"]),
        ("circle", Problem::MissingField, &["a soft link to `/a` that leads in a circle"]),
        (
            "external",
            Problem::Unsupported,
            &["an external link to `/g/t` in the file `other.h5`", "Copy the data", "h5py"],
        ),
        ("behind", Problem::Unsupported, &["an external link to `/g` in the file `other.h5`"]),
        ("group", Problem::WrongType, &["a group of x, y", "rename the group"]),
        ("togroup", Problem::WrongType, &["a group of x"]),
        ("root", Problem::WrongType, &["a group of actions, observations"]),
    ] {
        both(dir.path(), name, |path| assert_refused(load(path).unwrap_err(), problem, path, "timeouts", parts));
    }
}

/// Fields that are not read may have any content, and are listed with the names in the file.
#[test]
fn other_names_do_not_matter() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
f = write("other", libver)
f["a"] = h5py.SoftLink("/nowhere"); f["b"] = h5py.ExternalLink("other.h5", "/x"); f["infos/qpos"] = i
f["c"] = h5py.SoftLink("c"); f["type"] = np.dtype("f4"); f["infos/deep/soft"] = h5py.SoftLink("/infos")
"#;
    if !files(dir.path(), script) {
        return;
    }
    both(dir.path(), "other", |path| {
        assert_eq!(load(path).unwrap().transitions.len(), 36);
        let options = LoadOptions { columns: vec!["label".into()], ..LoadOptions::default() };
        let error = tce_data::load(path, &options).unwrap_err();
        let parts = ["the file has a, actions, b, c, infos/, observations, rewards, terminals, timeouts, type"];
        assert_refused(error, Problem::MissingField, path, "label", &parts);
        for (column, problem) in
            [("infos", Problem::WrongType), ("type", Problem::WrongType), ("b", Problem::Unsupported)]
        {
            let options = LoadOptions { columns: vec![column.into()], ..LoadOptions::default() };
            assert_eq!(tce_data::load(path, &options).unwrap_err().problem(), Some(problem), "{column}");
        }
    });
}

/// Hundreds of damaged bytes in files with links: the result is an error or rows, never a panic or a huge allocation.
#[test]
fn damaged_links_never_panic() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
f = write("few", libver, ["timeouts"]); f.create_dataset("g/t", data=ends, compression="gzip"); f["a"] = h5py.SoftLink("/g"); f["timeouts"] = h5py.SoftLink("/a/t")
f["b"] = h5py.ExternalLink("other.h5", "/g")
f = write("many", libver, ["timeouts"]); f["g/t"] = ends
for k in range(200):
    f[f"column {k}"] = h5py.SoftLink("/g")
f["timeouts"] = h5py.SoftLink("/column 3/t")
"#;
    if !files(dir.path(), script) {
        return;
    }
    let (mut read, mut refused) = (0, 0);
    for name in ["few", "many"] {
        both(dir.path(), name, |path| assert_eq!(load(path).unwrap().report.dropped.time_out, 3));
        for libver in ["earliest", "latest"] {
            let whole = fs::read(dir.path().join(format!("{name}-{libver}.hdf5"))).unwrap();
            let path = dir.path().join("damaged.hdf5");
            let step = whole.len() / 700 + 1;
            for at in (0..whole.len()).step_by(step) {
                let mut bytes = whole.clone();
                bytes[at] = if (at / step).is_multiple_of(2) { whole[at] ^ 1 << (at % 8) } else { 0xff };
                fs::write(&path, &bytes).unwrap();
                match load(&path) {
                    Ok(_) => read += 1,
                    Err(_) => refused += 1,
                }
            }
        }
    }
    assert!(read > 500 && refused > 100, "{read} read, {refused} refused");
    assert!(LARGEST.load(Relaxed) < 64 << 20, "a small file made the reader allocate {LARGEST:?} bytes");
}
