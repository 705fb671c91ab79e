//! Statistics of scores over tasks and seeds, as Agarwal et al. (2021) and their package `rliable` define them.
//!
//! Two things go beyond `rliable`, which knows only full matrices:
//!
//! - **Tasks may have different numbers of runs.** Every task has the same weight, and a run the share of its task's weight. With
//!   equal numbers all figures are those of `rliable`; so is the interquartile mean where the number of runs is a multiple of four
//!   ([`Scores::iqm`]).
//! - **A resample of tasks is shared.** Where two methods are compared and tasks are drawn, both get the same tasks.

use rand::RngExt;
use rayon::prelude::*;
use serde::Serialize;
use tce_base::{Rng, Streams};

/// The scores of one method: for every task, the scores of its runs.
#[derive(Clone, Debug, PartialEq)]
pub struct Scores {
    pub(crate) tasks: Vec<Vec<f64>>,
}

/// Scores that nothing can be said about.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StatsError {
    /// There is no task.
    #[error("found no tasks, expected scores of at least one")]
    NoTasks,
    /// A task without runs.
    #[error("task {task}: found no scores, expected at least one; leave the task out of the comparison")]
    NoRuns {
        /// The task's place.
        task: usize,
    },
    /// A score that is no number.
    #[error("task {task}: found the score {score}, expected a finite number")]
    NotFinite {
        /// The task's place.
        task: usize,
        /// The score.
        score: f64,
    },
    /// Methods on different tasks.
    #[error("found {found} and {expected} tasks, expected the same tasks for both methods")]
    OtherTasks {
        /// Of one method.
        found: usize,
        /// Of the other.
        expected: usize,
    },
}

impl Scores {
    /// Scores by task; every task needs one, all of them finite.
    ///
    /// # Errors
    /// If there is no task, a task without runs, or a score that is no number.
    pub fn new(tasks: Vec<Vec<f64>>) -> Result<Self, StatsError> {
        if tasks.is_empty() {
            return Err(StatsError::NoTasks);
        }
        for (task, scores) in tasks.iter().enumerate() {
            if scores.is_empty() {
                return Err(StatsError::NoRuns { task });
            }
            if let Some(&score) = scores.iter().find(|s| !s.is_finite()) {
                return Err(StatsError::NotFinite { task, score });
            }
        }
        Ok(Self { tasks })
    }

    /// The scores by task.
    pub fn tasks(&self) -> &[Vec<f64>] {
        &self.tasks
    }

    /// Runs in all.
    pub fn runs(&self) -> usize {
        self.tasks.iter().map(Vec::len).sum()
    }

    /// Mean over runs, by task.
    pub fn task_means(&self) -> impl Iterator<Item = f64> + '_ {
        self.tasks.iter().map(|t| mean_of(t.iter().copied()))
    }

    /// Mean over tasks of the mean over runs of `f(score)`.
    fn average(&self, f: impl Fn(f64) -> f64) -> f64 {
        mean_of(self.tasks.iter().map(|t| mean_of(t.iter().map(|&s| f(s)))))
    }

    /// Mean over tasks of the mean over runs.
    pub fn mean(&self) -> f64 {
        self.average(|s| s)
    }

    /// Sum over tasks of the mean over runs: the paper's total score.
    pub fn total(&self) -> f64 {
        self.task_means().sum()
    }

    /// Median over tasks of the mean over runs.
    pub fn median(&self) -> f64 {
        let mut means: Vec<f64> = self.task_means().collect();
        means.sort_by(f64::total_cmp);
        quantile(&means, 0.5)
    }

    /// Mean shortfall from `gamma`: 0 if every run reaches it.
    pub fn optimality_gap(&self, gamma: f64) -> f64 {
        gamma - self.average(|s| s.min(gamma))
    }

    /// Share of runs with a score above `threshold`: the performance profile's value there.
    pub fn share_above(&self, threshold: f64) -> f64 {
        self.average(|s| f64::from(u8::from(s > threshold)))
    }

    /// Interquartile mean: the mean of the middle half of all runs' weight. A run on the border of the half counts with the part of its
    /// weight that is inside, so that methods with different numbers of runs are cut alike. `rliable` and scipy leave out whole runs,
    /// `floor(N / 4)` on either side: the same where N is a multiple of four and all tasks have equally many runs.
    pub fn iqm(&self) -> f64 {
        let tasks = self.tasks.len() as f64;
        let mut runs: Vec<(f64, f64)> = Vec::with_capacity(self.runs());
        for task in &self.tasks {
            let weight = 1.0 / (tasks * task.len() as f64);
            runs.extend(task.iter().map(|&s| (s, weight)));
        }
        runs.sort_by(|a, b| a.0.total_cmp(&b.0));
        // What is left of a weight that covers [from, from + weight] of [0, 1] within the middle half.
        let (mut from, mut sum, mut left) = (0.0, 0.0, 0.0);
        for (score, weight) in runs {
            let to = from + weight;
            let inside = (to.min(0.75) - from.max(0.25)).max(0.0);
            // The sum of weights is 1 up to rounding: a sliver at a border is none of the middle half.
            if inside > 1e-9 * weight {
                sum += inside * score;
                left += inside;
            }
            from = to;
        }
        sum / left
    }

    /// As many runs, drawn with replacement within every task; `order` tells which task stands in each place.
    fn resample(&self, order: Option<&[usize]>, rng: &mut Rng) -> Self {
        let of =
            |task: &Vec<f64>, rng: &mut Rng| (0..task.len()).map(|_| task[rng.random_range(0..task.len())]).collect();
        let tasks = match order {
            None => self.tasks.iter().map(|t| of(t, rng)).collect(),
            Some(order) => order.iter().map(|&k| of(&self.tasks[k], rng)).collect(),
        };
        Self { tasks }
    }
}

