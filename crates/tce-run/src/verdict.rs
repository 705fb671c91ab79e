//! Recommends a policy from the two data sets alone ([`crate::off_policy_evaluation`]), and says how sure that is.
//!
//! Every policy is tried from the same states in the same learned models, so that two policies are compared episode by
//! episode. The rule, measured in bench/expansion.md:
//!
//! 1. The standard is the baseline whose supported return is highest.
//! 2. A method is recommended instead if its imagined episodes return more than the standard's while they are near the target's states, by
//!    more than [`SURE`] standard errors of the paired differences and by more than [`LEAST`] of the standard's return. Of several, the one
//!    with the highest return.
//! 3. Of several seeds of the recommended method, the one with the highest supported return is taken.
//!
//! Learned dynamics have errors, above all away from the data: there they invent returns, and nothing counts. If the difference is smaller
//! than what they can resolve, the baseline is recommended. Where they lose the recommended policy, the next best or the baseline before half of an episode ([`WHOLE`]), the
//! verdict says so and is not sure, however large the difference is: the rest of the episode may decide otherwise. Of target rows in no
//! order, the length of an episode has to be known for a verdict to be sure.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tce_base::{Progress, mean_and_error, mean_std};
use tce_learn::{FittedQConfig, FittedValue, Policy};
use tce_nn::Device;

use crate::error::{Error, Result};
use crate::off_policy_evaluation::{OffPolicyEstimate, OffPolicyEvaluator};

/// Standard errors of a difference that is more than chance.
pub const SURE: f64 = 2.0;
/// Share of the standard's return that a difference has to exceed.
pub const LEAST: f64 = 0.02;
/// Share of an episode of which both policies' supported returns have to tell for a verdict to be sure. On Walker2d, gravity, they told
/// of a fifth and a third, were ten standard errors apart, and had the wrong order.
pub const WHOLE: f64 = 0.5;
/// The recommended policy's file.
pub const FILE: &str = "policy.safetensors";

/// The policies of one method, one per seed.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// The method's name in tables.
    pub name: String,
    /// Whether it is a baseline: it learned from target rows alone.
    pub baseline: bool,
    /// The policies' files.
    pub files: Vec<PathBuf>,
}

/// The estimates of a candidate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tried {
    /// The method's name.
    pub name: String,
    /// Whether it is a baseline.
    #[serde(alias = "floor")]
    pub baseline: bool,
    /// Imagined return, mean over the seeds.
    pub imagined_return: f64,
    /// What of it is near the target's states, which decides; none in verdicts from before December 2026.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub supported_return: Option<f64>,
    /// Standard error of what decides, over the imagined episodes of the policies' mean.
    #[serde(default)]
    pub standard_error: f64,
    /// Share of the steps of whole episodes that were reached, mean over the seeds.
    pub survival: f64,
    /// The same until the episodes are far from the target's states; none in verdicts from before December 2026.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub support: Option<f64>,
    /// RMSE of the actions at target states against the behaviour's, mean over the seeds; the box is 2 wide.
    #[serde(default)]
    pub action_error: f64,
    /// Discounted return by fitted Q evaluation, mean over the seeds, and the greatest of their standard errors; none where it was not
    /// asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fitted_q: Option<[f64; 2]>,
    /// Supported return less that of the standard, and its standard error.
    pub over_standard: [f64; 2],
}

/// The recommendation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// The method.
    pub method: String,
    /// Its policy with the highest supported return.
    pub policy: PathBuf,
    /// Whether the difference that decided is more than [`SURE`] standard errors, of episodes known for [`WHOLE`] or more of their steps.
    pub sure: bool,
    /// In a sentence.
    pub reason: String,
    /// All candidates, as they were given.
    pub tried: Vec<Tried>,
    /// The discounted return of the target's episodes as they were logged; none where no policy has a fitted one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub behaviour_value: Option<f64>,
}

