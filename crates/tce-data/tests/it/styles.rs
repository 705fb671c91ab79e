//! Tests of the ways in which h5py stores the same numbers: read correctly if supported, otherwise a clear error.

use std::fs;

use crate::common::{assert_refused, load, python, rows};
use tce_data::Problem;

/// `write(name, **fields)` writes 1003 rows; a field is an array or a function that creates its data set.
const PREPARE: &str = r#"
import sys, os, h5py, numpy as np
from functools import partial
n = 1003
i = np.arange(n, dtype=np.float32)
state, after = np.stack([i, -i], 1), np.stack([i + 1, -i - 1], 1)
ends = np.arange(n) % 10 == 9
after[ends] = 2000
# HDF5 2.0's "latest" compresses in a format of its own.
VERSIONS = ["earliest", ("v110", "v110"), "latest"]
def open_file(name, libver="earliest", **options):
    return h5py.File(os.path.join(sys.argv[1], name + ".hdf5"), "w", libver=libver, **options)
FIELDS = dict(observations=state, actions=np.full((n, 1), .5, np.float32), next_observations=after, rewards=i,
              terminals=np.arange(n) % 100 == 50, timeouts=ends)
def fill(f, how=lambda f, k, v: f.create_dataset(k, data=v), change=lambda k, v: v, **fields):
    for k, v in {**FIELDS, **fields}.items():
        if v is not None:
            how(f, k, change(k, v))
    return f
def compact(f, k, v):
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE); plist.set_layout(h5py.h5d.COMPACT)
    kind = h5py.h5t.py_create(v.dtype, logical=True)
    d = h5py.h5d.create(f.id, k.encode(), kind, h5py.h5s.create_simple(v.shape), plist)
    d.write(h5py.h5s.ALL, h5py.h5s.ALL, v)
def grown(f, k, v):
    d = f.create_dataset(k, (0,) + v.shape[1:], v.dtype, chunks=(64,) + v.shape[1:], maxshape=(None,) + v.shape[1:])
    for start in range(0, n, 100):
        d.resize(min(start + 100, n), 0)
        d[start:start + 100] = v[start:start + 100]
def chunked(f, k, v, **options):
    f.create_dataset(k, data=v, chunks=(100,) + v.shape[1:], **options)
def flags(kind):
    return lambda k, v: v.astype(kind) if v.dtype == bool else v
def floats(kind):
    return lambda k, v: v.astype(kind) if v.dtype != bool else v
"#;

#[test]
fn every_style_reads_right() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
for libver in VERSIONS:
    new = lambda name, **options: open_file(f"{name} {libver}", libver, **options)
    fill(new("contiguous"))
    fill(new("compact"), compact)
    fill(new("grown"), grown)
    fill(new("chunked"), chunked)
    fill(new("gzip"), partial(chunked, compression="gzip", shuffle=True, fletcher32=True))
    fill(new("lzf"), partial(chunked, compression="lzf", shuffle=True))
    fill(new("big endian"), change=floats(">f4"))
    fill(new("double"), change=floats("f8"))
    fill(new("big double"), change=floats(">f8"))
    fill(new("half"), change=floats("f2"))
    fill(new("big half"), partial(chunked, compression="gzip"), change=floats(">f2"))
    fill(new("integers"), change=lambda k, v: v.astype("i4") if k in ("observations", "rewards") else v)
    fill(new("big integers"), change=lambda k, v: v.astype(">i8") if k in ("observations", "rewards") else v)
    fill(new("scaled"), rewards=None).create_dataset("rewards", data=np.arange(n), scaleoffset=0, chunks=(50,))
    for kind in ["u1", "i8", "f4", ">f8"]:
        fill(new(f"flags {kind}"), change=flags(kind))
    fill(new("columns"), change=lambda k, v: v[:, None] if v.ndim == 1 else v)
    fill(new("block", userblock_size=2048), partial(chunked, compression="gzip"))
    fill(new("tracked", track_order=True))
    # Whole chunks were written, the file's last ones by nobody: their fill value is what they are.
    f = fill(new("holes"), rewards=None, terminals=None, timeouts=None)
    f.create_dataset("rewards", (n,), "f4", chunks=(100,), fillvalue=7)[:900] = i[:900]; f["rewards"][900:] = i[900:]
    f.create_dataset("terminals", (n,), bool, chunks=(10,))[50::100] = True
    f.create_dataset("timeouts", (n,), bool, chunks=(1,))[9::10] = True
"#;
    if python(&format!("{PREPARE}{script}"), dir.path()).is_none() {
        return;
    }
    let want = rows(1003);
    let mut read = 0;
    for entry in fs::read_dir(dir.path()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap();
        let got = load(&path).unwrap_or_else(|e| panic!("{name}: {e}")).transitions;
        assert_eq!(got.len(), 1003, "{name}");
        // Float16 has 11 bits: half of the numbers above 2048 cannot be represented, but 1003 can.
        assert_eq!(got.observations, want.observations, "{name}");
        assert_eq!((&got.actions, &got.rewards), (&want.actions, &want.rewards), "{name}");
        for i in 0..1003 {
            let next = if i % 10 == 9 { [2000.0, 2000.0] } else { [(i + 1) as f32, -((i + 1) as f32)] };
            assert_eq!(got.next_observation(i), next, "{name}");
            assert_eq!((got.terminals[i], got.timeouts[i]), (i % 100 == 50, i % 10 == 9), "{name}, row {i}");
        }
        read += 1;
    }
    assert!(read == 66, "{read} files");
}

