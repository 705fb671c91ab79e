//! IGDF (Wen et al. 2024): keeps source rows whose successor fits the target's dynamics (contrastive learning).
//!
//! ```text
//! φ: (s, a) → R^k, ψ: s' → R^k;  x_ij = φ_i · ψ_j for a target row i, j its own successor or that of a source row
//! L_φψ = mean over i, j of BCE-with-logits(x_ij, 1[j is i's own])                  → φ, ψ, before the first step
//! score = cos(φ(s, a), ψ(s')) of the batch's source rows; the best share ξ of them is kept
//! w   = exp(α score) for source rows, 1 for target rows: weights of L_Q           then a step of IQL ([`crate::iql`])
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | ξ | `keep` | .75 | ODRL (.25, .5 on some tasks) |
//! | α | `weight` | 1 | ODRL |
//! | k | `features` | 64 | ODRL |
//! | - | `hidden` | 256, 256 ReLU | ODRL |
//! | - | `lr` | 3e-4 | ODRL |
//! | - | `steps` | 7000 | ODRL |
//! | - | `batch` | 128 target rows, 127 source rows for all of them | ODRL |
//! | - | `mode`, `code` | corrected | published, odrl: φ and ψ stay as they were drawn; published, authors: w is its mean |
//!
//! Where s' is unknown, at terminal rows of logs without next states, there is no score: the row borrows that of another
//! source row of the batch (`lend_scores` in [`crate::selection`]), and φ and ψ do not see it.
//!
//! **Published**: there are two public implementations. ODRL defines the training of φ and ψ but never calls it, so
//! random networks select the rows. IGDF's authors train them, but multiply weights `[N, 1]` by squared errors `[N]`:
//! the mean of that N × N matrix is the mean weight times L_Q, so all rows have the same weight.

use std::path::Path;

use serde::{Deserialize, Serialize};
use tce_nn::{Device, Mlp, MlpConfig, Module, NamedParameters, NetworkError, Tensor, Trained};

use crate::buffer::{Buffer, Minibatch};
use crate::critic::state_action;
use crate::error::{LearnError, within};
use crate::iql::{Iql, IqlConfig};
use crate::losses::{binary_cross_entropy, member_mean};
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::mode::Mode;
use crate::on_iql::{BatchTransform, OnIql};
use crate::policy::PolicyLearner;
use crate::regulariser::Regulariser;
use crate::selection::{Selected, host_from, lend_scores, need_others};
use crate::training::{Learner, Meter, Place, prepare};

const ABOUT: About = About {
    name: "igdf",
    title: "IGDF",
    description: "IQL; source rows chosen by a contrastive model of the target's dynamics",
    reference: "Wen et al. 2024; ODRL",
    published: Some(
        "the contrastive model is never trained; with learner.igdf.code = \"authors\" instead all rows have the same weight",
    ),
    table: "igdf",
    needs: OtherRows::Source,
    episodes: false,
    scores: RowScores::None,
};

impl Method for IgdfConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        within("keep", self.keep, 0.0..=1.0)?;
        within("weight", self.weight, 0.0..=1e3)?;
        within("features", self.features as f64, 1.0..=1e5)?;
        within("lr", self.lr, 0.0..=1.0)?;
        within("batch", self.batch as f64, 2.0..=1e6)
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let Some(regulariser) = on.regulariser(self)? else { return Ok(None) };
        let learner = Igdf::new(on.buffer, self, on.iql, regulariser, on.steps, on.place, on.device)?;
        Ok(learner.map(|learner| Box::new(learner) as Box<dyn PolicyLearner>))
    }

    fn mode(&self) -> Option<Mode> {
        Some(self.mode)
    }

    fn backbone(&self, iql: &IqlConfig) -> Option<IqlConfig> {
        Some(iql.clone())
    }
}

/// Whose code [`Mode::Published`] follows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Code {
    /// ODRL's: φ and ψ are never trained.
    #[default]
    Odrl,
    /// IGDF's authors': all rows have the same weight, by a broadcast.
    Authors,
}

/// The configuration of [`Igdf`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct IgdfConfig {
    /// As meant, or with the defect that `learner.igdf.code` names.
    pub mode: Mode,
    /// Whose defect `learner.igdf.mode = "published"` has. It changes nothing where the mode is "corrected".
    pub code: Code,
    /// ξ, the share of a batch's source rows that are learned from, those with the highest scores. Source: ODRL, .25 and .5 on some
    /// tasks.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub keep: f64,
    /// α, how strongly a source row's score decides its weight in the critics' loss. Source: ODRL.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub weight: f64,
    /// k, the width of the representations φ and ψ. Source: ODRL.
    #[schemars(range(min = 1, max = 100000))]
    pub features: usize,
    /// Widths of the hidden layers of φ and ψ. Source: ODRL.
    pub hidden: Vec<usize>,
    /// Learning rate of φ and ψ, constant. Source: ODRL.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lr: f64,
    /// Training steps of φ and ψ, before the learner's first. Source: ODRL.
    pub steps: u64,
    /// Target rows of a step of φ and ψ; 127 source rows stand against all of them. Source: ODRL.
    #[schemars(range(min = 2, max = 1000000))]
    pub batch: usize,
}

