//! The permutation test: how often chance alone tells two methods as far apart as they are.

use std::collections::BTreeMap;

use rand::RngExt;
use rayon::prelude::*;
use tce_base::Streams;

use crate::stats::{Scores, StatsError, probability_of_improvement};

/// Assignments of a task's runs that are counted one by one, at most: two methods with ten runs each have 184 756.
const COUNTED: u64 = 200_000;

/// How often a random assignment of a task's runs to the two methods gives a probability of improvement as far from one half as
/// the true one: a stratified permutation test, two-sided. All assignments are counted; where a task has more than 200 000, random
/// ones are, `shuffles` of them. With few runs it cannot become small, whereas a bootstrap's interval can shrink to a point.
///
/// # Errors
/// If the two are not on equally many tasks.
pub fn permutation_p(streams: Streams, name: &str, shuffles: usize, x: &Scores, y: &Scores) -> Result<f64, StatsError> {
    if x.tasks.len() != y.tasks.len() {
        return Err(StatsError::OtherTasks { found: y.tasks.len(), expected: x.tasks.len() });
    }
    Ok(counted_p(x, y).unwrap_or_else(|| shuffled_p(streams, name, shuffles, x, y)))
}

/// Twice Mann-Whitney's U of `a` over `b`: two for every pair that `a` wins, one for a tie.
fn twice_u(a: &[f64], b: &[f64]) -> u64 {
    let pair = |s: f64, t: f64| if s == t { 1 } else { 2 * u64::from(s > t) };
    a.iter().flat_map(|&s| b.iter().map(move |&t| pair(s, t))).sum()
}

fn greatest_common_divisor(a: u64, b: u64) -> u64 {
    if b == 0 { a } else { greatest_common_divisor(b, a % b) }
}

/// The exact p, from whole numbers; None where there are too many assignments.
fn counted_p(x: &Scores, y: &Scores) -> Option<f64> {
    // A probability of improvement is twice U over twice the number of pairs; all tasks' get one denominator.
    let pairs = |(a, b): (&Vec<f64>, &Vec<f64>)| 2 * (a.len() * b.len()) as u64;
    let common = |all: u64, d: u64| (all / greatest_common_divisor(all, d)).checked_mul(d).filter(|c| *c < 1 << 40);
    let tasks = || x.tasks.iter().zip(&y.tasks);
    let denominator = tasks().map(pairs).try_fold(1, common)?;
    // Of every sum over the tasks done so far, its share among all assignments.
    let mut sums = BTreeMap::from([(0u64, 1.0f64)]);
    for (a, b) in tasks() {
        let of_task = assignments(a, b)?;
        let scale = denominator / pairs((a, b));
        let mut next = BTreeMap::new();
        for (sum, share) in &sums {
            for (u, of_all) in &of_task {
                *next.entry(sum + scale * u).or_insert(0.0) += share * of_all;
            }
        }
        sums = next;
    }
    // The distance of a sum from one half in every task, twice.
    let middle = denominator * x.tasks.len() as u64;
    let distance = |sum: u64| (2 * sum).abs_diff(middle);
    let observed = distance(tasks().map(|(a, b)| denominator / pairs((a, b)) * twice_u(a, b)).sum());
    Some(sums.iter().filter(|(sum, _)| distance(**sum) >= observed).map(|(_, share)| share).sum::<f64>().min(1.0))
}

