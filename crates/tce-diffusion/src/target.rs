//! What the transition score network generates.

use serde::{Deserialize, Serialize};

/// The row that stands for s' given s.
///
/// Hopper moves some dimensions by 3-4 % of their spread per step: generating the difference puts the network's error on
/// the scale of the step instead of the scale of the state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Target {
    /// s' itself, as the paper has it.
    Next,
    /// s' − s.
    #[default]
    Delta,
}

impl Target {
    /// The rows to train on, from rows s and s' in physical units; standardise the result by its own moments.
    ///
    /// # Panics
    /// If the two have different lengths.
    pub fn encode(self, state: &[f32], next: &[f32]) -> Vec<f32> {
        assert_eq!(state.len(), next.len(), "one next state per state");
        match self {
            Target::Next => next.to_vec(),
            Target::Delta => next.iter().zip(state).map(|(n, s)| n - s).collect(),
        }
    }

    /// s' from generated rows in physical units; in place.
    ///
    /// # Panics
    /// If the two have different lengths.
    pub fn decode(self, state: &[f32], generated: &mut [f32]) {
        assert_eq!(state.len(), generated.len(), "one generated row per state");
        if self == Target::Delta {
            generated.iter_mut().zip(state).for_each(|(g, s)| *g += s);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decoding_undoes_encoding() {
        let (s, n) = ([1.0, -2.0], [1.5, 4.0]);
        for target in [Target::Next, Target::Delta] {
            let mut rows = target.encode(&s, &n);
            target.decode(&s, &mut rows);
            assert_eq!(rows, n);
        }
        assert_eq!(Target::Delta.encode(&s, &n), [0.5, 6.0]);
    }
}
