//! Checks of a data set that run without a simulator.

use std::collections::HashSet;
use std::fmt;
use std::hash::{DefaultHasher, Hasher};

use serde::Serialize;
use tce_base::counted;

use crate::actions::ACTION_TOLERANCE;
use crate::agents::{ANT_ZEROS, describe, infer_agents};
use crate::moments::Moments;
use crate::{ActionRange, Agent, Rows, Support, Transitions};

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// For information.
    Note,
    /// Probably a mistake.
    Warning,
    /// The data cannot be used for this agent.
    Error,
}

/// One finding.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// Severity of the finding.
    pub severity: Severity,
    /// The column that it concerns.
    pub field: &'static str,
    /// What was found, what was expected and what to do.
    pub message: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let severity = match self.severity {
            Severity::Note => "note",
            Severity::Warning => "warning",
            Severity::Error => "error",
        };
        write!(f, "{severity}: {}: {}", self.field, self.message)
    }
}

/// The result of [`check()`].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Check {
    /// All findings, in the order of the columns.
    pub findings: Vec<Finding>,
    /// Share of rows whose (s, a, s') repeats an earlier row, 0..1.
    pub duplicate_share: f64,
}

impl Check {
    /// Whether there are no errors.
    pub fn is_ok(&self) -> bool {
        self.findings.iter().all(|f| f.severity != Severity::Error)
    }
}

/// Checks `data`, which should belong to `agent` (`None`: the user's own robot).
pub fn check(data: &Transitions, agent: Option<Agent>) -> Check {
    let mut findings = Vec::new();
    let mut add = |severity, field, message: String| findings.push(Finding { severity, field, message });
    if data.is_empty() {
        add(Severity::Error, "rows", "the data set has no rows; expected at least one".into());
        return Check { findings, duplicate_share: 0.0 };
    }
    if let Some(agent) = agent {
        let (o, a) = agent.dims();
        let fits =
            (o, a) == (data.obs_dim, data.act_dim) && (agent == Agent::Ant || infer_agents(data).contains(&agent));
        if !fits {
            let found = describe(data);
            add(
                Severity::Error,
                "observations",
                format!("these are data of another agent: {found}; expected {agent} ({o} observations, {a} actions)"),
            );
        }
    }
    for (field, values, dim) in [
        ("observations", &data.observations, data.obs_dim),
        ("actions", &data.actions, data.act_dim),
        ("rewards", &data.rewards, 1),
        ("next_observations", &data.next_observations, data.obs_dim),
    ] {
        if let Some(at) = values.iter().position(|x| !x.is_finite()) {
            let bad = values.iter().filter(|x| !x.is_finite()).count();
            add(
                Severity::Error,
                field,
                format!(
                    "{} NaN or infinite, the first at row {}, column {}",
                    counted(bad, "value is", "values are"),
                    at / dim,
                    at % dim
                ),
            );
        }
    }
    if let Some((severity, message)) = dead_dimensions(data, agent) {
        add(severity, "observations", message);
    }
    match agent {
        Some(_) => {
            if let Some(message) = actions_outside(&data.actions, data.act_dim) {
                add(Severity::Warning, "actions", message);
            }
        }
        None => {
            if let Some(range) = ActionRange::of(&[data]) {
                let message = format!(
                    "they range over {range}: scaled to [-1, 1] inside, results are in these units (--action-range)"
                );
                add(Severity::Note, "actions", message);
            }
        }
    }
    if data.len() > 1 && data.rewards.iter().all(|&r| r == data.rewards[0]) {
        let message = format!("every reward is {}; returns tell nothing of how good an episode is", data.rewards[0]);
        add(Severity::Note, "rewards", message);
    }
    // Constant columns are reported separately.
    let support = Support { constants: Vec::new(), ..Support::fit(&[&data.observations], data.obs_dim) };
    support.describe().into_iter().for_each(|line| add(Severity::Note, "observations", line));
    let single = data.episodes().iter().filter(|e| e.end - e.start == 1).count();
    if single > 1 && single * 10 > data.len() {
        let message = format!(
            "{single} episodes have one step; what follows episodes (returns, the better trajectories, sequence models) learns nothing from them"
        );
        add(Severity::Warning, "timeouts", message);
    }
    let duplicate_share = duplicate_share(data);
    if duplicate_share > 0.01 {
        let percent = 100.0 * duplicate_share;
        add(Severity::Warning, "rows", format!("{percent:.1} % of the rows repeat an earlier (s, a, s') exactly"));
    }
    Check { findings, duplicate_share }
}

/// Compares the constant dimensions with those that are known to be constant for this agent.
fn dead_dimensions(data: &Transitions, agent: Option<Agent>) -> Option<(Severity, String)> {
    let m = Moments::of(&[Rows::new(&data.observations, data.obs_dim)]);
    let dead: Vec<usize> = (0..data.obs_dim).filter(|&d| m.std[d] == 0.0).collect();
    let expected: Vec<usize> = match agent {
        Some(Agent::Ant) if data.obs_dim == 111 => (111 - ANT_ZEROS..111).collect(),
        _ => Vec::new(),
    };
    // A single row has no spread anywhere.
    if dead == expected || data.len() < 2 {
        return None;
    }
    let missing: Vec<_> = expected.iter().filter(|d| !dead.contains(d)).collect();
    let extra: Vec<_> = dead.iter().filter(|d| !expected.contains(d)).collect();
    if !missing.is_empty() {
        let message = format!(
            "dimensions {missing:?} vary; expected zeros there (Ant's contact forces, which the benchmark's simulator \
             leaves at 0). These data come from another simulator version and do not match the simulated target"
        );
        return Some((Severity::Warning, message));
    }
    let message = format!("dimensions {extra:?} never change; standardising leaves them alone");
    Some((if agent.is_some() { Severity::Warning } else { Severity::Note }, message))
}

