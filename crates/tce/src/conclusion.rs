//! What came out of a run, in sentences: how far every method is above or below the best baseline, whether that is more than seeds do,
//! and what to do next. The gap comes before the doubt.

use tce_report::difference::{Difference, ENOUGH, Effect, LEAST, SURE, Sample};
use tce_run::layers::Preset;

/// What is compared with baselines, and what is one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// It learns from the target rows alone.
    Baseline,
    /// It has to beat the baselines.
    Method,
}

/// The scores of one method.
#[derive(Clone, Debug, PartialEq)]
pub struct Scored {
    /// Its name in tables.
    pub name: String,
    /// Whether it is a baseline.
    pub role: Role,
    /// Normalised scores; None where there are none.
    pub scores: Option<Sample>,
}

impl Scored {
    /// Of a method, one score for each seed.
    pub fn new(name: &str, role: Role, scores: &[f64]) -> Self {
        Self { name: name.to_owned(), role, scores: Sample::of(scores) }
    }
}

/// A method with scores.
type Ranked<'a> = (&'a Scored, Sample);

/// The best of those that `fits`; those without a score cannot be compared.
fn best(all: &[Scored], fits: impl Fn(&Scored) -> bool) -> Option<Ranked<'_>> {
    let ranked = all.iter().filter(|s| fits(s)).filter_map(|s| Some((s, s.scores?)));
    ranked.max_by(|a, b| a.1.mean.total_cmp(&b.1.mean))
}

/// How a method does against the best baseline over several tasks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    /// Tasks on which both are known.
    pub tasks: usize,
    /// Tasks on which it is above the best baseline, and on which that is shown ([`Effect::Helps`]).
    pub above: [usize; 2],
    /// Tasks on which it is below, and on which that is shown ([`Effect::Harms`]).
    pub below: [usize; 2],
    /// Mean of score less the best baseline's.
    pub gap: f64,
}

impl Tally {
    /// Of a method and the baselines of every task; None where they never meet.
    pub fn of(tasks: impl Iterator<Item = (Option<Scored>, Vec<Scored>)>) -> Option<Self> {
        let mut tally = Self::default();
        for (method, baselines) in tasks {
            let method = method.and_then(|m| m.scores);
            let (Some(method), Some((_, baseline))) = (method, best(&baselines, |_| true)) else { continue };
            let Difference { points, effect, .. } = Difference::between(&method, &baseline);
            let side = if points >= 0.0 { &mut tally.above } else { &mut tally.below };
            side[0] += 1;
            side[1] += usize::from(matches!(effect, Effect::Helps | Effect::Harms));
            tally.tasks += 1;
            tally.gap += points;
        }
        (tally.tasks > 0).then(|| Self { gap: tally.gap / tally.tasks as f64, ..tally })
    }

    /// In a sentence.
    pub fn sentence(&self, method: &str) -> String {
        let side = if self.gap >= 0.0 { "above" } else { "below" };
        let Self { tasks, above: [above, helps], below: [below, harms], .. } = self;
        format!(
            "{method}: on average {:.1} {side} the best baseline of each task; above it on {above} of {tasks} (shown on {helps}), below it on \
             {below} (shown on {harms}).",
            self.gap.abs()
        )
    }
}

/// `TCE(OG) scores 95.9, .7 above the best baseline (BC, 95.2).`, and how sure that is.
fn compare((method, scores): Ranked<'_>, (baseline, of_baseline): Ranked<'_>) -> String {
    let Difference { points, error, seeds, effect } = Difference::between(&scores, &of_baseline);
    let side = if points >= 0.0 { "above" } else { "below" };
    let size = points.abs();
    let head = format!(
        "{} scores {:.1}, {size:.1} {side} the best baseline ({}, {:.1})",
        method.name, scores.mean, baseline.name, of_baseline.mean
    );
    let doubt = match (effect, error) {
        (_, None) => "one seed cannot tell whether seeds alone do that".to_owned(),
        (Effect::FewSeeds, _) => format!("{seeds} seeds are too few to say whether seeds alone do that"),
        (effect, Some(error)) => {
            let what = match effect {
                Effect::Open if size > SURE * error => {
                    format!("that is more than seeds do, but less than {LEAST:.0} point")
                }
                Effect::Open => "seeds do as much".to_owned(),
                _ => "that is more than seeds do".to_owned(),
            };
            format!("{what} (standard error of the difference {error:.1}, {seeds} seeds)")
        }
    };
    format!("{head}; {doubt}.")
}

