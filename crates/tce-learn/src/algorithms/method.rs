//! Builds a learner from a configuration. There is one implementation per algorithm, in the algorithm's file.
//!
//! To add an algorithm, write a file with a configuration that implements [`Method`], and add a line to the registry
//! (`tce-run/src/learners.rs`).

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

/// Information about a learner, for `tce learn --list` and for checks before a training run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct About {
    /// Its name on the command line and in `learner.algorithm`.
    pub name: &'static str,
    /// Its name in tables.
    #[serde(skip)]
    pub title: &'static str,
    /// A description in one line.
    pub description: &'static str,
    /// The reference for the method.
    pub reference: &'static str,
    /// How `mode = "published"` differs; `None` if the method has only one form.
    pub published: Option<&'static str>,
    /// The table of its configuration keys.
    pub table: &'static str,
    /// Requirements on the rows other than the target's.
    pub needs: OtherRows,
    /// Whether it uses episodes, so that rows must be in order.
    #[serde(skip)]
    pub episodes: bool,
    /// The scores by which it selects other rows.
    #[serde(skip)]
    pub scores: RowScores,
}

/// The scores of other rows that a learner gets ([`crate::Member::row_scores`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RowScores {
    /// No scores.
    None,
    /// The negative cost of transport to the target's rows.
    Transport,
    /// DmC's density-ratio scores.
    Density,
}

/// Which rows a policy is learned from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum LearnedRows {
    /// The target's alone.
    Target,
    /// The target's, and others: source or generated rows.
    Mixed,
}

impl LearnedRows {
    /// The target's, and `others` if there are any.
    pub fn with<T>(others: Option<&T>) -> Self {
        if others.is_some() { Self::Mixed } else { Self::Target }
    }
}

/// Requirements on the rows other than the target's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OtherRows {
    /// No requirements: any rows, or none.
    Any,
    /// They must be source rows, because the learner compares the domains.
    Source,
    /// They must have scores.
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

/// Inputs from which a learner is built, in addition to its own configuration.
#[derive(Clone, Copy)]
pub struct Setup<'a> {
    /// Members and batches.
    pub buffer: &'a Buffer,
    /// Training steps.
    pub steps: u64,
    /// The IQL configuration on which several methods are based.
    pub iql: &'a IqlConfig,
    /// The model of the target's behaviour, for regularisers.
    pub behaviour: &'a RegulariserConfig,
    /// Where checkpoints of preparations (training before the first step) are stored.
    pub place: Place<'a>,
    /// The device that computes the networks.
    pub device: &'a Device,
}

impl Setup<'_> {
    /// The regulariser of `method`. If it needs training, it is trained now. `None` if the user interrupted this.
    ///
    /// # Errors
    /// If the configuration cannot be used, or a checkpoint cannot be read or written.
    pub fn regulariser(&self, method: &dyn Method) -> Result<Option<Regulariser>, LearnError> {
        let kind = method.backbone(self.iql).map_or(Default::default(), |iql| iql.regulariser);
        Regulariser::prepare(kind, self.buffer, &method.behaviour(self.behaviour), self.place, self.device)
    }
}

/// The result of [`Method::build`]: a learner, or `None` if the user interrupted its preparation.
pub type Built = Result<Option<Box<dyn PolicyLearner>>, LearnError>;

/// The configuration of an algorithm, from which a learner can be built.
pub trait Method {
    /// Information about the method.
    fn about(&self) -> About;

    /// Returns an error for numbers out of range.
    ///
    /// # Errors
    /// The error names the field.
    fn check(&self) -> Result<(), LearnError>;

    /// Builds a learner before its first step. Models that it needs are trained here.
    ///
    /// # Errors
    /// If the configuration or the data cannot be used.
    fn build(&self, on: &Setup<'_>) -> Built;

    /// Whether it is trained as in its public code or as in its paper; `None` if the method has only one form.
    fn mode(&self) -> Option<Mode> {
        None
    }

    /// The IQL configuration that it derives from `iql`, if it is based on IQL.
    fn backbone(&self, iql: &IqlConfig) -> Option<IqlConfig> {
        let _ = iql;
        None
    }

    /// The configuration of the behaviour model that it derives from `base`.
    fn behaviour(&self, base: &RegulariserConfig) -> RegulariserConfig {
        base.clone()
    }

    /// Number of training steps on `rows`, where `steps` were asked for.
    fn steps(&self, steps: u64, rows: LearnedRows) -> u64 {
        let _ = rows;
        steps
    }

    /// The step from which on only target rows are learned from, of `steps`; None: other rows are, to the end.
    fn fade(&self, steps: u64) -> Option<u64> {
        let _ = steps;
        None
    }

    /// Rows of each update, where `batch` were asked for.
    fn batch(&self, batch: usize) -> usize {
        batch
    }
}
