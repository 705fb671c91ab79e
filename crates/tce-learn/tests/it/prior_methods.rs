//! Tests of prior methods and the deterministic actor-critics on a corridor.

use std::path::Path;
use std::sync::Arc;

use crate::common::go;
use rand::RngExt;
use tce_base::Streams;
use tce_data::{Standardizer, Transitions};
use tce_learn::cvae::CvaeConfig;
use tce_learn::deterministic::DelayConfig;
use tce_learn::{
    ActorConfig, Bosa, BosaConfig, Buffer, Dara, DaraConfig, Igdf, IgdfConfig, IqlConfig, Member, Mode, Otdf,
    OtdfConfig, Place, Policy, PolicyLearner, Rebrac, RebracConfig, Regulariser, RegulariserConfig, RegulariserKind,
    Srpo, SrpoConfig, Td3Bc, Td3BcConfig,
};
use tce_nn::{NamedParameters, cpu};

/// s = position in [-1, 1], a moves it by a/5 (`against`: by -a/5), the reward is the new position. The behaviour moves
/// left and right at random: the mean action is 0, the best one +1.
fn corridor(seed: u64, episodes: usize, against: f64) -> Transitions {
    let mut rng = Streams::new(seed).stream("corridor");
    let mut t = Transitions::new(1, 1);
    for _ in 0..episodes {
        let direction = if rng.random_bool(against) { -0.2 } else { 0.2 };
        let mut x = rng.random_range(-1.0f32..1.0);
        for k in 0..20 {
            let a = if rng.random::<bool>() { 0.8 } else { -0.8 };
            let next = (x + direction * a).clamp(-1.0, 1.0);
            t.push(&[x], &[a], next, &[next], false, k == 19);
            x = next;
        }
    }
    t
}

/// A fifth of the source moves in the opposite direction.
fn member(seed: u64) -> Member {
    let (target, source) = (corridor(4, 60, 0.0), corridor(5, 300, 0.2));
    let fit = |i: usize| {
        let expected = (source.observation(i)[0] + 0.2 * source.action(i)[0]).clamp(-1.0, 1.0);
        -(source.next_observation(i)[0] - expected).abs()
    };
    Member {
        streams: Streams::new(seed),
        row_scores: Some(Arc::new((0..source.len()).map(fit).collect())),
        standardizer: Standardizer::fit(&target.observations, 1),
        parts: vec![Arc::new(target), Arc::new(source)],
        reward_scale: 1.0,
    }
}

fn small() -> Vec<usize> {
    vec![32, 32]
}

fn actor() -> ActorConfig {
    ActorConfig { hidden: small(), lr: 3e-3, cosine: false, ..ActorConfig::default() }
}

fn iql() -> IqlConfig {
    let (hidden, actor) = (small(), actor());
    IqlConfig { hidden, discount: 0.9, critic_lr: 3e-3, polyak: 0.05, temperature: 10.0, actor, ..IqlConfig::paper() }
}

fn cvae(steps: u64) -> CvaeConfig {
    CvaeConfig { hidden: small(), steps, ..CvaeConfig::paper() }
}

const METHODS: [&str; 7] = ["dara", "srpo", "igdf", "otdf", "bosa", "td3-bc", "rebrac"];

