//! The rows that a learner trains on, and minibatches of them for a whole population.
//!
//! | concept | here |
//! |---|---|
//! | D_tar, D_mix | the parts of a [`Member`]: part 0 is the target, the others are source or generated rows |
//! | 128 + 128 rows (Table C.4) | the batch is split evenly over the existing parts; a single part gives all rows |
//! | observation standardisation | applied when a row is drawn: raw and standardised members share one table in memory |
//! | reward scale | likewise |
//!
//! Member m draws the rows of step t from its stream `batch`, index t. A run resumed at t draws the same rows.

use std::sync::{Arc, OnceLock};

use rand::RngExt;
use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_data::{Standardizer, Transitions, continued};
use tce_nn::burn::tensor::{Int, TensorData};
use tce_nn::{Device, Tensor, tensor};

use crate::error::LearnError;
use crate::shares::{faded, split};

/// The data of one member of a population.
#[derive(Clone, Debug)]
pub struct Member {
    /// Random streams of this member: initial weights, batches, noise.
    pub streams: Streams,
    /// The data sets; the target's is the first. Members may share them.
    pub parts: Vec<Arc<Transitions>>,
    /// Standardises observations for the networks; [`Standardizer::identity`] for raw ones. Its `dead` dimensions are
    /// hidden from the networks if they are dead for every member, so a raw member may list them, too.
    pub standardizer: Standardizer,
    /// Factor on every reward; 1 for no scaling, see [`return_range_scale`].
    pub reward_scale: f32,
    /// One number per row of part 1, if an algorithm weighs or filters these rows: a transport cost, a score.
    /// [`Minibatch::picks`] gives the indices of a batch's rows.
    pub row_scores: Option<Arc<Vec<f32>>>,
}

/// The data of all members, which have the same dimensions and batch size.
#[derive(Clone, Debug)]
pub struct Buffer {
    members: Vec<Member>,
    batch: usize,
    inputs: Vec<usize>,
    act_dim: usize,
    /// The name of the random stream for batches.
    stream: &'static str,
    /// The step from which on batches hold target rows alone.
    fade: Option<u64>,
    /// [`continued`] of every member's parts, from the first call of [`Buffer::next_actions`] on.
    continued: OnceLock<Vec<Vec<Vec<bool>>>>,
}

/// The origin of a batch entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pick {
    /// Index of the part.
    pub part: u32,
    /// Row within the part.
    pub row: u32,
}

/// `[P, B, ·]` tensors on the device, without autodiff. The rows of part 0 (the target) come first.
#[derive(Clone, Debug)]
pub struct Minibatch {
    /// s, `[P, B, inputs]`, as network inputs.
    pub s: Tensor<3>,
    /// a, `[P, B, act_dim]`.
    pub a: Tensor<3>,
    /// r, scaled, `[P, B, 1]`.
    pub r: Tensor<3>,
    /// s', `[P, B, inputs]`.
    pub s2: Tensor<3>,
    /// 1 - terminal, `[P, B, 1]`.
    pub not_done: Tensor<3>,
    /// Number of rows at the beginning of every member's batch that come from the target.
    pub target_rows: usize,
    /// The origin of the rows, `[P · B]`.
    pub picks: Vec<Pick>,
}

impl Minibatch {
    /// The rows `rows[m]` of every member m, in that order: a batch after filtering. Target rows must come first, as in
    /// the batch; ascending indices ensure this.
    ///
    /// # Panics
    /// If there is not one list per member, the lists are empty or differ in length, or an index is out of range.
    pub fn keep(&self, rows: &[Vec<usize>]) -> Self {
        let [p, b, _] = self.s.dims();
        let kept = rows.first().map_or(0, Vec::len);
        assert!(
            kept > 0 && rows.len() == p && rows.iter().all(|r| r.len() == kept),
            "one list of rows per member, all of one length"
        );
        let own = |m: usize| move |&i: &usize| (i < b).then_some(m * b + i).expect("a row of the batch");
        let picks: Vec<_> =
            rows.iter().enumerate().flat_map(|(m, r)| r.iter().map(own(m)).map(|at| self.picks[at])).collect();
        let target = |picks: &[Pick]| picks.iter().take_while(|p| p.part == 0).count();
        let target_rows = picks.chunks(kept).map(target).min().unwrap_or(0);
        let indices: Vec<i64> = rows.iter().flatten().map(|&i| i as i64).collect();
        let indices = Tensor::<3, Int>::from_data(TensorData::new(indices, [p, kept, 1]), &self.s.device());
        let take = |t: &Tensor<3>| {
            let width = t.dims()[2];
            t.clone().gather(1, indices.clone().expand([p, kept, width]))
        };
        Self {
            s: take(&self.s),
            a: take(&self.a),
            r: take(&self.r),
            s2: take(&self.s2),
            not_done: take(&self.not_done),
            target_rows,
            picks,
        }
    }
}

