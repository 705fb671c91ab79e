//! What the work took.

use std::collections::BTreeMap;

use maud::{Markup, html};
use tce_data::Agent;

use super::duration;
use crate::paper;
use crate::study::{Cost, Study, agent_title};

fn bytes(memory: u64) -> String {
    let gib = memory as f64 / f64::from(1u32 << 30);
    if gib >= 1.0 { format!("{gib:.1} GiB") } else { format!("{:.0} MiB", gib * 1024.0) }
}

pub(super) fn cost(study: &Study) -> Markup {
    // Groups of one stage together, in the order in which stages come; agents in the paper's.
    let mut stages: Vec<&str> = Vec::new();
    let mut groups: BTreeMap<(usize, Option<usize>, usize), Vec<&Cost>> = BTreeMap::new();
    for cost in &study.costs {
        let stage = stages.iter().position(|s| *s == cost.stage).unwrap_or_else(|| {
            stages.push(&cost.stage);
            stages.len() - 1
        });
        let agent = Agent::ALL.iter().position(|a| *a == cost.agent);
        groups.entry((stage, agent, cost.seeds)).or_default().push(cost);
    }
    let groups: Vec<Vec<&Cost>> = groups.into_values().collect();
    let paper = paper::runtime();
    html! {
        p {
            "Times on the clock of single pieces of work, on whatever machine did them and whatever else ran there. Attempts that were \
             interrupted count up to their last checkpoint. Memory is the most \
             that the process had at a time; where one process trained the networks and sampled from them, it stands with the sampling."
        }
        @if groups.is_empty() { p class="note" { "No stage has a time." } } @else {
            div class="scroll" {
                table {
                    thead {
                        tr {
                            th class="first" { "Stage" } th class="text" { "Agent" } th { "Seeds at once" } th { "Pieces" }
                            th { "Median" } th { "Shortest to longest" } th { "Most memory" }
                        }
                    }
                    tbody {
                        @for (k, list) in groups.iter().enumerate() {
                            @let mut times: Vec<f64> = list.iter().map(|c| c.seconds).collect();
                            @let () = times.sort_by(f64::total_cmp);
                            @let Cost { stage, agent, seeds, .. } = list[0];
                            @let first = k == 0 || groups[k - 1][0].stage != *stage;
                            tr class=[first.then_some("break")] {
                                th scope="row" { @if first { (stage) } }
                                td class="text" { (agent_title(*agent)) }
                                td { (seeds) } td { (list.len()) }
                                td { (duration(crate::stats::quantile(&times, 0.5))) }
                                td { (duration(times[0])) " to " (duration(times[times.len() - 1])) }
                                td { (list.iter().filter_map(|c| c.memory).max().map_or("not noted".into(), bytes)) }
                            }
                        }
                    }
                }
            }
        }
        p class="note" { "The paper's Table E.1, as printed (morphology shift, medium to expert, one GPU):" }
        div class="scroll" {
            table {
                thead { tr { @for (k, h) in paper[0].iter().enumerate() { th class=(if k == 0 { "first" } else { "from-paper" }) { (h) } } } }
                tbody {
                    @for row in &paper[1..] {
                        tr {
                            @for (k, c) in row.iter().enumerate() {
                                @if k == 0 { th scope="row" { (c) } } @else { td class="from-paper" { (c) } }
                            }
                        }
                    }
                }
            }
        }
    }
}