fn method(name: &str, mode: Mode, buffer: &Buffer, steps: u64) -> Box<dyn PolicyLearner> {
    let (d, iql, hidden) = (&cpu(), iql(), small());
    let delay = DelayConfig { polyak: 0.05, ..DelayConfig::default() };
    match name {
        "dara" => {
            let config = DaraConfig { mode, hidden, noise: 0.1, ..DaraConfig::default() };
            Box::new(Dara::new(buffer, &config, &iql, Regulariser::None, steps, d).unwrap())
        }
        "srpo" => {
            let config = SrpoConfig { mode, hidden, ..SrpoConfig::default() };
            Box::new(Srpo::new(buffer, &config, &iql, Regulariser::None, steps, d).unwrap())
        }
        "igdf" => {
            let config = IgdfConfig { mode, hidden, steps: 300, ..IgdfConfig::default() };
            Box::new(Igdf::new(buffer, &config, &iql, Regulariser::None, steps, Place::NONE, d).unwrap().unwrap())
        }
        "otdf" => {
            let config = OtdfConfig { mode, beta_reg: 0.01, ..OtdfConfig::default() };
            let constants = RegulariserConfig { cvae: cvae(300), ..RegulariserConfig::paper() };
            let kind = RegulariserKind::Otdf;
            let regulariser = Regulariser::prepare(kind, buffer, &constants, Place::NONE, d).unwrap().unwrap();
            Box::new(Otdf::new(buffer, &config, &iql, regulariser, steps, d).unwrap())
        }
        "bosa" => {
            let cvae = cvae(300);
            // The data have only two actions, with no gradient between them; with a small weight, the value decides.
            let config = BosaConfig {
                mode,
                cvae,
                delay,
                hidden,
                ensemble: 2,
                support_weight: 0.01,
                value_weight: 0.01,
                discount: 0.9,
                critic_lr: 3e-3,
                actor: actor(),
                ..BosaConfig::default()
            };
            Box::new(Bosa::new(buffer, &config, steps, Place::NONE, d).unwrap().unwrap())
        }
        "td3-bc" => {
            let config =
                Td3BcConfig { delay, hidden, discount: 0.9, critic_lr: 3e-3, actor: actor(), ..Td3BcConfig::default() };
            Box::new(Td3Bc::new(buffer, &config, steps, d).unwrap())
        }
        "rebrac" => {
            let config = RebracConfig {
                delay,
                hidden,
                discount: 0.9,
                critic_lr: 3e-3,
                actor: actor(),
                ..RebracConfig::default()
            };
            Box::new(Rebrac::new(buffer, &config, steps, d).unwrap())
        }
        other => panic!("no method {other}"),
    }
}

/// Mean reward of 20 steps in the target's corridor; 0 for random actions, .6 and more for moving right.
fn walk(policy: &Policy) -> f32 {
    let (mut x, mut sum, mut a) = (-0.5f32, 0.0, [0.0]);
    for _ in 0..20 {
        policy.act(&[x], None, &mut a);
        x = (x + 0.2 * a[0]).clamp(-1.0, 1.0);
        sum += x;
    }
    sum / 20.0
}

#[test]
fn every_method_improves_over_random() {
    let buffer = Buffer::new(vec![member(1)], 64).unwrap();
    for name in METHODS {
        let mut learner = method(name, Mode::Corrected, &buffer, 1500);
        let report = go(learner.as_mut(), &buffer, 0, 1500);
        let score = walk(&learner.policies()[0]);
        assert!(score > 0.3, "{name}: {score}, {:?}", report.metrics);
        assert!(report.diverged().is_empty(), "{name}: {:?}", report.metrics);
        // These methods do not train the policy at every step.
        let delayed = ["bosa", "td3-bc", "rebrac"].contains(&name);
        assert_eq!(report.metrics.contains_key("policy_value"), delayed, "{name}: {:?}", report.metrics);
    }
}

/// Published OTDF clones the mean action. Published BOSA learns from the immediate reward, which is enough here.
#[test]
fn the_published_otdf_does_not_improve() {
    let buffer = Buffer::new(vec![member(1)], 64).unwrap();
    let mut learner = method("otdf", Mode::Published, &buffer, 1500);
    go(learner.as_mut(), &buffer, 0, 1500);
    let score = walk(&learner.policies()[0]);
    assert!(score < 0.2, "{score}");
}

