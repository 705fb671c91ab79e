//! Methods beside each other.

use tce_data::Task;

use super::{Aggregate, Comparison, GAMMA};
use crate::error::Result;
use crate::permutation::permutation_p;
use crate::stats::{Bootstrap, Draw, Scores, probability_of_improvement};
use crate::study::Study;

/// Which methods are compared, on which tasks, and which methods are left out, all ascending.
///
/// Where all methods together have fewer than half of the tasks that the fullest one has that is no baseline, one is left out after the
/// other: a beginning of one method must not take the others' results away. It is the one without which the rest have most tasks in common;
/// of equals the one with the fewest tasks, a method before a baseline. A method and a baseline with a common task stay in any case, if
/// there are such two. At last, whatever costs no task comes back.
fn compared(study: &Study, tasks: usize, scores: &[Vec<Vec<f64>>]) -> (Vec<usize>, Vec<usize>, Vec<usize>) {
    let has = |t: usize, m: usize| !scores[t][m].is_empty();
    let count = |m: usize| (0..tasks).filter(|t| has(*t, m)).count();
    let is_baseline = |m: usize| study.methods[m].baseline;
    let mut kept: Vec<usize> = (0..study.methods.len()).filter(|m| count(*m) > 0).collect();
    let shared = |kept: &[usize]| -> Vec<usize> { (0..tasks).filter(|t| kept.iter().all(|m| has(*t, *m))).collect() };
    // Baselines that were run on more tasks than any method must not leave themselves alone in it.
    let fullest = |methods: &dyn Fn(usize) -> bool| kept.iter().filter(|m| methods(**m)).map(|m| count(*m)).max();
    let most = fullest(&|m| !is_baseline(m)).or_else(|| fullest(&|_| true)).unwrap_or(0);
    let paired = |kept: &[usize]| {
        kept.iter().any(|&m| !is_baseline(m) && kept.iter().any(|&b| is_baseline(b) && !shared(&[m, b]).is_empty()))
    };
    let some_pair = paired(&kept);
    let without = |kept: &[usize], m: usize| kept.iter().copied().filter(|k| *k != m).collect::<Vec<_>>();
    let mut left_out = Vec::new();
    while kept.len() > 1 && 2 * shared(&kept).len() < most.max(1) {
        let droppable = kept.iter().copied().filter(|&m| !some_pair || paired(&without(&kept, m)));
        let gain = |&m: &usize| {
            let tasks = shared(&without(&kept, m)).len();
            (std::cmp::Reverse(tasks), count(m), is_baseline(m), std::cmp::Reverse(m))
        };
        let Some(last) = droppable.min_by_key(gain) else { break };
        kept.retain(|m| *m != last);
        left_out.push(last);
    }
    let places = shared(&kept);
    let (back, mut left_out): (Vec<usize>, Vec<usize>) =
        left_out.into_iter().partition(|m| !places.is_empty() && places.iter().all(|t| has(*t, *m)));
    kept.extend(back);
    kept.sort_unstable();
    left_out.sort_unstable();
    (kept, places, left_out)
}

