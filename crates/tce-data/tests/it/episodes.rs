//! Tests of ends of episodes and known successors in users' own files.

use std::ops::Range;

use crate::common::{enum_flags, write};
use hdf5_pure::FileBuilder;
use proptest::prelude::*;
use rand::RngExt;
use tce_base::Streams;
use tce_data::{Dropped, EpisodeEnds, LoadOptions, Loaded, Successors, Transitions, continued, save_d4rl};

const EPISODES: usize = 20;
const LENGTH: usize = 100;
const ROWS: usize = EPISODES * LENGTH;

/// Twenty random walks of a hundred steps in three dimensions, and the fields of a file with them.
#[derive(Clone)]
struct Walks {
    observations: Vec<f32>,
    next: Option<Vec<f32>>,
    terminals: Vec<bool>,
    timeouts: Option<Vec<bool>>,
}

impl Walks {
    fn new() -> Self {
        Self::of(EPISODES, LENGTH)
    }

    fn of(episodes: usize, length: usize) -> Self {
        let mut rng = Streams::new(3).stream("walks");
        let mut step = || -> f32 { (0..6).map(|_| rng.random_range(-0.1f32..0.1)).sum() };
        let (mut observations, mut next) = (Vec::new(), Vec::new());
        for _ in 0..episodes {
            let mut s = [step(), step(), step()];
            for _ in 0..length {
                observations.extend(s);
                s.iter_mut().for_each(|x| *x += step());
                next.extend(s);
            }
        }
        let timeouts = (0..episodes * length).map(|i| i % length == length - 1).collect();
        Self { observations, next: Some(next), terminals: vec![false; episodes * length], timeouts: Some(timeouts) }
    }

    fn load(&self, options: &LoadOptions) -> Loaded {
        let dir = tempfile::tempdir().unwrap();
        let n = self.terminals.len() as u64;
        let mut b = FileBuilder::new();
        b.create_dataset("observations").with_f32_data(&self.observations).with_shape(&[n, 3]);
        b.create_dataset("actions").with_f32_data(&vec![0.5; 2 * n as usize]).with_shape(&[n, 2]);
        // The row's own number, to identify it later.
        b.create_dataset("rewards").with_f32_data(&(0..n).map(|i| i as f32).collect::<Vec<_>>());
        enum_flags(&mut b, "terminals", &self.terminals);
        if let Some(next) = &self.next {
            b.create_dataset("next_observations").with_f32_data(next).with_shape(&[n, 3]);
        }
        if let Some(timeouts) = &self.timeouts {
            enum_flags(&mut b, "timeouts", timeouts);
        }
        tce_data::load(&write(&dir, "walks.hdf5", b), options).unwrap()
    }

    fn read(&self) -> Loaded {
        self.load(&LoadOptions::default())
    }

    /// The rows in another order.
    fn permuted(&self, order: &[usize]) -> Self {
        let of = |data: &[f32]| order.iter().flat_map(|&i| data[3 * i..3 * i + 3].to_vec()).collect();
        let flags = |data: &[bool]| order.iter().map(|&i| data[i]).collect();
        Self {
            observations: of(&self.observations),
            next: self.next.as_deref().map(of),
            terminals: flags(&self.terminals),
            timeouts: self.timeouts.as_deref().map(flags),
        }
    }
}

fn spans(t: &Transitions) -> Vec<Range<usize>> {
    t.episodes().iter().map(|e| e.start..e.end).collect()
}

fn right() -> Vec<Range<usize>> {
    (0..EPISODES).map(|k| k * LENGTH..(k + 1) * LENGTH).collect()
}

fn roll(flags: &[bool], by: isize) -> Vec<bool> {
    let n = flags.len() as isize;
    (0..n).map(|i| flags[(i - by).rem_euclid(n) as usize]).collect()
}

#[test]
fn right_marks_say_it_without_a_word() {
    let got = Walks::new().read();
    assert_eq!((spans(&got.transitions), got.report.episodes), (right(), EpisodeEnds::Marks));
    assert_eq!((got.report.successors, got.report.dropped.total()), (Successors::Stored, 0));
    assert_eq!(got.report.warnings, [""; 0]);
}

#[test]
fn shifted_marks_lose_against_right_successors() {
    for by in [1, -1, 7] {
        let mut walks = Walks::new();
        walks.timeouts = walks.timeouts.map(|t| roll(&t, by));
        let got = walks.read();
        assert_eq!(spans(&got.transitions), right(), "by {by}");
        assert_eq!(Some(&got.transitions.next_observations), walks.next.as_ref());
        assert_eq!((got.report.episodes, got.report.dropped.total()), (EpisodeEnds::Continuity, 0));
        let text = got.report.to_string();
        assert!(
            text.contains("`timeouts` contradicts the states") && text.contains("not rows 99, 199, 299 and "),
            "{text}"
        );
    }
}

