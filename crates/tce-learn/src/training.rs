//! One training loop for everything that learns, and what every learner is made of.

use std::collections::BTreeMap;
use std::path::Path;

use tce_base::{Progress, Streams, interrupted, random::fill_normal};
use tce_nn::burn::tensor::TensorData;
use tce_nn::{Adam, AdamConfig, Device, Module, NamedParameters, NetworkError, Tensor, host, moving_average, tensor};

use crate::buffer::{Buffer, Minibatch};
use crate::policy::Policy;

/// Losses and other figures are taken every so many steps: they cost time, and their means need no more.
const METER_EVERY: u64 = 10;

/// Something that is trained one minibatch at a time, P members at once.
pub trait Learner {
    /// One step. `step` counts from 0; figures go to `meter`.
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter);

    /// All parameters and optimiser states: what [`Learner::restore`] needs to go on as if nothing had happened.
    fn state(&self) -> NamedParameters;

    /// Puts back a [`Learner::state`]; `path` is where it came from, for messages.
    ///
    /// # Errors
    /// If it belongs to another learner.
    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError>;
}

/// A learner whose result is one policy per member.
pub trait PolicyLearner: Learner {
    /// The policies as they are now, in the order of the members.
    fn policies(&self) -> Vec<Policy>;
}

/// Draws of N(0, 1) `[P, rows, width]`, member m's from stream `index` of `name` of its own.
pub fn member_noise(members: &[Streams], name: &str, index: u64, shape: [usize; 3], device: &Device) -> Tensor<3> {
    let mut noise = vec![0.0; shape.iter().product()];
    for (noise, streams) in noise.chunks_mut(shape[1] * shape[2]).zip(members) {
        fill_normal(&mut streams.indexed(name, index), noise);
    }
    tensor(noise, shape, device)
}

/// A network and its optimiser.
pub struct Trained<M> {
    /// Empty only during a step.
    net: Option<M>,
    adam: Adam,
}

impl<M: Module> Trained<M> {
    /// A network that has not seen a step, trained with Adam's default constants.
    pub fn new(net: M) -> Self {
        Self { net: Some(net), adam: AdamConfig::default().init() }
    }

    /// The network.
    pub fn net(&self) -> &M {
        self.net.as_ref().expect("only empty during a step")
    }

    /// One step of Adam down the gradient of `loss`, the sum over members of the members' losses.
    ///
    /// The loss is taken by value: a tensor that still holds the graph would make Adam copy the parameters.
    pub fn step(&mut self, loss: Tensor<1>, lr: f64) {
        let mut grads = loss.backward();
        drop(loss);
        let net = self.net.take().expect("only empty during a step");
        self.net = Some(self.adam.step(lr, net, &mut grads));
    }

    /// Adds parameters and moments to `state`.
    pub fn save(&self, name: &str, state: &mut NamedParameters) {
        state.collect(name, self.net());
        let (time, moments) = self.adam.state();
        state.metadata.insert(format!("adam.{name}"), time.to_string());
        for (k, (m, v)) in moments.iter().enumerate() {
            for (part, t) in [("m", m), ("v", v)] {
                state.tensors.insert(format!("adam.{name}.{part}.{k}"), (t.dims().to_vec(), host(t.clone())));
            }
        }
    }

    /// Takes parameters and moments from `state`.
    pub fn load(&mut self, name: &str, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        let missing = |what: String, found: String| NetworkError::Mismatch {
            path: path.to_owned(),
            name: what,
            found,
            expected: "the optimiser's state".into(),
        };
        let key = format!("adam.{name}");
        let found = state.metadata.get(&key).cloned().unwrap_or_else(|| "nothing".into());
        let time = found.parse().map_err(|_| missing(key.clone(), found))?;
        let net = self.net.take().expect("only empty during a step");
        let net = self.net.insert(state.apply(name, net, path)?);
        let device = net.devices()[0].clone().inner();
        let moment = |part: &str, k: usize| -> Option<Tensor<1>> {
            let (shape, data) = state.tensors.get(&format!("{key}.{part}.{k}"))?;
            Some(Tensor::from_data(TensorData::new(data.clone(), shape.clone()), &device))
        };
        let mut moments = Vec::new();
        while let (Some(m), Some(v)) = (moment("m", moments.len()), moment("v", moments.len())) {
            moments.push((m, v));
        }
        self.adam.restore(time, moments);
        Ok(())
    }
}

/// A network that follows another one slowly (a target network, an average of the parameters).
pub struct Averaged<M> {
    /// Empty only while it moves.
    net: Option<M>,
}

impl<M: Module> Averaged<M> {
    /// A copy of `online`, outside of autodiff.
    pub fn new(online: &M) -> Self {
        // A moving average of rate 0 owns its memory, which a plain copy would share with `online`.
        Self { net: Some(moving_average(online.valid(), online, 0.0)) }
    }

    /// The network.
    pub fn net(&self) -> &M {
        self.net.as_ref().expect("only empty while it moves")
    }

    /// θ' ← (1 - rate) θ' + rate θ.
    pub fn follow(&mut self, online: &M, rate: f64) {
        let net = self.net.take().expect("only empty while it moves");
        self.net = Some(moving_average(net, online, rate));
    }