/// Chunks of 65,536 rows and more, whose sides HDF5 stores in three bytes.
#[test]
fn large_chunks_read_right() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
n = 140_000
i = np.arange(n, dtype=np.float32)
ends = np.arange(n) % 1000 == 999
FIELDS = dict(observations=np.stack([i, -i], 1), actions=np.full((n, 1), .5, np.float32), next_observations=None,
              rewards=i, terminals=np.zeros(n, bool), timeouts=ends)
for libver in VERSIONS:
    for block in [0, 512]:
        new = lambda name: open_file(f"{name} {libver} {block}", libver, userblock_size=block)
        def rows(f, k, v, m, **options):
            more = dict(maxshape=(None,) + v.shape[1:]) if options.pop("grows", False) else {}
            f.create_dataset(k, data=v, chunks=(m,) + v.shape[1:], **more, **options)
        for m in [65_535, 65_536, 100_000, n]:
            fill(new(f"{m}"), partial(rows, m=m))
            fill(new(f"{m} gzip"), partial(rows, m=m, compression="gzip", compression_opts=1, shuffle=True))
            fill(new(f"{m} grows"), partial(rows, m=m, compression="gzip", compression_opts=1, grows=True))
"#;
    if python(&format!("{PREPARE}{script}"), dir.path()).is_none() {
        return;
    }
    let mut read = 0;
    for entry in fs::read_dir(dir.path()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap();
        let got = load(&path).unwrap_or_else(|e| panic!("{name}: {e}"));
        let kept: Vec<f32> = (0..140_000).filter(|i| i % 1000 != 999).map(|i| i as f32).collect();
        assert_eq!(got.transitions.rewards, kept, "{name}");
        let states: Vec<f32> = kept.iter().flat_map(|x| [*x, -x]).collect();
        assert_eq!(got.transitions.observations, states, "{name}");
        read += 1;
    }
    assert_eq!(read, 72);
}

/// Data that were created but never written: the fill value for vectors (as in h5py), an error for states and actions.
#[test]
fn unwritten_fields() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
for libver in ["earliest", "latest"]:
    new = lambda name: open_file(f"{name}-{libver}", libver)
    fill(new("flags"), terminals=None).create_dataset("terminals", (n,), bool)
    fill(new("column"), terminals=None).create_dataset("terminals", (n, 1), "u1")
    fill(new("chunked"), terminals=None).create_dataset("terminals", (n,), bool, chunks=(7,))
    fill(new("rewards"), rewards=None).create_dataset("rewards", (n,), "f4", fillvalue=2.5)
    fill(new("part"), rewards=None).create_dataset("rewards", (n,), "f8", fillvalue=-3, chunks=(500,))[:400] = 1
    for k in ["observations", "actions", "next_observations"]:
        fill(new(k), **{k: None}).create_dataset(k, FIELDS[k].shape, "f4")
        fill(new("part " + k), **{k: None}).create_dataset(k, FIELDS[k].shape, "f4", chunks=(500, 1))[:400] = 1
"#;
    if python(&format!("{PREPARE}{script}"), dir.path()).is_none() {
        return;
    }
    for libver in ["earliest", "latest"] {
        let path = |name: &str| dir.path().join(format!("{name}-{libver}.hdf5"));
        for name in ["flags", "column", "chunked"] {
            let got = load(&path(name)).unwrap();
            assert_eq!(got.transitions.terminals, [false; 1003], "{name}");
            let warning = &got.report.warnings[0];
            assert!(warning.contains("`terminals`: created, but never written; read as its fill value"), "{warning}");
        }
        assert_eq!(load(&path("rewards")).unwrap().transitions.rewards, [2.5; 1003]);
        let got = load(&path("part")).unwrap();
        assert_eq!(
            (got.transitions.rewards[399], got.transitions.rewards[499], got.transitions.rewards[500]),
            (1.0, -3.0, -3.0)
        );
        assert!(
            got.report.warnings[0].contains("`rewards`: 2 of its 3 chunks never written"),
            "{:?}",
            got.report.warnings
        );
        for (field, chunks) in
            [("observations", "4 of its 6"), ("actions", "2 of its 3"), ("next_observations", "4 of its 6")]
        {
            let parts = ["created, but never written", "every row written", "write it again"];
            assert_refused(load(&path(field)).unwrap_err(), Problem::Truncated, &path(field), field, &parts);
            let part = path(&format!("part {field}"));
            let parts = [&format!("{chunks} chunks never written")[..], "every row written"];
            assert_refused(load(&part).unwrap_err(), Problem::Truncated, &part, field, &parts);
        }
    }
}

