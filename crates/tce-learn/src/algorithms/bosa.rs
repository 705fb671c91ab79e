//! BOSA (Liu et al. 2024): critics learn from rows that both domains' dynamics support; the policy stays near the
//! behaviour.
//!
//! ```text
//! β̂(a|s), p̂_1..n(s'|s, a): variational autoencoders on rows of both domains ([`crate::cvae`]), before the first step
//! m   = 1[min over i of ln p̂_i(s'|s, a) > ln ε]
//! a'  = clip(π'(s') + clip(σ n, ±c), ±1);  y = r + γ (1 - terminal) min(Q1', Q2')(s', a')
//! L_Q = Σ_k [½ mean m (Qk(s, a) - y)² + λ_Q mean over source rows of Qk(s, a)]                     → Q1, Q2
//! every d-th step:  L_π = -mean Q1(s, π(s)) / mean |Q1(s, π(s))| - λ_π mean ln β̂(π(s)|s)           → π;  Q', π' follow
//! ```
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | ε | `threshold` | .01 | ODRL |
//! | λ_Q, λ_π | `value_weight`, `support_weight` | .1, .1 | ODRL |
//! | n | `ensemble` | 5 | ODRL |
//! | K, β² | `samples`, `std`² | 1, .125 | ODRL: one sample, √(β/4) with β = .5 |
//! | - | `cvae` | 256-256, 5 000 steps of 128 + 128 rows | ODRL: 750-750, 100 000 steps; ours fits two cores |
//! | γ | `discount` | .99 | ODRL |
//! | σ, c, d, ρ | `delay` | .2, .5, 2, .005 | ODRL |
//! | - | `critic_lr`, `hidden`, `actor` | 3e-4, 256-256 | ODRL |
//! | - | `mode` | corrected | published: y = r + γ terminal min(Q1', Q2')(s', a') |
//!
//! Here s' is standardised and without the dimensions that never change; ODRL models it raw and complete. The same ln ε
//! is therefore another threshold: with β² = .125 every perfectly modelled dimension adds .12 to ln p̂. In our runs the
//! mask keeps 95 % of the rows (Ant) or more.
//!
//! Where s' is unknown, at terminal rows of logs without next states, there is no density. Such rows count (m = 1), because
//! their y needs no s'; the autoencoders do not see them. In the published form y would need it, so that they do not count.
//!
//! **Published**: ODRL's buffer returns 1 - terminal, but its BOSA uses this value as terminal. It therefore bootstraps
//! at terminal rows only, and the critics learn the immediate reward.

use std::path::Path;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_nn::{Device, MlpConfig, NamedParameters, NetworkError, Tensor};

use crate::actor::ActorConfig;
use crate::buffer::{Buffer, Minibatch};
use crate::critic::state_action;
use crate::cvae::{Cvae, CvaeConfig, CvaeLearner, Density, Modelled};
use crate::deterministic::{ActorCritic, DelayConfig, Deterministic, UpdateRule};
use crate::error::{LearnError, within};
use crate::losses::{member_mean, squared_td_error};
use crate::method::{About, Built, Method, OtherRows, RowScores, Setup};
use crate::mode::Mode;
use crate::policy::PolicyLearner;
use crate::selection::need_others;
use crate::td3_bc::normalised_value;
use crate::training::{Learner, Meter, Place, prepare};

const ABOUT: About = About {
    name: "bosa",
    title: "BOSA",
    description: "deterministic actor-critic on the support of dynamics and behaviour models",
    reference: "Liu et al. 2024; ODRL",
    published: Some("critics bootstrap at terminal rows and nowhere else"),
    table: "bosa",
    needs: OtherRows::Source,
    episodes: false,
    scores: RowScores::None,
};

impl Method for BosaConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        within("threshold", self.threshold, f64::MIN_POSITIVE..=1e30)?;
        within("value_weight", self.value_weight, 0.0..=1e6)?;
        within("support_weight", self.support_weight, 0.0..=1e6)?;
        within("ensemble", self.ensemble as f64, 1.0..=1e3)?;
        within("samples", self.samples as f64, 1.0..=1e4)?;
        within("std", self.std, f64::MIN_POSITIVE..=1e6)?;
        within("discount", self.discount, 0.0..=1.0)?;
        within("critic_lr", self.critic_lr, 0.0..=1.0)?;
        self.delay.check()
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let learner = Bosa::new(on.buffer, self, on.steps, on.place, on.device)?;
        Ok(learner.map(|learner| Box::new(learner) as Box<dyn PolicyLearner>))
    }

    fn mode(&self) -> Option<Mode> {
        Some(self.mode)
    }
}

