//! Selection among the rows of a batch: IGDF, OTDF and DmC select source rows at every step.

use std::sync::Arc;

use tce_nn::{Tensor, host, tensor};

use crate::buffer::{Buffer, Member, Minibatch, Pick};
use crate::error::LearnError;
use crate::losses::member_mean;
use crate::training::Meter;

/// Number of `others` rows that are kept at the share `keep`: ⌊keep · others⌋, at least one.
pub fn kept_rows(keep: f64, others: usize) -> usize {
    // .8 · 5 may be 4.000…01 or 3.999…9, depending on how it is computed.
    ((keep * others as f64 + 1e-9).floor() as usize).clamp(1, others.max(1))
}

/// For every member, the indices of all target rows of a batch and the `count` others with the highest `scores`,
/// ascending. Ties go to the earlier row. `scores` has one number per row that is not a target row, sorted by member.
pub fn best_others(target_rows: usize, scores: &[f32], others: usize, count: usize) -> Vec<Vec<usize>> {
    let choose = |scores: &[f32]| {
        let mut order: Vec<usize> = (0..others).collect();
        order.sort_unstable_by(|&a, &b| scores[b].total_cmp(&scores[a]).then(a.cmp(&b)));
        order.truncate(count);
        order.sort_unstable();
        (0..target_rows).chain(order.into_iter().map(|i| target_rows + i)).collect()
    };
    scores.chunks(others.max(1)).map(choose).collect()
}

/// A batch without its worse source rows, and the weights of its rows in L_Q.
pub struct Selected {
    /// Target rows, then the kept source rows.
    pub batch: Minibatch,
    /// `[P, B', 1]`: 1 for target rows.
    pub weights: Tensor<3>,
}

impl Selected {
    /// Keeps the share `keep` of the rows that are not the target's, those with the highest `scores` (in the format of
    /// [`best_others`]). Row i of them has the weight `weight(scores[i])`.
    pub fn new(batch: &Minibatch, scores: &[f32], keep: f64, weight: impl Fn(f32) -> f32) -> Self {
        let [p, b, _] = batch.s.dims();
        let (first, others) = (batch.target_rows, b - batch.target_rows);
        let rows = best_others(first, scores, others, kept_rows(keep, others));
        let weigh = |(m, &i): (usize, &usize)| if i < first { 1.0 } else { weight(scores[m * others + i - first]) };
        let weights: Vec<f32> =
            (rows.iter().enumerate()).flat_map(|(m, rows)| rows.iter().map(move |i| (m, i))).map(weigh).collect();
        let kept = rows[0].len();
        Self { weights: tensor(weights, [p, kept, 1], &batch.s.device()), batch: batch.keep(&rows) }
    }

    /// The result in the form of [`crate::on_iql::BatchTransform`]; records the mean weight in `meter`.
    pub(crate) fn recorded(self, meter: &mut Meter) -> (Minibatch, Option<Tensor<3>>) {
        meter.record("critic_weight", &member_mean(self.weights.clone()));
        (self.batch, Some(self.weights))
    }
}

/// The scores by which OTDF and DmC choose among the rows that are not target rows.
pub(crate) struct Scores {
    /// Tells whose s' is known.
    buffer: Buffer,
    /// Of every member, one number per row of part 1; 0 where s' is unknown.
    of_rows: Vec<Arc<Vec<f32>>>,
}

impl Scores {
    /// The `row_scores` of the members of `buffer`, which `method` needs.
    ///
    /// # Errors
    /// If a member has no source rows, or not a finite number for each whose s' is known.
    pub(crate) fn new(method: &str, buffer: &Buffer) -> Result<Self, LearnError> {
        need_scores(method, buffer.members())?;
        Ok(Self { buffer: buffer.clone(), of_rows: buffer.members().iter().filter_map(scores_of_rows).collect() })
    }

