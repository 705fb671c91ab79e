//! Files that must be refused, each with a message that says what to do, and damaged files.

use std::fs;
use std::sync::atomic::Ordering::Relaxed;

use crate::common::{LARGEST, assert_refused, load, rows, write};
use hdf5_pure::FileBuilder;
use tce_data::{Agent, LoadOptions, Problem, check};

/// D4RL's fields of `rows(8)`, except `leave_out`, which `replace` may write.
fn without(leave_out: &str, replace: impl FnOnce(&mut FileBuilder)) -> FileBuilder {
    let r = rows(8);
    let mut b = FileBuilder::new();
    if leave_out != "observations" {
        b.create_dataset("observations").with_f32_data(&r.observations).with_shape(&[8, 2]);
    }
    if leave_out != "actions" {
        b.create_dataset("actions").with_f32_data(&r.actions).with_shape(&[8, 1]);
    }
    for name in ["rewards", "terminals", "timeouts"] {
        if leave_out != name {
            b.create_dataset(name).with_u8_data(&[0; 8]);
        }
    }
    replace(&mut b);
    b
}

#[test]
fn a_missing_file_and_a_directory() {
    let dir = tempfile::tempdir().unwrap();
    let text = load(&dir.path().join("no.hdf5")).unwrap_err().to_string();
    assert!(text.contains("no.hdf5") && text.contains("no such file"), "{text}");
    let text = load(dir.path()).unwrap_err().to_string();
    assert!(text.contains("it is a folder, not a file"), "{text}");
}

#[test]
fn empty_foreign_and_cut_off_files() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.hdf5");
    fs::write(&path, b"").unwrap();
    assert_refused(load(&path).unwrap_err(), Problem::Empty, &path, "file", &["0 bytes"]);
    fs::write(&path, b"PK\x03\x04 a zip, perhaps").unwrap();
    assert_refused(load(&path).unwrap_err(), Problem::NotHdf5, &path, "file", &["signature", "Convert"]);
    let whole = rows(500).otdf().finish().unwrap();
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    assert_refused(load(&path).unwrap_err(), Problem::Truncated, &path, "file", &["again"]);
}

#[test]
fn every_missing_field_is_named_with_those_that_are_there() {
    let dir = tempfile::tempdir().unwrap();
    for field in ["observations", "actions", "rewards", "terminals"] {
        let path = write(&dir, "a.hdf5", without(field, |_| ()));
        assert_refused(load(&path).unwrap_err(), Problem::MissingField, &path, field, &["timeouts", "Check"]);
    }
    let mut b = FileBuilder::new();
    b.set_attr("a", hdf5_pure::AttrValue::I64(1));
    let path = write(&dir, "a.hdf5", b);
    assert_refused(load(&path).unwrap_err(), Problem::MissingField, &path, "observations", &["no data sets"]);
}

#[test]
fn every_wrong_rank_is_named() {
    let dir = tempfile::tempdir().unwrap();
    for (field, shape) in [
        ("observations", vec![16]),
        ("observations", vec![4, 2, 2]),
        ("actions", vec![16]),
        ("rewards", vec![8, 2]),
        ("terminals", vec![1, 16]),
        ("timeouts", vec![4, 2, 2]),
    ] {
        let b = without(field, |b| {
            b.create_dataset(field).with_f32_data(&[0.0; 16]).with_shape(&shape);
        });
        let path = write(&dir, "a.hdf5", b);
        let shape = format!("{shape:?}");
        assert_refused(load(&path).unwrap_err(), Problem::WrongRank, &path, field, &[&shape, "(N", "Reshape"]);
    }
}

#[test]
fn every_disagreeing_row_count_is_named() {
    let dir = tempfile::tempdir().unwrap();
    for field in ["actions", "rewards", "terminals", "timeouts", "next_observations", "label"] {
        let b = without(field, |b| {
            let d = b.create_dataset(field);
            match field {
                "actions" => d.with_f32_data(&[0.0; 7]).with_shape(&[7, 1]),
                "next_observations" => d.with_f32_data(&[0.0; 14]).with_shape(&[7, 2]),
                _ => d.with_f32_data(&[0.0; 7]),
            };
        });
        let path = write(&dir, "a.hdf5", b);
        let columns = if field == "label" { vec!["label".to_owned()] } else { Vec::new() };
        let error = tce_data::load(&path, &LoadOptions { columns, ..LoadOptions::default() }).unwrap_err();
        assert_refused(error, Problem::RowCount, &path, field, &["7 rows", "8 rows", "observations"]);
    }
}

