//! Timings at the size of the benchmark. They are not tests: run them by hand with
//! `cargo nextest run --release -p tce-data --run-ignored only --no-capture speed`.

use std::collections::BTreeMap;
use std::time::Instant;

use rand::RngExt;
use tce_base::Streams;
use tce_data::{
    DensityOptions, LoadOptions, NeighbourOptions, Rows, Standardizer, TransportOptions, check, density_scores,
    inspect, load, nn_distances, save_d4rl, save_minari, transport_costs, zscore_keep,
};

fn seconds<T>(what: &str, work: impl FnOnce() -> T) -> T {
    let started = Instant::now();
    let out = work();
    eprintln!("{what}: {:.2} s, peak memory {} MB", started.elapsed().as_secs_f64(), peak_mb());
    out
}

fn peak_mb() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with("VmHWM")).unwrap_or_default();
    line.split_whitespace().nth(1).and_then(|n| n.parse::<u64>().ok()).unwrap_or(0) / 1024
}

fn points(name: &str, rows: usize, dim: usize) -> Vec<f32> {
    let mut rng = Streams::new(1).stream(name);
    (0..rows * dim).map(|d| (1.0 + (d % dim) as f32) * rng.random_range(-1.0f32..1.0)).collect()
}

#[test]
#[ignore = "a timing"]
fn speed_of_files() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("big.hdf5");
    let t = crate::common::synthetic(1_000_000, 17, 6, 1000);
    eprintln!("the table itself: {} MB", peak_mb());
    seconds("save 1M x (17 + 6 + 1 + 17)", || save_d4rl(&path, &t, &BTreeMap::new(), &[]).unwrap());
    eprintln!("file: {} MB", std::fs::metadata(&path).unwrap().len() >> 20);
    let got = seconds("load", || load(&path, &LoadOptions::default()).unwrap());
    assert!(got.transitions == t);
    seconds("inspect", || inspect(&t, Some(1000)));
    seconds("check", || check(&t, None));
    seconds("standardise", || Standardizer::fit(&t.observations, 17).apply(&t.observations));
    seconds("z-score", || zscore_keep(&Rows::state_pairs(&t), 3.0));
}

#[test]
#[ignore = "a timing"]
fn speed_of_many_episodes() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("tce/many-v0");
    // No successor is the next row's state: every row becomes an episode.
    let t = crate::common::synthetic(8000, 3, 2, 10);
    seconds("save 8000 episodes", || save_minari(&path, "tce/many-v0", &t, None).unwrap());
    let got = seconds("load", || load(&path, &LoadOptions::default()).unwrap());
    assert!(got.transitions.rewards == t.rewards);
}

#[test]
#[ignore = "a timing"]
fn speed_of_loading() {
    let path = std::path::PathBuf::from(std::env::var_os("TCE_FILE").expect("TCE_FILE"));
    seconds("load", || load(&path, &LoadOptions::default()).unwrap());
}

#[test]
#[ignore = "a timing"]
fn speed_of_neighbours() {
    let (x, y) = (points("source", 1_000_000, 40), points("target", 5_000, 40));
    let options = NeighbourOptions::default();
    seconds("neighbours 1M x 5k x 40", || nn_distances(&Rows::new(&x, 40), &Rows::new(&y, 40), &options).unwrap());
}

#[test]
#[ignore = "a timing"]
fn speed_of_density_scores() {
    let (x, y) = (points("source", 1_000_000, 40), points("target", 5_000, 40));
    let (x, y) = (Rows::new(&x, 40), Rows::new(&y, 40));
    let options = DensityOptions::default();
    seconds("density scores 1M x 50k x 40", || density_scores(&x, &y, &options, &Streams::new(0)).unwrap());
}

#[test]
#[ignore = "a timing"]
fn speed_of_transport() {
    let (x, y) = (points("source", 10_000, 40), points("target", 5_000, 40));
    let options = TransportOptions::default();
    seconds("transport 10k x 5k x 40", || transport_costs(&Rows::new(&x, 40), &Rows::new(&y, 40), &options).unwrap());
}
