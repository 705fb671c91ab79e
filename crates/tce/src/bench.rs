//! What `tce bench` measures: the program's hot loops on HalfCheetah's sizes, each beside what the core could do just then.
//!
//! A repeat is half a second of one workload between two measurements of the core's own matrix-product rate, so that a
//! machine that others slow down shows it. FLOPs are those of the matrix products, two per multiply-add; what is not a
//! product (activations, Adam, batches) counts as time but not as work.

use std::sync::{Arc, LazyLock};
use std::time::Instant;

use serde::Serialize;
use tce_base::Streams;
use tce_base::random::fill_normal;
use tce_data::{
    Agent, NeighbourOptions, Rows, Shift, Standardizer, Transitions, TransportOptions, nn_distances, transport_costs,
};
use tce_diffusion::{
    Balance, Denoiser, Edm, NetworkConfig, Process, Request, Sampler, ScoreData, ScoreModel, TrainConfig, Trainer,
    uniform_labels,
};
use tce_learn::cvae::{CvaeConfig, CvaeLearner, Modelled};
use tce_learn::sac::{Sac, SacConfig};
use tce_learn::world_model::Worlds;
use tce_learn::{
    Bc, BcConfig, Buffer, Iql, IqlConfig, LabelConfig, LabelModels, LearnError, Learner, Member, MetaDt, MetaDtConfig,
    Place, Regulariser, RegulariserConfig, RegulariserKind, Steps, TrainingJob, train_side_by_side,
};
use tce_nn::{Checkpoints, Device, is_cpu, on_threads_of, product_rate, tensor};
use tce_run::config::Algorithm;
use tce_run::error::Result;
use tce_run::layers::{Layered, Preset};
use tce_run::methods::build;
use tce_sim::{CollectOptions, UniformActor, collect};

/// HalfCheetah's observations and actions, the hidden width, and rows per batch.
const OBS: usize = 17;
const ACT: usize = 6;
const WIDTH: usize = 256;
const BATCH: usize = 256;
/// Seconds of the core's own rate between two repeats.
const PROBE: f64 = 0.01;

/// A workload that runs: `call` does `units` of `unit`, each of `flops` in matrix products.
struct Body {
    unit: &'static str,
    units: f64,
    flops: f64,
    call: Box<dyn FnMut()>,
}

impl Body {
    fn new(unit: &'static str, units: f64, flops: f64, call: impl FnMut() + 'static) -> Self {
        Self { unit, units, flops, call: Box::new(call) }
    }
}

/// What is measured.
#[derive(Clone, Copy)]
enum Work {
    /// Updates of a learner of the registry.
    Method(Algorithm),
    /// Steps of an environment.
    Environment(Agent),
    /// What a function sets up.
    Own(fn(&On) -> Body),
}

/// A workload of the table.
struct Workload {
    name: String,
    title: String,
    work: Work,
}

/// What a workload runs on.
pub struct On {
    /// The device of the networks.
    pub device: Device,
    /// Seeds of IQL and of the learners on its networks.
    pub seeds: u64,
}

/// Name, title and how to set it up.
type Own = (&'static str, &'static str, fn(&On) -> Body);

/// What stands before the learners of the registry and the environments.
const OWN: &[Own] = &[
    ("iql", "IQL, 17/6, 256-256, 256 rows, one seed", |on| iql(on, on.seeds, RegulariserKind::None)),
    ("iql-5", "the same, five seeds side by side (members' updates)", |on| iql(on, 5, RegulariserKind::None)),
    ("iql-kl", "IQL with the forward-KL term of Eq. 10", |on| iql(on, on.seeds, RegulariserKind::ForwardKl)),
    ("sac", "SAC, 17/6, 256-256, 256 rows", sac),
    ("bc", "behaviour cloning, 256 rows", bc),
    ("meta-dt", "Meta-DT's transformer, 128 segments of 8 steps", meta_dt),
    ("meta-dt-world", "its world model, 128 rows with 8 steps of history", meta_dt_world),
    ("score-train", "training of a score network (Table B.1), 128 rows", score_train),
    ("score-eval-1k", "evaluation of a score network as in sampling, 1 024 rows", |on| score_eval(on, 1024)),
    ("score-eval-4k", "the same, 4 096 rows", |on| score_eval(on, 4096)),
    ("score-eval-16k", "the same, 16 384 rows", |on| score_eval(on, 16_384)),
    ("sample", "states by DPM-Solver++ with 20 evaluations", sample),
    ("labels", "inverse dynamics and reward, 128 rows", labels),
    ("cvae", "behaviour CVAE, 256-256, 128 rows", cvae),
    ("nearest", "nearest of 5 000 target rows, 40 dimensions (Eq. 9)", |_| nearest()),
    ("transport", "Sinkhorn costs to 5 000 target rows, blocks of 2 500", |_| transport()),
];

