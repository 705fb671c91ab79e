//! Behaviour cloning.
//!
//! L_π = E over (s, a) of ℓ(s, a): for the default policy form the mean squared error of tanh(μ(s)), see [`crate::actor`].
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | - | `actor` | deterministic, 256-256, Adam 3e-4, cosine | as the policies of IQL |
//! | - | `dropout` | 0 | of hidden units, while it is trained: Srivastava et al. 2014; or chosen by the data, [`crate::bc_dropout`] |
//! | - | `loss` | squared | own: or the likelihood of a tanh-Gaussian policy, [`Actor::likelihood_loss`] |
//! | - | `batch` | 0 | own: rows of each update; 0: `learner.batch` |
//! | E | `ensemble` | 1 | own: policies whose outputs are averaged before the tanh |
//! | - | `mixed_steps` | 0 | own: generated rows are fitted sooner than they are right, see below |
//! | - | `fade` | 0 | own: other rows first, the target's alone at last, see below |
//! | - | `scale_by` | all | own: whose spread standardises observations, see [`ScaleBy`] |
//! | `top` | [`crate::best_trajectories`], before the buffer is made | 1 | "BC-10 %" of Chen et al. 2021 |
//!
//! A network that fits 5000 actions exactly says little between them. Where the rows lie close to each other this is
//! enough; where they do not, dropout is worth 28 points, and elsewhere it costs as many ([`crate::bc_dropout`]). A third
//! layer lowers the error between the rows, and the policies score higher (bench/expansion.md).
//!
//! Clones of one data set differ in their initial weights, and this decides whether they fall. The mean of several
//! clones makes fewer of the errors that they do not share: Walker2d, four clones of the same rows, 48 to 88 points
//! each, 93.5 together (bench/expansion.md). An ensemble sees the same batches and becomes one wider network
//! ([`crate::MlpPolicy::average`]).
//!
//! Generated rows teach at first and harm at last: they cover states that the target's rows do not visit, but are less
//! exact. With `fade` their share of a batch falls linearly from a half to nothing, and the last steps are the target's
//! alone. HalfCheetah, kinematic, ensembles of five, 50k steps: 49.5 points without generated rows, 51.6 with half a
//! batch of them to the end, 73.3 with `fade` = .6 (bench/expansion.md).
//!
//! Without `fade`, clones of target and generated rows need shorter training than clones of the target rows alone and
//! then get worse again: HalfCheetah, ensembles of five, 73, 77, 68 points after 8k, 15k, 30k steps; Walker2d 70, 93,
//! 92 (bench/expansion.md). The caller gets the number of steps from [`BcConfig::steps`].
//!
//! Raw or standardised observations, and all rows or the best trajectories, are properties of a member's data. One
//! population may contain all of them.

use std::path::Path;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_base::{OrAuto, Streams};
use tce_nn::{Device, NamedParameters, NetworkError, Tensor};

use crate::actor::{Actor, ActorConfig, PolicyForm};
use crate::bc_dropout::chosen;
use crate::buffer::{Buffer, Minibatch};
use crate::error::{LearnError, within};
use crate::method::{About, Built, LearnedRows, Method, OtherRows, RowScores, Setup};
use crate::networks::Dropout;
use crate::policy::{Policy, PolicyLearner};
use crate::training::{Learner, Meter};

const ABOUT: About = About {
    name: "bc",
    title: "BC",
    description: "behaviour cloning; of the best trajectories with learner.top",
    reference: "Pomerleau 1989",
    published: None,
    table: "bc",
    needs: OtherRows::Any,
    episodes: false,
    scores: RowScores::None,
};

impl Method for BcConfig {
    fn about(&self) -> About {
        ABOUT
    }

    fn check(&self) -> Result<(), LearnError> {
        if let OrAuto::Given(share) = self.dropout {
            within("dropout", share, 0.0..=0.9)?;
        }
        within("fade", self.fade, 0.0..=1.0)?;
        within("ensemble", self.ensemble as f64, 1.0..=64.0)?;
        if self.ensemble > 1 && self.loss == CloneLoss::Squared && self.actor.form != PolicyForm::TanhMean {
            let (found, remedy) =
                (format!("{} with actor.form {:?}", self.ensemble, self.actor.form), "choose tanh_mean");
            return Err(LearnError::invalid("ensemble", found, "1, or policies without noise of their own", remedy));
        }
        Ok(())
    }

