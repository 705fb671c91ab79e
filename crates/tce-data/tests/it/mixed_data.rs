//! Choices and findings on the public target data, if they are available.
//! `cargo nextest run --release -p tce-data mixed_data` prints the decisions.

use tce_data::{
    Agent, CLEAR_GAP, Episode, LoadOptions, Shift, Support, Transitions, choose_trajectories, choose_trajectories_with,
    load,
};

const SHIFTS: [Shift; 3] = [Shift::Morph, Shift::Kinematic, Shift::Gravity];

fn pairs() -> Vec<(String, Transitions, Transitions)> {
    let Some(shared) = crate::common::shared() else {
        eprintln!("SKIPPED: the public target data need TCE_SHARED");
        return Vec::new();
    };
    let read = |agent: Agent, shift: Shift, quality: &str| {
        let path = shared.join(format!("datasets/otdf/{agent}_{}_{quality}.hdf5", shift.file_name()));
        load(&path, &LoadOptions { dims: Some(agent.dims()), ..crate::common::benchmark() }).unwrap().transitions
    };
    let of = |agent, shift: Shift| {
        (format!("{agent} {}", shift.file_name()), read(agent, shift, "medium"), read(agent, shift, "expert"))
    };
    Agent::ALL.into_iter().flat_map(|agent| SHIFTS.map(|shift| of(agent, shift))).collect()
}

/// Episodes of `t` that the end of the file did not cut: at most `count`, from index `skip` on, wrapping around.
fn whole(t: &Transitions, count: usize, skip: usize) -> Vec<Episode> {
    let mut all = t.episodes();
    let limit = all.iter().map(|e| e.end - e.start).max().unwrap();
    all.retain(|e| t.terminals[e.end - 1] || e.end - e.start + 2 >= limit);
    let n = all.len();
    (0..count.min(n)).map(|k| all[(k + skip) % n]).collect()
}

/// Concatenates episodes; the last one loses its last `cut` share.
fn join(parts: &[(&Transitions, Vec<Episode>)], cut: f64) -> Transitions {
    let mut out = Transitions::new(parts[0].0.obs_dim, parts[0].0.act_dim);
    for (t, episodes) in parts {
        for e in episodes {
            out.extend(&t.select(&(e.start..e.end).collect::<Vec<_>>()));
        }
    }
    let start = out.episodes().last().unwrap().start;
    let keep = start + ((out.len() - start) as f64 * (1.0 - cut)) as usize;
    out.select(&(0..keep).collect::<Vec<_>>())
}

#[test]
fn sets_of_one_quality_are_kept_whole() {
    for (name, medium, expert) in pairs() {
        for (quality, t) in [("medium", medium), ("expert", expert)] {
            let c = choose_trajectories(&t);
            println!("| {name} {quality} | {} |", c.reason);
            assert!(!c.is_selective(), "{name} {quality}: {}", c.reason);
            for gap in [0.75, 1.0, 1.5] {
                let c = choose_trajectories_with(&t, gap);
                if c.is_selective() {
                    println!("with {gap} instead of {CLEAR_GAP}: {name} {quality}: {}", c.reason);
                }
            }
        }
    }
}

#[test]
fn of_mixed_sets_the_expert_part_is_kept() {
    let others = [1.0, 1.5, 2.5, 3.0, 4.0];
    let mut exact_with = [0; 5];
    let mut counts = std::collections::BTreeMap::<(&str, &str), usize>::new();
    for (name, medium, expert) in pairs() {
        for (m, e) in [(2, 3), (4, 1), (1, 4)] {
            for skip in 0..3 {
                for (first, cut) in [
                    ("medium", 0.0),
                    ("medium", 0.4),
                    ("medium", 0.9),
                    ("expert", 0.0),
                    ("expert", 0.4),
                    ("expert", 0.9),
                ] {
                    let mut parts = [(&medium, whole(&medium, m, skip)), (&expert, whole(&expert, e, skip))];
                    let (m, e) = (parts[0].1.len(), parts[1].1.len());
                    if first == "expert" {
                        parts.reverse();
                    }
                    let t = join(&parts, cut);
                    let c = choose_trajectories(&t);
                    let good = if first == "medium" { m..m + e } else { 0..e };
                    let episodes = t.episodes();
                    let exact = c.is_selective() && c.episodes == episodes[good.clone()];
                    for (count, gap) in exact_with.iter_mut().zip(others) {
                        let c = choose_trajectories_with(&t, gap);
                        *count += (c.is_selective() && c.episodes == episodes[good.clone()]) as usize;
                    }
                    // With very few expert rows, or very few others, keeping everything is also right.
                    let expert_rows: usize = episodes[good.clone()].iter().map(|e| e.end - e.start).sum();
                    let kind = match (expert_rows, t.len() - expert_rows) {
                        (0..500, _) => "no expert rows to speak of",
                        (_, 0..250) => "hardly anything but expert rows",
                        _ => "mixed",
                    };
                    let verdict = match (exact, c.is_selective()) {
                        (true, _) => "expert",
                        (false, true) => "OTHER",
                        (false, false) => "all",
                    };
                    *counts.entry((kind, verdict)).or_default() += 1;
                    println!(
                        "| {kind} | {name} {m}+{e} from {skip}, {first} first, cut {cut} | {verdict} | {} |",
                        c.reason
                    );
                }
            }
        }
    }
    println!("{counts:?}");
    println!("with {others:?} instead of {CLEAR_GAP}: {exact_with:?} exactly the expert part");
    let of = |verdict| counts.get(&("mixed", verdict)).copied().unwrap_or(0);
    let (right, all) = (of("expert"), of("expert") + of("all") + of("OTHER"));
    println!("{right} of {all} mixed sets: exactly the expert part");
    assert!(right * 10 >= all * 8, "{right} of {all}");
}

#[test]
fn supports_of_the_public_sets() {
    for (name, medium, expert) in pairs() {
        for (quality, t) in [("medium", medium), ("expert", expert)] {
            let s = Support::fit(&[&t.observations, &t.next_observations], t.obs_dim);
            println!("{name} {quality}: {}", s.describe().join(" "));
            let mut rows = t.observations.clone();
            s.apply(&mut rows);
            assert_eq!(rows, t.observations, "{name} {quality}");
            let units: Vec<_> = s.units.iter().map(|u| (u.first, u.width)).collect();
            let agent = name.split(' ').next().unwrap();
            assert_eq!(units, if agent == "ant" { vec![(1, 4)] } else { vec![] }, "{name} {quality}");
            assert_eq!(s.constants.len(), if agent == "ant" { 84 } else { 0 }, "{name} {quality}");
            assert_eq!(!s.clips.is_empty(), agent == "hopper" || agent == "walker2d", "{name} {quality}");
            for bound in s.clips.iter().flat_map(|c| [c.low, c.high]).flatten() {
                assert_eq!(bound.value.abs(), 10.0, "{name} {quality}");
            }
        }
    }
}
