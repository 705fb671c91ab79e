//! Chooses the trajectories to learn from in a data set of mixed quality.
//!
//! A policy cloned from data of two qualities matches neither; a data set of one quality needs all its rows.
//! [`choose_trajectories`] decides from the rewards alone.
//!
//! # The measures
//!
//! | measure | of | is |
//! |---|---|---|
//! | return | whole trajectories: they end by a terminal, or are at most two rows short of the longest | the sum of the rewards |
//! | pace | trajectories at least a quarter as long as the longest | the median, over windows of a tenth of the longest trajectory, of the mean reward per step |
//!
//! The pace hardly depends on the start, a fall, an accident or the place where the log was cut. The return shows
//! whether a robot falls. A group's spread is the range of its values; with ten or more values, without the outer tenth
//! at either end. (In a split by pace, returns keep the outer tenth. Falls that are too short for a pace join the worse
//! group by their return; if there are many, its long trajectories are this tenth, and the returns would no longer show
//! that they are as high as the better group's.)
//!
//! # The rule
//!
//! The trajectories are split into two groups of least variance (weighted by rows): the whole ones by pace, then by
//! return, then all by pace; the first clear split is used. Let `g` be the gap between the groups, divided by the
//! spread plus a hundredth of the better group's mean, and c the setting ([`CLEAR_GAP`]). A split is clear if the
//! better group's mean return is higher by 15 %, with and without the trajectories that were assigned afterwards, and
//! one of these holds:
//!
//! - by pace: g_pace ≥ c, and the mean paces differ by 15 % (and, if the better group has one whole trajectory only,
//!   g_return ≥ .6 c);
//! - by both: g_return ≥ .6 c and g_pace ≥ .6 c, and the mean paces differ by 5 %;
//! - by return (robots that are rewarded for not falling): the split is one by return, g_return ≥ 1.5 c, and the worse
//!   group has two or more whole trajectories. A single short one is an accident, not a behaviour.
//!
//! For returns, the spread is the larger one of both groups. For paces, it is the better group's (a bad behaviour may
//! be irregular), or the other group's if a group has only one trajectory. Cut trajectories count in a group's values
//! only if the group has no whole ones. Trajectories that were not part of the split are assigned to a group
//! afterwards: whole ones by their return; cut ones to the worse group only if that group had earned about as much at
//! the same age, and their pace, if known, is also closer to it. Everything is kept unless the split is clear and the
//! better group has [`ENOUGH_ROWS`] rows.

use serde::Serialize;

use crate::{Episode, Transitions};

/// The smallest gap, in units of the spread within a group, at which two groups count as two behaviours.
pub const CLEAR_GAP: f64 = 2.0;

/// The fewest rows that are enough to learn from.
pub const ENOUGH_ROWS: usize = 500;

/// Mean returns (and mean paces, if the pace decides alone) of two behaviours differ by this share of the larger one.
const LEAST_DIFFERENCE: f64 = 0.15;
/// Factors on the clear gap: for either measure if both are used, and for returns if they decide alone.
const BOTH: f64 = 0.6;
const ALONE: f64 = 1.5;

/// The measure that a split is based on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Measure {
    /// The sum of a whole trajectory's rewards.
    Return,
    /// The median over windows of the mean reward per step.
    Pace,
}

/// The result of [`choose_trajectories`].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Choice {
    /// The rows to learn from, ascending; for [`Transitions::select`].
    pub rows: Vec<usize>,
    /// The trajectories that contain these rows, in row order.
    pub episodes: Vec<Episode>,
    /// Midpoint between the groups, in units of the measure; `None` if everything was kept.
    pub threshold: Option<(Measure, f64)>,
    /// The reason, as one sentence for users.
    pub reason: String,
}

impl Choice {
    /// Whether some trajectories are left out.
    pub fn is_selective(&self) -> bool {
        self.threshold.is_some()
    }
}

/// Chooses trajectories with [`CLEAR_GAP`].
pub fn choose_trajectories(data: &Transitions) -> Choice {
    choose_trajectories_with(data, CLEAR_GAP)
}

