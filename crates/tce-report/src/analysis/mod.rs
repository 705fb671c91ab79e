//! From runs to the figures of the report. Everything that is printed, drawn or warned about is decided here.

use serde::Serialize;
use tce_data::{Shift, Task};

use crate::error::{ReportError, Result};
use crate::folder::Verdict;
use crate::paper::{self, PaperTable, Printed};
use crate::stats::{Bootstrap, Draw, Estimate, Scores};
use crate::study::{Method, Run, Study, order};

mod analyse;
mod compare;
mod effects;
mod opening;
mod recipes;
mod recommended;
mod warnings;

pub use analyse::analyse;
pub use effects::Gap;
pub use opening::{gap_words, opening, verdict_words};
pub use recipes::{Recipes, thousands};
pub use recommended::Recommendation;

/// A diverged policy counts as much as a random one. Left out, it would flatter its method.
pub const DIVERGED: f64 = 0.0;
/// The score that the optimality gap is measured from: the expert's.
pub const GAMMA: f64 = 100.0;
/// With fewer seeds a resample has too few values to draw from.
const ENOUGH_SEEDS: usize = 5;

/// How figures are computed.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Resamples of the bootstrap.
    pub resamples: usize,
    /// The intervals' coverage.
    pub level: f64,
    /// Seed of the resampling.
    pub seed: u64,
}

impl Default for Options {
    fn default() -> Self {
        Self { resamples: 10_000, level: 0.95, seed: 0 }
    }
}

/// A task's scores under one method.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Cell {
    /// Mean over seeds.
    pub mean: f64,
    /// Standard deviation over seeds, of a sample; none for one seed.
    pub std: Option<f64>,
    /// Seeds.
    pub seeds: usize,
    /// How many of them diverged and count as [`DIVERGED`].
    pub diverged: usize,
    /// Whether no other method of ours has a higher mean.
    pub best: bool,
    /// Whether the mean is above that of every baseline of this task; None for baselines and where there are none.
    pub above_baselines: Option<bool>,
}

/// A sum or a mean over tasks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Total {
    /// Sum over tasks of the mean over seeds, or interquartile mean of all runs.
    #[serde(flatten)]
    pub estimate: Estimate,
    /// Tasks in it.
    pub tasks: usize,
}

/// A method of ours beside the paper's figures for it, on the tasks that have both.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Against {
    /// Place among the methods.
    pub method: usize,
    /// The paper's name for it.
    pub paper_method: String,
    /// Ours.
    pub ours: Total,
    /// The paper's sum over the same tasks.
    pub paper: f64,
}

/// A task's line.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// The task.
    pub task: Task,
    /// By method; None where there is no score.
    pub cells: Vec<Option<Cell>>,
    /// By column of the paper's table.
    pub paper: Vec<Option<Printed>>,
}

/// All tasks of one shift.
#[derive(Clone, Debug, Serialize)]
pub struct ShiftTable {
    /// The shift.
    pub shift: Shift,
    /// Tasks.
    pub rows: Vec<Row>,
    /// By method.
    pub totals: Vec<Option<Total>>,
    /// Interquartile means over the same tasks, by method.
    pub iqms: Vec<Option<Total>>,
    /// The paper's table.
    #[serde(skip)]
    pub paper: Option<&'static PaperTable>,
    /// Sum of the paper's figures over this table's tasks, and how many tasks have one, by column.
    pub paper_totals: Vec<(f64, usize)>,
    /// Ours beside the paper's.
    pub against: Vec<Against>,
    /// Why ours and the paper's may not be comparable; None where nothing speaks against it.
    pub doubt: Option<String>,
}

/// Statistics of one method over the compared tasks.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Aggregate {
    /// Place among the methods.
    pub method: usize,
    /// Runs.
    pub runs: usize,
    /// Fewest and most seeds of a task.
    pub seeds: (usize, usize),
    /// Interquartile mean, median, mean, optimality gap, with intervals over seeds.
    pub over_seeds: [Estimate; 4],
    /// The same with intervals over tasks and seeds.
    pub over_tasks: [Estimate; 4],
    /// Sum over tasks of the mean over seeds.
    pub total: Estimate,
    /// Mean over tasks of its place among the methods by the mean over seeds; 1 is the best, equal ones share their places.
    pub rank: f64,
    /// Share of runs above every threshold of the comparison.
    #[serde(skip)]
    pub profile: Vec<Estimate>,
    /// Probability that a run of it scores higher than a run of each baseline of the comparison; None for baselines.
    pub over_baselines: Option<Vec<Estimate>>,
    /// How likely a difference as large as that to the best baseline is by chance alone (permutation test); None for baselines.
    pub p_value: Option<f64>,
}

