//! Training by denoising score matching (B.2, B.6): Adam on ‖F − target‖², one set of tensors for the whole population.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rand::RngExt;
use serde::{Deserialize, Serialize};
use tce_base::random::fill_normal;
use tce_base::{Interrupted, Progress, Streams, interrupted};
use tce_nn::{
    Averaged, Checkpoints, Device, Module, NamedParameters, NetworkError, Tensor, Trained, cosine_decay, host,
    on_threads_of, tensor,
};

use crate::cycles::Found;
use crate::{DiffusionError, NetworkConfig, Process, ScoreData, ScoreModel, ScoreNetwork};

/// Steps between two reports of the loss.
const REPORT: u64 = 100;

/// How to train.
///
/// | symbol | field | default | source |
/// |---|---|---|---|
/// | – | `learning_rate` | 1e-4 | Table C.4 |
/// | – | `schedule` | `constant` | Table C.4 names none |
/// | B | `batch` | 128 | Table C.4 |
/// | – | `ema` | 0.999 | own; rate of the average that samples, warmed up as min(ema, (1 + t) / (10 + t)); 0: none |
///
/// An epoch of the paper is read as a pass over the target rows (39 batches of 128 for 5 000 rows): 10K epochs of the
/// state score network are 390 000 steps, 5K of the transition score network 195 000.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// Of Adam.
    pub learning_rate: f64,
    /// Over the steps of the training.
    pub schedule: Schedule,
    /// Rows per step and member.
    pub batch: usize,
    /// What the moving average keeps per step.
    pub ema: f64,
}

/// The learning rate over the steps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// The same at every step.
    #[default]
    Constant,
    /// Along a half cosine to zero.
    Cosine,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self { learning_rate: 1e-4, schedule: Schedule::Constant, batch: 128, ema: 0.999 }
    }
}

impl TrainConfig {
    fn check(&self) -> Result<(), DiffusionError> {
        if !(self.learning_rate > 0.0 && self.learning_rate.is_finite()) {
            return Err(DiffusionError::input("train.learning_rate", self.learning_rate, "a positive number"));
        }
        if self.batch == 0 {
            return Err(DiffusionError::input("train.batch", 0, "at least 1"));
        }
        if !(0.0..1.0).contains(&self.ema) {
            return Err(DiffusionError::input("train.ema", self.ema, "at least 0 and less than 1"));
        }
        Ok(())
    }
}

/// A noisy batch of the whole population.
struct Batch {
    /// c_in x^τ `[P, B, d]`
    x: Tensor<3>,
    /// c_noise `[P, B, 1]`
    time: Tensor<3>,
    /// `[P, B, c]`
    condition: Tensor<3>,
    /// `[P, B, d]`
    target: Tensor<3>,
}

/// A training under way.
pub struct Trainer {
    name: String,
    spec: NetworkConfig,
    process: Process,
    config: TrainConfig,
    members: Vec<Streams>,
    device: Device,
    network: Trained<ScoreNetwork>,
    average: Option<Averaged<ScoreNetwork>>,
    step: u64,
    /// What a training until done has found at the ends of its cycles.
    pub(crate) found: Found,
    /// Raised by whichever of several trainings diverges.
    stop: Arc<AtomicBool>,
}

impl Trainer {
    /// A fresh population, one network per member; `name` tells its random streams (`init/{name}/…`, `train/{name}`)
    /// and its progress bar from those of other trainings. `device` is a plain device (no autodiff).
    ///
    /// # Errors
    /// If a setting is unusable.
    pub fn new(
        name: &str,
        spec: NetworkConfig,
        process: Process,
        config: TrainConfig,
        members: &[Streams],
        device: &Device,
    ) -> Result<Self, DiffusionError> {
        spec.check()?;
        process.check()?;
        config.check()?;
        if members.is_empty() {
            return Err(DiffusionError::input("members", 0, "at least 1"));
        }
        let device = device.clone().autodiff();
        let network = spec.init(members, name, &device);
        let average = (config.ema > 0.0).then(|| Averaged::new(&network));
        let (name, members, network) = (name.to_owned(), members.to_vec(), Trained::new(network));
        let (found, stop) = (Found::default(), Arc::default());
        Ok(Self { name, spec, process, config, members, device, network, average, step: 0, found, stop })
    }

    /// Several trainings that are of use only together share a flag: when one diverges, the others stop too.
    pub fn stop_with(&mut self, other: &Trainer) {
        self.stop = other.stop.clone();
    }

    /// The highest learning rate.
    pub(crate) fn highest_rate(&self) -> f64 {
        self.config.learning_rate
    }