impl Buffer {
    /// A buffer that draws `batch` rows per member and step.
    ///
    /// # Errors
    /// If there is no member, a member has no rows, no target rows, or other dimensions than the rest.
    pub fn new(members: Vec<Member>, batch: usize) -> Result<Self, LearnError> {
        let Some(first) = members.first().and_then(|m| m.parts.first()) else {
            return Err(LearnError::invalid(
                "members",
                "none",
                "at least one, with target rows",
                "give data to learn from",
            ));
        };
        let dims = (first.obs_dim, first.act_dim);
        for (k, member) in members.iter().enumerate() {
            for (p, part) in member.parts.iter().enumerate() {
                if (part.obs_dim, part.act_dim) != dims {
                    let found = format!("{} observations, {} actions", part.obs_dim, part.act_dim);
                    let expected = format!("{} and {} as in member 0, part 0", dims.0, dims.1);
                    let field = format!("member {k}, part {p}");
                    return Err(LearnError::invalid(field, found, expected, "use data of one agent"));
                }
            }
            if member.parts.first().is_none_or(|t| t.is_empty()) {
                let field = format!("member {k}, part 0 (target)");
                return Err(LearnError::invalid(field, "no rows", "at least one", "check the data set"));
            }
            if member.standardizer.dim() != dims.0 {
                let field = format!("member {k}, standardizer");
                let expected = format!("{}", dims.0);
                return Err(LearnError::invalid(field, member.standardizer.dim(), expected, "fit it on this data"));
            }
            let rows = member.parts.get(1).map_or(0, |p| p.len());
            if let Some(scores) = member.row_scores.as_ref().filter(|s| s.len() != rows) {
                let (field, found) = (format!("member {k}, row_scores"), format!("{} numbers", scores.len()));
                let expected = format!("{rows}, one per row of part 1");
                return Err(LearnError::invalid(field, found, expected, "compute them for these rows"));
            }
            let live = member.parts.iter().filter(|p| !p.is_empty()).count();
            if batch < live {
                let expected = format!("at least {live}, one row per part");
                return Err(LearnError::invalid("batch", batch, expected, "enlarge the batch"));
            }
        }
        // A dimension that is constant in the data of every member would only cost time (Ant's 84 contact slots).
        let live = |d: &usize| members.iter().any(|m| !m.standardizer.dead.contains(d));
        let inputs = (0..dims.0).filter(live).collect();
        let (stream, continued) = ("batch", OnceLock::new());
        Ok(Self { members, batch, inputs, act_dim: dims.1, stream, fade: None, continued })
    }

    /// The same with batches from another stream: two learners with one seed must not draw the same rows at every step.
    pub fn with_stream(self, stream: &'static str) -> Self {
        Self { stream, ..self }
    }

    /// The same, where the other parts' share of a batch falls linearly from its whole at step 0 to nothing at step
    /// `until`. Their places go to the target.
    pub fn fading(self, until: Option<u64>) -> Self {
        Self { fade: until, ..self }
    }

    /// Rows of each of `parts` in the batch of `step`.
    fn split(&self, step: u64, parts: &[Arc<Transitions>]) -> Vec<usize> {
        let rows = split(self.batch, parts);
        match self.fade {
            Some(until) => faded(rows, step, until),
            None => rows,
        }
    }

    /// An empty buffer of one member that grows by [`Buffer::replay_mut`]: the replay buffer of an agent. Observations
    /// are not standardised; the dimensions `dead` are left out. Sample once it has `batch` rows or more.
    pub fn replay(streams: Streams, dims: (usize, usize), dead: Vec<usize>, batch: usize) -> Self {
        let standardizer = Standardizer { dead, ..Standardizer::identity(dims.0) };
        let inputs = (0..dims.0).filter(|d| !standardizer.dead.contains(d)).collect();
        let parts = vec![Arc::new(Transitions::new(dims.0, dims.1))];
        let member = Member { streams, parts, standardizer, reward_scale: 1.0, row_scores: None };
        let (stream, continued) = ("batch", OnceLock::new());
        Self { members: vec![member], batch, inputs, act_dim: dims.1, stream, fade: None, continued }
    }

