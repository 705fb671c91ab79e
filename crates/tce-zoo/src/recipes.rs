//! Recipes of data sets: which actors collect how many rows.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use tce_data::{Agent, Quality, Shift};

/// One actor's part of a data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Part {
    /// The policy's file, or `zoo:NAME`.
    pub actor: PathBuf,
    /// Its share of the rows, relative to the shares of the other parts.
    pub weight: f64,
}

/// How a data set is collected. Equal recipes give identical bytes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Recipe {
    /// The robot.
    pub agent: Agent,
    /// The domain.
    pub shift: Shift,
    /// The parts, collected one after the other: D4RL's medium-expert is medium, then expert.
    pub parts: Vec<Part>,
    /// Total number of rows.
    pub rows: usize,
    /// Whether mean actions are taken instead of sampled ones.
    pub mean: bool,
    /// Number of environments in lockstep.
    pub lanes: usize,
    /// The seed of all random numbers.
    pub seed: u64,
}

/// The actors of one robot in one domain; a part without actors is empty.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cast {
    /// D4RL's medium behaviour.
    pub medium: Vec<Part>,
    /// D4RL's expert behaviour.
    pub expert: Vec<Part>,
    /// The policies of a training run up to the medium level.
    pub replay: Vec<Part>,
}

/// Rows of a target set (OTDF).
pub const TARGET_ROWS: usize = 5000;

impl Cast {
    /// D4RL's source data of this quality: `rows` for medium or expert, twice as many for medium-expert, and for a
    /// replay buffer the same share as in D4RL. `None` if an actor is missing.
    pub fn source(self, agent: Agent, shift: Shift, quality: Quality, rows: usize, seed: u64) -> Option<Recipe> {
        let rows = match quality {
            Quality::Medium | Quality::Expert => rows,
            Quality::MediumExpert => 2 * rows,
            Quality::MediumReplay => {
                // D4RL's replay buffers hold 202k, 402k, 302k and 302k rows for 1M rows of medium data.
                let share = match agent {
                    Agent::HalfCheetah => 0.202,
                    Agent::Hopper => 0.402,
                    Agent::Walker2d | Agent::Ant => 0.302,
                };
                (rows as f64 * share) as usize
            }
        };
        let parts = self.parts(quality, [1.0, 1.0])?;
        Some(Recipe { agent, shift, parts, rows, mean: false, lanes: 32, seed })
    }

    /// A target set like OTDF's: [`TARGET_ROWS`] rows of whole episodes, except that the last is cut. Medium-expert is
    /// two parts of medium and three of expert, and its successors are the real ones. `None` if an actor is missing.
    pub fn target(self, agent: Agent, shift: Shift, quality: Quality, seed: u64) -> Option<Recipe> {
        let parts = self.parts(quality, [0.4, 0.6])?;
        // The seed differs from the source's; otherwise both sets would begin with the same noise.
        let seed = seed ^ u64::from_le_bytes(*b"target\0\0");
        // One lane only: with more, each lane would cut an episode.
        Some(Recipe { agent, shift, parts, rows: TARGET_ROWS, mean: false, lanes: 1, seed })
    }

    fn parts(self, quality: Quality, [medium, expert]: [f64; 2]) -> Option<Vec<Part>> {
        let scaled = |parts: Vec<Part>, share: f64| {
            let total: f64 = parts.iter().map(|p| p.weight).sum();
            parts.into_iter().map(move |p| Part { weight: p.weight * share / total, ..p }).collect::<Vec<_>>()
        };
        let needed = match quality {
            Quality::Medium => vec![scaled(self.medium, 1.0)],
            Quality::Expert => vec![scaled(self.expert, 1.0)],
            Quality::MediumReplay => vec![scaled(self.replay, 1.0)],
            Quality::MediumExpert => vec![scaled(self.medium, medium), scaled(self.expert, expert)],
        };
        needed.iter().all(|p| !p.is_empty()).then(|| needed.concat())
    }
}
