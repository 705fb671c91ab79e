//! From runs to the figures of the report. Everything that is printed, drawn or warned about is decided here.

use serde::Serialize;
use tce_base::Streams;
use tce_data::{Shift, Task};

use crate::error::{ReportError, Result};
use crate::folder::Verdict;
use crate::paper::{self, PaperTable, Printed};
use crate::stats::{Bootstrap, Draw, Estimate, Scores};
use crate::study::{Method, Run, Study, order};

mod compare;
mod opening;
mod recipes;
mod recommended;
mod warnings;

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
    /// Whether the mean is above that of every floor of this task; None for floors and where there are none.
    pub above_floors: Option<bool>,
}

/// A sum over tasks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Total {
    /// Sum over tasks of the mean over seeds.
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
    /// Share of runs above every threshold of the comparison.
    #[serde(skip)]
    pub profile: Vec<Estimate>,
    /// Probability that a run of it scores higher than a run of each floor of the comparison; None for floors.
    pub over_floors: Option<Vec<Estimate>>,
    /// How likely a difference as large as that to the best floor is by chance alone (permutation test); None for floors.
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
    /// Floors in it, by place among the methods.
    pub floors: Vec<usize>,
    /// The floor with the highest interquartile mean, by place in `floors`.
    pub best_floor: Option<usize>,
    /// The intervals' coverage.
    pub level: f64,
    /// Where the performance profiles are computed.
    #[serde(skip)]
    pub thresholds: Vec<f64>,
}

/// What can be said of a method against the best floor.
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

/// What a run counts for.
pub fn score(run: &Run) -> Option<f64> {
    match run.member.verdict {
        Verdict::Score(score) => Some(score),
        Verdict::Diverged(_) => Some(DIVERGED),
        Verdict::Unscored => None,
    }
}

impl Comparison {
    /// Probability that a run of `aggregate` scores higher than one of the best floor, and what that means.
    pub fn improvement(&self, aggregate: &Aggregate) -> Option<(Estimate, Finding)> {
        let estimate = aggregate.over_floors.as_ref()?[self.best_floor?];
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

    /// The best floor's place among the methods.
    pub fn best_floor(&self) -> Option<usize> {
        self.best_floor.map(|k| self.floors[k])
    }

    /// The best floor's figures.
    pub fn standard(&self) -> Option<&Aggregate> {
        self.best_floor().and_then(|m| self.methods.iter().find(|a| a.method == m))
    }

    /// Points by which the interquartile mean of `aggregate` is above that of the best floor; None for floors.
    pub fn gap(&self, aggregate: &Aggregate) -> Option<f64> {
        aggregate.over_floors.as_ref()?;
        Some(aggregate.over_seeds[0].point - self.standard()?.over_seeds[0].point)
    }
}

/// The figures of `study`.
///
/// # Errors
/// If there is no run in it.
pub fn analyse(study: &Study, options: &Options) -> Result<Analysis> {
    if study.runs.is_empty() {
        let what = match study.missing.first() {
            Some(first) => format!(
                "found no finished run, expected at least one; {} are not done, the first is {} ({})",
                study.missing.len(),
                first.what,
                first.why
            ),
            None => {
                "found no finished run, expected at least one; make some with `tce sweep launch` or `tce run`".into()
            }
        };
        return Err(ReportError::Nothing { path: study.directory.clone().into(), what });
    }
    let bootstrap =
        Bootstrap { streams: Streams::new(options.seed), resamples: options.resamples, level: options.level };
    let tasks = tasks_of(study);
    let runs = |task: &Task, method: &Method| -> Vec<&Run> {
        study.runs.iter().filter(|r| r.task == *task && r.method == method.id).collect()
    };
    let by_task: Vec<Vec<Vec<&Run>>> =
        tasks.iter().map(|t| study.methods.iter().map(|m| runs(t, m)).collect()).collect();
    let scores: Vec<Vec<Vec<f64>>> = by_task
        .iter()
        .map(|methods| methods.iter().map(|runs| runs.iter().filter_map(|r| score(r)).collect()).collect())
        .collect();

    let mut tables = Vec::new();
    for shift in Shift::ALL {
        let places: Vec<usize> = (0..tasks.len()).filter(|k| tasks[*k].shift == shift).collect();
        if !places.is_empty() {
            tables.push(shift_table(study, &bootstrap, shift, &places, &tasks, &by_task, &scores)?);
        }
    }
    let comparison = compare::compare(study, &bootstrap, &tasks, &scores)?;
    let published: Vec<bool> = study
        .methods
        .iter()
        .map(|m| m.variant.ends_with("-published") || study.runs.iter().any(|r| r.method == m.id && r.folder.published))
        .collect();
    let warnings = warnings::warnings(study, &tasks, &scores, comparison.as_ref(), &published);
    Ok(Analysis {
        name: study.name.clone(),
        methods: study.methods.clone(),
        published,
        tables,
        comparison,
        recipes: Recipes::of(study),
        recommendations: recommended::recommendations(study),
        warnings,
        level: options.level,
        resamples: options.resamples,
    })
}

/// The study's tasks in the paper's order, those without a result included.
fn tasks_of(study: &Study) -> Vec<Task> {
    let mut tasks: Vec<Task> = Vec::new();
    for task in study.runs.iter().map(|r| r.task).chain(study.missing.iter().map(|m| m.task)) {
        if !tasks.contains(&task) {
            tasks.push(task);
        }
    }
    tasks.sort_by_key(order);
    tasks
}

fn mean_std(values: &[f64]) -> (f64, Option<f64>) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    (mean, (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt()))
}