    /// The table of a replay buffer, to add rows to.
    ///
    /// # Panics
    /// If the table of the first member is shared.
    pub fn replay_mut(&mut self) -> &mut Transitions {
        // The rows will change.
        self.continued.take();
        Arc::get_mut(&mut self.members[0].parts[0]).expect("a replay table has one owner")
    }

    /// The members.
    pub fn members(&self) -> &[Member] {
        &self.members
    }

    /// The members' random streams, for the constructors of networks.
    pub fn streams(&self) -> Vec<Streams> {
        self.members.iter().map(|m| m.streams).collect()
    }

    /// The observation dimensions that the networks see, ascending: all except those that are dead for every member.
    pub fn inputs(&self) -> &[usize] {
        &self.inputs
    }

    /// Action dimension.
    pub fn act_dim(&self) -> usize {
        self.act_dim
    }

    /// Observation dimension of the data.
    pub fn obs_dim(&self) -> usize {
        self.members[0].standardizer.dim()
    }

    /// Rows per member and step.
    pub fn batch(&self) -> usize {
        self.batch
    }

    /// The same members with only the target part, and another batch size.
    pub fn target_only(&self, batch: usize) -> Result<Self, LearnError> {
        let only = |m: &Member| Member { parts: m.parts[..1].to_vec(), row_scores: None, ..m.clone() };
        Ok(Self { inputs: self.inputs.clone(), ..Self::new(self.members.iter().map(only).collect(), batch)? })
    }

    /// The minibatch of `step`.
    pub fn sample(&self, step: u64, device: &Device) -> Minibatch {
        let (p, b, d, a) = (self.members.len(), self.batch, self.inputs.len(), self.act_dim);
        let room = |width: usize| Vec::with_capacity(p * b * width);
        let (mut s, mut actions, mut r, mut s2, mut not_done) = (room(d), room(a), room(1), room(d), room(1));
        let mut picks = Vec::with_capacity(p * b);
        let mut target_rows = b;
        for member in &self.members {
            let mut rng = member.streams.indexed(self.stream, step);
            let split = self.split(step, &member.parts);
            target_rows = target_rows.min(split[0]);
            for (k, (part, &rows)) in member.parts.iter().zip(&split).enumerate() {
                for _ in 0..rows {
                    let i = rng.random_range(0..part.len());
                    self.push(member, part.observation(i), &mut s);
                    self.push(member, part.next_observation(i), &mut s2);
                    actions.extend_from_slice(part.action(i));
                    r.push(part.rewards[i] * member.reward_scale);
                    not_done.push(if part.terminals[i] { 0.0 } else { 1.0 });
                    picks.push(Pick { part: k as u32, row: i as u32 });
                }
            }
        }
        Minibatch {
            s: tensor(s, [p, b, d], device),
            a: tensor(actions, [p, b, a], device),
            r: tensor(r, [p, b, 1], device),
            s2: tensor(s2, [p, b, d], device),
            not_done: tensor(not_done, [p, b, 1], device),
            target_rows,
            picks,
        }
    }

    /// The actions of the next rows `[P, B, d_a]`, and 1 if the data contain them, else 0, `[P, B, 1]`. The next row
    /// must belong to the same episode and start where this row ends, up to rounding ([`continued`]). Generated rows have
    /// no next row.
    pub fn next_actions(&self, batch: &Minibatch) -> (Tensor<3>, Tensor<3>) {
        let [p, b, a] = batch.a.dims();
        let (mut actions, mut known) = (vec![0.0; p * b * a], vec![0.0; p * b]);
        let of = |m: &Member| m.parts.iter().map(|part| continued(part)).collect();
        let continued = self.continued.get_or_init(|| self.members.iter().map(of).collect());
        for (k, pick) in batch.picks.iter().enumerate() {
            let (member, part, i) = (k / b, pick.part as usize, pick.row as usize);
            if continued[member][part][i] {
                actions[k * a..(k + 1) * a].copy_from_slice(self.members[member].parts[part].action(i + 1));
                known[k] = 1.0;
            }
        }
        let device = batch.a.device();
        (tensor(actions, [p, b, a], &device), tensor(known, [p, b, 1], &device))
    }

    /// Observations of member `member` as network inputs: the visible dimensions, standardised, row-major.
    pub fn network_inputs(&self, member: usize, observations: &[f32]) -> Vec<f32> {
        let mut out = Vec::with_capacity(observations.len() / self.obs_dim() * self.inputs.len());
        for row in observations.chunks_exact(self.obs_dim()) {
            self.push(&self.members[member], row, &mut out);
        }
        out
    }

