//! Training steps and score evaluations per second at the sizes of HalfCheetah: `cargo run --release --example score_speed`.

use std::time::Instant;

use tce_base::Streams;
use tce_base::random::fill_normal;
use tce_diffusion::{Edm, NetworkConfig, Process, Request, Sampler, ScoreData, TrainConfig, Trainer, uniform_labels};
use tce_nn::cpu;

fn main() {
    let d = 17;
    let mut rows = vec![0.0; 10_000 * d];
    fill_normal(&mut Streams::new(0).stream("rows"), &mut rows);
    let process = Process::Edm(Edm::default());
    let (source, target) = rows.split_at(5000 * d);
    for members in [1, 5] {
        let streams: Vec<_> = (0..members).map(Streams::new).collect();
        let data = [ScoreData::labelled(source, target, d, true).expect("rows")];
        let spec = NetworkConfig::new(d, 1);
        let mut trainer =
            Trainer::new("state", spec, process, TrainConfig::default(), &streams, &cpu()).expect("sizes");
        trainer.train(&data, 50, |_, _| {}).expect("warm-up");
        let start = Instant::now();
        trainer.train(&data, 550, |_, _| {}).expect("training");
        let rate = 500.0 / start.elapsed().as_secs_f64();
        println!("P = {members}: {rate:.0} training steps/s, {:.0} members' steps/s", rate * members as f64);
        let (model, n) = (trainer.model(), 16384 / members as usize);
        let labels = uniform_labels(&Streams::new(0), "y", n, 0.2);
        let request = Request { name: "speed", rows: n, condition: &labels, start: None };
        for sampler in
            [Sampler::DpmSolver { steps: 20 }, Sampler::PredictorCorrector { steps: 10, snr: 0.16, corrections: 1 }]
        {
            let start = Instant::now();
            model.sample(request, &sampler, &streams, None).expect("sampling");
            let evaluations = (n * members as usize * sampler.evaluations()) as f64;
            println!("  {sampler:?}: {:.0} evaluations/s", evaluations / start.elapsed().as_secs_f64());
        }
    }
}
