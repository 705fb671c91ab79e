//! Whether to use the generated rows, in a sentence with the metrics that decide.
//!
//! | decides | do not use | use |
//! |---|---|---|
//! | score of the policy that the rows teach, beside the target data's | below by more than [`LOSS`] of it, for certain | not below by more than that, for certain |
//! | actions that the rows teach, at real states | no nearer to the behaviour's than its mean action | |
//! | coverage of the target's states | less than [`REACH`] of what a second sample of the target reaches | |
//! | steps beside the simulator's | off by more than [`STEP`] of a usual step | |
//! | copies | rows are copies of training rows | |
//!
//! One reason against the rows is enough. Without one, only the score of the policy speaks for them: all others are about single rows,
//! and possible rows may still teach a behaviour that nobody had ([`crate::implied`]). "For certain" means by [`SURE`] standard errors of the
//! mean over episodes; one episode has no such error, so that nothing is for certain. Where there is no such score, the data do not tell.
//!
//! That rows are good does not mean that a policy learns more from them than from the target rows alone. Only scores tell that.

use std::fmt;

use crate::diagnosis::Diagnosis;
use crate::implied::Implied;
use crate::memorisation;
pub use crate::numbers::percent;

/// The part of the target data's score that the policy of the rows may lose.
pub const LOSS: f64 = 0.1;
/// Standard errors of a mean that count as certain.
pub const SURE: f64 = 2.0;
/// The part of what a second sample of the target reaches that generated rows have to reach.
pub const REACH: f64 = 0.5;
/// Median error of a step, in usual steps, from which on rows are no steps of the target.
pub const STEP: f64 = 0.5;

/// What to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// The rows teach what the target data do.
    Use,
    /// Something speaks against them.
    DoNotUse,
    /// Nothing speaks against them, and nothing for them.
    NotTold,
}

/// What to do with the rows, and why.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Advice {
    /// What to do.
    pub answer: Answer,
    /// Why, as parts of a sentence.
    pub because: Vec<String>,
    /// What speaks for the rows where the data do not tell.
    pub besides: Vec<String>,
}

impl fmt::Display for Advice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let start = match self.answer {
            Answer::Use => "Use these rows",
            Answer::DoNotUse => "Do not use these rows",
            Answer::NotTold => "The data do not tell whether to use these rows",
        };
        write!(f, "{start}, because {}.", self.because.join("; "))?;
        match &self.besides[..] {
            [] => Ok(()),
            parts => write!(f, " Nothing else speaks against them: {}.", parts.join("; ")),
        }
    }
}

/// How the score of the policy that the rows teach compares.
enum Taught {
    Good(String),
    Bad(String),
    Unknown(String),
}

fn taught(implied: Option<&Implied>) -> Taught {
    let rollout = implied.and_then(|i| i.rollout.as_ref());
    let Some(rollout) = rollout else {
        return Taught::Unknown("the policy that they teach could not be tried without a simulator".into());
    };
    if let Some(why) = &rollout.failed {
        return Taught::Bad(format!("the policy that they teach cannot act to the end of an episode ({why})"));
    }
    let behaviour = implied.and_then(|i| i.behaviour_score);
    let (Some((mean, std)), Some(behaviour)) = (rollout.score, behaviour) else {
        return Taught::Unknown(
            "there are no reference returns by which to compare the policy that they teach with the target data".into(),
        );
    };
    let episodes = rollout.episodes;
    let count = if episodes == 1 { "one episode".to_owned() } else { format!("{episodes} episodes") };
    let clause = format!(
        "the policy that they teach scores {mean:.1} ± {std:.1} in {count}, beside the target data's {behaviour:.1}"
    );
    let (lost, error) = (behaviour - mean, SURE * std / (episodes as f64).sqrt());
    let allowed = LOSS * behaviour.abs();
    // The standard deviation of one episode is 0, which says nothing of other episodes.
    let several = episodes > 1;
    if several && lost - error > allowed {
        Taught::Bad(clause)
    } else if several && lost + error <= allowed {
        Taught::Good(clause)
    } else {
        Taught::Unknown(format!("{clause}, and this scatter leaves open whether it is worse"))
    }
}

impl Diagnosis {
    /// Whether to use the rows.
    pub fn advice(&self) -> Advice {
        let own = self.at_own_bound();
        let (mut against, mut good) = (Vec::new(), Vec::new());
        let taught = taught(self.implied.as_ref());
        match &taught {
            Taught::Bad(clause) => against.push(clause.clone()),
            Taught::Good(clause) => good.push(clause.clone()),
            Taught::Unknown(_) => {}
        }
        let actions = self.implied.as_ref().and_then(|i| i.actions.held_out.or(i.actions.trained));
        if let Some(a) = actions.filter(|a| a.single >= a.spread) {
            against.push(format!(
                "the actions that they teach are {:.2} away from the behaviour's, no nearer than its mean action would be ({:.2})",
                a.single, a.spread
            ));
        }
        if let (Some(c), Some(second)) = (own.and_then(|b| b.coverage), self.covered_by_target) {
            let clause = format!(
                "they reach {} of the target's states, and a second sample of the target itself reaches {}",
                percent(c.target),
                percent(second.target)
            );
            if c.target < REACH * second.target { against.push(clause) } else { good.push(clause) }
        }
        if let Some(s) = own.and_then(|b| b.kept.consistency) {
            let clause = format!(
                "their steps are {:.2} of a usual step away from the simulator's (0 is exact, 1 as wrong as a whole step)",
                s.median
            );
            if s.median > STEP { against.push(clause) } else { good.push(clause) }
        }
        if let Some(m) = own.and_then(|b| b.memorisation).filter(|m| m.verdict() == memorisation::Verdict::Copies) {
            against.push(format!(
                "they look like copies of training rows: in {} of the comparisons a generated row is nearer to a training row than a \
                 real row of another episode is (good: 50 %)",
                percent(m.probability)
            ));
        }
        match (against.is_empty(), taught) {
            (false, _) => Advice { answer: Answer::DoNotUse, because: against, besides: vec![] },
            (true, Taught::Unknown(why)) => Advice { answer: Answer::NotTold, because: vec![why], besides: good },
            (true, _) => Advice { answer: Answer::Use, because: good, besides: vec![] },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::implied::{ImpliedActions, ImpliedRollout};

    /// Beside a target of 90, so that 81 is enough.
    #[test]
    fn one_episode_is_certain_of_nothing() {
        let told = |mean: f64, std: f64, episodes: usize| {
            let rollout =
                ImpliedRollout { episodes, score: Some((mean, std)), returns: None, length: None, failed: None };
            let actions = ImpliedActions { trained: None, held_out: None };
            let implied = Implied { actions, rollout: Some(rollout), behaviour_score: Some(90.0) };
            match taught(Some(&implied)) {
                Taught::Good(_) => "good",
                Taught::Bad(_) => "bad",
                Taught::Unknown(_) => "unknown",
            }
        };
        assert_eq!([told(5.0, 0.0, 1), told(90.0, 0.0, 1)], ["unknown"; 2]);
        assert_eq!([told(5.0, 0.0, 2), told(90.0, 0.0, 2)], ["bad", "good"]);
        assert_eq!([told(78.0, 3.0, 10), told(80.0, 3.0, 10)], ["bad", "unknown"]);
    }
}
