//! The loss functions. Tensors are `[P, B, D]`, losses `[P, 1, 1]` (one per member).
//!
//! | function | formula | source |
//! |---|---|---|
//! | [`expectile_loss`] | mean of abs(τ - 1(u < 0)) u² | IQL Eq. 5; B.12 |
//! | [`advantage_weights`] | min(exp(β u / scale), cap) | IQL Eq. 7; B.14 |
//! | [`squared_error`] | (mean - a)², per component | OTDF's log-likelihood of a deterministic policy, up to constants |
//! | [`normal_log_prob`] | Σ_d ln N(x_d; mean_d, σ_d²) | - |
//! | [`binary_cross_entropy`] | mean of ln(1 + e^x) - label x | - |
//! | [`kl_to_standard_normal`] | -½ mean(1 + 2 ln σ - μ² - σ²) | BCQ's CVAE |

use serde::{Deserialize, Serialize};
use tce_nn::Tensor;

/// Mean over rows and columns, `[P, B, D]` → `[P, 1, 1]`.
pub fn member_mean(x: Tensor<3>) -> Tensor<3> {
    x.mean_dim(2).mean_dim(1)
}

/// Asymmetric squares of u = Q - V `[P, B, 1]`: weight τ if u ≥ 0, 1 - τ if u < 0.
pub fn expectile_loss(u: Tensor<3>, tau: f64) -> Tensor<3> {
    let below = u.clone().inner().lower_elem(0.0).float();
    let weight = below * (1.0 - 2.0 * tau) + tau;
    member_mean(u.square() * weight)
}

/// In what units the advantage enters the exponent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum AdvantageScale {
    /// In units of the reward, as published.
    #[default]
    Raw,
    /// Divided by its own standard deviation over the batch, so that the temperature means the same for every task. The
    /// mean stays: V is the baseline.
    Standardised,
}

/// Settings of [`advantage_weights`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdvantageWeights {
    /// β
    pub temperature: f64,
    /// Largest weight.
    pub cap: f64,
    /// Units of u.
    pub scale: AdvantageScale,
}

/// min(exp(β u / scale), cap), `[P, B, 1]` → `[P, B, 1]`.
pub fn advantage_weights(u: Tensor<3>, weights: AdvantageWeights) -> Tensor<3> {
    let u = match weights.scale {
        AdvantageScale::Raw => u,
        AdvantageScale::Standardised => {
            let centred = u.clone() - u.clone().mean_dim(1);
            u / centred.square().mean_dim(1).sqrt().clamp_min(1e-6)
        }
    };
    (u * weights.temperature).exp().clamp_max(weights.cap)
}

/// (mean - a)², `[P, B, A]`.
pub fn squared_error(mean: Tensor<3>, a: Tensor<3>) -> Tensor<3> {
    (mean - a).square()
}

/// Log density of independent normals, summed over the last axis: `[P, B, A]` → `[P, B, 1]`. `log_std` may be broadcast.
pub fn normal_log_prob(x: Tensor<3>, mean: Tensor<3>, log_std: Tensor<3>) -> Tensor<3> {
    let z = (x - mean) * (-log_std.clone()).exp();
    let ln_2pi = (2.0 * std::f64::consts::PI).ln();
    ((z.square() + ln_2pi) * -0.5 - log_std).sum_dim(2)
}

/// KL(N(μ, σ²) ‖ N(0, 1)), mean over latent dimensions and rows.
pub fn kl_to_standard_normal(mean: Tensor<3>, log_std: Tensor<3>) -> Tensor<3> {
    let variance = (log_std.clone() * 2.0).exp();
    member_mean((log_std * 2.0 + 1.0 - mean.square() - variance) * -0.5)
}

/// Squared temporal-difference error, mean over rows: q, y and weights `[P, B, 1]`.
pub fn squared_td_error(q: Tensor<3>, y: Tensor<3>, weights: Option<Tensor<3>>) -> Tensor<3> {
    let error = (q - y).square();
    member_mean(match weights {
        Some(w) => error * w,
        None => error,
    })
}

