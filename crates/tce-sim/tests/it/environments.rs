//! Tests of environments against closed forms and their own rules.

use proptest::prelude::*;
use tce_base::Streams;
use tce_data::{Agent, Shift};
use tce_sim::{Env, SimError, simulate, terminal_rule};

fn start(agent: Agent, shift: Shift, seed: u64) -> (Env, Vec<f32>) {
    let mut env = Env::new(agent, shift).unwrap();
    let mut obs = vec![0.0; agent.dims().0];
    env.reset(&mut Streams::new(seed).stream("reset"), &mut obs);
    (env, obs)
}

#[test]
fn a_hopper_in_the_air_falls_freely() {
    // At rest and far above the floor, all parts fall equally: v = -g dt, whatever the joints do.
    for (shift, gravity) in [(Shift::Source, 9.81), (Shift::Gravity, 4.905), (Shift::Gravity5, 49.05)] {
        let mut env = Env::new(Agent::Hopper, shift).unwrap();
        let mut obs = [0.0; 11];
        obs[0] = 5.0;
        env.set_state(&obs);
        let result = env.step(&[0.0; 3], &mut obs);
        assert!((env.dt() - 0.008).abs() < 1e-15);
        assert!((obs[6] as f64 + gravity * 0.008).abs() < 1e-6, "{shift}: vertical velocity {}", obs[6]);
        assert!((result.reward - 1.0).abs() < 1e-12, "standing still earns the alive bonus, not {}", result.reward);
        assert!(!result.terminal && !result.unstable);
    }
}

#[test]
fn actions_cost_as_specified_and_are_clamped() {
    for (agent, cost, alive) in [
        (Agent::HalfCheetah, 0.1, 0.0),
        (Agent::Hopper, 1e-3, 1.0),
        (Agent::Walker2d, 1e-3, 1.0),
        (Agent::Ant, 0.5, 1.0),
    ] {
        let (mut env, obs) = start(agent, Shift::Source, 1);
        let mut outcome = |level: f32| {
            let mut next = vec![0.0; obs.len()];
            env.set_state(&obs);
            let result = env.step(&vec![level; agent.dims().1], &mut next);
            (result.reward, next)
        };
        // Beyond the motors' range only the control cost increases.
        let ((r1, s1), (r2, s2)) = (outcome(1.0), outcome(2.0));
        assert_eq!(s1, s2, "{agent}: actions are clamped");
        assert!((r1 - r2 - 3.0 * cost * agent.dims().1 as f64).abs() < 1e-9, "{agent}: cost of actions");
        let still = outcome(0.0);
        assert!((still.0 - alive).abs() < 2.0, "{agent}: reward {} without an action", still.0);
    }
}

#[test]
fn the_reward_is_the_distance_covered() {
    // Hopper, Walker2d, HalfCheetah: the reward uses the coordinate itself.
    for agent in [Agent::HalfCheetah, Agent::Hopper, Agent::Walker2d] {
        let (mut env, mut obs) = start(agent, Shift::Source, 2);
        for _ in 0..5 {
            let before = env.qpos()[0];
            let result = env.step(&vec![0.0; agent.dims().1], &mut obs);
            let alive = if agent == Agent::HalfCheetah { 0.0 } else { 1.0 };
            let expected = (env.qpos()[0] - before) / env.dt() + alive;
            assert!((result.reward - expected).abs() < 1e-9, "{agent}");
        }
    }
    // Ant: the sum telescopes to the position at the last RK4 stage. This stage evaluates the end of the physics step
    // from an estimate, so the position is close to the coordinate, but not equal to it.
    let (mut env, mut obs) = start(Agent::Ant, Shift::Source, 2);
    let x = env.qpos()[0];
    let (mut sum, mut largest) = (0.0, 0.0_f64);
    for step in 0..40 {
        let action = [if step % 10 < 5 { 1.0 } else { -1.0 }; 8];
        sum += env.step(&action, &mut obs).reward - 1.0 + 0.5 * 8.0;
        largest = largest.max((env.qpos()[0] - x - sum * env.dt()).abs());
    }
    assert!(largest > 1e-6 && largest < 1e-2, "the reward's position differs by {largest} m");
}

