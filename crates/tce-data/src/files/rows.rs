//! Helpers for rows, addressed by index.

/// Lists rows in words: `row 3`, `rows 3, 7 and 11`, `rows 99, 199, 299 and 16 more`.
pub(super) fn tell(rows: &[usize]) -> String {
    listed("row", rows)
}

/// Lists numbered things, of which one is a `noun`, as [`tell`] lists rows.
pub(super) fn listed(noun: &str, numbers: &[usize]) -> String {
    match numbers {
        [] => format!("no {noun}"),
        [one] => format!("{noun} {one}"),
        [a, b, c, _, _, ..] => format!("{noun}s {a}, {b}, {c} and {} more", numbers.len() - 3),
        [start @ .., last] => {
            let start: Vec<_> = start.iter().map(usize::to_string).collect();
            format!("{noun}s {} and {last}", start.join(", "))
        }
    }
}

/// Marks the row before each dropped row as the end of its episode.
pub(super) fn cut_before_dropped(keep: &[bool], terminals: &[bool], timeouts: &mut [bool]) {
    for i in 1..keep.len() {
        if !keep[i] && keep[i - 1] && !terminals[i - 1] {
            timeouts[i - 1] = true;
        }
    }
}

/// Removes all rows except those in `keep`.
pub(super) fn retain<T: Copy>(data: &mut Vec<T>, dim: usize, keep: &[bool]) {
    let mut to = 0;
    for (i, _) in keep.iter().enumerate().filter(|(_, k)| **k) {
        data.copy_within(i * dim..(i + 1) * dim, to);
        to += dim;
    }
    data.truncate(to);
}

/// Returns the rows in the given order.
pub(super) fn reordered<T: Copy>(data: &[T], dim: usize, order: &[usize]) -> Vec<T> {
    order.iter().flat_map(|&i| data[i * dim..(i + 1) * dim].iter().copied()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dropping_rows_cuts_their_episode() {
        let mut timeouts = [false; 5];
        cut_before_dropped(&[true, false, true, true, false], &[false, false, false, true, false], &mut timeouts);
        assert_eq!(timeouts, [true, false, false, false, false]);
        let mut data = vec![0, 0, 1, 1, 2, 2];
        retain(&mut data, 2, &[false, true, true]);
        assert_eq!(data, [1, 1, 2, 2]);
        assert_eq!(reordered(&data, 2, &[1, 0]), [2, 2, 1, 1]);
    }

    #[test]
    fn rows_are_told_shortly() {
        let told: Vec<String> = [0, 1, 3, 4, 5].map(|n| tell(&(10..10 + n).collect::<Vec<_>>())).into();
        let expected =
            ["no row", "row 10", "rows 10, 11 and 12", "rows 10, 11, 12 and 13", "rows 10, 11, 12 and 2 more"];
        assert_eq!(told, expected);
        assert_eq!(listed("column", &[1, 2]), "columns 1 and 2");
    }
}
