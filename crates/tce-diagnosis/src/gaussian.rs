//! Divergences between normal distributions with diagonal covariance, row by row.

use rayon::prelude::*;
use tce_base::{Streams, random::fill_normal};

/// Draws behind a total variation.
pub const DRAWS: usize = 64;

/// Row-major means and ln σ of width `dim`, one distribution per row.
#[derive(Clone, Copy, Debug)]
pub struct Normals<'a> {
    /// μ
    pub mean: &'a [f32],
    /// ln σ
    pub log_std: &'a [f32],
    /// Dimensions.
    pub dim: usize,
}

/// μ and ln σ of one distribution.
type Row<'a> = (&'a [f32], &'a [f32]);

impl<'a> Normals<'a> {
    fn rows(self) -> impl IndexedParallelIterator<Item = Row<'a>> {
        assert_eq!(self.mean.len(), self.log_std.len(), "one spread per mean");
        self.mean.par_chunks_exact(self.dim).zip(self.log_std.par_chunks_exact(self.dim))
    }
}

/// KL(P‖Q) of every row, in nats:  Σ_d ln(σ_q/σ_p) + (σ_p² + (μ_p − μ_q)²) / 2σ_q² − ½.
pub fn kl(p: Normals<'_>, q: Normals<'_>) -> Vec<f64> {
    let row = |((mp, lp), (mq, lq)): (Row, Row)| -> f64 {
        let term = |d: usize| {
            let (lp, lq, shift) = (f64::from(lp[d]), f64::from(lq[d]), f64::from(mp[d]) - f64::from(mq[d]));
            lq - lp + ((2.0 * lp).exp() + shift * shift) * (-2.0 * lq).exp() / 2.0 - 0.5
        };
        (0..mp.len()).map(term).sum()
    };
    p.rows().zip(q.rows()).map(row).collect()
}

/// D_TV(P‖Q) = E_{x ~ P} max(0, 1 − q(x)/p(x)) of every row, by [`DRAWS`] draws. The draws are the same for all rows: differences
/// between rows are none of the draws.
pub fn total_variation(p: Normals<'_>, q: Normals<'_>, streams: &Streams) -> Vec<f64> {
    let dim = p.dim;
    let mut z = vec![0.0f32; DRAWS * dim];
    fill_normal(&mut streams.stream("diagnosis/total variation"), &mut z);
    let row = |((mp, lp), (mq, lq)): (Row, Row)| -> f64 {
        let draw = |z: &[f32]| {
            let log_ratio = |d: usize| {
                let (z, lp, lq) = (f64::from(z[d]), f64::from(lp[d]), f64::from(lq[d]));
                let x = f64::from(mp[d]) + lp.exp() * z;
                let from_q = (x - f64::from(mq[d])) * (-lq).exp();
                lp - lq + 0.5 * (z * z - from_q * from_q)
            };
            let ratio: f64 = (0..dim).map(log_ratio).sum();
            // Not `max`, to which a model that has diverged would be as good as the best one.
            (1.0 - ratio.exp()).clamp(0.0, 1.0)
        };
        z.chunks_exact(dim).map(draw).sum::<f64>() / DRAWS as f64
    };
    p.rows().zip(q.rows()).map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn normals<'a>(mean: &'a [f32], log_std: &'a [f32], dim: usize) -> Normals<'a> {
        Normals { mean, log_std, dim }
    }

    #[test]
    fn kl_of_known_normals() {
        // N(1, 4) against N(0, 1): ½ (4 + 1 − 1 − ln 4); N(0, 1) against N(1, 4): ½ ((1 + 1)/4 − 1 + ln 4).
        let two = 2f32.ln();
        let found = kl(normals(&[1.0, 0.0], &[two, 0.0], 1), normals(&[0.0, 1.0], &[0.0, two], 1));
        assert!((found[0] - 0.5 * (4.0 - 4f64.ln())).abs() < 1e-6);
        assert!((found[1] - 0.5 * (0.5 - 1.0 + 4f64.ln())).abs() < 1e-6);
        // Dimensions add up; a distribution is at no distance from itself.
        let both = kl(normals(&[1.0, 0.0], &[two, 0.0], 2), normals(&[0.0, 1.0], &[0.0, two], 2));
        assert!((both[0] - found[0] - found[1]).abs() < 1e-6);
        let same = kl(normals(&[0.3, -1.0], &[0.7, -4.0], 2), normals(&[0.3, -1.0], &[0.7, -4.0], 2));
        assert!(same[0].abs() < 1e-9);
    }

    #[test]
    fn total_variation_of_known_normals() {
        // Equal spreads σ at distance Δ: 2 Φ(Δ / 2σ) − 1.
        let streams = Streams::new(0);
        let at = |shift: f32| {
            // Many rows would have the same draws; many seeds do not.
            let all = (0..50).map(|seed| {
                total_variation(normals(&[shift], &[1.0], 1), normals(&[0.0], &[1.0], 1), &Streams::new(seed))[0]
            });
            all.sum::<f64>() / 50.0
        };
        let sigma = 1f32.exp();
        for (z, expected) in [(0.0f32, 0.0), (1.0, 0.382_925), (2.0, 0.682_689), (4.0, 0.954_500)] {
            assert!((at(z * sigma) - expected).abs() < 0.02, "{z}: {}", at(z * sigma));
        }
        let far =
            total_variation(normals(&[0.0, 0.0], &[-5.0, 0.0], 2), normals(&[1.0, 0.0], &[-5.0, 0.0], 2), &streams);
        assert_eq!(far, [1.0], "sharp distributions at different places have nothing in common");
        let lost = total_variation(normals(&[f32::NAN], &[0.0], 1), normals(&[0.0], &[0.0], 1), &streams);
        assert!(lost[0].is_nan(), "no number is not the least one");
    }
}
