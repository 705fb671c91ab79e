//! DARA (Liu et al. 2022): lowers source rewards where a source transition is unlikely in the target.
//!
//! ```text
//! C_sas, C_sa: classifiers of (s, a, s') and (s, a) into source and target, on inputs x + σ n, n ~ N(0, I)
//! L_C = CE(C_sas) + CE(C_sa)                                                      → both classifiers
//! Δ   = ln p(tar|s,a,s') - ln p(tar|s,a) - ln p(src|s,a,s') + ln p(src|s,a),  each p + 1e-10;  Δ ← clip(Δ, ±c)
//! r   ← r + η Δ  for source rows                                  then a step of IQL ([`crate::iql`])
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | η | `eta` | .1 | ODRL |
//! | c | `clip` | 10 | ODRL |
//! | σ | `noise` | 1 | ODRL, on raw inputs; here on inputs as the networks see them |
//! | - | `hidden` | 256, 256 ReLU | ODRL |
//! | - | `lr` | 3e-4 | ODRL |
//! | - | `mode` | corrected | published: p is a softmax of a softmax (below) |
//!
//! r is the raw reward: a member's `reward_scale` multiplies Δ as it multiplies r. Where s' is unknown, at terminal rows
//! of logs without next states, Δ is 0, and the classifiers do not see the row.
//!
//! **Published**: ODRL's forward pass ends in a softmax, and both callers use the result as logits. L_C is then between
//! .31 and 1.31 for every row, and its gradient vanishes where the classifier is certain. Δ should be a difference of
//! log-odds, but becomes a difference of probabilities with |Δ| ≤ 2: no source row loses more than 2 η, not up to c η
//! as in the method.

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_nn::burn::tensor::activation::{log_softmax, softmax};
use tce_nn::{Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained};

use crate::buffer::{Buffer, Minibatch};
use crate::critic::state_action;
use crate::error::{LearnError, within};
use crate::iql::{Iql, IqlConfig};
use crate::losses::member_mean;
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::mode::Mode;
use crate::on_iql::{BatchTransform, OnIql};
use crate::regulariser::Regulariser;
use crate::selection::need_others;
use crate::training::{Meter, member_noise};

const ABOUT: About = About {
    name: "dara",
    title: "DARA",
    description: "IQL; source rewards lowered where two classifiers tell the domains apart",
    reference: "Liu et al. 2022; ODRL",
    published: Some("the classifiers' softmax is taken for logits, by their loss and by the rewards"),
    table: "dara",
    needs: OtherRows::Source,
    episodes: false,
    scores: RowScores::None,
};

impl Method for DaraConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        within("eta", self.eta, 0.0..=1e6)?;
        within("clip", self.clip, 0.0..=1e6)?;
        within("noise", self.noise, 0.0..=1e6)?;
        within("lr", self.lr, 0.0..=1.0)
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let Some(regulariser) = on.regulariser(self)? else { return Ok(None) };
        Ok(Some(Box::new(Dara::new(on.buffer, self, on.iql, regulariser, on.steps, on.device)?)))
    }

    fn mode(&self) -> Option<Mode> {
        Some(self.mode)
    }

    fn backbone(&self, iql: &IqlConfig) -> Option<IqlConfig> {
        Some(iql.clone())
    }
}

/// Added to a probability before its logarithm (ODRL).
const TINY: f64 = 1e-10;

/// The configuration of [`Dara`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DaraConfig {
    /// How often the classifiers' outputs go through a softmax: once as meant, twice as the public code has it.
    pub mode: Mode,
    /// η, the weight of the classifiers' correction of the source's rewards. Source: ODRL.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub eta: f64,
    /// c, the greatest correction before η multiplies it, up or down. Source: ODRL.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub clip: f64,
    /// σ, the noise on the classifiers' inputs in training. Source: ODRL, on raw inputs.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub noise: f64,
    /// Widths of the hidden layers of the classifiers. Source: ODRL.
    pub hidden: Vec<usize>,
    /// Learning rate of the classifiers, constant. Source: ODRL.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr: f64,
}

impl Default for DaraConfig {
    fn default() -> Self {
        Self { mode: Mode::default(), eta: 0.1, clip: 10.0, noise: 1.0, hidden: vec![256, 256], lr: 3e-4 }
    }
}

/// DARA of a population.
pub type Dara = OnIql<Classifiers>;

/// C_sas and C_sa.
pub struct Classifiers {
    config: DaraConfig,
    sas: Trained<Mlp>,
    sa: Trained<Mlp>,
    /// The classifiers draw their own batches from it, of rows whose s' is known.
    buffer: Buffer,
    /// What a batch has multiplied rewards by, `[P, 1, 1]`.
    scales: Tensor<3>,
}

