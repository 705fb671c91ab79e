//! Segments of trajectories: the training data of models with a memory.
//!
//! A segment consists of the K steps that end at a row drawn from a member's tables, cut at the start of the episode.
//! This is what a policy knows when it acts. Half of the rows come from the target, half from the source, as in a
//! [`Buffer`]. Where the buffer's batches hold only rows with s', only such rows end a segment. Member m draws the rows of
//! step t from its stream `segments`, index t.
//!
//! | symbol | shape | meaning |
//! |---|---|---|
//! | s, a, r, s' | `[B, K, ·]` | the steps of a segment, starting at index 0; zeros after the last one |
//! | R̂ | `[B, K, 1]` | return to go: the sum of the rewards from a step (included) to the end of its episode |
//! | t | `[B, K]` | steps since the beginning of the episode |
//! | strip | `[B, h + K - 1, ·]` | (s, a, r) of the h steps before the segment, then of the segment; zeros before the episode |
//!
//! Steps k..k + h of the strip are the h steps before step k of the segment. The return to go of a cut episode is the
//! sum of the rewards that it has. A table without an order of time (generated rows: every row is its own episode)
//! gives segments of one step.

use std::sync::Arc;

use tce_data::Transitions;

use crate::buffer::{Buffer, Member, Pick};
use crate::shares::split;

/// The starts of the episodes of a member's tables, and the return to go of each row.
#[derive(Clone, Debug)]
pub struct Trajectories {
    tables: Vec<Table>,
}

#[derive(Clone, Debug)]
struct Table {
    rows: Arc<Transitions>,
    /// First row of each row's episode.
    first: Vec<u32>,
    /// R̂ of each row.
    to_go: Vec<f32>,
    best_return: f64,
}

/// Segments of one member; the arrays of the [module](self), row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Segments {
    /// s as network inputs.
    pub states: Vec<f32>,
    /// a
    pub actions: Vec<f32>,
    /// r
    pub rewards: Vec<f32>,
    /// s' as network inputs.
    pub next_states: Vec<f32>,
    /// R̂
    pub returns_to_go: Vec<f32>,
    /// t
    pub times: Vec<i32>,
    /// 1 for steps of the segment, 0 after the last one, `[B, K, 1]`.
    pub valid: Vec<f32>,
    /// s of the strip, as network inputs.
    pub strip_states: Vec<f32>,
    /// a of the strip.
    pub strip_actions: Vec<f32>,
    /// r of the strip.
    pub strip_rewards: Vec<f32>,
    /// The rows at which the segments end, `[B]`.
    pub picks: Vec<Pick>,
}

impl Trajectories {
    /// The trajectories of `member`.
    pub fn new(member: &Member) -> Self {
        Self { tables: member.parts.iter().map(|rows| Table::new(rows.clone())).collect() }
    }

    /// The largest return of a trajectory of the target.
    pub fn best_target_return(&self) -> f64 {
        self.tables.first().map_or(0.0, |t| t.best_return)
    }

    /// Number of rows of each table.
    pub(crate) fn rows(&self) -> impl Iterator<Item = usize> {
        self.tables.iter().map(|t| t.rows.len())
    }

    /// The segments of one step that end at the rows `range` of table `part`, with strips for `horizon` steps of history.
    pub(crate) fn block(
        &self,
        buffer: &Buffer,
        member: usize,
        part: usize,
        range: std::ops::Range<usize>,
        horizon: usize,
    ) -> Segments {
        let mut out = Segments::default();
        range.for_each(|row| self.tables[part].push(buffer, member, row, [1, horizon], &mut out));
        out
    }

