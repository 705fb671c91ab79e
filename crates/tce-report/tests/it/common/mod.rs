//! Run folders and a diagnosis, made up for the tests. Every test has the parts that it needs.
#![allow(dead_code)]

use std::fs;
use std::path::Path;
use std::sync::Arc;

use serde_json::json;
use tce_base::sha256_hex;
use tce_data::{Agent, Quality, Shift, Task};
use tce_diagnosis::{
    AtBound, Bounds, Choice, Coverage, Curve, Diagnosis, Embedding, ErrorOverDistance, Group, Histogram, Implied,
    ImpliedActions, ImpliedErrors, ImpliedRollout, Labels, Memorisation, Rated, Reliability, Sampled, Spread, Truth,
};
use tce_report::{Method, Options, Recipe, Run, RunFolder, Study};

/// A name that is markup to everybody who does not escape it.
pub const HOSTILE: &str = "<script>alert(1)</script>\"'&{}|%_$\\";

pub fn hopper() -> Task {
    Task { agent: Agent::Hopper, shift: Shift::Morph, source: Quality::Medium, target: Quality::Expert }
}

/// A run's folder with one member per score; a score that is None is a policy that diverged.
pub fn write_folder(directory: &Path, scores: &[(u64, Option<f64>)], config: &str) {
    fs::create_dir_all(directory).unwrap();
    let write = |name: &str, text: &str| fs::write(directory.join(name), text).unwrap();
    write("config.toml", config);
    let inputs = json!({ "agent": "hopper", "shift": "morph", "target": "00ff", "source": null });
    write("spec.json", &json!({ "format": 2, "stage": "x", "spec": { "inputs": inputs } }).to_string());
    let evaluation = |score: &Option<f64>| match score {
        Some(s) => json!({ "returns": [s * 10.0, s * 12.0], "lengths": [9, 9], "score": s }),
        None => json!({ "returns": [], "lengths": [], "score": null, "failed": HOSTILE }),
    };
    let summary = json!({
        "name": "x",
        "seeds": scores.iter().map(|s| s.0).collect::<Vec<_>>(),
        "scores": scores.iter().map(|s| s.1).collect::<Vec<_>>(),
        "learned": { "evaluations": scores.iter().map(|s| evaluation(&s.1)).collect::<Vec<_>>(), "seconds": 61.0 },
        "extra_rows": 1234,
        "generated": [],
        "seconds": 125.0,
        "directory": "x",
    });
    let files = json!({ "config.toml": sha256_hex(config.as_bytes()) });
    write("done.json", &json!({ "program": "tce 0.1.0", "files": files, "summary": summary }).to_string());
    let mut lines = String::new();
    for (member, (_, score)) in scores.iter().enumerate() {
        for step in [100, 200, 300] {
            let loss = 1.0 / f64::from(step);
            lines += &format!("{}\n", json!({ "stage": "learn", "step": step, "member": member, "policy_loss": loss }));
            if let Some(s) = score {
                let line = json!({ "stage": "evaluate", "step": step, "member": member, "score": s * f64::from(step) / 300.0 });
                lines += &format!("{line}\n");
            }
        }
    }
    // A killed program leaves half a line.
    write("metrics.jsonl", &(lines + "{\"stage\":\"le"));
}

pub fn method(id: &str, title: &str, baseline: bool) -> Method {
    let (base, published) = match id.strip_suffix("-published") {
        Some(base) => (base, true),
        None => (id, false),
    };
    Method {
        id: id.into(),
        title: title.into(),
        variant: id.into(),
        base: base.into(),
        published,
        baseline,
        plain: true,
    }
}

pub fn add(study: &mut Study, task: Task, method: &str, directory: &Path) {
    let folder = Arc::new(RunFolder::read(directory).unwrap().unwrap());
    assert_eq!(folder.damage(), None);
    for (index, member) in folder.members.iter().enumerate() {
        let member = member.clone();
        study.runs.push(Run {
            task,
            method: method.into(),
            member,
            index,
            folder: folder.clone(),
            recipe: Arc::new(Recipe::default()),
        });
    }
}

pub fn quick() -> Options {
    Options { resamples: 200, ..Options::default() }
}

/// One task: of every method its id, its title and a score per seed. Ids that begin with `bc` are baselines.
pub fn one_task(root: &Path, methods: &[(&str, &str, &[f64])]) -> Study {
    let mut study = Study {
        name: "demo".into(),
        sweep: false,
        directory: "demo".into(),
        methods: methods.iter().map(|(id, title, _)| method(id, title, id.starts_with("bc"))).collect(),
        runs: Vec::new(),
        missing: Vec::new(),
        conflicts: Vec::new(),
        notes: Vec::new(),
        costs: Vec::new(),
        diagnoses: Vec::new(),
        recommended: Vec::new(),
    };
    for (id, _, scores) in methods {
        let directory = root.join(id);
        let scores: Vec<(u64, Option<f64>)> = (0..).zip(scores.iter().map(|s| Some(*s))).collect();
        write_folder(&directory, &scores, "a = 1\n");
        add(&mut study, hopper(), id, &directory);
    }
    study
}