#[test]
fn no_rows_and_no_usable_rows() {
    let dir = tempfile::tempdir().unwrap();
    let b = without("observations", |b| {
        b.create_dataset("observations").with_f32_data(&[]).with_shape(&[0, 2]);
    });
    let path = write(&dir, "a.hdf5", b);
    assert_refused(load(&path).unwrap_err(), Problem::Empty, &path, "observations", &["0 rows"]);
    let path = write(&dir, "b.hdf5", rows(1).d4rl());
    assert_refused(load(&path).unwrap_err(), Problem::Empty, &path, "observations", &["1 rows", "next_observations"]);
}

#[test]
fn nan_and_infinity_are_located_in_every_field() {
    let dir = tempfile::tempdir().unwrap();
    for (field, row, column) in
        [("observations", 5, 1), ("next_observations", 2, 0), ("actions", 3, 0), ("rewards", 7, 0)]
    {
        for (bad, name) in [(f32::NAN, "NaN"), (f32::NEG_INFINITY, "-inf")] {
            let mut r = rows(8);
            match field {
                "observations" => r.observations[row * 2 + column] = bad,
                "next_observations" => r.next[row * 2 + column] = bad,
                "actions" => r.actions[row] = bad,
                _ => r.rewards[row] = bad,
            }
            let path = write(&dir, "a.hdf5", r.with_next(r.d4rl()));
            let place = format!("{name} in row {row}, column {column}");
            assert_refused(load(&path).unwrap_err(), Problem::NonFinite, &path, field, &[&place, "Remove"]);
        }
    }
    // A float64 that float32 cannot hold.
    let b = without("rewards", |b| {
        b.create_dataset("rewards").with_f64_data(&[0.0, 1e300, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    });
    let path = write(&dir, "a.hdf5", b);
    let parts = ["1e300 in row 1, column 0", "does not fit float32", "3.4e38"];
    assert_refused(load(&path).unwrap_err(), Problem::NonFinite, &path, "rewards", &parts);
    let b = without("observations", |b| {
        let mut data = [0.0; 16];
        data[11] = -1e39;
        data[13] = f64::NAN;
        b.create_dataset("observations").with_f64_data(&data).with_shape(&[8, 2]);
    });
    let path = write(&dir, "a.hdf5", b);
    let parts = ["-1e39 in row 5, column 1 (2 such values)", "does not fit float32"];
    assert_refused(load(&path).unwrap_err(), Problem::NonFinite, &path, "observations", &parts);
}

#[test]
fn wrong_types_values_and_dimensions() {
    let dir = tempfile::tempdir().unwrap();
    let b = without("rewards", |b| {
        b.create_dataset("rewards").with_vlen_strings(&["0"; 8]);
    });
    let path = write(&dir, "a.hdf5", b);
    assert_refused(
        load(&path).unwrap_err(),
        Problem::WrongType,
        &path,
        "rewards",
        &["float32, float64", "Store numbers"],
    );

    let b = without("terminals", |b| {
        b.create_dataset("terminals").with_f32_data(&[0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]);
    });
    let path = write(&dir, "b.hdf5", b);
    assert_refused(load(&path).unwrap_err(), Problem::Value, &path, "terminals", &["0.5 in row 2", "0 or 1"]);

    let b = without("", |b| {
        b.create_dataset("next_observations").with_f32_data(&[0.0; 24]).with_shape(&[8, 3]);
    });
    let path = write(&dir, "c.hdf5", b);
    assert_refused(
        load(&path).unwrap_err(),
        Problem::Dimension,
        &path,
        "next_observations",
        &["3 columns", "2 columns"],
    );

    let path = write(&dir, "d.hdf5", rows(8).d4rl());
    let of = |dims| tce_data::load(&path, &LoadOptions { dims: Some(dims), ..LoadOptions::default() }).unwrap_err();
    assert_refused(
        of((17, 6)),
        Problem::Dimension,
        &path,
        "observations",
        &["2 columns", "17 columns", "another agent"],
    );
    assert_refused(of((2, 6)), Problem::Dimension, &path, "actions", &["1 columns", "6 columns"]);
}

#[test]
fn a_group_in_a_fields_place_is_named() {
    let dir = tempfile::tempdir().unwrap();
    for field in ["observations", "next_observations", "timeouts"] {
        let b = without(field, |b| {
            let mut group = b.create_group(field);
            group.create_dataset("qpos").with_f32_data(&[0.0; 8]);
            group.create_dataset("qvel").with_f32_data(&[0.0; 8]);
            b.add_group(group.finish());
        });
        let path = write(&dir, "a.hdf5", b);
        let parts = ["a group of qpos, qvel", "a data set", "rename the group"];
        assert_refused(load(&path).unwrap_err(), Problem::WrongType, &path, field, &parts);
    }
}

/// Float32 cannot represent every integer from 2^24 on: a warning is given exactly if a file loses digits.
#[test]
fn integers_that_lose_digits_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let rewards = |rewards: &[i64; 8]| {
        let b = without("rewards", |b| {
            b.create_dataset("rewards").with_i64_data(rewards);
        });
        load(&write(&dir, "a.hdf5", b)).unwrap().report.warnings
    };
    assert_eq!(rewards(&[0, 1, -7, 1 << 24, -(1 << 24), 1 << 40, i64::MIN, 3]), Vec::<String>::new());
    let warnings = rewards(&[0, 1, (1 << 24) + 1, 1 << 40, (1 << 53) + 1, i64::MAX, 0, 0]);
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    for part in ["`rewards`", "3 integers", "16777217 in row 2"] {
        assert!(warnings[0].contains(part), "{}", warnings[0]);
    }
    let b = without("observations", |b| {
        let mut data = [0u64; 16];
        data[9] = u64::MAX;
        b.create_dataset("observations").with_u64_data(&data).with_shape(&[8, 2]);
    });
    let warnings = load(&write(&dir, "a.hdf5", b)).unwrap().report.warnings;
    assert!(warnings[0].contains("`observations`") && warnings[0].contains("18446744073709551615 in row 4, column 1"));
}

#[test]
fn actions_outside_of_the_box_are_a_warning() {
    let dir = tempfile::tempdir().unwrap();
    let mut r = rows(8);
    r.actions[4] = -1.00005; // rounding
    assert!(load(&write(&dir, "a.hdf5", r.with_next(r.d4rl()))).unwrap().report.warnings.is_empty());
    r.actions[5] = -1.5;
    let got = load(&write(&dir, "a.hdf5", r.with_next(r.d4rl()))).unwrap();
    // The robots of the benchmark clamp them; users' robots have their own units.
    let of =
        |agent| check(&got.transitions, agent).findings.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n");
    let text = of(Some(Agent::Hopper));
    assert!(text.contains("warning: actions: 1 value lies outside") && text.contains("row 5"), "{text}");
    assert!(of(None).contains("note: actions: they range over -1.5:"), "{}", of(None));
}

/// Deflate reaches 1000 : 1, so 16 MB of zeros in a few kilobytes are valid; but they are not eight rows.
#[test]
fn a_well_compressed_data_set_is_not_mistaken_for_damage() {
    let dir = tempfile::tempdir().unwrap();
    let b = without("rewards", |b| {
        b.create_dataset("rewards").with_f32_data(&[0.0; 4_000_000]).with_chunks(&[4_000_000]).with_deflate(9);
    });
    let path = write(&dir, "a.hdf5", b);
    assert!(fs::metadata(&path).unwrap().len() < 40_000);
    assert_refused(load(&path).unwrap_err(), Problem::RowCount, &path, "rewards", &["4000000 rows", "8 rows"]);
}

/// Every truncation of a small file, thousands of damaged bytes: an error or rows, never a panic or a huge allocation.
#[test]
fn damage_never_panics() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.hdf5");
    let mut refused = 0;
    let mut panics = 0;
    let mut read = |bytes: &[u8]| {
        fs::write(&path, bytes).unwrap();
        match load(&path) {
            Ok(got) => {
                let t = &got.transitions;
                assert_eq!(t.len() + got.report.dropped.total(), got.report.rows_in_file);
                assert_eq!(t.observations.len(), t.len() * t.obs_dim);
                assert!(t.len() <= 1040 * bytes.len());
            }
            Err(e) => {
                refused += 1;
                panics += e.to_string().contains("cannot follow") as usize;
            }
        }
    };
    for whole in [rows(60).otdf().finish().unwrap(), rows(60).with_next(rows(60).d4rl()).finish().unwrap()] {
        for end in (0..whole.len()).step_by(11) {
            read(&whole[..end]);
        }
        for at in (0..whole.len()).step_by(2) {
            let mut bytes = whole.clone();
            bytes[at] ^= 1 << (at % 8);
            read(&bytes);
            bytes[(at + 1).min(whole.len() - 1)] = 0xff;
            read(&bytes);
        }
    }
    assert!(LARGEST.load(Relaxed) < 64 << 20, "a file of a few kilobytes made the reader allocate {LARGEST:?} bytes");
    assert!(refused > 1000, "only {refused} damaged files were refused");
    eprintln!("{refused} refused, {panics} of them where the HDF5 reader panicked");
}
