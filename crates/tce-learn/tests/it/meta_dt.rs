//! Tests of Meta-DT on small problems, and of properties that hold whatever it learns.

use std::path::Path;
use std::sync::Arc;

use crate::common::go;
use rand::RngExt;
use tce_base::{Streams, random::fill_normal};
use tce_data::{Standardizer, Transitions};
use tce_learn::world_model::{WorldModelConfig, Worlds};
use tce_learn::{Buffer, Learner, Member, MetaDt, MetaDtConfig, Meter, Place, Policy, PolicyKind, PolicyLearner};
use tce_nn::{NamedParameters, cpu};

/// A corridor: s = position, a moves it by a/5, the reward is the new position. An episode moves all the way left or
/// all the way right, and only its return shows beforehand which.
fn corridor(name: &str, episodes: usize) -> Arc<Transitions> {
    let mut rng = Streams::new(4).stream(name);
    let mut t = Transitions::new(1, 1);
    for _ in 0..episodes {
        let (mut x, side) = (rng.random_range(-0.1f32..0.1), if rng.random::<bool>() { 1.0 } else { -1.0 });
        for k in 0..STEPS {
            let a = side * rng.random_range(0.6f32..1.0);
            let next = (x + 0.2 * a).clamp(-1.0, 1.0);
            t.push(&[x], &[a], next, &[next], false, k + 1 == STEPS);
            x = next;
        }
    }
    Arc::new(t)
}

const STEPS: usize = 15;

fn member(seed: u64, parts: Vec<Arc<Transitions>>) -> Member {
    let standardizer = Standardizer::identity(parts[0].obs_dim);
    Member { streams: Streams::new(seed), parts, standardizer, reward_scale: 1.0, row_scores: None }
}

fn two_parts(seed: u64) -> Member {
    member(seed, vec![corridor("target", 20), corridor("source", 100)])
}

fn small(world_steps: u64) -> MetaDtConfig {
    MetaDtConfig {
        context: 4,
        embed: 32,
        layers: 2,
        heads: 2,
        lr: 2e-3,
        warm_up: 50,
        batch: 32,
        return_scale: 10.0,
        world_model: WorldModelConfig {
            steps: world_steps,
            horizon: 3,
            gru: 16,
            latent: 4,
            hidden: vec![16],
            ..WorldModelConfig::default()
        },
        ..MetaDtConfig::default()
    }
}

/// A learner with a trained world model.
fn prepared(buffer: &Buffer, config: &MetaDtConfig) -> MetaDt {
    MetaDt::new(buffer, config, Place::NONE, &cpu()).unwrap().expect("not interrupted")
}

/// Return of an episode that starts at 0.
fn rollout(policy: &Policy) -> f32 {
    let (mut memory, mut x, mut sum, mut a) = ([policy.start()], 0.0f32, 0.0, [0.0]);
    for _ in 0..STEPS {
        policy.act_with(&[x], &mut memory, None, &mut a);
        x = (x + 0.2 * a[0]).clamp(-1.0, 1.0);
        policy.reward(&mut memory[0], x.into());
        sum += x;
    }
    sum
}

/// Cloning would not move: the mean action of the data is 0 at the start of an episode.
#[test]
fn it_does_what_the_return_it_is_asked_for_says() {
    let buffer = Buffer::new(vec![two_parts(1)], 2).unwrap();
    let config = small(150);
    let mut worlds = Worlds::new(&buffer, &config.world_model, &cpu());
    go(&mut worlds, &buffer, 0, 120);
    let world = go(&mut worlds, &buffer, 120, 150);
    assert!(world.metrics["world_state_loss"][0] < 0.1, "{world:?}");
    let mut learner = prepared(&buffer, &config);
    let (trained, state) = (worlds.state(), learner.state());
    assert!(trained.tensors.iter().all(|(name, t)| state.tensors[name] == *t), "another world model was prepared");
    let report = go(&mut learner, &buffer, 0, 500);
    assert!(report.metrics["policy_loss"][0].is_finite());
    // An action of 1 at every step has return 12.
    let best = rollout(&learner.policies()[0]);
    assert!(best > 9.0, "{best}");
    let worst = MetaDtConfig { return_factor: -1.0, ..config };
    let mut other = prepared(&buffer, &worst);
    other.restore(&learner.state(), Path::new("state")).unwrap();
    let worst = rollout(&other.policies()[0]);
    assert!(worst < -9.0, "{worst}");
}

