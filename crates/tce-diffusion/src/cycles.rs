//! Cycles of a training until done ([`crate::until_done`]): when they end, and what was found at their ends.

use std::path::Path;

use serde::{Deserialize, Deserializer, Serialize};
use tce_nn::{NamedParameters, NetworkError};

use crate::DiffusionError;

/// Prefix of the best networks in a training's state.
const BEST: &str = "best/";
/// Key of the cycles' ends in the metadata of a training's state.
const ENDS: &str = "until_done";

/// When a training is done: after a cosine cycle that lowers the criterion by less than `gain`, or at the `limit`. Cycle k takes
/// `first` · 2ᵏ steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct UntilDone {
    /// Steps of the first cycle.
    pub first: u64,
    /// Steps that all cycles together may take.
    pub limit: u64,
    /// Share by which the criterion has to fall in a cycle for another one to follow; below zero, it may rise by so much.
    pub gain: f64,
}

impl Default for UntilDone {
    fn default() -> Self {
        Self { first: 7_500, limit: 120_000, gain: 0.1 }
    }
}

impl UntilDone {
    /// Refuses numbers that cannot be meant.
    ///
    /// # Errors
    /// Names the field.
    pub fn check(&self) -> Result<(), DiffusionError> {
        if self.first == 0 {
            return Err(DiffusionError::input("first", 0, "at least 1 step"));
        }
        if self.limit < self.first {
            return Err(DiffusionError::input("limit", self.limit, format!("at least `first`, {}", self.first)));
        }
        if !(self.gain < 1.0 && self.gain.is_finite()) {
            return Err(DiffusionError::input("gain", self.gain, "less than 1"));
        }
        Ok(())
    }

    /// The steps at which cycles end, as far as the limit allows.
    pub fn ends(&self) -> Vec<u64> {
        let end = |k: u32| self.first.saturating_mul((1u64 << k) - 1);
        (1..40).map(end).take_while(|&end| end <= self.limit).collect()
    }

    /// Whether a member whose criteria were `before` at the earlier ends is done with `now`. A criterion that is no number ends
    /// the training, too.
    pub(crate) fn done(&self, before: &[f64], now: f64) -> bool {
        let best = before.iter().copied().fold(f64::INFINITY, f64::min);
        !before.is_empty() && (now.is_nan() || now > (1.0 - self.gain) * best)
    }
}

/// What was measured at the end of a cycle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CycleEnd {
    /// Steps since the beginning.
    pub step: u64,
    /// The criterion of every member; no number where the member has diverged.
    #[serde(deserialize_with = "or_nan")]
    pub criterion: Vec<f64>,
}

/// Reads numbers that JSON has as `null` where they were not finite: those of a member that diverged after it was done.
///
/// # Errors
/// If they are no list of numbers.
pub fn or_nan<'de, T, D>(from: D) -> Result<Vec<T>, D::Error>
where
    T: Deserialize<'de> + From<f32>,
    D: Deserializer<'de>,
{
    let numbers: Vec<Option<T>> = Deserialize::deserialize(from)?;
    Ok(numbers.into_iter().map(|number| number.unwrap_or_else(|| T::from(f32::NAN))).collect())
}

/// What a training until done has found so far.
#[derive(Clone, Debug, Default)]
pub(crate) struct Found {
    pub(crate) ends: Vec<CycleEnd>,
    /// The networks to be returned, all members.
    pub(crate) best: NamedParameters,
}

impl Found {
    /// Adds what was found to the state of a training.
    pub(crate) fn keep(&self, state: &mut NamedParameters) {
        if self.ends.is_empty() {
            return;
        }
        state.tensors.extend(self.best.tensors.iter().map(|(name, t)| (format!("{BEST}{name}"), t.clone())));
        // As bits: a criterion may be no number, for which JSON has no word.
        let bits: Vec<_> =
            self.ends.iter().map(|e| (e.step, e.criterion.iter().map(|c| c.to_bits()).collect())).collect();
        let text = serde_json::to_string::<Vec<(u64, Vec<u64>)>>(&bits).expect("plain numbers");
        state.metadata.insert(ENDS.to_owned(), text);
    }

    /// What [`Found::keep`] added, nothing if nothing was.
    pub(crate) fn restored(state: &NamedParameters, path: &Path) -> Result<Self, DiffusionError> {
        let Some(text) = state.metadata.get(ENDS) else { return Ok(Self::default()) };
        let bits: Vec<(u64, Vec<u64>)> = serde_json::from_str(text)
            .map_err(|e| NetworkError::Format { path: path.to_owned(), reason: format!("metadata '{ENDS}': {e}") })?;
        let ends =
            bits.into_iter().map(|(step, c)| CycleEnd { step, criterion: c.into_iter().map(f64::from_bits).collect() });
        Ok(Self { ends: ends.collect(), best: state.under(BEST) })
    }

    /// The criteria of member `m` so far.
    pub(crate) fn criteria(&self, m: usize) -> Vec<f64> {
        self.ends.iter().map(|e| e.criterion[m]).collect()
    }

    /// The members that were done before the last end or at it.
    pub(crate) fn done(&self, plan: &UntilDone) -> Vec<bool> {
        let members = self.ends.first().map_or(0, |e| e.criterion.len());
        let done = |m| {
            let criteria = self.criteria(m);
            (0..criteria.len()).any(|k| plan.done(&criteria[..k], criteria[k]))
        };
        (0..members).map(done).collect()
    }

    /// Takes the end of a cycle: the networks `now` of the members that are not done yet and have become better.
    pub(crate) fn take(&mut self, plan: &UntilDone, end: CycleEnd, now: NamedParameters) {
        let before = self.done(plan);
        if self.ends.is_empty() {
            self.best = now;
        } else {
            for (m, &c) in end.criterion.iter().enumerate() {
                let better = self.criteria(m).iter().all(|&earlier| c < earlier);
                if better && !before[m] {
                    for (name, (shape, values)) in &mut self.best.tensors {
                        let size = values.len() / shape[0];
                        values[m * size..][..size].copy_from_slice(&now.tensors[name].1[m * size..][..size]);
                    }
                }
            }
        }
        self.ends.push(end);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_of_cycles_survive_json_whatever_was_measured() {
        let end = CycleEnd { step: 7, criterion: vec![0.5, f64::NAN] };
        let back: CycleEnd = serde_json::from_str(&serde_json::to_string(&end).unwrap()).unwrap();
        assert_eq!((back.step, back.criterion[0]), (7, 0.5));
        assert!(back.criterion.len() == 2 && back.criterion[1].is_nan());
        assert!(serde_json::from_str::<CycleEnd>(r#"{"step":7,"criterion":["x"]}"#).is_err());
    }
}
