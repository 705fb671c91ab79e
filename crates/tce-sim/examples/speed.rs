//! Environment steps per second of every robot (uniformly random actions).
//!
//! `RAYON_NUM_THREADS=1 cargo run --release -p tce-sim --example speed -- [ROWS]`

use std::time::Instant;

use tce_base::Streams;
use tce_data::{Agent, Shift};
use tce_sim::{CollectOptions, UniformActor, collect};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let rows: usize = std::env::args().nth(1).map_or(Ok(50_000), |a| a.parse())?;
    println!("{} threads", rayon::current_num_threads());
    for agent in Agent::ALL {
        let start = Instant::now();
        let data = collect(agent, Shift::Source, &UniformActor, &CollectOptions::new(rows, Streams::new(0)))?;
        let seconds = start.elapsed().as_secs_f64();
        println!("{agent:12} {:8.0} steps/s, {} episodes", data.len() as f64 / seconds, data.episodes().len());
    }
    Ok(())
}
