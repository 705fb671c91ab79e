//! From runs to the figures of the report. Everything that is printed, drawn or warned about is decided here.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use tce_base::Streams;
use tce_data::{Shift, Task};

use crate::error::{ReportError, Result};
use crate::folder::Verdict;
use crate::paper::{self, PaperTable, Printed};
use crate::stats::{Bootstrap, Draw, Estimate, Scores, permutation_p, probability_of_improvement};
use crate::study::{Method, Run, Study, order};

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
}

/// Statistics of one method over the compared tasks.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Aggregate {
    /// Place among the methods.
    pub method: usize,
    /// Runs.
    pub runs: usize,
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
    /// There is no interval.
    Unknown,
}

impl Finding {
    /// In a table.
    pub fn word(self) -> &'static str {
        match self {
            Finding::Better => "beats it",
            Finding::Worse => "falls short of it",
            Finding::Open => "no difference shown",
            Finding::Few => "too few runs to tell",
            Finding::Unknown => "one seed: cannot be told",
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
    let comparison = compare(study, &bootstrap, &tasks, &scores)?;
    let published: Vec<bool> = study
        .methods
        .iter()
        .map(|m| m.variant.ends_with("-published") || study.runs.iter().any(|r| r.method == m.id && r.folder.published))
        .collect();
    let warnings = warnings(study, &tasks, &scores, comparison.as_ref(), &published);
    Ok(Analysis {
        name: study.name.clone(),
        methods: study.methods.clone(),
        published,
        tables,
        comparison,
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
    Ok(ShiftTable { shift, rows, totals, paper, paper_totals, against })
}

/// Methods on the tasks that all of them have. Where that is fewer than half of what the fullest method has, the method with the fewest
/// tasks is left out, one after the other, a floor last of all: a beginning of one method must not take the others' results away.
fn compare(
    study: &Study,
    bootstrap: &Bootstrap,
    tasks: &[Task],
    scores: &[Vec<Vec<f64>>],
) -> Result<Option<Comparison>> {
    let has = |t: usize, m: usize| !scores[t][m].is_empty();
    let count = |m: usize| (0..tasks.len()).filter(|t| has(*t, m)).count();
    let mut kept: Vec<usize> = (0..study.methods.len()).filter(|m| count(*m) > 0).collect();
    let mut left_out: Vec<usize> = (0..study.methods.len()).filter(|m| count(*m) == 0).collect();
    let shared =
        |kept: &[usize]| -> Vec<usize> { (0..tasks.len()).filter(|t| kept.iter().all(|m| has(*t, *m))).collect() };
    let most = kept.iter().map(|m| count(*m)).max().unwrap_or(0);
    while 2 * shared(&kept).len() < most.max(1) {
        let Some(&last) = kept.iter().min_by_key(|m| (count(**m), study.methods[**m].floor, std::cmp::Reverse(**m)))
        else {
            return Ok(None);
        };
        kept.retain(|m| *m != last);
        left_out.push(last);
    }
    if kept.is_empty() {
        return Ok(None);
    }
    left_out.sort_unstable();
    let places = shared(&kept);
    let of = |m: usize| Scores::new(places.iter().map(|&t| scores[t][m].clone()).collect());
    let tables = kept.iter().map(|&m| of(m)).collect::<Result<Vec<_>, _>>()?;
    let floors: Vec<usize> = kept.iter().copied().filter(|m| study.methods[*m].floor).collect();
    let table_of = |m: usize| &tables[kept.iter().position(|k| *k == m).expect("it is kept")];
    let thresholds = thresholds(&tables);
    // Profiles have a value for every threshold: a fifth of the resamples keeps them as fast as the rest.
    let coarse = Bootstrap { resamples: (bootstrap.resamples / 5).max(1), ..*bootstrap };
    let best_floor = (0..floors.len()).max_by(|a, b| {
        let iqm = |k: &usize| table_of(floors[*k]).iqm();
        iqm(a).total_cmp(&iqm(b))
    });
    let mut methods = Vec::new();
    for (&m, scores) in kept.iter().zip(&tables) {
        let method = &study.methods[m];
        let statistics =
            |s: &[&Scores]| vec![s[0].iqm(), s[0].median(), s[0].mean(), s[0].optimality_gap(GAMMA), s[0].total()];
        let runs = bootstrap.intervals(&method.id, Draw::Runs, &[scores], statistics)?;
        let both = bootstrap.intervals(&method.id, Draw::TasksAndRuns, &[scores], statistics)?;
        let profile = coarse.intervals(&format!("profile/{}", method.id), Draw::Runs, &[scores], |s| {
            thresholds.iter().map(|&t| s[0].share_above(t)).collect()
        })?;
        let improvements = |f: &usize| {
            let name = format!("improvement/{}/{}", method.id, study.methods[*f].id);
            let pair = [scores, table_of(*f)];
            Ok(bootstrap.intervals(&name, Draw::Runs, &pair, |s| vec![probability_of_improvement(s[0], s[1])])?[0])
        };
        let over_floors = match method.floor {
            true => None,
            false => Some(floors.iter().map(improvements).collect::<Result<Vec<_>>>()?),
        };
        let p_value = match best_floor {
            Some(k) if !method.floor => {
                let floor = floors[k];
                let name = format!("{}/{}", method.id, study.methods[floor].id);
                Some(permutation_p(bootstrap.streams, &name, bootstrap.resamples, scores, table_of(floor))?)
            }
            _ => None,
        };
        methods.push(Aggregate {
            method: m,
            runs: scores.runs(),
            over_seeds: [runs[0], runs[1], runs[2], runs[3]],
            over_tasks: [both[0], both[1], both[2], both[3]],
            total: runs[4],
            profile,
            over_floors,
            p_value,
        });
    }
    let tasks = places.iter().map(|&t| tasks[t]).collect();
    Ok(Some(Comparison { tasks, methods, left_out, floors, best_floor, level: bootstrap.level, thresholds }))
}

/// Every second point from below the lowest score to above the highest, 0 and 100 included.
fn thresholds(tables: &[Scores]) -> Vec<f64> {
    let all = || tables.iter().flat_map(Scores::tasks).flatten().copied();
    let low = (all().fold(0.0, f64::min) / 10.0).floor() * 10.0;
    let high = (all().fold(100.0, f64::max) / 10.0).ceil() * 10.0;
    // A return of a million is possible; a figure with a million points is none.
    let step = ((high - low) / 60.0).max(2.0);
    let n = ((high - low) / step).round() as usize;
    (0..=n).map(|k| low + (high - low) * k as f64 / n as f64).collect()
}

fn plural(n: usize, one: &str, many: &str) -> String {
    if n == 1 { format!("1 {one}") } else { format!("{n} {many}") }
}

fn list<'a>(names: impl IntoIterator<Item = &'a str>) -> String {
    names.into_iter().collect::<Vec<_>>().join(", ")
}

fn warnings(
    study: &Study,
    tasks: &[Task],
    scores: &[Vec<Vec<f64>>],
    comparison: Option<&Comparison>,
    published: &[bool],
) -> Vec<Warning> {
    let mut out = Vec::new();
    let mut warn = |text: String, details: Vec<String>| out.push(Warning { text, details });
    let title = |m: usize| study.methods[m].title.as_str();

    if !study.missing.is_empty() {
        let all = study.runs.len() + study.missing.len();
        warn(
            format!(
                "Partial results: {} of {all} runs have no result. They are counted nowhere; where they are not missing at random, \
                 the figures are biased.",
                study.missing.len()
            ),
            study.missing.iter().map(|m| format!("{}: {}", m.what, m.why)).collect(),
        );
    }
    if !study.conflicts.is_empty() {
        warn(
            "Two copies of the same work came to different results; the first one is shown. This is a fault of determinism."
                .into(),
            study.conflicts.clone(),
        );
    }
    let cases = |wanted: &dyn Fn(&Run) -> Option<String>| -> Vec<String> {
        let case = |r: &Run| Some(format!("{}, {}, seed {}: {}", r.method, r.task, r.member.seed, wanted(r)?));
        study.runs.iter().filter_map(case).collect()
    };
    let diverged = cases(&|r| match &r.member.verdict {
        Verdict::Diverged(why) => Some(why.clone()),
        _ => None,
    });
    if !diverged.is_empty() {
        warn(
            format!(
                "{} could not act to the end of {} evaluation: counted as {DIVERGED} points, a random policy's score, and marked † in \
                 the tables.",
                plural(diverged.len(), "policy", "policies"),
                if diverged.len() == 1 { "its" } else { "their" },
            ),
            diverged,
        );
    }
    let unscored = cases(&|r| (r.member.verdict == Verdict::Unscored).then(|| "no score".into()));
    if !unscored.is_empty() {
        let n = plural(unscored.len(), "run has", "runs have");
        warn(
            format!("{n} no score, for lack of reference returns or of a simulator, and are counted nowhere."),
            unscored,
        );
    }
    let modes: Vec<&str> = (0..published.len()).filter(|m| published[*m]).map(title).collect();
    if !modes.is_empty() {
        warn(
            format!(
                "Published mode: {} follow the published code, its known faults included. They stand for what was published, not \
                 for what the method can do.",
                list(modes)
            ),
            Vec::new(),
        );
    }
    let counts: BTreeSet<usize> = scores.iter().flatten().map(Vec::len).filter(|n| *n > 0).collect();
    if let (Some(least), Some(most)) = (counts.first(), counts.last()) {
        if *least < ENOUGH_SEEDS {
            warn(
                format!(
                    "Few seeds: {} a task and method, where the paper has {ENOUGH_SEEDS}. Intervals from so few seeds are too \
                     narrow{}.",
                    if least == most { least.to_string() } else { format!("{least} to {most}") },
                    if *least == 1 { ", and a task with one seed adds nothing to them" } else { "" },
                ),
                Vec::new(),
            );
        }
        if least != most {
            warn(
                format!(
                    "Unequal numbers of seeds, {least} to {most}. Every task has the same weight, and a run the share of its \
                     task's."
                ),
                Vec::new(),
            );
        }
    }
    // Without `--no-floors` all four are there: a table without them is a choice that a reader has to know.
    let bare: BTreeMap<&str, usize> = study
        .methods
        .iter()
        .enumerate()
        .filter(|(_, method)| method.floor)
        .map(|(m, method)| (method.title.as_str(), scores.iter().filter(|t| t[m].is_empty()).count()))
        .filter(|(_, missing)| *missing > 0)
        .collect();
    if !bare.is_empty() {
        let part = |(title, n): (&&str, &usize)| format!("{title} on {n} of {}", tasks.len());
        let parts: Vec<String> = bare.iter().map(part).collect();
        warn(
            format!("Floors are missing: {}. A score says little without the floor it has to beat.", parts.join("; ")),
            Vec::new(),
        );
    }
    match comparison {
        None => warn("No run has a score: there are no statistics.".into(), Vec::new()),
        Some(c) => {
            if c.tasks.len() < tasks.len() {
                warn(
                    format!(
                        "Aggregates are over the {} of {} tasks on which every compared method has a score.",
                        c.tasks.len(),
                        tasks.len()
                    ),
                    Vec::new(),
                );
            }
            if !c.left_out.is_empty() {
                warn(
                    format!(
                        "Not in the aggregates, for lack of scores on more than half of the tasks: {}.",
                        list(c.left_out.iter().map(|m| title(*m)))
                    ),
                    Vec::new(),
                );
            }
            let finding = |wanted: Finding| -> Vec<&str> {
                let is = |a: &&Aggregate| c.improvement(a).is_some_and(|(_, f)| f == wanted);
                c.methods.iter().filter(is).map(|a| title(a.method)).collect()
            };
            if let Some(floor) = c.best_floor() {
                let worse = finding(Finding::Worse);
                let open = [Finding::Open, Finding::Few, Finding::Unknown].map(finding).concat();
                if !worse.is_empty() {
                    warn(format!("Below the best floor ({}): {}.", title(floor), list(worse)), Vec::new());
                }
                if !open.is_empty() {
                    warn(format!("Not shown to beat the best floor ({}): {}.", title(floor), list(open)), Vec::new());
                }
            }
        }
    }
    let programs: BTreeSet<&str> = study.runs.iter().map(|r| r.folder.program.as_str()).collect();
    if programs.len() > 1 {
        warn(format!("The runs were made by different programs: {}.", list(programs)), Vec::new());
    }
    for note in &study.notes {
        warn(note.clone(), Vec::new());
    }
    out
}
