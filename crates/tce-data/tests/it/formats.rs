//! Tests of Minari's and robomimic's layouts: files that `minari` writes, files that it reads, a named error for every
//! fault.

use std::path::Path;
use std::process::Command;

use crate::common::{enum_flags, environment, synthetic, write};
use hdf5_pure::FileBuilder;
use tce_data::{ActionRange, EpisodeEnds, Layout, LoadOptions, Problem, Transitions, load, save_minari};

/// Pinned versions of Minari and gymnasium, in an environment of their own.
const MINARI: [&str; 5] = ["minari[hdf5]==0.5.4", "gymnasium==1.2.2", "h5py==3.16.0", "numpy==2.2.6", "pillow==11.3.0"];

/// The output of `script` in Python with Minari; `None`, with a printed note, if there is no such Python.
fn minari(script: &str, argument: &Path) -> Option<String> {
    let python = match environment("minari-0.5.4", &MINARI, "minari, gymnasium, h5py, PIL") {
        Ok(python) => python,
        Err(why) => {
            eprintln!("SKIPPED: no Minari: {why}");
            return None;
        }
    };
    let output = Command::new(&python).args(["-c", script]).arg(argument).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).unwrap())
}

fn state(t: &Transitions, i: usize) -> &[f32] {
    t.observation(i)
}

#[test]
fn what_minari_collects_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let script = r#"
import os, sys, warnings; warnings.filterwarnings("ignore")
os.environ["MINARI_DATASETS_PATH"] = sys.argv[1]
import gymnasium as gym, minari, numpy as np
from minari.data_collector import EpisodeBuffer
box = lambda n, high=9: gym.spaces.Box(-high, high, (n,))
arm = gym.spaces.Dict(q=box(2), goal=box(1), tool=gym.spaces.Dict(b=box(1), a=box(1)))
f = lambda *columns: np.stack(columns, 1).astype(np.float32)
def episode(k, n, terminal):
    t = np.arange(n + 1.)
    seen = dict(q=f(t * 0 + k, t), goal=f(100 + t), tool=dict(b=f(t * 0 + 8), a=f(t * 0 + 7)))
    end = np.arange(n) == n - 1
    return EpisodeBuffer(id=k, observations=seen, actions=np.full((n, 2), 20., np.float32), rewards=np.ones(n), terminations=end & terminal, truncations=end & (not terminal))
minari.create_dataset_from_buffers("test/arm-v0", buffer=[episode(0, 7, False), episode(1, 5, True), episode(2, 7, False)],
    observation_space=arm, action_space=box(2, 20), algorithm_name="a", author="a", author_email="a@b.c", code_permalink="c")
env, episodes = gym.make("CartPole-v1"), []
for k in range(3):
    seen, acts, rewards, ends, cuts = [env.reset(seed=k)[0]], [], [], [], []
    while not (ends and (ends[-1] or cuts[-1])):
        acts.append(k % 2 if len(acts) % 3 else 1 - k % 2)
        o, r, end, cut, _ = env.step(acts[-1])
        seen.append(o); rewards.append(r); ends.append(end); cuts.append(cut)
    episodes.append(EpisodeBuffer(id=k, observations=np.array(seen), actions=np.array(acts), rewards=np.array(rewards), terminations=np.array(ends), truncations=np.array(cuts)))
