//! Noise processes: x^τ = α(τ) x⁰ + σ(τ) z with z ~ N(0, I) and τ from [`Process::end`] (almost clean) to 1 (noise).
//!
//! | kind | α(τ) | σ(τ) | reverse SDE | start |
//! |---|---|---|---|---|
//! | `ve` | 1 | √(1 − e^−B(τ)) | f = 0, g² = dσ²/dτ | N(0, I) as written, or a data row + σ(1) z |
//! | `vp` | e^(−B(τ)/2) | √(1 − e^−B(τ)) | f = −β x / 2, g² = β | N(0, I) |
//! | `edm` | 1 | (σ_min^(1/ρ) + τ (σ_max^(1/ρ) − σ_min^(1/ρ)))^ρ | f = 0, g² dτ = dσ² | N(0, σ_max² I) |
//!
//! with B(τ) = α_min τ + (α_max − α_min) τ² / 2 (Eq. B.1) and β = dB/dτ. `ve` is Appendix B to the letter: its marginal at
//! τ = 1 is N(E x, Var x + σ(1)²) and not the N(0, I) it starts from, which costs variance (a deterministic sampler ends
//! at v/(v + 1) of a variance v, the reverse SDE at .75 of a unit variance). [`Start::Data`] is the cure; `vp` is Eq. 5.

use rand::RngExt;
use rand::distr::Distribution;
use serde::{Deserialize, Serialize};
use tce_base::Rng;
use tce_base::random::fill_normal;

use crate::DiffusionError;

/// Which noise. In files: `kind = "ve" | "vp" | "edm"` beside the fields of the variant.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum Process {
    /// Noise of bounded variance without drift, as Appendix B writes it.
    Ve(Ve),
    /// Noise that keeps the variance (Equation 5).
    Vp(Vp),
    /// Noise of a given spread, with a preconditioned network (Karras et al. 2022).
    Edm(Edm),
}

/// Drift-free noise of bounded variance, as Appendix B writes it.
///
/// | symbol | field | default | source |
/// |---|---|---|---|
/// | α_min, α_max | `alpha_min`, `alpha_max` | 0.1, 20 | Table C.4 |
/// | smallest τ | `tau_min` | 1e-5 | own; σ(1e-3) = .0105 is a third of a step in Hopper's finest dimensions |
/// | s^K | `start` | `normal` | Algorithm 1 |
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Ve {
    /// α_min, the rate of noise at the beginning. Source: Table C.4.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub alpha_min: f64,
    /// α_max, the rate of noise at the end. Source: Table C.4.
    pub alpha_max: f64,
    /// Smallest time τ in training and sampling. Source: own.
    pub tau_min: f64,
    /// Where sampling starts.
    pub start: Start,
}

/// Where [`Ve`] starts sampling.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Start {
    /// N(0, I), as written.
    #[default]
    Normal,
    /// A row of the training data + σ(1) z: the process's own marginal. TCE's state network starts at target rows alone, under every label.
    Data,
}

/// Variance-preserving noise, α² + σ² = 1 (Eq. 5 with B.1's σ). Fields as in [`Ve`], and:
///
/// | symbol | field | default | source |
/// |---|---|---|---|
/// | largest σ/α | `ratio_max` | 20 | own, as σ_max of [`Edm`]: deterministic samplers start there and not at the 152 of τ = 1, where the noise network's error counts 152 times (HalfCheetah, 6k steps: sliced Wasserstein .040 instead of .056, largest value 20 instead of 49) |
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Vp {
    /// α_min, the rate of noise at the beginning. Source: Table C.4.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub alpha_min: f64,
    /// α_max, the rate of noise at the end. Source: Table C.4.
    pub alpha_max: f64,
    /// Smallest time τ in training and sampling. Source: own.
    pub tau_min: f64,
    /// Noise over signal from which deterministic samplers start. Source: own.
    #[schemars(range(min = 1.0))]
    pub ratio_max: f64,
}