/// Flags that were never written have as many rows as the states or actions beside them, whatever those are called.
#[test]
fn unwritten_flags_beside_fields_of_other_names() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
actions = FIELDS["actions"]
for name, rows in [("alias", n), ("longer", n + 1)]:
    f = open_file(name)
    for k, v in dict(obs=state, action=actions, reward=i, next_obs=after, truncated=ends).items():
        f[k] = v
    f.create_dataset("terminated", (rows,), bool)
f = open_file("minari")
for e in range(3):
    g = f.create_group(f"episode_{e}")
    g["observations"], g["actions"], g["rewards"], g["truncations"] = state[:11], actions[:10], i[:10], ends[:10]
    g.create_dataset("terminations", (10,), bool)
f = open_file("robomimic")
g = f.create_group("data/demo_0")
g["obs/q"], g["next_obs/q"], g["actions"] = state, after, actions
g.create_dataset("dones", (n,), "i8")
"#;
    if python(&format!("{PREPARE}{script}"), dir.path()).is_none() {
        return;
    }
    let path = |name: &str| dir.path().join(format!("{name}.hdf5"));
    for (name, field, rows) in [
        ("alias", "terminated", 1003),
        ("minari", "episode_2/terminations", 30),
        ("robomimic", "data/demo_0/dones", 1003),
    ] {
        let got = load(&path(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(got.transitions.terminals, vec![false; rows], "{name}");
        let told = format!("`{field}`: created, but never written; read as its fill value");
        assert!(got.report.to_string().contains(&told), "{}", got.report);
    }
    let parts = ["1004 rows", "never written", "1003 rows, as in `obs`"];
    assert_refused(load(&path("longer")).unwrap_err(), Problem::RowCount, &path("longer"), "terminated", &parts);
}

/// The number of another filter replaces that of LZF: to the reader, the file needs a plugin.
#[test]
fn filters_that_are_not_read_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
fill(open_file("lzf"), observations=None).create_dataset("observations", data=state, compression="lzf")
"#;
    if python(&format!("{PREPARE}{script}"), dir.path()).is_none() {
        return;
    }
    let bytes = fs::read(dir.path().join("lzf.hdf5")).unwrap();
    // The message holds: number, length of the name, flags, count of parameters, name.
    let at = bytes.windows(4).position(|w| w == b"lzf\0").unwrap() - 8;
    assert_eq!(bytes[at..at + 4], [0x00, 0x7d, 8, 0]);
    for (id, name, advice) in [
        (4u16, "szip", "`h5repack -f GZIP=4 in.hdf5 out.hdf5`"),
        (5, "n-bit", "`h5repack -f GZIP=4 in.hdf5 out.hdf5`"),
        (307, "bzip2", "import h5py, hdf5plugin"),
        (32001, "Blosc", "pip install hdf5plugin"),
        (32004, "LZ4", "import h5py, hdf5plugin"),
        (32008, "bitshuffle", "import h5py, hdf5plugin"),
        (32013, "ZFP", "import h5py, hdf5plugin"),
        (32015, "Zstandard", "import h5py, hdf5plugin"),
        (32026, "Blosc2", "import h5py, hdf5plugin"),
        (4711, "an unknown plugin", "import h5py, hdf5plugin"),
    ] {
        let mut bytes = bytes.clone();
        bytes[at..at + 2].copy_from_slice(&id.to_le_bytes());
        let path = dir.path().join("other.hdf5");
        fs::write(&path, bytes).unwrap();
        let found = format!("compression by {name} (HDF5 filter {id})");
        let parts = [&found[..], "gzip, lzf or no compression", advice];
        assert_refused(load(&path).unwrap_err(), Problem::Unsupported, &path, "observations", &parts);
    }
}

#[test]
fn numbers_in_another_file_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
f = fill(open_file("virtual"), observations=None); f["g/o"] = state
layout = h5py.VirtualLayout((n, 2), "f4"); layout[:] = h5py.VirtualSource(".", "g/o", (n, 2))
f.create_virtual_dataset("observations", layout)
f = fill(open_file("external"), observations=None)
f.create_dataset("observations", data=state, external=[(os.path.join(sys.argv[1], "raw.bin"), 0, h5py.h5f.UNLIMITED)])
f = fill(open_file("flags"), terminals=None)
f.create_dataset("terminals", data=ends, external=[(os.path.join(sys.argv[1], "raw.bin"), 0, h5py.h5f.UNLIMITED)])
f = fill(open_file("trees", ("v110", "v110")), observations=None)
f.create_dataset("observations", data=state, maxshape=(None, None), chunks=(100, 2))
"#;
    if python(&format!("{PREPARE}{script}"), dir.path()).is_none() {
        return;
    }
    for (name, field, found) in [
        ("virtual", "observations", "a virtual data set"),
        ("external", "observations", "raw data in another file"),
        ("flags", "terminals", "raw data in another file"),
        ("trees", "observations", "several unlimited dimensions"),
    ] {
        let path = dir.path().join(format!("{name}.hdf5"));
        assert_refused(load(&path).unwrap_err(), Problem::Unsupported, &path, field, &[found, "python -c", "h5py"]);
    }
}