/// Every workload, in the order of the table.
fn workloads() -> Vec<Workload> {
    let own =
        |&(name, title, make): &Own| Workload { name: name.to_owned(), title: title.to_owned(), work: Work::Own(make) };
    // These have workloads of their own.
    let apart = [Algorithm::Iql, Algorithm::Bc, Algorithm::MetaDt];
    let methods = Algorithm::ALL.iter().filter(|a| !apart.contains(a)).map(|&algorithm| {
        let about = algorithm.about();
        Workload { name: about.name.to_owned(), title: about.title.to_owned(), work: Work::Method(algorithm) }
    });
    let environments = Agent::ALL.into_iter().map(|agent| Workload {
        name: format!("env-{agent}"),
        title: "environment steps".to_owned(),
        work: Work::Environment(agent),
    });
    OWN.iter().map(own).chain(methods).chain(environments).collect()
}

/// The names of all workloads.
pub fn names() -> impl Iterator<Item = &'static str> {
    static NAMES: LazyLock<Vec<String>> = LazyLock::new(|| workloads().into_iter().map(|w| w.name).collect());
    NAMES.iter().map(String::as_str)
}

/// Whether the workload `name` needs the simulator.
pub fn simulates(name: &str) -> bool {
    workloads().iter().any(|w| w.name == name && matches!(w.work, Work::Environment(_)))
}

/// How a workload did.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Measured {
    /// Its name.
    pub name: String,
    /// What it is.
    pub title: String,
    /// What is counted.
    pub unit: &'static str,
    /// Units per second, median of the repeats.
    pub per_second: f64,
    /// The slowest and the fastest repeat.
    pub range: [f64; 2],
    /// GFLOP/s in matrix products, median; 0 where there are none.
    pub gflops: f64,
    /// Share of the cores' own rate of matrix products around each repeat, median.
    pub share: f64,
    /// Units per second of every repeat.
    pub repeats: Vec<f64>,
}

/// Measures the workload `name`: `repeats` times `seconds`, after a warm-up.
///
/// # Panics
/// If there is no such workload ([`names`]).
pub fn measure(name: &str, repeats: usize, seconds: f64, on: &On) -> Result<Measured> {
    let known = workloads().into_iter().find(|w| w.name == name);
    let Workload { name, title, work } = known.expect("a known workload");
    let mut body = match work {
        Work::Method(algorithm) => method(on, algorithm),
        Work::Environment(agent) => environment(agent),
        Work::Own(make) => make(on),
    };
    let mut call = || {
        (body.call)();
        // A GPU works behind the program's back.
        on_threads_of(&on.device, || on.device.sync()).expect("a device that works");
    };
    call();
    let threads = rayon::current_num_threads() as f64;
    let (mut rates, mut shares) = (Vec::new(), Vec::new());
    let mut before = product_rate(PROBE);
    for _ in 0..repeats {
        if tce_base::interrupted() {
            return Err(tce_run::error::Error::interrupted());
        }
        let started = Instant::now();
        let mut calls = 0u32;
        while calls == 0 || started.elapsed().as_secs_f64() < seconds {
            call();
            calls += 1;
        }
        let rate = f64::from(calls) * body.units / started.elapsed().as_secs_f64();
        let after = product_rate(PROBE);
        rates.push(rate);
        shares.push(rate * body.flops / 1e9 / (0.5 * (before + after)) / threads);
        before = after;
    }
    let per_second = median(&rates);
    Ok(Measured {
        name,
        title,
        unit: body.unit,
        per_second,
        range: [rates.iter().copied().fold(f64::INFINITY, f64::min), rates.iter().copied().fold(0.0, f64::max)],
        gflops: per_second * body.flops / 1e9,
        share: median(&shares),
        repeats: rates,
    })
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len();
    0.5 * (sorted[(n - 1) / 2] + sorted[n / 2])
}

