//! Tests of rollouts: complete, in order, and the same at any number of threads.

use std::sync::Mutex;

use tce_base::{Rng, Streams};
use tce_data::{Agent, Shift, Transitions};
use tce_sim::{Actor, CollectOptions, EPISODE_LIMIT, Env, SimError, UniformActor, collect, evaluate, replay};

fn with_threads<R: Send>(threads: usize, work: impl FnOnce() -> R + Send) -> R {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

fn random(agent: Agent, rows: usize, lanes: usize, seed: u64) -> Transitions {
    let options = CollectOptions { lanes, ..CollectOptions::new(rows, Streams::new(seed)) };
    collect(agent, Shift::Morph, &UniformActor, &options).unwrap()
}

#[test]
fn the_same_bytes_at_any_number_of_threads() {
    for agent in Agent::ALL {
        let one = with_threads(1, || random(agent, 1003, 8, 7));
        let three = with_threads(3, || random(agent, 1003, 8, 7));
        assert!(one == three, "{agent}");
        assert_eq!(one.len(), 1003);
        assert!(one != random(agent, 1003, 8, 8), "{agent}: another seed, other rows");
        let scores = |threads| {
            with_threads(threads, || {
                evaluate(agent, Shift::Morph, &UniformActor, 3, Streams::new(1), || false).unwrap()
            })
        };
        assert_eq!(scores(1), scores(3));
    }
}

#[test]
fn lanes_are_filled_in_order_and_cut_with_a_time_out() {
    let data = random(Agent::HalfCheetah, 4003, 3, 1);
    // HalfCheetah never falls: 1335 + 1334 + 1334 rows, each one whole episode and one cut episode.
    let ends: Vec<usize> = data.episodes().iter().map(|e| e.end).collect();
    assert_eq!(ends, [1000, 1335, 2335, 2669, 3669, 4003]);
    assert!(data.terminals.iter().all(|&t| !t));
    assert!(ends.iter().all(|&end| data.timeouts[end - 1]));
    assert_eq!(data.timeouts.iter().filter(|&&t| t).count(), ends.len());
}

#[test]
fn rows_of_an_episode_follow_each_other() {
    let data = random(Agent::Hopper, 500, 4, 2);
    let episodes = data.episodes();
    assert!(episodes.len() > 8, "random hopping ends soon");
    for episode in episodes {
        for row in episode.start + 1..episode.end {
            assert_eq!(data.next_observation(row - 1), data.observation(row));
        }
        assert!(data.observation(episode.start)[5..].iter().all(|v| v.abs() <= 0.005), "an episode starts at rest");
        let last = episode.end - 1;
        assert!(data.terminals[last] ^ data.timeouts[last]);
    }
}

#[test]
fn a_lane_does_not_depend_on_the_others() {
    // The rows of a lane equal those of a single environment with the streams of this lane.
    let data = random(Agent::Walker2d, 90, 3, 5);
    let streams = Streams::new(5);
    let mut env = Env::new(Agent::Walker2d, Shift::Morph).unwrap();
    for lane in 0..3_u64 {
        let mut obs = vec![0.0; 17];
        env.reset(&mut streams.indexed("collect/reset", lane << 32), &mut obs);
        let mut rng = streams.indexed("collect/action", lane << 32);
        for row in 30 * lane as usize..30 * (lane as usize + 1) {
            assert_eq!(data.observation(row), obs);
            let mut action = [0.0; 6];
            tce_base::random::fill_uniform(&mut rng, &mut action);
            let action = action.map(|a| 2.0 * a - 1.0);
            assert_eq!(data.action(row), action);
            let result = env.step(&action, &mut obs);
            assert_eq!((data.rewards[row], data.next_observation(row)), (result.reward as f32, &obs[..]));
            if result.terminal {
                break;
            }
        }
    }
}

#[test]
fn evaluation_steps_only_what_still_runs() {
    let sizes = Mutex::new(Vec::new());
    let actor = |observations: &[f32], rngs: &mut [Rng], actions: &mut [f32]| {
        assert_eq!((observations.len(), actions.len()), (11 * rngs.len(), 3 * rngs.len()));
        sizes.lock().unwrap().push(rngs.len());
        actions.fill(0.4);
    };
    let results = evaluate(Agent::Hopper, Shift::Source, &actor, 6, Streams::new(0), || false).unwrap();
    let sizes = sizes.into_inner().unwrap();
    assert_eq!(results.len(), 6);
    assert_eq!(sizes.iter().sum::<usize>(), results.iter().map(|r| r.length).sum::<usize>());
    assert!(sizes.is_sorted_by(|a, b| a >= b) && sizes[0] == 6);

    // Episode 2 alone.
    let mut env = Env::new(Agent::Hopper, Shift::Source).unwrap();
    let mut obs = vec![0.0; 11];
    env.reset(&mut Streams::new(0).indexed("evaluate/reset", 2), &mut obs);
    let (mut sum, mut length) = (0.0, 0);
    loop {
        let result = env.step(&[0.4; 3], &mut obs);
        (sum, length) = (sum + result.reward, length + 1);
        if result.terminal || length == EPISODE_LIMIT {
            break;
        }
    }
    assert_eq!((results[2].episode_return, results[2].length), (sum, length));
}

#[test]
fn an_episode_ends_after_a_thousand_steps() {
    let still = |_: &[f32], _: &mut [Rng], actions: &mut [f32]| actions.fill(0.0);
    let results = evaluate(Agent::HalfCheetah, Shift::Source, &still, 2, Streams::new(0), || false).unwrap();
    assert!(results.iter().all(|r| r.length == EPISODE_LIMIT && r.episode_return.abs() < 100.0), "{results:?}");
}

#[test]
fn an_actor_that_returns_nan_is_refused() {
    let broken = |_: &[f32], _: &mut [Rng], actions: &mut [f32]| actions.fill(f32::NAN);
    let error = evaluate(Agent::Ant, Shift::Source, &broken, 2, Streams::new(0), || false).unwrap_err();
    assert!(matches!(error, SimError::NotFinite { row: 0, .. }), "{error}");
    let options = CollectOptions { lanes: 0, ..CollectOptions::new(10, Streams::new(0)) };
    assert!(matches!(collect(Agent::Ant, Shift::Source, &UniformActor, &options), Err(SimError::Option { .. })));
}

#[test]
fn collected_rows_replay_and_changed_ones_do_not() {
    for agent in Agent::ALL {
        let mut data = random(agent, 1200, 4, 3);
        let report = replay(agent, Shift::Morph, &data, None).unwrap();
        assert!(report.passes(), "{report:?}");
        assert_eq!(report.compared + report.skipped_clipped, 1200);
        let wrong_domain = replay(agent, Shift::Source, &data, None).unwrap();
        assert!(!wrong_domain.passes(), "{agent}: the source robot moves otherwise");

        let json = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<tce_sim::ReplayReport>(&json).unwrap(), report);

        data.terminals[5] = !data.terminals[5];
        let report = replay(agent, Shift::Morph, &data, None).unwrap();
        assert!(report.terminal_mismatches.contains(&5) && !report.passes(), "{agent}");
    }
}