/// Preconditioned denoising (Karras et al. 2022, "Elucidating the Design Space of Diffusion-Based Generative Models").
///
/// | symbol | field | default | source |
/// |---|---|---|---|
/// | σ_min | `sigma_min` | 0.002 | their Table 1 |
/// | σ_max | `sigma_max` | 20 | own: rows have unit variance, 20 loses less of it on a short grid than their 80 |
/// | ρ | `rho` | 7 | their Table 1 |
/// | P_mean, P_std | `p_mean`, `p_std` | −1.2, 1.2 | their Table 1: ln σ ~ N(P_mean, P_std²) in training |
/// | σ_data | `sigma_data` | 1 | rows are standardised |
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Edm {
    /// Smallest σ of the sampling grid. Source: Karras et al., Table 1.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub sigma_min: f64,
    /// Largest σ of the sampling grid: rows have unit variance, and 20 loses less of it on a short grid than the authors' 80.
    pub sigma_max: f64,
    /// ρ, the exponent of the sampling grid. Source: Karras et al., Table 1.
    #[schemars(range(min = 1.0))]
    pub rho: f64,
    /// Mean of ln σ in training. Source: Karras et al., Table 1.
    pub p_mean: f64,
    /// Standard deviation of ln σ in training. Source: Karras et al., Table 1.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub p_std: f64,
    /// Standard deviation of the data; rows are standardised.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub sigma_data: f64,
}

impl Default for Ve {
    fn default() -> Self {
        Self { alpha_min: 0.1, alpha_max: 20.0, tau_min: 1e-5, start: Start::Normal }
    }
}

impl Default for Vp {
    fn default() -> Self {
        Self { alpha_min: 0.1, alpha_max: 20.0, tau_min: 1e-5, ratio_max: 20.0 }
    }
}

impl Default for Edm {
    fn default() -> Self {
        Self { sigma_min: 0.002, sigma_max: 20.0, rho: 7.0, p_mean: -1.2, p_std: 1.2, sigma_data: 1.0 }
    }
}

/// How the levels of a deterministic sampler are spaced.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Grid {
    /// (σ/α)^(1/ρ) uniform (Karras et al. 2022, Eq. 5), with ρ of [`Edm`] or 7.
    Karras,
    /// ln(σ/α) uniform (Lu et al. 2022).
    Log,
}

/// One amount of noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// τ; beyond [0, 1] where EDM's training draws a σ off the sampling grid.
    pub tau: f64,
    /// What multiplies the clean row.
    pub alpha: f64,
    /// What multiplies the unit noise.
    pub sigma: f64,
}

impl Level {
    /// σ / α
    pub fn ratio(&self) -> f64 {
        self.sigma / self.alpha
    }

    /// λ = ln(α / σ), half the logarithm of the signal-to-noise ratio.
    pub fn log_snr(&self) -> f64 {
        (self.alpha / self.sigma).ln()
    }
}

/// How a network F becomes a denoiser: D(x) = `skip` · x + `out` · F(`scale` · x; `time`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Precondition {
    /// c_skip
    pub skip: f64,
    /// c_out
    pub out: f64,
    /// c_in
    pub scale: f64,
    /// c_noise, the scalar fed to the TimeMLP.
    pub time: f64,
}

/// One Euler–Maruyama step of the reverse SDE: x ← `keep` · x + `score` · q(x) + √`variance` · ξ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Increment {
    /// 1 + drift.
    pub keep: f64,
    /// g² |Δτ|
    pub score: f64,
    /// g² |Δτ|
    pub variance: f64,
}

/// B(τ) of Eq. B.1.
fn integral(min: f64, max: f64, tau: f64) -> f64 {
    min * tau + 0.5 * (max - min) * tau * tau
}

/// τ with B(τ) = `b`.
fn inverse(min: f64, max: f64, b: f64) -> f64 {
    2.0 * b / (min + (min * min + 2.0 * (max - min) * b).sqrt())
}

impl Process {
    /// Refuses values no process can have.
    ///
    /// # Errors
    /// Names the first field that does not fit.
    pub fn check(&self) -> Result<(), DiffusionError> {
        let require = |ok: bool, field: &str, found: f64, expected: &str| match ok {
            true => Ok(()),
            false => Err(DiffusionError::input(format!("process.{field}"), found, expected)),
        };
        let rates = |alpha_min: f64, alpha_max: f64, tau_min: f64| {
            require(alpha_min > 0.0, "alpha_min", alpha_min, "a positive rate")?;
            require(alpha_max > alpha_min && alpha_max.is_finite(), "alpha_max", alpha_max, "more than alpha_min")?;
            require(tau_min > 0.0 && tau_min < 0.1, "tau_min", tau_min, "a time between 0 and 0.1")
        };
        match *self {
            Process::Ve(Ve { alpha_min, alpha_max, tau_min, .. }) => rates(alpha_min, alpha_max, tau_min),
            Process::Vp(Vp { alpha_min, alpha_max, tau_min, ratio_max }) => {
                rates(alpha_min, alpha_max, tau_min)?;
                require(ratio_max >= 1.0, "ratio_max", ratio_max, "at least 1")
            }
            Process::Edm(e) => {
                require(e.sigma_min > 0.0, "sigma_min", e.sigma_min, "a positive noise")?;
                let above = e.sigma_max > e.sigma_min && e.sigma_max.is_finite();
                require(above, "sigma_max", e.sigma_max, "more than sigma_min")?;
                require(e.rho >= 1.0 && e.rho.is_finite(), "rho", e.rho, "at least 1")?;
                require(e.p_mean.is_finite(), "p_mean", e.p_mean, "a number")?;
                require(e.p_std > 0.0 && e.p_std.is_finite(), "p_std", e.p_std, "a positive number")?;
                require(e.sigma_data > 0.0 && e.sigma_data.is_finite(), "sigma_data", e.sigma_data, "a positive number")
            }
        }
    }