/// Mean over the seeds of every imagined episode's supported return.
fn episodes(estimates: &[OffPolicyEstimate]) -> Vec<f64> {
    let count = estimates.len().max(1) as f64;
    let n = estimates.first().map_or(0, |j| j.supported.len());
    (0..n).map(|i| estimates.iter().map(|j| j.supported[i]).sum::<f64>() / count).collect()
}

/// Mean and standard error of the paired differences.
fn difference(a: &[f64], b: &[f64]) -> (f64, f64) {
    mean_and_error(&a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<_>>())
}

/// Decimals with which a number of this standard error is written: returns may be thousands or hundredths.
fn decimals(error: f64) -> usize {
    match error {
        e if e == 0.0 || e >= 2.0 => 0,
        e if e >= 0.2 => 1,
        e if e >= 0.02 => 2,
        _ => 3,
    }
}

/// The verdict where there is no choice: one candidate with one policy.
pub fn only(candidates: &[Candidate]) -> Option<Verdict> {
    let [Candidate { name, files, .. }] = candidates else { return None };
    let [policy] = &files[..] else { return None };
    let reason = format!("{name} is the only policy there is.");
    Some(Verdict {
        method: name.clone(),
        policy: policy.clone(),
        sure: true,
        reason,
        tried: Vec::new(),
        behaviour_value: None,
    })
}

/// Tries all candidates in learned dynamics and recommends one. With `fitted_q` their policies are evaluated by fitted Q, too: those
/// metrics are shown and decide nothing, because they do not rank policies (bench/expansion.md).
///
/// # Errors
/// If there is no candidate, a policy cannot be read, or the dynamics cannot be learned.
pub fn recommend(
    evaluator: impl FnOnce() -> Result<OffPolicyEvaluator>,
    candidates: &[Candidate],
    fitted_q: Option<(&FittedQConfig, &Device)>,
) -> Result<Verdict> {
    let evaluator = evaluator()?;
    tce_base::begin_step("verdict");
    let progress = Progress::new("try policies", candidates.iter().map(|c| c.files.len() as u64).sum(), "policies");
    let load_all = |c: &Candidate| c.files.iter().map(|file| Ok(Policy::load(file)?)).collect::<Result<Vec<_>>>();
    let policies = candidates.iter().map(load_all).collect::<Result<Vec<_>>>()?;
    let try_one = |policy: &Policy| evaluator.evaluate(policy).inspect(|_| progress.inc(1));
    let estimates = policies.iter().map(|own| own.iter().map(try_one).collect()).collect::<Result<Vec<Vec<_>>>>()?;
    progress.finish();
    let mut verdict = decide(candidates, &estimates)?;
    if let Some(doubt) = evaluator.doubt() {
        verdict.reason = format!("{} {doubt}", verdict.reason);
        verdict.sure = false;
    }
    if let Some((config, device)) = fitted_q {
        let values = evaluator.values(&policies.concat(), config, device)?;
        let mut values = values.iter();
        for (tried, candidate) in verdict.tried.iter_mut().zip(candidates) {
            let own: Vec<&FittedValue> = values.by_ref().take(candidate.files.len()).collect();
            let mean = mean_std(&own.iter().map(|v| v.mean()).collect::<Vec<_>>()).0;
            tried.fitted_q = Some([mean, own.iter().map(|v| v.standard_error()).fold(0.0, f64::max)]);
        }
        verdict.behaviour_value = Some(evaluator.behaviour_value(config));
    }
    Ok(verdict)
}

/// [`recommend`] without fitted Q. A single policy is taken without being tried: where there is a simulator, it has been evaluated.
///
/// # Errors
/// As [`recommend`].
pub fn recommend_or_only(
    evaluator: impl FnOnce() -> Result<OffPolicyEvaluator>,
    candidates: &[Candidate],
) -> Result<Verdict> {
    only(candidates).map_or_else(|| recommend(evaluator, candidates, None), Ok)
}

