//! Replays every `AGENT_SHIFT_QUALITY.hdf5` of a directory and prints the table of errors.
//!
//! `cargo run --release -p tce-sim --example replay_table -- ../shared/datasets/otdf`

use std::path::PathBuf;

use tce_data::{Agent, LoadOptions, Shift, load};
use tce_sim::replay;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let directory = PathBuf::from(std::env::args().nth(1).ok_or("which directory?")?);
    println!(
        "{:36} {:>5} {:>5} {:>5} {:>5} | {:>8} {:>8} {:>8} {:>8} | {:>8} {:>8} {:>8} | miss",
        "data set", "rows", "used", "carry", "skip", "s' med", "p90", "p99", "max", "r med", "p99", "max"
    );
    let mut all = true;
    for agent in Agent::ALL {
        for shift in Shift::ALL {
            for quality in ["medium", "medium_expert", "expert"] {
                let name = format!("{agent}_{}_{quality}", shift.file_name());
                let path = directory.join(format!("{name}.hdf5"));
                if !path.exists() {
                    continue;
                }
                let data =
                    load(&path, &LoadOptions { dims: Some(agent.dims()), ..LoadOptions::default() })?.transitions;
                let r = replay(agent, shift, &data, None)?;
                let (s, w) = (r.next_observation, r.reward);
                println!(
                    "{name:36} {:5} {:5} {:5} {:5} | {:8.1e} {:8.1e} {:8.1e} {:8.1e} | {:8.1e} {:8.1e} {:8.1e} | {:?} {}",
                    r.rows,
                    r.compared,
                    r.carried,
                    r.skipped_clipped,
                    s.median,
                    s.p90,
                    s.p99,
                    s.max,
                    w.median,
                    w.p99,
                    w.max,
                    r.terminal_mismatches,
                    if r.passes() { "pass" } else { "FAIL" }
                );
                all &= r.passes();
            }
        }
    }
    if all { Ok(()) } else { Err("some data sets are not reproduced".into()) }
}
