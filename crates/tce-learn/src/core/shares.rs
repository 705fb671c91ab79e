//! How many rows of a batch come from each part of a member's data.

use std::sync::Arc;

use tce_data::Transitions;

/// Splits `batch` rows evenly over the parts that have rows; the remainder goes to the earlier parts.
pub(crate) fn split(batch: usize, parts: &[Arc<Transitions>]) -> Vec<usize> {
    let live = parts.iter().filter(|p| !p.is_empty()).count();
    let mut given = 0;
    let share = |p: &Arc<Transitions>| {
        if p.is_empty() {
            return 0;
        }
        given += 1;
        batch / live + usize::from(given <= batch % live)
    };
    parts.iter().map(share).collect()
}

/// `rows` of each part in the batch of `step`, where the parts after the first have all of their rows at step 0, fewer
/// from step to step, and none from step `until` on. The first part takes their places.
pub(crate) fn faded(mut rows: Vec<usize>, step: u64, until: u64) -> Vec<usize> {
    let left = until.saturating_sub(step);
    for k in 1..rows.len() {
        // Rounded up, so that there are other rows until the end. `until` is 0 only if nothing is left.
        let kept = if left == 0 { 0 } else { (rows[k] as u64 * left).div_ceil(until) as usize };
        rows[0] += rows[k] - kept;
        rows[k] = kept;
    }
    rows
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn other_rows_fade_to_nothing() {
        let at = |step| faded(vec![64, 64], step, 100);
        assert_eq!([at(0), at(50), at(75), at(99), at(100), at(5000)].map(|rows| rows[1]), [64, 32, 16, 1, 0, 0]);
        assert_eq!(faded(vec![5, 3], 0, 0), [8, 0]);
        assert_eq!(faded(vec![7], 3, 10), [7], "target rows alone");
    }

    proptest! {
        #[test]
        fn no_place_of_a_batch_is_lost(rows in prop::collection::vec(0usize..300, 1..4), step in 0u64..2000, until in 0u64..2000) {
            let (now, later) = (faded(rows.clone(), step, until), faded(rows.clone(), step + 1, until));
            prop_assert_eq!(now.iter().sum::<usize>(), rows.iter().sum::<usize>());
            for k in 1..rows.len() {
                prop_assert!(now[k] <= rows[k] && later[k] <= now[k]);
            }
        }
    }
}