/// Why a method is recommended: its return, how far it is ahead of the standard, and whether the data tell it from the next best, if that is not
/// the standard.
fn ahead(chosen: (&str, f64), standard: (&str, (f64, f64)), next: Option<(&str, (f64, f64))>) -> String {
    let (name, (by, error)) = standard;
    let digits = decimals(error);
    let first = format!(
        "{} is recommended: tried in learned dynamics, near the target's states, it returns {:.digits$}, which is {by:.digits$} ± \
         {error:.digits$} more than {name}.",
        chosen.0, chosen.1,
    );
    let Some((next, (by, error))) = next else { return first };
    let digits = decimals(error);
    if by > SURE * error {
        return format!("{first} The next best, {next}, returns {by:.digits$} ± {error:.digits$} less.");
    }
    let (by, how) = if by < 0.0 { (-by, "more") } else { (by, "less") };
    format!("{first} The data do not tell it from {next}, which returns {by:.digits$} ± {error:.digits$} {how}.")
}

fn decide(candidates: &[Candidate], estimates: &[Vec<OffPolicyEstimate>]) -> Result<Verdict> {
    let returns: Vec<Vec<f64>> = estimates.iter().map(|j| episodes(j)).collect();
    let mean = |k: usize| mean_std(&returns[k]).0;
    let best = |of: &dyn Fn(usize) -> bool| {
        (0..candidates.len())
            .filter(|&k| of(k) && !estimates[k].is_empty())
            .max_by(|&a, &b| mean(a).total_cmp(&mean(b)))
    };
    let standard = best(&|k| candidates[k].baseline).or_else(|| best(&|_| true));
    let standard = standard.ok_or_else(|| Error::Failed("there is no policy to recommend".into()))?;
    let over: Vec<(f64, f64)> = returns.iter().map(|r| difference(r, &returns[standard])).collect();
    let beats = |k: usize| {
        let (by, error) = over[k];
        by > SURE * error && by > LEAST * mean(standard).abs()
    };
    let chosen = best(&|k| !candidates[k].baseline && beats(k)).unwrap_or(standard);
    let next_best = best(&|k| k != chosen);
    let gap = next_best.map(|k| difference(&returns[chosen], &returns[k]));
    let name = |k: usize| &candidates[k].name;
    let digits = gap.map_or(0, |(_, error)| decimals(error));
    let reason = match (next_best, gap) {
        (Some(k), Some(gap)) if chosen != standard => {
            let next = (k != standard).then(|| (&name(k)[..], gap));
            ahead((name(chosen), mean(chosen)), (name(standard), over[chosen]), next)
        }
        (Some(k), Some((by, error))) => {
            let next = name(k);
            let told = match by >= 0.0 {
                true => format!("the next best, {next}, {by:.digits$} ± {error:.digits$} less"),
                false => format!("{next} {:.digits$} ± {error:.digits$} more, which is too little to go by", -by),
            };
            format!(
                "{} is recommended: tried in learned dynamics, near the target's states, no method returns clearly more ({told}).",
                name(chosen)
            )
        }
        _ => format!("{} is the only method there is.", name(chosen)),
    };
    let of_seeds = |k: usize, metric: &dyn Fn(&OffPolicyEstimate) -> f64| {
        mean_std(&estimates[k].iter().map(metric).collect::<Vec<_>>()).0
    };
    let support = |k: usize| of_seeds(k, &|j| j.support);
    let known = next_best.map_or(1.0, |k| support(chosen).min(support(k)).min(support(standard)));
    let reason = match known < WHOLE {
        true => format!("{reason} Learned dynamics tell of the first {:.0} % of an episode only.", 100.0 * known),
        false => reason,
    };
    let seed = (0..estimates[chosen].len())
        .max_by(|&a, &b| estimates[chosen][a].supported_return.total_cmp(&estimates[chosen][b].supported_return));
    let tried = |k: usize| Tried {
        name: candidates[k].name.clone(),
        baseline: candidates[k].baseline,
        imagined_return: of_seeds(k, &|j| j.imagined_return),
        supported_return: Some(mean(k)),
        standard_error: mean_and_error(&returns[k]).1,
        survival: of_seeds(k, &|j| j.survival),
        support: Some(support(k)),
        action_error: of_seeds(k, &|j| j.action_error),
        fitted_q: None,
        over_standard: over[k].into(),
    };
    Ok(Verdict {
        method: name(chosen).clone(),
        policy: candidates[chosen].files[seed.unwrap_or(0)].clone(),
        sure: gap.is_none_or(|(by, error)| by > SURE * error) && known >= WHOLE,
        reason,
        tried: (0..candidates.len()).map(tried).collect(),
        behaviour_value: None,
    })
}