#[test]
fn resets_have_the_specified_noise() {
    for (agent, width, deviation) in [
        (Agent::HalfCheetah, 0.1, 0.1),
        (Agent::Hopper, 0.005, 0.005 / 3f64.sqrt()),
        (Agent::Walker2d, 0.005, 0.005 / 3f64.sqrt()),
        (Agent::Ant, 0.1, 0.1),
    ] {
        let mut env = Env::new(agent, Shift::Source).unwrap();
        let rest: Vec<f64> = env.qpos().to_vec();
        let streams = Streams::new(3);
        let mut obs = vec![0.0; agent.dims().0];
        let (mut squares, mut count, mut widest) = (0.0, 0.0, 0.0_f64);
        for episode in 0..400 {
            env.reset(&mut streams.indexed("reset", episode), &mut obs);
            squares += env.qvel().iter().map(|v| v * v).sum::<f64>();
            count += env.qvel().len() as f64;
            for (i, (q, rest)) in env.qpos().iter().zip(&rest).enumerate() {
                let in_quaternion = agent == Agent::Ant && (3..7).contains(&i);
                if !in_quaternion {
                    widest = widest.max((q - rest).abs());
                }
            }
            if agent == Agent::Ant {
                let norm: f64 = env.qpos()[3..7].iter().map(|q| q * q).sum();
                assert!((norm - 1.0).abs() < 1e-12);
                assert!(obs[27..].iter().all(|&x| x == 0.0));
            }
        }
        let found = (squares / count).sqrt();
        assert!(widest <= width && widest > 0.99 * width, "{agent}: positions differ by up to {widest}");
        assert!((found / deviation - 1.0).abs() < 0.06, "{agent}: velocities deviate by {found}, not {deviation}");
    }
}

#[test]
fn a_state_set_from_an_observation_is_observed_as_such() {
    for agent in Agent::ALL {
        let (mut env, obs) = start(agent, Shift::Morph, 4);
        let mut seen = vec![1.0; obs.len()];
        env.set_state(&obs);
        env.observe(&mut seen);
        assert_eq!(obs, seen, "{agent}");
    }
}

#[test]
fn observed_velocities_are_clipped_where_the_robot_says_so() {
    for (agent, velocities, clipped) in
        [(Agent::Hopper, 5, true), (Agent::Walker2d, 8, true), (Agent::HalfCheetah, 8, false), (Agent::Ant, 13, false)]
    {
        let (mut env, mut obs) = start(agent, Shift::Source, 5);
        obs[velocities] = 50.0;
        env.set_state(&obs);
        assert_eq!(env.qvel()[0], 50.0);
        env.observe(&mut obs);
        assert_eq!(obs[velocities], if clipped { 10.0 } else { 50.0 }, "{agent}");
    }
}

#[test]
fn the_terminal_rule_holds_at_its_bounds() {
    let with = |agent: Agent, changes: &[(usize, f32)]| {
        let mut obs = vec![0.0; agent.dims().0];
        changes.iter().for_each(|&(i, x)| obs[i] = x);
        terminal_rule(agent, &obs)
    };
    use Agent::{Ant, HalfCheetah, Hopper, Walker2d};
    assert!(!with(Hopper, &[(0, 0.71)]) && with(Hopper, &[(0, 0.69)]));
    assert!(!with(Hopper, &[(0, 1.2), (1, -0.19)]) && with(Hopper, &[(0, 1.2), (1, -0.21)]));
    assert!(!with(Hopper, &[(0, 1.2), (10, 99.0)]) && with(Hopper, &[(0, 1.2), (10, -101.0)]));
    assert!(with(Hopper, &[(0, f32::NAN)]));
    assert!(!with(Walker2d, &[(0, 0.81)]) && with(Walker2d, &[(0, 0.79)]) && with(Walker2d, &[(0, 2.01)]));
    assert!(with(Walker2d, &[(0, 1.2), (1, 1.01)]) && !with(Walker2d, &[(0, 1.2), (1, -0.99)]));
    assert!(!with(Ant, &[(0, 0.21)]) && with(Ant, &[(0, 0.19)]) && with(Ant, &[(0, 1.01)]));
    assert!(with(Ant, &[(0, 0.5), (20, f32::INFINITY)]));
    assert!(!with(HalfCheetah, &[(0, f32::NAN)]));
}

