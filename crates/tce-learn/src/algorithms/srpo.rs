//! SRPO (Xue et al. 2023) on IQL, as IGDF's authors compare it: raises rewards of states that resemble high-value ones.
//!
//! ```text
//! rows of a batch ranked by V(s): the best share ρ gets label 1, the rest 0
//! L_D = BCE-with-logits(D(s), label)                                               → D
//! r   ← r + λ ln clip(x, 1/c, c),   x = exp D(s) = p/(1 - p), the odds             then a step of IQL ([`crate::iql`])
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | λ | `lambda` | .1 | IGDF's repository (some tasks .3) |
//! | ρ | `share` | .5 | the same (some tasks .2) |
//! | c | `clip` | 10 | the same |
//! | - | `hidden` | 256, 256 ReLU | the same |
//! | - | `lr` | 1e-3 | the same |
//! | - | `mode` | corrected | published: x is the logit D(s) itself |
//!
//! r is the raw reward: a member's `reward_scale` multiplies the added term as it multiplies r.
//!
//! IGDF's authors base it on another IQL (Gaussian log-likelihood for the policy:
//! `learner.iql.policy_extraction = "awr_logprob"`); here all prior methods use the same IQL.
//!
//! **Published**: the code clamps the logit instead of the odds. Every state with D(s) ≤ .1 (odds below 1.1) then loses
//! λ ln 10, however dissimilar it is, and the logarithm of a logit hardly grows.

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_nn::{Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained, host, tensor};

use crate::buffer::{Buffer, Minibatch};
use crate::error::{LearnError, within};
use crate::iql::{Iql, IqlConfig};
use crate::losses::binary_cross_entropy;
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::mode::Mode;
use crate::on_iql::{BatchTransform, OnIql};
use crate::regulariser::Regulariser;
use crate::selection::{best_others, kept_rows};
use crate::training::Meter;

const ABOUT: About = About {
    name: "srpo",
    title: "SRPO",
    description: "IQL; rewards raised where the state looks like one of high value",
    reference: "Xue et al. 2023; IGDF's repository",
    published: Some("the discriminator's logit is clamped where its odds are meant"),
    table: "srpo",
    needs: OtherRows::Any,
    episodes: false,
    scores: RowScores::None,
};

impl Method for SrpoConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        within("lambda", self.lambda, 0.0..=1e6)?;
        within("share", self.share, 0.0..=1.0)?;
        within("clip", self.clip, 1.0..=1e6)?;
        within("lr", self.lr, 0.0..=1.0)
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let Some(regulariser) = on.regulariser(self)? else { return Ok(None) };
        Ok(Some(Box::new(Srpo::new(on.buffer, self, on.iql, regulariser, on.steps, on.device)?)))
    }

    fn mode(&self) -> Option<Mode> {
        Some(self.mode)
    }

    fn backbone(&self, iql: &IqlConfig) -> Option<IqlConfig> {
        Some(iql.clone())
    }
}

/// The configuration of [`Srpo`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SrpoConfig {
    /// What enters the reward: the odds of the discriminator, or, as the public code has it, its logit.
    pub mode: Mode,
    /// λ, the weight of the discriminator's term in the rewards. Source: IGDF's repository, .3 on some tasks.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub lambda: f64,
    /// ρ, the share of a batch's states, those of the highest value, that the discriminator is shown as good. Source: IGDF's
    /// repository, .2 on some tasks.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub share: f64,
    /// c, the greatest odds that count; 1/c is the least. Source: IGDF's repository.
    #[schemars(range(min = 1.0, max = 1000000.0))]
    pub clip: f64,
    /// Widths of the hidden layers of the discriminator. Source: IGDF's repository.
    pub hidden: Vec<usize>,
    /// Learning rate of the discriminator, constant. Source: IGDF's repository.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr: f64,
}

impl Default for SrpoConfig {
    fn default() -> Self {
        Self { mode: Mode::default(), lambda: 0.1, share: 0.5, clip: 10.0, hidden: vec![256, 256], lr: 1e-3 }
    }
}

/// SRPO of a population.
pub type Srpo = OnIql<Discriminator>;

/// D.
pub struct Discriminator {
    config: SrpoConfig,
    net: Trained<Mlp>,
    /// What a batch has multiplied rewards by, `[P, 1, 1]`.
    scales: Tensor<3>,
}

impl Srpo {
    /// New networks for the members of `buffer`, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If a configuration cannot be used.
    pub fn new(
        buffer: &Buffer,
        config: &SrpoConfig,
        iql: &IqlConfig,
        regulariser: Regulariser,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        config.check()?;
        let net = MlpConfig::relu(buffer.inputs().len(), &config.hidden, 1);
        let net = net.init(&buffer.streams(), "srpo", &device.clone().autodiff());
        let (config, net, scales) = (config.clone(), Trained::new(net), buffer.reward_scales(device));
        let transform = Discriminator { config, net, scales };
        Ok(OnIql { iql: Iql::new(buffer, iql, regulariser, steps, device)?, transform })
    }
}