/// Normal rows with actions in the box, every row an episode.
fn table(seed: u64, rows: usize) -> Arc<Transitions> {
    let mut t = Transitions::with_capacity(OBS, ACT, rows);
    let mut row = [0.0; 2 * OBS + ACT + 1];
    let mut rng = Streams::new(seed).stream("rows");
    for _ in 0..rows {
        fill_normal(&mut rng, &mut row);
        let (s, rest) = row.split_at(OBS);
        let (a, rest) = rest.split_at(ACT);
        t.push(s, &a.iter().map(|a| a.tanh()).collect::<Vec<_>>(), rest[0], &rest[1..], false, true);
    }
    Arc::new(t)
}

fn members(seeds: u64) -> Vec<Member> {
    let parts = vec![table(1, 5_000), table(2, 200_000)];
    let member = |seed| Member {
        streams: Streams::new(seed),
        parts: parts.clone(),
        standardizer: Standardizer::identity(OBS),
        reward_scale: 1.0,
        row_scores: None,
    };
    (0..seeds).map(member).collect()
}

/// Ten steps a call of learners side by side, as [`tce_run::policy_training`] trains them.
fn training<L: Learner + ?Sized + 'static>(device: &Device, jobs: Vec<(Buffer, Box<L>)>, flops: f64) -> Body {
    let (device, seeds) = (device.clone(), jobs.iter().map(|(buffer, _)| buffer.members().len()).sum::<usize>());
    let (buffers, mut learners): (Vec<_>, Vec<Box<L>>) = jobs.into_iter().unzip();
    let mut from = 0;
    Body::new("updates", 10.0 * seeds as f64, flops, move || {
        let mut jobs: Vec<_> = learners
            .iter_mut()
            .zip(&buffers)
            .map(|(learner, buffer)| TrainingJob { learner: learner.as_mut(), buffer })
            .collect();
        let steps = Steps { from, to: from + 10, report_every: 0 };
        let done = train_side_by_side(&mut jobs, steps, "bench", &mut Checkpoints::none(), &device, |_, _, _| {
            Ok::<_, LearnError>(())
        });
        done.expect("nothing to fail");
        from += 10;
    })
}

/// Multiply-adds of one row in a network of these widths, and of its first layer alone.
fn row_products(widths: &[usize]) -> (f64, f64) {
    let all: usize = widths.windows(2).map(|w| w[0] * w[1]).sum();
    (all as f64, (widths[0] * widths[1]) as f64)
}

/// The seeds as [`tce_run::policy_training`] trains them: side by side on the CPU, elsewhere as one set of tensors.
fn jobs<L>(on: &On, seeds: u64, job: impl Fn(Vec<Member>) -> (Buffer, L)) -> Vec<(Buffer, L)> {
    let all = members(seeds);
    let size = if is_cpu(&on.device) { 1 } else { all.len() };
    all.chunks(size).map(|members| job(members.to_vec())).collect()
}