    fn build(&self, on: &Setup<'_>) -> Built {
        let OrAuto::Auto = self.dropout else {
            return Ok(Some(Box::new(Bc::new(on.buffer, self, on.steps, on.device)?)));
        };
        let single = BcConfig { ensemble: 1, ..self.clone() };
        let clones = |rows: &Buffer, rates, steps| Bc::with_dropout(rows, &single, rates, steps, on.device);
        let Some(rates) = chosen(on.buffer, on.steps, on.place, on.device, clones)? else { return Ok(None) };
        Ok(Some(Box::new(Bc::with_dropout(on.buffer, self, rates, on.steps, on.device)?)))
    }

    fn batch(&self, batch: usize) -> usize {
        if self.batch == 0 { batch } else { self.batch }
    }

    fn fade(&self, steps: u64) -> Option<u64> {
        (self.fade > 0.0).then(|| (self.fade * steps as f64).round() as u64)
    }

    fn steps(&self, steps: u64, rows: LearnedRows) -> u64 {
        match self.mixed_steps {
            most if rows == LearnedRows::Mixed && most > 0 => steps.min(most),
            _ => steps,
        }
    }
}

/// The configuration of [`Bc`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BcConfig {
    /// The policy.
    pub actor: ActorConfig,
    /// Policies that are trained side by side; their outputs are averaged before the tanh.
    #[schemars(range(min = 1, max = 64))]
    pub ensemble: usize,
    /// Share of hidden units that are left out of each update, at random. "auto": 0.3 where it lowers a clone's error at rows that it has
    /// not seen, else none.
    #[serde(skip_serializing_if = "is_default")]
    pub dropout: OrAuto<f64>,
    /// Most steps where rows besides the target's are cloned, too: generated rows are fitted sooner than they are right. 0: as many
    /// as without them.
    pub mixed_steps: u64,
    /// Share of the steps after which only target rows are cloned. The other rows' share of a batch falls linearly until then. 0: half of
    /// every batch, to the end.
    #[serde(skip_serializing_if = "is_default")]
    #[schemars(range(min = 0.0, max = 1.0))]
    pub fade: f64,
    /// Rows of each update. 0: `learner.batch`.
    #[serde(skip_serializing_if = "is_default")]
    pub batch: usize,
    /// What a clone of an action costs.
    #[serde(skip_serializing_if = "is_default")]
    pub loss: CloneLoss,
    /// Whose rows give the mean and the spread by which observations are standardised, where others are cloned, too.
    #[serde(skip_serializing_if = "is_default")]
    pub scale_by: ScaleBy,
}

impl Default for BcConfig {
    fn default() -> Self {
        Self {
            actor: ActorConfig::default(),
            ensemble: 1,
            dropout: OrAuto::default(),
            mixed_steps: 0,
            fade: 0.0,
            batch: 0,
            loss: CloneLoss::Squared,
            scale_by: ScaleBy::All,
        }
    }
}

// The cache keys of runs from before a key was added do not contain it.
fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// β of [`Actor::likelihood_loss`], as its authors recommend it.
const BETA: f64 = 0.5;

/// What a clone of an action costs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum CloneLoss {
    /// The policy form's own loss, see [`crate::actor`]; for `tanh_mean` the squared error.
    #[default]
    Squared,
    /// The likelihood under a tanh-Gaussian policy, whose spread is learned: noisy actions count less.
    Likelihood,
}

/// Whose rows give the mean and the spread of observations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ScaleBy {
    /// All rows that are cloned, the target's as much as the others.
    #[default]
    All,
    /// The target's. Clones of generated rows then see the target's states as sharply as clones of the target's rows alone do.
    Target,
}

/// Behaviour cloning of a population.
pub struct Bc {
    /// One population for each position in the ensembles.
    actors: Vec<Actor>,
    members: Vec<Streams>,
    /// Of every member.
    dropout: Vec<f64>,
    /// Whether the data chose it; then it is a metric.
    told: bool,
    loss: CloneLoss,
}