/// A sentence for every method, one for the recommended policy (`recommended` is its name), and one about the next step.
pub fn sentences(all: &[Scored], recommended: Option<&str>, preset: Preset) -> Vec<String> {
    let mut out = Vec::new();
    let baseline = best(all, |s| s.role == Role::Baseline);
    if let Some(baseline) = baseline {
        let methods = all.iter().filter(|s| s.role == Role::Method).filter_map(|s| Some((s, s.scores?)));
        out.extend(methods.map(|method| compare(method, baseline)));
    }
    let chosen = recommended.and_then(|name| all.iter().find(|s| s.name == name)).and_then(|s| Some((s, s.scores?)));
    if let (Some((chosen, scores)), Some((top, highest))) = (chosen, best(all, |_| true)) {
        out.push(match chosen.name == top.name {
            true => format!("The recommended policy's method, {}, has the highest score of all.", chosen.name),
            false => format!(
                "The recommended policy's method, {}, scores {:.1}: {:.1} below {}, the highest. The data alone do not show scores.",
                chosen.name,
                scores.mean,
                highest.mean - scores.mean,
                top.name
            ),
        });
    }
    let seeds = all.iter().filter_map(|s| s.scores).map(|s| s.seeds).max().unwrap_or(0);
    if preset == Preset::Quick {
        out.push("`quick` is a smoke test. For a result use --preset default --seeds 3.".into());
    } else if (1..ENOUGH).contains(&seeds) && baseline.is_some() && all.iter().any(|s| s.role == Role::Method) {
        out.push("For a result that holds, run at least --seeds 3.".into());
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn baseline(name: &str, scores: &[f64]) -> Scored {
        Scored::new(name, Role::Baseline, scores)
    }

    fn method(name: &str, scores: &[f64]) -> Scored {
        Scored::new(name, Role::Method, scores)
    }

    #[test]
    fn the_gap_comes_first_and_then_whether_seeds_do_that() {
        let bc = baseline("BC", &[60.0, 62.0, 64.0]);
        let against = |bc: &Scored, scores: &[f64]| {
            let own = method("TCE(OG)", scores);
            compare((&own, own.scores.unwrap()), (bc, bc.scores.unwrap()))
        };
        let say = |scores: &[f64]| against(&bc, scores);
        // Standard errors: sqrt(4 / 3) = 1.155 each, 1.633 together.
        assert_eq!(
            say(&[68.0, 70.0, 72.0]),
            "TCE(OG) scores 70.0, 8.0 above the best baseline (BC, 62.0); that is more than seeds do (standard error of the difference \
             1.6, 3 seeds)."
        );
        assert_eq!(
            say(&[58.0, 60.0, 62.0]),
            "TCE(OG) scores 60.0, 2.0 below the best baseline (BC, 62.0); seeds do as much (standard error of the difference 1.6, 3 \
             seeds)."
        );
        assert_eq!(
            against(&baseline("BC", &[60.0, 60.0, 60.0]), &[60.5, 60.5, 60.5]),
            "TCE(OG) scores 60.5, 0.5 above the best baseline (BC, 60.0); that is more than seeds do, but less than 1 point (standard error \
             of the difference 0.0, 3 seeds)."
        );
        assert_eq!(
            say(&[10.0, 11.0]),
            "TCE(OG) scores 10.5, 51.5 below the best baseline (BC, 62.0); 2 seeds are too few to say whether seeds alone do that."
        );
        assert_eq!(
            say(&[95.0]),
            "TCE(OG) scores 95.0, 33.0 above the best baseline (BC, 62.0); one seed cannot tell whether seeds alone do that."
        );
    }

    #[test]
    fn the_best_baseline_counts_and_what_has_no_score_does_not() {
        let all = [
            baseline("BC", &[50.0]),
            baseline("BC, five", &[80.0]),
            baseline("BC, diverged", &[]),
            method("TCE(OG)", &[70.0]),
            method("TCE(NN)", &[]),
        ];
        let text = sentences(&all, Some("BC, five"), Preset::Default);
        assert_eq!(text.len(), 3, "{text:?}");
        assert!(text[0].starts_with("TCE(OG) scores 70.0, 10.0 below the best baseline (BC, five, 80.0)"), "{text:?}");
        assert_eq!(text[1], "The recommended policy's method, BC, five, has the highest score of all.");
        assert_eq!(text[2], "For a result that holds, run at least --seeds 3.");
        let other = sentences(&all, Some("TCE(OG)"), Preset::Quick);
        assert!(other[1].contains("scores 70.0: 10.0 below BC, five, the highest"), "{other:?}");
        assert!(other[2].starts_with("`quick` is a smoke test"), "{other:?}");
    }

    #[test]
    fn several_tasks_are_counted() {
        let baselines = || vec![baseline("BC", &[60.0, 62.0, 64.0]), baseline("BC, raw", &[5.0, 5.0, 5.0])];
        let of = |scores: &[f64]| Some(method("m", scores));
        let tasks = [
            (of(&[68.0, 70.0, 72.0]), baselines()),
            (of(&[58.0, 60.0, 62.0]), baselines()),
            (of(&[10.0]), baselines()),
            (None, baselines()),
            (of(&[1.0]), vec![]),
        ];
        let tally = Tally::of(tasks.into_iter()).unwrap();
        assert_eq!(tally, Tally { tasks: 3, above: [1, 1], below: [2, 0], gap: (8.0 - 2.0 - 52.0) / 3.0 });
        assert_eq!(
            tally.sentence("m"),
            "m: on average 15.3 below the best baseline of each task; above it on 1 of 3 (shown on 1), below it on 2 (shown on 0)."
        );
        assert_eq!(Tally::of([(None, baselines())].into_iter()), None);
    }

    #[test]
    fn without_scores_there_is_nothing_to_say() {
        assert!(sentences(&[baseline("BC", &[])], Some("BC"), Preset::Default).is_empty());
    }
}
