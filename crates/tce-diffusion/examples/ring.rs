//! A score model of a toy distribution, trained and sampled: points on a ring, and on a smaller one.
//!
//!     cargo run --release --example ring
//!
//! The label y moves the samples from the small ring (0) to the large one (1), as it moves TCE's states from the target's to the
//! source's.

use tce_base::Streams;
use tce_base::random::fill_normal;
use tce_diffusion::metrics::sliced_wasserstein;
use tce_diffusion::{
    Balance, DiffusionError, Edm, NetworkConfig, Process, Request, Sampler, ScoreData, TrainConfig, Trainer,
};
use tce_nn::{Checkpoints, cpu};

const POINTS: usize = 3000;

/// Points at distance `radius` of the origin, give or take .05.
fn ring(radius: f32) -> Vec<f32> {
    let mut noise = vec![0.0; 3 * POINTS];
    fill_normal(&mut Streams::new(1).stream(&format!("ring {radius}")), &mut noise);
    let point = |z: &[f32]| {
        let scale = (radius + 0.05 * z[2]) / z[0].hypot(z[1]);
        [z[0] * scale, z[1] * scale]
    };
    noise.chunks_exact(3).flat_map(point).collect()
}

/// A picture of 16 lines of the square [-2, 2]².
fn picture(points: &[f32]) -> String {
    let mut counts = [[0; 32]; 16];
    for p in points.chunks_exact(2).filter(|p| p.iter().all(|x| x.abs() < 2.0)) {
        counts[((p[1] + 2.0) * 4.0) as usize][((p[0] + 2.0) * 8.0) as usize] += 1;
    }
    let shade = |n: &usize| [' ', '.', ':', 'o', '#'][(n / 6).min(4)];
    counts.iter().map(|line| line.iter().map(shade).collect::<String>() + "\n").collect()
}

fn main() -> Result<(), DiffusionError> {
    let (large, small) = (ring(1.4), ring(0.6));
    let data = ScoreData::labelled(&large, &small, 2, Balance::Parts)?;
    let network = NetworkConfig { width: 64, embedding: 16, blocks: 2, ..NetworkConfig::new(2, 1) };
    let config = TrainConfig { learning_rate: 2e-3, ema: 0.99, ..TrainConfig::default() };
    let process = Process::Edm(Edm { sigma_max: 20.0, ..Edm::default() });
    let mut trainer = Trainer::new("ring", network, process, config, &[Streams::new(0)], &cpu())?;
    trainer.train(std::slice::from_ref(&data), 4000, &mut Checkpoints::none(), |_, _| {})?;
    let model = trainer.model();
    for y in [0.0, 0.5, 1.0] {
        let condition = vec![y; POINTS];
        let request =
            Request { name: "points", rows: POINTS, condition: &condition, guidance: None, start: None, kept: None };
        let points = model.sample(request, &Sampler::DpmSolver { steps: 20 }, &[Streams::new(5)], None)?;
        let [to_small, to_large] =
            [&small, &large].map(|ring| sliced_wasserstein(&points, ring, 2, 50, &Streams::new(0)));
        println!("y = {y}: distance to the small ring {to_small:.3}, to the large one {to_large:.3}");
        println!("{}", picture(&points));
        assert!(y != 0.0 || to_small < 0.15, "y = 0 is the small ring");
        assert!(y != 1.0 || to_large < 0.15, "y = 1 is the large ring");
    }
    Ok(())
}