impl Bc {
    /// New policies for the members of `buffer`, to be trained for `steps` steps.
    ///
    /// # Errors
    /// If the configuration cannot be used. `dropout = "auto"` is a training of its own: [`Method::build`] does it.
    pub fn new(buffer: &Buffer, config: &BcConfig, steps: u64, device: &Device) -> Result<Self, LearnError> {
        let OrAuto::Given(share) = config.dropout else {
            return Err(LearnError::invalid("dropout", "\"auto\"", "a share", "build the learner with Method::build"));
        };
        Self::with_dropout(buffer, config, vec![share; buffer.members().len()], steps, device)
    }

    /// [`Bc::new`], with the dropout of every member.
    pub(crate) fn with_dropout(
        buffer: &Buffer,
        config: &BcConfig,
        dropout: Vec<f64>,
        steps: u64,
        device: &Device,
    ) -> Result<Self, LearnError> {
        config.check()?;
        let form = match config.loss {
            CloneLoss::Squared => config.actor.form,
            CloneLoss::Likelihood => PolicyForm::TanhGaussian,
        };
        let policy = ActorConfig { form, ..config.actor.clone() };
        let actor = |k: usize| -> Result<Actor, LearnError> {
            let actor = match k {
                0 => Actor::new(buffer, &policy, steps, device)?,
                k => Actor::named(&format!("policy {k}"), buffer, &policy, steps, device)?,
            };
            Ok(match config.loss {
                CloneLoss::Squared => actor,
                CloneLoss::Likelihood => actor.sampling_as_cloned(),
            })
        };
        let actors = (0..config.ensemble).map(actor).collect::<Result<_, _>>()?;
        let told = config.dropout == OrAuto::Auto;
        Ok(Self { actors, members: buffer.streams(), dropout, told, loss: config.loss })
    }
}

/// One step of one population. Returns its loss.
fn step(actor: &mut Actor, batch: &Minibatch, mut dropout: Vec<Dropout>, step: u64, loss: CloneLoss) -> Tensor<3> {
    let output = actor.forward_with(batch.s.clone(), |h| Dropout::apply_members(&mut dropout, h));
    let loss = match loss {
        CloneLoss::Squared => actor.imitation_loss(&output, batch.a.clone(), None),
        CloneLoss::Likelihood => Actor::likelihood_loss(&output, batch.a.clone(), BETA),
    };
    drop(output);
    let value = loss.clone().inner();
    actor.step(loss, step);
    value
}

/// The prefix of the names of policy `k` of an ensemble in a checkpoint.
fn prefix(k: usize) -> String {
    if k == 0 { String::new() } else { format!("{k}/") }
}

impl Learner for Bc {
    fn update(&mut self, batch: &Minibatch, at: u64, meter: &mut Meter) {
        let masks = |k: usize| -> Vec<Dropout> {
            if self.dropout.iter().all(|&share| share == 0.0) {
                // Creating a generator for each update and policy costs time.
                return Vec::new();
            }
            let name = format!("dropout {k}");
            let members = self.members.iter().zip(&self.dropout);
            members.map(|(m, &share)| Dropout::new(share, m.indexed(&name, at))).collect()
        };
        let actors = self.actors.par_iter_mut().enumerate();
        let losses: Vec<_> = actors.map(|(k, actor)| step(actor, batch, masks(k), at, self.loss)).collect();
        losses.iter().for_each(|loss| meter.record("policy_loss", loss));
        if self.told && meter.active() {
            meter.add("dropout", self.dropout.clone());
        }
    }

    fn state(&self) -> NamedParameters {
        let mut state = NamedParameters::default();
        for (k, actor) in self.actors.iter().enumerate() {
            // The first policy has the same names as a single policy.
            let mut own = NamedParameters::default();
            actor.save(&mut own);
            state.extend_under(&prefix(k), own);
        }
        state
    }

    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        for (k, actor) in self.actors.iter_mut().enumerate() {
            actor.load(&state.under(&prefix(k)), path)?;
        }
        Ok(())
    }
}

impl PolicyLearner for Bc {
    fn policies(&self) -> Vec<Policy> {
        let all: Vec<Vec<Policy>> = self.actors.iter().map(Actor::policies).collect();
        let Some((first, rest)) = all.split_first() else { return Vec::new() };
        let member = |(m, policy): (usize, &Policy)| {
            let ensemble: Vec<_> = std::iter::once(policy).chain(rest.iter().map(|p| &p[m])).collect();
            Policy::average(&ensemble)
        };
        first.iter().enumerate().map(member).collect()
    }
}
