//! Coverage: the share of reference states that have a generated state in their neighbourhood.
//!
//! The paper draws a "coverage curve" over y_max (Fig. 3 a.2) and does not define it. Here it is the coverage of Naeem et al. 2020
//! (Reliable Fidelity and Diversity Metrics, Eq. 7): a reference state is covered if a generated one lies within the distance of
//! its k-th nearest neighbour among the reference states of its own domain. As many rows as reference rows of the very same
//! distribution cover 1 − 2⁻ᵏ of them; more rows cover more, so that metrics are comparable between sets of equal size alone.

use serde::{Deserialize, Serialize};
use tce_data::{DataError, NeighbourOptions, Rows, nn_distances};

/// k of Naeem et al.
pub const NEIGHBOUR: usize = 5;

/// Coverage of both domains' states by one set of rows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// Of target states.
    pub target: f64,
    /// Of source states.
    pub source: Option<f64>,
}

impl Coverage {
    /// Of the two domains together, each counting one half; of the target alone where there is no source.
    pub fn both(&self) -> f64 {
        self.source.map_or(self.target, |source| (self.target + source) / 2.0)
    }
}

/// States of one domain with the size of their neighbourhoods.
pub struct Reference {
    rows: Vec<f32>,
    dim: usize,
    radii: Vec<f32>,
}

impl Reference {
    /// Of `rows`, row-major of width `dim`, in the units in which distances mean something.
    ///
    /// # Errors
    /// If the user interrupts.
    ///
    /// # Panics
    /// If there are no more than [`NEIGHBOUR`] rows.
    pub fn new(rows: Vec<f32>, dim: usize) -> Result<Self, DataError> {
        let table = Rows::new(&rows, dim);
        // Every row is its own nearest neighbour.
        let options = NeighbourOptions { k: NEIGHBOUR + 1, ..NeighbourOptions::default() };
        let radii = nn_distances(&table, &table, &options)?;
        Ok(Self { rows, dim, radii })
    }

    /// The share of the states that `covering` covers.
    ///
    /// # Errors
    /// If the user interrupts.
    ///
    /// # Panics
    /// If there are not as many covering rows as reference rows.
    pub fn covered_by(&self, covering: &[f32]) -> Result<f64, DataError> {
        assert_eq!(covering.len(), self.rows.len(), "coverage compares sets of equal size");
        let options = NeighbourOptions::default();
        let nearest = nn_distances(&Rows::new(&self.rows, self.dim), &Rows::new(covering, self.dim), &options)?;
        let covered = nearest.iter().zip(&self.radii).filter(|(d, r)| d <= r).count();
        Ok(covered as f64 / self.radii.len() as f64)
    }
}

#[cfg(test)]
mod tests {
    use tce_base::{Streams, random::fill_normal};

    use super::*;

    fn cloud(seed: u64, rows: usize, at: f32) -> Vec<f32> {
        let mut out = vec![0.0; rows * 3];
        fill_normal(&mut Streams::new(seed).stream("cloud"), &mut out);
        out.iter_mut().for_each(|x| *x += at);
        out
    }

    #[test]
    fn of_a_known_mixture() {
        // A target at 0 and a source far away at 50; mixtures of the two with known shares.
        let target = Reference::new(cloud(1, 1000, 0.0), 3).unwrap();
        let source = Reference::new(cloud(2, 1000, 50.0), 3).unwrap();
        let both = |rows: &[f32]| (target.covered_by(rows).unwrap(), source.covered_by(rows).unwrap());
        let (t, s) = both(&cloud(3, 1000, 0.0));
        assert!((t - (1.0 - 0.5f64.powi(5))).abs() < 0.02 && s == 0.0, "{t} {s}");
        // Half of the rows in each: as if a neighbourhood held k/2 rows; 1 − E(1 − p)^500 with p of Beta(5, 996), (2/3)^5.
        let mixed = [cloud(4, 500, 0.0), cloud(5, 500, 50.0)].concat();
        let (t, s) = both(&mixed);
        let half = 1.0 - (2.0f64 / 3.0).powi(5);
        assert!((t - half).abs() < 0.03 && (s - half).abs() < 0.03, "{t} {s}, expected {half}");
        // A tenth of the rows in the source: a neighbourhood holds 5 of 1000 rows, so that 100 rows miss it with (1 - p)^100.
        let few = [cloud(6, 900, 0.0), cloud(7, 100, 50.0)].concat();
        let (_, s) = both(&few);
        assert!((0.3..0.5).contains(&s), "{s}");
        let (t, s) = both(&cloud(8, 1000, 25.0));
        assert_eq!((t, s), (0.0, 0.0), "between the domains is neither of them");
        assert_eq!(Coverage { target: 0.9, source: Some(0.1) }.both(), 0.5);
    }
}
