//! The training loop that all learners share, and the interface of a learner.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use tce_base::{Progress, Streams, interrupted, random::fill_normal};
use tce_nn::{Checkpoints, Device, NamedParameters, NetworkError, Tensor, host, on_threads_of, tensor};

use crate::buffer::{Buffer, Member, Minibatch};
use crate::error::LearnError;

/// Metrics are computed every so many steps. More would cost time without changing their means. The number is a prime,
/// so that events of every second step are also included.
const METER_EVERY: u64 = 11;
/// Steps of a job before the next job gets its turn.
const TURN: u64 = 50;

/// Where a training run stores its checkpoints, and what distinguishes it from others.
#[derive(Clone, Copy, Debug)]
pub struct Place<'a> {
    /// The directory; `None` stores nothing, for short runs and tests.
    pub directory: Option<&'a Path>,
    /// Cache key: hash of all inputs that affect the result.
    pub key: &'a str,
    /// The index of the job among several parallel ones.
    pub job: usize,
    /// Receives the metrics of preparations (training before the first step), and what they tell of rows.
    pub journal: Option<&'a Journal>,
}

/// What the preparations of the jobs of one call leave for the caller and for each other. Jobs may run in parallel.
#[derive(Debug, Default)]
pub struct Journal {
    /// Metrics.
    reports: Mutex<Vec<(usize, String, Report)>>,
    /// The dropout that the target rows of a member have told (`bc_dropout.rs`).
    pub(crate) dropout: Mutex<Vec<(Member, f64)>>,
}

impl Journal {
    /// Job, training and report, sorted by jobs and steps, independent of the order in which they arrived.
    ///
    /// # Panics
    /// If a job has panicked.
    pub fn take(&self) -> Vec<(usize, String, Report)> {
        let mut reports = std::mem::take(&mut *self.reports.lock().expect("no job has panicked"));
        reports.sort_by_key(|(job, ..)| *job);
        reports
    }
}

/// Prefix of the checkpoint names of [`prepare`].
const PREPARATION: &str = "prepare";
/// Number of reports of a preparation.
const PREPARATION_REPORTS: u64 = 10;