/// The marks are right, and successors were built from the next row: at the ends they are unknown.
#[test]
fn rebuilt_successors_are_still_told_from_shifted_marks() {
    let mut walks = Walks::new();
    let mut next = walks.observations[3..].to_vec();
    next.extend([0.0; 3]);
    walks.next = Some(next);
    walks.terminals[499] = true;
    walks.timeouts.as_mut().unwrap()[499] = false;
    let got = walks.read();
    assert_eq!(got.report.dropped, Dropped { time_out: 18, last_row: 1, wrong_successor: 0 });
    assert_eq!((got.report.unknown_successors, got.transitions.terminals.iter().filter(|t| **t).count()), (1, 1));
    assert_eq!(got.transitions.episodes().len(), 20);
}

/// The same successors with misplaced marks: the jumps of the state show the ends.
#[test]
fn rebuilt_successors_under_wrong_marks_are_found_by_the_jumps() {
    let mut next = Walks::new().observations[3..].to_vec();
    next.extend([0.0; 3]);
    for by in [1, -2, 5] {
        let timeouts = Walks::new().timeouts.map(|t| roll(&t, by));
        let got = Walks { next: Some(next.clone()), timeouts, ..Walks::new() }.read();
        assert!(got.report.to_string().contains("but the states jump"), "{by}: {}", got.report);
        assert!((19..=21).contains(&got.report.dropped.total()), "{by}: {}", got.report);
    }
    for timeouts in [None, Some(vec![false; ROWS])] {
        let got = Walks { next: Some(next.clone()), timeouts, ..Walks::new() }.read();
        assert!(got.report.to_string().contains("the state jumps after rows"), "{}", got.report);
    }
}

/// One walk without a reset: with any marks, s' = next s proves nothing.
#[test]
fn right_successors_of_one_stream_are_never_thrown_away() {
    let stream = Walks::of(1, ROWS);
    type Mark = fn(usize) -> bool;
    let marks: [(&str, Mark); 5] = [
        ("every hundredth", |i| i % 100 == 99),
        ("all", |_| true),
        ("all but the ends", |i| i % 100 != 99),
        ("every second", |i| i % 2 == 1),
        ("a single one", |i| i == 500),
    ];
    for (what, mark) in marks {
        let timeouts: Vec<bool> = (0..ROWS).map(mark).collect();
        let got = Walks { timeouts: Some(timeouts), ..stream.clone() }.read();
        assert_eq!((got.report.rows_kept, got.report.unknown_successors), (ROWS, 0), "{what}: {}", got.report);
    }
}

#[test]
fn a_success_that_is_held_keeps_its_successors() {
    let held: Vec<bool> = (0..ROWS).map(|i| i % LENGTH >= 95).collect();
    for timeouts in [None, Some(vec![false; ROWS])] {
        let got = Walks { terminals: held.clone(), timeouts, ..Walks::new() }.read();
        assert_eq!((got.report.rows_kept, got.report.unknown_successors), (ROWS, 0), "{}", got.report);
        assert!(got.report.to_string().contains("`terminals` stays true after rows 95, 96, 97"), "{}", got.report);
    }
}

#[test]
fn a_few_late_marks_are_moved() {
    let late: Vec<bool> =
        (0..ROWS).map(|i| if i / LENGTH < 5 { i % LENGTH == 0 && i > 0 } else { i % LENGTH == 99 }).collect();
    let got = Walks { timeouts: Some(late), ..Walks::new() }.read();
    assert_eq!(spans(&got.transitions), right());
    assert!(got.report.to_string().contains("`timeouts` marks rows 100, 200, 300 and 400"), "{}", got.report);
}

/// The successors are never the next row's state: some steps later, or with one other column. The marks are right.
#[test]
fn successors_stored_in_another_way_leave_the_marks_alone() {
    let mut walks = Walks::new();
    walks.next.as_mut().unwrap().iter_mut().step_by(3).for_each(|x| *x = 7.0);
    let got = walks.read();
    assert_eq!((spans(&got.transitions), got.report.episodes), (right(), EpisodeEnds::Marks));
    assert!(got.report.to_string().contains("although the rows are in order"), "{}", got.report);
}

