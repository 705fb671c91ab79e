//! What came out of a run, in sentences: how far every method is above or below the best baseline, whether that is more than seeds do,
//! and what to do next. The gap comes before the doubt.

use tce_base::mean_std;
use tce_run::layers::Preset;
use tce_run::verdict::SURE;

/// Learner seeds below which the spread between seeds is not known well enough to be believed.
const FEW: usize = 3;

/// The scores of one method, one a seed.
#[derive(Clone, Debug, PartialEq)]
pub struct Scored {
    /// Its name in tables.
    pub name: String,
    /// Whether it is a baseline: a baseline that learns from the target rows alone.
    pub baseline: bool,
    /// Normalised scores.
    pub scores: Vec<f64>,
}

impl Scored {
    /// Of a method.
    pub fn new(name: &str, baseline: bool, scores: &[f64]) -> Self {
        Self { name: name.to_owned(), baseline, scores: scores.to_vec() }
    }

    fn mean(&self) -> f64 {
        mean_std(&self.scores).0
    }

    /// Squared standard error of the mean; None for a single seed.
    fn variance_of_mean(&self) -> Option<f64> {
        let n = self.scores.len();
        (n > 1).then(|| mean_std(&self.scores).1.powi(2) / n as f64)
    }
}

/// The best of those that `fits`; those without a score cannot be compared.
fn best(all: &[Scored], fits: impl Fn(&Scored) -> bool) -> Option<&Scored> {
    all.iter().filter(|s| !s.scores.is_empty() && fits(s)).max_by(|a, b| a.mean().total_cmp(&b.mean()))
}

/// How a method does against the best baseline over several tasks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    /// Tasks on which both are known.
    pub tasks: usize,
    /// Above the best baseline, and by more than seeds do.
    pub above: [usize; 2],
    /// Below it, and by more than seeds do.
    pub below: [usize; 2],
    /// Mean of score less the best baseline's.
    pub gap: f64,
}

impl Tally {
    /// Of a method and the baselines of every task; None where they never meet.
    pub fn of(tasks: impl Iterator<Item = (Option<Scored>, Vec<Scored>)>) -> Option<Self> {
        let mut tally = Self::default();
        for (method, baselines) in tasks {
            let (Some(method), Some(baseline)) = (method, best(&baselines, |_| true)) else { continue };
            let gap = method.mean() - baseline.mean();
            let side = if gap >= 0.0 { &mut tally.above } else { &mut tally.below };
            side[0] += 1;
            side[1] += usize::from(standing(&method, baseline) == Standing::MoreThanSeeds);
            tally.tasks += 1;
            tally.gap += gap;
        }
        (tally.tasks > 0).then(|| Self { gap: tally.gap / tally.tasks as f64, ..tally })
    }

    /// In a sentence.
    pub fn sentence(&self, method: &str) -> String {
        let side = if self.gap >= 0.0 { "above" } else { "below" };
        let Self { tasks, above: [above, clearly_above], below: [below, clearly_below], .. } = self;
        format!(
            "{method}: on average {:.1} {side} the best baseline of each task; above it on {above} of {tasks} (on {clearly_above} by more than \
             seeds do), below it on {below} ({clearly_below}).",
            self.gap.abs()
        )
    }
}

/// What a difference of two methods is against that of their seeds.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Standing {
    /// One of them has one seed.
    OneSeed,
    /// Fewer than [`FEW`] seeds, however large it is.
    FewSeeds,
    /// More than [`SURE`] standard errors.
    MoreThanSeeds,
    /// Less.
    SeedsDoAsMuch,
}

/// The standard error of the difference, where both have several seeds.
fn standard_error(a: &Scored, b: &Scored) -> Option<f64> {
    Some((a.variance_of_mean()? + b.variance_of_mean()?).sqrt())
}

fn standing(a: &Scored, b: &Scored) -> Standing {
    match standard_error(a, b) {
        None => Standing::OneSeed,
        Some(error) if (a.mean() - b.mean()).abs() <= SURE * error => Standing::SeedsDoAsMuch,
        Some(_) if a.scores.len().min(b.scores.len()) < FEW => Standing::FewSeeds,
        Some(_) => Standing::MoreThanSeeds,
    }
}

