//! Training, sampling and files together, on toys that train in seconds.

use std::path::Path;

use tce_base::Streams;
use tce_base::random::fill_normal;
use tce_diffusion::metrics::sliced_wasserstein;
use tce_diffusion::{
    Balance, Edm, NetworkConfig, Process, Request, Sampler, ScoreData, ScoreModel, Start, TrainConfig, Trainer, Ve, Vp,
    present, uniform_labels,
};
use tce_nn::{Checkpoints, cpu};

fn normal(name: &str, n: usize, mean: f32, std: f32) -> Vec<f32> {
    let mut x = vec![0.0; n];
    fill_normal(&mut Streams::new(8).stream(name), &mut x);
    x.iter().map(|x| mean + std * x).collect()
}

fn train(process: Process, spec: NetworkConfig, data: &ScoreData, members: u64, steps: u64, rate: f64) -> ScoreModel {
    let streams: Vec<_> = (0..members).map(Streams::new).collect();
    let config = TrainConfig { learning_rate: rate, ema: 0.98, ..TrainConfig::default() };
    let mut trainer = Trainer::new("toy", spec, process, config, &streams, &cpu()).unwrap();
    trainer.train(std::slice::from_ref(data), steps, &mut Checkpoints::none(), |_, _| {}).unwrap();
    trainer.model()
}

fn small(dims: usize, condition: usize) -> NetworkConfig {
    NetworkConfig { width: 48, embedding: 16, blocks: 2, ..NetworkConfig::new(dims, condition) }
}

/// Source around 1, target around −1, standard deviation .2 each: the label moves the samples from one to the other.
#[test]
fn the_label_moves_samples_between_the_domains() {
    let (source, target) = (normal("source", 2000, 1.0, 0.2), normal("target", 400, -1.0, 0.2));
    let data = ScoreData::labelled(&source, &target, 1, Balance::Parts).unwrap();
    for (process, sampler) in [
        (Process::Edm(Edm::default()), Sampler::DpmSolver { steps: 20 }),
        (Process::Vp(Vp::default()), Sampler::Heun { steps: 18 }),
        (Process::Ve(Ve::default()), Sampler::PredictorCorrector { steps: 100, snr: 0.16, corrections: 1 }),
    ] {
        let model = train(process, small(1, 1), &data, 1, 1500, 2e-3);
        let distances = [0.0, 0.5, 1.0].map(|y| {
            let n = 2000;
            let request =
                Request { name: "x", rows: n, condition: &vec![y; n], guidance: None, start: None, kept: None };
            let x = model.sample(request, &sampler, &[Streams::new(5)], None).unwrap();
            [&source, &target].map(|rows| sliced_wasserstein(&x, rows, 1, 1, &Streams::new(0)))
        });
        // (to source, to target) at labels 0, .5 and 1; the domains are 2 apart.
        let [at_target, between, at_source] = distances;
        assert!(at_target[1] < 0.15 && at_source[0] < 0.15, "{process:?}: {distances:?}");
        assert!(at_target[1] < between[1] && between[1] < at_source[1], "{process:?}: {distances:?}");
        assert!(at_source[0] < between[0] && between[0] < at_target[0], "{process:?}: {distances:?}");
    }
}

/// x | c ~ N(c, .1²), from VE with its start repaired by data rows.
#[test]
fn samples_follow_their_condition() {
    let c = normal("c", 3000, 0.0, 1.0);
    let rows: Vec<f32> = c.iter().zip(normal("e", 3000, 0.0, 0.1)).map(|(c, e)| c + e).collect();
    let data = ScoreData::conditioned(&rows, 1, &c, 1).unwrap();
    let model = train(Process::Ve(Ve { start: Start::Data, ..Ve::default() }), small(1, 1), &data, 1, 1500, 2e-3);
    let on = normal("new", 3000, 0.0, 1.0);
    let request = Request { name: "x", rows: 3000, condition: &on, guidance: None, start: Some(&rows), kept: None };
    let x = model.sample(request, &Sampler::Heun { steps: 18 }, &[Streams::new(5)], None).unwrap();
    let error = (x.iter().zip(&on).map(|(x, c)| (x - c).powi(2)).sum::<f32>() / 3000.0).sqrt();
    assert!(error > 0.05 && error < 0.25, "{error}");
}