#[test]
fn a_file_of_ours_that_somebody_changed_is_looked_at_again() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("ours.hdf5");
    let mut t = Walks::new().read().transitions;
    t.timeouts.fill(false);
    save_d4rl(&path, &t, &Default::default(), &[]).unwrap();
    let got = tce_data::load(&path, &LoadOptions { distrust_own: true, ..LoadOptions::default() }).unwrap();
    assert_eq!(spans(&got.transitions), right());
}

#[test]
fn without_successors_wrong_marks_show_in_the_jumps() {
    let straight = Walks { next: None, ..Walks::new() };
    for by in [2, -3] {
        let got = Walks { timeouts: straight.timeouts.as_ref().map(|t| roll(t, by)), ..straight.clone() }.read();
        assert!(got.report.to_string().contains(&format!("but the states jump {} rows", by.abs())), "{}", got.report);
    }
    for timeouts in [None, Some(vec![false; ROWS])] {
        let got = Walks { timeouts, ..straight.clone() }.read();
        assert!(got.report.to_string().contains("the state jumps after rows"), "{}", got.report);
    }
    assert!(!straight.read().report.to_string().contains("jumps"), "{}", straight.read().report);
    // Four interleaved environments: this cannot be corrected, so the user is warned.
    let order: Vec<usize> = (0..ROWS / 4).flat_map(|i| (0..4).map(move |k| k * ROWS / 4 + i)).collect();
    let got = straight.permuted(&order).read();
    assert!(got.report.to_string().contains("do the rows of 4 environments take turns?"), "{}", got.report);
}

#[test]
fn marks_that_are_all_zero_are_made_up_for_by_the_states() {
    let walks = Walks { timeouts: Some(vec![false; ROWS]), ..Walks::new() };
    let got = walks.read();
    assert_eq!((spans(&got.transitions), got.report.episodes), (right(), EpisodeEnds::Continuity));
    assert!(
        got.report.to_string().contains("`timeouts` does not mark rows 99, 199, 299 and 16 more"),
        "{}",
        got.report
    );
}

#[test]
fn rounded_successors_do_not_end_episodes() {
    for digits in [6, 4, 3, 2] {
        let mut walks = Walks { timeouts: None, ..Walks::new() };
        let scale = 10f32.powi(digits);
        walks.next.as_mut().unwrap().iter_mut().for_each(|x| *x = (*x * scale).round() / scale);
        let got = walks.read();
        assert_eq!(
            (spans(&got.transitions), got.report.episodes),
            (right(), EpisodeEnds::Continuity),
            "{digits} digits"
        );
    }
}

#[test]
fn rows_are_continued_up_to_rounding_where_no_mark_ends_them() {
    let mut walks = Walks::new();
    walks.next.as_mut().unwrap().iter_mut().for_each(|x| *x = (*x * 1e3).round() / 1e3);
    let mut t = walks.read().transitions;
    let mut expected: Vec<bool> = (0..ROWS).map(|i| i % LENGTH != LENGTH - 1).collect();
    assert_eq!(continued(&t), expected);
    t.timeouts.fill(false);
    t.terminals[7] = true;
    expected[7] = false;
    assert_eq!(continued(&t), expected, "the states tell the ends, too");
    assert!(continued(&Transitions::new(3, 2)).is_empty());
}

/// Without `timeouts` nothing marks the ends of such a file, and the next row's action is not one at s'.
#[test]
fn successors_stored_in_another_way_are_not_the_next_row() {
    let mut walks = Walks { timeouts: None, ..Walks::new() };
    walks.next.as_mut().unwrap().iter_mut().step_by(3).for_each(|x| *x = 70.0);
    let t = walks.read().transitions;
    assert!(!t.timeouts.contains(&true));
    assert!(!continued(&t).contains(&true));
}

#[test]
fn environments_that_take_turns_are_put_in_order() {
    for (environments, marked) in [(4, true), (4, false), (20, true), (3, true)] {
        // Row i of environment k is at index i * environments + k.
        let straight = Walks::of(environments, 5 * LENGTH);
        let order: Vec<usize> =
            (0..5 * LENGTH).flat_map(|i| (0..environments).map(move |k| k * 5 * LENGTH + i)).collect();
        let mut tangled = straight.permuted(&order);
        if !marked {
            tangled.timeouts = None;
        }
        let got = tangled.read();
        assert_eq!(got.report.environments, environments);
        assert_eq!(spans(&got.transitions), spans(&straight.read().transitions), "{environments}, marks: {marked}");
        assert_eq!(got.transitions.observations, straight.observations);
        // The other columns are reordered in the same way.
        let expected: Vec<f32> = (0..environments * 5 * LENGTH)
            .map(|row| ((row % (5 * LENGTH)) * environments + row / (5 * LENGTH)) as f32)
            .collect();
        assert_eq!(got.transitions.rewards, expected);
        assert!(got.report.to_string().contains(&format!("the rows of {environments} environments take turns")));
    }
}