    /// The scores of the rows of `batch` that are not target rows, sorted by member; borrowed where s' is unknown.
    pub(crate) fn of_others(&self, batch: &Minibatch) -> Vec<f32> {
        let (first, b) = (batch.target_rows, batch.s.dims()[1]);
        let of = |(scores, picks): (&Arc<Vec<f32>>, &[Pick])| -> Vec<f32> {
            picks[first..].iter().map(|pick| scores[pick.row as usize]).collect()
        };
        let mut scores: Vec<f32> = self.of_rows.iter().zip(batch.picks.chunks(b)).flat_map(of).collect();
        lend_scores(&self.buffer.known_from(batch, first), &mut scores, b - first);
        scores
    }
}

/// A number per row of part 1: the member's where s' is known, else 0.
fn scores_of_rows(member: &Member) -> Option<Arc<Vec<f32>>> {
    let (scores, rows) = (member.row_scores.as_ref()?, member.parts.get(1)?);
    Some(if scores.len() == rows.len() { scores.clone() } else { Arc::new(rows.number_by_row(scores)) })
}

/// Gives rows that cannot be scored, because their s' is not `known`, the score of the row before them, or of the last one
/// for the first: both slices have `others` rows for each member. The rows of a batch are in random order, so that such rows, which are
/// terminal, are kept as often and weighed as much as others. 0 if no row of a member can be scored.
pub(crate) fn lend_scores(known: &[bool], scores: &mut [f32], others: usize) {
    for (scores, known) in scores.chunks_mut(others.max(1)).zip(known.chunks(others.max(1))) {
        let mut last = scores.iter().zip(known).rev().find(|(_, known)| **known).map_or(0.0, |(score, _)| *score);
        for (score, known) in scores.iter_mut().zip(known) {
            if *known {
                last = *score;
            } else {
                *score = last;
            }
        }
    }
}

/// Returns an error for members without source rows, which `method` needs.
pub(crate) fn need_others(method: &str, members: &[Member]) -> Result<(), LearnError> {
    match members.iter().position(|m| m.parts.len() != 2 || m.parts[1].is_empty()) {
        None => Ok(()),
        Some(m) => Err(LearnError::invalid(
            format!("member {m}"),
            format!("{} tables with rows", m_parts(&members[m])),
            format!("target rows and source rows: {method} compares the two"),
            "give source rows too (mixture.source = \"all\", or --extra)",
        )),
    }
}

fn m_parts(member: &Member) -> usize {
    member.parts.iter().filter(|p| !p.is_empty()).count()
}

/// Returns an error for members without a score for every source row whose s' is known.
fn need_scores(method: &str, members: &[Member]) -> Result<(), LearnError> {
    need_others(method, members)?;
    for (m, member) in members.iter().enumerate() {
        let (found, rows) = (member.row_scores.as_ref().map_or(0, |s| s.len()), member.scored_rows());
        if found != rows || member.row_scores.iter().flat_map(|s| s.iter()).any(|s| !s.is_finite()) {
            return Err(LearnError::invalid(
                format!("member {m}, row_scores"),
                format!("{found} numbers"),
                format!("a finite number for each of the {rows} source rows with a next state: {method} chooses by it"),
                "compute them for these very rows",
            ));
        }
    }
    Ok(())
}