#[test]
fn simulating_a_batch_is_stepping_row_by_row() {
    for agent in Agent::ALL {
        let (obs_dim, act_dim) = agent.dims();
        let rows = 150;
        let (mut states, mut actions) = (Vec::new(), Vec::new());
        for row in 0..rows {
            states.extend(start(agent, Shift::Gravity, row).1);
            actions.extend((0..act_dim).map(|i| ((row as f32) * 0.7 + i as f32).sin()));
        }
        let batch = simulate(agent, Shift::Gravity, &states, &actions).unwrap();
        let mut env = Env::new(agent, Shift::Gravity).unwrap();
        let mut next = vec![0.0; obs_dim];
        for row in 0..rows as usize {
            env.set_state(&states[row * obs_dim..][..obs_dim]);
            let result = env.step(&actions[row * act_dim..][..act_dim], &mut next);
            assert_eq!(batch.next_observations[row * obs_dim..][..obs_dim], next, "{agent}, row {row}");
            assert_eq!(batch.rewards[row], result.reward as f32);
            assert_eq!(batch.terminals[row], result.terminal);
        }
    }
}

#[test]
fn simulate_refuses_what_it_cannot_simulate() {
    let sizes = simulate(Agent::Hopper, Shift::Source, &[0.0; 12], &[0.0; 3]);
    assert!(matches!(sizes, Err(SimError::Dimension { found: 12, expected: 11, .. })), "{sizes:?}");
    let mut states = [0.0; 22];
    states[13] = f32::NAN;
    let nan = simulate(Agent::Hopper, Shift::Source, &states, &[0.0; 6]);
    assert!(matches!(nan, Err(SimError::NotFinite { row: 1, .. })), "{nan:?}");
}

#[test]
fn a_step_that_blows_up_is_reported() {
    // No robot moves at 1e11 m/s: MuJoCo resets itself above 1e10.
    let mut states = vec![0.0; 17];
    states[8] = 1e11;
    let out = simulate(Agent::HalfCheetah, Shift::Source, &states, &[0.0; 6]).unwrap();
    assert!(out.rewards[0].is_nan() && out.terminals[0] && out.next_observations.iter().all(|x| x.is_nan()));
    // A healthy row after it is not affected.
    let (_, healthy) = start(Agent::HalfCheetah, Shift::Source, 0);
    let alone = simulate(Agent::HalfCheetah, Shift::Source, &healthy, &[0.0; 6]).unwrap();
    states.extend(&healthy);
    let both = simulate(Agent::HalfCheetah, Shift::Source, &states, &[0.0; 12]).unwrap();
    assert_eq!(both.next_observations[17..], alone.next_observations);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// The rule on observations equals the environment's rule, wherever velocities are not clipped.
    #[test]
    fn the_rule_on_observations_is_the_environments(seed in 0u64..1000, height in 0.1f32..2.5, angle in -1.5f32..1.5) {
        for agent in Agent::ALL {
            let (mut env, mut obs) = start(agent, Shift::Source, seed);
            obs[0] = height;
            if agent != Agent::Ant {
                obs[1] = angle;
            }
            env.set_state(&obs);
            let result = env.step(&vec![0.3; agent.dims().1], &mut obs);
            let clipped = agent != Agent::Ant && obs.iter().any(|x| x.abs() >= 10.0);
            if !clipped && !result.unstable {
                prop_assert_eq!(terminal_rule(agent, &obs), result.terminal);
            }
        }
    }
}