/// The values of [`twice_u`] over all assignments of the runs of `a` and `b`, with their shares; None if there are too many.
fn assignments(a: &[f64], b: &[f64]) -> Option<BTreeMap<u64, f64>> {
    let all: Vec<f64> = a.iter().chain(b).copied().collect();
    let (n, k) = (all.len() as u64, a.len() as u64);
    let count = (0..k).try_fold(1u64, |c, i| Some(c.checked_mul(n - i)? / (i + 1)).filter(|c| *c <= COUNTED))?;
    let mut out = BTreeMap::new();
    let mut chosen: Vec<usize> = (0..a.len()).collect();
    loop {
        let (mut first, mut rest) = (Vec::with_capacity(a.len()), Vec::with_capacity(b.len()));
        let mut next = chosen.iter().peekable();
        for (i, &score) in all.iter().enumerate() {
            if next.next_if(|c| **c == i).is_some() { first.push(score) } else { rest.push(score) }
        }
        *out.entry(twice_u(&first, &rest)).or_insert(0.0) += 1.0 / count as f64;
        // The next choice in lexical order: the last place that can go up does, and those behind it follow.
        let Some(place) = (0..chosen.len()).rev().find(|&i| chosen[i] < all.len() - chosen.len() + i) else {
            return Some(out);
        };
        chosen[place] += 1;
        (place + 1..chosen.len()).for_each(|i| chosen[i] = chosen[i - 1] + 1);
    }
}

/// The share of random assignments that are as far, the true one among them.
fn shuffled_p(streams: Streams, name: &str, shuffles: usize, x: &Scores, y: &Scores) -> f64 {
    let distance = |x: &Scores, y: &Scores| (probability_of_improvement(x, y) - 0.5).abs();
    let observed = distance(x, y);
    let one = |k: usize| {
        let mut rng = streams.indexed(&format!("report/permutation/{name}"), k as u64);
        let (mut a, mut b) = (x.clone(), y.clone());
        for (a, b) in a.tasks.iter_mut().zip(&mut b.tasks) {
            let mut all: Vec<f64> = a.iter().chain(b.iter()).copied().collect();
            // The first places of a Fisher-Yates shuffle are a's.
            for place in 0..a.len() {
                let from = rng.random_range(place..all.len());
                all.swap(place, from);
            }
            let (first, rest) = all.split_at(a.len());
            a.copy_from_slice(first);
            b.copy_from_slice(rest);
        }
        usize::from(distance(&a, &b) >= observed - 1e-12)
    };
    let as_far: usize = (0..shuffles).into_par_iter().map(one).sum();
    (as_far + 1) as f64 / (shuffles + 1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two runs against two, all above: 2 of the 6 assignments are as far. Five against five: 2 of 252.
    #[test]
    fn permutations_are_counted() {
        let of = |n: u32, from: u32| Scores::new(vec![(from..from + n).map(f64::from).collect()]).unwrap();
        let p = |x: &Scores, y: &Scores| permutation_p(Streams::new(0), "test", 20_000, x, y).unwrap();
        assert!((p(&of(2, 100), &of(2, 0)) - 2.0 / 6.0).abs() < 1e-12);
        assert!((p(&of(5, 100), &of(5, 0)) - 2.0 / 252.0).abs() < 1e-12);
        // One run against 38, below all of them: 2 of 39 places, more than a twentieth.
        assert!((p(&of(1, 0), &of(38, 1)) - 2.0 / 39.0).abs() < 1e-12);
        // Two tasks: all above in both is 1 of 36, all below as far.
        let twice = |from: u32| Scores::new(vec![of(2, from).tasks.remove(0), of(2, from).tasks.remove(0)]).unwrap();
        assert!((p(&twice(100), &twice(0)) - 2.0 / 36.0).abs() < 1e-12);
        let same = Scores::new(vec![vec![1.0, 2.0, 5.0], vec![3.0, 4.0]]).unwrap();
        assert!((p(&same, &same) - 1.0).abs() < 1e-12);
        // Too many to count: 30 against 30.
        assert!(p(&of(30, 100), &of(30, 0)) < 1e-3);
    }

    /// Counted and shuffled, ties and unequal numbers of runs included.
    #[test]
    fn counting_and_shuffling_agree() {
        let x = Scores::new(vec![vec![1.0, 2.0, 2.0], vec![5.0, 7.0], vec![3.0]]).unwrap();
        let y = Scores::new(vec![vec![2.0, 0.0], vec![5.0, 5.0, 6.0], vec![1.0, 4.0]]).unwrap();
        let (counted, shuffled) = (counted_p(&x, &y).unwrap(), shuffled_p(Streams::new(1), "test", 50_000, &x, &y));
        assert!((counted - shuffled).abs() < 0.01, "{counted} {shuffled}");
    }
}
