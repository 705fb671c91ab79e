//! The λ that the data speak for, beside what was best in hindsight.

use maud::{Markup, html};
use tce_base::counted;
use tce_data::Task;
use tce_diagnosis::{Choice, Diagnosis};

use super::numbers::plain;
use crate::analysis::Analysis;
use crate::html::words::term;
use crate::study::{Study, short};
use crate::svg::minus;

/// A run of TCE's mixture: its λ, its title and mean score, and the configuration but for λ.
struct Mixed {
    rest: toml::Table,
    lambda: f64,
    title: String,
    score: f64,
    seeds: usize,
}

/// The study's mixtures of generated and nearest source rows on `task` that differ from the diagnosed run in λ alone; where that run is
/// not of the study, of its largest group.
fn mixtures(study: &Study, analysis: &Analysis, task: Task, d: &Diagnosis) -> Vec<Mixed> {
    let of = |(m, method): (usize, &crate::study::Method)| -> Option<Mixed> {
        let row = analysis.tables.iter().flat_map(|t| &t.rows).find(|r| r.task == task)?;
        let cell = row.cells[m].as_ref()?;
        let run = study.runs.iter().find(|r| r.task == task && r.method == method.id)?;
        let config: toml::Table = toml::from_str(&run.folder.config).ok()?;
        let mixture = config.get("mixture")?.clone();
        let text = |key: &str| mixture.get(key).and_then(toml::Value::as_str);
        let lambda = match (text("generated")?, text("source")?) {
            ("tce", "none") => 0.0,
            ("tce", "nearest") => mixture.get("lambda")?.as_float()?,
            _ => return None,
        };
        Some(Mixed {
            rest: without_mixture(config),
            lambda,
            title: method.title.clone(),
            score: cell.mean,
            seeds: cell.seeds,
        })
    };
    let own = study.runs.iter().find(|r| r.task == task && r.folder.directory.file_name().is_some_and(|n| *n == *d.of));
    let own = own.and_then(|r| toml::from_str(&r.folder.config).ok()).map(without_mixture);
    alike(analysis.methods.iter().enumerate().filter_map(of).collect(), own)
}

/// Those that differ in λ alone, from `own` if there is one: otherwise the most of one kind, those of the first method among equals. The
/// others say nothing of λ.
fn alike(all: Vec<Mixed>, own: Option<toml::Table>) -> Vec<Mixed> {
    let like = |rest: &toml::Table| all.iter().filter(|m| m.rest == *rest).count();
    // The first of the greatest: `max_by_key` takes the last.
    let largest = || all.iter().rev().max_by_key(|m| like(&m.rest)).map(|m| m.rest.clone());
    let Some(rest) = own.or_else(largest) else { return all };
    all.into_iter().filter(|m| m.rest == rest).collect()
}

/// Everything but what decides on source rows.
fn without_mixture(mut config: toml::Table) -> toml::Table {
    if let Some(mixture) = config.get_mut("mixture").and_then(toml::Value::as_table_mut) {
        mixture.remove("source");
        mixture.remove("lambda");
    }
    config
}

/// What the rule picks, beside what was best in hindsight.
pub(super) fn lambdas(study: &Study, analysis: &Analysis, all: &[&Diagnosis]) -> Markup {
    let rows: Vec<(Task, &Diagnosis, &Choice)> =
        all.iter().filter_map(|d| Some((d.task?, *d, d.choice.as_ref()?))).collect();
    if rows.is_empty() {
        return html! {};
    }
    html! {
        h3 { "λ from the data alone" }
        p {
            (term("lambda", "λ")) " is the share of real source rows in the data that a policy learns from. The rule takes the λ at which "
            (term("theorem", "Theorem 1")) " promises the least loss, measured by models of the target rows alone. Where the promises differ by \
             less than these models and the samples are in doubt, the data cannot tell, and λ = 0 stands. Beside it stands what the \
             simulator would have said. The last columns are hindsight: the scores of this report's mixtures that differ in λ alone."
        }
        div class="scroll" {
            table {
                thead { tr {
                    th class="first" { "Task" } th class="text" { "Diagnosis" } th class="text" { "λ of the rule" } th { "Least bound at" } th class="text" { "By the simulator" }
                    th class="edge text" { "Scores by λ" } th class="text" { "Best in hindsight" }
                } }
                tbody {
                    @for (task, d, choice) in &rows {
                        @let mixed = mixtures(study, analysis, *task, d);
                        @let several = mixed.iter().any(|m| m.lambda != mixed[0].lambda);
                        @let best = mixed.iter().max_by(|a, b| a.score.total_cmp(&b.score)).filter(|_| several);
                        tr {
                            th scope="row" { (short(task)) }
                            td class="text" { (d.of) ", seed " (d.seed) }
                            td class="text" { (choice.to_string()) }
                            td { (plain(choice.least)) }
                            td class="text" { (d.choice_by_simulator.as_ref().map_or("–".into(), Choice::to_string)) }
                            td class="edge text" {
                                @for m in &mixed {
                                    div { (m.title) ", λ = " (plain(m.lambda)) ": " (minus(format!("{:.1}", m.score))) " (" (counted(m.seeds, "seed", "seeds")) ")" }
                                }
                            }
                            td class="text" { @match best { Some(m) => { "λ = " (plain(m.lambda)) ", " (m.title) }, None => "–" } }
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hindsight_compares_what_differs_in_lambda_alone() {
        let mixed = |title: &str, config: &str| Mixed {
            rest: without_mixture(toml::from_str(config).unwrap()),
            lambda: 0.0,
            title: title.into(),
            score: 0.0,
            seeds: 1,
        };
        let titled = |all, own| alike(all, own).into_iter().map(|m| m.title).collect::<Vec<_>>();
        let titles = |all| titled(all, None);
        let og =
            || mixed("og", "generator.y_max = 0.2\nmixture = { generated = 'tce', source = 'none', lambda = 0.0 }");
        let nn =
            || mixed("nn", "generator.y_max = 0.2\nmixture = { generated = 'tce', source = 'nearest', lambda = 0.1 }");
        let wide =
            || mixed("wide", "generator.y_max = 0.5\nmixture = { generated = 'tce', source = 'none', lambda = 0.0 }");
        let weighed = || {
            mixed(
                "x",
                "generator.y_max = 0.2\nmixture = { generated = 'tce', source = 'none', lambda = 0.0, weight = 2 }",
            )
        };
        assert_eq!(titles(vec![wide(), og(), weighed(), nn()]), ["og", "nn"]);
        assert_eq!(titles(vec![wide(), og()]), ["wide"], "nothing to compare");
        assert!(titles(vec![]).is_empty());
        // The diagnosed run's own kind, however many there are of others.
        assert_eq!(titled(vec![wide(), og(), nn()], Some(wide().rest)), ["wide"]);
    }
}