/// Chooses trajectories. `clear_gap` is the setting c: a larger value keeps everything more often, infinity always.
pub fn choose_trajectories_with(data: &Transitions, clear_gap: f64) -> Choice {
    let trajectories = measure(data);
    let mut too_few = None;
    for (measure, whole_only) in [(Measure::Pace, true), (Measure::Return, true), (Measure::Pace, false)] {
        let Some(split) = split(data, &trajectories, measure, whole_only) else { continue };
        let Some(threshold) = clear(&trajectories, &split, measure, clear_gap) else { continue };
        let better = split.better;
        let rows: Vec<usize> = trajectories
            .iter()
            .zip(&better)
            .filter(|(_, b)| **b)
            .flat_map(|(t, _)| t.episode.start..t.episode.end)
            .collect();
        if rows.len() < ENOUGH_ROWS {
            too_few.get_or_insert(rows.len());
            continue;
        }
        let reason = tell(&trajectories, &better, measure, rows.len(), data.len());
        let episodes = trajectories.iter().zip(&better).filter(|(_, b)| **b).map(|(t, _)| t.episode).collect();
        return Choice { rows, episodes, threshold: Some((measure, threshold)), reason };
    }
    Choice {
        rows: (0..data.len()).collect(),
        episodes: trajectories.iter().map(|t| t.episode).collect(),
        threshold: None,
        reason: tell_all(&trajectories, too_few),
    }
}

/// A trajectory and its measures.
struct Trajectory {
    episode: Episode,
    /// Its return, if it is whole.
    whole: Option<f64>,
    /// Its pace, if it is long enough.
    pace: Option<f64>,
}

impl Trajectory {
    fn len(&self) -> usize {
        self.episode.end - self.episode.start
    }

    fn value(&self, measure: Measure) -> Option<f64> {
        match measure {
            Measure::Return => self.whole,
            Measure::Pace => self.pace,
        }
    }
}

fn measure(data: &Transitions) -> Vec<Trajectory> {
    let episodes = data.episodes();
    let longest = episodes.iter().map(|e| e.end - e.start).max().unwrap_or(0);
    let window = (longest / 10).max(1);
    let of = |episode: Episode| {
        let rewards = &data.rewards[episode.start..episode.end];
        let whole = data.terminals[episode.end - 1] || rewards.len() + 2 >= longest;
        let finite = episode.episode_return.is_finite();
        Trajectory {
            episode,
            whole: (whole && finite).then_some(episode.episode_return),
            pace: (rewards.len() * 4 >= longest && finite).then(|| pace(rewards, window)),
        }
    };
    episodes.into_iter().map(of).collect()
}

/// The median of the means of windows that overlap by four fifths. A trajectory with a pace is never shorter than a
/// window: it has at least a quarter of the longest length, a window a tenth.
fn pace(rewards: &[f32], window: usize) -> f64 {
    let mean = |w: &[f32]| w.iter().map(|&r| r as f64).sum::<f64>() / w.len() as f64;
    let mut means: Vec<f64> = rewards.windows(window).step_by((window / 5).max(1)).map(mean).collect();
    means.sort_by(f64::total_cmp);
    let n = means.len();
    if n == 0 { mean(rewards) } else { (means[(n - 1) / 2] + means[n / 2]) / 2.0 }
}

/// The trajectories in two groups.
struct Split {
    /// Of each trajectory that took part in the split, whether it is in the better group; `None` for the others.
    known: Vec<Option<bool>>,
    /// The same for every trajectory, after the others were assigned.
    better: Vec<bool>,
}

/// The split of least variance by `measure` (of whole trajectories only, or of all that have it). `None` if all values
/// are equal or fewer than two trajectories have one.
fn split(data: &Transitions, trajectories: &[Trajectory], measure: Measure, whole_only: bool) -> Option<Split> {
    let value = |t: &Trajectory| t.value(measure).filter(|_| !whole_only || t.whole.is_some());
    let mut known: Vec<(f64, f64)> = trajectories.iter().filter_map(|t| Some((value(t)?, t.len() as f64))).collect();
    known.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = known.iter().map(|k| k.1).sum();
    let mean = known.iter().map(|k| k.0 * k.1).sum::<f64>() / total;
    // The largest variance between the groups gives the smallest variance within them.
    let (mut weight, mut sum) = (0.0, 0.0);
    let mut best: Option<(f64, f64)> = None;
    for pair in known.windows(2) {
        weight += pair[0].1;
        sum += pair[0].1 * (pair[0].0 - mean);
        let between = sum * sum * (1.0 / weight + 1.0 / (total - weight));
        if pair[0].0 < pair[1].0 && best.is_none_or(|b| between > b.0) {
            best = Some((between, (pair[0].0 + pair[1].0) / 2.0));
        }
    }
    let (_, threshold) = best?;
    let mut better: Vec<Option<bool>> = trajectories.iter().map(|t| Some(value(t)? > threshold)).collect();
    let known = better.clone();
    for (k, t) in trajectories.iter().enumerate() {
        if better[k].is_none() {
            let whole = t.whole.and_then(|r| {
                let mean = |group| mean_of(trajectories, &known, group, |t| t.whole);
                Some((r - mean(true)?).abs() < (r - mean(false)?).abs())
            });
            // A cut trajectory is left out only if neither test puts it in the better group.
            let by_pace = t.pace.and_then(|pace| {
                let mean = |group| mean_of(trajectories, &known, group, |t| t.pace);
                Some((pace - mean(true)?).abs() < (pace - mean(false)?).abs())
            });
            better[k] = whole.or_else(|| Some(by_age(data, trajectories, &known, t)? || by_pace == Some(true)));
        }
    }
    // A trajectory without any measure is kept: it shows no fall.
    Some(Split { known, better: better.into_iter().map(|b| b.unwrap_or(true)).collect() })
}