    /// Takes the parameters from `state`.
    pub fn load(&mut self, name: &str, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        self.net = Some(state.apply(name, self.net().clone(), path)?);
        Ok(())
    }
}

/// Means of named figures, per member.
#[derive(Debug, Default)]
pub struct Meter {
    active: bool,
    sums: BTreeMap<&'static str, (Vec<f64>, u64)>,
}

impl Meter {
    /// A meter that takes every figure.
    pub fn always() -> Self {
        Self { active: true, ..Self::default() }
    }

    /// Whether figures are wanted at this step; learners ask before they compute any.
    pub fn active(&self) -> bool {
        self.active
    }

    /// Takes the mean over each member's entries of `value` `[P, ·, ·]`.
    pub fn record(&mut self, name: &'static str, value: &Tensor<3>) {
        if self.active {
            let members = value.dims()[0];
            let values = host(value.clone());
            let per_member = values.len() / members;
            let means = values.chunks(per_member).map(|c| c.iter().map(|&v| v as f64).sum::<f64>() / per_member as f64);
            self.add(name, means.collect());
        }
    }

    /// Takes one figure per member.
    pub fn add(&mut self, name: &'static str, per_member: Vec<f64>) {
        let (sum, count) = self.sums.entry(name).or_insert_with(|| (vec![0.0; per_member.len()], 0));
        sum.iter_mut().zip(per_member).for_each(|(s, v)| *s += v);
        *count += 1;
    }

    /// The means since the last call, and starts anew.
    pub fn take(&mut self) -> BTreeMap<&'static str, Vec<f64>> {
        let means = |(sum, n): (Vec<f64>, u64)| sum.into_iter().map(|s| s / n as f64).collect();
        std::mem::take(&mut self.sums).into_iter().map(|(name, entry)| (name, means(entry))).collect()
    }
}

/// What [`train`] tells now and then.
#[derive(Clone, Debug)]
pub struct Report {
    /// Steps done.
    pub step: u64,
    /// Mean of each figure since the last report, per member.
    pub metrics: BTreeMap<&'static str, Vec<f64>>,
}

impl Report {
    /// Members with a figure that is not a finite number: their training has diverged. The others do not feel it.
    pub fn diverged(&self) -> Vec<usize> {
        let members = self.metrics.values().map(Vec::len).max().unwrap_or(0);
        let bad = |m: &usize| self.metrics.values().any(|v| v.get(*m).is_some_and(|x| !x.is_finite()));
        (0..members).filter(bad).collect()
    }
}

/// How many steps, and how often to tell.
#[derive(Clone, Copy, Debug)]
pub struct Steps {
    /// First step, 0 unless resumed.
    pub from: u64,
    /// One past the last.
    pub to: u64,
    /// A report every so many steps, and at the end; 0 for the end only.
    pub report_every: u64,
}

impl Steps {
    /// `count` steps from the beginning.
    pub fn new(count: u64, report_every: u64) -> Self {
        Self { from: 0, to: count, report_every }
    }
}

/// How a training ended: the step it stands at, and whether the user stopped it before its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Steps done; where to resume from.
    pub step: u64,
    /// Whether it was interrupted.
    pub interrupted: bool,
}

/// Trains `learner` on minibatches of `buffer`, with a progress bar named `label`.
///
/// `on_report` gets the means of the figures and the learner, to evaluate or save it; its error ends the training.
/// The learner's device is the one of its parameters; batches are made on `device`.
pub fn train<L: Learner + ?Sized, E>(
    learner: &mut L,
    buffer: &Buffer,
    steps: Steps,
    label: &str,
    device: &Device,
    mut on_report: impl FnMut(&Report, &L) -> Result<(), E>,
) -> Result<Outcome, E> {
    let progress = Progress::new(label, steps.to.saturating_sub(steps.from), "steps");
    let mut meter = Meter::default();
    for step in steps.from..steps.to {
        if interrupted() {
            return Ok(Outcome { step, interrupted: true });
        }
        meter.active = step % METER_EVERY == 0;
        learner.update(&buffer.sample(step, device), step, &mut meter);
        progress.inc(1);
        let done = step + 1;
        if done == steps.to || (steps.report_every > 0 && done % steps.report_every == 0) {
            let report = Report { step: done, metrics: meter.take() };
            for member in report.diverged() {
                eprintln!("{label}: member {member} has diverged at step {done} (a loss is not finite)");
            }
            on_report(&report, learner)?;
        }
    }
    progress.finish();
    Ok(Outcome { step: steps.to.max(steps.from), interrupted: false })
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_nn::cpu;

    #[test]
    fn figures_are_means_per_member() {
        let mut meter = Meter::always();
        meter.record("x", &tensor(vec![1.0, 3.0, 10.0, 20.0], [2, 2, 1], &cpu()));
        meter.record("x", &tensor(vec![4.0, 4.0, 0.0, 0.0], [2, 2, 1], &cpu()));
        assert_eq!(meter.take()["x"], [3.0, 7.5]);
        assert!(meter.take().is_empty());
    }

    #[test]
    fn a_diverged_member_is_named() {
        let report = Report { step: 1, metrics: BTreeMap::from([("a", vec![1.0, f64::NAN]), ("b", vec![0.0, 0.0])]) };
        assert_eq!(report.diverged(), [1]);
    }
}