fn iql(on: &On, seeds: u64, kind: RegulariserKind) -> Body {
    let config = IqlConfig { regulariser: kind, ..IqlConfig::paper() };
    let small = RegulariserConfig {
        cvae: CvaeConfig { hidden: vec![64], steps: 10, ..CvaeConfig::paper() },
        ..RegulariserConfig::paper()
    };
    let device = &on.device;
    let job = |members| {
        let buffer = Buffer::new(members, BATCH).expect("good data");
        let regulariser = Regulariser::prepare(kind, &buffer, &small, Place::NONE, device)
            .expect("defaults")
            .expect("not interrupted");
        let learner = Iql::new(&buffer, &config, regulariser, 1 << 40, device).expect("defaults");
        (buffer, Box::new(learner))
    };
    let ((v, v1), (q, q1), (pi, pi1)) = (
        row_products(&[OBS, WIDTH, WIDTH, 1]),
        row_products(&[OBS + ACT, WIDTH, WIDTH, 1]),
        row_products(&[OBS, WIDTH, WIDTH, ACT]),
    );
    // V(s) and V(s'), the gradient of V; twins: target, online, gradient; policy and gradient. No gradient of an input.
    let products = 2.0 * v + (2.0 * v - v1) + 2.0 * (2.0 * q + 2.0 * q - q1) + (3.0 * pi - pi1);
    training(device, jobs(on, seeds, job), 2.0 * BATCH as f64 * products)
}

fn sac(On { device, .. }: &On) -> Body {
    let buffer = Buffer::new(members(1), BATCH).expect("good data");
    let learner = Sac::new(&buffer, &SacConfig::default(), device).expect("defaults");
    let (q, q1) = row_products(&[OBS + ACT, WIDTH, WIDTH, 1]);
    let (pi, pi1) = row_products(&[OBS, WIDTH, WIDTH, 2 * ACT]);
    // Policy at s' and s, with its gradient; critics: target, online, gradient, and to the action and back.
    let products = (4.0 * pi - pi1) + 2.0 * (q + 3.0 * q - q1 + 2.0 * q);
    training(device, vec![(buffer, Box::new(learner))], 2.0 * BATCH as f64 * products)
}

/// A method as the default preset has it, with target and source rows; what it trains before its first step is not timed.
fn method(on: &On, algorithm: Algorithm) -> Body {
    let layered = Layered::new(Preset::Default, None, None, None, &[]);
    let mut config = layered.and_then(|l| l.config()).expect("the default preset").learner;
    (config.algorithm, config.iql.regulariser) = (algorithm, RegulariserKind::None);
    (config.behaviour.cvae.steps, config.igdf.steps, config.bosa.cvae.steps) = (1, 1, 1);
    let job = |mut members: Vec<Member>| {
        for member in &mut members {
            member.row_scores = Some(Arc::new((0..member.parts[1].len()).map(|i| (i % 97) as f32).collect()));
        }
        let buffer = Buffer::new(members, BATCH).expect("good data");
        let learner = build(&buffer, &config, Place::NONE, &on.device).expect("defaults");
        (buffer, learner)
    };
    training(&on.device, jobs(on, on.seeds, job), 0.0)
}

fn bc(On { device, .. }: &On) -> Body {
    let buffer = Buffer::new(members(1), BATCH).expect("good data");
    let learner = Bc::new(&buffer, &BcConfig::default(), 1 << 40, device).expect("defaults");
    let (pi, pi1) = row_products(&[OBS, WIDTH, WIDTH, ACT]);
    training(device, vec![(buffer, Box::new(learner))], 2.0 * BATCH as f64 * (3.0 * pi - pi1))
}

/// Meta-DT's configuration, and few rows: their contexts, which a training computes once, are all there after the warm-up.
fn meta_dt_rows() -> (MetaDtConfig, Buffer) {
    let mut c = MetaDtConfig::default();
    c.world_model.steps = 0;
    (c, Buffer::new(members(1), BATCH).expect("good data").target_only(BATCH).expect("target rows"))
}

fn meta_dt(On { device, .. }: &On) -> Body {
    let (c, buffer) = meta_dt_rows();
    let learner = MetaDt::new(&buffer, &c, Place::NONE, device).expect("defaults").expect("not interrupted");
    let (w, square) = (&c.world_model, (c.embed * c.embed) as f64);
    let (all, states) = ((3 * c.context - 1) as f64, c.context as f64);
    // Query, key, value and output take 4 products of a token with a square, two layers 8; of other tokens than states the last has 2.
    let blocks = (c.layers - 1) as f64 * (12.0 * all * square + 2.0 * all * all * c.embed as f64);
    let last = (2.0 * all + 10.0 * states) * square + 2.0 * all * states * c.embed as f64;
    let step = OBS * w.features + (1 + w.features + w.latent + 2 * ACT) * c.embed;
    training(device, vec![(buffer, Box::new(learner))], 6.0 * c.batch as f64 * (blocks + last + states * step as f64))
}

