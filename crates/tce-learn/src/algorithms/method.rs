//! What makes a learner of a configuration: one implementation an algorithm, in the algorithm's file.
//!
//! A further algorithm is a file with a configuration that implements [`Method`], and a line in the registry (`tce-run/src/learners.rs`).

use std::fmt;

use serde::Serialize;
use tce_nn::Device;

use crate::buffer::Buffer;
use crate::error::LearnError;
use crate::iql_config::IqlConfig;
use crate::mode::Mode;
use crate::policy::PolicyLearner;
use crate::regulariser::{Regulariser, RegulariserConfig};
use crate::training::Place;

/// A learner, as `tce learn --list` prints it and as checks before a training ask for it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct About {
    /// Its name on the command line and in `learner.algorithm`.
    pub name: &'static str,
    /// Its name in tables.
    #[serde(skip)]
    pub title: &'static str,
    /// One line.
    pub description: &'static str,
    /// Whose it is.
    pub reference: &'static str,
    /// How `mode = "published"` differs; none where there is one form.
    pub published: Option<&'static str>,
    /// The table of its keys.
    pub table: &'static str,
    /// What the rows besides the target's must have.
    pub needs: OtherRows,
    /// Whether it looks at s' of terminal rows: it models the dynamics, or compares transitions of two domains.
    #[serde(skip)]
    pub successors: bool,
    /// Whether it follows episodes, so that rows must be in order.
    #[serde(skip)]
    pub episodes: bool,
    /// By which numbers it chooses among other rows.
    #[serde(skip)]
    pub scores: RowScores,
}

/// The numbers of other rows that a learner gets ([`crate::Member::row_scores`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RowScores {
    /// None.
    None,
    /// The negated cost of transport to the target's rows.
    Transport,
    /// DmC's density-ratio scores.
    Density,
}

/// What the rows besides the target's must have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OtherRows {
    /// Nothing: any rows, or none.
    Any,
    /// They are the source's: the learner compares the domains.
    Source,
    /// They have scores.
    Scored,
}

impl fmt::Display for OtherRows {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            OtherRows::Any => "any rows, or none",
            OtherRows::Source => "source rows",
            OtherRows::Scored => "source rows, or rows of mixture.generated = \"dmc\"",
        })
    }
}

impl Serialize for OtherRows {
    fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(self)
    }
}

/// What a learner is made from, besides its own configuration.
#[derive(Clone, Copy)]
pub struct Setup<'a> {
    /// Members and batches.
    pub buffer: &'a Buffer,
    /// Training steps.
    pub steps: u64,
    /// The IQL that several methods stand on.
    pub iql: &'a IqlConfig,
    /// The model of the target's behaviour, for regularisers.
    pub behaviour: &'a RegulariserConfig,
    /// Where checkpoints of what is trained before the first step are kept.
    pub place: Place<'a>,
    /// What computes the networks.
    pub device: &'a Device,
}

impl Setup<'_> {
    /// The regulariser of `method`, trained now where it has to be. None if the user interrupted it.
    ///
    /// # Errors
    /// If the configuration cannot be used, or a checkpoint cannot be read or written.
    pub fn regulariser(&self, method: &dyn Method) -> Result<Option<Regulariser>, LearnError> {
        let kind = method.backbone(self.iql).map_or(Default::default(), |iql| iql.regulariser);
        Regulariser::prepare(kind, self.buffer, &method.behaviour(self.behaviour), self.place, self.device)
    }
}

/// What [`Method::build`] gives: a learner, or None if the user interrupted what is trained before.
pub type Built = Result<Option<Box<dyn PolicyLearner>>, LearnError>;

/// The configuration of an algorithm, of which a learner can be made.
pub trait Method {
    /// What it is.
    fn about(&self) -> About;

    /// Refuses numbers out of range.
    ///
    /// # Errors
    /// Names the field.
    fn check(&self) -> Result<(), LearnError>;

    /// A learner before its first step; what it needs for that is trained here.
    ///
    /// # Errors
    /// If the configuration or the data cannot be used.
    fn build(&self, on: &Setup<'_>) -> Built;

    /// Whether it is trained as its public code has it, where that differs from its paper; None where there is one form.
    fn mode(&self) -> Option<Mode> {
        None
    }

    /// The IQL that it makes of `iql`, where it stands on it.
    fn backbone(&self, iql: &IqlConfig) -> Option<IqlConfig> {
        let _ = iql;
        None
    }

    /// The behaviour model that it makes of `base`.
    fn behaviour(&self, base: &RegulariserConfig) -> RegulariserConfig {
        base.clone()
    }

    /// Training steps of the `steps` that were asked for, by whether there are rows besides the target's.
    fn steps(&self, steps: u64, mixed: bool) -> u64 {
        let _ = mixed;
        steps
    }

    /// Rows of each update, where `batch` were asked for.
    fn batch(&self, batch: usize) -> usize {
        batch
    }
}
