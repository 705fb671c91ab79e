//! Infers from its numbers which robot a data set belongs to.

use crate::{Agent, Transitions};

/// Ant's observation ends with this many contact forces, which MuJoCo leaves at zero in the benchmark.
pub(crate) const ANT_ZEROS: usize = 84;

/// Source and target are data of different robots.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "source and target are of different robots: found a source of {source_agent}, a target of {target_agent}; expected the same state \
     and action space. Choose files of the same robot"
)]
pub struct AgentMismatch {
    /// Description of the source's robot.
    pub source_agent: String,
    /// Description of the target's robot.
    pub target_agent: String,
}

/// The benchmark agents that `data` may belong to; empty for the user's own robot.
///
/// The dimensions decide, except between HalfCheetah and Walker2d (both 17 and 6). The first coordinate of both is a
/// height: Walker2d's is .8 to 2 on every row, HalfCheetah's is around -.1. Walker2d's velocities are clipped to ±10.
/// If neither fits cleanly (generated rows), both are returned. An Ant must have its 84 zeros.
pub fn infer_agents(data: &Transitions) -> Vec<Agent> {
    match (data.obs_dim, data.act_dim) {
        (11, 3) => vec![Agent::Hopper],
        (111, 8) => {
            let zeros = |row: &[f32]| row[111 - ANT_ZEROS..].iter().all(|&x| x == 0.0);
            if data.observations.chunks_exact(111).all(zeros) { vec![Agent::Ant] } else { Vec::new() }
        }
        (17, 6) => {
            let walks = |row: &&[f32]| row[0] > 0.8 && row[0] < 2.0 && row[8..].iter().all(|v| v.abs() <= 10.001);
            let share = data.observations.chunks_exact(17).filter(walks).count() as f64 / data.len().max(1) as f64;
            match share {
                _ if data.is_empty() => vec![Agent::HalfCheetah, Agent::Walker2d],
                s if s >= 0.999 => vec![Agent::Walker2d],
                s if s <= 0.01 => vec![Agent::HalfCheetah],
                _ => vec![Agent::HalfCheetah, Agent::Walker2d],
            }
        }
        _ => Vec::new(),
    }
}

/// Describes in words the agents that `data` may belong to, and its dimensions.
pub(crate) fn describe(data: &Transitions) -> String {
    let names: Vec<&str> = infer_agents(data).into_iter().map(Agent::name).collect();
    let name = if names.is_empty() { "none of the benchmark's".to_owned() } else { names.join(" or ") };
    format!("{name} ({} observations, {} actions)", data.obs_dim, data.act_dim)
}

/// Returns an error if source and target are of different robots: their dimensions differ, or `named` is a robot of the
/// benchmark and one of the files looks like another robot. A user's own robot is never taken for a benchmark robot.
pub fn ensure_same_agent(
    source: &Transitions,
    target: &Transitions,
    named: Option<Agent>,
) -> Result<(), AgentMismatch> {
    let same_dims = (source.obs_dim, source.act_dim) == (target.obs_dim, target.act_dim);
    let other = |data: &Transitions| {
        let found = infer_agents(data);
        named.is_some_and(|agent| {
            agent.dims() != (data.obs_dim, data.act_dim) || (!found.is_empty() && !found.contains(&agent))
        })
    };
    if same_dims && !other(source) && !other(target) {
        return Ok(());
    }
    let describe = |data: &Transitions| match named {
        Some(_) => describe(data),
        None => format!("{} observations and {} actions", data.obs_dim, data.act_dim),
    };
    Err(AgentMismatch { source_agent: describe(source), target_agent: describe(target) })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Ten rows that look like `agent`.
    pub(crate) fn looks_like(agent: Agent) -> Transitions {
        let (o, a) = agent.dims();
        let mut t = Transitions::new(o, a);
        for i in 0..10 {
            let mut s: Vec<f32> = (0..o).map(|d| ((i * 7 + d * 3) as f32).sin()).collect();
            match agent {
                Agent::Walker2d | Agent::Hopper => s[0] = 1.25 + 0.01 * i as f32,
                Agent::HalfCheetah => s[0] = -0.1,
                Agent::Ant => s[111 - ANT_ZEROS..].fill(0.0),
            }
            t.push(&s, &vec![0.1 * i as f32; a], 1.0, &s, false, false);
        }
        t
    }

    #[test]
    fn every_agent_is_recognised_by_its_rows() {
        for agent in Agent::ALL {
            assert_eq!(infer_agents(&looks_like(agent)), [agent]);
        }
        assert_eq!(infer_agents(&Transitions::new(4, 2)), []);
    }

    #[test]
    fn unclear_rows_leave_both_open_and_a_touched_ant_is_none() {
        let mut t = looks_like(Agent::Walker2d);
        t.observations[0] = 0.5;
        assert_eq!(infer_agents(&t), [Agent::HalfCheetah, Agent::Walker2d]);
        let mut t = looks_like(Agent::Ant);
        t.observations[110] = 1e-3;
        assert_eq!(infer_agents(&t), []);
    }

    #[test]
    fn different_agents_are_refused_by_name() {
        for a in Agent::ALL {
            for b in Agent::ALL {
                let result = ensure_same_agent(&looks_like(a), &looks_like(b), Some(b));
                if a == b {
                    assert_eq!(result, Ok(()));
                    continue;
                }
                let message = result.unwrap_err().to_string();
                assert!(message.contains(a.name()) && message.contains(b.name()), "{message}");
            }
        }
    }

    #[test]
    fn own_robots_are_told_apart_by_their_dimensions_alone() {
        let message =
            ensure_same_agent(&Transitions::new(4, 2), &Transitions::new(4, 3), None).unwrap_err().to_string();
        assert!(message.contains("4 observations and 2 actions"), "{message}");
        assert!(ensure_same_agent(&Transitions::new(4, 2), &Transitions::new(4, 2), None).is_ok());
        // The 17 x 6 data of a user's own robot arm, whose base is turned.
        let (a, b) = (looks_like(Agent::Walker2d), looks_like(Agent::HalfCheetah));
        assert!(ensure_same_agent(&a, &b, None).is_ok());
    }
}