minari.create_dataset_from_buffers("test/cartpole-v0", buffer=episodes, env=env, algorithm_name="a", author="a", author_email="a@b.c", code_permalink="c")
s = minari.load_dataset("test/cartpole-v0")
print(sum(len(e.rewards) for e in s.iterate_episodes()), repr(float(sum(e.observations[-1].sum() for e in s.iterate_episodes()))))
"#;
    let Some(text) = minari(script, dir.path()) else { return };
    let got = load(&dir.path().join("test/arm-v0"), &LoadOptions::default()).unwrap();
    let t = &got.transitions;
    assert_eq!(
        (got.report.layout, got.report.episodes, t.obs_dim, t.act_dim),
        (Layout::Minari, EpisodeEnds::Marks, 5, 2)
    );
    let spans: Vec<_> = t.episodes().iter().map(|e| (e.start, e.end)).collect();
    assert_eq!(spans, [(0, 7), (7, 12), (12, 19)]);
    // goal, q, tool/a, tool/b: in the order of their names.
    assert_eq!(
        (state(t, 8), t.next_observation(8)),
        (&[101.0, 1.0, 1.0, 7.0, 8.0][..], &[102.0, 1.0, 2.0, 7.0, 8.0][..])
    );
    assert!(t.terminals[11] && !t.timeouts[11] && t.timeouts[6] && t.timeouts[18] && !t.terminals[18]);
    assert_eq!(t.next_observation(11)[2], 5.0, "the last observation of an episode is the last successor");
    let words = got.report.to_string();
    assert!(words.contains("goal [0], q [1..3], tool/a [3], tool/b [4]"), "{words}");
    // Discrete actions become a column of numbers; the file itself may be passed, too.
    let got = load(&dir.path().join("test/cartpole-v0/data/main_data.hdf5"), &LoadOptions::default()).unwrap();
    let t = &got.transitions;
    assert_eq!((t.obs_dim, t.act_dim), (4, 1));
    assert!(t.actions.iter().all(|&a| a == 0.0 || a == 1.0));
    let (rows, last) = text.trim().split_once(' ').unwrap();
    assert_eq!(t.len(), rows.parse::<usize>().unwrap());
    let sum: f64 = t.episodes().iter().flat_map(|e| t.next_observation(e.end - 1)).map(|&x| f64::from(x)).sum();
    assert!((sum - last.parse::<f64>().unwrap()).abs() < 1e-5);
}

#[test]
fn minari_reads_what_we_write() {
    let dir = tempfile::tempdir().unwrap();
    let mut t = synthetic(300, 4, 2, 50);
    // Within an episode, s' is the next row's state.
    for i in 0..299 {
        if !t.terminals[i] && !t.timeouts[i] {
            let next = t.observation(i + 1).to_vec();
            t.next_observations[4 * i..4 * i + 4].copy_from_slice(&next);
        }
    }
    let range = ActionRange { low: vec![-20.0, -1.0], high: vec![20.0, 1.5] };
    save_minari(&dir.path().join("tce/set-v0"), "tce/set-v0", &t, Some(&range)).unwrap();
    let error = save_minari(&dir.path().join("tce/set-v0"), "tce/set-v0", &t, None).unwrap_err().to_string();
    assert!(error.contains("something is there already"), "{error}");
    let back = load(&dir.path().join("tce/set-v0"), &LoadOptions::default()).unwrap();
    assert_eq!(back.transitions, t);
    let script = r#"
import os, sys
os.environ["MINARI_DATASETS_PATH"] = sys.argv[1]
import minari, numpy as np
s = minari.load_dataset("tce/set-v0")
e = list(s.iterate_episodes())
print(s.total_episodes, s.total_steps, s.action_space.low.tolist(), s.action_space.high.tolist(), s.observation_space.shape)
print(sum(int(x.terminations.sum()) for x in e), sum(int(x.truncations.sum()) for x in e), e[0].terminations.dtype)
print(repr(float(sum(np.float64(x.observations).sum() for x in e))), repr(float(sum(np.float64(x.actions).sum() for x in e))))
assert all(len(x.observations) == len(x.actions) + 1 for x in e) and all(s.observation_space.contains(x.observations[0]) for x in e)
"#;
    let Some(text) = minari(script, dir.path()) else { return };
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines[0], "6 300 [-20.0, -1.0] [20.0, 1.5] (4,)");
    assert_eq!(lines[1], "2 4 bool");
    let sums: Vec<f64> = lines[2].split(' ').map(|x| x.parse().unwrap()).collect();
    let sum = |v: &[f32]| v.iter().map(|&x| f64::from(x)).sum::<f64>();
    let ends: f64 = t.episodes().iter().map(|e| sum(t.next_observation(e.end - 1))).sum();
    assert!((sums[0] - sum(&t.observations) - ends).abs() < 1e-4 && (sums[1] - sum(&t.actions)).abs() < 1e-4);
}