/// The marks of several episodes fit the environments: each has its own.
#[test]
fn environments_with_several_episodes_are_put_in_order() {
    let order: Vec<usize> = (0..ROWS / 4).flat_map(|i| (0..4).map(move |k| k * ROWS / 4 + i)).collect();
    let got = Walks::new().permuted(&order).read();
    assert_eq!((got.report.environments, spans(&got.transitions)), (4, right()));
    assert_eq!(got.transitions.observations, Walks::new().observations);
}

/// Each row is several steps of one robot, as for n-step returns: s' is some rows later, and the rows stay where they
/// are.
#[test]
fn rows_of_several_steps_are_not_several_environments() {
    for steps in [2, 5, 20] {
        let walks = Walks::new();
        let after = |i: usize| {
            let end = (i / LENGTH + 1) * LENGTH;
            let last = walks.next.as_ref().unwrap();
            let (rows, at) = if i + steps < end { (&walks.observations, i + steps) } else { (last, end - 1) };
            rows[3 * at..3 * at + 3].to_vec()
        };
        let next: Vec<f32> = (0..ROWS).flat_map(after).collect();
        let one = std::iter::once(0..ROWS).collect();
        for (timeouts, episodes, ends) in
            [(walks.timeouts.clone(), right(), EpisodeEnds::Marks), (None, one, EpisodeEnds::Terminals)]
        {
            let got = Walks { next: Some(next.clone()), timeouts, ..walks.clone() }.read();
            assert_eq!((got.report.environments, got.report.episodes), (1, ends), "{steps}: {}", got.report);
            assert_eq!((spans(&got.transitions), got.report.rows_kept), (episodes, ROWS), "{steps}: {}", got.report);
            assert_eq!(
                (&got.transitions.observations, &got.transitions.next_observations),
                (&walks.observations, &next)
            );
            let told = format!("the state {steps} rows later, although the rows are in order");
            assert!(got.report.to_string().contains(&told), "{}", got.report);
        }
    }
}

/// With a gait of five steps, a robot is closer to where it is five rows later than to the next row. An episode whose
/// last five rows have no successor, and one mark, is that of one robot.
#[test]
fn the_marks_of_one_robot_are_not_those_of_several() {
    let state = |row: usize, later: usize| {
        let (episode, step) = ((row / LENGTH) as f64, (row % LENGTH + later) as f64);
        let phase = step * (std::f64::consts::TAU / 5.0 + 0.002) + 1.3 * episode;
        [phase.cos() as f32, phase.sin() as f32, 0.0]
    };
    let observations = (0..ROWS).flat_map(|i| state(i, 0)).collect();
    let next = Some((0..ROWS).flat_map(|i| state(i, 5)).collect());
    let got = Walks { observations, next, ..Walks::new() }.read();
    assert_eq!((got.report.environments, spans(&got.transitions)), (1, right()), "{}", got.report);
    assert!(got.report.to_string().contains("the state 5 rows later"), "{}", got.report);
}

#[test]
fn rows_in_no_order_are_single_transitions_and_the_user_is_told() {
    let mut order: Vec<usize> = (0..ROWS).collect();
    let mut rng = Streams::new(5).stream("order");
    (1..ROWS).rev().for_each(|i| order.swap(i, rng.random_range(0..=i)));
    for timeouts in [None, Walks::new().timeouts] {
        let got = Walks { timeouts, ..Walks::new() }.permuted(&order).read();
        assert_eq!((got.report.episodes, got.report.rows_kept), (EpisodeEnds::NoOrder, ROWS));
        assert!(got.transitions.episodes().len() > ROWS * 9 / 10);
        assert!(got.report.to_string().contains("the rows are in no order"), "{}", got.report);
    }
}

#[test]
fn long_logs_have_no_limit_unless_one_is_asked_for() {
    let long = Walks { timeouts: None, ..Walks::of(2, 1500) };
    let got = long.read();
    assert_eq!((spans(&got.transitions), got.report.dropped.total()), (vec![0..1500, 1500..3000], 0));
    let one = Walks { timeouts: None, next: None, ..Walks::of(1, 20_000) }.read();
    assert_eq!((one.report.rows_kept, one.report.episodes), (19_999, EpisodeEnds::Terminals));
    let limited = long.load(&LoadOptions { step_limit: Some(500), ..LoadOptions::default() });
    assert_eq!(limited.transitions.episodes().len(), 6);
}