/// Methods on the tasks that all of them have ([`compared`]).
pub(super) fn compare(
    study: &Study,
    bootstrap: &Bootstrap,
    tasks: &[Task],
    scores: &[Vec<Vec<f64>>],
) -> Result<Option<Comparison>> {
    let (kept, places, left_out) = compared(study, tasks.len(), scores);
    if places.is_empty() {
        return Ok(None);
    }
    let of = |m: usize| Scores::new(places.iter().map(|&t| scores[t][m].clone()).collect());
    let tables = kept.iter().map(|&m| of(m)).collect::<Result<Vec<_>, _>>()?;
    let baselines: Vec<usize> = kept.iter().copied().filter(|m| study.methods[*m].baseline).collect();
    let table_of = |m: usize| &tables[kept.iter().position(|k| *k == m).expect("it is kept")];
    let thresholds = thresholds(&tables);
    // Profiles have a value for every threshold: a fifth of the resamples keeps them as fast as the rest.
    let coarse = Bootstrap { resamples: (bootstrap.resamples / 5).max(1), ..*bootstrap };
    let best_baseline = (0..baselines.len()).max_by(|a, b| {
        let iqm = |k: &usize| table_of(baselines[*k]).iqm();
        iqm(a).total_cmp(&iqm(b))
    });
    let mut methods = Vec::new();
    let ranks = ranks(&tables);
    for ((&m, scores), rank) in kept.iter().zip(&tables).zip(ranks) {
        let method = &study.methods[m];
        let statistics =
            |s: &[&Scores]| vec![s[0].iqm(), s[0].median(), s[0].mean(), s[0].optimality_gap(GAMMA), s[0].total()];
        let runs = bootstrap.intervals(&method.id, Draw::Runs, &[scores], statistics)?;
        let both = bootstrap.intervals(&method.id, Draw::TasksAndRuns, &[scores], statistics)?;
        let profile = coarse.intervals(&format!("profile/{}", method.id), Draw::Runs, &[scores], |s| {
            thresholds.iter().map(|&t| s[0].share_above(t)).collect()
        })?;
        let improvements = |f: &usize| {
            let name = format!("improvement/{}/{}", method.id, study.methods[*f].id);
            let pair = [scores, table_of(*f)];
            Ok(bootstrap.intervals(&name, Draw::Runs, &pair, |s| vec![probability_of_improvement(s[0], s[1])])?[0])
        };
        let over_baselines = match method.baseline {
            true => None,
            false => Some(baselines.iter().map(improvements).collect::<Result<Vec<_>>>()?),
        };
        let p_value = match best_baseline {
            Some(k) if !method.baseline => {
                let baseline = baselines[k];
                let name = format!("{}/{}", method.id, study.methods[baseline].id);
                Some(permutation_p(bootstrap.streams, &name, bootstrap.resamples, scores, table_of(baseline))?)
            }
            _ => None,
        };
        methods.push(Aggregate {
            method: m,
            runs: scores.runs(),
            seeds: scores.tasks().iter().fold((usize::MAX, 0), |(l, h), t| (l.min(t.len()), h.max(t.len()))),
            over_seeds: [runs[0], runs[1], runs[2], runs[3]],
            over_tasks: [both[0], both[1], both[2], both[3]],
            total: runs[4],
            rank,
            profile,
            over_baselines,
            p_value,
        });
    }
    let tasks = places.iter().map(|&t| tasks[t]).collect();
    Ok(Some(Comparison { tasks, methods, left_out, baselines, best_baseline, level: bootstrap.level, thresholds }))
}

/// For each of `tables`, the mean over tasks of its place among them, by the mean over runs.
fn ranks(tables: &[Scores]) -> Vec<f64> {
    let means: Vec<Vec<f64>> = tables.iter().map(|t| t.task_means().collect()).collect();
    let place = |own: f64, t: usize| {
        let (higher, equal) = means.iter().fold((0, 0), |(higher, equal), other| match other[t].total_cmp(&own) {
            std::cmp::Ordering::Greater => (higher + 1, equal),
            std::cmp::Ordering::Equal => (higher, equal + 1),
            std::cmp::Ordering::Less => (higher, equal),
        });
        // Of `equal` methods that share places the mean one; it is one of them itself.
        f64::from(higher) + f64::from(1 + equal) / 2.0
    };
    let mean = |own: &Vec<f64>| own.iter().zip(0..).map(|(m, t)| place(*m, t)).sum::<f64>() / own.len() as f64;
    means.iter().map(mean).collect()
}

/// Every second point from below the lowest score to above the highest, 0 and 100 included.
fn thresholds(tables: &[Scores]) -> Vec<f64> {
    let all = || tables.iter().flat_map(Scores::tasks).flatten().copied();
    let low = (all().fold(0.0, f64::min) / 10.0).floor() * 10.0;
    let high = (all().fold(100.0, f64::max) / 10.0).ceil() * 10.0;
    // A return of a million is possible; a figure with a million points is none.
    let step = ((high - low) / 60.0).max(2.0);
    let n = ((high - low) / step).round() as usize;
    (0..=n).map(|k| low + (high - low) * k as f64 / n as f64).collect()
}