/// Describes in words which actions leave the box [-1, 1] by more than float32 rounding. `None` if none does.
fn actions_outside(actions: &[f32], dim: usize) -> Option<String> {
    let outside = |x: &&f32| x.abs() > 1.0 + ACTION_TOLERANCE;
    let count = actions.iter().filter(outside).count();
    let at = actions.iter().position(|x| outside(&x))?;
    let worst = actions.iter().fold(0f32, |m, x| m.max(x.abs()));
    let values = counted(count, "value lies", "values lie");
    Some(format!(
        "{values} outside of [-1, 1] (largest magnitude {worst}, first at row {}, column {}); the simulator \
         clamps them, a policy with a tanh cannot reach them: clip them or rescale the actions",
        at / dim,
        at % dim
    ))
}

fn duplicate_share(data: &Transitions) -> f64 {
    let (s, a, s2) = (&data.observations, &data.actions, &data.next_observations);
    // A row without a next state may be a copy, too.
    let rows = Rows::join(&[(s, data.obs_dim), (a, data.act_dim), (s2, data.obs_dim)]);
    let mut row = vec![0f32; rows.dim()];
    let mut seen = HashSet::with_capacity(rows.len());
    // The hash has 64 bits: among two million different rows, a false match has probability 1e-7.
    let repeated = (0..rows.len())
        .filter(|&i| {
            rows.copy_row(i, &mut row);
            let mut hash = DefaultHasher::new();
            row.iter().for_each(|x| hash.write_u32(x.to_bits()));
            !seen.insert(hash.finish())
        })
        .count();
    repeated as f64 / rows.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agents::tests::looks_like;

    fn errors(c: &Check) -> Vec<String> {
        c.findings.iter().filter(|f| f.severity == Severity::Error).map(Finding::to_string).collect()
    }

    #[test]
    fn good_data_of_every_agent_pass_and_of_another_do_not() {
        for a in Agent::ALL {
            for b in Agent::ALL {
                let c = check(&looks_like(a), Some(b));
                assert_eq!(c.is_ok(), a == b, "{a} as {b}: {:?}", c.findings);
                if a != b {
                    let e = &errors(&c)[0];
                    assert!(e.contains(a.name()) && e.contains(b.name()), "{e}");
                }
            }
            let worse = |f: &&Finding| f.severity > Severity::Note;
            assert_eq!(check(&looks_like(Agent::Ant), Some(Agent::Ant)).findings.iter().find(worse), None);
        }
    }

    #[test]
    fn each_defect_is_found() {
        let found = |change: &dyn Fn(&mut Transitions), agent| {
            let mut t = looks_like(agent);
            change(&mut t);
            let c = check(&t, Some(agent));
            c.findings.iter().map(Finding::to_string).collect::<Vec<_>>().join("\n")
        };
        let text = found(&|t| t.rewards[3] = f32::NAN, Agent::Hopper);
        assert!(text.contains("error: rewards") && text.contains("row 3, column 0"), "{text}");
        let text = found(&|t| t.actions[4] = 1.5, Agent::Hopper);
        assert!(text.contains("warning: actions") && text.contains("row 1, column 1"), "{text}");
        let text = found(&|t| t.observations[50] = 0.25, Agent::Ant);
        assert!(text.contains("dimensions [50] vary"), "{text}");
        let text = found(&|t| t.observations.iter_mut().skip(4).step_by(11).for_each(|x| *x = 0.5), Agent::Hopper);
        assert!(text.contains("dimensions [4] never change"), "{text}");
        let text = found(&|t| t.extend(&t.clone()), Agent::Hopper);
        assert!(text.contains("50.0 % of the rows repeat"), "{text}");
        assert!(!check(&Transitions::new(11, 3), None).is_ok());
    }

    #[test]
    fn what_an_own_robot_should_know_is_told() {
        let mut t = Transitions::new(2, 1);
        for i in 0..400 {
            let x = i as f32 * 0.01 + if i > 249 { 50.0 } else { 0.0 };
            t.push(&[x, 3.0], &[20.0 * (i as f32).sin()], 0.0, &[x + 0.01, 3.0], false, i == 99);
        }
        let told =
            |t: &Transitions| check(t, None).findings.iter().map(Finding::to_string).collect::<Vec<_>>().join("\n");
        let text = told(&t);
        for part in [
            "note: rewards: every reward is 0",
            "note: observations: dimensions [1] never change",
            "note: actions: they range over -",
        ] {
            assert!(text.contains(part), "{part} is not in:\n{text}");
        }
        assert!(!text.contains("lie outside of [-1, 1]"), "{text}");
        assert!(!text.contains("one step"), "{text}");
        (0..50).for_each(|i| t.timeouts[i] = true);
        assert!(told(&t).contains("warning: timeouts: 50 episodes have one step"), "{}", told(&t));
    }
}
