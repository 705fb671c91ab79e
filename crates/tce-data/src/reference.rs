//! The shifts of the benchmark, and the reference returns with scores 0 and 100.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use tce_base::did_you_mean;

use crate::Agent;

/// The difference between the target domain and the source domain.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Shift {
    /// The unchanged robot (gym's v2 models).
    #[serde(rename = "source")]
    Source,
    /// Limbs of different lengths or radii.
    #[serde(rename = "morph")]
    Morph,
    /// A joint that can hardly move.
    #[serde(rename = "kinematic")]
    Kinematic,
    /// Half the gravity.
    #[serde(rename = "gravity")]
    Gravity,
    /// Five times the gravity (ODRL).
    #[serde(rename = "gravity-5")]
    Gravity5,
}

impl Shift {
    /// All shifts.
    pub const ALL: [Shift; 5] = [Shift::Source, Shift::Morph, Shift::Kinematic, Shift::Gravity, Shift::Gravity5];

    /// The name used in task names.
    pub fn name(self) -> &'static str {
        match self {
            Shift::Source => "source",
            Shift::Morph => "morph",
            Shift::Kinematic => "kinematic",
            Shift::Gravity => "gravity",
            Shift::Gravity5 => "gravity-5",
        }
    }

    /// The name used in OTDF's and ODRL's file names (`ant_gravity_0.5_medium.hdf5`).
    pub fn file_name(self) -> &'static str {
        match self {
            Shift::Gravity => "gravity_0.5",
            Shift::Gravity5 => "gravity_5.0",
            other => other.name(),
        }
    }
}

impl fmt::Display for Shift {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Shift {
    type Err = String;

    /// Parses [`Shift::name`] and [`Shift::file_name`].
    fn from_str(text: &str) -> Result<Self, String> {
        Shift::ALL.into_iter().find(|s| s.name() == text || s.file_name() == text).ok_or_else(|| {
            let hint = did_you_mean(text, Shift::ALL.map(Shift::name));
            format!("`{text}` is no shift; expected source, morph, kinematic, gravity or gravity-5{hint}")
        })
    }
}

/// Whose reference returns to use. They differ for Walker2d, and in the digits printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ScoreTable {
    /// OTDF's and ODRL's own programs: what published scores were computed with.
    #[default]
    Otdf,
    /// Table C.2 of the paper, as printed.
    Paper,
}

/// The returns of a random and of an expert policy.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReferenceScores {
    /// J_r: the return with score 0.
    pub min: f64,
    /// J_e: the return with score 100.
    pub max: f64,
}

impl ReferenceScores {
    /// 100 (J - J_r) / (J_e - J_r) for an undiscounted episode return J (the paper's NS, Appendix C).
    pub fn normalised_score(&self, episode_return: f64) -> f64 {
        100.0 * (episode_return - self.min) / (self.max - self.min)
    }
}

/// The reference returns of `agent` under `shift`: D4RL's for the source domain (in either table), those of `table` for
/// the three shifts, ODRL's for Ant under five times the gravity. `None` for the other three agents: none are
/// published.
pub fn reference_scores(agent: Agent, shift: Shift, table: ScoreTable) -> Option<ReferenceScores> {
    use Agent::*;
    use Shift::*;
    let otdf_min = match agent {
        HalfCheetah => -280.178953,
        Hopper => -26.3360015397715,
        Walker2d => 10.079455055289959,
        Ant => -325.6,
    };
    let (min, max) = match (shift, table, agent) {
        (Source, _, HalfCheetah) => (-280.178953, 12135.0),
        (Source, _, Hopper) => (-20.272305, 3234.3),
        (Source, _, Walker2d) => (1.629008, 4592.3),
        (Source, _, Ant) => (-325.6, 3879.7),
        (Gravity5, _, Ant) => (-325.6, 6226.89),
        (Gravity5, _, _) => return None,
        (Morph, _, HalfCheetah) => (otdf_min, 9713.59),
        (Morph, _, Hopper) => (otdf_min, 3152.75),
        (Morph, _, Walker2d) => (otdf_min, 4398.43),
        (Morph, _, Ant) => (otdf_min, 5722.01),
        (Kinematic, _, HalfCheetah) => (otdf_min, 7065.03),
        (Kinematic, _, Hopper) => (otdf_min, 2842.73),
        (Kinematic, _, Walker2d) => (otdf_min, 3257.51),
        (Kinematic, _, Ant) => (otdf_min, 5122.57),
        (Gravity, _, HalfCheetah) => (otdf_min, 9509.15),
        (Gravity, _, Hopper) => (otdf_min, 3234.3),
        (Gravity, ScoreTable::Otdf, Walker2d) => (otdf_min, 5194.713),
        (Gravity, ScoreTable::Paper, Walker2d) => (otdf_min, 5154.71),
        (Gravity, ScoreTable::Otdf, Ant) => (otdf_min, 4317.065),
        (Gravity, ScoreTable::Paper, Ant) => (otdf_min, 4317.07),
    };
    let min = match (table, shift, agent) {
        (ScoreTable::Paper, Morph | Kinematic | Gravity, HalfCheetah) => -280.18,
        (ScoreTable::Paper, Morph | Kinematic | Gravity, Hopper) => -26.34,
        (ScoreTable::Paper, Morph | Kinematic | Gravity, Walker2d) => 10.8,
        _ => min,
    };
    Some(ReferenceScores { min, max })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip() {
        for shift in Shift::ALL {
            assert_eq!(shift.to_string().parse::<Shift>(), Ok(shift));
            assert_eq!(shift.file_name().parse::<Shift>(), Ok(shift));
            assert_eq!(serde_json::to_string(&shift).unwrap(), format!("\"{shift}\""));
        }
        assert!("gravity-2".parse::<Shift>().unwrap_err().contains("`gravity-2`"));
    }

    #[test]
    fn random_scores_0_and_expert_100() {
        for agent in Agent::ALL {
            for shift in Shift::ALL {
                for table in [ScoreTable::Otdf, ScoreTable::Paper] {
                    let Some(r) = reference_scores(agent, shift, table) else {
                        assert!(shift == Shift::Gravity5 && agent != Agent::Ant);
                        continue;
                    };
                    assert!(r.min < r.max);
                    assert_eq!(r.normalised_score(r.min), 0.0);
                    assert!((r.normalised_score(r.max) - 100.0).abs() < 1e-12);
                }
            }
        }
    }

    /// D4RL publishes both the returns and the normalised scores of its data: 4770.3 is 40.7 for halfcheetah-medium.
    #[test]
    fn a_published_pair_is_reproduced() {
        let r = reference_scores(Agent::HalfCheetah, Shift::Source, ScoreTable::Otdf).unwrap();
        assert!((r.normalised_score(4770.3) - 40.68).abs() < 0.01);
    }

    #[test]
    fn the_tables_differ_where_they_are_known_to() {
        let walker = |table| reference_scores(Agent::Walker2d, Shift::Gravity, table).unwrap();
        assert_eq!(walker(ScoreTable::Otdf), ReferenceScores { min: 10.079455055289959, max: 5194.713 });
        assert_eq!(walker(ScoreTable::Paper), ReferenceScores { min: 10.8, max: 5154.71 });
        let source = |table| reference_scores(Agent::Walker2d, Shift::Source, table);
        assert_eq!(source(ScoreTable::Otdf), source(ScoreTable::Paper));
    }
}