/// `TCE(OG) scores 95.9, .7 above the best baseline (BC, 95.2).`, and how sure that is.
fn compare(method: &Scored, baseline: &Scored) -> String {
    let gap = method.mean() - baseline.mean();
    let side = if gap >= 0.0 { "above" } else { "below" };
    let size = gap.abs();
    let head = format!(
        "{} scores {:.1}, {size:.1} {side} the best baseline ({}, {:.1})",
        method.name,
        method.mean(),
        baseline.name,
        baseline.mean()
    );
    let seeds = method.scores.len().min(baseline.scores.len());
    let error = standard_error(method, baseline).unwrap_or(f64::NAN);
    let doubt = match standing(method, baseline) {
        Standing::OneSeed => "one seed cannot tell whether seeds alone do that".to_owned(),
        Standing::FewSeeds => format!("{seeds} seeds are too few to say whether seeds alone do that"),
        Standing::MoreThanSeeds => {
            format!("that is more than seeds do (standard error of the difference {error:.1}, {seeds} seeds)")
        }
        Standing::SeedsDoAsMuch => {
            format!("seeds do as much (standard error of the difference {error:.1}, {seeds} seeds)")
        }
    };
    format!("{head}; {doubt}.")
}

/// A sentence for every method, one for the recommended policy (`recommended` is its name), and one about the next step.
pub fn sentences(all: &[Scored], recommended: Option<&str>, preset: Preset) -> Vec<String> {
    let mut out = Vec::new();
    let baseline = best(all, |s| s.baseline);
    if let Some(baseline) = baseline {
        out.extend(all.iter().filter(|s| !s.baseline && !s.scores.is_empty()).map(|method| compare(method, baseline)));
    }
    let chosen = recommended.and_then(|name| all.iter().find(|s| s.name == name)).filter(|s| !s.scores.is_empty());
    if let (Some(chosen), Some(top)) = (chosen, best(all, |_| true)) {
        out.push(match chosen.name == top.name {
            true => format!("The recommended policy's method, {}, has the highest score of all.", chosen.name),
            false => format!(
                "The recommended policy's method, {}, scores {:.1}: {:.1} below {}, the highest. The data alone do not show scores.",
                chosen.name,
                chosen.mean(),
                top.mean() - chosen.mean(),
                top.name
            ),
        });
    }
    let seeds = all.iter().map(|s| s.scores.len()).max().unwrap_or(0);
    if preset == Preset::Quick {
        out.push("`quick` is a smoke test. For a result use --preset default --seeds 3.".into());
    } else if (1..FEW).contains(&seeds) && baseline.is_some() && all.iter().any(|s| !s.baseline) {
        out.push("For a result that holds, run at least --seeds 3.".into());
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scored(name: &str, baseline: bool, scores: &[f64]) -> Scored {
        Scored { name: name.into(), baseline, scores: scores.to_vec() }
    }

    #[test]
    fn the_gap_comes_first_and_then_whether_seeds_do_that() {
        let baseline = scored("BC", true, &[60.0, 62.0, 64.0]);
        let say = |scores: &[f64]| compare(&scored("TCE(OG)", false, scores), &baseline);
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
            scored("BC", true, &[50.0]),
            scored("BC, five", true, &[80.0]),
            scored("BC, diverged", true, &[]),
            scored("TCE(OG)", false, &[70.0]),
            scored("TCE(NN)", false, &[]),
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
        let baselines = || vec![scored("BC", true, &[60.0, 62.0, 64.0]), scored("BC, raw", true, &[5.0, 5.0, 5.0])];
        let method = |scores: &[f64]| Some(scored("m", false, scores));
        let tasks = [
            (method(&[68.0, 70.0, 72.0]), baselines()),
            (method(&[58.0, 60.0, 62.0]), baselines()),
            (method(&[10.0]), baselines()),
            (None, baselines()),
            (method(&[1.0]), vec![]),
        ];
        let tally = Tally::of(tasks.into_iter()).unwrap();
        assert_eq!(tally, Tally { tasks: 3, above: [1, 1], below: [2, 0], gap: (8.0 - 2.0 - 52.0) / 3.0 });
        assert_eq!(
            tally.sentence("m"),
            "m: on average 15.3 below the best baseline of each task; above it on 1 of 3 (on 1 by more than seeds do), below it on 2 (0)."
        );
        assert_eq!(Tally::of([(None, baselines())].into_iter()), None);
    }

    #[test]
    fn without_scores_there_is_nothing_to_say() {
        assert!(sentences(&[scored("BC", true, &[])], Some("BC"), Preset::Default).is_empty());
    }
}
