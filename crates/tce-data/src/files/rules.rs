//! Where episodes end and which stored successors are right. Facts: the public files, `datasets.md`.

/// What a file says row by row, before anything is dropped.
pub(super) struct Table<'a> {
    pub dim: usize,
    pub observations: &'a [f32],
    pub next_observations: &'a [f32],
    pub terminals: &'a [bool],
}

impl Table<'_> {
    fn len(&self) -> usize {
        self.terminals.len()
    }

    /// Whether there is a row i + 1 and the stored successor of row i equals its state.
    fn continues(&self, i: usize) -> bool {
        let d = self.dim;
        i + 1 < self.len() && self.next_observations[i * d..(i + 1) * d] == self.observations[(i + 1) * d..(i + 2) * d]
    }
}

/// Time-outs and wrong successors of a file without `timeouts`.
///
/// An episode ends at a terminal, after `limit` steps, where s'_i ≠ s_{i+1}, and at the last row: the first element
/// marks the ends that are no terminals. Where the stored successor of a row that ended by a terminal or by the limit is
/// the following row's state, it was built as s_{i+1} and is the next episode's first state: the second element marks
/// these rows, and with them a last row that ended so, whose successor was made up in some other way.
pub(super) fn infer_boundaries(t: &Table<'_>, limit: Option<usize>) -> (Vec<bool>, Vec<bool>) {
    let mut timeouts = vec![false; t.len()];
    let mut wrong = vec![false; t.len()];
    let (mut any, mut last_is_end) = (false, false);
    let mut start = 0;
    for i in 0..t.len() {
        let continues = t.continues(i);
        last_is_end = t.terminals[i] || Some(i + 1 - start) == limit;
        if last_is_end || !continues {
            timeouts[i] = !t.terminals[i];
            wrong[i] = last_is_end && continues;
            any |= wrong[i];
            start = i + 1;
        }
    }
    if let Some(last) = wrong.last_mut() {
        *last = any && last_is_end;
    }
    (timeouts, wrong)
}

/// Whether the stored successors of a file with `timeouts` were built as s_{i+1}: most of the rows that end an episode
/// have the following row's state as s'. (A single one may be a stream that was cut on purpose.)
pub(super) fn successors_are_next_rows(t: &Table<'_>, timeouts: &[bool]) -> bool {
    let ends: Vec<usize> = (0..t.len().saturating_sub(1)).filter(|&i| t.terminals[i] || timeouts[i]).collect();
    let joined = ends.iter().filter(|&&i| t.continues(i)).count();
    joined * 2 > ends.len()
}

/// Rows after which an episode was cut by the step limit, for a file that has neither `timeouts` nor
/// `next_observations`: D4RL counts steps.
pub(super) fn count_timeouts(terminals: &[bool], limit: Option<usize>) -> Vec<bool> {
    let mut steps = 0;
    terminals
        .iter()
        .map(|&terminal| {
            steps += 1;
            let full = Some(steps) == limit;
            if terminal || full {
                steps = 0;
            }
            full
        })
        .collect()
}

/// Marks the row before a dropped one as the end of its episode.
pub(super) fn cut_before_dropped(keep: &[bool], terminals: &[bool], timeouts: &mut [bool]) {
    for i in 1..keep.len() {
        if !keep[i] && keep[i - 1] && !terminals[i - 1] {
            timeouts[i - 1] = true;
        }
    }
}

/// Removes the rows that are not kept.
pub(super) fn retain_rows<T: Copy>(data: &mut Vec<T>, dim: usize, keep: &[bool]) {
    let mut to = 0;
    for (i, _) in keep.iter().enumerate().filter(|(_, k)| **k) {
        data.copy_within(i * dim..(i + 1) * dim, to);
        to += dim;
    }
    data.truncate(to);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(obs: &[f32], next: &[f32], terminals: &[bool], limit: usize) -> (Vec<bool>, Vec<bool>) {
        infer_boundaries(&Table { dim: 1, observations: obs, next_observations: next, terminals }, Some(limit))
    }

    #[test]
    fn right_successors_end_at_breaks_terminals_and_the_limit() {
        let obs = [0.0, 1.0, 2.0, 10.0, 11.0, 20.0];
        let next = [1.0, 2.0, 3.0, 11.0, 12.0, 21.0];
        let (timeouts, wrong) = check(&obs, &next, &[false, false, false, false, true, false], 3);
        assert_eq!(timeouts, [false, false, true, false, false, true]);
        assert_eq!(wrong, [false; 6]);
    }

    #[test]
    fn successors_built_from_the_next_row_are_wrong_at_every_end() {
        // Row 2 reaches the limit, row 4 is a terminal, the last row is one too: its s' cannot be right either.
        let obs = [0.0, 1.0, 2.0, 10.0, 11.0, 20.0];
        let next = [1.0, 2.0, 10.0, 11.0, 20.0, 0.0];
        let (timeouts, wrong) = check(&obs, &next, &[false, false, false, false, true, true], 3);
        assert_eq!(timeouts, [false, false, true, false, false, false]);
        assert_eq!(wrong, [false, false, true, false, true, true]);
    }

    #[test]
    fn a_cut_stream_is_not_mistaken_for_rebuilt_successors() {
        let t = |next: &'static [f32]| Table {
            dim: 1,
            observations: &[0.0, 1.0, 10.0, 11.0, 20.0, 21.0],
            next_observations: next,
            terminals: &[false; 6],
        };
        let timeouts = [false, true, false, true, false, true];
        assert!(successors_are_next_rows(&t(&[1.0, 10.0, 11.0, 20.0, 21.0, 22.0]), &timeouts));
        assert!(!successors_are_next_rows(&t(&[1.0, 10.0, 11.0, 12.0, 21.0, 22.0]), &timeouts));
    }

    #[test]
    fn steps_are_counted_from_the_last_end() {
        let got = count_timeouts(&[false, true, false, false, false, false], Some(3));
        assert_eq!(got, [false, false, false, false, true, false]);
    }

    #[test]
    fn dropping_rows_cuts_their_episode() {
        let mut timeouts = [false; 5];
        cut_before_dropped(&[true, false, true, true, false], &[false, false, false, true, false], &mut timeouts);
        assert_eq!(timeouts, [true, false, false, false, false]);
        let mut data = vec![0, 0, 1, 1, 2, 2];
        retain_rows(&mut data, 2, &[false, true, true]);
        assert_eq!(data, [1, 1, 2, 2]);
    }
}
