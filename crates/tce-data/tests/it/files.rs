//! Tests of reading valid files of every kind.

use std::collections::BTreeMap;

use crate::common::{Rows, benchmark, enum_flags, load, rebuilt, rows, write};
use hdf5_pure::FileBuilder;
use tce_data::{
    Dropped, EpisodeEnds, Layout, LoadOptions, Loaded, Successors, Transitions, read_attributes, save_d4rl,
};

fn starts_and_ends(t: &Transitions) -> Vec<(usize, usize)> {
    t.episodes().iter().map(|e| (e.start, e.end)).collect()
}

#[test]
fn otdf_uses_stored_successors_and_finds_the_boundaries() {
    let dir = tempfile::tempdir().unwrap();
    let mut r = rows(2500);
    r.terminals[299] = true; // the next episode starts somewhere else
    r.next[299 * 2] = 777.0;
    r.next[1299 * 2] = 888.0; // the step limit
    r.next[1799 * 2] = 999.0; // a break without a reason
    let got = load(&write(&dir, "a.hdf5", r.otdf())).unwrap();
    assert_eq!((got.report.layout, got.report.successors), (Layout::Otdf, Successors::Stored));
    assert_eq!((got.report.rows_in_file, got.report.rows_kept, got.report.dropped), (2500, 2500, Dropped::default()));
    let t = &got.transitions;
    assert_eq!(starts_and_ends(t), [(0, 300), (300, 1300), (1300, 1800), (1800, 2500)]);
    assert_eq!(t.next_observation(299), [777.0, -300.0]);
    assert_eq!(t.rewards, r.rewards);
    let ends = |flags: &[bool]| (0..2500).filter(|&i| flags[i]).collect::<Vec<_>>();
    assert_eq!((ends(&t.terminals), ends(&t.timeouts)), (vec![299], vec![1299, 1799, 2499]));
}

/// A stream of 1500 rows and then a real limit-ended episode cannot be distinguished from rebuilt successors: only the
/// caller knows the step limit.
#[test]
fn the_step_limit_is_an_option() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(&dir, "a.hdf5", rows(1500).otdf());
    let limited = load(&path).unwrap();
    assert_eq!((limited.report.dropped.wrong_successor, limited.report.rows_kept), (1, 1499));
    let free = tce_data::load(&path, &LoadOptions { step_limit: None, ..LoadOptions::default() }).unwrap();
    assert_eq!((free.report.dropped.total(), free.report.rows_kept), (0, 1500));
    assert_eq!(starts_and_ends(&free.transitions), [(0, 1500)]);
}

#[test]
fn rebuilt_successors_are_dropped_and_their_episodes_stay_cut() {
    let dir = tempfile::tempdir().unwrap();
    // Two episodes of 1000 steps, one terminal after 500; successors are built from the next row everywhere.
    let mut r = rebuilt(&[1000, 1000, 500, 100]);
    r.terminals[2499] = true;
    let got = load(&write(&dir, "a.hdf5", r.otdf())).unwrap();
    assert_eq!(got.report.dropped, Dropped { wrong_successor: 2, ..Dropped::default() });
    let t = &got.transitions;
    assert_eq!(starts_and_ends(t), [(0, 999), (999, 1998), (1998, 2498), (2498, 2598)]);
    assert!(t.timeouts[998] && t.timeouts[1997]);
    // The terminal row is kept for methods that learn from its reward; its successor is unknown.
    assert!(t.terminals[2497] && !t.known[2497] && t.next_observation(2497) == t.observation(2497));
    assert_eq!((got.report.unknown_successors, t.with_successors().len()), (1, 2597));
    let text = got.report.to_string();
    assert!(text.contains("2598 of 2600 rows; dropped 2 for a wrong stored successor"), "{text}");
}

/// Compares with the result of `d4rl.qlearning_dataset` for this file, row by row.
#[test]
fn d4rl_without_successors_follows_qlearning_dataset() {
    let dir = tempfile::tempdir().unwrap();
    let mut r = rows(10);
    r.terminals[3] = true;
    r.timeouts[6] = true;
    let got = load(&write(&dir, "a.hdf5", r.d4rl())).unwrap();
    assert_eq!((got.report.layout, got.report.successors), (Layout::D4rl, Successors::NextRow));
    assert_eq!(got.report.dropped, Dropped { time_out: 1, last_row: 1, wrong_successor: 0 });
    assert_eq!((got.report.unknown_successors, got.report.episodes), (1, EpisodeEnds::Marks));
    let t = &got.transitions;
    let first: Vec<f32> = (0..t.len()).map(|i| t.observation(i)[0]).collect();
    let next: Vec<f32> = (0..t.len()).map(|i| t.next_observation(i)[0]).collect();
    assert_eq!(first, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 8.0]);
    // In `qlearning_dataset`, the terminal row 3 has successor 4, the next episode's first state.
    assert_eq!(next, [1.0, 2.0, 3.0, 3.0, 5.0, 6.0, 8.0, 9.0]);
    assert_eq!((0..8).filter(|&i| !t.known[i]).collect::<Vec<_>>(), [3]);
    assert_eq!(starts_and_ends(t), [(0, 4), (4, 6), (6, 8)]);
    assert_eq!(t.terminals.iter().filter(|&&x| x).count(), 1);
}