/// Before its first step, IGDF's two modes of ODRL differ only in the encoders.
#[test]
fn the_published_igdf_chooses_by_networks_as_they_were_drawn() {
    let buffer = Buffer::new(vec![member(1)], 64).unwrap();
    let state = |mode| method("igdf", mode, &buffer, 10).state();
    let (published, corrected) = (state(Mode::Published), state(Mode::Corrected));
    assert_eq!(published.metadata["adam.igdf"], "0");
    assert_eq!(corrected.metadata["adam.igdf"], "300");
    let differs = |name: &String| published.tensors[name] != corrected.tensors[name];
    for name in published.tensors.keys() {
        assert_eq!(differs(name), name.starts_with("igdf."), "{name}");
    }
}

#[test]
fn whatever_is_learned_can_be_resumed_on_any_number_of_threads() {
    let buffer = Buffer::new(vec![member(1), member(2)], 32).unwrap();
    for name in METHODS {
        for mode in [Mode::Corrected, Mode::Published] {
            let whole = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| {
                    let mut learner = method(name, mode, &buffer, 12);
                    go(learner.as_mut(), &buffer, 0, 12);
                    learner.state()
                })
            };
            let expected = whole(2);
            assert!(expected == whole(1), "{name}, {mode:?}: another number of threads gave other parameters");
            let mut first = method(name, mode, &buffer, 12);
            go(first.as_mut(), &buffer, 0, 7);
            let state = NamedParameters::from_bytes(&first.state().to_bytes(), Path::new("state")).unwrap();
            let mut second = method(name, mode, &buffer, 12);
            second.restore(&state, Path::new("state")).unwrap();
            go(second.as_mut(), &buffer, 7, 12);
            assert!(expected == second.state(), "{name}, {mode:?}: the resumed training is another");
        }
    }
}

/// A corridor where every fifth row is terminal and without s'; `instead` stands in its place.
fn log(seed: u64, episodes: usize, against: f64, instead: f32) -> Transitions {
    let mut t = corridor(seed, episodes, against);
    for i in (4..t.len()).step_by(5) {
        (t.terminals[i], t.timeouts[i], t.known[i]) = (true, false, false);
        t.next_observations[i] = instead;
    }
    t
}

/// Terminal rows whose s' is unknown are learned from, and what stands in the place of s' has no effect.
#[test]
fn an_unknown_successor_has_no_effect() {
    let learned = |name: &str, mode: Mode, instead: f32| {
        let parts = vec![Arc::new(log(4, 60, 0.0, instead)), Arc::new(log(5, 100, 0.2, instead))];
        let scores = (0..parts[1].with_successors().len()).map(|i| -((i % 9) as f32)).collect();
        let member = Member { parts, row_scores: Some(Arc::new(scores)), ..member(1) };
        let buffer = Buffer::new(vec![member], 32).unwrap();
        let mut learner = method(name, mode, &buffer, 12);
        go(learner.as_mut(), &buffer, 0, 12);
        learner.state()
    };
    for name in ["dara", "srpo", "igdf", "otdf", "bosa"] {
        for mode in [Mode::Corrected, Mode::Published] {
            assert!(learned(name, mode, 0.0) == learned(name, mode, 50.0), "{name}, {mode:?}");
        }
    }
}

#[test]
fn rows_that_a_method_needs_are_asked_for() {
    let alone = Member { parts: member(1).parts[..1].to_vec(), row_scores: None, ..member(1) };
    let without = Member { row_scores: None, ..member(1) };
    let message = |member: Member, name: &str| {
        let buffer = Buffer::new(vec![member], 32).unwrap();
        let (iql, d) = (iql(), &cpu());
        let result = match name {
            "dara" => Dara::new(&buffer, &DaraConfig::default(), &iql, Regulariser::None, 1, d).map(|_| ()),
            _ => Otdf::new(&buffer, &OtdfConfig::default(), &iql, Regulariser::None, 1, d).map(|_| ()),
        };
        result.unwrap_err().to_string()
    };
    assert!(message(alone.clone(), "dara").contains("DARA compares the two"));
    assert!(message(alone, "otdf").contains("OTDF compares the two"));
    assert!(message(without, "otdf").contains("for each of the 6000 source rows"));
}