/// Mean over tasks of the probability that a run of `x` scores higher than a run of `y`, a tie counting one half
/// (Mann-Whitney's U over the number of pairs).
///
/// # Panics
/// If the two are not on the same tasks.
pub fn probability_of_improvement(x: &Scores, y: &Scores) -> f64 {
    assert_eq!(x.tasks.len(), y.tasks.len(), "methods are compared on the same tasks");
    let task = |(a, b): (&Vec<f64>, &Vec<f64>)| {
        let wins = a.iter().flat_map(|s| b.iter().map(move |t| (s, t))).map(|(s, t)| match s.total_cmp(t) {
            _ if s == t => 0.5,
            std::cmp::Ordering::Greater => 1.0,
            _ => 0.0,
        });
        wins.sum::<f64>() / (a.len() * b.len()) as f64
    };
    mean_of(x.tasks.iter().zip(&y.tasks).map(task))
}

/// A figure and the interval that resampling gives it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// The figure of the runs as they are.
    pub point: f64,
    /// The interval; none where no task has more than one run, because then resampling has nothing to draw from.
    pub interval: Option<(f64, f64)>,
}

impl Estimate {
    /// `61.7 [57.2, 65.9]`, or without the interval where there is none.
    pub fn told(&self, decimals: usize) -> String {
        match self.interval {
            Some((low, high)) => format!("{:.decimals$} [{low:.decimals$}, {high:.decimals$}]", self.point),
            None => format!("{:.decimals$}", self.point),
        }
    }
}

/// What is drawn anew.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Draw {
    /// Runs within every task: what other seeds would have given on these tasks (`rliable`'s default).
    Runs,
    /// Tasks, and runs within them: what other tasks of this kind would have given, too (`rliable`'s `task_bootstrap`).
    TasksAndRuns,
}

/// The stratified bootstrap with percentile intervals.
#[derive(Clone, Copy, Debug)]
pub struct Bootstrap {
    /// Where the draws come from.
    pub streams: Streams,
    /// Resamples.
    pub resamples: usize,
    /// The intervals' coverage, 0.95 say.
    pub level: f64,
}