#[test]
fn d4rl_with_right_successors_keeps_every_row() {
    let dir = tempfile::tempdir().unwrap();
    let mut r = rows(10);
    r.terminals[3] = true;
    r.timeouts[6] = true;
    r.next[3 * 2] = 100.0;
    r.next[6 * 2] = 200.0;
    let got = load(&write(&dir, "a.hdf5", r.with_next(r.d4rl()))).unwrap();
    assert_eq!((got.report.successors, got.report.rows_kept), (Successors::Stored, 10));
    assert_eq!(starts_and_ends(&got.transitions), [(0, 4), (4, 7), (7, 10)]);
    assert_eq!(got.transitions.next_observation(6), [200.0, -7.0]);
}

/// Ten rows, of which row 3 is terminal, with what `add` adds to their file; all further columns are read.
fn with_field(name: &str, add: &dyn Fn(&mut FileBuilder)) -> Loaded {
    let dir = tempfile::tempdir().unwrap();
    let mut r = rows(10);
    (r.terminals[3], r.timeouts[6]) = (true, true);
    (r.next[3 * 2], r.next[6 * 2]) = (-70.0, 200.0);
    let mut b = r.with_next(r.d4rl());
    add(&mut b);
    tce_data::load(&write(&dir, name, b), &LoadOptions { all_columns: true, ..benchmark() }).unwrap()
}

/// `true` in all of `n` rows but one.
fn all_but(row: usize, n: usize) -> Vec<bool> {
    (0..n).map(|i| i != row).collect()
}

/// A file that someone wrote from the columns of a table: `known` is 0 at a terminal whose s' was not logged.
#[test]
fn the_field_known_marks_successors_that_were_not_logged() {
    let numbers: Vec<f32> = all_but(3, 10).into_iter().map(f32::from).collect();
    let column = |b: &mut FileBuilder| {
        b.create_dataset("known").with_f32_data(&numbers).with_shape(&[10, 1]);
    };
    for got in [
        with_field("flags.hdf5", &|b| enum_flags(b, "known", &all_but(3, 10))),
        with_field("column.hdf5", &column),
        with_field("ours.hdf5", &|b| enum_flags(b, "next_observations_known", &all_but(3, 10))),
    ] {
        let t = &got.transitions;
        assert_eq!((&t.known, got.report.unknown_successors), (&all_but(3, 10), 1));
        assert_eq!(t.next_observation(3), t.observation(3), "what stood there is nobody's s'");
        assert_eq!(starts_and_ends(t), [(0, 4), (4, 7), (7, 10)]);
        assert!(got.columns.is_empty(), "{:?}", got.columns);
    }
}

#[test]
fn a_column_known_of_ones_own_is_told_and_stays_a_column() {
    let read = |name: &str, words: &str, add: &dyn Fn(&mut FileBuilder)| {
        let got = with_field(name, add);
        assert_eq!((got.report.unknown_successors, got.transitions.next_observation(3)[0]), (0, -70.0));
        let told: Vec<&String> = got.report.warnings.iter().filter(|w| w.starts_with("`known` was not read")).collect();
        assert!(told.len() == 1 && told[0].contains(words), "{:?}", got.report.warnings);
        got.columns.contains_key("known")
    };
    let numbers: Vec<f32> = (0..10).map(|i| i as f32).collect();
    let counts = |b: &mut FileBuilder| {
        b.create_dataset("known").with_f32_data(&numbers);
    };
    let wide = |b: &mut FileBuilder| {
        b.create_dataset("known").with_u8_data(&[1; 20]).with_shape(&[10, 2]);
    };
    assert!(read("counts.hdf5", "found 2 in row 2; expected 0 or 1", &counts));
    assert!(read("elsewhere.hdf5", "found 0 in row 5, which is no terminal", &|b| {
        enum_flags(b, "known", &all_but(5, 10));
    }));
    assert!(!read("short.hdf5", "found 9 rows; expected 10 rows, as in `observations`", &|b| {
        enum_flags(b, "known", &all_but(3, 9));
    }));
    assert!(!read("wide.hdf5", "found shape [10, 2]; expected shape (N,) or (N, 1)", &wide));

    // A file of ours has its marks under another name.
    let (dir, got) = (tempfile::tempdir().unwrap(), with_field("plain.hdf5", &|_| {}));
    let path = dir.path().join("ours.hdf5");
    save_d4rl(&path, &got.transitions, &BTreeMap::new(), &[("known", &numbers[..])]).unwrap();
    let again = tce_data::load(&path, &LoadOptions { all_columns: true, ..benchmark() }).unwrap();
    assert_eq!((&again.transitions, &again.columns["known"]), (&got.transitions, &numbers));
    assert!(again.report.warnings.is_empty(), "{}", again.report);
}