/// The group (`true`: the better one) whose members had earned about as much at the age at which `cut` was cut.
fn by_age(data: &Transitions, trajectories: &[Trajectory], known: &[Option<bool>], cut: &Trajectory) -> Option<bool> {
    let earned = |t: &Trajectory| {
        let start = t.episode.start;
        (t.len() >= cut.len()).then(|| data.rewards[start..start + cut.len()].iter().map(|&r| r as f64).sum::<f64>())
    };
    let own = cut.episode.episode_return;
    let distance = |group| mean_of(trajectories, known, group, earned).map(|m: f64| (own - m).abs());
    match (distance(true), distance(false)) {
        (Some(better), Some(worse)) => Some(better <= worse),
        // `cut` is older than any trajectory of one group.
        (Some(_), None) => Some(true),
        (None, Some(_)) => Some(false),
        (None, None) => None,
    }
}

fn mean_of(
    trajectories: &[Trajectory],
    known: &[Option<bool>],
    group: bool,
    value: impl Fn(&Trajectory) -> Option<f64>,
) -> Option<f64> {
    let of_group = trajectories.iter().zip(known).filter(|(_, k)| **k == Some(group));
    mean(&of_group.filter_map(|(t, _)| value(t)).collect::<Vec<_>>())
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Statistics of one group's values in one measure.
struct Group {
    count: usize,
    mean: f64,
    low: f64,
    high: f64,
}

impl Group {
    /// The group of the trajectories whose index is a `member`; with ten or more values, `trimmed` leaves out the outer
    /// tenth at either end of the range.
    fn of(
        trajectories: &[Trajectory],
        member: impl Fn(usize) -> bool,
        measure: Measure,
        trimmed: bool,
    ) -> Option<Group> {
        let of_group = || trajectories.iter().enumerate().filter(|(k, _)| member(*k)).map(|(_, t)| t);
        // Cut trajectories count only if the group has no whole ones.
        let whole = of_group().filter(|t| t.whole.is_some()).filter_map(|t| t.value(measure));
        let mut values: Vec<f64> = whole.collect();
        if values.is_empty() {
            values = of_group().filter_map(|t| t.value(measure)).collect();
        }
        values.sort_by(f64::total_cmp);
        let (count, outer) = (values.len(), if trimmed { values.len() / 10 } else { 0 });
        Some(Group { count, mean: mean(&values)?, low: values[outer], high: values[count - 1 - outer] })
    }

    fn spread(&self) -> f64 {
        self.high - self.low
    }
}

/// The gap between two groups in units of the spread; negative if they overlap.
fn gap(worse: &Group, better: &Group, measure: Measure) -> f64 {
    let spread = match measure {
        Measure::Pace if better.count > 1 => better.spread(),
        _ => worse.spread().max(better.spread()),
    };
    let unit = spread + 0.01 * better.mean.abs();
    if unit > 0.0 { (better.low - worse.high) / unit } else { 0.0 }
}

/// Whether `better`'s mean exceeds `worse`'s by this share of the larger one.
fn differ(worse: &Group, better: &Group, share: f64) -> bool {
    better.mean - worse.mean >= share * better.mean.abs().max(worse.mean.abs())
}

/// The threshold, if the split by `measure` is clear.
fn clear(trajectories: &[Trajectory], split: &Split, measure: Measure, clear_gap: f64) -> Option<f64> {
    // Beside many short falls, the long trajectories of the worse group are its outer tenth.
    let trimmed = |m: Measure| measure == Measure::Return || m == Measure::Pace;
    let groups = |m: Measure| {
        let of = |group: bool| Group::of(trajectories, |k| split.better[k] == group, m, trimmed(m));
        of(false).zip(of(true))
    };
    let (returns, paces) = (groups(Measure::Return), groups(Measure::Pace));
    // The falls that joined the worse group must not make the difference alone.
    let of = |group: bool| Group::of(trajectories, |k| split.known[k] == Some(group), Measure::Return, false);
    let took_part = of(false).zip(of(true));
    if [&returns, &took_part].into_iter().flatten().any(|(w, b)| !differ(w, b, LEAST_DIFFERENCE)) {
        return None;
    }
    let size = |groups: &Option<(Group, Group)>, m| groups.as_ref().map_or(f64::NEG_INFINITY, |(w, b)| gap(w, b, m));
    let (by_return, by_pace) = (size(&returns, Measure::Return), size(&paces, Measure::Pace));
    let paces_differ = paces.as_ref().is_some_and(|(w, b)| differ(w, b, LEAST_DIFFERENCE));
    let paces_differ_a_little = paces.as_ref().is_some_and(|(w, b)| differ(w, b, LEAST_DIFFERENCE / 3.0));
    // A single better trajectory may be luck: if its return is known, it must be clearly better, too.
    let lone = returns.as_ref().is_some_and(|(_, b)| b.count == 1) && by_return < BOTH * clear_gap;
    let pace = by_pace >= clear_gap && paces_differ && !lone;
    let both = paces_differ_a_little && by_return.min(by_pace) >= BOTH * clear_gap;
    let several = returns.as_ref().is_some_and(|(w, _)| w.count > 1);
    // Returns decide alone only where they made the groups: a split by pace may divide equal trajectories at random.
    let alone = measure == Measure::Return && several && by_return >= ALONE * clear_gap;
    let (worse, better) = match measure {
        Measure::Return => returns?,
        Measure::Pace => paces?,
    };
    (pace || both || alone).then_some((worse.high + better.low) / 2.0)
}

/// A number as a word, if the word is short.
fn word(n: usize) -> String {
    const WORDS: [&str; 13] =
        ["none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"];
    WORDS.get(n).map_or_else(|| n.to_string(), |w| (*w).to_owned())
}

fn capitalised(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

/// `1290 to 1310`, or one number if both are printed the same.
fn range(low: f64, high: f64) -> String {
    let digits = if low.abs().max(high.abs()) < 100.0 { 2 } else { 0 };
    let (low, high) = (format!("{low:.digits$}"), format!("{high:.digits$}"));
    if low == high { low } else { format!("{low} to {high}") }
}

/// The smallest and the largest value of a group, or of everything (`None`).
fn extremes(trajectories: &[Trajectory], better: Option<(&[bool], bool)>, measure: Measure) -> Option<String> {
    let in_group = |k: usize| better.is_none_or(|(b, group)| b[k] == group);
    let values = trajectories.iter().enumerate().filter(|(k, _)| in_group(*k)).filter_map(|(_, t)| t.value(measure));
    let ends =
        values.fold(None, |ends: Option<(f64, f64)>, v| Some(ends.map_or((v, v), |(lo, hi)| (lo.min(v), hi.max(v)))));
    ends.map(|(low, high)| range(low, high))
}

fn tell(trajectories: &[Trajectory], better: &[bool], measure: Measure, kept: usize, rows: usize) -> String {
    let good = better.iter().filter(|b| **b).count();
    let bad = better.len() - good;
    let verb = |verb: &str| if bad == 1 { format!("{verb}s") } else { verb.to_owned() };
    let pair =
        |m| Some((extremes(trajectories, Some((better, false)), m)?, extremes(trajectories, Some((better, true)), m)?));
    let returns = pair(Measure::Return);
    let paces = pair(Measure::Pace).filter(|_| measure == Measure::Pace || returns.is_none());
    let numbers = match (returns, paces) {
        (Some((w, b)), None) => format!("{} {w}, the other {} {b}", verb("return"), word(good)),
        (Some((w, b)), Some((pw, pb))) => {
            format!("{} {w} ({pw} per step), the other {} {b} ({pb} per step)", verb("return"), word(good))
        }
        (None, Some((w, b))) => format!("{} {w} per step, the other {} {b}", verb("earn"), word(good)),
        (None, None) => format!("{} less than the other {}", verb("earn"), word(good)),
    };
    format!(
        "{} of {} trajectories {numbers}: learned from the better {} ({kept} of {rows} rows).",
        capitalised(&word(bad)),
        word(better.len()),
        word(good)
    )
}

fn tell_all(trajectories: &[Trajectory], too_few: Option<usize>) -> String {
    let n = trajectories.len();
    if n < 2 {
        return format!(
            "There {} {} to choose from: all rows are kept.",
            if n == 1 { "is" } else { "are" },
            match n {
                1 => "one trajectory",
                _ => "no trajectories",
            }
        );
    }
    if let Some(rows) = too_few {
        return format!(
            "All {} trajectories are kept: the better ones have only {rows} rows, fewer than {ENOUGH_ROWS}.",
            word(n)
        );
    }
    let returns = extremes(trajectories, None, Measure::Return);
    let numbers = returns.map_or_else(String::new, |r| format!(" (returns {r})"));
    format!("All {} trajectories are kept{numbers}: they do not fall into two clearly different groups.", word(n))
}

#[cfg(test)]
mod tests;