impl Bootstrap {
    /// `statistics` of `samples` with intervals. Every sample is drawn on its own, tasks are drawn once for all of them. The draws
    /// depend on `name` and the resample's number, and on nothing else.
    ///
    /// # Errors
    /// If the samples are not on equally many tasks.
    pub fn intervals(
        &self,
        name: &str,
        draw: Draw,
        samples: &[&Scores],
        statistics: impl Fn(&[&Scores]) -> Vec<f64> + Sync,
    ) -> Result<Vec<Estimate>, StatsError> {
        let tasks = samples.first().map_or(0, |s| s.tasks.len());
        if let Some(other) = samples.iter().find(|s| s.tasks.len() != tasks) {
            return Err(StatsError::OtherTasks { found: other.tasks.len(), expected: tasks });
        }
        let points = statistics(samples);
        let several = samples.iter().any(|s| s.tasks.iter().any(|t| t.len() > 1));
        if !(several || draw == Draw::TasksAndRuns && tasks > 1) {
            return Ok(points.into_iter().map(|point| Estimate { point, interval: None }).collect());
        }
        let one = |k: usize| {
            let mut rng = self.streams.indexed(&format!("report/bootstrap/{name}"), k as u64);
            let order: Option<Vec<usize>> =
                (draw == Draw::TasksAndRuns).then(|| (0..tasks).map(|_| rng.random_range(0..tasks)).collect());
            let drawn: Vec<Scores> = samples.iter().map(|s| s.resample(order.as_deref(), &mut rng)).collect();
            statistics(&drawn.iter().collect::<Vec<_>>())
        };
        let replicates: Vec<Vec<f64>> = (0..self.resamples.max(1)).into_par_iter().map(one).collect();
        let tail = (1.0 - self.level) / 2.0;
        let estimate = |(k, point): (usize, f64)| {
            let mut column: Vec<f64> = replicates.iter().map(|r| r[k]).collect();
            column.sort_by(f64::total_cmp);
            Estimate { point, interval: Some((quantile(&column, tail), quantile(&column, 1.0 - tail))) }
        };
        Ok(points.into_iter().enumerate().map(estimate).collect())
    }
}

pub(crate) fn mean_of(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let n = values.len() as f64;
    values.sum::<f64>() / n
}

