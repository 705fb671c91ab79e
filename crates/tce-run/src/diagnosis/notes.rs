//! What a diagnosis says of metrics that are missing or lack rows.

use tce_diagnosis::{Bounds, Curve};

use super::references::References;
use super::rows::Batch;

/// What is said of rows that are no part of a metric, and of bounds that there are none of.
pub fn left_out(own: &Batch, theorem: Option<&Bounds>, simulator: bool) -> Vec<String> {
    let mut notes = Vec::new();
    let lost = own.simulated.as_ref().map_or(0, |s| (0..own.len()).filter(|&i| !s.held(i)).count());
    if lost > 0 {
        notes.push(format!(
            "The simulator's physics blew up in {lost} generated rows at the run's own y_max; medians and percentiles leave them out."
        ));
    }
    let Some(theorem) = theorem else { return notes };
    let Bounds { value, value_alone, transition, transition_alone, .. } = theorem;
    for (what, curve, expected) in [
        ("on values by the simulator", value, simulator),
        ("on values by the data alone", value_alone, true),
        ("on transitions by the simulator", transition, simulator),
        ("on transitions by the data alone", transition_alone, true),
    ] {
        match curve {
            None if expected => notes.push(format!(
                "Theorem 1's bound {what} is missing: the discrepancy is a finite number in no source row, or in no generated one; \
                 a model has diverged."
            )),
            Some(c) if c.lost != (0, 0) => notes.push(format!(
                "Theorem 1's bound {what} leaves out {} source and {} generated rows, whose discrepancy is no finite number.",
                c.lost.0, c.lost.1
            )),
            _ => (),
        }
    }
    let single = |c: &Curve| c.generated_error.is_none() || c.errors[0].iter().any(Option::is_none);
    if value_alone.as_ref().is_some_and(single) {
        notes.push(
            "The source's nearest rows, or the generated ones, are of a single trajectory, which says nothing of others: λ = 0 cannot be \
             told from every other λ."
                .into(),
        );
    }
    notes
}

/// Bounds and batches whose rows are not all numbers; `rows` were generated for each.
pub fn lost<'a>(batches: impl Iterator<Item = (&'a f32, &'a Batch)>, rows: usize) -> Vec<String> {
    let told = |(y, batch): (&f32, &Batch)| {
        format!(
            "{} of {rows} rows generated with y_max = {y} hold numbers that are not finite. They count as rejected, and are part of no \
             other metric.",
            batch.lost
        )
    };
    batches.filter(|(_, batch)| batch.lost > 0).map(told).collect()
}

/// What there is not without the simulator, which was `wanted` or not.
pub fn without_simulator(wanted: bool) -> String {
    let why = if wanted { "its task is not one of the benchmark's" } else { "it was not to be used" };
    format!(
        "Without the simulator ({why}) there are no abundant target rows: no transition KL, no reward error, no consistency, \
         and Theorem 1 by models of the target rows alone."
    )
}

/// What is to be said of the rows that coverage is counted over.
pub fn of_references(references: Option<&References>) -> Option<&'static str> {
    match references {
        None => Some("There are too few rows for a coverage."),
        Some(r) if !r.by_episode => Some(
            "The target's episodes cannot be split into halves: its coverage by other target rows is by rows of the same episodes, \
             and more than fresh rows would cover.",
        ),
        Some(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use tce_diagnosis::Rated;

    use super::*;
    use crate::diagnosis::models::tests::log;

    /// Every metric that is missing has a note.
    #[test]
    fn what_is_left_out_is_told() {
        let t = log(&[1, 1]);
        let held = |rewards: Vec<f32>| tce_sim::Simulated { rewards, ..Default::default() };
        let batch =
            |simulated| Batch { rows: t.clone(), keep: vec![true; 2], labels: vec![0.0; 2], simulated, lost: 0 };
        let curve = |sources: &[f64]| Curve::of(&Rated::certain(sources.to_vec()), &Rated::certain(vec![1.0, 2.0]));
        let rows: Vec<f64> = (0..1000).map(f64::from).collect();
        let with = |value: Option<Curve>, value_alone: Option<Curve>| Bounds {
            discount: 0.9,
            r_max: 1.0,
            transition: curve(&rows),
            value,
            transition_alone: curve(&rows),
            value_alone,
            held_out: None,
        };
        let notes = |b: &Batch, t: &Bounds| left_out(b, Some(t), true).join("\n");
        let whole = with(curve(&rows), curve(&rows));
        assert_eq!(notes(&batch(Some(held(vec![1.0, 2.0]))), &whole), "");
        assert!(notes(&batch(Some(held(vec![1.0, f32::NAN]))), &whole).contains("blew up in 1 generated rows"));
        let none = batch(None);
        assert!(
            notes(&none, &with(curve(&[f64::NAN]), curve(&rows))).contains("on values by the simulator is missing")
        );
        assert!(!left_out(&none, Some(&with(None, curve(&rows))), false).join("").contains("missing"));
        let one = notes(&none, &with(curve(&rows), curve(&[&rows[..], &[f64::INFINITY]].concat())));
        assert!(one.contains("on values by the data alone leaves out 1 source and 0 generated rows"), "{one}");
        assert!(notes(&none, &with(curve(&rows), curve(&rows[..50]))).contains("are of a single trajectory"));
    }
}