impl Dara {
    /// New networks for the members of `buffer`, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If a configuration cannot be used, there are no source rows, or the s' of no row of a table is known.
    pub fn new(
        buffer: &Buffer,
        config: &DaraConfig,
        iql: &IqlConfig,
        regulariser: Regulariser,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        config.check()?;
        need_others("DARA", buffer.members())?;
        let (members, train) = (buffer.streams(), device.clone().autodiff());
        let (s, a) = (buffer.inputs().len(), buffer.act_dim());
        let classifier = |name: &str, inputs: usize| {
            Trained::new(MlpConfig::relu(inputs, &config.hidden, 2).init(&members, name, &train))
        };
        let transform = Classifiers {
            sas: classifier("dara sas", 2 * s + a),
            sa: classifier("dara sa", s + a),
            buffer: buffer.clone().with_stream("dara batch").with_successors()?,
            scales: buffer.reward_scales(device),
            config: config.clone(),
        };
        Ok(OnIql { iql: Iql::new(buffer, iql, regulariser, steps, device)?, transform })
    }
}

/// The logits of a classifier with `outputs` `[P, B, 2]` in a mode. Published: their softmax.
fn logits(outputs: Tensor<3>, mode: Mode) -> Tensor<3> {
    match mode {
        Mode::Published => softmax(outputs, 2),
        Mode::Corrected => outputs,
    }
}

/// Cross-entropy of `outputs` `[P, B, 2]` against the labels target (1) for the first `target_rows` rows and source (0) for the
/// others, mean over rows.
pub fn domain_cross_entropy(outputs: Tensor<3>, target_rows: usize, mode: Mode) -> Tensor<3> {
    let [_, b, _] = outputs.dims();
    let log_p = log_softmax(logits(outputs, mode), 2);
    let target = log_p.clone().narrow(1, 0, target_rows).narrow(2, 1, 1);
    let source = log_p.narrow(1, target_rows, b - target_rows).narrow(2, 0, 1);
    -member_mean(Tensor::cat(vec![target, source], 1))
}

/// Δ `[P, B, 1]` before clipping, from the outputs `[P, B, 2]` of the two classifiers.
pub fn dynamics_gap(sas: Tensor<3>, sa: Tensor<3>, mode: Mode) -> Tensor<3> {
    let log_p = |outputs: Tensor<3>, k: usize| (softmax(outputs, 2).narrow(2, k, 1) + TINY).log();
    let (sas, sa) = (logits(sas, mode), logits(sa, mode));
    log_p(sas.clone(), 1) - log_p(sa.clone(), 1) - log_p(sas, 0) + log_p(sa, 0)
}

fn join(batch: &Minibatch) -> (Tensor<3>, Tensor<3>) {
    let sa = state_action(&batch.s, batch.a.clone());
    (Tensor::cat(vec![sa.clone(), batch.s2.clone()], 2), sa)
}

impl BatchTransform for Classifiers {
    fn transform(
        &mut self,
        _iql: &Iql,
        batch: &Minibatch,
        step: u64,
        meter: &mut Meter,
    ) -> (Minibatch, Option<Tensor<3>>) {
        let Self { config: c, sas, sa, buffer, scales } = self;
        let (members, device) = (&buffer.streams(), &batch.s.device());
        let rows = buffer.sample(step, device);
        let (x, y) = join(&rows);
        let train = |net: &mut Trained<Mlp>, x: Tensor<3>, name: &str| {
            let noise = member_noise(members, name, step, x.dims(), device);
            let loss = domain_cross_entropy(net.net().forward(x + noise * c.noise), rows.target_rows, c.mode);
            let value = loss.clone().inner();
            net.step(loss.sum(), c.lr);
            value
        };
        let (a, b) = rayon::join(|| train(sas, x, "dara noise sas"), || train(sa, y, "dara noise sa"));
        meter.record("classifier_loss", &(a + b));

        let (first, others) = (batch.target_rows, batch.s.dims()[1] - batch.target_rows);
        let (x, y) = join(batch);
        let source = |x: Tensor<3>| x.narrow(1, first, others);
        let gap = dynamics_gap(sas.net().valid().forward(source(x)), sa.net().valid().forward(source(y)), c.mode);
        let gap = gap.clamp(-c.clip, c.clip) * buffer.known(batch, first);
        meter.record("dynamics_gap", &gap);
        let corrected = source(batch.r.clone()) + gap * c.eta * scales.clone();
        let r = Tensor::cat(vec![batch.r.clone().narrow(1, 0, first), corrected], 1);
        (Minibatch { r, ..batch.clone() }, None)
    }