/// Binary cross-entropy of logits `[P, B, 1]` against labels in [0, 1], mean over rows: ln(1 + e^x) - label x.
pub fn binary_cross_entropy(logits: Tensor<3>, labels: Tensor<3>) -> Tensor<3> {
    // ln(1 + e^x) = max(x, 0) + ln(1 + e^-|x|): the exponential cannot overflow.
    let softplus = logits.clone().clamp_min(0.0) + (-logits.clone().abs()).exp().log1p();
    member_mean(softplus - logits * labels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_nn::{cpu, host, tensor};

    fn column(values: &[f32]) -> Tensor<3> {
        tensor(values.to_vec(), [1, values.len(), 1], &cpu())
    }

    fn close(x: Tensor<3>, expected: &[f32]) {
        let x = host(x);
        assert_eq!(x.len(), expected.len());
        assert!(
            x.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5 * b.abs().max(1.0)),
            "{x:?} is not {expected:?}"
        );
    }

    #[test]
    fn expectile_loss_and_its_gradient() {
        // .7 · 4 + .3 · 1 + 0, over 3.
        let u = tensor(vec![2.0, -1.0, 0.0], [1, 3, 1], &cpu().autodiff()).require_grad();
        let loss = expectile_loss(u.clone(), 0.7);
        close(loss.clone().inner(), &[3.1 / 3.0]);
        let grads = loss.sum().backward();
        close(u.grad(&grads).unwrap(), &[2.8 / 3.0, -0.6 / 3.0, 0.0]);
    }

    #[test]
    fn the_expectile_minimises_the_expectile_loss() {
        // The .7-expectile m of {0, 1}: .7 (1 - m) = .3 m, so m = .7.
        let loss = |m: f32| host(expectile_loss(column(&[-m, 1.0 - m]), 0.7))[0];
        assert!(loss(0.7) < loss(0.69) && loss(0.7) < loss(0.71));
    }

    #[test]
    fn weights_are_capped_and_may_be_standardised() {
        let weights = |scale| AdvantageWeights { temperature: 3.0, cap: 100.0, scale };
        let u = [0.5, -2.0, 90.0];
        close(advantage_weights(column(&u), weights(AdvantageScale::Raw)), &[1.5f32.exp(), (-6.0f32).exp(), 100.0]);
        // Mean 1, std √2.
        let u = [-1.0, 3.0, 1.0, 1.0];
        let expected = u.map(|u: f32| (3.0 * u / 2f32.sqrt()).exp().min(100.0));
        close(advantage_weights(column(&u), weights(AdvantageScale::Standardised)), &expected);
        let constant = advantage_weights(column(&[0.0, 0.0]), weights(AdvantageScale::Standardised));
        close(constant, &[1.0, 1.0]);
    }

    #[test]
    fn cross_entropy_of_logits() {
        // -ln σ(2), -ln(1 - σ(-1)), and a logit whose exponential overflows.
        let loss = binary_cross_entropy(column(&[2.0, -1.0, 200.0]), column(&[1.0, 0.0, 0.0]));
        close(loss, &[((-2f32).exp().ln_1p() + (-1f32).exp().ln_1p() + 200.0) / 3.0]);
    }

    #[test]
    fn normal_density_and_divergence() {
        let x = tensor(vec![1.0, -0.5], [1, 1, 2], &cpu());
        let mean = tensor(vec![0.0, 0.5], [1, 1, 2], &cpu());
        let log_std = tensor(vec![0.0, 2f32.ln()], [1, 1, 2], &cpu());
        // -½ (1 + ¼) - ln 2 - ln 2π
        let expected = -0.625 - 2f32.ln() - (2.0 * std::f32::consts::PI).ln();
        close(normal_log_prob(x, mean.clone(), log_std.clone()), &[expected]);
        // Per dimension ½ (μ² + σ² - 1 - ln σ²): 0 and ½ (¼ + 4 - 1 - ln 4).
        close(kl_to_standard_normal(mean, log_std), &[(3.25 - 4f32.ln()) / 4.0]);
    }

    #[test]
    fn temporal_difference_errors_may_be_weighted() {
        // Member 0: errors 0 and 1; member 1: 0 and 1, and -1 and 2.
        let q = tensor(vec![1.0, 2.0, 4.0, 6.0], [2, 2, 1], &cpu());
        let y = tensor(vec![1.0, 1.0, 5.0, 4.0], [2, 2, 1], &cpu());
        close(squared_td_error(q.clone(), y.clone(), None), &[0.5, 2.5]);
        let w = tensor(vec![1.0, 0.0, 1.0, 2.0], [2, 2, 1], &cpu());
        close(squared_td_error(q, y, Some(w)), &[0.0, 4.5]);
    }
}
