//! Quality of the policy that collected a data set.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use tce_base::did_you_mean;

/// The quality of a benchmark data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quality {
    /// A policy whose training stopped at about a third of the expert's return. "m" in the paper's tables.
    Medium,
    /// The replay buffer of training up to the medium policy (source data only). "m-r".
    MediumReplay,
    /// Medium and expert data, concatenated. "m-e".
    MediumExpert,
    /// The fully trained policy. "e".
    Expert,
}

impl Quality {
    /// All qualities, in the order of the paper's source columns, then its target columns.
    pub const ALL: [Quality; 4] = [Quality::Medium, Quality::MediumReplay, Quality::MediumExpert, Quality::Expert];

    /// The name used in task names: `medium-replay`.
    pub fn name(self) -> &'static str {
        match self {
            Quality::Medium => "medium",
            Quality::MediumReplay => "medium-replay",
            Quality::MediumExpert => "medium-expert",
            Quality::Expert => "expert",
        }
    }
}

impl fmt::Display for Quality {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Quality {
    type Err = String;

    /// Parses `medium-replay`, `medium_replay` (file names) and the paper's `m-r`.
    fn from_str(text: &str) -> Result<Self, String> {
        match text.replace('_', "-").as_str() {
            "medium" | "m" => Ok(Quality::Medium),
            "medium-replay" | "m-r" => Ok(Quality::MediumReplay),
            "medium-expert" | "m-e" => Ok(Quality::MediumExpert),
            "expert" | "e" => Ok(Quality::Expert),
            _ => {
                let hint = did_you_mean(text, Quality::ALL.map(Quality::name));
                Err(format!(
                    "`{text}` is no data quality; expected medium, medium-replay, medium-expert or expert{hint}"
                ))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip() {
        for quality in Quality::ALL {
            assert_eq!(quality.to_string().parse::<Quality>(), Ok(quality));
            assert_eq!(serde_json::to_string(&quality).unwrap(), format!("\"{quality}\""));
        }
        assert_eq!("medium_expert".parse(), Ok(Quality::MediumExpert));
        assert_eq!("m-r".parse(), Ok(Quality::MediumReplay));
        assert!("best".parse::<Quality>().unwrap_err().contains("`best`"));
    }
}