/// One network learns p(x | score) and p(x): score 1 is around 1, score 0 around −1, and half of the rows have either.
#[test]
fn a_dropped_condition_is_the_whole_distribution_and_guidance_sharpens() {
    let (high, low) = (normal("high", 1000, 1.0, 0.2), normal("low", 1000, -1.0, 0.2));
    let rows = [high, low].concat();
    let on = present(&[vec![1.0; 1000], vec![0.0; 1000]].concat(), 1);
    let data = ScoreData::conditioned(&rows, 1, &on, 2).unwrap().with_dropout(0.25).unwrap();
    let model = train(Process::Edm(Edm::default()), small(1, 2), &data, 1, 1500, 2e-3);
    let n = 2000;
    let sample = |score: f32, guidance: Option<f64>| {
        let condition = present(&vec![score; n], 1);
        let request = Request { name: "x", rows: n, condition: &condition, guidance, start: None, kept: None };
        assert_eq!(request.evaluations(&Sampler::Heun { steps: 3 }), if guidance.is_some() { 10 } else { 5 });
        model.sample(request, &Sampler::DpmSolver { steps: 20 }, &[Streams::new(5)], None).unwrap()
    };
    let high = |x: &[f32]| x.iter().filter(|x| **x > 0.0).count() as f64 / n as f64;
    assert!(high(&sample(1.0, None)) > 0.97 && high(&sample(0.0, None)) < 0.03);
    let without = high(&sample(1.0, Some(0.0)));
    assert!((without - 0.5).abs() < 0.1, "{without}");
    // Between the two the guided samples go further to the side of their condition than the plain ones.
    let (plain, guided) = (high(&sample(0.7, None)), high(&sample(0.7, Some(2.0))));
    assert!(guided >= plain, "{guided} {plain}");
    let same = sample(1.0, Some(1.0)).iter().zip(sample(1.0, None)).all(|(a, b)| (a - b).abs() < 1e-3);
    assert!(same, "weight 1 is no guidance");
    let request =
        Request { name: "x", rows: 1, condition: &[0.0; 2], guidance: Some(f64::NAN), start: None, kept: None };
    let error = model.sample(request, &Sampler::DpmSolver { steps: 5 }, &[Streams::new(5)], None).unwrap_err();
    assert_eq!(error.to_string(), "guidance of 'x': found NaN, expected a finite number");
}

fn population() -> (ScoreModel, [Streams; 2]) {
    let rows = normal("rows", 300, 0.0, 1.0);
    let data = ScoreData::labelled(&rows[..150], &rows[150..], 3, Balance::Parts).unwrap();
    let model = train(Process::Vp(Vp::default()), small(3, 1), &data, 2, 30, 1e-3);
    (model, [Streams::new(20), Streams::new(21)])
}

#[test]
fn bytes_do_not_depend_on_the_threads_nor_on_the_population() {
    let n = 5000; // more than a chunk
    let labels: Vec<f32> = (0..2).flat_map(|m| uniform_labels(&Streams::new(m), "y", n, 0.2)).collect();
    assert!(labels.iter().all(|y| (0.0..0.2).contains(y)));
    let sampler = Sampler::PredictorCorrector { steps: 5, snr: 0.16, corrections: 1 };
    let request = Request { name: "state", rows: n, condition: &labels, guidance: None, start: None, kept: None };
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let (model, streams) = population();
            let rows = model.sample(request, &sampler, &streams, None).unwrap();
            (model, streams, rows)
        })
    };
    let (model, streams, rows) = run(1);
    let (other, _, more) = run(2);
    assert_eq!(model.parameters().to_bytes(), other.parameters().to_bytes());
    assert_eq!(rows, more);
    assert_eq!(rows.len(), 2 * n * 3);
    // The second member alone, with its own labels.
    let request = Request { condition: &labels[n..], ..request };
    assert_eq!(rows[n * 3..], model.member(1).sample(request, &sampler, &streams[1..], None).unwrap());
    // Another name is other noise.
    let renamed = Request { name: "next", ..request };
    assert_ne!(rows[n * 3..], model.member(1).sample(renamed, &sampler, &streams[1..], None).unwrap());
}

#[test]
fn files_keep_the_model() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("q.safetensors");
    let (model, _) = population();
    model.save(&path).unwrap();
    let loaded = ScoreModel::load(&path, &cpu()).unwrap();
    assert_eq!(loaded.parameters(), model.parameters());
    assert_eq!((loaded.config(), loaded.process(), loaded.members()), (model.config(), model.process(), 2));
    let mut foreign = model.parameters();
    foreign.metadata.clear();
    let error = ScoreModel::from_parameters(&foreign, Path::new("a.safetensors"), &cpu()).unwrap_err().to_string();
    assert!(error.contains("a.safetensors") && error.contains("score_model"), "{error}");
}

#[test]
fn requests_that_do_not_fit_are_refused() {
    let (model, streams) = population();
    let request = Request { name: "x", rows: 3, condition: &[0.0; 3], guidance: None, start: None, kept: None };
    let error = |request, sampler: Sampler, streams: &[Streams]| {
        model.sample(request, &sampler, streams, None).unwrap_err().to_string()
    };
    let sampler = Sampler::DpmSolver { steps: 5 };
    let wrong = Request { condition: &[0.0; 4], ..request };
    let expected = "condition of 'x': found 4 numbers, expected 3 rows of 1, or 2 times as many";
    assert_eq!(error(wrong, sampler, &streams), expected);
    assert_eq!(error(request, sampler, &streams[..1]), "streams: found 1, expected one per member, 2");
    assert_eq!(error(request, Sampler::Heun { steps: 0 }, &streams), "sampler.steps: found 0, expected at least 2");

    let rows = [0.5, -0.5];
    let data = ScoreData::labelled(&rows[..1], &rows[1..], 1, Balance::Parts).unwrap();
    let model = train(Process::Ve(Ve { start: Start::Data, ..Ve::default() }), small(1, 1), &data, 1, 1, 1e-3);
    let error = model.sample(request, &sampler, &streams[..1], None).unwrap_err().to_string();
    assert!(error.starts_with("start of 'x': found nothing, expected training rows"), "{error}");
}
