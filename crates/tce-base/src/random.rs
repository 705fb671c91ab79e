//! One seed, many named streams.
//!
//! Every random number of the program comes from `Streams`: a seed and a *name* select a ChaCha key, an *index* selects
//! one of its 2^64 streams, and ChaCha itself is counter-based. Two draws that do not share (seed, name, index) are
//! independent, and none of them depends on which thread asks first: work that is split by index gives the same bytes
//! at any thread count.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use sha2::{Digest, Sha256};

/// The generator of one stream. Implements [`rand::Rng`].
pub type Rng = ChaCha8Rng;

/// All streams of one seed (one member of a population, one data collection, one evaluation).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Streams {
    seed: u64,
}

impl Streams {
    /// The streams of `seed`.
    pub fn new(seed: u64) -> Self {
        Self { seed }
    }

    /// The seed itself.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Streams of their own for a piece of work that must not draw what another one of this seed draws.
    pub fn child(&self, name: &str) -> Self {
        use rand::Rng as _;
        Self::new(self.stream(name).next_u64())
    }

    /// Stream 0 of `name`.
    pub fn stream(&self, name: &str) -> Rng {
        self.indexed(name, 0)
    }

    /// Stream `index` of `name`: one per episode, chunk of rows, training step, ...
    pub fn indexed(&self, name: &str, index: u64) -> Rng {
        let mut hash = Sha256::new();
        hash.update(self.seed.to_le_bytes());
        hash.update(name.as_bytes());
        let mut rng = ChaCha8Rng::from_seed(hash.finalize().into());
        rng.set_stream(index);
        rng
    }
}

/// Fills `out` with independent draws of N(0, 1).
pub fn fill_normal(rng: &mut Rng, out: &mut [f32]) {
    for x in out {
        *x = StandardNormal.sample(rng);
    }
}

/// Fills `out` with independent draws of U[0, 1).
pub fn fill_uniform(rng: &mut Rng, out: &mut [f32]) {
    use rand::RngExt;
    for x in out {
        *x = rng.random();
    }
}

/// `count` of the numbers below `len` at random, ascending; all of them, without a draw, where there are no more.
pub fn choose(rng: &mut Rng, len: usize, count: usize) -> Vec<usize> {
    if count >= len {
        return (0..len).collect();
    }
    let mut chosen = rand::seq::index::sample(rng, len, count).into_vec();
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn streams_are_reproducible_and_distinct() {
        let draw = |seed, name: &str, index| Streams::new(seed).indexed(name, index).random::<u64>();
        assert_eq!(draw(1, "reset", 0), draw(1, "reset", 0));
        assert_ne!(draw(1, "reset", 0), draw(2, "reset", 0));
        assert_ne!(draw(1, "reset", 0), draw(1, "action", 0));
        assert_ne!(draw(1, "reset", 0), draw(1, "reset", 1));
    }

    #[test]
    fn chosen_numbers_ascend_without_repetition() {
        let rng = || Streams::new(5).stream("choose");
        let chosen = choose(&mut rng(), 50, 20);
        assert!(chosen.len() == 20 && chosen[19] < 50 && chosen.windows(2).all(|w| w[0] < w[1]), "{chosen:?}");
        assert_eq!(chosen, choose(&mut rng(), 50, 20));
        assert_eq!(choose(&mut rng(), 3, 9), [0, 1, 2]);
    }

    #[test]
    fn normals_have_unit_moments() {
        let mut x = vec![0.0; 200_000];
        fill_normal(&mut Streams::new(3).stream("test"), &mut x);
        let n = x.len() as f64;
        let mean = x.iter().map(|&v| v as f64).sum::<f64>() / n;
        let var = x.iter().map(|&v| (v as f64 - mean).powi(2)).sum::<f64>() / n;
        assert!(mean.abs() < 0.01 && (var - 1.0).abs() < 0.02, "mean {mean}, variance {var}");
    }
}
