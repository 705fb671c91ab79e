//! Places in the space of states: where imagined episodes begin, what is far from the data, what is outside of all of it.

use tce_data::{NeighbourOptions, Rows, Standardizer, Transitions, nn_distances};

use crate::error::Result;

/// Target states from which a policy is tried, for each network of the ensemble.
const STARTS: usize = 32;
/// First states of source episodes from which it is tried besides, at most.
const SOURCE_STARTS: usize = 64;
/// A source state is near the target's states if its distance to the nearest one is at most so many times [`TargetStates::spacing`].
const NEAR: f64 = 3.0;
/// A state further outside of everything seen than this share of a column's range ends an imagined episode.
const MARGIN: f32 = 0.25;

/// The first row of every episode.
pub fn episode_starts(rows: &Transitions) -> Vec<usize> {
    rows.episodes().iter().map(|e| e.start).collect()
}

/// Where imagined episodes begin: the first states of all target episodes, and evenly spaced ones.
pub fn starts(target: &Transitions) -> Vec<usize> {
    let mut rows = episode_starts(target);
    rows.truncate(STARTS);
    let more = STARTS.saturating_sub(rows.len()).min(target.len());
    rows.extend((0..more).map(|i| i * target.len() / more));
    rows
}

/// First states of evenly spaced source episodes, of those that are near the target's states.
pub fn source_starts(source: &Transitions, target: &TargetStates) -> Result<Vec<f32>> {
    let all = episode_starts(source);
    let count = all.len().min(SOURCE_STARTS);
    let spaced: Vec<usize> = (0..count).map(|i| all[i * all.len() / count]).collect();
    if spaced.is_empty() {
        return Ok(Vec::new());
    }
    let states = source.select(&spaced);
    let distances = target.distances(&states.observations)?;
    let near: Vec<usize> = (0..states.len()).filter(|&i| f64::from(distances[i]) <= NEAR * target.spacing).collect();
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

/// The target's states, and how far apart they are. All of it depends on the data alone: it is computed once, however many policies are
/// tried.
pub struct TargetStates {
    /// The spreads of the columns, in which distances are measured.
    scale: Standardizer,
    /// The states in these spreads, `[rows, width]`.
    scaled: Vec<f32>,
    /// The median distance between states of different episodes, in the same spreads.
    pub spacing: f64,
}

impl TargetStates {
    /// Those of the rows `target`.
    pub fn of(target: &Transitions) -> Result<Self> {
        let scale = Standardizer::fit(&target.observations, target.obs_dim);
        let scaled = scale.apply(&target.observations);
        let spacing = spacing(&scaled, scale.dim(), &episode_starts(target))?;
        Ok(Self { scale, scaled, spacing })
    }

    /// Distance of every one of `observations` (`[rows, width]`, in the units of the data) to the nearest target state, in spreads of columns.
    pub fn distances(&self, observations: &[f32]) -> Result<Vec<f32>> {
        nearest(&self.scale.apply(observations), &self.scaled, self.scale.dim())
    }
}

/// Distance of every row of `rows` to the nearest one of `others`, both of `width` columns.
fn nearest(rows: &[f32], others: &[f32], width: usize) -> Result<Vec<f32>> {
    Ok(nn_distances(&Rows::new(rows, width), &Rows::new(others, width), &NeighbourOptions::default())?)
}

pub fn median(mut values: Vec<f32>) -> f64 {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).map_or(f64::NAN, |&v| f64::from(v))
}

/// Parts of the target whose distance from the rest is measured.
const PARTS: usize = 8;

/// Target states whose distance from the rest is measured, at most: evenly spaced ones of a longer log. A median needs no more.
const MEASURED: usize = 10_000;

/// The median distance between a state and the nearest one of another episode, or of another eighth of the episodes where there are more than
/// eight; of the other half, where there is one episode. `states` are of `width` columns in their spreads; episodes begin at `starts`.
fn spacing(states: &[f32], width: usize, starts: &[usize]) -> Result<f64> {
    let rows = states.len() / width;
    let parts = starts.len().min(PARTS);
    let cuts: Vec<usize> = match parts {
        0 | 1 => vec![0, rows / 2],
        _ => (0..parts).map(|k| starts[k * starts.len() / parts]).collect(),
    };
    let select = |wanted: &[usize]| -> Vec<f32> {
        wanted.iter().flat_map(|&i| &states[i * width..][..width]).copied().collect()
    };
    let mut all = Vec::with_capacity(rows);
    let every = rows.div_ceil(MEASURED).max(1);
    for (k, &cut) in cuts.iter().enumerate() {
        let end = cuts.get(k + 1).copied().unwrap_or(rows);
        let (mut one, rest): (Vec<usize>, Vec<usize>) = (0..rows).partition(|i| (cut..end).contains(i));
        one.retain(|i| i % every == 0);
        if !one.is_empty() && !rest.is_empty() {
            all.extend(nearest(&select(&one), &select(&rest), width)?);
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

    fn spacing_of(target: &Transitions) -> f64 {
        TargetStates::of(target).unwrap().spacing
    }

    #[test]
    fn the_spacing_of_a_target_is_that_of_all_of_its_episodes() {
        let usual = spacing_of(&episodes(&[200; 5], 1.0));
        // A last episode that was stopped at once stands where the others do; it decides nothing.
        let stopped = spacing_of(&episodes(&[200, 200, 200, 200, 200, 1], 1.0));
        assert!((stopped / usual - 1.0).abs() < 0.25, "{usual} {stopped}");
        // A column that is constant in an episode counts in spreads, whatever its unit.
        let (near, far) = (spacing_of(&episodes(&[200; 2], 0.1)), spacing_of(&episodes(&[200; 2], 1e3)));
        assert!((near / far - 1.0).abs() < 1e-3 && near > 0.5, "{near} {far}");
        // Of one episode, its halves; of a single row, nothing.
        assert!(spacing_of(&episodes(&[200], 1.0)) > 0.1);
        assert_eq!(spacing_of(&episodes(&[1], 1.0)), 1.0);
        // Many short episodes are taken together.
        assert!(spacing_of(&episodes(&[3; 300], 0.01)) > 0.0);
        // Of a long log every third row tells as much.
        let (all, some) = (spacing_of(&episodes(&[10_000], 0.0)), spacing_of(&episodes(&[20_000], 0.0)));
        assert!((all / some - 1.0).abs() < 0.05, "{all} {some}");
    }

    #[test]
    fn source_episodes_lend_their_starts_where_the_target_has_been() {
        // Two columns: a place along a line, and how far the line is away. The target's lines are one apart.
        let target = TargetStates::of(&episodes(&[50; 5], 1.0)).unwrap();
        let first = source_starts(&episodes(&[20; 200], 0.02), &target).unwrap();
        assert_eq!(first.len(), 2 * SOURCE_STARTS);
        assert!(first.chunks(2).all(|s| s[0] == 0.0) && first[3] > 0.0, "the first states of different episodes");
        assert!(source_starts(&episodes(&[20; 3], 1e4), &target).unwrap().len() == 2, "the others are far away");
        assert!(source_starts(&Transitions::new(2, 1), &target).unwrap().is_empty());
    }
}