/// Methods on the tasks that all of them have.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// The tasks.
    pub tasks: Vec<Task>,
    /// Methods, in the order of the study.
    pub methods: Vec<Aggregate>,
    /// Methods that lack too many tasks, by place.
    pub left_out: Vec<usize>,
    /// Baselines in it, by place among the methods.
    pub baselines: Vec<usize>,
    /// The baseline with the highest interquartile mean, by place in `baselines`.
    pub best_baseline: Option<usize>,
    /// The intervals' coverage.
    pub level: f64,
    /// Where the performance profiles are computed.
    #[serde(skip)]
    pub thresholds: Vec<f64>,
}

/// What can be said of a method against the best baseline.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Finding {
    /// The interval lies above one half, and chance alone seldom does that.
    Better,
    /// The interval lies below one half, and chance alone seldom does that.
    Worse,
    /// The interval holds one half.
    Open,
    /// The interval lies on one side of one half, but with so few runs chance alone often does that.
    Few,
    /// There is one seed, and so no interval.
    Unknown,
}

impl Finding {
    /// In a table.
    pub fn word(self) -> &'static str {
        match self {
            Finding::Better => "beats it",
            Finding::Worse => "falls short",
            Finding::Open => "not proved",
            Finding::Few => "too few runs",
            Finding::Unknown => "one seed",
        }
    }
}

/// Something a reader must know before believing a figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Warning {
    /// In one sentence or two.
    pub text: String,
    /// Single cases.
    pub details: Vec<String>,
}

/// All figures of a report.
#[derive(Clone, Debug, Serialize)]
pub struct Analysis {
    /// The study's name.
    pub name: String,
    /// Columns.
    pub methods: Vec<Method>,
    /// Whether a method's runs have published, bug-compatible behaviour.
    pub published: Vec<bool>,
    /// Shifts.
    pub tables: Vec<ShiftTable>,
    /// Methods beside each other; None without a score.
    pub comparison: Option<Comparison>,
    /// Methods beside the best baseline, task by task.
    pub gaps: Vec<Gap>,
    /// Presets and learner updates of the runs.
    pub recipes: Recipes,
    /// What the recommended policies came to.
    pub recommendations: Vec<Recommendation>,
    /// What a reader must know.
    pub warnings: Vec<Warning>,
    /// The intervals' coverage.
    pub level: f64,
    /// Resamples behind them.
    pub resamples: usize,
}

impl Analysis {
    /// Whether a table has to say that method `m` is published behaviour, because its title does not.
    pub fn needs_mark(&self, m: usize) -> bool {
        self.published[m] && !self.methods[m].title.contains("(published)")
    }
}

/// What a policy counts for that has this score, if it has one, or that [diverged](DIVERGED).
pub fn counts_for(score: Option<f64>, diverged: bool) -> Option<f64> {
    score.or(diverged.then_some(DIVERGED))
}

/// What a run counts for.
pub fn score(run: &Run) -> Option<f64> {
    match run.member.verdict {
        Verdict::Score(score) => Some(score),
        Verdict::Diverged(_) => counts_for(None, true),
        Verdict::Unscored => None,
    }
}

impl Comparison {
    /// Probability that a run of `aggregate` scores higher than one of the best baseline, and what that means.
    pub fn improvement(&self, aggregate: &Aggregate) -> Option<(Estimate, Finding)> {
        let estimate = aggregate.over_baselines.as_ref()?[self.best_baseline?];
        let chance = aggregate.p_value.is_none_or(|p| p > 1.0 - self.level);
        let finding = match estimate.interval {
            None => Finding::Unknown,
            Some((low, high)) if low <= 0.5 && high >= 0.5 => Finding::Open,
            Some(_) if chance => Finding::Few,
            Some((low, _)) if low > 0.5 => Finding::Better,
            Some(_) => Finding::Worse,
        };
        Some((estimate, finding))
    }

    /// The best baseline's place among the methods.
    pub fn best_baseline(&self) -> Option<usize> {
        self.best_baseline.map(|k| self.baselines[k])
    }

    /// The best baseline's figures.
    pub fn standard(&self) -> Option<&Aggregate> {
        self.best_baseline().and_then(|m| self.methods.iter().find(|a| a.method == m))
    }

    /// Points by which the interquartile mean of `aggregate` is above that of the best baseline; None for baselines.
    pub fn gap(&self, aggregate: &Aggregate) -> Option<f64> {
        aggregate.over_baselines.as_ref()?;
        Some(aggregate.over_seeds[0].point - self.standard()?.over_seeds[0].point)
    }
}
