//! Activation functions, as a composition of burn operations and as loops the compiler vectorises.

use burn::tensor::{Tensor, activation};
use multiversion::multiversion;
use serde::{Deserialize, Serialize};

/// What a dense layer does to its pre-activation z.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// z
    Identity,
    /// max(z, 0)
    Relu,
    /// z · sigmoid(z)
    Silu,
    /// tanh(z)
    Tanh,
}

impl Activation {
    /// The function as burn computes it on any device.
    pub fn compose(self, z: Tensor<3>) -> Tensor<3> {
        match self {
            Activation::Identity => z,
            Activation::Relu => activation::relu(z),
            Activation::Silu => activation::silu(z),
            Activation::Tanh => activation::tanh(z),
        }
    }

    /// z ← act(z), inlined into the kernels.
    #[inline(always)]
    pub(crate) fn apply(self, z: &mut [f32]) {
        match self {
            Activation::Identity => {}
            Activation::Relu => z.iter_mut().for_each(|z| *z = z.max(0.0)),
            Activation::Silu => z.iter_mut().for_each(|z| *z *= sigmoid(*z)),
            Activation::Tanh => z.iter_mut().for_each(|z| *z = tanh(*z)),
        }
    }

    /// z ← act(z) and `slope` ← act'(z); for SiLU the two share their exponential.
    #[inline(always)]
    pub(crate) fn apply_with_slope(self, z: &mut [f32], slope: &mut [f32]) {
        // One plain loop a step: the compiler makes vectors of them.
        match self {
            Activation::Identity => slope.fill(1.0),
            Activation::Relu => slope.iter_mut().zip(&*z).for_each(|(d, z)| *d = if *z > 0.0 { 1.0 } else { 0.0 }),
            Activation::Silu => {
                slope.iter_mut().zip(&*z).for_each(|(s, z)| *s = sigmoid(*z));
                for (z, slope) in z.iter_mut().zip(slope) {
                    let (y, s) = (*z * *slope, *slope);
                    // s (1 + z (1 - s))
                    *slope = s + y * (1.0 - s);
                    *z = y;
                }
                return;
            }
            Activation::Tanh => {
                slope.iter_mut().zip(&*z).for_each(|(d, z)| *d = tanh(*z));
                slope.iter_mut().for_each(|d| *d = 1.0 - *d * *d);
            }
        }
        self.apply(z);
    }

    /// Whether the derivative is no function of the output, so that the forward pass must keep it.
    pub(crate) fn keeps_slope(self) -> bool {
        self == Activation::Silu
    }
}

/// e^x to 2 ulp on [-87, 88], by range reduction and a degree-6 polynomial. Plain multiplications and additions only, so
/// that every instruction set gives the same bits; clamped outside.
#[inline(always)]
fn exp(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0; // 1.5 · 2^23: adding it rounds to an integer
    let x = x.clamp(-87.0, 88.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    // ln 2 in two parts, the first exact for the multiples that occur.
    let r = (x - n * 0.693_359_4) - n * -2.121_944_4e-4;
    let p = 1.0 / 720.0;
    let p = p * r + 1.0 / 120.0;
    let p = p * r + 1.0 / 24.0;
    let p = p * r + 1.0 / 6.0;
    let p = p * r + 0.5;
    let p = p * r + 1.0;
    let p = p * r + 1.0;
    // n as an integer, from the last bits of the sum: a cast saturates, which the compiler does lane by lane.
    let n = shifted.to_bits().wrapping_sub(ROUND.to_bits());
    p * f32::from_bits(n.wrapping_add(127) << 23)
}

#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

#[inline(always)]
fn tanh(x: f32) -> f32 {
    // 2 sigmoid(2x) - 1 loses relative accuracy near 0, where the odd series is exact to rounding.
    let x2 = x * x;
    let small = x * (1.0 + x2 * (-1.0 / 3.0 + x2 * (2.0 / 15.0 - x2 * (17.0 / 315.0))));
    let large = 2.0 * sigmoid(2.0 * x) - 1.0;
    if x2 < 0.01 { small } else { large }
}

/// dz = dy · act'(z) where dy stands, and db = column sums of dz. `kept` is act'(z) for SiLU and the output y for the others.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
pub(crate) fn activation_gradient(dz: &mut [f32], kept: &[f32], act: Activation, db: &mut [f32]) {
    db.fill(0.0);
    let width = db.len();
    for (dz, kept) in dz.chunks_exact_mut(width).zip(kept.chunks_exact(width)) {
        match act {
            Activation::Identity => {}
            Activation::Relu => {
                for (dz, y) in dz.iter_mut().zip(kept) {
                    *dz = if *y > 0.0 { *dz } else { 0.0 };
                }
            }
            Activation::Silu => {
                for (dz, slope) in dz.iter_mut().zip(kept) {
                    *dz *= slope;
                }
            }
            Activation::Tanh => {
                for (dz, y) in dz.iter_mut().zip(kept) {
                    *dz *= 1.0 - y * y;
                }
            }
        }
        for (db, dz) in db.iter_mut().zip(dz) {
            *db += *dz;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fast_functions_follow_the_exact_ones() {
        for i in -20_000..=20_000 {
            let x = i as f32 * 4e-3;
            let exact = (x as f64).exp();
            assert!(((exp(x) as f64 - exact) / exact).abs() < 4e-7, "exp({x})");
            let x = i as f32 * 5e-4;
            assert!((tanh(x) as f64 - (x as f64).tanh()).abs() < 3e-7, "tanh({x})");
            assert!((sigmoid(x) as f64 - 1.0 / (1.0 + (-x as f64).exp())).abs() < 2e-7, "sigmoid({x})");
        }
        assert_eq!(exp(-1000.0), exp(-87.0));
    }
}
