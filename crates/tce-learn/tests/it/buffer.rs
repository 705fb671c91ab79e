//! Tests of the rows that learners draw.

use std::sync::Arc;

use rand::RngExt;
use tce_base::Streams;
use tce_data::{Standardizer, Transitions};
use tce_learn::{Buffer, Member};
use tce_nn::{cpu, host};

/// Four walks of 25 steps in two dimensions. The action is the row's number, s' is written as `stored` says. The second
/// walk's end is not marked.
fn walks(stored: fn(f32) -> f32) -> Transitions {
    let mut rng = Streams::new(3).stream("walks");
    let mut t = Transitions::new(2, 1);
    for walk in 0..4 {
        let mut s = [0; 2].map(|_| rng.random_range(-1.0f32..1.0));
        for step in 0..25 {
            let next = s.map(|x| x + rng.random_range(-0.3f32..0.3));
            let row = t.len() as f32;
            t.push(&s, &[row], 0.0, &next.map(stored), false, step == 24 && walk != 1);
            s = next;
        }
    }
    t
}

#[test]
fn next_actions_are_found_where_successors_are_rounded() {
    let rows = [("exact", walks(|x| x)), ("three digits", walks(|x| (x * 1e3).round() / 1e3))];
    for (what, rows) in rows {
        let parts = vec![Arc::new(rows)];
        let (streams, standardizer) = (Streams::new(1), Standardizer::identity(2));
        let member = Member { streams, parts, standardizer, reward_scale: 1.0, row_scores: None };
        let buffer = Buffer::new(vec![member], 1000).unwrap();
        let batch = buffer.sample(0, &cpu());
        let (actions, known) = buffer.next_actions(&batch);
        for ((pick, a), known) in batch.picks.iter().zip(host(actions)).zip(host(known)) {
            let expected = if pick.row % 25 == 24 { (0.0, 0.0) } else { (pick.row as f32 + 1.0, 1.0) };
            assert_eq!((a, known), expected, "{what}: row {}", pick.row);
        }
    }
}

#[test]
fn next_actions_of_a_replay_buffer_grow_with_it() {
    let mut buffer = Buffer::replay(Streams::new(1), (2, 1), Vec::new(), 50);
    let all = walks(|x| x);
    for rows in [10, 20] {
        *buffer.replay_mut() = all.select(&(0..rows).collect::<Vec<_>>());
        let batch = buffer.sample(0, &cpu());
        let known: f32 = host(buffer.next_actions(&batch).1).iter().sum();
        let expected = batch.picks.iter().filter(|pick| pick.row as usize + 1 < rows).count();
        assert_eq!(known, expected as f32, "{rows} rows");
    }
}
