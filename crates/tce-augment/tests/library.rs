//! The method as a library: two tables in memory, no files.

use std::sync::Arc;

use rand::RngExt;
use tce_augment::config::{FilterConfig, SingleStageConfig};
use tce_augment::single_stage::SingleStage;
use tce_augment::{Augmenter, Settings, Work, on_cpu};
use tce_base::{OrAuto, Streams};
use tce_data::Transitions;
use tce_diffusion::Sampler;

/// A point that moves by its action, and a column that never changes.
fn walk(gain: f32, rows: usize, seed: u64) -> Transitions {
    let mut rng = Streams::new(seed).stream("walk");
    let mut t = Transitions::new(3, 1);
    for i in 0..rows {
        let (x, v, a): (f32, f32, f32) =
            (rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
        t.push(&[x, 0.5, v], &[a], x - v, &[x + gain * a, 0.5, v], false, i % 20 == 19);
    }
    t
}

fn short() -> Settings {
    let mut settings = Settings::recommended();
    settings.generator.state_steps = OrAuto::Given(30);
    settings.generator.transition_steps = OrAuto::Given(30);
    settings.generator.sampler = Sampler::SdeDpmSolver { steps: 4 };
    settings.labels.training.steps = 30;
    settings
}

#[test]
fn two_tables_become_a_third_one() {
    let (source, target, device) = (walk(0.2, 300, 1), walk(0.1, 200, 2), on_cpu());
    let mut settings = short();
    settings.filter = FilterConfig { enabled: true, z_threshold: 2.0, ..FilterConfig::recommended() };
    // Whatever lies far to the right has ended the episode.
    let rule = Arc::new(|state: &[f32]| state[0] > 0.8);
    let augmenter = Augmenter::fit(&source, &target, &settings, Some(rule), &Work::new(&[3, 4], &device)).unwrap();
    let pairs = augmenter.sample(100, 0.5, &[3, 4]).unwrap();
    assert_eq!(pairs.states.len(), 2 * 100 * 2, "two members, two live dimensions");
    let (keep, tables) = (augmenter.filter(&pairs), augmenter.label(&pairs).unwrap());
    for (keep, labelled) in keep.iter().zip(&tables) {
        let t = &labelled.transitions;
        assert_eq!(t.len(), keep.iter().filter(|k| **k).count());
        assert!(t.len() < 100 && !t.is_empty());
        for i in 0..t.len() {
            assert_eq!((t.observation(i)[1], t.next_observation(i)[1]), (0.5, 0.5), "the constant is put back");
            assert!(t.observation(i)[0] <= 0.8, "nothing begins behind the end");
            assert_eq!(t.terminals[i], t.next_observation(i)[0] > 0.8);
        }
    }
    assert_ne!(tables[0].transitions, tables[1].transitions);
    // A member of the population is a fit of its own.
    let alone = Augmenter::fit(&source, &target, &settings, None, &Work::new(&[4], &device)).unwrap();
    let (pairs, own) = (pairs.states[200..].to_vec(), alone.sample(100, 0.5, &[4]).unwrap().states);
    assert!(pairs.iter().zip(&own).all(|(a, b)| (a - b).abs() < 1e-3));
    let message = alone.sample(10, 0.5, &[1, 2]).unwrap_err().to_string();
    assert!(message.contains("found 2, expected 1"), "{message}");
}

/// Terminal rows without s' repeat s there. Models of the dynamics would learn that the robot stands still.
#[test]
fn rows_without_a_successor_are_left_out() {
    let log = |gain: f32, rows: usize, seed: u64| {
        let mut t = walk(gain, rows, seed);
        for i in (9..rows).step_by(10) {
            (t.terminals[i], t.timeouts[i], t.known[i]) = (true, false, false);
            let s = t.observation(i).to_vec();
            t.next_observations[3 * i..3 * i + 3].copy_from_slice(&s);
        }
        t
    };
    let (source, target, device) = (log(0.2, 300, 1), log(0.1, 200, 2), on_cpu());
    let pairs = |source: &Transitions, target: &Transitions| {
        let augmenter = Augmenter::fit(source, target, &short(), None, &Work::new(&[3], &device)).unwrap();
        augmenter.sample(50, 0.5, &[3]).unwrap()
    };
    let known = [&source, &target].map(|t| t.with_successors().into_owned());
    assert_eq!(known.each_ref().map(Transitions::len), [270, 180]);
    assert_eq!(pairs(&source, &target), pairs(&known[0], &known[1]));
}

#[test]
fn one_network_over_whole_transitions() {
    let (target, device) = (walk(0.1, 200, 2), on_cpu());
    let config = SingleStageConfig {
        sampler: Sampler::SdeDpmSolver { steps: 4 },
        width: 32,
        steps: 30,
        rows: 64,
        ..SingleStageConfig::recommended()
    };
    let work = Work::new(&[0], &device);
    let plain = SingleStage::fit(&target, None, &config, &work).unwrap();
    let rows = plain.sample(None, &target, &config, &work).unwrap().remove(0);
    assert!(rows.rows.len() == 64 && rows.scores.is_none());
    let scores: Vec<f32> = (0..target.len()).map(|i| i as f32 / 200.0).collect();
    let guided = SingleStage::fit(&target, Some(&scores), &config, &work).unwrap();
    let rows = guided.sample(Some(&scores), &target, &config, &work).unwrap().remove(0);
    assert!(rows.scores.unwrap().iter().all(|s| *s >= 0.89), "drawn under the best tenth");
}