/// The configuration of [`Bosa`]; see the [module](self).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BosaConfig {
    /// Where critics bootstrap: where a row is not terminal, or, as the public code has it, where it is.
    pub mode: Mode,
    /// ε, the density of a row's successor below which the critics do not learn from the row. Source: ODRL.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e+30))]
    pub threshold: f64,
    /// λ_Q, the weight of the values of source rows, which the critics keep small. Source: ODRL.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub value_weight: f64,
    /// λ_π, the weight of the log density of the policy's actions under the behaviour model. Source: ODRL.
    #[schemars(range(min = 0.0, max = 1000000.0))]
    pub support_weight: f64,
    /// n, the models of s' given s and a. Source: ODRL.
    #[schemars(range(min = 1, max = 1000))]
    pub ensemble: usize,
    /// K, the samples behind an estimated density. Source: ODRL.
    #[schemars(range(min = 1, max = 10000))]
    pub samples: usize,
    /// Standard deviation of the decoders' densities. Source: ODRL, √(β/4) with β = .5.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1000000.0))]
    pub std: f64,
    /// The autoencoders; `batch` counts rows of both domains.
    pub cvae: CvaeConfig,
    /// γ, the discount factor. Source: ODRL.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub discount: f64,
    /// σ, c, d, ρ
    pub delay: DelayConfig,
    /// Learning rate of the critics, constant. Source: ODRL.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub critic_lr: f64,
    /// Widths of the hidden layers of the critics. Source: ODRL.
    pub hidden: Vec<usize>,
    /// The policy; its `form` is tanh mean.
    pub actor: ActorConfig,
}

impl Default for BosaConfig {
    fn default() -> Self {
        Self {
            mode: Mode::default(),
            threshold: 0.01,
            value_weight: 0.1,
            support_weight: 0.1,
            ensemble: 5,
            samples: 1,
            std: 0.125f64.sqrt(),
            cvae: CvaeConfig { hidden: vec![256, 256], steps: 5000, batch: 256, ..CvaeConfig::paper() },
            discount: 0.99,
            delay: DelayConfig::default(),
            critic_lr: 3e-4,
            hidden: vec![256, 256],
            actor: ActorConfig { cosine: false, ..ActorConfig::default() },
        }
    }
}

impl BosaConfig {
    fn density(&self) -> Density {
        Density { samples: self.samples, std: self.std, importance: true }
    }
}

/// β̂ and p̂_1..n during their training, in parallel on the same batches.
struct Autoencoders {
    all: Vec<CvaeLearner>,
}

impl Learner for Autoencoders {
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let fork = || meter.fork();
        let meters: Vec<Meter> = (self.all.par_iter_mut())
            .map(|learner| {
                let mut meter = fork();
                learner.update(batch, step, &mut meter);
                meter
            })
            .collect();
        meters.into_iter().for_each(|m| meter.join(m));
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        for own in self.all.iter().map(Learner::state) {
            state.tensors.extend(own.tensors);
            state.metadata.extend(own.metadata);
        }
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.all.iter_mut().try_for_each(|learner| learner.restore(state, path))
    }
}

/// BOSA of a population.
pub type Bosa = Deterministic<Support>;

/// β̂ and p̂_1..n, and the settings for their use.
pub struct Support {
    config: BosaConfig,
    behaviour: Cvae,
    dynamics: Vec<Cvae>,
    /// Has the members' streams, and tells whose s' is known.
    buffer: Buffer,
}

impl Bosa {
    /// New networks for the members of `buffer`, to be trained for `steps` steps. The autoencoders are trained here.
    /// `None` if the user interrupted their training.
    ///
    /// # Errors
    /// If the configuration cannot be used, there are no source rows, or the s' of no row of a table is known.
    pub fn new(
        buffer: &Buffer,
        config: &BosaConfig,
        steps: u64,
        place: Place<'_>,
        device: &Device,
    ) -> Result<Option<Self>, LearnError> {
        config.check()?;
        need_others("BOSA", buffer.members())?;
        let rows = Buffer::new(buffer.members().to_vec(), config.cvae.batch)?.with_stream("bosa batch");
        let rows = rows.with_successors()?;
        let model = |modelled, name: &str| CvaeLearner::new(&rows, &config.cvae, modelled, name, device);
        let mut all = vec![model(Modelled::Behaviour, "bosa behaviour")?];
        for i in 0..config.ensemble {
            all.push(model(Modelled::Dynamics, &format!("bosa dynamics {i}"))?);
        }
        let mut autoencoders = Autoencoders { all };
        if !prepare(&mut autoencoders, &rows, config.cvae.steps, "BOSA autoencoders", place, device)? {
            return Ok(None);
        }
        let mut models = autoencoders.all.iter().map(CvaeLearner::model);
        let critic = MlpConfig::relu(buffer.inputs().len() + buffer.act_dim(), &config.hidden, 1);
        let nets = ActorCritic::new(buffer, &config.actor, &config.delay, &critic, steps, device)?;
        let rule = Support {
            behaviour: models.next().expect("the first of them"),
            dynamics: models.collect(),
            buffer: buffer.clone(),
            config: config.clone(),
        };
        Ok(Some(Deterministic { nets, rule }))
    }
}