    /// The `batch` segments of `step`, each of up to `context` steps, with strips for `horizon` steps of history (0: no
    /// strips).
    ///
    /// `member` is the index in `buffer` of the member with these trajectories.
    pub fn sample(&self, buffer: &Buffer, member: usize, step: u64, [batch, context, horizon]: [usize; 3]) -> Segments {
        let of = &buffer.members()[member];
        let mut rng = of.streams.indexed("segments", step);
        let mut out = Segments::default();
        for (part, (table, rows)) in self.tables.iter().zip(split(batch, &of.parts)).enumerate() {
            for _ in 0..rows {
                let row = buffer.draw(&table.rows, &mut rng);
                table.push(buffer, member, row, [context, horizon], &mut out);
                out.picks.push(Pick { part: part as u32, row: row as u32 });
            }
        }
        out
    }
}

impl Table {
    fn new(rows: Arc<Transitions>) -> Self {
        let mut first = vec![0; rows.len()];
        let mut to_go = vec![0.0; rows.len()];
        let mut best_return = f64::NEG_INFINITY;
        for episode in rows.episodes() {
            best_return = best_return.max(episode.episode_return);
            let mut sum = 0.0;
            for i in (episode.start..episode.end).rev() {
                sum += rows.rewards[i] as f64;
                (first[i], to_go[i]) = (episode.start as u32, sum as f32);
            }
        }
        Self { rows, first, to_go, best_return }
    }

