//! Places in the space of states: where imagined episodes begin, what is far from the data, what is outside of all of it.

use tce_data::{NeighbourOptions, Rows, Standardizer, Transitions, nn_distances};

use crate::error::Result;

/// Target states from which a policy is tried, for each network of the ensemble.
const STARTS: usize = 32;
/// First states of source episodes from which it is tried besides, at most.
const SOURCE_STARTS: usize = 64;
/// A source state is near the target's states if its distance to the nearest one is at most so many times the median distance between target
/// states of different episodes.
pub const NEAR: f64 = 3.0;
/// A state further outside of everything seen than this share of a column's range ends an imagined episode.
const MARGIN: f32 = 0.25;

/// Where imagined episodes begin: the first states of all target episodes, and evenly spaced ones.
pub fn starts(target: &Transitions) -> Vec<usize> {
    let mut rows: Vec<usize> = target.episodes().iter().map(|e| e.start).take(STARTS).collect();
    let more = STARTS.saturating_sub(rows.len()).min(target.len());
    rows.extend((0..more).map(|i| i * target.len() / more));
    rows
}

/// First states of evenly spaced source episodes, of those that are no further from the target's states than `near`.
pub fn source_starts(source: &Transitions, target: &Transitions, near: f64) -> Result<Vec<f32>> {
    let all: Vec<usize> = source.episodes().iter().map(|e| e.start).collect();
    let count = all.len().min(SOURCE_STARTS);
    let spaced: Vec<usize> = (0..count).map(|i| all[i * all.len() / count]).collect();
    if spaced.is_empty() {
        return Ok(Vec::new());
    }
    let states = source.select(&spaced);
    let distances = distances(&states, target, &spreads(target))?;
    let near: Vec<usize> = (0..states.len()).filter(|&i| f64::from(distances[i]) <= near).collect();
    Ok(states.select(&near).observations)
}

/// The least and the greatest value of every column over all states, with a margin.
pub fn bounds(tables: &[&Transitions]) -> (Vec<f32>, Vec<f32>) {
    let width = tables.first().map_or(0, |t| t.obs_dim);
    let (mut low, mut high) = (vec![f32::INFINITY; width], vec![f32::NEG_INFINITY; width]);
    for row in
        tables.iter().flat_map(|t| t.observations.chunks_exact(width).chain(t.next_observations.chunks_exact(width)))
    {
        for ((low, high), &x) in low.iter_mut().zip(&mut high).zip(row) {
            (*low, *high) = (low.min(x), high.max(x));
        }
    }
    for (low, high) in low.iter_mut().zip(&mut high) {
        let margin = MARGIN * (*high - *low);
        (*low, *high) = (*low - margin, *high + margin);
    }
    (low, high)
}

/// The spreads of a target's columns, in which distances are measured.
pub fn spreads(target: &Transitions) -> Standardizer {
    Standardizer::fit(&target.observations, target.obs_dim)
}

/// Distance of every state of `rows` to the nearest state of `target`, in spreads of columns.
pub fn distances(rows: &Transitions, target: &Transitions, scale: &Standardizer) -> Result<Vec<f32>> {
    let of = |t: &Transitions| scale.apply(&t.observations);
    let (rows, target) = (of(rows), of(target));
    let width = scale.dim();
    Ok(nn_distances(&Rows::new(&rows, width), &Rows::new(&target, width), &NeighbourOptions::default())?)
}

pub fn median(mut values: Vec<f32>) -> f64 {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).map_or(f64::NAN, |&v| f64::from(v))
}

/// Parts of the target whose distance from the rest is measured.
const PARTS: usize = 8;

/// Target states whose distance from the rest is measured, at most: evenly spaced ones of a longer log. A median needs no more.
const MEASURED: usize = 10_000;