impl Support {
    /// m `[P, B, 1]`.
    fn supported(&self, batch: &Minibatch, step: u64) -> Tensor<3> {
        let (c, x) = Modelled::Dynamics.split(batch);
        let density = |(i, model): (usize, &Cvae)| {
            let name = format!("bosa density {i}");
            model.log_density(c.clone(), x.clone(), self.config.density(), &self.buffer.streams(), &name, step)
        };
        let densities: Vec<_> = self.dynamics.par_iter().enumerate().map(density).collect();
        let least = densities.into_iter().reduce(Tensor::min_pair).expect("at least one model");
        let mask = least.greater_elem(self.config.threshold.ln()).float();
        counted(mask, self.buffer.known(batch, 0), self.config.mode)
    }
}

/// m of all rows, from that of the rows whose s' is `known` (1, else 0). The others are terminal.
fn counted(mask: Tensor<3>, known: Tensor<3>, mode: Mode) -> Tensor<3> {
    match mode {
        Mode::Corrected => mask.max_pair(-known + 1.0),
        Mode::Published => mask * known,
    }
}

/// y, computed from q = min(Q1', Q2')(s', a').
pub fn critic_target(batch: &Minibatch, q: Tensor<3>, discount: f64, mode: Mode) -> Tensor<3> {
    let bootstrap = match mode {
        Mode::Corrected => batch.not_done.clone(),
        Mode::Published => -batch.not_done.clone() + 1.0,
    };
    batch.r.clone() + bootstrap * q * discount
}

impl UpdateRule for Support {
    fn update(&self, nets: &mut ActorCritic, batch: &Minibatch, step: u64, meter: &mut Meter) {
        let Self { config: c, behaviour, buffer, .. } = self;
        let members = &buffer.streams();
        let (mask, y) = rayon::join(
            || self.supported(batch, step),
            || {
                let q = nets.next_value(batch.s2.clone(), nets.next_action(batch.s2.clone(), step));
                critic_target(batch, q, c.discount, c.mode)
            },
        );
        meter.record("supported", &mask);
        let (first, others) = (batch.target_rows, batch.s.dims()[1] - batch.target_rows);
        let loss = |q: Tensor<3>| {
            let source = member_mean(q.clone().narrow(1, first, others));
            squared_td_error(q, y.clone(), Some(mask.clone())) * 0.5 + source * c.value_weight
        };
        let polyak = nets.polyak(step);
        let loss = nets.critics.step_down(state_action(&batch.s, batch.a.clone()), loss, c.critic_lr, polyak);
        meter.record("critic_loss", &loss);
        if nets.due(step) {
            let a = nets.forward(batch.s.clone()).mean;
            let (q, density) = rayon::join(
                || nets.critics.pair[0].frozen(state_action(&batch.s, a.clone())),
                || behaviour.log_density(batch.s.clone(), a.clone(), c.density(), members, "bosa support", step),
            );
            drop(a);
            meter.record("policy_value", &q);
            meter.record("policy_support", &density);
            let loss = -normalised_value(q) - member_mean(density) * c.support_weight;
            nets.step(loss, step);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_nn::{cpu, host, tensor};

    #[test]
    fn the_modes_bootstrap_at_opposite_rows() {
        let column = |v: [f32; 2]| tensor(v.to_vec(), [1, 2, 1], &cpu());
        let zero = || column([0.0, 0.0]);
        let (r, not_done) = (column([1.0, 2.0]), column([1.0, 0.0]));
        let batch = Minibatch { s: zero(), a: zero(), s2: zero(), r, not_done, target_rows: 1, picks: vec![] };
        let y = |mode| host(critic_target(&batch, column([10.0, 20.0]), 0.5, mode));
        assert_eq!(y(Mode::Corrected), [6.0, 2.0]);
        assert_eq!(y(Mode::Published), [1.0, 12.0]);
    }

    /// Rows: known and supported, known and not, unknown and by chance not, unknown and by chance supported.
    #[test]
    fn rows_without_a_successor_count_where_they_need_none() {
        let column = |v: [f32; 4]| tensor(v.to_vec(), [1, 4, 1], &cpu());
        let m = |mode| host(counted(column([1.0, 0.0, 0.0, 1.0]), column([1.0, 1.0, 0.0, 0.0]), mode));
        assert_eq!(m(Mode::Corrected), [1.0, 0.0, 1.0, 1.0]);
        assert_eq!(m(Mode::Published), [1.0, 0.0, 0.0, 0.0]);
    }
}
