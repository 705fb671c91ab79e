use super::*;
use tce_nn::{cpu, host};

/// Row i: s = [i, 7], a = [-i], r = i, s' = [i + 1, 7]; three trajectories of returns 0+1, 2+3+4 and 5 (cut).
fn table() -> Transitions {
    let mut t = Transitions::new(2, 1);
    for i in 0..6 {
        let x = i as f32;
        t.push(&[x, 7.0], &[-x], x, &[x + 1.0, 7.0], i == 1, i == 4);
    }
    t
}

fn member(seed: u64, parts: Vec<Transitions>) -> Member {
    let standardizer = Standardizer::fit(&parts[0].observations, 2);
    let parts = parts.into_iter().map(Arc::new).collect();
    Member { streams: Streams::new(seed), parts, standardizer, reward_scale: 2.0, row_scores: None }
}

/// Two members that have one seed and `parts` times the same rows, of rewards that are multiplied by 1 and by 10.
pub(crate) fn of_two_scales(table: Transitions, parts: usize, batch: usize) -> Buffer {
    let table = Arc::new(table);
    let parts: Vec<_> = (0..parts).map(|_| table.clone()).collect();
    let member = |reward_scale| Member {
        streams: Streams::new(1),
        parts: parts.clone(),
        standardizer: Standardizer::identity(1),
        reward_scale,
        row_scores: None,
    };
    Buffer::new(vec![member(1.0), member(10.0)], batch).unwrap()
}

#[test]
fn rows_stay_together_and_dead_inputs_are_left_out() {
    let buffer = Buffer::new(vec![member(1, vec![table(), table()]), member(2, vec![table()])], 9).unwrap();
    assert_eq!(buffer.inputs(), [0]);
    let batch = buffer.sample(3, &cpu());
    assert_eq!((batch.s.dims(), batch.target_rows), ([2, 9, 1], 5));
    let (s, a, r, s2, nd) = (host(batch.s), host(batch.a), host(batch.r), host(batch.s2), host(batch.not_done));
    let z = &buffer.members()[0].standardizer;
    for (k, pick) in batch.picks.iter().enumerate() {
        let x = pick.row as f32;
        assert_eq!(pick.part, u32::from((5..9).contains(&k)));
        assert_eq!((a[k], r[k], nd[k]), (-x, 2.0 * x, f32::from(pick.row != 1)));
        assert_eq!((s[k], s2[k]), ((x - z.mean[0]) / z.std[0], (x + 1.0 - z.mean[0]) / z.std[0]));
    }
}

#[test]
fn kept_rows_stay_whole() {
    let buffer = Buffer::new(vec![member(1, vec![table(), table()]), member(2, vec![table(), table()])], 8).unwrap();
    let batch = buffer.sample(0, &cpu());
    let rows = [vec![0, 1, 3, 5], vec![2, 3, 6, 7]];
    let kept = batch.keep(&rows);
    assert_eq!((kept.s.dims(), kept.a.dims(), kept.target_rows), ([2, 4, 1], [2, 4, 1], 2));
    let columns = |b: &Minibatch| [&b.s, &b.a, &b.r, &b.s2, &b.not_done].map(|t| host(t.clone()));
    let (all, some) = (columns(&batch), columns(&kept));
    for (k, at) in rows.iter().enumerate().flat_map(|(m, r)| r.iter().map(move |i| 8 * m + i)).enumerate() {
        assert_eq!(kept.picks[k], batch.picks[at]);
        for (some, all) in some.iter().zip(&all) {
            assert_eq!(some[k], all[at]);
        }
    }
    assert_eq!(batch.keep(&[vec![0, 1], vec![1, 2]]).target_rows, 2, "target rows alone");
}