    fn save(&self, state: &mut NamedParameters) {
        self.sas.save("dara sas", state);
        self.sa.save("dara sa", state);
    }

    fn load(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.sas.load("dara sas", state, path)?;
        self.sa.load("dara sa", state, path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buffer::tests::of_two_scales;
    use tce_data::Transitions;
    use tce_nn::{cpu, host, tensor};

    /// Two members with the same rows and networks, but for the scale of their rewards, which are all 0. Every fifth row is
    /// terminal, and its s' is unknown.
    #[test]
    fn the_correction_is_in_the_units_of_the_rewards_and_needs_a_successor() {
        let mut t = Transitions::new(1, 1);
        for i in 0..40 {
            let x = i as f32 / 20.0 - 0.95;
            t.push(&[x], &[-x], 0.0, &[x], i % 5 == 4, false);
        }
        t.known = t.terminals.iter().map(|terminal| !terminal).collect();
        let buffer = of_two_scales(t, 2, 64);
        let config = DaraConfig { hidden: vec![8], ..DaraConfig::default() };
        let iql = IqlConfig { hidden: vec![8], ..IqlConfig::paper() };
        let mut dara = Dara::new(&buffer, &config, &iql, Regulariser::None, 1, &cpu()).unwrap();
        let batch = buffer.sample(0, &cpu());
        let known = buffer.known_from(&batch, 0);
        let changed = dara.transform.transform(&dara.iql, &batch, 0, &mut Meter::default()).0;
        assert_eq!((&changed.picks, host(changed.not_done)), (&batch.picks, host(batch.not_done)));
        let r = host(changed.r);
        for k in 0..64 {
            let (one, ten) = (r[k], r[64 + k]);
            assert_eq!(one != 0.0, k >= 32 && known[k], "row {k}: {one}");
            assert!((10.0 * one - ten).abs() < 1e-5, "row {k}: {one} {ten}");
        }
        assert!(known[32..64].iter().any(|known| !known), "some source rows have no s'");
    }

    fn outputs() -> Tensor<3> {
        // Rows: one target row, two source rows; columns: source, target.
        tensor(vec![-1.0, 2.0, 0.5, -0.5, 3.0, 4.0], [1, 3, 2], &cpu())
    }

    fn softmax2(a: f64, b: f64) -> (f64, f64) {
        let z = a.exp() + b.exp();
        (a.exp() / z, b.exp() / z)
    }

    #[test]
    fn the_modes_differ_by_one_softmax() {
        let rows = [(-1.0, 2.0, true), (0.5, -0.5, false), (3.0, 4.0, false)];
        let entropy = |twice: bool| {
            let of = |&(a, b, target): &(f64, f64, bool)| {
                let (a, b) = if twice { softmax2(a, b) } else { (a, b) };
                let (source, tar) = softmax2(a, b);
                -(if target { tar } else { source }).ln()
            };
            rows.iter().map(of).sum::<f64>() / 3.0
        };
        for (mode, twice) in [(Mode::Corrected, false), (Mode::Published, true)] {
            let loss = host(domain_cross_entropy(outputs(), 1, mode))[0] as f64;
            assert!((loss - entropy(twice)).abs() < 1e-6, "{mode:?}: {loss} is not {}", entropy(twice));
        }
    }

    #[test]
    fn the_gap_is_the_difference_of_log_odds() {
        // If no probability is near 0, the log-odds are the differences of the outputs.
        let sa = tensor(vec![0.2, 0.1, 0.0, 0.0, -1.0, 1.0], [1, 3, 2], &cpu());
        let gap = host(dynamics_gap(outputs(), sa.clone(), Mode::Corrected));
        for (gap, expected) in gap.iter().zip([3.0 + 0.1, -1.0, 1.0 - 2.0]) {
            assert!((gap - expected).abs() < 1e-5, "{gap} is not {expected}");
        }
        // Probabilities used as outputs: p_tar − p_src of either classifier.
        let gap = host(dynamics_gap(outputs(), sa, Mode::Published));
        let odds = |a: f64, b: f64| softmax2(a, b).1 - softmax2(a, b).0;
        let expected = [odds(-1.0, 2.0) - odds(0.2, 0.1), odds(0.5, -0.5), odds(3.0, 4.0) - odds(-1.0, 1.0)];
        for (gap, expected) in gap.iter().zip(expected) {
            assert!((*gap as f64 - expected).abs() < 1e-5, "{gap} is not {expected}");
        }
    }
}
