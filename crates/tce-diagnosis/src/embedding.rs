//! t-SNE pictures (Fig. 1a, Fig. 3 a.1), by the crate `bhtsne`.

use bhtsne::{Neighbor, tSNE};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_base::{Streams, random::fill_normal};

/// Perplexity of van der Maaten and Hinton 2008.
const PERPLEXITY: f32 = 30.0;
const EPOCHS: usize = 1000;
/// Accuracy of the Barnes-Hut approximation, as in the reference implementation.
const THETA: f32 = 0.5;

/// Whose rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Group {
    /// Source rows.
    Source,
    /// Source rows that are the nearest to the target.
    NearestSource,
    /// Target rows.
    Target,
    /// Generated rows.
    Generated,
}

impl Group {
    /// In print.
    pub fn title(self) -> &'static str {
        match self {
            Group::Source => "Source",
            Group::NearestSource => "Nearest source",
            Group::Target => "Target",
            Group::Generated => "Generated",
        }
    }
}

/// Points in the plane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Embedding {
    /// The groups, each with its points.
    pub groups: Vec<(Group, Vec<[f32; 2]>)>,
}

impl Embedding {
    /// Of rows of width `dim` in units in which distances mean something. One thread alone adds up, so that the points have the same
    /// bytes at any number of threads. None for fewer rows than a perplexity of 30 needs.
    pub fn of(groups: &[(Group, Vec<f32>)], dim: usize, streams: &Streams) -> Option<Self> {
        let rows: Vec<&[f32]> = groups.iter().flat_map(|(_, rows)| rows.chunks_exact(dim)).collect();
        let neighbours = (3.0 * PERPLEXITY) as usize;
        if rows.len() <= neighbours + 1 {
            return None;
        }
        // By hand: the crate's tree of vantage points draws from a generator of the process.
        let near = |i: usize| -> Vec<Neighbor<f32>> {
            let distance = |j: usize| -> f32 {
                let square = |(x, y): (&f32, &f32)| (f64::from(*x) - f64::from(*y)).powi(2);
                rows[i].iter().zip(rows[j]).map(square).sum::<f64>().sqrt() as f32
            };
            let mut all: Vec<(f32, usize)> = (0..rows.len()).filter(|j| *j != i).map(|j| (distance(j), j)).collect();
            all.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            all.truncate(neighbours);
            all.into_iter().map(|(distance, index)| Neighbor { index, distance }).collect()
        };
        let neighbours: Vec<_> = (0..rows.len()).into_par_iter().map(near).collect();
        let mut start = vec![0.0; 2 * rows.len()];
        fill_normal(&mut streams.stream("diagnosis/embedding"), &mut start);
        start.iter_mut().for_each(|x| *x *= 1e-4);
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().ok()?;
        let points = one.install(|| {
            let mut tsne: tSNE<f32, &[f32], 2> = tSNE::new(&rows);
            tsne.perplexity(PERPLEXITY).epochs(EPOCHS).initial_embedding(start);
            tsne.barnes_hut_with_neighbors(THETA, &neighbours);
            tsne.embedding()
        });
        let mut points = points.chunks_exact(2).map(|p| [p[0], p[1]]);
        let take = |(group, rows): &(Group, Vec<f32>)| (*group, points.by_ref().take(rows.len() / dim).collect());
        Some(Self { groups: groups.iter().map(take).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(name: &str, rows: usize, at: f32) -> Vec<f32> {
        let mut out = vec![0.0; rows * 5];
        fill_normal(&mut Streams::new(1).stream(name), &mut out);
        out.iter_mut().for_each(|x| *x += at);
        out
    }

    #[test]
    fn separate_clouds_stay_separate_and_threads_do_not_matter() {
        let groups =
            [(Group::Source, cloud("a", 120, 0.0)), (Group::Target, cloud("b", 100, 8.0)), (Group::Generated, vec![])];
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| Embedding::of(&groups, 5, &Streams::new(7)).unwrap())
        };
        let found = run(1);
        assert_eq!(found, run(2));
        assert_eq!(found.groups.iter().map(|g| g.1.len()).collect::<Vec<_>>(), [120, 100, 0]);
        let points = |k: usize| &found.groups[k].1;
        let distance = |a: &[f32; 2], b: &[f32; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
        // The nearest other point is of the same cloud.
        for (own, other) in [(0, 1), (1, 0)] {
            for (i, p) in points(own).iter().enumerate() {
                let nearest = |q: &[[f32; 2]], skip: Option<usize>| {
                    let others = q.iter().enumerate().filter(|(j, _)| Some(*j) != skip);
                    others.map(|(_, q)| distance(p, q)).fold(f32::INFINITY, f32::min)
                };
                assert!(nearest(points(own), Some(i)) < nearest(points(other), None));
            }
        }
        assert_eq!(Embedding::of(&[(Group::Source, cloud("a", 20, 0.0))], 5, &Streams::new(7)), None);
    }
}
