//! Tests on the public target data, if they are available.

use std::fs;

use tce_data::{
    Agent, EpisodeEnds, Layout, LoadOptions, Quality, Rows, ScoreTable, Severity, Shift, Standardizer, Transitions,
    check, ensure_same_agent, infer_agents, inspect, load, reference_scores, zscore_keep,
};

fn files() -> Option<Vec<(Agent, Shift, Quality, Transitions)>> {
    let Some(shared) = crate::common::shared() else {
        eprintln!("SKIPPED: the public target data need TCE_SHARED");
        return None;
    };
    let mut out = Vec::new();
    for agent in Agent::ALL {
        for shift in [Shift::Morph, Shift::Kinematic, Shift::Gravity] {
            for quality in [Quality::Medium, Quality::Expert] {
                let name = format!("datasets/otdf/{agent}_{}_{quality}.hdf5", shift.file_name());
                let options = LoadOptions { dims: Some(agent.dims()), ..crate::common::benchmark() };
                let got = load(&shared.join(name), &options).unwrap();
                assert_eq!(
                    (got.report.layout, got.report.rows_kept, got.report.dropped.total()),
                    (Layout::Otdf, 5000, 0)
                );
                assert_eq!(got.report.warnings, [""; 0]);
                assert_eq!(got.report.episodes, EpisodeEnds::Continuity);
                // The result does not depend on the step limit.
                let own = load(
                    &shared.join(format!("datasets/otdf/{agent}_{}_{quality}.hdf5", shift.file_name())),
                    &LoadOptions::default(),
                );
                assert_eq!(own.unwrap().transitions, got.transitions);
                out.push((agent, shift, quality, got.transitions));
            }
        }
    }
    Some(out)
}

/// The scores of the policies that collected the data, measured by another program (datasets.md): morph, kinematic,
/// gravity, each medium then expert.
const SCORES: [[f64; 6]; 4] = [
    [44.4, 99.1, 41.4, 99.2, 46.8, 86.0],
    [63.1, 100.1, 66.2, 100.1, 73.4, 125.0],
    [45.7, 99.1, 62.1, 94.6, 55.7, 99.7],
    [41.4, 97.9, 61.4, 99.2, 56.9, 79.5],
];

#[test]
fn the_behaviour_scores_are_reproduced() {
    let Some(files) = files() else { return };
    for (i, (agent, shift, quality, t)) in files.iter().enumerate() {
        let measured = inspect(t, Some(1000));
        let score = reference_scores(*agent, *shift, ScoreTable::Otdf).unwrap().normalised_score(measured.returns.mean);
        eprintln!(
            "{agent} {shift} {quality}: {score:.2}, {} episodes, {} complete, smallest std {:?}",
            measured.episodes,
            measured.complete_episodes,
            measured.observations.std.iter().copied().filter(|&s| s > 0.0).fold(f64::INFINITY, f64::min)
        );
        assert!((score - SCORES[i / 6][i % 6]).abs() < 0.051, "{agent} {shift} {quality}: {score}");
    }
}

#[test]
fn every_file_is_recognised_and_passes_the_checks() {
    let Some(files) = files() else { return };
    for (agent, shift, quality, t) in &files {
        assert_eq!(infer_agents(t), [*agent], "{agent} {shift} {quality}");
        let c = check(t, Some(*agent));
        let worse = c.findings.iter().find(|f| f.severity > Severity::Note);
        assert!(worse.is_none(), "{agent} {shift} {quality}: {worse:?}");
        // Their simulator clips velocities at 10.
        assert!(*agent != Agent::Walker2d || c.findings.iter().any(|f| f.message.contains("10")), "{:?}", c.findings);
    }
    for (a, _, _, source) in files.iter().step_by(6) {
        for (b, _, _, target) in files.iter().skip(3).step_by(6) {
            assert_eq!(ensure_same_agent(source, target, Some(*a)).is_ok(), a == b);
        }
    }
}

/// The floor attenuates no live dimension of a state or of a difference s' - s, and only Ant's zeros are dead.
#[test]
fn the_floor_leaves_every_real_signal_alone() {
    let Some(files) = files() else { return };
    for (agent, shift, quality, t) in &files {
        let difference: Vec<f32> = t.next_observations.iter().zip(&t.observations).map(|(a, b)| a - b).collect();
        for (what, data) in [("s", &t.observations), ("s' - s", &difference)] {
            let s = Standardizer::fit(data, t.obs_dim);
            let dead = if *agent == Agent::Ant { 84 } else { 0 };
            let mut live: Vec<f32> = s.live().iter().map(|&d| s.std[d]).collect();
            live.sort_by(f32::total_cmp);
            eprintln!("{agent} {shift} {quality} {what}: smallest / median std {:.2e}", live[0] / live[live.len() / 2]);
            assert_eq!((s.dead.len(), s.floored.len()), (dead, 0), "{agent} {shift} {quality} {what}");
        }
        // Eq. 8 at the paper's threshold rejects many real pairs; an implementation error would reject all or none.
        let kept = zscore_keep(&Rows::state_pairs(t), 3.0).iter().filter(|&&k| k).count();
        eprintln!("{agent} {shift} {quality}: z = 3 rejects {:.1} %", 100.0 - kept as f64 / 50.0);
        assert!((3500..5000).contains(&kept));
    }
}

/// Damaged copies of a real file: cuts and bit flips.
#[test]
fn damaged_real_files_never_panic() {
    let Some(shared) = crate::common::shared() else {
        eprintln!("SKIPPED: damaged_real_files_never_panic needs TCE_SHARED");
        return;
    };
    let whole = fs::read(shared.join("datasets/otdf/hopper_kinematic_medium.hdf5")).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.hdf5");
    let mut accepted = 0;
    for i in 0..150 {
        fs::write(&path, &whole[..whole.len() * i / 150]).unwrap();
        assert!(load(&path, &crate::common::benchmark()).is_err(), "cut {i}");
        let mut bytes = whole.clone();
        // Half of the flips are in the metadata at the front, half are spread over the file.
        let at = if i % 2 == 0 { 13 * i } else { whole.len() * i / 150 };
        bytes[at] ^= 0x10;
        fs::write(&path, &bytes).unwrap();
        accepted += load(&path, &crate::common::benchmark()).is_ok() as usize;
    }
    eprintln!("{accepted} of 150 flipped bits had no effect that the format can notice");
}