/// The median distance between a target state and the nearest one of another episode, or of another eighth of the episodes where there are
/// more than eight; of the other half, where there is one episode.
pub fn spacing(target: &Transitions) -> Result<f64> {
    let starts: Vec<usize> = target.episodes().iter().map(|e| e.start).collect();
    let parts = starts.len().min(PARTS);
    let cuts: Vec<usize> = match parts {
        0 | 1 => vec![0, target.len() / 2],
        _ => (0..parts).map(|k| starts[k * starts.len() / parts]).collect(),
    };
    let scale = spreads(target);
    let mut all = Vec::with_capacity(target.len());
    let every = target.len().div_ceil(MEASURED).max(1);
    for (k, &cut) in cuts.iter().enumerate() {
        let end = cuts.get(k + 1).copied().unwrap_or(target.len());
        let (mut one, rest): (Vec<usize>, Vec<usize>) = (0..target.len()).partition(|i| (cut..end).contains(i));
        one.retain(|i| i % every == 0);
        if !one.is_empty() && !rest.is_empty() {
            all.extend(distances(&target.select(&one), &target.select(&rest), &scale)?);
        }
    }
    Ok(if all.is_empty() { 1.0 } else { median(all).max(1e-6) })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Episodes of so many rows along a line; each is `apart` from the one before, in the second column.
    fn episodes(lengths: &[usize], apart: f32) -> Transitions {
        let mut t = Transitions::new(2, 1);
        for (k, &length) in lengths.iter().enumerate() {
            for i in 0..length {
                let x = 100.0 * i as f32 / length as f32;
                t.push(&[x, k as f32 * apart], &[0.0], 0.0, &[x, k as f32 * apart], false, i + 1 == length);
            }
        }
        t
    }

    #[test]
    fn the_spacing_of_a_target_is_that_of_all_of_its_episodes() {
        let usual = spacing(&episodes(&[200; 5], 1.0)).unwrap();
        // A last episode that was stopped at once stands where the others do; it decides nothing.
        let stopped = spacing(&episodes(&[200, 200, 200, 200, 200, 1], 1.0)).unwrap();
        assert!((stopped / usual - 1.0).abs() < 0.25, "{usual} {stopped}");
        // A column that is constant in an episode counts in spreads, whatever its unit.
        let (near, far) = (spacing(&episodes(&[200; 2], 0.1)).unwrap(), spacing(&episodes(&[200; 2], 1e3)).unwrap());
        assert!((near / far - 1.0).abs() < 1e-3 && near > 0.5, "{near} {far}");
        // Of one episode, its halves; of a single row, nothing.
        assert!(spacing(&episodes(&[200], 1.0)).unwrap() > 0.1);
        assert_eq!(spacing(&episodes(&[1], 1.0)).unwrap(), 1.0);
        // Many short episodes are taken together.
        assert!(spacing(&episodes(&[3; 300], 0.01)).unwrap() > 0.0);
        // Of a long log every third row tells as much.
        let (all, some) = (spacing(&episodes(&[10_000], 0.0)).unwrap(), spacing(&episodes(&[20_000], 0.0)).unwrap());
        assert!((all / some - 1.0).abs() < 0.05, "{all} {some}");
    }

    #[test]
    fn source_episodes_lend_their_starts_where_the_target_has_been() {
        // Two columns: a place along a line, and how far the line is away. The target's lines are one apart.
        let (target, near) = (episodes(&[50; 5], 1.0), 3.0 * spacing(&episodes(&[50; 5], 1.0)).unwrap());
        let first = source_starts(&episodes(&[20; 200], 0.02), &target, near).unwrap();
        assert_eq!(first.len(), 2 * SOURCE_STARTS);
        assert!(first.chunks(2).all(|s| s[0] == 0.0) && first[3] > 0.0, "the first states of different episodes");
        assert!(source_starts(&episodes(&[20; 3], 1e4), &target, near).unwrap().len() == 2, "the others are far away");
        assert!(source_starts(&Transitions::new(2, 1), &target, near).unwrap().is_empty());
    }
}