    /// The spread of the steps s' - s of the member's part 0, in the units of [`Buffer::network_inputs`].
    pub(crate) fn step_units(&self, member: usize) -> Standardizer {
        let rows = &self.members[member].parts[0];
        let mut steps = self.network_inputs(member, &rows.next_observations);
        let states = self.network_inputs(member, &rows.observations);
        steps.iter_mut().zip(states).for_each(|(step, s)| *step -= s);
        Standardizer::fit(&steps, self.inputs.len())
    }

    /// Appends an observation of `member` as network inputs.
    pub(crate) fn push(&self, member: &Member, row: &[f32], out: &mut Vec<f32>) {
        let z = &member.standardizer;
        out.extend(self.inputs.iter().map(|&d| (row[d] - z.mean[d]) / z.std[d]));
    }
}

/// How rewards are scaled before they reach a critic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RewardScale {
    /// As they are.
    #[default]
    None,
    /// Times 1000 / (best - worst return of a trajectory), as IQL's authors do for MuJoCo ([`return_range_scale`]).
    ReturnRange,
}

/// 1000 / (max - min) of the returns of all trajectories of `tables`.
///
/// Pass data sets with real trajectories: the target's and the source's. Do not pass generated rows, in which every row
/// is a trajectory. IQL's authors used the whole data set that the learner sees.
///
/// # Errors
/// If all trajectories have the same return, or there are fewer than two.
pub fn return_range_scale(tables: &[&Transitions]) -> Result<f32, LearnError> {
    let returns = tables.iter().flat_map(|t| t.episodes()).map(|e| e.episode_return);
    let (min, max) = returns.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), r| (lo.min(r), hi.max(r)));
    if max > min {
        return Ok((1000.0 / (max - min)) as f32);
    }
    let remedy = "use reward_scale = none, or give more trajectories";
    Err(LearnError::invalid(
        "reward_scale = return_range",
        format!("returns {min} to {max}"),
        "two different returns",
        remedy,
    ))
}