    /// The device without autodiff.
    pub(crate) fn plain_device(&self) -> Device {
        self.sampling_network().device()
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// Trains until `steps` steps are taken (since the beginning, not since the last call). `data` is one set for all
    /// members, or one per member. `on_loss` gets the steps taken and each member's mean loss since the last report, every
    /// 100 steps and at the end; a loss is the mean over rows and dimensions, 1 for a network that knows nothing of VE's
    /// or VP's noise.
    ///
    /// With `checkpoints` the training goes on from the newest one, and keeps one now and then and when the user interrupts; the
    /// result and all reports are then those of an undisturbed training.
    ///
    /// # Errors
    /// If the data does not fit the network, the loss is no number any more, a checkpoint cannot be used or written, or the user
    /// interrupts; then the trainer is whole, and [`Trainer::state`] can be kept.
    pub fn train(
        &mut self,
        data: &[ScoreData],
        steps: u64,
        checkpoints: &mut Checkpoints,
        on_loss: impl FnMut(u64, &[f32]),
    ) -> Result<(), DiffusionError> {
        self.check_data(data)?;
        if let Some((_, state, path)) = checkpoints.restore() {
            self.restore(&state, &path)?;
        }
        let (schedule, highest) = (self.config.schedule, self.config.learning_rate);
        let rate = |step| match schedule {
            Schedule::Constant => highest,
            Schedule::Cosine => cosine_decay(highest, step, steps),
        };
        self.advance(data, steps, rate, &[], checkpoints, on_loss)
    }

    /// Takes steps until there are `steps`, step t with the learning rate `rate(t)`. `done` tells of which members the network is already
    /// kept elsewhere, so that it no longer matters whether they diverge; those that it leaves out are not done.
    pub(crate) fn advance(
        &mut self,
        data: &[ScoreData],
        steps: u64,
        rate: impl Fn(u64) -> f64 + Sync,
        done: &[bool],
        checkpoints: &mut Checkpoints,
        mut on_loss: impl FnMut(u64, &[f32]),
    ) -> Result<(), DiffusionError> {
        let progress = Progress::new(format!("train {}", self.name), steps.saturating_sub(self.step), "steps");
        let (mut sum, mut count) = (None, 0u64);
        let device = self.network.net().device();
        while self.step < steps {
            // Between two reports a checkpoint would have to hold the losses since the last one.
            let whole = count == 0;
            let stop = interrupted() || self.stop.load(Ordering::Relaxed);
            if whole && self.step > 0 && (stop || checkpoints.due()) {
                checkpoints.keep(self.step, on_threads_of(&device, || self.state())).map_err(NetworkError::from)?;
            }
            if stop && whole {
                let work = format!("training of {}", self.name);
                return Err(Interrupted::after(&work, self.step, steps, "steps").into());
            }
            let so_far = sum.take();
            sum = Some(on_threads_of(&device, || {
                let loss = self.step(data, rate(self.step));
                match so_far {
                    None => loss,
                    Some(sum) => sum + loss,
                }
            }));
            count += 1;
            progress.inc(1);
            if self.step.is_multiple_of(REPORT) || self.step == steps {
                let sum = sum.take().expect("at least one step");
                let losses: Vec<_> = on_threads_of(&device, || host(sum)).iter().map(|l| l / count as f32).collect();
                count = 0;
                let diverged = |m: &usize| !losses[*m].is_finite() && done.get(*m) != Some(&true);
                if let Some(member) = (0..losses.len()).find(diverged) {
                    let (label, loss) = (format!("training of {}", self.name), losses[member]);
                    let (step, learning_rate) = (self.step, self.config.learning_rate);
                    self.stop.store(true, Ordering::Relaxed);
                    return Err(DiffusionError::Diverged { label, member, loss, step, learning_rate });
                }
                let shown: Vec<f32> = losses.iter().copied().filter(|l| l.is_finite()).collect();
                progress.message(format!("loss {:.4}", shown.iter().sum::<f32>() / shown.len() as f32));
                on_loss(self.step, &losses);
            }
        }
        progress.finish();
        Ok(())
    }

    pub(crate) fn check_data(&self, data: &[ScoreData]) -> Result<(), DiffusionError> {
        if data.len() != 1 && data.len() != self.members.len() {
            return Err(DiffusionError::input("data sets", data.len(), format!("1, or {}", self.members.len())));
        }
        for d in data {
            let (found, expected) = ((d.dims(), d.condition()), (self.spec.dims, self.spec.condition));
            if found != expected {
                let text = |(d, c): (usize, usize)| format!("rows of {d} under conditions of {c}");
                return Err(DiffusionError::input(format!("data of {}", self.name), text(found), text(expected)));
            }
        }
        Ok(())
    }

    /// One step of Adam; the loss of each member, `[P, 1, 1]`.
    fn step(&mut self, data: &[ScoreData], rate: f64) -> Tensor<3> {
        let batch = self.batch(data, &format!("train/{}", self.name), self.step);
        let loss = denoising_loss(self.network.net(), batch);
        let detached = loss.clone().inner();
        match &mut self.average {
            None => self.network.step(loss.sum(), rate),
            Some(average) => {
                let t = self.step as f64;
                let keep = self.config.ema.min((1.0 + t) / (10.0 + t));
                self.network.step_averaged(loss.sum(), rate, average, 1.0 - keep);
            }
        }
        self.step += 1;
        detached
    }

    /// Batch `index` of the stream `name`. The batches of a training are indexed by the step: a restored training continues the
    /// same draws.
    fn batch(&self, data: &[ScoreData], name: &str, index: u64) -> Batch {
        let (p, b, d, c) = (self.members.len(), self.config.batch, self.spec.dims, self.spec.condition);
        let (mut x, mut target) = (Vec::with_capacity(p * b * d), Vec::with_capacity(p * b * d));
        let (mut time, mut condition) = (Vec::with_capacity(p * b), Vec::with_capacity(p * b * c));
        let mut z = vec![0.0; d];
        for (m, streams) in self.members.iter().enumerate() {
            let data = &data[if data.len() == 1 { 0 } else { m }];
            let mut rng = streams.indexed(name, index);
            for i in 0..b {
                let (row, on) = data.draw(&mut rng, i);
                let level = self.process.draw(&mut rng);
                fill_normal(&mut rng, &mut z);
                let pre = self.process.precondition(level);
                let (of_row, of_noise) = self.process.network_target(level);
                let (alpha, sigma) = ((pre.scale * level.alpha) as f32, (pre.scale * level.sigma) as f32);
                x.extend(row.iter().zip(&z).map(|(x, z)| alpha * x + sigma * z));
                let (of_row, of_noise) = (of_row as f32, of_noise as f32);
                target.extend(row.iter().zip(&z).map(|(x, z)| of_row * x + of_noise * z));
                time.push(pre.time as f32);
                // Drawn last, and only where wanted: other trainings keep their numbers.
                if data.dropout() > 0.0 && rng.random::<f64>() < data.dropout() {
                    condition.resize(condition.len() + c, 0.0);
                } else {
                    condition.extend_from_slice(on);
                }
            }
        }
        let tensor = |data, width| tensor(data, [p, b, width], &self.device);
        Batch { x: tensor(x, d), time: tensor(time, 1), condition: tensor(condition, c), target: tensor(target, d) }
    }

    /// What samples: the moving average if there is one.
    fn sampling_network(&self) -> ScoreNetwork {
        match &self.average {
            Some(average) => average.net().clone(),
            None => self.network.net().valid(),
        }
    }

    /// The model as it is: the moving average if there is one.
    pub fn model(&self) -> ScoreModel {
        ScoreModel::new(self.spec, self.process, self.sampling_network())
    }

    /// The loss of every member on rows that it may not have seen, of the network that samples: the mean over `batches` batches,
    /// which are the same at every call, so that two calls differ by the networks alone.
    pub fn loss_on(&self, data: &[ScoreData], batches: u64) -> Result<Vec<f64>, DiffusionError> {
        self.check_data(data)?;
        let network = self.sampling_network();
        let name = format!("held out/{}", self.name);
        let mut sums = vec![0.0; self.members.len()];
        for index in 0..batches {
            let mut batch = self.batch(data, &name, index);
            for part in [&mut batch.x, &mut batch.time, &mut batch.condition, &mut batch.target] {
                *part = part.clone().inner();
            }
            let losses = on_threads_of(&network.device(), || host(denoising_loss(&network, batch)));
            sums.iter_mut().zip(losses).for_each(|(sum, loss)| *sum += f64::from(loss));
        }
        Ok(sums.into_iter().map(|sum| sum / batches as f64).collect())
    }

    /// Everything a continuation needs besides the arguments of [`Trainer::new`].
    pub fn state(&self) -> NamedParameters {
        let mut out = NamedParameters::default();
        self.network.save("network", &mut out);
        if let Some(average) = &self.average {
            out.collect("average", average.net());
        }
        out.metadata.insert("step".to_owned(), self.step.to_string());
        self.found.keep(&mut out);
        out
    }

    /// Puts back what [`Trainer::state`] gave; the rest of the training gives the same bytes as one without a break.
    /// `path` is where it came from, for messages.
    ///
    /// # Errors
    /// If the state belongs to another training.
    pub fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), DiffusionError> {
        let step = state.metadata.get("step").and_then(|s| s.parse().ok());
        self.step = step.ok_or_else(|| NetworkError::Format {
            path: path.to_owned(),
            reason: "the metadata has no 'step': no state of a training".to_owned(),
        })?;
        self.network.load("network", state, path)?;
        if let Some(average) = &mut self.average {
            average.load("average", state, path)?;
        }
        self.found = Found::restored(state, path)?;
        Ok(())
    }
}

/// The mean over rows and dimensions of (F − target)², per member: `[P, 1, 1]`. Members are summed, not averaged, before
/// the backward pass, so that each gets the gradient it would get alone.
fn denoising_loss(network: &ScoreNetwork, batch: Batch) -> Tensor<3> {
    let f = network.forward(batch.x, batch.time, batch.condition);
    (f - batch.target).square().mean_dim(2).mean_dim(1)
}

#[cfg(test)]
mod tests;