fn meta_dt_world(On { device, .. }: &On) -> Body {
    let (c, buffer) = meta_dt_rows();
    let (w, learner) = (&c.world_model, Worlds::new(&buffer, &c.world_model, device));
    let step = (OBS + ACT + 1) * w.features + 3 * w.gru * (3 * w.features + w.gru);
    let decoder = |out: usize| row_products(&[OBS + ACT + w.latent, w.hidden[0], w.hidden[1], out]).0;
    let products = (w.horizon * step + w.gru * w.latent) as f64 + decoder(OBS) + decoder(1);
    training(device, vec![(buffer, Box::new(learner))], 6.0 * c.batch as f64 * products)
}

fn cvae(On { device, .. }: &On) -> Body {
    let config = CvaeConfig { hidden: vec![WIDTH, WIDTH], ..CvaeConfig::paper() };
    let buffer = Buffer::new(members(1), BATCH).expect("good data").target_only(config.batch).expect("target rows");
    let learner = CvaeLearner::new(&buffer, &config, Modelled::Behaviour, "cvae", device).expect("defaults");
    let latent = config.latent_per_action * ACT;
    let (encoder, first) = row_products(&[OBS + ACT, WIDTH, WIDTH, 2 * latent]);
    let (decoder, _) = row_products(&[OBS + latent, WIDTH, WIDTH, ACT]);
    let flops = 2.0 * config.batch as f64 * (3.0 * (encoder + decoder) - first);
    training(device, vec![(buffer, Box::new(learner))], flops)
}

fn labels(On { device, .. }: &On) -> Body {
    let config = LabelConfig::paper();
    let all = members(1);
    let models = LabelModels::new(&all, &config, device).expect("defaults");
    let buffer = Buffer::new(all, BATCH).expect("good data").target_only(config.batch).expect("target rows");
    let model = |out: usize| {
        let mut widths = vec![2 * OBS];
        widths.extend(vec![config.model.width; config.model.blocks + 1]);
        widths.push(out);
        let (all, first) = row_products(&widths);
        3.0 * all - first
    };
    training(device, vec![(buffer, Box::new(models))], 2.0 * config.batch as f64 * (model(ACT) + model(1)))
}

/// Multiply-adds per row of a score network: all of it, and what is left of it when time and condition are put in.
fn score_products(spec: &NetworkConfig) -> (f64, f64) {
    let (e, h, d) = (spec.embedding, spec.width, spec.dims);
    let embeddings = (1 + spec.condition) * e + 2 * e * e + 2 * e * h;
    let trunk = d * h + spec.blocks * h * h + h * d;
    ((embeddings + trunk) as f64, trunk as f64)
}

fn trainer(device: &Device, spec: NetworkConfig) -> Trainer {
    let process = Process::Edm(Edm::default());
    Trainer::new("bench", spec, process, TrainConfig::default(), &[Streams::new(0)], device).expect("sizes")
}

fn score_train(On { device, .. }: &On) -> Body {
    let spec = NetworkConfig::new(OBS, 1);
    // Both live as long as the process: the training data borrows them.
    let [source, target] = [table(2, 200_000), table(1, 5_000)].map(|t| &*Box::leak(Box::new(t)));
    let data = ScoreData::labelled(&source.observations, &target.observations, OBS, Balance::Parts).expect("rows");
    let mut trainer = trainer(device, spec);
    let batch = TrainConfig::default().batch as f64;
    let inputs = (2 * spec.embedding + spec.dims * spec.width) as f64;
    let mut steps = 0;
    Body::new("updates", 10.0, 2.0 * batch * (3.0 * score_products(&spec).0 - inputs), move || {
        steps += 10;
        trainer.train(std::slice::from_ref(&data), steps, &mut Checkpoints::none(), |_, _| {}).expect("finite rows");
    })
}

fn model(device: &Device) -> (ScoreModel, NetworkConfig) {
    let spec = NetworkConfig::new(OBS, 1);
    (trainer(device, spec).model(), spec)
}