    /// The smallest τ of the sampling grid.
    pub fn end(&self) -> f64 {
        match self {
            Process::Ve(Ve { tau_min, .. }) | Process::Vp(Vp { tau_min, .. }) => *tau_min,
            Process::Edm(_) => 0.0,
        }
    }

    /// The noise at time τ.
    pub fn level(&self, tau: f64) -> Level {
        match *self {
            Process::Ve(Ve { alpha_min, alpha_max, .. }) => {
                let b = integral(alpha_min, alpha_max, tau);
                Level { tau, alpha: 1.0, sigma: (-(-b).exp_m1()).sqrt() }
            }
            Process::Vp(Vp { alpha_min, alpha_max, .. }) => {
                let b = integral(alpha_min, alpha_max, tau);
                Level { tau, alpha: (-0.5 * b).exp(), sigma: (-(-b).exp_m1()).sqrt() }
            }
            Process::Edm(Edm { sigma_min, sigma_max, rho, .. }) => {
                let (low, high) = (sigma_min.powf(1.0 / rho), sigma_max.powf(1.0 / rho));
                Level { tau, alpha: 1.0, sigma: (low + tau * (high - low)).powf(rho) }
            }
        }
    }

    /// The noise with σ / α = `ratio`. [`Ve`] has only ratios below 1.
    pub fn level_of_ratio(&self, ratio: f64) -> Level {
        let tau = match *self {
            Process::Ve(Ve { alpha_min, alpha_max, .. }) => inverse(alpha_min, alpha_max, -(-ratio * ratio).ln_1p()),
            Process::Vp(Vp { alpha_min, alpha_max, .. }) => inverse(alpha_min, alpha_max, (ratio * ratio).ln_1p()),
            Process::Edm(Edm { sigma_min, sigma_max, rho, .. }) => {
                let (low, high) = (sigma_min.powf(1.0 / rho), sigma_max.powf(1.0 / rho));
                return Level { tau: (ratio.powf(1.0 / rho) - low) / (high - low), alpha: 1.0, sigma: ratio };
            }
        };
        self.level(tau)
    }

    /// The grid of the stochastic samplers: `steps` + 1 levels, τ uniform from 1 to [`Process::end`].
    pub fn uniform_grid(&self, steps: usize) -> Vec<Level> {
        let end = self.end();
        (0..=steps).map(|k| self.level(1.0 + (end - 1.0) * k as f64 / steps as f64)).collect()
    }

    /// The grid of the deterministic samplers: `steps` levels from τ = 1 (VP: σ/α = `ratio_max`) down to
    /// [`Process::end`], spaced as `grid` says in the ratio σ/α; the last step of a sampler then goes to no noise.
    pub fn ratio_grid(&self, steps: usize, grid: Grid) -> Vec<Level> {
        let rho = if let Process::Edm(e) = self { e.rho } else { 7.0 };
        let map = |ratio: f64| if grid == Grid::Karras { ratio.powf(1.0 / rho) } else { ratio.ln() };
        let unmap = |v: f64| if grid == Grid::Karras { v.powf(rho) } else { v.exp() };
        let last = self.level(self.end());
        let first = match self {
            Process::Vp(Vp { ratio_max, .. }) if *ratio_max < self.level(1.0).ratio() => {
                self.level_of_ratio(*ratio_max)
            }
            _ => self.level(1.0),
        };
        let [high, low] = [first, last].map(|l| map(l.ratio()));
        // The ends are exact rather than inverses of their own ratios, which near VE's σ(1) = 1 lose digits.
        let inner = (1..steps - 1).map(|k| high + k as f64 / (steps - 1) as f64 * (low - high));
        let inner = inner.map(|v| self.level_of_ratio(unmap(v)));
        std::iter::once(first).chain(inner).chain(std::iter::once(last)).collect()
    }

