//! Every run and what decided it.

use std::collections::{BTreeMap, BTreeSet};

use maud::{Markup, html};
use tce_base::counted;
use tce_data::Task;

use super::{duration, one, term};
use crate::analysis::score;
use crate::folder::Verdict;
use crate::study::{Recipe, Run, Study, order};
use crate::svg::minus;

pub(super) fn runs(study: &Study) -> Markup {
    let mut tasks: Vec<Task> = study.runs.iter().map(|r| r.task).collect();
    tasks.sort_by_key(order);
    tasks.dedup();
    let mut configs: BTreeMap<&str, (&str, BTreeSet<&str>)> = BTreeMap::new();
    for run in &study.runs {
        let entry = configs.entry(&run.folder.config_hash).or_insert((&run.folder.config, BTreeSet::new()));
        entry.1.insert(&run.method);
    }
    html! {
        p {
            "Every score with what decided it: seed, settings, hashes of data and results, and the program. The runs lie in "
            code { (study.directory) } ". The call that makes a run again stands beside its hashes: on the same data, a processor with the same \
             instructions and the same version of the program, it gives the same policy byte for byte if no GPU was used."
        }
        @for task in &tasks {
            @let list: Vec<&Run> = study.methods.iter().flat_map(|m| study.runs.iter().filter(move |r| r.task == *task && r.method == m.id)).collect();
            details {
                summary { (task) " · " (counted(list.len(), "run", "runs")) }
                div class="inner scroll" {
                    table {
                        thead {
                            tr {
                                th class="first" { "Method" } th { "Seed" } th { "Score" } th { "Episodes" } th { "Returns" }
                                th { "Other rows" } th { "Time" } th class="text" { "Program" } th class="text" { "Settings" }
                                th class="text" { "Folder and hashes" }
                            }
                        }
                        tbody { @for run in list { (run_row(study, run)) } }
                    }
                }
            }
        }
        h3 { "Settings" }
        p class="note" {
            "Some names: " code { "expectile" } " is " (term("expectile", "that of IQL")) "; " code { "y_max" } " bounds "
            (term("y", "the labels ŷ of generated states")) "; " code { "lambda" } " is " (term("lambda", "the share of source rows"))
            "; " code { "z_threshold" } " is " (term("filter", "the filter's")) "."
        }
        @for (hash, (text, methods)) in &configs {
            details id=(format!("config-{hash}")) {
                summary { code { (hash) } " · " (methods.iter().copied().collect::<Vec<_>>().join(", ")) }
                div class="inner" {
                    @if let Some(run) = study.runs.iter().find(|r| r.folder.config_hash == **hash) { (recipe(&run.recipe)) }
                    pre { (text) }
                }
            }
        }
    }
}

/// Where settings come from.
fn recipe(recipe: &Recipe) -> Markup {
    html! {
        @match (&recipe.preset, &recipe.changed[..]) {
            (None, _) => p class="note" { "These settings are like none of the presets." },
            (Some(preset), []) => p class="note" { "The settings of preset " (preset) "." },
            (Some(preset), changed) => {
                p class="note" { "Preset " (preset) ", but for these (in brackets the preset's):" }
                ul class="note" { @for c in changed { li { code { (c) } } } }
            }
        }
    }
}

/// The call that makes this run again, where its settings are those of a preset with changes.
pub(crate) fn command(study: &Study, run: &Run) -> Option<String> {
    let method = study.methods.iter().find(|m| m.id == run.method)?;
    let preset = run.recipe.preset.as_ref()?;
    let sets: String = run.recipe.changed.iter().map(|c| format!(" --set '{}={}'", c.key, c.value)).collect();
    let (task, variant, seed) = (run.task, &method.variant, run.member.seed);
    Some(format!("tce run {task} --preset {preset} --variant {variant} --no-baselines --seeds 1 --seed {seed}{sets}"))
}

fn run_row(study: &Study, run: &Run) -> Markup {
    let folder = &run.folder;
    let returns = &run.member.returns;
    let (low, high) = returns.iter().fold((f64::MAX, f64::MIN), |(l, h), r| (l.min(*r), h.max(*r)));
    html! {
        tr {
            th scope="row" { (run.method) @if folder.published { " " span class="badge" { "published mode" } } }
            td { (run.member.seed) }
            td {
                (score(run).map_or("–".into(), one))
                @if let Verdict::Diverged(why) = &run.member.verdict { span title=(why) { "†" } }
            }
            td { (returns.len()) }
            td { @if returns.is_empty() { "–" } @else { (minus(format!("{low:.0}"))) " to " (minus(format!("{high:.0}"))) } }
            td {
                (folder.extra_rows)
                @if let Some((sampled, kept)) = folder.generated.get(run.index) {
                    " " small { (kept) " kept of " (sampled) " generated" }
                }
            }
            td {
                (duration(folder.seconds))
                @if folder.members.len() > 1 { " " small { "for " (folder.members.len()) " seeds" } }
            }
            td class="text" { (folder.program) }
            td class="text" { a href=(format!("#config-{}", folder.config_hash)) { code { (folder.config_hash) } } }
            td class="text" {
                details {
                    summary { code { (folder.directory.display()) } }
                    table {
                        tbody {
                            @if let Some(command) = command(study, run) { tr { th { "make it again" } td class="text" { code { (command) } } } }
                            @if !folder.machine.is_empty() { tr { th { "processor" } td class="text" { (folder.machine) } } }
                            @for (name, value) in &folder.inputs { tr { th { "input: " (name) } td class="text" { code { (value) } } } }
                            @for (name, hash) in &folder.files { tr { th { (name) } td class="text" { code { (hash) } } } }
                        }
                    }
                }
            }
        }
    }
}