/// The quantile of ascending values with linear interpolation (numpy's default).
pub fn quantile(ascending: &[f64], q: f64) -> f64 {
    let place = q * (ascending.len() - 1) as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(ascending.len() - 1);
    ascending[below] + (place - below as f64) * (ascending[above] - ascending[below])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Five seeds of four tasks, by seed.
    const X: [[f64; 4]; 5] = [
        [44.1, 12.9, 83.2, 61.4],
        [43.7, 29.1, 58.8, 60.2],
        [44.5, 10.2, 73.4, 71.9],
        [42.0, 17.6, 85.0, 55.5],
        [44.1, 35.4, -0.7, 63.8],
    ];
    /// Three seeds of the same tasks.
    const Y: [[f64; 4]; 3] = [[44.0, 33.1, 61.7, 38.6], [38.5, 12.9, 76.2, 41.3], [43.9, 59.8, 64.3, 41.8]];

    fn by_task<const N: usize>(by_seed: &[[f64; N]]) -> Scores {
        Scores::new((0..N).map(|t| by_seed.iter().map(|s| s[t]).collect()).collect()).unwrap()
    }

    fn bootstrap(resamples: usize) -> Bootstrap {
        Bootstrap { streams: Streams::new(0), resamples, level: 0.95 }
    }

    fn aggregates(s: &[&Scores]) -> Vec<f64> {
        vec![s[0].iqm(), s[0].mean(), s[0].median(), s[0].optimality_gap(100.0)]
    }

    /// `rliable` 1.2.0 (numpy 2.4.6, scipy 1.17.1): `metrics.aggregate_iqm`, `aggregate_mean`, `aggregate_median`,
    /// `aggregate_optimality_gap(gamma=100)` and `probability_of_improvement`.
    #[test]
    fn point_estimates_are_those_of_rliable() {
        for (scores, expected, total) in [
            (by_task(&X), [48.97, 46.805, 51.81, 53.195], 187.22),
            (by_task(&Y), [44.9, 46.341_666_666_666_67, 41.35, 53.658_333_333_333_33], 185.366_666_666_666_67),
        ] {
            for (found, expected) in aggregates(&[&scores]).into_iter().zip(expected) {
                assert!((found - expected).abs() < 1e-12, "found {found}, expected {expected}");
            }
            assert!((scores.total() - total).abs() < 1e-12);
        }
        let found = probability_of_improvement(&by_task(&X), &by_task(&Y));
        assert!((found - 0.641_666_666_666_666_6).abs() < 1e-15, "{found}");
    }

    fn close(found: &[Estimate], expected: &[(f64, f64)], tolerance: f64) {
        for (found, expected) in found.iter().zip(expected) {
            let (low, high) = found.interval.unwrap();
            assert!(
                (low - expected.0).abs() < tolerance && (high - expected.1).abs() < tolerance,
                "found {low}..{high}, expected {expected:?}"
            );
        }
    }

    /// `rliable.library.get_interval_estimates(..., reps=50000)` with and without `task_bootstrap`, its percentile method. Both
    /// sides have a Monte-Carlo error; the scores' few distinct values make the quantiles jump.
    #[test]
    fn intervals_are_those_of_rliable() {
        let (x, y) = (by_task(&X), by_task(&Y));
        let of = |draw, scores| bootstrap(20_000).intervals("test", draw, &[scores], aggregates).unwrap();
        let runs = [(40.88, 53.97), (38.685, 53.01), (36.05, 54.97), (46.99, 61.315)];
        close(&of(Draw::Runs, &x), &runs, 0.35);
        let runs = [(40.0, 51.433), (40.8, 52.225), (39.9, 50.95), (47.775, 59.2)];
        close(&of(Draw::Runs, &y), &runs, 0.35);
        let both = [(24.499, 66.93), (28.78, 63.87), (22.66, 65.27), (36.13, 71.22)];
        close(&of(Draw::TasksAndRuns, &x), &both, 0.7);
        let both = [(34.933, 63.433), (33.858, 60.733), (34.1, 65.417), (39.267, 66.142)];
        close(&of(Draw::TasksAndRuns, &y), &both, 0.7);
        let improvement = |s: &[&Scores]| vec![probability_of_improvement(s[0], s[1])];
        let found = bootstrap(20_000).intervals("test", Draw::Runs, &[&x, &y], improvement).unwrap();
        close(&found, &[(0.466_666_7, 0.816_666_7)], 0.011);
    }

    /// `rliable.library.create_performance_profile(..., reps=2000)` at four thresholds.
    #[test]
    fn profiles_are_those_of_rliable() {
        let of = |s: &[&Scores]| [0.0, 25.0, 50.0, 75.0].map(|t| s[0].share_above(t)).to_vec();
        let x = bootstrap(5000).intervals("test", Draw::Runs, &[&by_task(&X)], of).unwrap();
        for (found, expected) in x.iter().zip([0.95, 0.8, 0.45, 0.1]) {
            assert!((found.point - expected).abs() < 1e-12);
        }
        close(&x, &[(0.85, 1.0), (0.65, 0.95), (0.35, 0.5), (0.0, 0.2)], 0.051);
        let y = bootstrap(5000).intervals("test", Draw::Runs, &[&by_task(&Y)], of).unwrap();
        for (found, expected) in y.iter().zip([1.0, 11.0 / 12.0, 1.0 / 3.0, 1.0 / 12.0]) {
            assert!((found.point - expected).abs() < 1e-12);
        }
        close(&y, &[(1.0, 1.0), (0.75, 1.0), (0.25, 0.5), (0.0, 0.25)], 0.084);
    }

    /// The middle half of the weight: nine runs of 1, 3, ..., 17 keep 7, 9, 11 and three quarters of 5 and 13. Of a multiple of four it is
    /// scipy.stats.trim_mean(range, 0.25).
    #[test]
    fn the_interquartile_mean_is_of_exactly_the_middle_half() {
        let of = |scores: Vec<f64>| Scores::new(vec![scores]).unwrap().iqm();
        assert!((of((0..9).map(|k| f64::from(2 * k + 1)).collect()) - 9.0).abs() < 1e-12);
        for (n, expected) in [(1, 0.0), (2, 0.5), (3, 1.0), (4, 1.5), (8, 3.5)] {
            assert!((of((0..n).map(f64::from).collect()) - expected).abs() < 1e-12, "{n}");
        }
        // Three runs: half of the weight is the middle one and a quarter of each of the others.
        assert!((of(vec![0.0, 30.0, 90.0]) - (0.25 * 0.0 + 30.0 + 0.25 * 90.0) / 1.5).abs() < 1e-9);
        // As many runs twice change nothing, however many there are.
        assert!((of(vec![0.0, 30.0, 90.0]) - of(vec![0.0, 0.0, 30.0, 30.0, 90.0, 90.0])).abs() < 1e-9);
        // [0, 0, 9, 30, 100, 1000]: half of the second and of the fifth run are outside.
        let scores = Scores::new(vec![vec![30.0, 0.0, 9.0], vec![1000.0, 0.0, 100.0]]).unwrap();
        assert!((scores.iqm() - (0.5 * 0.0 + 9.0 + 30.0 + 0.5 * 100.0) / 3.0).abs() < 1e-9);
    }

    #[test]
    fn a_task_with_more_runs_counts_no_more() {
        let few = Scores::new(vec![vec![0.0], vec![60.0]]).unwrap();
        let many = Scores::new(vec![vec![0.0; 9], vec![60.0]]).unwrap();
        assert_eq!((few.mean(), many.mean()), (30.0, 30.0));
        assert!((many.iqm() - 30.0).abs() < 1e-9, "{}", many.iqm());
        assert!((many.optimality_gap(100.0) - few.optimality_gap(100.0)).abs() < 1e-12);
    }

    #[test]
    fn a_single_run_a_task_has_no_interval() {
        let scores = Scores::new(vec![vec![1.0], vec![2.0]]).unwrap();
        let found = bootstrap(50).intervals("test", Draw::Runs, &[&scores], aggregates).unwrap();
        assert!(found.iter().all(|e| e.interval.is_none()));
        let found = bootstrap(50).intervals("test", Draw::TasksAndRuns, &[&scores], aggregates).unwrap();
        assert!(found.iter().all(|e| e.interval.is_some()));
    }

    #[test]
    fn nonsense_is_refused() {
        assert_eq!(Scores::new(vec![]), Err(StatsError::NoTasks));
        assert_eq!(Scores::new(vec![vec![1.0], vec![]]), Err(StatsError::NoRuns { task: 1 }));
        let message = Scores::new(vec![vec![f64::NAN]]).unwrap_err().to_string();
        assert!(message.contains("NaN") && message.contains("finite"), "{message}");
        let (a, b) = (Scores::new(vec![vec![1.0]]).unwrap(), Scores::new(vec![vec![1.0], vec![2.0]]).unwrap());
        assert!(bootstrap(5).intervals("test", Draw::Runs, &[&a, &b], |_| vec![]).is_err());
    }

    fn tables() -> impl Strategy<Value = Vec<Vec<f64>>> {
        prop::collection::vec(prop::collection::vec(-50.0..150.0f64, 1..7), 1..8)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn aggregates_lie_between_the_extremes(tasks in tables()) {
            let all: Vec<f64> = tasks.iter().flatten().copied().collect();
            let (low, high) = all.iter().fold((f64::MAX, f64::MIN), |(l, h), &s| (l.min(s), h.max(s)));
            let scores = Scores::new(tasks).unwrap();
            for value in [scores.iqm(), scores.mean(), scores.median()] {
                prop_assert!(value >= low - 1e-9 && value <= high + 1e-9);
            }
            prop_assert!(scores.optimality_gap(100.0) >= 0.0);
            prop_assert_eq!(scores.share_above(low - 1.0), 1.0);
            prop_assert_eq!(scores.share_above(high), 0.0);
        }

        #[test]
        fn the_order_of_tasks_and_seeds_does_not_matter(tasks in tables()) {
            let scores = Scores::new(tasks.clone()).unwrap();
            let turned = tasks.into_iter().rev().map(|t| t.into_iter().rev().collect()).collect();
            let turned = Scores::new(turned).unwrap();
            for (a, b) in aggregates(&[&scores]).into_iter().zip(aggregates(&[&turned])) {
                prop_assert!((a - b).abs() < 1e-9);
            }
            prop_assert!((scores.total() - turned.total()).abs() < 1e-9);
        }

        #[test]
        fn improvement_is_a_probability_and_its_opposite_the_rest(pairs in prop::collection::vec(
            (prop::collection::vec(0..5u8, 1..5), prop::collection::vec(0..5u8, 1..5)), 1..6)) {
            let of = |v: &Vec<u8>| v.iter().map(|&s| f64::from(s)).collect::<Vec<_>>();
            let x = Scores::new(pairs.iter().map(|(a, _)| of(a)).collect()).unwrap();
            let y = Scores::new(pairs.iter().map(|(_, b)| of(b)).collect()).unwrap();
            let (there, back) = (probability_of_improvement(&x, &y), probability_of_improvement(&y, &x));
            prop_assert!((0.0..=1.0).contains(&there));
            prop_assert!((there + back - 1.0).abs() < 1e-12);
            prop_assert!((probability_of_improvement(&x, &x) - 0.5).abs() < 1e-12);
        }

        #[test]
        fn the_interval_of_a_mean_contains_it(tasks in tables()) {
            let scores = Scores::new(tasks).unwrap();
            let of = |s: &[&Scores]| vec![s[0].mean(), s[0].total()];
            for e in bootstrap(400).intervals("test", Draw::Runs, &[&scores], of).unwrap() {
                if let Some((low, high)) = e.interval {
                    prop_assert!(low <= e.point + 1e-9 && e.point <= high + 1e-9, "{:?}", e);
                }
            }
        }
    }
}