/// Minari has one state between two rows: an episode is cut where that would replace a successor.
#[test]
fn successors_that_are_not_the_next_row_survive_in_minaris_layout() {
    let dir = tempfile::tempdir().unwrap();
    let written = |name: &str, t: &Transitions| {
        save_minari(&dir.path().join(name), "tce/set-v0", t, None).unwrap();
        load(&dir.path().join(name), &LoadOptions::default()).unwrap().transitions
    };
    // Successors that have nothing to do with the next row.
    let mut t = synthetic(300, 4, 2, 50);
    let back = written("apart", &t);
    assert_eq!(
        (&back.next_observations, &back.rewards, &back.terminals),
        (&t.next_observations, &t.rewards, &t.terminals)
    );
    assert_eq!(back.episodes().len(), 300);
    // One such row in an episode, and a terminal row whose successor is not known.
    for i in (0..299).filter(|i| i % 50 != 49) {
        let next = t.observation(i + 1).to_vec();
        t.next_observations[4 * i..4 * i + 4].copy_from_slice(&next);
    }
    t.next_observations[4 * 20..4 * 21].fill(9.0);
    let own = t.observation(149).to_vec();
    t.next_observations[4 * 149..4 * 150].copy_from_slice(&own);
    t.known[149] = false;
    let back = written("one", &t);
    let spans: Vec<_> = back.episodes().iter().map(|e| (e.start, e.end)).collect();
    assert_eq!(spans, [(0, 21), (21, 50), (50, 100), (100, 150), (150, 200), (200, 250), (250, 300)]);
    assert_eq!(back.next_observations, t.next_observations);
    assert!(back.timeouts[20] && !back.terminals[20] && back.terminals[149] && back.known[149]);
}

/// A file in robomimic's layout, as in its documentation: `demos` demonstrations of 4 steps.
fn robomimic(demos: usize, with_next: bool, dones: bool) -> FileBuilder {
    let mut b = FileBuilder::new();
    let mut data = b.create_group("data");
    for k in 0..demos {
        let mut demo = data.create_group(&format!("demo_{k}"));
        let states = |shift: f32| (0..4).map(|i| (10 * k) as f32 + i as f32 + shift).collect::<Vec<_>>();
        let mut obs = demo.create_group("obs");
        obs.create_dataset("eef").with_f32_data(&states(0.0)).with_shape(&[4, 1]);
        obs.create_dataset("joint").with_f32_data(&[k as f32; 8]).with_shape(&[4, 2]);
        obs.create_dataset("agentview_image").with_u8_data(&[0; 4 * 2 * 2 * 3]).with_shape(&[4, 2, 2, 3]);
        demo.add_group(obs.finish());
        if with_next {
            let mut next = demo.create_group("next_obs");
            next.create_dataset("eef").with_f32_data(&states(1.0)).with_shape(&[4, 1]);
            next.create_dataset("joint").with_f32_data(&[k as f32; 8]).with_shape(&[4, 2]);
            demo.add_group(next.finish());
        }
        demo.create_dataset("actions").with_f64_data(&[0.5; 4]).with_shape(&[4, 1]);
        demo.create_dataset("rewards").with_f64_data(&[0.0, 0.0, 0.0, 1.0]);
        let done = u8::from(dones);
        demo.create_dataset("dones").with_u8_data(&[0, 0, 0, done]);
        data.add_group(demo.finish());
    }
    b.add_group(data.finish());
    b
}