impl Default for IgdfConfig {
    fn default() -> Self {
        let (mode, code, hidden) = (Mode::default(), Code::default(), vec![256, 256]);
        Self { mode, code, keep: 0.75, weight: 1.0, features: 64, hidden, lr: 3e-4, steps: 7000, batch: 128 }
    }
}

impl IgdfConfig {
    /// Whether training includes the defect of `code`.
    fn as_in(&self, code: Code) -> bool {
        self.mode == Mode::Published && self.code == code
    }
}

/// φ and ψ.
#[derive(Module, Debug)]
struct Pair {
    phi: Mlp,
    psi: Mlp,
}

/// φ and ψ of a population, with their training.
pub struct Encoders {
    config: IgdfConfig,
    pair: Trained<Pair>,
    /// Tells whose s' is known.
    buffer: Buffer,
}

impl Encoders {
    fn new(buffer: &Buffer, config: &IgdfConfig, device: &Device) -> Self {
        let (members, device) = (buffer.streams(), device.clone().autodiff());
        let (s, a) = (buffer.inputs().len(), buffer.act_dim());
        let net = |name: &str, inputs: usize| {
            MlpConfig::relu(inputs, &config.hidden, config.features).init(&members, name, &device)
        };
        let pair = Pair { phi: net("igdf phi", s + a), psi: net("igdf psi", s) };
        Self { pair: Trained::new(pair), config: config.clone(), buffer: buffer.clone() }
    }

    /// cos(φ(s, a), ψ(s')) of the rows that are not target rows, sorted by member; borrowed where s' is unknown.
    fn scores(&self, batch: &Minibatch) -> Vec<f32> {
        let (first, sa) = (batch.target_rows, state_action(&batch.s, batch.a.clone()));
        let pair = self.pair.net().valid();
        let mut scores = host_from(cosine(pair.phi.forward(sa), pair.psi.forward(batch.s2.clone())), first);
        lend_scores(&self.buffer.known_from(batch, first), &mut scores, batch.s.dims()[1] - first);
        scores
    }
}

/// Cosine of the angle between the rows of x and y `[P, B, k]`, `[P, B, 1]`; 0 where one of them is zero.
pub fn cosine(x: Tensor<3>, y: Tensor<3>) -> Tensor<3> {
    let norm = |v: &Tensor<3>| v.clone().square().sum_dim(2).sqrt();
    let norms = (norm(&x) * norm(&y)).clamp_min(1e-8);
    (x * y).sum_dim(2) / norms
}

/// L_φψ per member: `phi` and `psi` `[P, N, k]` of target rows, `others` `[P, M, k]` of the source rows' successors.
pub fn contrast(phi: Tensor<3>, psi: Tensor<3>, others: Tensor<3>) -> Tensor<3> {
    let ([p, n, _], [_, m, _]) = (phi.dims(), others.dims());
    let own = (phi.clone() * psi).sum_dim(2);
    let other = phi.matmul(others.swap_dims(1, 2)).reshape([p, n * m, 1]);
    let (ones, zeros) = (own.clone().inner().ones_like(), other.clone().inner().zeros_like());
    let (own, other) = (binary_cross_entropy(own, ones), binary_cross_entropy(other, zeros));
    (own + other * m as f64) / (m + 1) as f64
}

impl Learner for Encoders {
    fn update(&mut self, batch: &Minibatch, _step: u64, meter: &mut Meter) {
        let (n, rows) = (batch.target_rows, batch.s.dims()[1]);
        let sa = state_action(&batch.s, batch.a.clone()).narrow(1, 0, n);
        let phi = self.pair.net().phi.forward(sa);
        let psi = self.pair.net().psi.forward(batch.s2.clone());
        let loss = contrast(phi, psi.clone().narrow(1, 0, n), psi.narrow(1, n, rows - n));
        meter.record("contrast", &loss);
        self.pair.step(loss.sum(), self.config.lr);
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        self.save(&mut state);
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.load(state, path)
    }
}

/// IGDF of a population.
pub type Igdf = OnIql<Encoders>;

impl Igdf {
    /// New networks for the members of `buffer`, to be trained for `steps` steps. φ and ψ are trained here. `None` if
    /// the user interrupted their training.
    ///
    /// # Errors
    /// If a configuration cannot be used, there are no source rows, or the s' of no row of a table is known.
    pub fn new(
        buffer: &Buffer,
        config: &IgdfConfig,
        iql: &IqlConfig,
        regulariser: Regulariser,
        steps: u64,
        place: Place<'_>,
        device: &Device,
    ) -> Result<Option<Self>, LearnError> {
        config.check()?;
        need_others("IGDF", buffer.members())?;
        let mut encoders = Encoders::new(buffer, config, device);
        if !config.as_in(Code::Odrl) {
            // The batch is split evenly, so there is one source row less than target rows.
            let rows = Buffer::new(buffer.members().to_vec(), 2 * config.batch - 1)?.with_stream("igdf batch");
            let rows = rows.with_successors()?;
            if !prepare(&mut encoders, &rows, config.steps, "IGDF encoders", place, device)? {
                return Ok(None);
            }
        }
        Ok(Some(OnIql { iql: Iql::new(buffer, iql, regulariser, steps, device)?, transform: encoders }))
    }
}

