//! Rows that a training does not see, to tell what it is worth on others.

use tce_base::Streams;
use tce_base::random::choose;

/// Rows that follow each other and are held out together: neighbours in time are too much alike for one to test the other.
const HELD_OUT_RUN: usize = 25;

/// The part, one of `folds`, of every one of `n` rows: runs of rows are dealt out at random, as evenly as they come. The same for all seeds.
pub fn fold_of_runs(n: usize, folds: usize) -> Vec<usize> {
    let length = HELD_OUT_RUN.min(n.div_ceil(folds)).max(1);
    let runs = n.div_ceil(length);
    let mut fold = vec![0; runs];
    let mut left: Vec<usize> = (0..runs).collect();
    let mut rng = Streams::new(0).stream("folds");
    for part in 1..folds {
        let chosen = choose(&mut rng, left.len(), runs * part / folds - runs * (part - 1) / folds);
        chosen.iter().rev().for_each(|&at| fold[left.remove(at)] = part);
    }
    (0..n).map(|i| fold[i / length]).collect()
}

/// The rows of `n` to train on, and the share that is held out, in runs at random places; both ascending. The same for all seeds.
pub fn hold_out_runs(n: usize, share: f64) -> (Vec<usize>, Vec<usize>) {
    // Of a single run one half would be held out from the other.
    let length = if n > HELD_OUT_RUN { HELD_OUT_RUN } else { n.div_ceil(2).max(1) };
    let runs = n.div_ceil(length);
    // One run at least, if any; never all of them.
    let count = ((runs as f64 * share).round() as usize).max(usize::from(share > 0.0)).min(runs.saturating_sub(1));
    let chosen = choose(&mut Streams::new(0).stream("held out runs"), runs, count);
    (0..n).partition(|i| chosen.binary_search(&(i / length)).is_err())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn held_out_rows_come_in_runs_and_are_the_share() {
        let (kept, held_out) = hold_out_runs(5000, 0.05);
        assert_eq!((kept.len(), held_out.len()), (4750, 250));
        assert!(held_out.chunks(HELD_OUT_RUN).all(|run| run[0] % HELD_OUT_RUN == 0 && run[24] == run[0] + 24));
        let mut all = [kept, held_out].concat();
        all.sort_unstable();
        assert_eq!(all, (0..5000).collect::<Vec<_>>());
        assert_eq!(hold_out_runs(100, 0.0), ((0..100).collect(), vec![]));
        let (kept, held_out) = hold_out_runs(60, 0.01);
        assert!(!held_out.is_empty() && kept.len() >= 35, "at least one run, never all");
        assert_eq!(hold_out_runs(1, 0.05), (vec![0], vec![]));
        assert_eq!(hold_out_runs(0, 0.05), (vec![], vec![]));
    }

    #[test]
    fn folds_are_of_runs_and_even() {
        let folds = fold_of_runs(5000, 4);
        assert_eq!((0..4).map(|f| folds.iter().filter(|&&k| k == f).count()).collect::<Vec<_>>(), [1250; 4]);
        assert!(folds.chunks(HELD_OUT_RUN).all(|run| run.iter().all(|&f| f == run[0])));
        assert_ne!(folds[..1250], [folds[0]; 1250], "at random places");
        let few = fold_of_runs(10, 4);
        assert!((0..4).all(|f| few.contains(&f)), "{few:?}");
        assert_eq!(fold_of_runs(0, 4), Vec::<usize>::new());
    }
}