#[test]
fn robomimics_demonstrations_are_read_in_the_order_of_their_numbers() {
    let dir = tempfile::tempdir().unwrap();
    let got = load(&write(&dir, "demos.hdf5", robomimic(12, true, true)), &LoadOptions::default()).unwrap();
    let t = &got.transitions;
    assert_eq!((got.report.layout, t.len(), t.obs_dim, t.act_dim), (Layout::Robomimic, 48, 3, 1));
    // demo_2 comes before demo_10.
    assert_eq!(
        (0..12).map(|k| state(t, 4 * k)[0]).collect::<Vec<_>>(),
        (0..12).map(|k| 10.0 * k as f32).collect::<Vec<_>>()
    );
    assert_eq!(t.next_observation(3), [4.0, 0.0, 0.0]);
    assert!(t.terminals[3] && t.known[3] && t.timeouts.iter().all(|t| !t));
    let words = got.report.to_string();
    assert!(words.contains("eef [0], joint [1..3]") && words.contains("left out: agentview_image"), "{words}");

    // Without next_obs the last row of a demonstration has no successor: it is kept only if it is terminal.
    let got = load(&write(&dir, "short.hdf5", robomimic(3, false, true)), &LoadOptions::default()).unwrap();
    assert_eq!((got.report.rows_kept, got.report.unknown_successors), (12, 3));
    assert_eq!(got.transitions.next_observation(1)[0], 2.0);
    let got = load(&write(&dir, "cut.hdf5", robomimic(3, false, false)), &LoadOptions::default()).unwrap();
    assert_eq!((got.report.rows_kept, got.report.dropped.last_row, got.report.unknown_successors), (9, 3, 0));
    assert_eq!(got.transitions.episodes().len(), 3);
}

#[test]
fn faults_of_episodes_are_told_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let faulty = |observations: usize, name: &str| {
        let mut b = FileBuilder::new();
        let mut e = b.create_group("episode_0");
        e.create_dataset("observations")
            .with_f32_data(&vec![0.5; observations * 2])
            .with_shape(&[observations as u64, 2]);
        e.create_dataset("actions").with_f32_data(&[0.5; 3]).with_shape(&[3, 1]);
        e.create_dataset("rewards").with_f32_data(&[0.5; 3]);
        for flags in ["terminations", name] {
            e.create_dataset(flags).with_u8_data(&[0; 3]);
        }
        b.add_group(e.finish());
        load(&write(&dir, "faulty.hdf5", b), &LoadOptions::default())
    };
    assert_eq!(faulty(4, "truncations").unwrap().transitions.len(), 3);
    let error = faulty(3, "truncations").unwrap_err();
    assert_eq!(error.problem(), Some(Problem::RowCount));
    assert!(
        error.to_string().contains("episode_0/observations") && error.to_string().contains("4, for 3 actions"),
        "{error}"
    );
    let error = faulty(4, "cuts").unwrap_err();
    assert!(error.to_string().contains("episode_0/truncations"), "{error}");
}

#[test]
fn episodes_without_a_step_are_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let mut b = FileBuilder::new();
    for (name, n) in [("episode_0", 4u64), ("episode_1", 0), ("episode_2", 2)] {
        let mut e = b.create_group(name);
        let values = |n: u64| vec![0.5f32; n as usize];
        e.create_dataset("observations").with_f32_data(&values(2 * n + 2)).with_shape(&[n + 1, 2]);
        e.create_dataset("actions").with_f32_data(&values(n)).with_shape(&[n, 1]);
        e.create_dataset("rewards").with_f32_data(&values(n)).with_shape(&[n]);
        for flags in ["terminations", "truncations"] {
            e.create_dataset(flags).with_u8_data(&vec![0; n as usize]).with_shape(&[n]);
        }
        b.add_group(e.finish());
    }
    let got = load(&write(&dir, "empty.hdf5", b), &LoadOptions::default()).unwrap();
    assert_eq!((got.report.rows_kept, got.transitions.episodes().len()), (6, 2));
    assert!(got.report.to_string().contains("1 episode without a step was left out"), "{}", got.report);
}