    /// Appends the segment that ends at `row`.
    fn push(&self, buffer: &Buffer, member: usize, row: usize, [context, horizon]: [usize; 2], out: &mut Segments) {
        let (t, first) = (&self.rows, self.first[row] as usize);
        let start = first.max((row + 1).saturating_sub(context));
        let (d, a) = (buffer.inputs().len(), buffer.act_dim());
        let member = &buffer.members()[member];
        for i in start..start + context {
            // The segment ends at the drawn row, even if the episode continues.
            let valid = i <= row;
            out.valid.push(f32::from(u8::from(valid)));
            if valid {
                buffer.push(member, t.observation(i), &mut out.states);
                buffer.push(member, t.next_observation(i), &mut out.next_states);
                out.actions.extend_from_slice(t.action(i));
                out.rewards.push(t.rewards[i]);
                out.returns_to_go.push(self.to_go[i]);
                out.times.push((i - first) as i32);
            } else {
                out.states.resize(out.states.len() + d, 0.0);
                out.next_states.resize(out.next_states.len() + d, 0.0);
                out.actions.resize(out.actions.len() + a, 0.0);
                out.rewards.push(0.0);
                out.returns_to_go.push(0.0);
                out.times.push(0);
            }
        }
        for k in 0..if horizon > 0 { horizon + context - 1 } else { 0 } {
            // Step start - horizon + k; the drawn row itself is not part of any history.
            match (start + k).checked_sub(horizon).filter(|i| (first..row).contains(i)) {
                Some(i) => {
                    buffer.push(member, t.observation(i), &mut out.strip_states);
                    out.strip_actions.extend_from_slice(t.action(i));
                    out.strip_rewards.push(t.rewards[i]);
                }
                None => {
                    out.strip_states.resize(out.strip_states.len() + d, 0.0);
                    out.strip_actions.resize(out.strip_actions.len() + a, 0.0);
                    out.strip_rewards.push(0.0);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_base::Streams;
    use tce_data::Standardizer;

    /// Row i: s = [i + 100], a = [-i], r = i. Episodes 0..5 (terminal), 5..6 (time-out), 6..20 (the table ends).
    fn ordered() -> Transitions {
        let mut t = Transitions::new(1, 1);
        for i in 0..20 {
            let x = i as f32;
            t.push(&[x + 100.0], &[-x], x, &[x + 101.0], i == 4, i == 5);
        }
        t
    }

    fn generated() -> Transitions {
        let mut t = Transitions::new(1, 1);
        for i in 0..7 {
            t.push(&[i as f32 + 500.0], &[0.5], 1.0, &[0.0], false, true);
        }
        t
    }

    fn buffer(seed: u64) -> Buffer {
        let parts = vec![Arc::new(ordered()), Arc::new(generated())];
        let standardizer = Standardizer::identity(1);
        Buffer::new(
            vec![Member { streams: Streams::new(seed), parts, standardizer, reward_scale: 1.0, row_scores: None }],
            64,
        )
        .unwrap()
    }

    const K: usize = 4;
    const H: usize = 3;

    fn sample(seed: u64, step: u64) -> Segments {
        let buffer = buffer(seed);
        Trajectories::new(&buffer.members()[0]).sample(&buffer, 0, step, [40, K, H])
    }

    fn episode(row: usize) -> std::ops::Range<usize> {
        [0..5, 5..6, 6..20].into_iter().find(|e| e.contains(&row)).unwrap()
    }

    /// Checks every entry against the row numbers, by brute force.
    #[test]
    fn segments_end_at_their_row_and_never_cross_an_episode() {
        let s = sample(3, 7);
        assert!(s.picks.iter().take(20).all(|p| p.part == 0) && s.picks.iter().skip(20).all(|p| p.part == 1));
        for (b, pick) in s.picks.iter().enumerate() {
            let row = pick.row as usize;
            let steps =
                if pick.part == 1 { row..row + 1 } else { episode(row).start.max(row.saturating_sub(K - 1))..row + 1 };
            let begin = if pick.part == 1 { row } else { episode(row).start };
            for k in 0..K {
                let at = b * K + k;
                let i = steps.start + k;
                if i >= steps.end {
                    let zeros = [s.valid[at], s.states[at], s.actions[at], s.rewards[at], s.returns_to_go[at]];
                    assert_eq!(zeros, [0.0; 5]);
                    continue;
                }
                let (x, to_go) = match pick.part {
                    0 => ([i as f32 + 100.0, -(i as f32), i as f32], (i..episode(i).end).sum::<usize>() as f32),
                    _ => ([i as f32 + 500.0, 0.5, 1.0], 1.0),
                };
                assert_eq!([s.states[at], s.actions[at], s.rewards[at]], x);
                assert_eq!((s.valid[at], s.returns_to_go[at], s.times[at]), (1.0, to_go, (i - begin) as i32));
                // The H steps before step i; the last one is the nearest.
                for j in 0..H {
                    let at = b * (H + K - 1) + k + j;
                    let expected = match (i + j).checked_sub(H).filter(|n| *n >= begin) {
                        Some(n) => [n as f32 + 100.0, -(n as f32), n as f32],
                        None => [0.0; 3],
                    };
                    assert_eq!([s.strip_states[at], s.strip_actions[at], s.strip_rewards[at]], expected);
                }
            }
        }
    }

    /// The terminal row 4 has no s'. A buffer for models never draws it; the learner's does.
    #[test]
    fn a_row_without_a_successor_is_for_learners_alone() {
        let mut log = ordered();
        log.known[4] = false;
        let member = Member { parts: vec![Arc::new(log)], ..buffer(3).members()[0].clone() };
        let learners = Buffer::new(vec![member], 64).unwrap();
        let models = learners.clone().with_successors().unwrap();
        let trajectories = Trajectories::new(&learners.members()[0]);
        let drawn = |buffer: &Buffer| trajectories.sample(buffer, 0, 7, [400, 1, H]);
        assert!(drawn(&learners).picks.iter().any(|pick| pick.row == 4));
        assert!(drawn(&models).picks.iter().all(|pick| pick.row != 4));
        assert_eq!(drawn(&models).picks.len(), 400);
    }

    #[test]
    fn the_draw_depends_on_seed_and_step_alone() {
        assert_eq!(sample(3, 7), sample(3, 7));
        assert_ne!(sample(3, 7).picks, sample(3, 8).picks);
        assert_ne!(sample(3, 7).picks, sample(4, 7).picks);
        let buffer = buffer(1);
        assert_eq!(Trajectories::new(&buffer.members()[0]).best_target_return(), (6..20).sum::<i32>() as f64);
    }
}