/// The best trajectories by return: the smallest number of them, at least one, that is at least the share `top` of all.
///
/// A trajectory that is cut at the table's end is ranked by the sum of its existing rewards. If rewards are positive,
/// it may be left out although it would have become good, but it is never kept on a guess. Ties go to the earlier one.
///
/// # Errors
/// If `top` is not in (0, 1] or there are no rows.
pub fn best_trajectories(t: &Transitions, top: f64) -> Result<Transitions, LearnError> {
    let mut episodes = t.episodes();
    if !(top > 0.0 && top <= 1.0) {
        return Err(LearnError::invalid("top", top, "a share in (0, 1]", "1 keeps every trajectory"));
    }
    if episodes.is_empty() {
        return Err(LearnError::invalid("data", "no rows", "at least one trajectory", "check the data set"));
    }
    let keep = ((top * episodes.len() as f64) - 1e-9).ceil().max(1.0) as usize;
    episodes.sort_by(|a, b| b.episode_return.total_cmp(&a.episode_return).then(a.start.cmp(&b.start)));
    episodes.truncate(keep);
    episodes.sort_by_key(|e| e.start);
    let rows: Vec<usize> = episodes.iter().flat_map(|e| e.start..e.end).collect();
    Ok(t.select(&rows))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_nn::{cpu, host};

    /// Row i: s = [i, 7], a = [-i], r = i, s' = [i + 1, 7]; three trajectories of returns 0+1, 2+3+4 and 5 (cut).
    fn table() -> Transitions {
        let mut t = Transitions::new(2, 1);
        for i in 0..6 {
            let x = i as f32;
            t.push(&[x, 7.0], &[-x], x, &[x + 1.0, 7.0], i == 1, i == 4);
        }
        t
    }

    fn member(seed: u64, parts: Vec<Transitions>) -> Member {
        let standardizer = Standardizer::fit(&parts[0].observations, 2);
        let parts = parts.into_iter().map(Arc::new).collect();
        Member { streams: Streams::new(seed), parts, standardizer, reward_scale: 2.0, row_scores: None }
    }

    #[test]
    fn rows_stay_together_and_dead_inputs_are_left_out() {
        let buffer = Buffer::new(vec![member(1, vec![table(), table()]), member(2, vec![table()])], 9).unwrap();
        assert_eq!(buffer.inputs(), [0]);
        let batch = buffer.sample(3, &cpu());
        assert_eq!((batch.s.dims(), batch.target_rows), ([2, 9, 1], 5));
        let (s, a, r, s2, nd) = (host(batch.s), host(batch.a), host(batch.r), host(batch.s2), host(batch.not_done));
        let z = &buffer.members()[0].standardizer;
        for (k, pick) in batch.picks.iter().enumerate() {
            let x = pick.row as f32;
            assert_eq!(pick.part, u32::from((5..9).contains(&k)));
            assert_eq!((a[k], r[k], nd[k]), (-x, 2.0 * x, f32::from(pick.row != 1)));
            assert_eq!((s[k], s2[k]), ((x - z.mean[0]) / z.std[0], (x + 1.0 - z.mean[0]) / z.std[0]));
        }
    }

    #[test]
    fn kept_rows_stay_whole() {
        let buffer =
            Buffer::new(vec![member(1, vec![table(), table()]), member(2, vec![table(), table()])], 8).unwrap();
        let batch = buffer.sample(0, &cpu());
        let rows = [vec![0, 1, 3, 5], vec![2, 3, 6, 7]];
        let kept = batch.keep(&rows);
        assert_eq!((kept.s.dims(), kept.a.dims(), kept.target_rows), ([2, 4, 1], [2, 4, 1], 2));
        let columns = |b: &Minibatch| [&b.s, &b.a, &b.r, &b.s2, &b.not_done].map(|t| host(t.clone()));
        let (all, some) = (columns(&batch), columns(&kept));
        for (k, at) in rows.iter().enumerate().flat_map(|(m, r)| r.iter().map(move |i| 8 * m + i)).enumerate() {
            assert_eq!(kept.picks[k], batch.picks[at]);
            for (some, all) in some.iter().zip(&all) {
                assert_eq!(some[k], all[at]);
            }
        }
        assert_eq!(batch.keep(&[vec![0, 1], vec![1, 2]]).target_rows, 2, "target rows alone");
    }

    #[test]
    fn next_actions_stay_within_episodes() {
        let buffer = Buffer::new(vec![member(1, vec![table()])], 40).unwrap();
        let batch = buffer.sample(0, &cpu());
        let (actions, known) = buffer.next_actions(&batch);
        for ((pick, a), known) in batch.picks.iter().zip(host(actions)).zip(host(known)) {
            // Rows 1 and 4 end their episodes, row 5 ends the table.
            let expected = if [1, 4, 5].contains(&pick.row) { (0.0, 0.0) } else { (-(pick.row as f32) - 1.0, 1.0) };
            assert_eq!((a, known), expected, "row {}", pick.row);
        }
    }

    #[test]
    fn a_member_draws_the_same_rows_alone() {
        let two = Buffer::new(vec![member(1, vec![table()]), member(2, vec![table()])], 4).unwrap();
        let one = Buffer::new(vec![member(2, vec![table()])], 4).unwrap();
        assert_eq!(two.sample(5, &cpu()).picks[4..], one.sample(5, &cpu()).picks);
        assert_ne!(one.sample(5, &cpu()).picks, one.sample(6, &cpu()).picks);
    }

    #[test]
    fn bad_input_is_refused() {
        let empty = Transitions::new(2, 1);
        let other = Transitions::new(3, 1);
        for (members, batch, needle) in [
            (vec![], 4, "members"),
            (vec![member(1, vec![table(), other])], 4, "member 0, part 1"),
            (vec![member(1, vec![table(), table()])], 1, "batch"),
        ] {
            let error = Buffer::new(members, batch).unwrap_err().to_string();
            assert!(error.contains(needle), "{error}");
        }
        let mut without_target = member(1, vec![table()]);
        without_target.parts.insert(0, Arc::new(empty));
        let scored = Member { row_scores: Some(Arc::new(vec![0.0; 5])), ..member(1, vec![table(), table()]) };
        assert!(Buffer::new(vec![scored], 4).unwrap_err().to_string().contains("member 0, row_scores"));
        assert!(Buffer::new(vec![without_target], 4).unwrap_err().to_string().contains("target"));
    }

    #[test]
    fn the_best_trajectories_are_whole_ones() {
        // Returns 1, 9 and 5.
        assert_eq!(best_trajectories(&table(), 0.1).unwrap().rewards, [2.0, 3.0, 4.0]);
        assert_eq!(best_trajectories(&table(), 0.34).unwrap().rewards, [2.0, 3.0, 4.0, 5.0]);
        assert_eq!(best_trajectories(&table(), 2.0 / 3.0).unwrap().len(), 4);
        assert_eq!(best_trajectories(&table(), 1.0).unwrap().len(), 6);
        assert!(best_trajectories(&table(), 0.0).is_err());
    }

    #[test]
    fn rewards_scale_by_the_range_of_returns() {
        assert_eq!(return_range_scale(&[&table()]).unwrap(), 125.0);
        assert!(return_range_scale(&[&Transitions::new(1, 1)]).is_err());
    }
}
