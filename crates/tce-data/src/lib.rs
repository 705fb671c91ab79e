//! Transitions: their form, reading and writing of files, comparison and selection.
//!
//! | question | answer |
//! |---|---|
//! | What is a data set? | [`Transitions`]: columns s, a, r, s', terminal, time-out; [`Rows`] views them as points |
//! | Where does it come from? | [`load`]: HDF5 in OTDF's or D4RL's layout, validated before use, with a [`LoadReport`] |
//! | And from memory? | [`from_columns`], with the same checks |
//! | Where does it go? | [`save_d4rl`]: D4RL's layout with `next_observations`, atomically |
//! | Which rows does the next row continue? | [`continued`] |
//! | What is in it? | [`inspect`], [`check`](check()), [`infer_agents`], [`ensure_same_agent`] |
//! | In which units does a network see it? | [`Standardizer`] |
//! | How good is a return? | [`reference_scores`], [`ReferenceScores::normalised_score`] |
//! | Which transfer problems are there? | [`Task`] |
//! | Which trajectories of a mixed set to learn from? | [`choose_trajectories`] |
//! | Which rows does a training not see? | [`hold_out_runs`], [`fold_of_runs`] |
//! | Which values can a row have at all? | [`Support`]: bounds, constants, flags, unit vectors |
//! | Which generated rows are outliers? | [`zscore_keep`] (Eq. 8) |
//! | Which source rows are close to the target? | [`nn_distances`] and [`lambda_quantile_select`] (Eq. 9), [`transport_costs`] (OTDF), [`density_scores`] (DmC) |
//!
//! Everything here is deterministic: the results are the same bytes at any number of threads.
//!
//! ```
//! use tce_data::{Agent, ScoreTable, Shift, Standardizer, Task, Transitions, reference_scores};
//!
//! // Two steps of a robot with one state and one action; the episode is cut after the second.
//! let mut log = Transitions::new(1, 1);
//! log.push(&[0.0], &[0.5], 1.0, &[2.0], false, false);
//! log.push(&[2.0], &[0.5], 1.0, &[4.0], false, true);
//! assert_eq!(log.len(), 2);
//!
//! // Standardised observations have mean 0 and spread 1.
//! let z = Standardizer::fit(&log.observations, log.obs_dim).apply(&log.observations);
//! assert_eq!(z, [-1.0, 1.0]);
//!
//! // 100 is the expert of the changed robot.
//! let task: Task = "hopper-morph/medium/expert".parse()?;
//! assert_eq!(task.with_arrow(), "hopper-morph:medium->expert");
//! let scores = reference_scores(Agent::Hopper, Shift::Morph, ScoreTable::Otdf).expect("a robot of the benchmark");
//! assert!(scores.normalised_score(0.0) < 1.0);
//! # Ok::<(), String>(())
//! ```

mod actions;
mod agents;
mod check;
pub mod density;
mod error;
pub mod files;
mod filter;
mod held_out;
mod inspect;
mod moments;
mod neighbours;
mod product;
mod quality;
mod reference;
mod rows;
mod standardise;
mod support;
mod task;
mod trajectories;
mod transitions;
mod transport;

pub use actions::ActionRange;
pub use agents::{AgentMismatch, ensure_same_agent, infer_agents};
pub use check::{Check, Finding, Severity, check};
pub use density::{DensityOptions, DensityScale, DensityScores, density_scores, further_scores};
pub use error::{DataError, Problem};
pub use files::{
    Columns, Dropped, EpisodeEnds, Layout, LoadOptions, LoadReport, Loaded, Successors, continued, from_columns, load,
    main_file, read_attributes, save_d4rl, save_minari,
};
pub use filter::{largest_z, zscore_keep};
pub use held_out::{fold_of_runs, hold_out_runs};
pub use inspect::{DimensionSummary, Inspection, Summary, inspect};
pub use neighbours::{NeighbourOptions, Units, lambda_quantile_select, nn_distances};
pub use quality::Quality;
pub use reference::{ReferenceScores, ScoreTable, Shift, reference_scores};
pub use rows::Rows;
pub use standardise::{RELATIVE_FLOOR, Standardizer, even_standardizer};
pub use support::{Bound, Clip, Constant, Levels, Support, UnitGroup};
pub use task::{Task, parse_agent, parse_environment};
pub use trajectories::{CLEAR_GAP, Choice, ENOUGH_ROWS, Measure, choose_trajectories, choose_trajectories_with};
pub use transitions::{Agent, Episode, Transitions};
pub use transport::{TransportOptions, transport_costs};