fn shift_table(
    study: &Study,
    bootstrap: &Bootstrap,
    shift: Shift,
    places: &[usize],
    tasks: &[Task],
    by_task: &[Vec<Vec<&Run>>],
    scores: &[Vec<Vec<f64>>],
) -> Result<ShiftTable> {
    let paper = paper::table(shift);
    let columns = paper.map_or(0, |p| p.columns.len());
    let methods = &study.methods;
    let mut rows = Vec::new();
    for &t in places {
        let stats: Vec<Option<(f64, Option<f64>)>> =
            scores[t].iter().map(|s| (!s.is_empty()).then(|| mean_std(s))).collect();
        let best = stats.iter().flatten().map(|s| s.0).fold(f64::MIN, f64::max);
        let floors = stats.iter().zip(methods).filter(|(_, m)| m.floor).filter_map(|(s, _)| s.map(|s| s.0));
        let floor = floors.reduce(f64::max);
        let cell = |(k, stat): (usize, &Option<(f64, Option<f64>)>)| {
            stat.map(|(mean, std)| Cell {
                mean,
                std,
                seeds: scores[t][k].len(),
                diverged: by_task[t][k].iter().filter(|r| matches!(r.member.verdict, Verdict::Diverged(_))).count(),
                best: mean >= best,
                above_floors: if methods[k].floor { None } else { floor.map(|f| mean > f) },
            })
        };
        rows.push(Row {
            task: tasks[t],
            cells: stats.iter().enumerate().map(cell).collect(),
            paper: paper.and_then(|p| p.row(&tasks[t])).map_or_else(|| vec![None; columns], <[_]>::to_vec),
        });
    }
    let total = |name: &str, lists: Vec<Vec<f64>>| -> Result<Option<Total>> {
        if lists.is_empty() {
            return Ok(None);
        }
        let tasks = lists.len();
        let scores = Scores::new(lists)?;
        let estimate = bootstrap.intervals(name, Draw::Runs, &[&scores], |s| vec![s[0].total()])?[0];
        Ok(Some(Total { estimate, tasks }))
    };
    let mut totals = Vec::new();
    let mut against = Vec::new();
    for (m, method) in methods.iter().enumerate() {
        let lists = |want: &dyn Fn(usize) -> bool| -> Vec<Vec<f64>> {
            let kept = places.iter().enumerate().filter(|(k, t)| want(*k) && !scores[**t][m].is_empty());
            kept.map(|(_, &t)| scores[t][m].clone()).collect()
        };
        let name = format!("total/{shift}/{}", method.id);
        totals.push(total(&name, lists(&|_| true))?);
        let paper_method = paper::counterpart(&method.variant).filter(|_| method.plain);
        let Some((paper_method, column)) = paper_method.and_then(|p| Some((p, paper?.column(p)?))) else { continue };
        let printed = |k: usize| rows[k].paper[column];
        let ours = total(&format!("against/{name}"), lists(&|k| printed(k).is_some()))?;
        if let Some(ours) = ours {
            let both = (0..rows.len()).filter(|k| rows[*k].cells[m].is_some());
            let paper = both.filter_map(|k| printed(k).map(|p| p.mean)).sum();
            against.push(Against { method: m, paper_method: paper_method.into(), ours, paper });
        }
    }
    let paper_totals = (0..columns)
        .map(|c| {
            let figures = rows.iter().filter_map(|r| r.paper[c]);
            figures.fold((0.0, 0), |(sum, n), p| (sum + p.mean, n + 1))
        })
        .collect();
    let doubt = recipes::doubt(study, shift);
    Ok(ShiftTable { shift, rows, totals, paper, paper_totals, against, doubt })
}