#[test]
fn d4rl_with_rebuilt_successors_is_read_as_if_they_were_absent() {
    let dir = tempfile::tempdir().unwrap();
    let mut r = rebuilt(&[40, 30, 30]);
    r.terminals[39] = true;
    r.timeouts[69] = true;
    let with = load(&write(&dir, "a.hdf5", r.with_next(r.d4rl()))).unwrap();
    let without = load(&write(&dir, "b.hdf5", r.d4rl())).unwrap();
    assert_eq!(with.transitions, without.transitions);
    assert!(with.report.to_string().contains("treated as absent"));
    assert_eq!(with.report.successors, Successors::NextRow);
}

#[test]
fn without_timeouts_and_successors_steps_are_counted() {
    let dir = tempfile::tempdir().unwrap();
    let r = rows(2100);
    let mut b = FileBuilder::new();
    b.create_dataset("observations").with_f32_data(&r.observations).with_shape(&[2100, 2]);
    b.create_dataset("actions").with_f32_data(&r.actions).with_shape(&[2100, 1]);
    b.create_dataset("rewards").with_f32_data(&r.rewards);
    b.create_dataset("terminals").with_u8_data(&[0; 2100]);
    let got = load(&write(&dir, "a.hdf5", b)).unwrap();
    assert_eq!(got.report.dropped, Dropped { time_out: 2, last_row: 1, wrong_successor: 0 });
    assert!(got.report.warnings[0].contains("1000 steps"));
}

/// f64 states, terminals as f64, i32, u8 and booleans, (N,) and (N, 1): all give the same rows.
#[test]
fn every_storage_type_gives_the_same_rows() {
    let dir = tempfile::tempdir().unwrap();
    let mut r = rows(40);
    r.terminals[20] = true;
    r.next[20 * 2] = 0.25;
    let want = load(&write(&dir, "0.hdf5", r.otdf())).unwrap().transitions;
    let base = |wide: bool, column: bool| {
        let mut b = FileBuilder::new();
        for (name, data, d) in [
            ("observations", &r.observations, 2),
            ("next_observations", &r.next, 2),
            ("actions", &r.actions, 1),
            ("rewards", &r.rewards, 0),
        ] {
            let shape = if d > 0 {
                vec![40, d]
            } else if column {
                vec![40, 1]
            } else {
                vec![40]
            };
            let double: Vec<f64> = data.iter().map(|&x| x as f64).collect();
            let ds = b.create_dataset(name);
            if wide {
                ds.with_f64_data(&double).with_shape(&shape)
            } else {
                ds.with_f32_data(data).with_shape(&shape)
            };
        }
        b
    };
    let flags = |r: &Rows| r.terminals.iter().map(|&t| t as u8).collect::<Vec<_>>();
    let mut b = base(true, false);
    b.create_dataset("terminals").with_f64_data(&flags(&r).iter().map(|&x| x as f64).collect::<Vec<_>>());
    let got = load(&write(&dir, "1.hdf5", b)).unwrap();
    assert_eq!(got.transitions, want);
    assert!(got.report.warnings[0].contains("float64"));
    let mut b = base(false, true);
    b.create_dataset("terminals")
        .with_i32_data(&flags(&r).iter().map(|&x| x as i32).collect::<Vec<_>>())
        .with_shape(&[40, 1]);
    assert_eq!(load(&write(&dir, "2.hdf5", b)).unwrap().transitions, want);
    let mut b = base(false, true);
    b.create_dataset("terminals").with_u8_data(&flags(&r));
    assert_eq!(load(&write(&dir, "3.hdf5", b)).unwrap().transitions, want);
    let mut b = base(true, true);
    enum_flags(&mut b, "terminals", &r.terminals);
    assert_eq!(load(&write(&dir, "4.hdf5", b)).unwrap().transitions, want);
}

