//! From a study to its analysis.

use tce_base::Streams;
use tce_data::{Shift, Task};

use super::*;
use super::{compare, effects, recipes, recommended, warnings};
use crate::difference::Sample;

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
        .map(|m| m.published || study.runs.iter().any(|r| r.method == m.id && r.folder.published))
        .collect();
    let warnings = warnings::warnings(study, &tasks, &scores, comparison.as_ref(), &published);
    let mut analysis = Analysis {
        name: study.name.clone(),
        methods: study.methods.clone(),
        published,
        tables,
        comparison,
        gaps: Vec::new(),
        recipes: Recipes::of(study),
        recommendations: recommended::recommendations(study),
        warnings,
        level: options.level,
        resamples: options.resamples,
    };
    analysis.gaps = effects::gaps(&analysis);
    Ok(analysis)
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
        let samples: Vec<Option<Sample>> = scores[t].iter().map(|s| Sample::of(s)).collect();
        let best = samples.iter().flatten().map(|s| s.mean).fold(f64::MIN, f64::max);
        let baselines = samples.iter().zip(methods).filter(|(_, m)| m.baseline).filter_map(|(s, _)| s.map(|s| s.mean));
        let baseline = baselines.reduce(f64::max);
        let cell = |(k, sample): (usize, &Option<Sample>)| {
            sample.map(|Sample { mean, std, seeds }| Cell {
                mean,
                std,
                seeds,
                diverged: by_task[t][k].iter().filter(|r| matches!(r.member.verdict, Verdict::Diverged(_))).count(),
                best: mean >= best,
                above_baselines: if methods[k].baseline { None } else { baseline.map(|f| mean > f) },
            })
        };
        rows.push(Row {
            task: tasks[t],
            cells: samples.iter().enumerate().map(cell).collect(),
            paper: paper.and_then(|p| p.row(&tasks[t])).map_or_else(|| vec![None; columns], <[_]>::to_vec),
        });
    }
    let over =
        |name: &str, lists: Vec<Vec<f64>>, statistic: &(dyn Fn(&Scores) -> f64 + Sync)| -> Result<Option<Total>> {
            if lists.is_empty() {
                return Ok(None);
            }
            let tasks = lists.len();
            let scores = Scores::new(lists)?;
            let estimate = bootstrap.intervals(name, Draw::Runs, &[&scores], |s| vec![statistic(s[0])])?[0];
            Ok(Some(Total { estimate, tasks }))
        };
    let (mut totals, mut iqms) = (Vec::new(), Vec::new());
    let mut against = Vec::new();
    for (m, method) in methods.iter().enumerate() {
        let lists = |want: &dyn Fn(usize) -> bool| -> Vec<Vec<f64>> {
            let kept = places.iter().enumerate().filter(|(k, t)| want(*k) && !scores[**t][m].is_empty());
            kept.map(|(_, &t)| scores[t][m].clone()).collect()
        };
        let name = format!("total/{shift}/{}", method.id);
        totals.push(over(&name, lists(&|_| true), &Scores::total)?);
        iqms.push(over(&format!("iqm/{name}"), lists(&|_| true), &Scores::iqm)?);
        let paper_method = paper::counterpart(&method.base).filter(|_| method.plain);
        let Some((paper_method, column)) = paper_method.and_then(|p| Some((p, paper?.column(p)?))) else { continue };
        let printed = |k: usize| rows[k].paper[column];
        let ours = over(&format!("against/{name}"), lists(&|k| printed(k).is_some()), &Scores::total)?;
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
    Ok(ShiftTable { shift, rows, totals, iqms, paper, paper_totals, against, doubt })
}
