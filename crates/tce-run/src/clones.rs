//! Actions of clones for rows besides the target's (`mixture.actions = "clones"`).
//!
//! A generated row has the action that the target's inverse dynamics infers from s and s'. Where the generator errs, this action is not
//! what the behaviour would do in s, and a clone of such rows learns the error. Clones of the target rows answer in s, too: then the
//! generator decides which states are learned from, and nothing else. Where clones of so few rows are bad, the inverse dynamics is the
//! better teacher (bench/expansion.md).

use std::path::PathBuf;
use std::sync::Arc;

use rayon::prelude::*;
use tce_base::{Progress, interrupted};
use tce_data::Transitions;
use tce_learn::{Policy, rmse};

use crate::error::{Error, Result};
use crate::policy_training::MemberData;

/// Rows that a policy acts on at once: what its layers need of memory stays small.
const CHUNK: usize = 1024;

/// The actions of `policy` in the states of `rows`, in the box [-1, 1].
fn actions_of(policy: &Policy, rows: &Transitions, label: String) -> Result<Vec<f32>> {
    let progress = Progress::new(label, rows.len() as u64, "rows");
    let mut actions = vec![0.0; rows.actions.len()];
    let states = rows.observations.par_chunks(CHUNK * rows.obs_dim);
    actions.par_chunks_mut(CHUNK * rows.act_dim).zip(states).try_for_each(|(actions, states)| {
        if interrupted() {
            return Err(Error::interrupted());
        }
        policy.act(states, None, actions);
        progress.inc((actions.len() / rows.act_dim) as u64);
        Ok(())
    })?;
    progress.finish();
    Ok(actions)
}

/// Gives the other rows of every member the actions of its policy in `policies`. Returns how far these are from the rows' own: the root mean
/// square over rows and actions, per member.
///
/// # Errors
/// If a policy cannot be read, or the user interrupts.
pub fn take_actions(data: &mut [MemberData], policies: &[PathBuf]) -> Result<Vec<f64>> {
    let mut distances = Vec::new();
    for (member, file) in data.iter_mut().zip(policies) {
        let Some(rows) = &mut member.extra else { continue };
        // Rows are in the box, whatever the units of the user's actions are.
        let policy = Policy::load(file)?.in_units(None);
        let actions = actions_of(&policy, rows, format!("actions of clones [{}]", member.seed))?;
        let differ = rmse(&actions, &rows.actions);
        tce_base::note!(
            "seed {}: other rows have the actions of clones of the target rows, which are {differ:.3} (root mean square) from their own",
            member.seed
        );
        distances.push(differ);
        Arc::make_mut(rows).actions = actions;
    }
    Ok(distances)
}

#[cfg(test)]
mod tests {
    use tce_data::{ActionRange, Standardizer};
    use tce_learn::{Head, MlpPolicy, PolicySpec};
    use tce_nn::{Activation, NamedParameters};

    use super::*;

    /// A policy without hidden layers: the action is half the observation.
    fn half() -> Policy {
        let spec = PolicySpec {
            observations: 1,
            actions: 1,
            inputs: vec![0],
            standardizer: Standardizer::identity(1),
            clip: None,
            hidden: Vec::new(),
            activation: Activation::Relu,
            output_activation: Activation::Identity,
            head: Head::Mean,
            log_std_range: None,
        };
        let mut weights = NamedParameters::default();
        weights.tensors.insert("policy.layers.0.weight".into(), (vec![1, 1, 1], vec![0.5]));
        weights.tensors.insert("policy.layers.0.bias".into(), (vec![1, 1, 1], vec![0.0]));
        MlpPolicy::new(spec, &weights, "policy", "half".as_ref()).unwrap().into()
    }

    fn rows(n: usize, action: f32) -> Arc<Transitions> {
        let mut t = Transitions::new(1, 1);
        (0..n).for_each(|i| t.push(&[i as f32 / n as f32], &[action], i as f32, &[9.0], i == 7, false));
        Arc::new(t)
    }

    #[test]
    fn other_rows_take_the_actions_of_the_policy_and_keep_the_rest() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("policy-seed3.safetensors");
        // It acts in the units of the user's robot, and rows are in the box all the same.
        half().in_units(Some(ActionRange { low: vec![0.0], high: vec![10.0] })).save(&file).unwrap();
        let (target, extra, n) = (rows(10, 0.25), rows(3 * CHUNK + 5, 0.25), 3 * CHUNK + 5);
        let of =
            |extra| MemberData { seed: 3, target: target.clone(), extra, row_scores: None, trajectories: Vec::new() };
        let mut data = [of(Some(extra.clone()))];
        let distances = take_actions(&mut data, std::slice::from_ref(&file)).unwrap();
        let changed = data[0].extra.clone().unwrap();
        let expected: Vec<f32> = (0..n).map(|i| 0.5 * (i as f32 / n as f32)).collect();
        assert_eq!(*changed, Transitions { actions: expected, ..(*extra).clone() });
        // The actions are spread evenly from 0 to .5, .25 is their mean: the root mean square is .5 / √12.
        assert!((distances[0] - 0.5 / 12_f64.sqrt()).abs() < 1e-3, "{distances:?}");
        assert_eq!((&extra.actions[..2], &data[0].target), (&[0.25; 2][..], &target), "what others share stays");
        // Without other rows, and without policies, there is nothing to do.
        assert_eq!(take_actions(&mut [of(None)], &[file]).unwrap(), [0.0; 0]);
        assert_eq!(take_actions(&mut data, &[]).unwrap(), [0.0; 0]);
    }
}
