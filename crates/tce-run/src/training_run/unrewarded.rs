//! Data whose rewards tell nothing of a policy.

use tce_data::Transitions;

use crate::verdict::{Candidate, Verdict, only};

/// The reward of all rows of `target`, where they have the same one and it tells nothing of a policy. One other than 0 counts the steps, which
/// tells something where episodes end in terminals.
pub fn only_reward(target: &Transitions) -> Option<f32> {
    let first = *target.rewards.first()?;
    let equal = target.rewards.iter().all(|&reward| reward == first);
    (equal && (first == 0.0 || !target.terminals.contains(&true))).then_some(first)
}

/// The verdict where the rewards of `target` tell nothing: the baseline. A model of such rewards predicts noise around the one that there is,
/// and that must not choose. None where they tell something.
pub fn without_rewards(candidates: &[Candidate], target: &Transitions) -> Option<Verdict> {
    let reward = only_reward(target)?;
    if let Some(verdict) = only(candidates) {
        let reason =
            format!("{} The target's rewards are all equal ({reward}) and tell nothing of its return.", verdict.reason);
        return Some(Verdict { reason, ..verdict });
    }
    let standard = candidates.iter().find(|c| c.baseline)?;
    Some(Verdict {
        method: standard.name.clone(),
        policy: standard.files.first()?.clone(),
        sure: false,
        reason: format!(
            "{} is recommended: the target's rewards are all equal ({reward}), so that nothing can be compared. Record rewards that \
             tell good steps from bad ones to compare policies.",
            standard.name
        ),
        tried: Vec::new(),
        behaviour_value: None,
    })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::policy_training::policy_file;

    #[test]
    fn equal_rewards_tell_nothing_unless_episodes_end() {
        let told = |rewards: [f32; 3], terminal: bool| {
            let mut t = Transitions::new(1, 1);
            for (i, reward) in rewards.into_iter().enumerate() {
                t.push(&[i as f32], &[0.0], reward, &[i as f32 + 1.0], terminal && i == 2, !terminal && i == 2);
            }
            only_reward(&t)
        };
        assert_eq!(told([1.0, 1.0, 2.0], false), None);
        // A reward for every step until the robot falls counts the steps.
        assert_eq!((told([1.0; 3], true), told([1.0; 3], false)), (None, Some(1.0)));
        assert_eq!((told([0.0; 3], true), told([0.0; 3], false)), (Some(0.0), Some(0.0)));

        let candidate = |name: &str, baseline, seeds: u64| Candidate {
            name: name.into(),
            baseline,
            files: (0..seeds).map(|seed| policy_file(seed).into()).collect(),
        };
        let mut t = Transitions::new(1, 1);
        t.push(&[0.0], &[0.0], 0.0, &[1.0], true, false);
        let two = without_rewards(&[candidate("clones", true, 2), candidate("wider", false, 2)], &t).unwrap();
        assert_eq!((two.method.as_str(), two.sure, two.policy), ("clones", false, PathBuf::from(policy_file(0))));
        let one = without_rewards(&[candidate("clones", true, 1)], &t).unwrap();
        assert!(one.sure && one.reason.contains("rewards are all equal (0)"), "{}", one.reason);
        t.rewards[0] = 1.0;
        assert_eq!(without_rewards(&[candidate("clones", true, 1)], &t), None);
    }
}
