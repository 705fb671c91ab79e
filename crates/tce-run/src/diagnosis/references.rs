//! Rows that stand for all of a domain: what coverage is counted over, and the source rows that are measured.

use rand::seq::SliceRandom;
use tce_augment::units::Units;
use tce_base::Streams;
use tce_base::random::choose;
use tce_data::Transitions;
use tce_diagnosis::{Coverage, coverage};

use super::Subject;
use super::work::{Sources, Work, few};
use crate::config::SourceRows;
use crate::error::Result;
use crate::mixture::distances;

/// Reference states of each domain behind a coverage.
const REFERENCE: usize = 2000;
/// Source rows behind Theorem 1.
const SOURCES: usize = 20_000;
/// The share of source rows that is called nearest where the run itself has no λ.
const NEAREST: f64 = 0.05;

/// Equally many states of each domain that coverage is counted over, and target rows that are none of them.
pub struct References {
    pub rows: usize,
    target: coverage::Reference,
    source: Option<coverage::Reference>,
    pub other_target: Transitions,
    /// Whether the other target rows are of other episodes.
    pub by_episode: bool,
}

impl References {
    /// Coverage by `covering`; None if they are fewer than the reference rows.
    pub fn covered_by(&self, covering: &Transitions, units: &Units, streams: &Streams) -> Result<Option<Coverage>> {
        if covering.len() < self.rows {
            return Ok(None);
        }
        let states = units.states(&few(covering, self.rows, streams, "covering").observations);
        let source = self.source.as_ref().map(|s| s.covered_by(&states)).transpose()?;
        Ok(Some(Coverage { target: self.target.covered_by(&states)?, source }))
    }
}

impl Work<'_> {
    pub fn units(&self) -> &Units {
        &self.sampler.generator.units
    }

    /// A sample of the source rows in the order of their distances to the target (Eq. 9), and of the nearest share.
    pub fn sources(&self, streams: &Streams) -> Result<Option<Sources>> {
        let Subject { inputs, config, .. } = *self.subject;
        let Some(source) = &inputs.source else { return Ok(None) };
        let (all, distances) = (&source.rows, distances(inputs, SourceRows::Nearest, self.root)?);
        let mut order: Vec<usize> = (0..all.len()).collect();
        order.sort_by(|&a, &b| distances[a].total_cmp(&distances[b]).then(a.cmp(&b)));
        let pick = |from: &[usize], name: &str| {
            let places = choose(&mut streams.stream(name), from.len(), SOURCES.min(all.len() / 2).max(1));
            places.into_iter().map(|i| from[i]).collect::<Vec<_>>()
        };
        let share =
            if config.mixture.lambda > 0.0 && config.mixture.lambda < 1.0 { config.mixture.lambda } else { NEAREST };
        let near = ((share * all.len() as f64).round() as usize).clamp(1, all.len());
        let measured = pick(&order, "sources");
        Ok(Some(Sources {
            sorted: all.select(&measured),
            episodes: episodes_of(all, &measured),
            nearest: all.select(&pick(&order[..near], "nearest")),
            others: all.select(&others(all.len(), &measured)),
        }))
    }

    /// As many rows as there are of each kind, `kept` of them generated; None where that is too few for neighbourhoods.
    pub fn references(&self, streams: &Streams, sources: Option<&Sources>, kept: usize) -> Result<Option<References>> {
        let target = &self.subject.inputs.target.rows;
        let (first, second, by_episode) = halves(target, streams);
        let enough = first.len().min(second.len()).min(kept).min(sources.map_or(usize::MAX, |s| s.sorted.len()));
        let rows = REFERENCE.min(enough);
        if rows <= coverage::NEIGHBOUR {
            return Ok(None);
        }
        let reference =
            |t: &Transitions| coverage::Reference::new(self.units().states(&t.observations), self.units().live.len());
        let source = sources.map(|s| reference(&few(&s.sorted, rows, streams, "reference/source"))).transpose()?;
        Ok(Some(References {
            rows,
            target: reference(&few(&target.select(&first), rows, streams, "reference/target"))?,
            source,
            other_target: target.select(&second),
            by_episode,
        }))
    }
}

/// Two halves of the rows in whole episodes, drawn at random, and whether that could be: where one would have less than a third of the rows,
/// rows are drawn instead.
fn halves(t: &Transitions, streams: &Streams) -> (Vec<usize>, Vec<usize>, bool) {
    let mut episodes = t.episodes();
    episodes.shuffle(&mut streams.stream("halves"));
    // The longest first: each goes where there are fewer rows.
    episodes.sort_by_key(|e| std::cmp::Reverse(e.end - e.start));
    let (mut first, mut second) = (Vec::new(), Vec::new());
    for e in episodes {
        let half = if second.len() < first.len() { &mut second } else { &mut first };
        half.extend(e.start..e.end);
    }
    if 3 * second.len().min(first.len()) < t.len() {
        let chosen = choose(&mut streams.stream("halves/rows"), t.len(), t.len() / 2);
        let second = others(t.len(), &chosen);
        return (chosen, second, false);
    }
    first.sort_unstable();
    second.sort_unstable();
    (first, second, true)
}

/// The episode of each of the rows at `places`.
fn episodes_of(t: &Transitions, places: &[usize]) -> Vec<usize> {
    let all: Vec<usize> = t.episodes().iter().enumerate().flat_map(|(k, e)| vec![k; e.end - e.start]).collect();
    places.iter().map(|&i| all[i]).collect()
}

/// Which of 0 .. `count` are not among `places`.
fn others(count: usize, places: &[usize]) -> Vec<usize> {
    let mut free = vec![true; count];
    places.iter().for_each(|&i| free[i] = false);
    (0..count).filter(|&i| free[i]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diagnosis::models::tests::log;

    #[test]
    fn rows_know_their_episode() {
        assert_eq!(episodes_of(&log(&[2, 3, 1]), &[5, 0, 3, 1, 4, 2]), [2, 0, 1, 0, 1, 1]);
    }

    #[test]
    fn halves_are_whole_episodes_where_they_are_even_enough() {
        for (lengths, whole) in [
            (vec![10; 5], true),
            (vec![10, 10], true),
            (vec![30, 10, 10, 10], true),
            (vec![50], false),
            (vec![50, 5], false),
            (vec![997, 1, 1, 1], false),
        ] {
            let t = log(&lengths);
            let (first, second, by_episode) = halves(&t, &Streams::new(1));
            assert_eq!(by_episode, whole, "{lengths:?}");
            let mut all = [first.clone(), second.clone()].concat();
            all.sort_unstable();
            assert_eq!(all, (0..t.len()).collect::<Vec<_>>(), "{lengths:?}: every row once");
            assert!(3 * first.len().min(second.len()) >= t.len(), "{lengths:?}: {} and {}", first.len(), second.len());
            let split = |e: &tce_data::Episode| first.contains(&e.start) != first.contains(&(e.end - 1));
            assert!(!whole || !t.episodes().iter().any(split), "{lengths:?}");
        }
    }
}
