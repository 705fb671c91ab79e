//! What came out, in a sentence.

use crate::analysis::{Analysis, Finding};

/// The result in one sentence.
pub(crate) fn headline(analysis: &Analysis) -> String {
    let Some(comparison) = &analysis.comparison else {
        return "No run has a score.".into();
    };
    let title = |m: usize| analysis.methods[m].title.as_str();
    let Some(floor) = comparison.best_floor() else {
        return "There is no floor to compare with: without one a score says little.".into();
    };
    let judged: Vec<(usize, Finding)> =
        comparison.methods.iter().filter_map(|a| Some((a.method, comparison.improvement(a)?.1))).collect();
    let better: Vec<&str> = judged.iter().filter(|j| j.1 == Finding::Better).map(|j| title(j.0)).collect();
    let floor = title(floor);
    match (judged.len(), better.len()) {
        (0, _) if analysis.methods.iter().all(|m| m.floor) => {
            format!("Only floors were run; the best of them is {floor}.")
        }
        (0, _) => "No method can be compared with the floors: they share no task with scores.".into(),
        (1, 1) => format!("{} beats the best floor, {floor}.", better[0]),
        (1, _) => format!("{} is not shown to beat the best floor, {floor}.", title(judged[0].0)),
        (n, 0) => format!("None of the {n} methods is shown to beat the best floor, {floor}."),
        (n, k) if n == k => format!("All {n} methods beat the best floor, {floor}."),
        (n, k) => {
            let verb = if k == 1 { "beats" } else { "beat" };
            format!("{k} of {n} methods {verb} the best floor, {floor}: {}.", better.join(", "))
        }
    }
}
