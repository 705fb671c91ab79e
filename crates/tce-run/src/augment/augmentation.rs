//! Generated rows of a run, and what is told of them.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tce_data::Transitions;
use tce_learn::LabelErrors;

use crate::error::Result;
use crate::stage::{Attempt, Stage};

/// What generating rows leaves behind, per member.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Generated {
    /// The file in the stage.
    pub file: String,
    /// Rows sampled.
    pub sampled: usize,
    /// Rows that passed the filter.
    pub kept: usize,
    /// Share of inferred action components outside of the box, before clipping.
    pub outside_box: f64,
    /// Share of terminal rows.
    pub terminal: f64,
    /// Network evaluations per row, both stages of sampling together.
    pub evaluations: usize,
    /// Errors of the member's label models on held-out target rows.
    pub labels: Option<LabelErrors>,
}

/// Generated tables, one per member, and where they are.
pub struct Augmentation {
    /// The tables.
    pub tables: Vec<Arc<Transitions>>,
    /// A score per row, where the rows have any ([`super::single_stage`]).
    pub scores: Vec<Option<Arc<Vec<f32>>>>,
    /// What was noticed.
    pub reports: Vec<Generated>,
    /// The stage with the files.
    pub stage: Stage,
}

impl Augmentation {
    /// Puts the files into `attempt`, too; returns their names.
    ///
    /// # Errors
    /// If a file can neither be linked nor copied.
    pub fn link_into(&self, attempt: &Attempt) -> Result<Vec<String>> {
        let link = |report: &Generated| {
            attempt.link(&self.stage.file(&report.file), &report.file)?;
            Ok(report.file.clone())
        };
        self.reports.iter().map(link).collect()
    }
}