/// Groups in groups, in many episodes: every number comes from its own one. A clock far from zero is told once.
#[test]
fn columns_in_groups_of_groups_are_those_of_their_episode() {
    let dir = tempfile::tempdir().unwrap();
    let mut b = FileBuilder::new();
    for k in 0..30 {
        let mut e = b.create_group(&format!("episode_{k}"));
        let mut seen = e.create_group("observations");
        let clock: Vec<f64> = (0..21).map(|i| 1.7e9 + 0.001 * f64::from(20 * k + i)).collect();
        seen.create_dataset("clock").with_f64_data(&clock);
        let mut tool = seen.create_group("tool");
        let angle: Vec<f32> = (0..21).map(|i| (100 * k + i) as f32).collect();
        tool.create_dataset("angle").with_f32_data(&angle);
        seen.add_group(tool.finish());
        e.add_group(seen.finish());
        e.create_dataset("actions").with_f32_data(&[k as f32; 20]).with_shape(&[20, 1]);
        e.create_dataset("rewards").with_f32_data(&[-k as f32; 20]);
        for flags in ["terminations", "truncations"] {
            e.create_dataset(flags).with_u8_data(&[0; 20]);
        }
        b.add_group(e.finish());
    }
    let got = load(&write(&dir, "nested.hdf5", b), &LoadOptions::default()).unwrap();
    let t = &got.transitions;
    assert_eq!((t.len(), t.obs_dim, t.episodes().len()), (600, 2, 30));
    for i in 0..600 {
        let (k, step) = ((i / 20) as f32, (i % 20) as f32);
        assert_eq!((t.observation(i)[1], t.next_observation(i)[1]), (100.0 * k + step, 100.0 * k + step + 1.0));
        assert_eq!((t.action(i), t.rewards[i]), (&[k][..], -k));
    }
    let told = got.report.to_string();
    assert_eq!(told.matches("`observations`: float32 rounds column 0 by more than 1 %").count(), 1, "{told}");
}

/// A column that holds an infinity has the right shape: the reason is told as it is.
#[test]
fn a_column_that_is_not_finite_is_named_with_its_reason() {
    let dir = tempfile::tempdir().unwrap();
    let mut b = crate::common::rows(40).d4rl();
    let mut logp = [0.0; 40];
    logp[3] = f32::NEG_INFINITY;
    b.create_dataset("logp").with_f32_data(&logp);
    b.create_dataset("short").with_f32_data(&[0.0; 39]);
    let options = LoadOptions { all_columns: true, ..LoadOptions::default() };
    let got = load(&write(&dir, "infinite.hdf5", b), &options).unwrap();
    let told = got.report.to_string();
    assert!(told.contains("`logp` was not read: found -inf in row 3, column 0 (1 such values)"), "{told}");
    assert!(told.contains("no columns of 40 numbers: short"), "{told}");
    assert!(got.columns.is_empty());
}

/// Fields under other names, and flags that do not say enough.
#[test]
fn likely_fields_are_read_and_doubtful_ones_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let file = |fields: &[(&str, usize)], flags: &[&str]| {
        let mut b = FileBuilder::new();
        for (name, width) in fields {
            let data: Vec<f32> = (0..40 * width.max(&1)).map(|i| i as f32 / 100.0).collect();
            let set = b.create_dataset(name).with_f32_data(&data);
            if *width > 0 {
                set.with_shape(&[40, *width as u64]);
            }
        }
        flags.iter().for_each(|name| enum_flags(&mut b, name, &(0..40).map(|i| i % 10 == 9).collect::<Vec<_>>()));
        load(&write(&dir, "other.hdf5", b), &LoadOptions::default())
    };
    let got = file(&[("obs", 2), ("action", 1), ("reward", 0)], &["terminated", "truncated"]).unwrap();
    let words = got.report.to_string();
    for (field, read) in
        [("observations", "obs"), ("actions", "action"), ("terminals", "terminated"), ("timeouts", "truncated")]
    {
        assert!(words.contains(&format!("no `{field}`: `{read}` was read as such")), "{words}");
    }
    assert_eq!(got.transitions.episodes().len(), 4);
    let got =
        file(&[("observations", 2), ("actions", 1), ("rewards", 0)], &["terminals", "episode_terminals"]).unwrap();
    assert!(got.report.to_string().contains("`episode_terminals` was not read; if it tells"), "{}", got.report);
    let got =
        file(&[("observations", 2), ("actions", 1), ("rewards", 0)], &["terminals", "timeouts", "truncated"]).unwrap();
    assert!(got.report.to_string().contains("`truncated` was not read, because `timeouts` is there"), "{}", got.report);
    let error = file(&[("observations", 2), ("actions", 1), ("rewards", 0)], &["dones"]).unwrap_err().to_string();
    assert!(error.contains("`dones`, which does not tell terminals from time-outs"), "{error}");
    let error = file(&[("observations", 2), ("actions", 1), ("rewards", 0)], &[]).unwrap_err().to_string();
    assert!(error.contains("`terminals`") && error.contains("the file has actions, observations, rewards"), "{error}");
}

