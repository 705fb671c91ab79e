//! Tests of soft actor-critic: its densities, its gradients, and its result where the best action is known.

use std::sync::Arc;

use tce_base::{Streams, random::fill_uniform};
use tce_data::{Standardizer, Transitions};
use tce_learn::actor::{Actor, ActorConfig, PolicyForm};
use tce_learn::critic::Twins;
use tce_learn::sac::{Sac, SacConfig};
use tce_learn::{Buffer, Learner, Member, Meter, PolicyLearner};
use tce_nn::{cpu, host, tensor};

/// One-step episodes: reward -(a - .8 s)², s and a uniform in [-1, 1].
fn bandit(rows: usize) -> Transitions {
    let mut rng = Streams::new(9).stream("bandit");
    let mut t = Transitions::new(1, 1);
    let mut draw = [0.0; 2];
    for _ in 0..rows {
        fill_uniform(&mut rng, &mut draw);
        let [s, a] = draw.map(|u: f32| 2.0 * u - 1.0);
        t.push(&[s], &[a], -(a - 0.8 * s).powi(2), &[0.0], true, false);
    }
    t
}

fn buffer(seeds: u64, batch: usize) -> Buffer {
    let rows = Arc::new(bandit(2000));
    let member = |seed| Member {
        streams: Streams::new(seed),
        parts: vec![rows.clone()],
        standardizer: Standardizer::identity(1),
        reward_scale: 1.0,
        row_scores: None,
    };
    Buffer::new((0..seeds).map(member).collect(), batch).unwrap()
}

fn small() -> SacConfig {
    SacConfig { hidden: vec![32, 32], lr: 3e-3, target_entropy: Some(-2.0), ..SacConfig::default() }
}

#[test]
fn the_squashed_density_is_that_of_the_formula() {
    let buffer = buffer(1, 8);
    let config = ActorConfig { form: PolicyForm::TanhGaussian, hidden: vec![16], ..ActorConfig::default() };
    let actor = Actor::new(&buffer, &config, 0, &cpu()).unwrap();
    let s = tensor((0..64).map(|i| i as f32 / 8.0 - 4.0).collect(), [1, 64, 1], &cpu());
    let output = actor.forward(s.clone());
    let (action, log_prob) = output.sample_with_log_prob(&buffer.streams(), "n", 3);
    let (action, log_prob) = (host(action), host(log_prob));
    // μ and σ are read from the policy's file: from three draws of known noise, the network's internals would be
    // needed.
    let policy = actor.policies().remove(0).to_parameters().tensors;
    let w = |k: usize, part: &str| policy[&format!("policy.layers.{k}.{part}")].1.clone();
    let (w0, b0, w1, b1) = (w(0, "weight"), w(0, "bias"), w(1, "weight"), w(1, "bias"));
    for (i, s) in host(s).into_iter().enumerate() {
        let h: Vec<f64> = (0..16).map(|j| (s as f64 * w0[j] as f64 + b0[j] as f64).max(0.0)).collect();
        let z = |k: usize| (0..16).map(|j| h[j] * w1[2 * j + k] as f64).sum::<f64>() + b1[k] as f64;
        let (mean, std) = (z(0), z(1).exp());
        let a = action[i] as f64;
        let u = a.atanh();
        let normal = -0.5 * ((u - mean) / std).powi(2) - std.ln() - 0.5 * (2.0 * std::f64::consts::PI).ln();
        let expected = normal - (1.0 - a * a).ln();
        assert!((log_prob[i] as f64 - expected).abs() < 2e-3 * expected.abs().max(1.0), "{} {expected}", log_prob[i]);
    }
}

#[test]
fn gradients_reach_the_action_through_a_frozen_critic() {
    let twins = Twins::new(1, 1, &[16, 16], &[Streams::new(1)], &cpu().autodiff());
    let sa = [0.3f32, -0.4, 0.9, 0.2];
    let x = tensor(sa.to_vec(), [1, 2, 2], &cpu().autodiff()).require_grad();
    let grads = twins.pair[0].frozen(x.clone()).sum().backward();
    let gradient = host(x.grad(&grads).unwrap());
    for k in 0..4 {
        let at = |shift: f32| {
            let mut moved = sa.to_vec();
            moved[k] += shift;
            host(twins.pair[0].online(tensor(moved, [1, 2, 2], &cpu()))).iter().sum::<f32>()
        };
        let difference = (at(1e-2) - at(-1e-2)) / 2e-2;
        assert!((gradient[k] - difference).abs() < 2e-3, "{} {difference}", gradient[k]);
    }
}

#[test]
fn it_finds_the_best_action_of_a_bandit() {
    let buffer = buffer(2, 64);
    let mut sac = Sac::new(&buffer, &small(), &cpu()).unwrap();
    for step in 0..1500 {
        sac.update(&buffer.sample(step, &cpu()), step, &mut Meter::default());
    }
    for policy in sac.policies() {
        let (s, mut a) = ([-0.9, -0.5, 0.0, 0.5, 0.9], [0.0; 5]);
        policy.act(&s, None, &mut a);
        assert!(s.iter().zip(a).all(|(s, a)| (a - 0.8 * s).abs() < 0.15), "{a:?}");
    }
    // The temperature has decreased far below 1, towards an entropy of -2.
    assert!(sac.alpha().iter().all(|a| *a < 0.3), "{:?}", sac.alpha());
}

#[test]
fn a_restored_learner_goes_on_to_the_same_bits() {
    let buffer = buffer(1, 32);
    let run = |sac: &mut Sac, steps: std::ops::Range<u64>| {
        steps.for_each(|step| sac.update(&buffer.sample(step, &cpu()), step, &mut Meter::default()));
    };
    let fresh = || Sac::new(&buffer, &small(), &cpu()).unwrap();
    let (mut whole, mut first, mut second) = (fresh(), fresh(), fresh());
    run(&mut whole, 0..20);
    run(&mut first, 0..9);
    second.restore(&first.state(), std::path::Path::new("state")).unwrap();
    run(&mut second, 9..20);
    assert_eq!(whole.state(), second.state());
    assert_eq!(whole.act(&[0.5], 4), second.act(&[0.5], 4));
}

#[test]
fn a_replay_buffer_grows() {
    let mut buffer = Buffer::replay(Streams::new(1), (3, 1), vec![1], 4);
    for i in 0..10 {
        let s = [i as f32, 7.0, 0.5];
        buffer.replay_mut().push(&s, &[0.1], 1.0, &s, i == 9, false);
    }
    let batch = buffer.sample(0, &cpu());
    assert_eq!((batch.s.dims(), buffer.inputs()), ([1, 4, 2], &[0, 2][..]));
    assert!(host(batch.s).chunks(2).all(|s| (0.0..10.0).contains(&s[0]) && s[1] == 0.5));
}