/// A verdict and the file that its policy was put into.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Kept {
    /// The file.
    pub file: PathBuf,
    /// The verdict.
    #[serde(flatten)]
    pub verdict: Verdict,
}

impl Kept {
    /// What a person reads.
    pub fn sentences(&self) -> String {
        let doubt = if self.verdict.sure { "" } else { " The data do not tell for sure." };
        format!("{}{doubt}\nrecommended policy: {}", self.verdict.reason, self.file.display())
    }
}

/// Puts the recommended policy into `directory`, whole or not at all, and the verdict beside it.
///
/// # Errors
/// If a file cannot be read or written.
pub fn keep(verdict: Verdict, directory: &Path) -> Result<Kept> {
    let place = directory.join(FILE);
    Policy::load(&verdict.policy)?.save(&place)?;
    // Relative, so that the folder can be moved and two copies of a run have the same bytes.
    let policy = verdict.policy.strip_prefix(directory).unwrap_or(&verdict.policy).to_owned();
    tce_base::write_json(&directory.join("verdict.json"), &Verdict { policy, ..verdict.clone() })?;
    Ok(Kept { file: place, verdict })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimate(returns: &[f64]) -> OffPolicyEstimate {
        let (mean, std) = mean_std(returns);
        OffPolicyEstimate {
            imagined_return: mean,
            standard_error: std,
            supported_return: mean,
            survival: 1.0,
            support: 1.0,
            distance: 1.0,
            action_error: 0.1,
            returns: returns.to_vec(),
            supported: returns.to_vec(),
        }
    }

    fn candidates(names: &[(&str, bool)]) -> Vec<Candidate> {
        let of = |(name, baseline): &(&str, bool)| Candidate {
            name: (*name).into(),
            baseline: *baseline,
            files: vec![format!("{name}-0").into(), format!("{name}-1").into()],
        };
        names.iter().map(of).collect()
    }

    fn choose(method: [&[f64]; 2]) -> Verdict {
        let baseline = vec![estimate(&[100.0, 200.0, 300.0, 400.0]), estimate(&[100.0, 200.0, 300.0, 402.0])];
        let method = method.map(estimate).to_vec();
        decide(&candidates(&[("baseline", true), ("method", false)]), &[baseline, method]).unwrap()
    }

    #[test]
    fn a_method_has_to_beat_the_baseline_episode_by_episode() {
        // Fifty more in every episode: certain, however much the episodes differ.
        let ahead = choose([&[150.0, 250.0, 350.0, 450.0], &[150.0, 250.0, 350.0, 452.0]]);
        assert_eq!((ahead.method.as_str(), ahead.policy.to_str(), ahead.sure), ("method", Some("method-1"), true));
        assert_eq!(ahead.tried[1].over_standard[0], 50.0);
        assert!(ahead.reason.ends_with("it returns 300, which is 50 ± 0 more than baseline."), "{}", ahead.reason);
        assert_eq!([30.0, 0.7, 0.05, 0.001].map(decimals), [0, 1, 2, 3]);
        // As much on average, from one episode: chance.
        let lucky = choose([&[100.0, 200.0, 300.0, 600.0], &[100.0, 200.0, 300.0, 600.0]]);
        assert_eq!((lucky.method.as_str(), lucky.sure), ("baseline", false));
        assert!(lucky.reason.ends_with("(method 50 ± 50 more, which is too little to go by)."), "{}", lucky.reason);
        let behind = choose([&[50.0, 150.0, 250.0, 350.0], &[50.0, 150.0, 250.0, 352.0]]);
        assert!(behind.reason.ends_with("(the next best, method, 50 ± 0 less)."), "{}", behind.reason);
        // Always more, but by nothing that matters.
        let slightly = choose([&[101.0, 201.0, 301.0, 402.0], &[101.0, 201.0, 301.0, 402.0]]);
        assert_eq!(slightly.method, "baseline");
        assert_eq!(slightly.policy.to_str(), Some("baseline-1"), "the better seed");
    }

    #[test]
    fn a_verdict_on_the_first_steps_of_an_episode_is_not_sure() {
        let short = |returns: &[f64]| OffPolicyEstimate { support: 0.2, ..estimate(returns) };
        let two = candidates(&[("baseline", true), ("method", false)]);
        let verdict = decide(&two, &[vec![estimate(&[900.0, 901.0])], vec![short(&[100.0, 101.0])]]).unwrap();
        assert_eq!((verdict.method.as_str(), verdict.sure), ("baseline", false));
        assert_eq!(verdict.tried[1].support, Some(0.2));
        assert!(verdict.reason.ends_with("the first 20 % of an episode only."), "{}", verdict.reason);
    }

    #[test]
    fn of_two_methods_the_verdict_says_what_is_not_sure() {
        let three = candidates(&[("baseline", true), ("own", false), ("clones", false)]);
        let decide = |own: &[f64], clones: &[f64], support: f64| {
            let baseline = OffPolicyEstimate { support, ..estimate(&[100.0, 200.0, 300.0, 400.0]) };
            decide(&three, &[vec![baseline], vec![estimate(own)], vec![estimate(clones)]]).unwrap()
        };
        let own = [200.0, 300.0, 400.0, 500.0];
        // Both are far above the baseline, and one is above the other, or they are level.
        let clear = decide(&own, &[150.0, 250.0, 350.0, 450.0], 1.0);
        assert_eq!((clear.method.as_str(), clear.sure), ("own", true));
        let told = "it returns 350, which is 100 ± 0 more than baseline. The next best, clones, returns 50 ± 0 less.";
        assert!(clear.reason.ends_with(told), "{}", clear.reason);
        let level = decide(&own, &[201.0, 305.0, 382.0, 504.0], 1.0);
        assert_eq!((level.method.as_str(), level.sure), ("own", false));
        assert!(level.reason.ends_with("tell it from clones, which returns 2 ± 5 less."), "{}", level.reason);
        // The higher mean comes from one episode, and is no reason.
        let lucky = decide(&own, &[100.0, 200.0, 300.0, 1200.0], 1.0);
        assert_eq!((lucky.method.as_str(), lucky.sure), ("own", false));
        assert!(lucky.reason.contains("tell it from clones, which returns 100 ± 200 more."), "{}", lucky.reason);
        // The baseline was lost early, so that the rest of its episodes is not known.
        let short = decide(&own, &[150.0, 250.0, 350.0, 450.0], 0.2);
        assert_eq!((short.method.as_str(), short.sure), ("own", false));
        assert!(short.reason.ends_with("the first 20 % of an episode only."), "{}", short.reason);
    }

    #[test]
    fn without_baselines_the_best_is_taken_and_without_policies_nothing() {
        let two = candidates(&[("a", false), ("b", false)]);
        let verdict = decide(&two, &[vec![estimate(&[1.0, 2.0])], vec![estimate(&[3.0, 4.0])]]).unwrap();
        assert_eq!(verdict.method, "b");
        assert!(decide(&two, &[vec![], vec![]]).is_err());
    }
}