/// 1 for the share `share` of the rows with the highest values, per member, 0 for the others; `[P, B, 1]` as `values`.
pub fn high_value_labels(values: Tensor<3>, share: f64) -> Tensor<3> {
    let ([p, b, _], device) = (values.dims(), values.device());
    let mut labels = vec![0.0; p * b];
    for (labels, best) in labels.chunks_mut(b).zip(best_others(0, &host(values), b, kept_rows(share, b))) {
        best.into_iter().for_each(|i| labels[i] = 1.0);
    }
    tensor(labels, [p, b, 1], &device)
}

/// λ ln clip(x, 1/c, c) for the logits of the discriminator.
pub fn reward_shift(logits: Tensor<3>, config: &SrpoConfig) -> Tensor<3> {
    let (low, high) = (1.0 / config.clip, config.clip);
    let log = match config.mode {
        Mode::Published => logits.clamp(low, high).log(),
        // ln clip(exp D, 1/c, c), computed without the exponential, which would overflow.
        Mode::Corrected => logits.clamp(low.ln(), high.ln()),
    };
    log * config.lambda
}

impl BatchTransform for Discriminator {
    fn transform(
        &mut self,
        iql: &Iql,
        batch: &Minibatch,
        _step: u64,
        meter: &mut Meter,
    ) -> (Minibatch, Option<Tensor<3>>) {
        let Self { config: c, net, scales } = self;
        let labels = high_value_labels(iql.values(batch.s.clone()), c.share);
        let loss = binary_cross_entropy(net.net().forward(batch.s.clone()), labels);
        meter.record("discriminator_loss", &loss);
        net.step(loss.sum(), c.lr);
        let shift = reward_shift(net.net().valid().forward(batch.s.clone()), c);
        meter.record("reward_shift", &shift);
        (Minibatch { r: batch.r.clone() + shift * scales.clone(), ..batch.clone() }, None)
    }

    fn save(&self, state: &mut NamedParameters) {
        self.net.save("srpo", state);
    }

    fn load(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.net.load("srpo", state, path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buffer::tests::of_two_scales;
    use tce_data::Transitions;
    use tce_nn::cpu;

    #[test]
    fn the_modes_differ_in_what_is_clamped() {
        let logits = [-5.0f32, 0.05, 1.0, 20.0];
        let shift = |mode| {
            let config = SrpoConfig { mode, lambda: 0.3, ..SrpoConfig::default() };
            host(reward_shift(tensor(logits.to_vec(), [1, 4, 1], &cpu()), &config))
        };
        for (k, &x) in logits.iter().enumerate() {
            let published = 0.3 * x.clamp(0.1, 10.0).ln();
            let corrected = 0.3 * x.exp().clamp(0.1, 10.0).ln();
            assert!((shift(Mode::Published)[k] - published).abs() < 1e-6);
            assert!((shift(Mode::Corrected)[k] - corrected).abs() < 1e-6);
        }
    }

    /// Two members with the same rows and networks: what is added to a reward is multiplied as the reward is.
    #[test]
    fn the_term_is_in_the_units_of_the_rewards() {
        let mut t = Transitions::new(1, 1);
        for i in 0..20 {
            let x = i as f32 / 10.0 - 0.95;
            t.push(&[x], &[x], 0.0, &[x], false, i % 5 == 4);
        }
        let buffer = of_two_scales(t, 1, 8);
        let config = SrpoConfig { hidden: vec![8], ..SrpoConfig::default() };
        let iql = IqlConfig { hidden: vec![8], ..IqlConfig::paper() };
        let mut srpo = Srpo::new(&buffer, &config, &iql, Regulariser::None, 1, &cpu()).unwrap();
        let batch = buffer.sample(0, &cpu());
        let r = host(srpo.transform.transform(&srpo.iql, &batch, 0, &mut Meter::default()).0.r);
        for (&one, &ten) in r[..8].iter().zip(&r[8..]) {
            assert!(one != 0.0 && (10.0 * one - ten).abs() < 1e-5, "{one} {ten}");
        }
    }

    #[test]
    fn the_upper_half_is_labelled() {
        let values = tensor(vec![1.0, 4.0, 3.0, 2.0, 0.0, -1.0, -3.0, -2.0], [2, 4, 1], &cpu());
        assert_eq!(host(high_value_labels(values, 0.5)), [0.0, 1.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0]);
    }
}
