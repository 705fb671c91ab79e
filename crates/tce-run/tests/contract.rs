//! What every learner of the registry keeps to, whatever it is: a further line there is tested here by itself.
//!
//! | promise | test |
//! |---|---|
//! | it learns from target and other rows in memory | all |
//! | a member of a population learns what a training of its own learns | [`members_learn_what_trainings_of_their_own_learn`] |
//! | a training that was stopped ends with the bytes of an undisturbed one | [`resumed_trainings_end_as_undisturbed_ones`] |
//! | the folder of another training is refused | [`another_training_is_refused`] |

use std::fs;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rand::RngExt;
use tce_base::{Streams, set_interrupted};
use tce_data::Transitions;
use tce_run::config::{Algorithm, Config};
use tce_run::inputs::Inputs;
use tce_run::layers::{ConfigArgs, Preset};
use tce_run::own::Own;
use tce_run::training_run::{Comparison, Trained, TrainingRun};
use tce_run::{Error, Result};

/// The wish to stop is one of the whole process: with `cargo test`, which has all tests in one, they take turns.
static TURN: Mutex<()> = Mutex::new(());

fn turn() -> MutexGuard<'static, ()> {
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Episodes of 20 steps of a point that the action pushes by `gain`; some end early, at a terminal.
fn walk(gain: f32, rows: usize, seed: u64) -> Arc<Transitions> {
    let mut rng = Streams::new(seed).stream("walk");
    let mut t = Transitions::new(3, 2);
    let mut s = [0.0f32; 3];
    for i in 0..rows {
        if i % 20 == 0 {
            s = [0; 3].map(|_| rng.random_range(-1.0..1.0));
        }
        let a = [0; 2].map(|_| rng.random_range(-1.0f32..1.0));
        let next = [s[0] + gain * a[0], s[1] + gain * a[1], 0.9 * s[2]];
        let (terminal, last) = (i % 20 == 19 && i % 3 == 0, i % 20 == 19);
        t.push(&s, &a, -next[0].abs(), &next, terminal, last && !terminal);
        s = next;
    }
    Arc::new(t)
}

/// A few steps of everything that is trained.
fn config(algorithm: Algorithm) -> Config {
    let sets = [
        "learner.steps=24",
        "learner.batch=16",
        "learner.bc.ensemble=2",
        "learner.behaviour.cvae.steps=8",
        "learner.bosa.cvae.steps=8",
        "learner.igdf.steps=8",
        "learner.meta_dt.world_model.steps=8",
    ];
    let sets = sets.iter().map(|s| (*s).to_owned()).collect();
    let args = ConfigArgs { preset: Preset::Quick, config: None, sets }.with_own_tables(Some(algorithm), None);
    args.layered(None, None).unwrap().config().unwrap()
}

fn train(algorithm: Algorithm, seeds: &[u64], out: &Path) -> Result<Trained> {
    let extra = Some((walk(0.4, 400, 1), None));
    let own = Own::default();
    let inputs = Inputs::of_rows(None, walk(0.2, 200, 2), extra, &own)?;
    let config = config(algorithm);
    let run = TrainingRun { config: &config, seeds, own: &own, comparison: Comparison::Skip, out };
    run.run(&inputs, &tce_nn::cpu())
}

fn policy(out: &Path, seed: u64) -> Vec<u8> {
    fs::read(out.join(format!("policy-seed{seed}.safetensors"))).unwrap()
}

#[test]
fn members_learn_what_trainings_of_their_own_learn() {
    let _turn = turn();
    for &algorithm in Algorithm::ALL {
        let root = tempfile::tempdir().unwrap();
        let (both, alone) = (root.path().join("both"), root.path().join("alone"));
        let trained = train(algorithm, &[3, 4], &both).unwrap();
        assert_eq!(trained.policies.len(), 2, "{algorithm:?}");
        train(algorithm, &[4], &alone).unwrap();
        assert_eq!(policy(&both, 4), policy(&alone, 4), "{algorithm:?}");
        assert_ne!(policy(&both, 3), policy(&both, 4), "{algorithm:?}: the seed matters");
    }
}

#[test]
fn resumed_trainings_end_as_undisturbed_ones() {
    let _turn = turn();
    for &algorithm in Algorithm::ALL {
        let root = tempfile::tempdir().unwrap();
        let (whole, stopped) = (root.path().join("whole"), root.path().join("stopped"));
        train(algorithm, &[0], &whole).unwrap();
        // Every start does a few steps and stops at the next safe point, until all is done.
        let mut stops = 0;
        loop {
            set_interrupted(stops < 3);
            let outcome = train(algorithm, &[0], &stopped);
            set_interrupted(false);
            match outcome {
                Err(error) if error.exit_code() == 130 => stops += 1,
                outcome => {
                    outcome.unwrap();
                    break;
                }
            }
        }
        assert!(stops > 0, "{algorithm:?} was never stopped");
        assert_eq!(policy(&whole, 0), policy(&stopped, 0), "{algorithm:?}, stopped {stops} times");
    }
}

#[test]
fn another_training_is_refused() {
    let _turn = turn();
    let root = tempfile::tempdir().unwrap();
    train(Algorithm::Bc, &[0], root.path()).unwrap();
    assert_eq!(train(Algorithm::Bc, &[0], root.path()).unwrap().seeds, [0], "taken from the folder");
    let error = train(Algorithm::Iql, &[0], root.path()).unwrap_err();
    assert!(matches!(&error, Error::Usage(text) if text.contains("other settings")), "{error}");
}