/// A training run of 7 steps that is stopped and resumed.
fn resumed<L: Learner>(buffer: &Buffer, new: impl Fn() -> L) -> L {
    let mut whole = new();
    go(&mut whole, buffer, 0, 7);
    for stop in [1, 4] {
        let mut first = new();
        go(&mut first, buffer, 0, stop);
        let state = NamedParameters::from_bytes(&first.state().to_bytes(), Path::new("state")).unwrap();
        let mut second = new();
        second.restore(&state, Path::new("state")).unwrap();
        go(&mut second, buffer, stop, 7);
        assert!(whole.state().to_bytes() == second.state().to_bytes(), "stopped at {stop}");
    }
    whole
}

#[test]
fn a_resumed_training_goes_on_as_if_nothing_had_happened() {
    let buffer = Buffer::new(vec![two_parts(1), two_parts(2)], 2).unwrap();
    resumed(&buffer, || Worlds::new(&buffer, &small(5).world_model, &cpu()));
    let new = || prepared(&buffer, &small(5));
    let whole = resumed(&buffer, new);
    let error = new().restore(&whole.policies()[0].to_parameters(), Path::new("other.safetensors")).unwrap_err();
    assert!(error.to_string().contains("other.safetensors"), "{error}");
}

#[test]
fn a_member_equals_a_run_of_its_own() {
    let learn = |members: Vec<Member>| {
        let buffer = Buffer::new(members, 2).unwrap();
        let mut learner = prepared(&buffer, &small(3));
        go(&mut learner, &buffer, 0, 3);
        learner.policies().pop().unwrap().to_parameters()
    };
    assert_eq!(learn(vec![two_parts(1), two_parts(2)]), learn(vec![two_parts(2)]));
}

/// At full size, where burn distributes matrix products over threads.
#[test]
fn the_bytes_do_not_depend_on_the_number_of_threads() {
    let learn = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let buffer = Buffer::new(vec![two_parts(1)], 2).unwrap();
            let mut config = MetaDtConfig::default();
            config.world_model.steps = 2;
            let mut learner = prepared(&buffer, &config);
            go(&mut learner, &buffer, 0, 2);
            let policy = learner.policies().remove(0);
            (learner.state().to_bytes(), policy.to_parameters().to_bytes(), rollout(&policy))
        })
    };
    assert!(learn(1) == learn(3), "another number of threads gave other parameters");
}

/// Every third episode ends at a terminal without s'. The policy learns from these rows, and what stands in the place of s'
/// has no effect.
#[test]
fn an_unknown_successor_has_no_effect() {
    let log = |name: &str, instead: f32| {
        let mut t = Transitions::clone(&corridor(name, 20));
        for i in (STEPS - 1..t.len()).step_by(3 * STEPS) {
            (t.terminals[i], t.timeouts[i], t.known[i]) = (true, false, false);
            t.next_observations[i] = instead;
        }
        Arc::new(t)
    };
    let learned = |instead: f32| {
        let parts = vec![log("target", instead), log("source", instead)];
        let buffer = Buffer::new(vec![member(1, parts)], 2).unwrap();
        let mut learner = prepared(&buffer, &small(20));
        go(&mut learner, &buffer, 0, 10);
        learner.state()
    };
    assert!(learned(0.0) == learned(50.0));
    let mut none = Transitions::clone(&corridor("target", 20));
    none.known.fill(false);
    let buffer = Buffer::new(vec![member(1, vec![Arc::new(none)])], 2).unwrap();
    let error = MetaDt::new(&buffer, &small(1), Place::NONE, &cpu()).err().expect("refused").to_string();
    assert!(error.contains("member 0, part 0: found 300 rows without s'"), "{error}");
}

/// A table without an order of time is a table of one-step episodes.
#[test]
fn generated_rows_are_learned_from_too() {
    let mut t = Transitions::new(1, 1);
    for i in 0..100 {
        let x = i as f32 / 50.0 - 1.0;
        t.push(&[x], &[-0.5 * x], 1.0, &[x], false, true);
    }
    let buffer = Buffer::new(vec![member(3, vec![Arc::new(t)])], 2).unwrap();
    let mut learner = prepared(&buffer, &small(5));
    let report = go(&mut learner, &buffer, 0, 300);
    let mut a = [0.0; 2];
    learner.policies()[0].act(&[0.8, -0.4], None, &mut a);
    assert!((a[0] + 0.4).abs() < 0.15 && (a[1] - 0.2).abs() < 0.15, "{a:?} {report:?}");
}

