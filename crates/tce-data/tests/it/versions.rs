//! Reads our files with old and new HDF5 libraries and compares every number.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::common::{environment, synthetic};
use tce_data::save_d4rl;

/// Name of the environment, the library inside, and what pip installs. These are the oldest and the newest h5py that
/// run on Python 3.11: HDF5 1.12 (which reads what 1.10 and 1.14 read) and HDF5 2.0, which has stricter checks.
const VERSIONS: [(&str, &str, [&str; 2]); 2] = [
    ("h5py-3.8.0", "1.12.", ["h5py==3.8.0", "numpy==1.26.4"]),
    ("h5py-3.16.0", "2.0.", ["h5py==3.16.0", "numpy==2.2.6"]),
];
/// Around 65,536, chunks once had sides that HDF5 2.0 rejects.
const ROWS: [usize; 5] = [10, 5_000, 65_535, 65_536, 70_000];

/// Compares every data set with the raw numbers stored beside the file.
const COMPARE: &str = r#"
import sys, os, h5py, numpy as np
folder, rows = sys.argv[1], sys.argv[2:]
for n in map(int, rows):
    with h5py.File(os.path.join(folder, f"{n}.hdf5"), "r") as f:
        names = dict(observations=11, actions=3, next_observations=11, rewards=0, terminals=0, timeouts=0, label=0)
        assert set(f) == set(names), sorted(f)
        for name, width in names.items():
            kind = bool if name in ("terminals", "timeouts") else np.dtype("<f4")
            want = np.fromfile(os.path.join(folder, f"{n}.{name}"), kind)
            got = f[name][()]
            assert got.dtype == kind, (n, name, got.dtype)
            assert got.shape == ((n, width) if width else (n,)), (n, name, got.shape)
            assert np.array_equal(got.ravel(), want), (n, name)
        assert f.attrs["config"] == "λ = 0.1"
print(h5py.version.hdf5_version)
"#;

fn write_all(folder: &Path) {
    for n in ROWS {
        let t = synthetic(n, 11, 3, 7);
        let label: Vec<f32> = (0..n).map(|i| i as f32 / 3.0).collect();
        let attributes = [("config".to_owned(), "λ = 0.1".to_owned())].into();
        save_d4rl(&folder.join(format!("{n}.hdf5")), &t, &attributes, &[("label", &label)]).unwrap();
        let raw = |name: &str, bytes: Vec<u8>| fs::write(folder.join(format!("{n}.{name}")), bytes).unwrap();
        let floats = |v: &[f32]| v.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        raw("observations", floats(&t.observations));
        raw("actions", floats(&t.actions));
        raw("next_observations", floats(&t.next_observations));
        raw("rewards", floats(&t.rewards));
        raw("label", floats(&label));
        raw("terminals", t.terminals.iter().map(|&x| x as u8).collect());
        raw("timeouts", t.timeouts.iter().map(|&x| x as u8).collect());
    }
}

#[test]
fn old_and_new_libraries_read_our_files() {
    let dir = tempfile::tempdir().unwrap();
    write_all(dir.path());
    std::thread::scope(|s| {
        for (name, library, packages) in VERSIONS {
            let folder = dir.path();
            s.spawn(move || {
                let python = match environment(name, &packages, "h5py, numpy") {
                    Ok(python) => python,
                    Err(why) => return eprintln!("SKIPPED: no {name}: {why}"),
                };
                let rows = ROWS.map(|n| n.to_string());
                let out = Command::new(python).args(["-c", COMPARE]).arg(folder).args(rows).output().unwrap();
                assert!(out.status.success(), "{name}: {}", String::from_utf8_lossy(&out.stderr));
                let version = String::from_utf8(out.stdout).unwrap();
                assert!(version.starts_with(library), "{name} has HDF5 {version}");
            });
        }
    });
}