fn score_eval(On { device, .. }: &On, rows: usize) -> Body {
    let (model, spec) = model(device);
    let mut x = vec![0.0; rows * OBS];
    fill_normal(&mut Streams::new(1).stream("x"), &mut x);
    let x = tensor(x, [1, rows, OBS], device);
    let labels = tensor(uniform_labels(&Streams::new(1), "y", rows, 0.2), [1, rows, 1], device);
    let level = model.process().level(0.5);
    // The model outlives every binding of it; both are dropped with the workload.
    let model: &'static ScoreModel = Box::leak(Box::new(model));
    let denoiser = model.bind(labels);
    Body::new("rows", rows as f64, 2.0 * score_products(&spec).1, move || drop(denoiser.denoise(x.clone(), level)))
}

fn sample(On { device, .. }: &On) -> Body {
    let (model, spec) = model(device);
    let (rows, sampler) = (16_384, Sampler::DpmSolver { steps: 20 });
    let labels = uniform_labels(&Streams::new(0), "y", rows, 0.2);
    let flops = 2.0 * score_products(&spec).1 * sampler.evaluations() as f64;
    Body::new("rows", rows as f64, flops, move || {
        let request = Request { name: "bench", rows, condition: &labels, guidance: None, start: None, kept: None };
        drop(model.sample(request, &sampler, &[Streams::new(0)], None).expect("a good request"));
    })
}

fn points(name: &str, rows: usize, dim: usize) -> Vec<f32> {
    let mut out = vec![0.0; rows * dim];
    fill_normal(&mut Streams::new(1).stream(name), &mut out);
    out.iter_mut().enumerate().for_each(|(i, x)| *x *= (1 + i % dim) as f32);
    out
}

fn nearest() -> Body {
    let (rows, target, dim) = (50_000, 5_000, 40);
    let (x, y) = (points("source", rows, dim), points("target", target, dim));
    Body::new("rows", rows as f64, 2.0 * (target * dim) as f64, move || {
        let options = NeighbourOptions::default();
        drop(nn_distances(&Rows::new(&x, dim), &Rows::new(&y, dim), &options).expect("finite rows"));
    })
}

fn transport() -> Body {
    let (rows, target, dim) = (2_500, 5_000, 40);
    let (x, y) = (points("source", rows, dim), points("target", target, dim));
    Body::new("rows", rows as f64, 0.0, move || {
        let options = TransportOptions::default();
        drop(transport_costs(&Rows::new(&x, dim), &Rows::new(&y, dim), &options).expect("finite rows"));
    })
}

fn environment(agent: Agent) -> Body {
    let rows = 4_096;
    Body::new("steps", rows as f64, 0.0, move || {
        let options = CollectOptions::new(rows, Streams::new(0));
        drop(collect(agent, Shift::Source, &UniformActor, &options).expect("the simulator runs"));
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_workload_runs() {
        let on = On { device: tce_nn::cpu(), seeds: 2 };
        for name in ["iql", "iql-kl", "sac", "score-train", "score-eval-1k", "cvae", "labels", "env-hopper"] {
            let m = measure(name, 1, 0.0, &on).unwrap();
            assert!(m.per_second > 0.0 && m.range == [m.per_second; 2], "{name}");
        }
    }

    /// 536 MFLOP an update, counted by hand from the layers of [17, 256, 256, 1], [23, 256, 256, 1] and [17, 256, 256, 6].
    #[test]
    fn an_iql_update_has_its_flops() {
        let (v, q, pi) = (70_144.0, 71_680.0, 71_424.0);
        let products = 2.0 * v + 2.0 * v - 4_352.0 + 2.0 * (4.0 * q - 5_888.0) + 3.0 * pi - 4_352.0;
        let on = On { device: tce_nn::cpu(), seeds: 1 };
        assert_eq!(iql(&on, 1, RegulariserKind::None).flops, 512.0 * products);
    }

    #[test]
    fn medians_take_the_middle() {
        assert_eq!((median(&[3.0, 1.0, 2.0]), median(&[4.0, 1.0])), (2.0, 2.5));
    }
}