/// The terminal row 1 has no s'. A buffer for models never draws it; the learner's does.
#[test]
fn rows_without_a_successor_are_for_learners_alone() {
    let log = || {
        let mut t = table();
        t.known[1] = false;
        t
    };
    let rows = |parts: Vec<Transitions>| Buffer::new(vec![member(1, parts)], 600).unwrap();
    let learners = rows(vec![log(), table()]);
    let batch = learners.sample(0, &cpu());
    let expected = |first: usize| batch.picks[first..].iter().map(|pick| (pick.part, pick.row) != (0, 1));
    assert!(expected(0).any(|known| !known), "row 1 is drawn");
    assert_eq!(learners.known_from(&batch, 0), expected(0).collect::<Vec<_>>());
    let known = learners.known(&batch, 20);
    assert_eq!(known.dims(), [1, 580, 1]);
    assert_eq!(host(known), expected(20).map(f32::from).collect::<Vec<_>>());

    let models = learners.clone().with_successors().unwrap();
    let drawn = models.sample(0, &cpu());
    assert_eq!((drawn.picks.len(), drawn.target_rows), (600, 300));
    assert!(models.known_from(&drawn, 0).iter().all(|known| *known));
    // If all are known, nothing changes.
    let complete = rows(vec![table(), table()]);
    assert_eq!(complete.clone().with_successors().unwrap().sample(4, &cpu()).picks, complete.sample(4, &cpu()).picks);

    let mut none = table();
    none.known.fill(false);
    let error = rows(vec![table(), none]).with_successors().unwrap_err().to_string();
    assert!(error.contains("member 0, part 1: found 6 rows without s'"), "{error}");
}

#[test]
fn next_actions_stay_within_episodes() {
    let buffer = Buffer::new(vec![member(1, vec![table()])], 40).unwrap();
    let batch = buffer.sample(0, &cpu());
    let (actions, known) = buffer.next_actions(&batch);
    for ((pick, a), known) in batch.picks.iter().zip(host(actions)).zip(host(known)) {
        // Rows 1 and 4 end their episodes, row 5 ends the table.
        let expected = if [1, 4, 5].contains(&pick.row) { (0.0, 0.0) } else { (-(pick.row as f32) - 1.0, 1.0) };
        assert_eq!((a, known), expected, "row {}", pick.row);
    }
}

#[test]
fn a_member_draws_the_same_rows_alone() {
    let two = Buffer::new(vec![member(1, vec![table()]), member(2, vec![table()])], 4).unwrap();
    let one = Buffer::new(vec![member(2, vec![table()])], 4).unwrap();
    assert_eq!(two.sample(5, &cpu()).picks[4..], one.sample(5, &cpu()).picks);
    assert_ne!(one.sample(5, &cpu()).picks, one.sample(6, &cpu()).picks);
}

#[test]
fn bad_input_is_refused() {
    let empty = Transitions::new(2, 1);
    let other = Transitions::new(3, 1);
    for (members, batch, needle) in [
        (vec![], 4, "members"),
        (vec![member(1, vec![table(), other])], 4, "member 0, part 1"),
        (vec![member(1, vec![table(), table()])], 1, "batch"),
    ] {
        let error = Buffer::new(members, batch).unwrap_err().to_string();
        assert!(error.contains(needle), "{error}");
    }
    let mut without_target = member(1, vec![table()]);
    without_target.parts.insert(0, Arc::new(empty));
    let scored = Member { row_scores: Some(Arc::new(vec![0.0; 5])), ..member(1, vec![table(), table()]) };
    assert!(Buffer::new(vec![scored], 4).unwrap_err().to_string().contains("member 0, row_scores"));
    assert!(Buffer::new(vec![without_target], 4).unwrap_err().to_string().contains("target"));
}

#[test]
fn the_best_trajectories_are_whole_ones() {
    // Returns 1, 9 and 5.
    assert_eq!(best_trajectories(&table(), 0.1).unwrap().rewards, [2.0, 3.0, 4.0]);
    assert_eq!(best_trajectories(&table(), 0.34).unwrap().rewards, [2.0, 3.0, 4.0, 5.0]);
    assert_eq!(best_trajectories(&table(), 2.0 / 3.0).unwrap().len(), 4);
    assert_eq!(best_trajectories(&table(), 1.0).unwrap().len(), 6);
    assert!(best_trajectories(&table(), 0.0).is_err());
}

#[test]
fn rewards_scale_by_the_range_of_returns() {
    assert_eq!(return_range_scale(&[&table()]).unwrap(), 125.0);
    assert!(return_range_scale(&[&Transitions::new(1, 1)]).is_err());
}