    /// One draw of the training distribution of noise: τ ~ U(tau_min, 1), or ln σ ~ N(P_mean, P_std²).
    pub fn draw(&self, rng: &mut Rng) -> Level {
        match *self {
            Process::Ve(_) | Process::Vp(_) => {
                let u: f64 = rand::distr::StandardUniform.sample(rng);
                self.level(self.end() + (1.0 - self.end()) * u)
            }
            Process::Edm(Edm { p_mean, p_std, .. }) => {
                let mut z = [0.0f32];
                fill_normal(rng, &mut z);
                self.level_of_ratio((p_mean + p_std * z[0] as f64).exp())
            }
        }
    }

    /// Standard deviation of the Gaussian that sampling starts from.
    pub fn start_std(&self) -> f64 {
        match self {
            Process::Ve(Ve { start: Start::Normal, .. }) | Process::Vp(_) => 1.0,
            _ => self.level(1.0).sigma,
        }
    }

    /// Whether sampling starts at rows of the training data.
    pub fn starts_at_data(&self) -> bool {
        matches!(self, Process::Ve(Ve { start: Start::Data, .. }))
    }

    /// How the network is read at a level. VE and VP: the network predicts the noise z and is fed x^τ as it is, so that
    /// q = −F / σ, and B.2's λ(τ) ‖q + z/σ‖² with λ = σ² is ‖F − z‖². EDM: Table 1 of Karras et al., whose loss weight
    /// times c_out² is 1 as well. In all of them the loss is thus ‖F − [`Process::network_target`]‖².
    pub fn precondition(&self, level: Level) -> Precondition {
        let Level { tau, alpha, sigma } = level;
        match *self {
            Process::Ve(_) | Process::Vp(_) => {
                Precondition { skip: 1.0 / alpha, out: -sigma / alpha, scale: 1.0, time: tau }
            }
            Process::Edm(Edm { sigma_data: d, .. }) => {
                let norm = (sigma * sigma + d * d).sqrt();
                Precondition {
                    skip: d * d / (norm * norm),
                    out: sigma * d / norm,
                    scale: 1.0 / norm,
                    time: sigma.ln() / 4.0,
                }
            }
        }
    }

    /// (a, b) such that the network should give a x⁰ + b z: what makes D(α x⁰ + σ z) = x⁰.
    pub fn network_target(&self, level: Level) -> (f64, f64) {
        match *self {
            Process::Ve(_) | Process::Vp(_) => (0.0, 1.0),
            Process::Edm(Edm { sigma_data: d, .. }) => {
                let norm = (level.sigma * level.sigma + d * d).sqrt();
                (level.sigma / (d * norm), -d / norm)
            }
        }
    }

    /// The reverse step from `from` to the less noisy `to`. VE and VP: f and g at `from`, as B.3 writes it, with |Δτ| for
    /// its (negative) Δτ. EDM: g² |Δτ| is the exact σ² difference (Song et al. 2021, Eq. 46), for its grid is coarse.
    pub fn increment(&self, from: Level, to: Level) -> Increment {
        let step = from.tau - to.tau;
        match *self {
            Process::Ve(Ve { alpha_min, alpha_max, .. }) => {
                let b = integral(alpha_min, alpha_max, from.tau);
                let g2 = (alpha_min + (alpha_max - alpha_min) * from.tau) * (-b).exp();
                Increment { keep: 1.0, score: g2 * step, variance: g2 * step }
            }
            Process::Vp(Vp { alpha_min, alpha_max, .. }) => {
                let g2 = alpha_min + (alpha_max - alpha_min) * from.tau;
                Increment { keep: 1.0 + 0.5 * g2 * step, score: g2 * step, variance: g2 * step }
            }
            Process::Edm(_) => {
                let difference = from.sigma * from.sigma - to.sigma * to.sigma;
                Increment { keep: 1.0, score: difference, variance: difference }
            }
        }
    }

    /// α of the Langevin step at `to`, reached from `from` (Song et al. 2021, Alg. 4 and 5): 1 for VE and EDM, 1 − β|Δτ|
    /// for VP.
    pub fn langevin_scale(&self, from: Level, to: Level) -> f64 {
        match *self {
            Process::Vp(Vp { alpha_min, alpha_max, .. }) => {
                (1.0 - (alpha_min + (alpha_max - alpha_min) * to.tau) * (from.tau - to.tau)).max(0.0)
            }
            _ => 1.0,
        }
    }
}

/// A uniform index below `n`.
pub(crate) fn draw_index(rng: &mut Rng, n: usize) -> usize {
    rng.random_range(0..n)
}

#[cfg(test)]
mod tests;