#[test]
fn replay_refuses_another_robots_rows() {
    let data = random(Agent::Hopper, 10, 1, 0);
    let error = replay(Agent::Ant, Shift::Source, &data, None).unwrap_err();
    assert!(matches!(error, SimError::Dimension { found: 11, expected: 111, .. }), "{error}");
}

/// Chooses actions by the number of steps in the episode, and records the rewards passed to it.
struct Counting {
    /// For every evaluated episode: its number of steps, and the sum of its rewards before the last step.
    told: Mutex<Vec<(usize, f64)>>,
}

impl Actor for Counting {
    /// The index of the lane's episode in `told`, once it has acted.
    type Memory = Option<usize>;

    fn start(&self) -> Option<usize> {
        None
    }

    fn act(&self, _: &[f32], memories: &mut [Option<usize>], rngs: &mut [Rng], actions: &mut [f32]) {
        assert_eq!(memories.len(), rngs.len());
        let mut told = self.told.lock().unwrap();
        for (memory, action) in memories.iter_mut().zip(actions.chunks_exact_mut(3)) {
            let at = *memory.get_or_insert_with(|| {
                told.push((0, 0.0));
                told.len() - 1
            });
            action.fill(by_steps(told[at].0));
            told[at].0 += 1;
        }
    }

    fn reward(&self, memory: &mut Option<usize>, reward: f64) {
        self.told.lock().unwrap()[memory.unwrap()].1 += reward;
    }
}

fn by_steps(steps: usize) -> f32 {
    (steps as f32).sin() * 0.5
}

#[test]
fn a_memory_lives_as_long_as_its_episode() {
    let actor = Counting { told: Mutex::default() };
    let options = CollectOptions { lanes: 4, ..CollectOptions::new(400, Streams::new(3)) };
    let data = collect(Agent::Hopper, Shift::Source, &actor, &options).unwrap();
    let episodes = data.episodes();
    assert!(episodes.len() > 6, "several episodes a lane");
    for episode in &episodes {
        for row in episode.start..episode.end {
            assert_eq!(data.action(row), [by_steps(row - episode.start); 3]);
        }
    }
    assert_eq!(actor.told.lock().unwrap().len(), episodes.len());

    let actor = Counting { told: Mutex::default() };
    let results = evaluate(Agent::Hopper, Shift::Source, &actor, 5, Streams::new(0), || false).unwrap();
    // Episodes begin in order; when a lane stops, its memory is removed with it.
    for (result, (steps, told)) in results.iter().zip(actor.told.lock().unwrap().iter()) {
        assert_eq!(result.length, *steps);
        assert!(*told != 0.0 && (result.episode_return - told).abs() < 20.0, "all rewards but the last");
    }
}