#[test]
fn infos_timeouts_are_time_outs_and_all_columns_can_be_had() {
    let dir = tempfile::tempdir().unwrap();
    let mut b = crate::common::rows(40).d4rl();
    let mut infos = b.create_group("infos");
    infos.create_dataset("cost").with_f32_data(&(0..40).map(|i| i as f32).collect::<Vec<_>>());
    infos.create_dataset("qpos").with_f32_data(&[0.0; 80]).with_shape(&[40, 2]);
    b.add_group(infos.finish());
    b.create_dataset("origin").with_f32_data(&[1.0; 40]);
    let path = write(&dir, "infos.hdf5", b);
    let got = load(&path, &LoadOptions { all_columns: true, ..LoadOptions::default() }).unwrap();
    assert_eq!(got.columns.keys().collect::<Vec<_>>(), ["infos/cost", "origin"]);
    assert!(
        got.report.to_string().contains("not read, because they are no columns of 40 numbers: infos/qpos"),
        "{}",
        got.report
    );
    // They are written and read again.
    let columns: Vec<(&str, &[f32])> = got.columns.iter().map(|(k, v)| (k.as_str(), v.as_slice())).collect();
    let again = dir.path().join("again.hdf5");
    tce_data::save_d4rl(&again, &got.transitions, &Default::default(), &columns).unwrap();
    let back = load(&again, &LoadOptions { all_columns: true, ..LoadOptions::default() }).unwrap();
    assert_eq!((back.columns, back.transitions), (got.columns, got.transitions));

    let mut b = FileBuilder::new();
    let r = crate::common::rows(40);
    b.create_dataset("observations").with_f32_data(&r.observations).with_shape(&[40, 2]);
    b.create_dataset("actions").with_f32_data(&r.actions).with_shape(&[40, 1]);
    b.create_dataset("rewards").with_f32_data(&r.rewards);
    enum_flags(&mut b, "terminals", &r.terminals);
    let mut infos = b.create_group("infos");
    infos.create_dataset("timeouts").with_u8_data(&(0..40).map(|i| u8::from(i % 10 == 9)).collect::<Vec<_>>());
    b.add_group(infos.finish());
    let got = load(&write(&dir, "nested.hdf5", b), &LoadOptions::default()).unwrap();
    assert_eq!((got.transitions.episodes().len(), got.report.rows_kept), (4, 36));
    assert!(got.report.to_string().contains("`infos/timeouts` was read as such"), "{}", got.report);
}

/// A hard link makes the file endless: a group contains itself.
#[test]
fn a_group_in_itself_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("circle.hdf5");
    let script = r#"
import sys, h5py, numpy as np
with h5py.File(sys.argv[1], "w") as f:
    e = f.create_group("episode_0")
    e["actions"], e["rewards"] = np.ones((3, 1)), np.ones(3)
    e["terminations"] = e["truncations"] = np.zeros(3, bool)
    e["observations/q"] = np.ones((4, 2))
    e["observations/again"] = e["observations"]
"#;
    if crate::common::python(script, &path).is_none() {
        return;
    }
    let error = load(&path, &LoadOptions::default()).unwrap_err().to_string();
    assert!(error.contains("groups in groups") && error.contains("at most 8"), "{error}");
}