/// A coordinate in metres from a far origin: float32 holds half metres there, and the steps are centimetres. The same
/// coordinate in whole metres loses nothing.
#[test]
fn doubles_that_lose_their_steps_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let read = |step: f64| {
        let state = |i: u32| [f64::from(i).sin(), 5.4e6 + step * f64::from(i)];
        let mut b = FileBuilder::new();
        for (name, later) in [("observations", 0), ("next_observations", 1)] {
            let states: Vec<f64> = (0..200).flat_map(|i| state(i + later)).collect();
            b.create_dataset(name).with_f64_data(&states).with_shape(&[200, 2]);
        }
        b.create_dataset("actions").with_f64_data(&[0.5; 200]).with_shape(&[200, 1]);
        b.create_dataset("rewards").with_f64_data(&[1.0; 200]);
        enum_flags(&mut b, "terminals", &[false; 200]);
        load(&write(&dir, "far.hdf5", b)).unwrap().report.warnings.join("\n")
    };
    let told = read(0.01);
    assert!(told.contains("`observations`: float32 rounds column 1 by more than 1 % of a usual step"), "{told}");
    assert!(
        told.contains("subtract an offset") && !told.contains("`actions`") && !told.contains("`rewards`"),
        "{told}"
    );
    assert!(!read(1.0).contains("of a usual step"));
}

#[test]
fn own_files_come_back_exactly_with_attributes_and_columns() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("deep/out.hdf5");
    let mut t = crate::common::synthetic(5000, 17, 6, 37);
    // A stream that is cut on purpose: s' is the next row's state across a time-out. The reader must not "repair" this.
    for i in (36..4999).step_by(37) {
        let next = t.observation(i + 1).to_vec();
        t.next_observations[i * 17..(i + 1) * 17].copy_from_slice(&next);
    }
    let origin: Vec<f32> = (0..5000).map(|i| (i % 3) as f32).collect();
    let long = "x = 1\n".repeat(40_000);
    let attributes: BTreeMap<String, String> =
        [("config".to_owned(), long), ("name".to_owned(), "Zürich √".to_owned()), ("none".to_owned(), String::new())]
            .into();
    save_d4rl(&path, &t, &attributes, &[("origin", &origin)]).unwrap();
    let options = LoadOptions { columns: vec!["origin".into()], dims: Some((17, 6)), ..LoadOptions::default() };
    let got = tce_data::load(&path, &options).unwrap();
    assert_eq!(got.transitions, t);
    assert_eq!(got.columns["origin"], origin);
    assert_eq!((got.report.layout, got.report.warnings.len()), (Layout::Tce, 0));
    let mut read = read_attributes(&path).unwrap();
    assert_eq!(read.remove("tce_format").as_deref(), Some("transitions-1"));
    assert_eq!(read, attributes);
    assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1, "no temporary files");
}

#[test]
fn columns_lose_the_same_rows() {
    let dir = tempfile::tempdir().unwrap();
    let mut r = rows(6);
    r.timeouts[2] = true;
    let mut b = r.d4rl();
    b.create_dataset("label").with_f32_data(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
    let options = LoadOptions { columns: vec!["label".into()], ..LoadOptions::default() };
    let got = tce_data::load(&write(&dir, "a.hdf5", b), &options).unwrap();
    assert_eq!(got.columns["label"], [0.0, 1.0, 3.0, 4.0]);
}

#[test]
fn a_full_disk_is_an_error_and_leaves_nothing() {
    use std::process::Command;
    let dir = tempfile::tempdir().unwrap();
    let mount = Command::new("mount").args(["-t", "tmpfs", "-o", "size=64k", "tmpfs"]).arg(dir.path()).output();
    if !mount.is_ok_and(|o| o.status.success()) {
        eprintln!("SKIPPED: a_full_disk_is_an_error_and_leaves_nothing needs the right to mount a tmpfs");
        return;
    }
    let path = dir.path().join("out.hdf5");
    let result = save_d4rl(&path, &crate::common::synthetic(5000, 17, 6, 100), &BTreeMap::new(), &[]);
    let left = std::fs::read_dir(dir.path()).unwrap().count();
    let unmounted = Command::new("umount").arg(dir.path()).status().unwrap().success();
    let text = result.unwrap_err().to_string();
    assert!(text.contains("out.hdf5") && text.contains("no space is left on the device"), "{text}");
    assert_eq!(left, 0, "a partial file was left behind");
    assert!(unmounted);
}

#[test]
fn a_failed_save_keeps_the_old_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("out.hdf5");
    let t = crate::common::synthetic(50, 3, 2, 10);
    save_d4rl(&path, &t, &BTreeMap::new(), &[]).unwrap();
    for columns in [[("origin", &[0.0f32; 49][..])], [("rewards", &[0.0f32; 50][..])]] {
        let text = save_d4rl(&path, &t, &BTreeMap::new(), &columns).unwrap_err().to_string();
        assert!(text.contains(columns[0].0), "{text}");
    }
    assert!(save_d4rl(&path, &Transitions::new(3, 2), &BTreeMap::new(), &[]).is_err());
    assert_eq!(load(&path).unwrap().transitions, t);
}
