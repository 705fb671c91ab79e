//! What tests of sweeps share.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use serde_json::Value;

/// Settings under which a piece of work takes a second or two.
pub const SETS: &[&str] = &[
    "source.rows=1500",
    "dynamics.steps=20",
    "generator.state_steps=100",
    "generator.transition_steps=100",
    "generator.batch=32",
    "generator.rows=600",
    "generator.sampler.steps=4",
    "labels.training.steps=60",
    "labels.training.batch=32",
    "learner.steps=120",
    "learner.behaviour.cvae.steps=30",
    "learner.behaviour.cvae.hidden=[16]",
    "learner.batch=32",
    "evaluation.episodes=1",
];

/// Writes the description of a small sweep.
pub fn describe(directory: &Path, name: &str, seeds: u64) -> String {
    let sets: Vec<String> = SETS.iter().map(|s| format!("{s:?}")).collect();
    let file = format!("{name}.toml");
    let text = format!(
        "tasks = [\"hopper-morph:medium->expert\"]\nvariants = [\"tce-og\", \"tce-no-reg\", \"bc\"]\nbaselines = false\n\
         seeds = {seeds}\nset = [{}]\nfrom_zoo = true\n",
        sets.join(", ")
    );
    fs::write(directory.join(&file), text).unwrap();
    file
}

/// What the records in `done/` say, without times and memory.
pub fn outcomes(sweep: &Path) -> BTreeMap<String, Value> {
    let mut out = BTreeMap::new();
    for path in fs::read_dir(sweep.join("done")).into_iter().flatten().map(|e| e.unwrap().path()) {
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        if name.starts_with('.') {
            continue;
        }
        let mut value: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        for cost in ["seconds", "memory"] {
            value.as_object_mut().unwrap().remove(cost);
        }
        out.insert(name, value);
    }
    out
}