#[test]
fn a_terminal_row_without_a_successor_is_learned_from_and_its_dynamics_are_not() {
    let mut walks = Walks { next: None, ..Walks::new() };
    for row in [499, ROWS - 1] {
        walks.terminals[row] = true;
        walks.timeouts.as_mut().unwrap()[row] = false;
    }
    let got = walks.read();
    let t = &got.transitions;
    assert_eq!(got.report.dropped, Dropped { time_out: 18, ..Dropped::default() });
    let terminal: Vec<usize> = (0..t.len()).filter(|&i| t.terminals[i]).collect();
    assert_eq!(terminal.iter().map(|&i| t.rewards[i]).collect::<Vec<_>>(), [499.0, ROWS as f32 - 1.0]);
    assert!(terminal.iter().all(|&i| !t.known[i] && t.observation(i) == t.next_observation(i)));
    assert_eq!((got.report.unknown_successors, t.with_successors().len()), (2, t.len() - 2));
    // A file that is written and read again gives the same rows.
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("again.hdf5");
    save_d4rl(&path, t, &Default::default(), &[]).unwrap();
    assert_eq!(tce_data::load(&path, &LoadOptions::default()).unwrap().transitions, *t);
}

/// Some loggers write NaN where an episode ended at a terminal.
#[test]
fn a_successor_that_is_no_number_is_not_known_where_it_is_not_needed() {
    let mut walks = Walks::new();
    for row in [499, 1299] {
        walks.terminals[row] = true;
        walks.timeouts.as_mut().unwrap()[row] = false;
        walks.next.as_mut().unwrap()[3 * row] = f32::NAN;
    }
    for timeouts in [walks.timeouts.clone(), None] {
        let got = Walks { timeouts, ..walks.clone() }.read();
        assert_eq!((got.report.rows_kept, got.report.unknown_successors, spans(&got.transitions)), (ROWS, 2, right()));
        assert!(got.transitions.next_observations.iter().all(|x| x.is_finite()));
        assert!(got.report.to_string().contains("is not finite in 2 terminal rows"), "{}", got.report);
    }
}

#[test]
fn shifted_marks_show_in_files_without_successors_too() {
    for by in [1, -1] {
        let straight = Walks { next: None, ..Walks::new() };
        let shifted = Walks { timeouts: straight.timeouts.as_ref().map(|t| roll(t, by)), ..straight.clone() };
        let got = shifted.read();
        assert!(got.report.to_string().contains("`timeouts` contradicts the states"), "{}", got.report);
        let (a, b) = (&got.transitions, &straight.read().transitions);
        assert_eq!(spans(a)[1..19], spans(b)[1..19]);
    }
}

#[test]
fn shifted_terminals_are_told_and_used_as_they_are() {
    let mut walks = Walks { timeouts: None, ..Walks::new() };
    walks.terminals = roll(&(0..ROWS).map(|i| i % LENGTH == LENGTH - 1).collect::<Vec<_>>(), 1);
    for timeouts in [None, Some(vec![false; ROWS])] {
        let got = Walks { timeouts, ..walks.clone() }.read();
        assert!(got.report.to_string().contains("`terminals` contradicts the states"), "{}", got.report);
        assert_eq!((got.transitions.terminals, got.report.rows_kept), (walks.terminals.clone(), ROWS));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    /// With right successors and any marks: no row is lost or gets another successor, no episode crosses a break.
    #[test]
    fn right_successors_survive_any_marks(seed in 0u64..1000, share in 0.0f64..0.3, terminals in any::<bool>()) {
        let mut rng = Streams::new(seed).stream("marks");
        let mut walks = Walks::of(5, 60);
        let marks: Vec<bool> = (0..300).map(|_| rng.random_bool(share)).collect();
        *(if terminals { &mut walks.terminals } else { walks.timeouts.as_mut().unwrap() }) = marks;
        let got = walks.read();
        let t = &got.transitions;
        let next = walks.next.as_ref().unwrap();
        for i in 0..t.len() {
            let row = t.rewards[i] as usize;
            prop_assert!(!t.known[i] || t.next_observation(i) == &next[3 * row..3 * row + 3]);
        }
        for e in t.episodes() {
            for i in e.start + 1..e.end {
                prop_assert!((t.next_observation(i - 1)[0] - t.observation(i)[0]).abs() < 0.02, "row {i}");
            }
        }
        if got.report.successors == Successors::Stored {
            prop_assert!(t.len() + got.report.dropped.total() == 300);
        }
    }
}
