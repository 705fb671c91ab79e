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
use tce_base::{Rng, Streams};
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
    /// One number per row of part 1 whose s' is known, in their order, if an algorithm weighs or filters these rows: a
    /// transport cost, a score. Both compare transitions (s, a, s').
    pub row_scores: Option<Arc<Vec<f32>>>,
}

impl Member {
    /// Rows of part 1 whose s' is known: those that have a number in `row_scores`.
    pub(crate) fn scored_rows(&self) -> usize {
        self.parts.get(1).map_or(0, |part| part.known.iter().filter(|known| **known).count())
    }
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
    /// Whether only rows whose s' is known are drawn.
    successors: bool,
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
            let rows = member.scored_rows();
            if let Some(scores) = member.row_scores.as_ref().filter(|s| s.len() != rows) {
                let (field, found) = (format!("member {k}, row_scores"), format!("{} numbers", scores.len()));
                let expected = format!("{rows}, one per row of part 1 whose s' is known");
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
        Ok(Self { members, batch, inputs, act_dim: dims.1, stream, fade: None, successors: false, continued })
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

    /// The same, where batches hold only rows whose s' is known: for models that need it. If all are known, the batches
    /// are the same. The rows of a [`Pick`] are still those of the whole tables.
    ///
    /// # Errors
    /// If a table has rows, and the s' of none of them is known.
    pub(crate) fn with_successors(self) -> Result<Self, LearnError> {
        for (m, member) in self.members.iter().enumerate() {
            for (p, part) in member.parts.iter().enumerate() {
                if !part.is_empty() && !part.known.contains(&true) {
                    let (field, found) = (format!("member {m}, part {p}"), format!("{} rows without s'", part.len()));
                    let remedy = "record the next states as `next_observations`";
                    return Err(LearnError::invalid(field, found, "at least one row with s'", remedy));
                }
            }
        }
        Ok(Self { successors: true, ..self })
    }

    /// A row of `part`, one of the parts, that batches may hold.
    pub(crate) fn draw(&self, part: &Transitions, rng: &mut Rng) -> usize {
        loop {
            let i = rng.random_range(0..part.len());
            if !self.successors || part.known[i] {
                return i;
            }
        }
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
        let members = vec![member];
        Self { members, batch, inputs, act_dim: dims.1, stream, fade: None, successors: false, continued }
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
                    let i = self.draw(part, &mut rng);
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

    /// Whether s' is known, for the rows of a batch of these members from row `first` on, sorted by member. A row whose
    /// s' is not known is terminal: no target of a critic needs it.
    pub(crate) fn known_from(&self, batch: &Minibatch, first: usize) -> Vec<bool> {
        let b = batch.s.dims()[1];
        let of = |(member, picks): (&Member, &[Pick])| -> Vec<bool> {
            picks[first..].iter().map(|pick| member.parts[pick.part as usize].known[pick.row as usize]).collect()
        };
        self.members.iter().zip(batch.picks.chunks(b)).flat_map(of).collect()
    }

    /// [`Buffer::known_from`] as numbers, 1 if it is known, else 0, `[P, B - first, 1]`.
    pub(crate) fn known(&self, batch: &Minibatch, first: usize) -> Tensor<3> {
        let known: Vec<f32> = self.known_from(batch, first).into_iter().map(f32::from).collect();
        let p = self.members.len();
        let rows = known.len() / p;
        tensor(known, [p, rows, 1], &batch.s.device())
    }

    /// The members' reward scales `[P, 1, 1]`: the factors on what a method adds to rewards.
    pub(crate) fn reward_scales(&self, device: &Device) -> Tensor<3> {
        tensor(self.members.iter().map(|m| m.reward_scale).collect(), [self.members.len(), 1, 1], device)
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
pub(crate) mod tests;
