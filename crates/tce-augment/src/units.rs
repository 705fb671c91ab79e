//! Between the units of the data and those of the networks.

use serde::{Deserialize, Serialize};
use tce_data::{Standardizer, Support, Transitions, even_standardizer};
use tce_diffusion::Target;

/// Between the data's units and the networks'.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Units {
    /// Dimension of s in the data.
    pub obs_dim: usize,
    /// Dimension of a.
    pub act_dim: usize,
    /// The dimensions that the networks see.
    pub live: Vec<usize>,
    /// A state whose dead dimensions have their constant values.
    pub template: Vec<f32>,
    /// Of live states.
    pub state: Standardizer,
    /// Of what q_tran generates, s' or s' - s.
    pub output: Standardizer,
    /// What q_tran generates.
    pub target: Target,
}

impl Units {
    /// The units in which batches have zero mean and unit variance: source and target count the same, as in a balanced
    /// batch, however many more source rows there are.
    pub fn fit(target: &Transitions, source: Option<&Transitions>, kind: Target) -> Self {
        let d = target.obs_dim;
        let all = even_standardizer(target, source);
        let live = all.live();
        let pick = |values: &[f32]| live.iter().map(|&k| values[k]).collect();
        let state = Standardizer { mean: pick(&all.mean), std: pick(&all.std), dead: vec![], floored: vec![] };
        let units = Self {
            obs_dim: d,
            act_dim: target.act_dim,
            template: all.mean.clone(),
            live,
            output: state.clone(),
            state,
            target: kind,
        };
        let rows = kind.encode(&units.take(&target.observations), &units.take(&target.next_observations));
        Self { output: Standardizer::fit(&rows, units.live.len()), ..units }
    }

    /// The live dimensions of row-major states.
    pub fn take(&self, states: &[f32]) -> Vec<f32> {
        states.chunks_exact(self.obs_dim).flat_map(|row| self.live.iter().map(|&k| row[k])).collect()
    }

    /// Whole states from live dimensions.
    pub fn put_back(&self, live: &[f32]) -> Vec<f32> {
        let mut out = Vec::with_capacity(live.len() / self.live.len() * self.obs_dim);
        for row in live.chunks_exact(self.live.len()) {
            let start = out.len();
            out.extend_from_slice(&self.template);
            self.live.iter().zip(row).for_each(|(&k, &v)| out[start + k] = v);
        }
        out
    }

    /// What q_tran is trained on: standardised outputs of the rows of `t`, `[rows, d]`.
    pub fn outputs(&self, t: &Transitions) -> Vec<f32> {
        let (s, s2) = (self.take(&t.observations), self.take(&t.next_observations));
        self.output.apply(&self.target.encode(&s, &s2))
    }

    /// The successors of live `states`, in place, from what q_tran generates, both `[n, d]`. A column that no step of the target changes
    /// keeps its value: a generative model leaves noise there.
    pub fn successors(&self, states: &[f32], generated: &mut [f32]) {
        self.output.invert_in_place(generated);
        self.output.restore_dead(generated);
        self.target.decode(states, generated);
    }

    /// Live dimensions of states that respect what the data respect.
    pub fn within(&self, support: &Support, live: &[f32]) -> Vec<f32> {
        let mut whole = self.put_back(live);
        support.apply(&mut whole);
        self.take(&whole)
    }

    /// Live, standardised states.
    pub fn states(&self, states: &[f32]) -> Vec<f32> {
        self.state.apply(&self.take(states))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dead_dimensions_come_back_as_their_constants() {
        let mut t = Transitions::new(3, 1);
        for i in 0..10 {
            let x = i as f32;
            t.push(&[x, 0.5, -x], &[0.0], 0.0, &[x + 1.0, 0.5, -x - 1.0], false, false);
        }
        let units = Units::fit(&t, None, Target::Delta);
        assert_eq!(units.live, [0, 2]);
        let live = units.take(&t.observations);
        assert_eq!(units.put_back(&live), t.observations);
        let standardised = units.states(&t.observations);
        let mean: f32 = standardised.iter().sum::<f32>() / standardised.len() as f32;
        assert!(mean.abs() < 1e-6);
    }

    #[test]
    fn what_no_step_changes_stays_what_it_is() {
        // The goal of an episode, in metres.
        let mut t = Transitions::new(2, 1);
        (0..20).for_each(|i| {
            let (x, goal) = (i as f32, if i < 10 { 0.001 } else { 0.002 });
            t.push(&[x, goal], &[0.0], 0.0, &[x + (i % 3) as f32, goal], false, i == 9);
        });
        let units = Units::fit(&t, None, Target::Delta);
        assert_eq!(units.live, [0, 1]);
        // The networks leave an error in both columns.
        let mut generated: Vec<f32> = units.outputs(&t).iter().map(|x| x + 1e-3).collect();
        units.successors(&t.observations, &mut generated);
        for (found, real) in generated.chunks_exact(2).zip(t.next_observations.chunks_exact(2)) {
            assert!((found[0] - real[0]).abs() < 2e-3 && found[0] != real[0], "{found:?} {real:?}");
            assert_eq!(found[1], real[1]);
        }
    }

    #[test]
    fn source_and_target_weigh_the_same_in_the_units() {
        let table = |value: f32, rows: usize| {
            let mut t = Transitions::new(1, 1);
            for i in 0..rows {
                let x = value + (i % 2) as f32 * 1e-3;
                t.push(&[x], &[0.0], 0.0, &[x], false, false);
            }
            t
        };
        let units = Units::fit(&table(0.0, 100), Some(&table(10.0, 10_000)), Target::Next);
        assert!((units.state.mean[0] - 5.0).abs() < 0.01 && (units.state.std[0] - 5.0).abs() < 0.01);
    }
}