impl Place<'_> {
    /// Nothing is stored.
    pub const NONE: Place<'static> = Place { directory: None, key: "", job: 0, journal: None };

    /// The checkpoints of the training run `name` at this place.
    ///
    /// # Errors
    /// If existing checkpoints cannot be read.
    pub fn checkpoints(&self, name: &str) -> Result<Checkpoints, LearnError> {
        Ok(match self.directory {
            Some(directory) => Checkpoints::open(directory, name, self.key)?,
            None => Checkpoints::none(),
        })
    }

    /// Removes the checkpoints of [`prepare`], for all jobs. Call it when the result is on disk.
    pub fn discard_preparations(&self) {
        let entries = self.directory.and_then(|d| std::fs::read_dir(d).ok());
        for entry in entries.into_iter().flatten().flatten() {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            if name.starts_with(PREPARATION) && name.ends_with(".checkpoint") {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

/// Trains a model that a learner needs before its first step: `steps` steps on `buffer`, resumed from the checkpoints
/// at `place`. The end is stored, too. Metrics go to the journal of `place`. False if the user interrupted it.
///
/// # Errors
/// If a checkpoint cannot be read or written.
pub fn prepare<L: Learner>(
    learner: &mut L,
    buffer: &Buffer,
    steps: u64,
    label: &str,
    place: Place<'_>,
    device: &Device,
) -> Result<bool, LearnError> {
    let name = format!("{PREPARATION}-{}-{}", label.replace(' ', "-"), place.job);
    let mut checkpoints = place.checkpoints(&name)?;
    let mut jobs = [TrainingJob { learner, buffer }];
    let steps = Steps::new(steps, (steps / PREPARATION_REPORTS).max(1));
    let training = label.replace(' ', "-").to_lowercase();
    let outcome = advance(&mut jobs, steps, label, &mut checkpoints, AtTheEnd::Keep, device, |_, report, _| {
        if let Some(journal) = place.journal {
            let mut reports = journal.reports.lock().expect("no job has panicked");
            reports.push((place.job, training.clone(), report.clone()));
        }
        Ok::<_, LearnError>(())
    })?;
    Ok(!outcome.interrupted)
}

/// Something that is trained one minibatch at a time, P members at once.
pub trait Learner: Send {
    /// One step. `step` counts from 0; metrics go to `meter`.
    fn update(&mut self, batch: &Minibatch, step: u64, meter: &mut Meter);

    /// All parameters and optimiser states: all that [`Learner::restore`] needs to resume exactly.
    fn state(&self) -> NamedParameters;

    /// Restores a [`Learner::state`]; `path` is its file, for messages.
    ///
    /// # Errors
    /// If it belongs to another learner.
    fn restore(&mut self, state: &NamedParameters, path: &Path) -> Result<(), NetworkError>;
}

/// Draws of N(0, 1) `[P, rows, width]`; member m's are from its own stream `name`, index `index`.
pub fn member_noise(members: &[Streams], name: &str, index: u64, shape: [usize; 3], device: &Device) -> Tensor<3> {
    let mut noise = vec![0.0; shape.iter().product()];
    for (noise, streams) in noise.chunks_mut(shape[1] * shape[2]).zip(members) {
        fill_normal(&mut streams.indexed(name, index), noise);
    }
    tensor(noise, shape, device)
}

/// Means of named metrics, per member.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Meter {
    #[serde(skip)]
    active: bool,
    #[serde(with = "bits")]
    sums: BTreeMap<String, (Vec<f64>, u64)>,
}

/// Serialises sums as the bits of the numbers: JSON has no NaN, and a member that has diverged has only NaN.
mod bits {
    use std::collections::BTreeMap;

    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    type Sums<T> = BTreeMap<String, (Vec<T>, u64)>;

    fn map<A: Copy, B>(sums: &Sums<A>, f: fn(A) -> B) -> Sums<B> {
        sums.iter().map(|(name, (sum, n))| (name.clone(), (sum.iter().map(|v| f(*v)).collect(), *n))).collect()
    }

    pub fn serialize<S: Serializer>(sums: &Sums<f64>, to: S) -> Result<S::Ok, S::Error> {
        map(sums, f64::to_bits).serialize(to)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Sums<f64>, D::Error> {
        Ok(map(&Sums::<u64>::deserialize(from)?, f64::from_bits))
    }
}

impl Meter {
    /// A meter that records every metric.
    pub fn always() -> Self {
        Self { active: true, ..Self::default() }
    }

    /// Whether metrics are recorded at this step. Learners check this before they compute any.
    pub fn active(&self) -> bool {
        self.active
    }

    /// An empty meter with the same activity, for work on another thread; [`Meter::join`] adds its metrics to this one.
    pub fn fork(&self) -> Self {
        Self { active: self.active, ..Self::default() }
    }

    /// Adds the metrics of a [`Meter::fork`].
    pub fn join(&mut self, fork: Self) {
        for (name, (values, count)) in fork.sums {
            let (sum, n) = self.sums.entry(name).or_insert_with(|| (vec![0.0; values.len()], 0));
            sum.iter_mut().zip(values).for_each(|(s, v)| *s += v);
            *n += count;
        }
    }

    /// Records the mean over each member's entries of `value` `[P, ·, ·]`.
    pub fn record(&mut self, name: &str, value: &Tensor<3>) {
        if self.active {
            let members = value.dims()[0];
            let values = host(value.clone());
            let per_member = values.len() / members;
            let means = values.chunks(per_member).map(|c| c.iter().map(|&v| v as f64).sum::<f64>() / per_member as f64);
            self.add(name, means.collect());
        }
    }

    /// Records one metric per member.
    pub fn add(&mut self, name: &str, per_member: Vec<f64>) {
        let (sum, count) = self.sums.entry(name.to_owned()).or_insert_with(|| (vec![0.0; per_member.len()], 0));
        sum.iter_mut().zip(per_member).for_each(|(s, v)| *s += v);
        *count += 1;
    }

    /// Returns the means since the last call and resets the meter.
    pub fn take(&mut self) -> BTreeMap<String, Vec<f64>> {
        let means = |(sum, n): (Vec<f64>, u64)| sum.into_iter().map(|s| s / n as f64).collect();
        std::mem::take(&mut self.sums).into_iter().map(|(name, entry)| (name, means(entry))).collect()
    }
}

/// A report that [`train`] gives at intervals.
#[derive(Clone, Debug)]
pub struct Report {
    /// Steps done.
    pub step: u64,
    /// Mean of each metric since the last report, per member.
    pub metrics: BTreeMap<String, Vec<f64>>,
}

impl From<(u64, Meter)> for Report {
    fn from((step, mut metrics): (u64, Meter)) -> Self {
        Self { step, metrics: metrics.take() }
    }
}

impl Report {
    /// Members with a metric that is not finite: their training has diverged. The other members are not affected.
    pub fn diverged(&self) -> Vec<usize> {
        let members = self.metrics.values().map(Vec::len).max().unwrap_or(0);
        let bad = |m: &usize| self.metrics.values().any(|v| v.get(*m).is_some_and(|x| !x.is_finite()));
        (0..members).filter(bad).collect()
    }
}

/// The number of steps, and the interval of reports.
#[derive(Clone, Copy, Debug)]
pub struct Steps {
    /// First step, 0 unless resumed.
    pub from: u64,
    /// One past the last.
    pub to: u64,
    /// Steps between reports; there is always one at the end; 0: only at the end.
    pub report_every: u64,
}

impl Steps {
    /// `count` steps, starting at 0.
    pub fn new(count: u64, report_every: u64) -> Self {
        Self { from: 0, to: count, report_every }
    }
}

/// How a training run ended: its current step, and whether the user stopped it early.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Steps done; the run can be resumed from here.
    pub step: u64,
    /// Whether the user interrupted it.
    pub interrupted: bool,
}

/// A learner and its rows.
pub struct TrainingJob<'a, L: ?Sized> {
    /// The learner.
    pub learner: &'a mut L,
    /// Its rows.
    pub buffer: &'a Buffer,
}

/// Trains `learner` on minibatches of `buffer`: [`train_side_by_side`] with one job.
///
/// # Errors
/// The error of `on_report`, and errors of the checkpoints.
pub fn train<L: Learner + ?Sized, E: From<LearnError>>(
    learner: &mut L,
    buffer: &Buffer,
    steps: Steps,
    label: &str,
    checkpoints: &mut Checkpoints,
    device: &Device,
    mut on_report: impl FnMut(&Report, &L) -> Result<(), E>,
) -> Result<Outcome, E> {
    let mut jobs = [TrainingJob { learner, buffer }];
    train_side_by_side(&mut jobs, steps, label, checkpoints, device, |_, report, l| on_report(report, l))
}

/// Trains the learners of all jobs, with one progress bar named `label`.
///
/// Jobs take the threads in turns of a few steps, so that three jobs keep two cores busy. The result of a job does not
/// depend on the other jobs or on the number of threads. `on_report` gets the job, the means of its metrics and its
/// learner, to evaluate or save it; an error from it ends the training run. The learners' device is that of their
/// parameters. Batches are created on `device`, each during the update before it.
///
/// With `checkpoints`, training resumes from the newest one, and stores one at intervals and when the user interrupts.
/// The result and all reports are then the same as without interruption. A finished run leaves its checkpoints to the
/// caller, who removes them once the result is stored.
///
/// # Errors
/// The error of `on_report`; if a checkpoint does not fit the learners or cannot be written.
pub fn train_side_by_side<L: Learner + ?Sized, E: From<LearnError>>(
    jobs: &mut [TrainingJob<L>],
    steps: Steps,
    label: &str,
    checkpoints: &mut Checkpoints,
    device: &Device,
    on_report: impl FnMut(usize, &Report, &L) -> Result<(), E>,
) -> Result<Outcome, E> {
    advance(jobs, steps, label, checkpoints, AtTheEnd::Leave, device, on_report)
}

/// What the loop does with its state after the last step.
#[derive(Clone, Copy, PartialEq, Eq)]
enum AtTheEnd {
    /// The caller has the result.
    Leave,
    /// It is stored as a checkpoint, too, for a preparation. Reports are stored in the checkpoints and all given at the
    /// end, including those of an earlier process and of a run with no steps left.
    Keep,
}

/// The loop.
fn advance<L: Learner + ?Sized, E: From<LearnError>>(
    jobs: &mut [TrainingJob<L>],
    steps: Steps,
    label: &str,
    checkpoints: &mut Checkpoints,
    at_the_end: AtTheEnd,
    device: &Device,
    mut on_report: impl FnMut(usize, &Report, &L) -> Result<(), E>,
) -> Result<Outcome, E> {
    let mut runs: Vec<_> = jobs.iter_mut().map(Run::new).collect();
    let mut step = steps.from;
    if let Some((at, state, path)) = checkpoints.restore() {
        for (k, run) in runs.iter_mut().enumerate() {
            run.restore(k, &state, &path).map_err(LearnError::from)?;
        }
        step = at;
    }
    let begun = step;
    let total = steps.to.saturating_sub(step) * runs.len() as u64;
    let progress = Progress::new(label, total, "steps");
    while step < steps.to {
        let stop = interrupted();
        if step > steps.from && (stop || checkpoints.due()) {
            checkpoints.keep(step, state_of(&runs)).map_err(LearnError::from)?;
        }
        if stop {
            return Ok(Outcome { step, interrupted: true });
        }
        let due = match steps.report_every {
            0 => steps.to,
            every => ((step / every + 1) * every).min(steps.to),
        };
        let turn = step..due.min(step + TURN);
        on_threads_of(device, || {
            runs.par_iter_mut().for_each(|run| run.advance(turn.clone(), steps.to, device, &progress));
        });
        step = turn.end;
        if step == due {
            for (k, run) in runs.iter_mut().enumerate() {
                let metrics = (step, std::mem::take(&mut run.meter));
                let report = Report::from(metrics.clone());
                for member in report.diverged() {
                    tce_base::note!(
                        "{label}: member {} has diverged at step {step} (a loss is not finite)",
                        k + member
                    );
                }
                match at_the_end {
                    AtTheEnd::Keep => run.history.push(metrics),
                    AtTheEnd::Leave => on_report(k, &report, run.job.learner)?,
                }
            }
        }
    }
    progress.finish();
    if at_the_end == AtTheEnd::Keep {
        if begun < steps.to {
            checkpoints.keep(steps.to, state_of(&runs)).map_err(LearnError::from)?;
        }
        for (k, run) in runs.iter_mut().enumerate() {
            for report in std::mem::take(&mut run.history).into_iter().map(Report::from) {
                on_report(k, &report, run.job.learner)?;
            }
        }
    }
    Ok(Outcome { step: steps.to.max(steps.from), interrupted: false })
}

/// The state of all jobs.
fn state_of<L: Learner + ?Sized>(runs: &[Run<L>]) -> NamedParameters {
    let mut state = NamedParameters::default();
    runs.iter().enumerate().for_each(|(k, run)| run.keep(k, &mut state));
    state
}

/// A job in progress.
struct Run<'a, 'b, L: ?Sized> {
    job: &'a mut TrainingJob<'b, L>,
    meter: Meter,
    /// Metrics of past reports that are given at the end, with their steps.
    history: Vec<(u64, Meter)>,
    /// The batch of the next step.
    next: Option<Minibatch>,
}

impl<'a, 'b, L: Learner + ?Sized> Run<'a, 'b, L> {
    fn new(job: &'a mut TrainingJob<'b, L>) -> Self {
        Self { job, meter: Meter::default(), history: Vec::new(), next: None }
    }

    /// Adds the state of this job, number `k`, to a checkpoint.
    fn keep(&self, k: usize, state: &mut NamedParameters) {
        let own = self.job.learner.state();
        state.extend_under(&format!("{k}/"), own);
        let metrics = serde_json::to_string(&(&self.meter, &self.history)).expect("plain data");
        state.metadata.insert(format!("{k}/meter"), metrics);
    }

    /// Restores the state that [`Run::keep`] added.
    fn restore(&mut self, k: usize, state: &NamedParameters, path: &Path) -> Result<(), NetworkError> {
        let mut own = state.under(&format!("{k}/"));
        // Checkpoints from before November 2026 have no history.
        let metrics = |text: String| {
            serde_json::from_str(&text).ok().or_else(|| Some((serde_json::from_str(&text).ok()?, Vec::new())))
        };
        let meter = own.metadata.remove("meter").and_then(metrics);
        (self.meter, self.history) = meter.ok_or_else(|| NetworkError::Format {
            path: path.to_owned(),
            reason: format!("no metrics of job {k}, so no checkpoint of this training; remove it to begin anew"),
        })?;
        self.job.learner.restore(&own, path)
    }

    fn advance(&mut self, turn: std::ops::Range<u64>, end: u64, device: &Device, progress: &Progress) {
        let TrainingJob { learner, buffer } = self.job;
        for step in turn {
            let batch = self.next.take().unwrap_or_else(|| buffer.sample(step, device));
            self.meter.active = step % METER_EVERY == 0;
            let meter = &mut self.meter;
            let (_, next) = rayon::join(
                || learner.update(&batch, step, meter),
                || (step + 1 < end).then(|| buffer.sample(step + 1, device)),
            );
            self.next = next;
            progress.inc(1);
        }
    }
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
    fn figures_survive_a_checkpoint_whatever_they_are() {
        let mut meter = Meter::default();
        meter.add("x", vec![f64::NAN, 0.1 + 0.2]);
        let text = serde_json::to_string(&meter).unwrap();
        let mut back: Meter = serde_json::from_str(&text).unwrap();
        let x = back.take()["x"].clone();
        assert!(x[0].is_nan() && x[1] == 0.1 + 0.2, "{x:?}");
    }

    #[test]
    fn a_diverged_member_is_named() {
        let report = Report {
            step: 1,
            metrics: BTreeMap::from([("a".into(), vec![1.0, f64::NAN]), ("b".into(), vec![0.0, 0.0])]),
        };
        assert_eq!(report.diverged(), [1]);
    }
}
