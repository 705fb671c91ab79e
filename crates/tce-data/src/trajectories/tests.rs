use proptest::prelude::*;
use rand::RngExt;
use tce_base::Streams;

use super::*;

/// How a trajectory ends.
#[derive(Clone, Copy, Debug, PartialEq)]
enum End {
    Fall,
    Limit,
}

/// Trajectories of (rows, reward per step, end). Rewards rise over the first 50 rows and vary a little from row to row.
fn data(trajectories: &[(usize, f32, End)], seed: u64) -> Transitions {
    let mut rng = Streams::new(seed).stream("rewards");
    let mut t = Transitions::new(1, 1);
    for &(rows, reward, end) in trajectories {
        for i in 0..rows {
            let r = reward * ((i + 1) as f32 / 50.0).min(1.0) * rng.random_range(0.98f32..1.02);
            let last = i + 1 == rows;
            t.push(&[0.0], &[0.0], r, &[0.0], last && end == Fall, last && end == Limit);
        }
    }
    t
}

fn kept(choice: &Choice, t: &Transitions) -> Vec<usize> {
    let all = t.episodes();
    choice.episodes.iter().map(|e| all.iter().position(|a| a == e).unwrap()).collect()
}

use End::{Fall, Limit};

#[test]
fn the_better_of_two_qualities_is_chosen_and_told() {
    let t = data(
        &[(1000, 1.3, Limit), (1000, 3.1, Limit), (1000, 1.31, Limit), (1000, 3.15, Limit), (1000, 3.2, Limit)],
        1,
    );
    let c = choose_trajectories(&t);
    assert_eq!(kept(&c, &t), [1, 3, 4]);
    assert_eq!((c.rows.len(), c.rows[0], c.rows[1000]), (3000, 1000, 3000));
    assert!(c.is_selective() && matches!(c.threshold, Some((Measure::Pace, x)) if x > 1.5 && x < 3.0));
    assert!(c.reason.starts_with("Two of five trajectories return 12"), "{}", c.reason);
    assert!(c.reason.ends_with(": learned from the better three (3000 of 5000 rows)."), "{}", c.reason);
    assert!(!choose_trajectories_with(&t, f64::INFINITY).is_selective());
}

/// Reward for not falling, always the same pace: only the return separates, and one early fall is an accident.
#[test]
fn falls_tell_where_the_pace_does_not() {
    let t = data(&[(410, 1.0, Fall), (400, 1.0, Fall), (1000, 1.0, Limit), (1000, 1.0, Limit), (300, 1.0, Limit)], 2);
    let c = choose_trajectories(&t);
    // The last one was cut too early to be judged, so it is kept.
    assert_eq!(kept(&c, &t)[..2], [2, 3]);
    assert!(matches!(c.threshold, Some((Measure::Return, _))), "{}", c.reason);
    let t = data(&[(400, 1.0, Fall), (1000, 1.0, Limit), (1000, 1.01, Limit), (1000, 0.99, Limit)], 3);
    assert!(!choose_trajectories(&t).is_selective());
}

/// The paces of equal trajectories differ by chance. Falls that are too short for a pace must not make that a split.
#[test]
fn falls_do_not_divide_equal_trajectories() {
    for (long, falls, rows) in [(4, 40, 15), (10, 100, 20), (10, 100, 300), (3, 30, 240)] {
        let mut trajectories = vec![(1000, 1.0, Limit); long];
        trajectories.extend(vec![(rows, 1.0, Fall); falls]);
        let t = data(&trajectories, 10);
        let c = choose_trajectories(&t);
        assert_eq!(kept(&c, &t), (0..long).collect::<Vec<_>>(), "{}", c.reason);
        assert!(matches!(c.threshold, Some((Measure::Return, _))), "{}", c.reason);
    }
}

/// Three even trajectories and three with an outburst return as much, at another pace: the falls beside them are what
/// lowers the mean return of the slower group.
#[test]
fn falls_do_not_make_the_difference_between_equal_returns() {
    for falls in [0, 1, 40] {
        let mut trajectories = vec![(1000, 1.0, Limit); 6];
        trajectories.extend(vec![(15, 1.0, Fall); falls]);
        let mut t = data(&trajectories, 11);
        for (i, reward) in t.rewards[..6000].iter_mut().enumerate() {
            let outburst = (400..600).contains(&(i % 1000));
            *reward = if i < 3000 { 1.0 } else { 0.79 + f32::from(u8::from(outburst)) };
        }
        let c = choose_trajectories(&t);
        // A single fall is an accident; many are a behaviour.
        let all = if falls == 1 { 7 } else { 6 };
        assert_eq!(kept(&c, &t), (0..all).collect::<Vec<_>>(), "{}", c.reason);
    }
}

#[test]
fn a_cut_trajectory_is_ranked_by_its_age() {
    for (reward, keep) in [(1.0, false), (3.0, true)] {
        for rows in [30, 100, 300, 800] {
            let t = data(
                &[
                    (1000, 1.0, Limit),
                    (1000, 1.05, Limit),
                    (1000, 3.0, Limit),
                    (1000, 3.1, Limit),
                    (rows, reward, Limit),
                ],
                4,
            );
            let c = choose_trajectories(&t);
            assert_eq!(kept(&c, &t), if keep { vec![2, 3, 4] } else { vec![2, 3] }, "{rows} {reward}: {}", c.reason);
        }
    }
}