#[test]
fn files_keep_every_bit_and_other_files_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("policy.safetensors");
    let buffer = Buffer::new(vec![two_parts(1)], 2).unwrap();
    let learner = prepared(&buffer, &small(1));
    let policy = learner.policies().remove(0);
    policy.save(&path).unwrap();
    let loaded = Policy::load(&path).unwrap();
    assert!(
        matches!(loaded.kind(), PolicyKind::Sequence(p) if p.spec().first_return > 11.0),
        "the best return of the target"
    );
    assert_eq!(loaded.to_parameters(), policy.to_parameters());
    assert_eq!(rollout(&loaded), rollout(&policy));

    let refused = |parameters: &NamedParameters| {
        parameters.save(&path).unwrap();
        Policy::load(&path).unwrap_err().to_string()
    };
    let error = refused(&learner.state());
    assert!(error.contains("policy.safetensors") && error.contains("a policy's specification"), "{error}");
    for (from, to, needle) in [
        ("\"inputs\":[0]", "\"inputs\":[1]", "dimensions below 1"),
        ("\"embed\":32", "\"embed\":9000000000", "weights: found"),
        ("\"heads\":2", "\"heads\":3", "a width that the heads share"),
        ("\"context\":4", "\"context\":0", "all above 0"),
        ("\"horizon\"", "\"horizont\"", "horizont"),
    ] {
        let mut parameters = policy.to_parameters();
        let json = parameters.metadata["sequence_policy"].clone();
        assert!(json.contains(from), "{json}");
        parameters.metadata.insert("sequence_policy".into(), json.replace(from, to));
        let error = refused(&parameters);
        assert!(error.contains(needle), "{error}");
    }
    let mut parameters = policy.to_parameters();
    parameters.metadata.remove("sequence_policy");
    assert!(refused(&parameters).contains("a policy's specification"));
}

#[test]
fn bad_configurations_are_refused() {
    let buffer = Buffer::new(vec![two_parts(1)], 2).unwrap();
    let set = |change: fn(&mut MetaDtConfig)| {
        let mut config = small(1);
        change(&mut config);
        MetaDt::new(&buffer, &config, Place::NONE, &cpu()).err().expect("refused").to_string()
    };
    assert!(set(|c| c.heads = 3).contains("heads: found 3, expected a divisor of embed = 32"));
    assert!(set(|c| c.context = 0).contains("context"));
    assert!(set(|c| c.dropout = 1.0).contains("dropout"));
    assert!(set(|c| c.return_scale = f64::NAN).contains("return_scale"));
    assert!(set(|c| c.world_model.horizon = 0).contains("world_model.horizon"));
}

/// CPU time of this thread in nanoseconds: other programs may be using the machine.
fn used() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    text.split(' ').next().and_then(|n| n.parse().ok()).unwrap_or(0.0)
}

/// Updates per second of one core at HalfCheetah's size:
/// `cargo test --release -p tce-learn --test it meta_dt -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement"]
fn speed() {
    let mut t = Transitions::new(17, 6);
    let mut row = vec![0.0; 17 + 6 + 1 + 17];
    for i in 0..2_000 {
        fill_normal(&mut Streams::new(0).indexed("row", i), &mut row);
        t.push(&row[..17], &row[17..23], row[23], &row[24..], false, i % 1000 == 999);
    }
    let t = Arc::new(t);
    let buffer = Buffer::new(vec![member(0, vec![t.clone(), t])], 256).unwrap();
    let mut config = MetaDtConfig::default();
    config.world_model.steps = 0;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    pool.install(|| {
        let batch = buffer.sample(0, &cpu());
        let time = |name: &str, learner: &mut dyn Learner, warm: u64, steps: u64| {
            let mut meter = Meter::always();
            (0..warm).for_each(|step| learner.update(&batch, step, &mut meter));
            let (started, before) = (std::time::Instant::now(), used());
            (warm..warm + steps).for_each(|step| learner.update(&batch, step, &mut meter));
            let (clock, core) = (started.elapsed().as_secs_f64(), (used() - before) * 1e-9);
            let [core, clock] = [core, clock].map(|seconds| steps as f64 / seconds);
            println!("{name}: {core:.1} updates per second of a core, {clock:.1} of the clock");
        };
        time("world model", &mut Worlds::new(&buffer, &config.world_model, &cpu()), 5, 50);
        let mut learner = prepared(&buffer, &config);
        // The first step computes most contexts.
        time("contexts", &mut learner, 0, 1);
        time("transformer", &mut learner, 5, 30);
    });
}
