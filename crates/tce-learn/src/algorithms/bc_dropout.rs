//! How much dropout a clone needs, told by the target's rows alone.
//!
//! ```text
//! e_p = RMSE of clones with dropout p, each row's by the clone of the fold that has not seen it
//! p   = MUCH if e_MUCH < (1 - MARGIN) e_0, else 0
//! ```
//!
//! | symbol | constant | value | source |
//! |---|---|---|---|
//! | – | [`MUCH`] | .3 | own |
//! | – | `MARGIN` | .02 | own |
//! | – | `FOLDS` | 4, of runs of 25 rows | own: a single tenth told one thing or the other by its place (bench/expansion.md) |
//! | – | `STEPS` | 4 000, a twelfth of the clones' steps if that is less | own: an eighth of the time of five clones |
//!
//! Where the rows lie close to each other, a clone finds the behaviour's action between them, and dropout only blurs it: HalfCheetah, morph, 90.2
//! points without and 62.9 with it, Walker2d, gravity, 69.2 and 19.5. Where a few episodes go through very different states, the clone's guess
//! between them is bad, and dropout smooths it: Walker2d, kinematic, 51.1 without and 79.1 with it. The error at rows that the clone has not
//! seen tells the two apart (bench/expansion.md).

use std::sync::Arc;

use tce_base::Streams;
use tce_data::{Transitions, fold_of_runs};
use tce_nn::Device;

use crate::buffer::{Buffer, Member};
use crate::error::LearnError;
use crate::labels::rmse;
use crate::policy::{Policy, PolicyLearner};
use crate::training::{Journal, Place, prepare};

/// The dropout of clones that need it.
pub const MUCH: f64 = 0.3;
/// Share by which dropout has to lower the error.
const MARGIN: f64 = 0.02;
/// Parts of the target's rows, each of which is held out once.
const FOLDS: usize = 4;
/// Updates of the comparison, at most.
const STEPS: u64 = 4_000;
/// With fewer rows nothing is held out, and there is no dropout.
const FEWEST: usize = 250;

/// The dropout of every member of `buffer`, whose clones are trained for `steps` steps. It depends on the member's target rows and their
/// standardisation, and on nothing else: members of different seeds have the same. What a job of the journal of `place` has found out is
/// not tried again for the same rows. `clones` makes clones of the members of a buffer, with a rate each, for so many steps. `None` if the
/// user interrupted it.
///
/// # Errors
/// Those of `clones`, and if a checkpoint cannot be read or written.
pub(super) fn chosen<L: PolicyLearner>(
    buffer: &Buffer,
    steps: u64,
    place: Place<'_>,
    device: &Device,
    clones: impl Fn(&Buffer, Vec<f64>, u64) -> Result<L, LearnError>,
) -> Result<Option<Vec<f64>>, LearnError> {
    let (members, journal) = (buffer.members(), place.journal);
    // The metrics of these clones are not the members'.
    let place = Place { journal: None, ..place };
    let steps = STEPS.min(steps.div_ceil(12));
    let mut rates: Vec<f64> = Vec::with_capacity(members.len());
    for (m, member) in members.iter().enumerate() {
        let here = members[..m].iter().position(|other| same(other, member)).map(|earlier| rates[earlier]);
        let rate = match here.or_else(|| journal.and_then(|journal| found(journal, member))) {
            Some(rate) => rate,
            None if member.parts[0].len() < FEWEST => 0.0,
            None => {
                let folds = Folds::of(member);
                let rows = Buffer::new(folds.members, buffer.batch())?;
                let mut learner = clones(&rows, folds.rates, steps)?;
                let label = if m == 0 { "choose dropout".to_owned() } else { format!("choose dropout {m}") };
                if !prepare(&mut learner, &rows, steps, &label, place, device)? {
                    return Ok(None);
                }
                let rate = told(&learner.policies(), &folds.unseen);
                if let Some(journal) = journal {
                    journal.dropout.lock().expect("no job has panicked").push((member.clone(), rate));
                }
                rate
            }
        };
        rates.push(rate);
    }
    Ok(Some(rates))
}

/// Whether two members have the same target rows in the same units.
fn same(a: &Member, b: &Member) -> bool {
    (Arc::ptr_eq(&a.parts[0], &b.parts[0]) || a.parts[0] == b.parts[0]) && a.standardizer == b.standardizer
}

/// What a job has found out about the rows of `member`.
fn found(journal: &Journal, member: &Member) -> Option<f64> {
    let dropout = journal.dropout.lock().expect("no job has panicked");
    dropout.iter().find(|(other, _)| same(other, member)).map(|(_, rate)| *rate)
}

/// Two members for each fold of a member's target rows, without dropout and with it, and the rows that they do not see.
struct Folds {
    members: Vec<Member>,
    rates: Vec<f64>,
    unseen: Vec<Transitions>,
}

impl Folds {
    fn of(member: &Member) -> Self {
        let target = &member.parts[0];
        let folds = fold_of_runs(target.len(), FOLDS);
        let mut all = Self { members: Vec::new(), rates: Vec::new(), unseen: Vec::new() };
        for fold in 0..FOLDS {
            let (held_out, seen): (Vec<usize>, Vec<usize>) = (0..target.len()).partition(|&i| folds[i] == fold);
            let seen = Arc::new(target.select(&seen));
            all.unseen.push(target.select(&held_out));
            for rate in [0.0, MUCH] {
                // Both have the same weights at the start and the same batches.
                let streams = Streams::new(fold as u64);
                all.members.push(Member { streams, parts: vec![seen.clone()], row_scores: None, ..member.clone() });
                all.rates.push(rate);
            }
        }
        all
    }
}

/// What the policies of all folds, in pairs, say of the rows that they have not seen.
fn told(policies: &[Policy], unseen: &[Transitions]) -> f64 {
    let mut squares = [0.0; 2];
    for (k, policy) in policies.iter().enumerate() {
        let rows = &unseen[k / 2];
        let mut actions = vec![0.0; rows.actions.len()];
        policy.act(&rows.observations, None, &mut actions);
        squares[k % 2] += rmse(&actions, &rows.actions).powi(2) * rows.len() as f64;
    }
    let [without, with] = squares.map(f64::sqrt);
    if with < (1.0 - MARGIN) * without { MUCH } else { 0.0 }
}