#[test]
fn one_quality_is_kept_whole() {
    for trajectories in [
        vec![],
        vec![(500, 1.0, Limit)],
        vec![(1000, 1.0, Limit); 5],
        // Falls at any time.
        vec![(300, 3.0, Fall), (460, 3.3, Fall), (700, 3.2, Fall), (1000, 2.9, Limit), (200, 3.0, Limit)],
        // Costs that hardly differ.
        vec![(1000, -1.0, Limit), (1000, -1.05, Limit), (1000, -1.1, Limit)],
        // Continuously rising quality, as in a replay buffer.
        (1..40).map(|i| (1000, i as f32, Limit)).collect(),
    ] {
        let t = data(&trajectories, 5);
        let c = choose_trajectories(&t);
        assert!(!c.is_selective(), "{}", c.reason);
        assert_eq!((c.rows.len(), c.episodes.len()), (t.len(), trajectories.len()));
        assert!(c.reason.contains("kept"), "{}", c.reason);
    }
    let mut broken = data(&[(1000, 1.0, Limit), (1000, 3.0, Limit)], 6);
    broken.rewards[10] = f32::NAN;
    assert!(!choose_trajectories(&broken).is_selective());
}

#[test]
fn costs_are_rewards_too() {
    let t = data(&[(1000, -3.0, Limit), (1000, -1.0, Limit), (1000, -3.1, Limit), (1000, -1.02, Limit)], 7);
    assert_eq!(kept(&choose_trajectories(&t), &t), [1, 3]);
}

#[test]
fn too_few_good_rows_are_not_learned_from_alone() {
    let t = data(&[(200, 1.0, Limit), (200, 1.0, Limit), (200, 1.01, Limit), (200, 3.0, Limit), (200, 3.0, Limit)], 8);
    let c = choose_trajectories(&t);
    assert_eq!(c.reason, "All five trajectories are kept: the better ones have only 400 rows, fewer than 500.");
    assert_eq!(c.rows.len(), 1000);
}

/// A thousand episodes with some outliers in both groups: without the outer tenth, the gap is still found.
#[test]
fn outliers_do_not_hide_two_qualities_of_many() {
    let mut trajectories = Vec::new();
    for i in 0..200 {
        trajectories.push((100, if i % 25 == 0 { 2.0 } else { 1.0 + 0.001 * i as f32 }, Limit));
        trajectories.push((100, if i % 25 == 0 { 2.2 } else { 3.0 + 0.001 * i as f32 }, Limit));
    }
    let t = data(&trajectories, 9);
    let c = choose_trajectories(&t);
    assert!(c.is_selective() && (c.episodes.len() as i64 - 200).abs() <= 10, "{}", c.reason);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    /// Two clear qualities, in any order and any unit of reward: exactly the better ones are chosen, whole and in
    /// order.
    #[test]
    fn two_clear_qualities_in_any_order(
        qualities in prop::collection::vec(any::<bool>(), 2..8), unit in prop_oneof![Just(1f32), Just(1e-3), Just(1e4)], seed in 0u64..100,
    ) {
        prop_assume!(qualities.contains(&true) && qualities.contains(&false));
        let rows = |&q: &bool| (if q { 1000 } else { 700 }, unit * if q { 3.0 } else { 2.0 }, if q { Limit } else { Fall });
        let t = data(&qualities.iter().map(rows).collect::<Vec<_>>(), seed);
        let c = choose_trajectories(&t);
        let good: Vec<usize> = (0..qualities.len()).filter(|&k| qualities[k]).collect();
        prop_assert_eq!(kept(&c, &t), good, "{}", c.reason);
        let rows: Vec<usize> = c.episodes.iter().flat_map(|e| e.start..e.end).collect();
        prop_assert_eq!(rows, c.rows);
    }

    /// For any rewards: the best whole trajectory is kept, rows form whole trajectories, the reason is a sentence.
    #[test]
    fn the_best_is_always_kept(
        trajectories in prop::collection::vec((1usize..400, -3f32..3.0, any::<bool>()), 1..10), seed in 0u64..100,
    ) {
        let t = data(&trajectories.iter().map(|&(n, r, f)| (n, r, if f { Fall } else { Limit })).collect::<Vec<_>>(), seed);
        let c = choose_trajectories(&t);
        prop_assert!(!c.rows.is_empty() && c.reason.ends_with('.'));
        prop_assert_eq!(c.rows.len(), c.episodes.iter().map(|e| e.end - e.start).sum::<usize>());
        if c.is_selective() {
            prop_assert!(c.rows.len() >= ENOUGH_ROWS && c.rows.len() < t.len());
            let mean = |keep: bool| {
                let of: Vec<f64> = measure(&t).iter().filter(|x| c.episodes.contains(&x.episode) == keep).filter_map(|x| x.whole).collect();
                mean(&of)
            };
            if let (Some(good), Some(bad)) = (mean(true), mean(false)) {
                prop_assert!(good > bad);
            }
        }
    }
}