impl BatchTransform for Encoders {
    fn transform(
        &mut self,
        _iql: &Iql,
        batch: &Minibatch,
        _step: u64,
        meter: &mut Meter,
    ) -> (Minibatch, Option<Tensor<3>>) {
        let (keep, weight) = (self.config.keep, self.config.weight as f32);
        let mut selected = Selected::new(batch, &self.scores(batch), keep, |score| (weight * score).exp());
        if self.config.as_in(Code::Authors) {
            selected.weights = member_mean(selected.weights.clone()).expand(selected.weights.dims());
        }
        selected.recorded(meter)
    }

    fn save(&self, state: &mut NamedParameters) {
        self.pair.save("igdf", state);
    }

    fn load(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.pair.load("igdf", state, path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buffer::Member;
    use std::sync::Arc;
    use tce_base::Streams;
    use tce_data::{Standardizer, Transitions};
    use tce_nn::{cpu, host, tensor};

    /// Compares with the definition, a matrix of N rows and 1 + M columns.
    #[test]
    fn the_contrast_follows_its_formula() {
        let (phi, psi) = (vec![1.0, 0.0, 0.5, -1.0], vec![2.0, 1.0, 0.0, 1.0]);
        let others = vec![1.0, 1.0, -1.0, 0.0, 0.0, 3.0];
        let dot = |a: &[f32], b: &[f32]| f64::from(a[0] * b[0] + a[1] * b[1]);
        let softplus = |x: f64| x.exp().ln_1p();
        let mut expected = 0.0;
        for i in 0..2 {
            let row = &phi[2 * i..2 * i + 2];
            expected += softplus(-dot(row, &psi[2 * i..2 * i + 2]));
            expected += others.chunks(2).map(|o| softplus(dot(row, o))).sum::<f64>();
        }
        let t = |v: &[f32], n: usize| tensor(v.to_vec(), [1, n, 2], &cpu());
        let loss = host(contrast(t(&phi, 2), t(&psi, 2), t(&others, 3)))[0] as f64;
        assert!((loss - expected / 8.0).abs() < 1e-6, "{loss} is not {}", expected / 8.0);
    }

    /// Same encoders, same batch: the authors' defect keeps the same rows, but gives all of them the mean weight.
    #[test]
    fn the_authors_code_weighs_all_rows_alike() {
        let mut t = Transitions::new(2, 1);
        for i in 0..40 {
            let x = i as f32 / 7.0;
            t.push(&[x.sin(), x.cos()], &[(2.0 * x).sin()], x, &[(3.0 * x).sin(), x.cos()], false, i % 10 == 9);
        }
        let t = Arc::new(t);
        let (streams, standardizer) = (Streams::new(1), Standardizer::fit(&t.observations, 2));
        let parts = vec![t.clone(), t];
        let member = Member { streams, parts, standardizer, reward_scale: 1.0, row_scores: None };
        let buffer = Buffer::new(vec![member], 16).unwrap();
        let batch = buffer.sample(3, &cpu());
        let shaped = |mode| {
            let small = IgdfConfig { hidden: vec![8], features: 4, steps: 3, batch: 4, ..IgdfConfig::default() };
            let config = IgdfConfig { mode, code: Code::Authors, ..small };
            let iql = IqlConfig { hidden: vec![8], ..IqlConfig::paper() };
            let igdf = Igdf::new(&buffer, &config, &iql, Regulariser::None, 1, Place::NONE, &cpu());
            let mut igdf = igdf.unwrap().unwrap();
            let (batch, weights) = igdf.transform.transform(&igdf.iql, &batch, 3, &mut Meter::default());
            (batch.picks, host(weights.unwrap()))
        };
        let ((rows, own), (same_rows, alike)) = (shaped(Mode::Corrected), shaped(Mode::Published));
        assert_eq!((rows.len(), &rows), (8 + 6, &same_rows));
        assert!(own[..8].iter().all(|w| *w == 1.0) && own[8..].windows(2).any(|w| w[0] != w[1]), "{own:?}");
        let mean = own.iter().sum::<f32>() / 14.0;
        assert!(alike.len() == 14 && alike.iter().all(|w| (w - mean).abs() < 1e-6), "{alike:?} {mean}");
    }

    #[test]
    fn cosines_are_those_of_angles() {
        let x = tensor(vec![3.0, 4.0, 0.0, 0.0, 1.0, 0.0], [1, 3, 2], &cpu());
        let y = tensor(vec![4.0, 3.0, 1.0, 0.0, -2.0, 0.0], [1, 3, 2], &cpu());
        assert_eq!(host(cosine(x, y)), [0.96, 0.0, -1.0]);
    }
}
