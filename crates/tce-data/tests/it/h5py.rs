//! Uses Python's h5py to check our files and to write others.

use std::collections::BTreeMap;

use crate::common::python;
use tce_data::{LoadOptions, load, save_d4rl};

#[test]
fn h5py_reads_our_files() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("out.hdf5");
    let t = crate::common::synthetic(3000, 11, 3, 50);
    let label: Vec<f32> = (0..3000).map(|i| i as f32 / 3000.0).collect();
    let attributes: BTreeMap<_, _> = [("config".to_owned(), "λ = 0.1\n".repeat(20_000))].into();
    save_d4rl(&path, &t, &attributes, &[("label", &label)]).unwrap();
    let script = r#"
import sys, h5py, numpy as np
with h5py.File(sys.argv[1]) as f:
    for k in sorted(f):
        d = f[k]
        print(k, d.shape, d.dtype, d.compression, d.shuffle, repr(float(np.float64(d[()]).sum())))
    assert f.attrs["config"] == "λ = 0.1\n" * 20000
    assert f["terminals"][()].dtype == bool
"#;
    let Some(text) = python(script, &path) else { return };
    let sum = |v: &[f32]| v.iter().map(|&x| x as f64).sum::<f64>();
    let count = |v: &[bool]| v.iter().filter(|&&x| x).count() as f64;
    let want = [
        ("actions", "(3000, 3) float32", sum(&t.actions)),
        ("label", "(3000,) float32", sum(&label)),
        ("next_observations", "(3000, 11) float32", sum(&t.next_observations)),
        ("observations", "(3000, 11) float32", sum(&t.observations)),
        ("rewards", "(3000,) float32", sum(&t.rewards)),
        ("terminals", "(3000,) bool", count(&t.terminals)),
        ("timeouts", "(3000,) bool", count(&t.timeouts)),
    ];
    assert_eq!(text.lines().count(), want.len(), "{text}");
    for (line, (name, kind, total)) in text.lines().zip(want) {
        assert!(line.starts_with(&format!("{name} {kind} gzip True ")), "{line}");
        let got: f64 = line.rsplit(' ').next().unwrap().parse().unwrap();
        assert!((got - total).abs() < 1e-9 * 3000.0, "{line}: expected {total}");
    }
}

#[test]
fn we_read_what_h5py_writes() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("in.hdf5");
    let script = r#"
import sys, h5py, numpy as np
n = 4000
with h5py.File(sys.argv[1], "w") as f:
    x = np.arange(n * 3, dtype=np.float64).reshape(n, 3)
    f.create_dataset("observations", data=x, compression="lzf", shuffle=True)
    f.create_dataset("actions", data=np.full((n, 2), 0.25, np.float32), compression="gzip", fletcher32=True)
    f.create_dataset("rewards", data=np.ones(n, np.float64), maxshape=(None,))
    f.create_dataset("terminals", data=np.arange(n) == 1234)
    f.create_dataset("timeouts", data=(np.arange(n) % 1000 == 999).astype(np.int64))
    f["infos/qpos"] = np.zeros((n, 2)); f["metadata/algorithm"] = "SAC"; f["metadata/seed"] = np.int64(3)
    f.attrs["who"] = "h5py"
"#;
    if python(script, &path).is_none() {
        return;
    }
    let got = load(&path, &LoadOptions::default()).unwrap();
    assert_eq!((got.report.dropped.time_out, got.report.dropped.last_row, got.report.rows_kept), (3, 1, 3996));
    assert_eq!(got.transitions.observation(1), [3.0, 4.0, 5.0]);
    assert_eq!(got.transitions.next_observation(1232), [3702.0, 3703.0, 3704.0]);
    assert!(!got.transitions.known[1233], "the next row is another episode's first");
    // Row 999 of the file was dropped: row 1234 is row 1233 here.
    assert_eq!(got.transitions.terminals.iter().position(|&t| t), Some(1233));
    assert_eq!(tce_data::read_attributes(&path).unwrap()["who"], "h5py");
}

/// A data set of a terabyte of which nothing, or only one chunk, was written.
#[test]
fn sparse_giants_are_refused_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("giant.hdf5");
    let script = r#"
import sys, h5py, numpy as np
n = 10**10
with h5py.File(sys.argv[1], "w") as f:
    d = f.create_dataset("observations", shape=(n, 17), dtype="f4", chunks=(1000, 17), compression="gzip")
    d[:1000] = 1.0
    f.create_dataset("actions", shape=(n, 6), dtype="f4")
    f.create_dataset("rewards", data=np.zeros(100, "f4"))
    f.create_dataset("terminals", data=np.zeros(100, bool))
"#;
    if python(script, &path).is_none() {
        return;
    }
    let started = std::time::Instant::now();
    let error = load(&path, &LoadOptions::default()).unwrap_err();
    assert_eq!(error.problem(), Some(tce_data::Problem::Oversized), "{error}");
    assert!(started.elapsed().as_secs() < 5);

    // Vectors are filled if nothing was written, but only up to a limited length.
    for kind in
        ["shape=(n,), dtype='f4'", "shape=(n,), dtype=bool, chunks=(10,)", "shape=(n,), dtype=bool, chunks=(10**9,)"]
    {
        for name in ["rewards", "terminals", "timeouts"] {
            let script = format!(
                r#"
import sys, h5py, numpy as np
n = 10**12
with h5py.File(sys.argv[1], "w") as f:
    for name, shape in [("observations", (100, 2)), ("actions", (100, 1)), ("rewards", 100), ("terminals", 100), ("timeouts", 100)]:
        if name != "{name}":
            f[name] = np.zeros(shape, "f4")
    f.create_dataset("{name}", {kind})
"#
            );
            python(&script, &path);
            let error = load(&path, &LoadOptions::default()).unwrap_err();
            let parts = ["1000000000000 rows", "never written", "100 rows, as in `observations`"];
            crate::common::assert_refused(error, tce_data::Problem::RowCount, &path, name, &parts);
        }
    }
    assert!(started.elapsed().as_secs() < 60);
}