pub fn spread(median: f64) -> Option<Spread> {
    Spread::of([median * 0.5, median, median * 2.0])
}

pub fn reliability(y: f64) -> Reliability {
    Reliability {
        rows: 90,
        distance: spread(0.1 + y),
        transition_kl: spread(1.0 + 10.0 * y),
        reward_difference: spread(0.01 + y),
        reward_error: spread(0.02 + y),
        consistency: spread(0.05 + y),
    }
}

pub fn embedding(groups: &[Group]) -> Embedding {
    let points = |k: usize| (0..50).map(|i| [(i * 7 % 13) as f32 + k as f32, (i * 5 % 11) as f32]).collect();
    Embedding { groups: groups.iter().enumerate().map(|(k, g)| (*g, points(k))).collect() }
}

pub fn diagnosis(task: Option<Task>) -> Diagnosis {
    let memorisation = Memorisation {
        generated: spread(1.0).unwrap(),
        held_out: spread(0.9).unwrap(),
        identical: 0.0,
        probability: 0.45,
        of_copies: 0.9,
    };
    let at = |y: f64| AtBound {
        y_max: y,
        lost: 0,
        coverage: Some(Coverage { target: 0.9 - y, source: Some(0.1 + y) }),
        rejected: 0.1,
        memorisation: Some(memorisation),
        kept: reliability(y),
        outliers: Some(reliability(2.0 * y)),
    };
    let generated: Vec<f64> = (0..100).map(|i| 0.2 + 0.001 * f64::from(i)).collect();
    let sources: Vec<f64> = (0..100).map(|i| 0.5 + 0.01 * f64::from(i)).collect();
    let curve = Curve::of(&Rated::certain(sources), &Rated::certain(generated));
    let histogram = |n: u64| Histogram { low: 0.0, high: 0.2, counts: (0..20).map(|k| n + k % 3).collect() };
    let implied = ImpliedErrors {
        rows: 2000,
        lost: 0,
        draws: 8,
        single: 0.25,
        mean: 0.2,
        between_draws: 0.15,
        inverse: 0.03,
        spread: 0.5,
    };
    Diagnosis {
        of: "tce-og-<b>".into(),
        task,
        seed: 3,
        y_max: 0.2,
        z_threshold: Some(3.0),
        lambda: 0.0,
        rows: 100,
        target_rows: 5000,
        coverage_rows: 45,
        covered_by_target: Some(Coverage { target: 0.96, source: Some(0.05) }),
        covered_by_fresh: true,
        bounds_of_y: [0.0, 0.1, 0.2].map(at).into(),
        sampled: Sampled {
            y_kept: histogram(5),
            y_rejected: histogram(1),
            z: histogram(4),
            z_real: histogram(3),
            real_rejected: 0.07,
        },
        transitions: Some(embedding(&[Group::Source, Group::NearestSource, Group::Target, Group::Generated])),
        states: vec![(0.2, embedding(&[Group::Source, Group::Target, Group::Generated]))],
        labels: Labels {
            held_out_action: Some((0.01, 0.5)),
            held_out_reward: Some((0.02, 0.6)),
            at_source: Some((0.2, 0.3)),
            at_generated: Some((0.1, 0.2)),
            terminal: Some(0.01),
        },
        implied: Some(Implied {
            actions: ImpliedActions { trained: Some(implied), held_out: Some(implied) },
            rollout: Some(ImpliedRollout {
                episodes: 10,
                score: Some((61.0, 4.0)),
                returns: Some((1000.0, 50.0)),
                length: Some(900.0),
                failed: None,
            }),
            behaviour_score: Some(90.0),
        }),
        error_over_distance: ErrorOverDistance::of(
            (1..=100).map(|i| (0.01 * f64::from(i), 0.02 * f64::from(i))).collect(),
            Some(0.3),
            Truth::Simulator,
        ),
        choice: curve.as_ref().map(Choice::of),
        choice_by_simulator: curve.as_ref().map(Choice::of),
        theorem: Some(Bounds {
            discount: 0.99,
            r_max: 5.0,
            transition: curve.clone(),
            value: curve.clone(),
            transition_alone: curve.clone(),
            value_alone: curve,
            held_out: Some((0.1, 0.05)),
        }),
        notes: vec!["a <note>".into()],
    }
}