/// The entries of `x` `[P, B, 1]` from row `first` on, sorted by member.
pub(crate) fn host_from(x: Tensor<3>, first: usize) -> Vec<f32> {
    let rows = x.dims()[1];
    host(x.narrow(1, first, rows - first))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn shares_are_rounded_down_as_published() {
        assert_eq!((kept_rows(0.8, 128), kept_rows(0.75, 128), kept_rows(0.8, 5), kept_rows(0.1, 5)), (102, 96, 4, 1));
    }

    /// Two members. Every row has its own number as state and reward, so that it can be identified.
    #[test]
    fn rows_keep_their_weights() {
        let column = |v: &[f32]| tensor(v.to_vec(), [2, 5, 1], &tce_nn::cpu());
        let numbers: Vec<f32> = (0..10).map(|i| i as f32).collect();
        let pick = |i: usize| Pick { part: u32::from(i % 5 >= 2), row: i as u32 };
        let batch = Minibatch {
            s: column(&numbers),
            a: column(&numbers),
            r: column(&numbers),
            s2: column(&numbers),
            not_done: column(&numbers),
            target_rows: 2,
            picks: (0..10).map(pick).collect(),
        };
        // Rows 2, 3, 4 of each member are the others.
        let kept = Selected::new(&batch, &[0.5, -1.0, 2.0, 3.0, 1.0, 2.0], 0.7, |score| 10.0 * score);
        assert_eq!(host(kept.batch.s.clone()), [0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 7.0, 9.0]);
        assert_eq!(host(kept.batch.r.clone()), host(kept.batch.s2.clone()));
        assert_eq!(host(kept.weights), [1.0, 1.0, 5.0, 20.0, 1.0, 1.0, 30.0, 20.0]);
        assert_eq!((kept.batch.target_rows, kept.batch.picks[3].row), (2, 4));
    }

    /// The source rows 1 and 4 have no s', and so no number. That of another row is ten times its index.
    #[test]
    fn scores_stay_with_their_rows() {
        let mut t = tce_data::Transitions::new(1, 1);
        (0..6).for_each(|i| t.push(&[i as f32], &[0.0], 0.0, &[0.0], i == 1 || i == 4, false));
        t.known = t.terminals.iter().map(|terminal| !terminal).collect();
        let t = Arc::new(t);
        let member = |scores: Vec<f32>| Member {
            streams: tce_base::Streams::new(1),
            parts: vec![t.clone(), t.clone()],
            standardizer: tce_data::Standardizer::identity(1),
            reward_scale: 1.0,
            row_scores: Some(Arc::new(scores)),
        };
        let own = vec![0.0, 20.0, 30.0, 50.0];
        let buffer = Buffer::new(vec![member(own.clone()), member(own.clone())], 200).unwrap();
        let batch = buffer.sample(0, &tce_nn::cpu());
        let scores = Scores::new("OTDF", &buffer).unwrap().of_others(&batch);
        let others = batch.picks.chunks(200).flat_map(|picks| &picks[100..]);
        assert_eq!(scores.len(), 200);
        assert!(others.clone().any(|pick| pick.row == 1) && others.clone().any(|pick| pick.row == 4));
        for (pick, score) in others.zip(scores) {
            match pick.row {
                1 | 4 => assert!(own.contains(&score), "borrowed {score}"),
                row => assert_eq!(score, 10.0 * row as f32),
            }
        }
        let error = Buffer::new(vec![member(vec![0.0; 6])], 200).unwrap_err().to_string();
        assert!(error.contains("4, one per row of part 1 whose s' is known"), "{error}");
    }

    #[test]
    fn rows_without_a_successor_borrow_a_score() {
        let known = [false, true, false, false, true, true, false, false, false, false];
        let mut scores = [9.0, 1.0, 9.0, 9.0, 2.0, 3.0, 9.0, 9.0, 9.0, 9.0];
        lend_scores(&known, &mut scores, 5);
        assert_eq!(scores, [2.0, 1.0, 1.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0]);
        lend_scores(&known[6..], &mut scores[6..], 4);
        assert_eq!(scores[6..], [0.0; 4], "none can be scored");
    }

    proptest! {
        /// Compares with the definition: no row that was left out is better than a kept one.
        #[test]
        fn what_is_kept_is_the_best(scores in prop::collection::vec(-3i8..3, 24), target in 0usize..4, count in 1usize..12) {
            let scores: Vec<f32> = scores.into_iter().map(f32::from).collect();
            for (rows, scores) in best_others(target, &scores, 12, count).iter().zip(scores.chunks(12)) {
                prop_assert_eq!(rows.len(), target + count);
                prop_assert!(rows.windows(2).all(|w| w[0] < w[1]));
                prop_assert!((0..target).all(|i| rows[i] == i));
                let kept: Vec<usize> = rows[target..].iter().map(|i| i - target).collect();
                let worst = kept.iter().map(|&i| scores[i]).fold(f32::INFINITY, f32::min);
                prop_assert!((0..12).filter(|i| !kept.contains(i)).all(|i| scores[i] <= worst));
            }
        }
    }
}
