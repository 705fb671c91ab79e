//! Stored successors that are not finite, and the layout of a table given which fields it has.

use super::report::Layout;

/// The layout of a table whose successors and marks are not guaranteed to be right.
pub(super) fn layout_of(successors: bool, timeouts: bool) -> Layout {
    match (successors, timeouts) {
        (true, false) => Layout::Otdf,
        _ => Layout::D4rl,
    }
}

/// Marks successors that are not finite as not `known`, and replaces all that are not known by the state. Only terminal
/// rows may have such successors. Returns the number of those that are not finite.
///
/// # Errors
/// The first such row that is not terminal.
pub(super) fn fill_gaps(
    next: &mut [f32],
    observations: &[f32],
    terminals: &[bool],
    known: &mut Option<Vec<bool>>,
) -> Result<usize, usize> {
    let dim = next.len() / terminals.len().max(1);
    let row = |i: usize| i * dim..(i + 1) * dim;
    let gaps: Vec<usize> = (0..terminals.len()).filter(|&i| next[row(i)].iter().any(|x| !x.is_finite())).collect();
    if let Some(&bad) = gaps.iter().find(|&&i| !terminals[i]) {
        return Err(bad);
    }
    if !gaps.is_empty() {
        let known = known.get_or_insert_with(|| vec![true; terminals.len()]);
        gaps.iter().for_each(|&i| known[i] = false);
    }
    let lost = |i: &usize| terminals[*i] && known.as_ref().is_some_and(|known| !known[*i]);
    for i in (0..terminals.len()).filter(lost) {
        next[row(i)].copy_from_slice(&observations[row(i)]);
    }
    Ok(gaps.len())
}

/// The warning about these successors.
pub(super) fn told_gaps(name: &str, gaps: usize) -> Option<String> {
    (gaps > 0)
        .then(|| format!("`{name}` is not finite in {gaps} terminal rows, whose next state is taken as not known"))
}
