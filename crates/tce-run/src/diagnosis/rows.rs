//! Generated rows under a label bound, with all that is known of each: whether the filter keeps it, its labels, and what the
//! simulator makes of it.

use tce_augment::config::FilterConfig;
use tce_augment::finish::{Finisher, everything_rejected};
use tce_augment::two_stage::{Draw, Generator};
use tce_base::Streams;
use tce_data::{Agent, Shift, Support, Transitions};
use tce_diffusion::uniform_labels;
use tce_sim::{Simulated, simulate};

use crate::config::Config;
use crate::error::{Error, Result};
use crate::off_policy_evaluation::OffPolicyEvaluator;

/// Where rows come from.
pub struct Sampler<'a> {
    pub generator: &'a Generator,
    pub finisher: &'a Finisher<'a>,
    pub config: &'a Config,
    /// What the networks were trained on.
    pub target: &'a Transitions,
    /// What rows are made to respect.
    pub support: Option<Support>,
    /// What filters rows, where learned dynamics do.
    pub evaluator: Option<OffPolicyEvaluator>,
    /// Of the whole population.
    pub seeds: &'a [u64],
    /// The one to look at.
    pub member: usize,
    pub simulator: Option<(Agent, Shift)>,
}

/// Rows of one label bound, those included that the filter rejects.
pub struct Batch {
    /// Labelled rows.
    pub rows: Transitions,
    /// Whether the filter keeps a row.
    pub keep: Vec<bool>,
    /// ŷ of every row.
    pub labels: Vec<f32>,
    /// What the target's dynamics do at (ŝ, â).
    pub simulated: Option<Simulated>,
    /// Rows that hold a number that is not finite: neither labelled nor simulated, and not among `rows`.
    pub lost: usize,
}

impl Batch {
    pub fn len(&self) -> usize {
        self.keep.len()
    }

    pub fn kept(&self) -> usize {
        self.keep.iter().filter(|k| **k).count()
    }

    /// Share of all rows drawn that the filter rejects; in the pipeline it rejects lost rows as well.
    pub fn rejected(&self) -> f64 {
        1.0 - self.kept() as f64 / (self.len() + self.lost) as f64
    }

    /// The rows that pass the filter.
    pub fn kept_rows(&self) -> Transitions {
        self.rows.select(&(0..self.len()).filter(|&i| self.keep[i]).collect::<Vec<_>>())
    }

    /// Refuses a sample of which the filter leaves nothing: there is nothing to measure, nor to learn from.
    pub fn ensure_kept(&self, filter: &FilterConfig) -> Result<()> {
        match (self.len(), self.kept()) {
            (0, _) => Err(Error::Failed(format!(
                "none of {} generated rows is made of finite numbers: the score networks have diverged; train them again, with \
                 another seed or a smaller generator.learning_rate",
                self.lost
            ))),
            (_, 0) => Err(everything_rejected(self.len() + self.lost, filter).into()),
            _ => Ok(()),
        }
    }
}

impl Sampler<'_> {
    /// Labels of state pairs by the member's models, whole states in the data's units.
    pub fn label(&self, s: &[f32], s2: &[f32]) -> Result<Transitions> {
        let mut pairs = vec![(Vec::new(), Vec::new()); self.seeds.len()];
        pairs[self.member] = (s.to_vec(), s2.to_vec());
        Ok(self.finisher.label(&pairs)?.swap_remove(self.member).transitions)
    }

    /// `rows` rows under ŷ ~ U(0, y_max), none where no number is finite. Batches of one `purpose` are drawn from the same noise: they
    /// differ by their bound alone.
    pub fn sample(&self, rows: usize, y_max: f32, purpose: &str) -> Result<Batch> {
        let members: Vec<Streams> =
            self.seeds.iter().map(|&s| Streams::new(s).child(&format!("diagnosis/{purpose}"))).collect();
        let Self { generator, config, target, .. } = self;
        let units = &generator.units;
        let draw = Draw::new(&config.generator.sampler, &members, target).within(self.support.as_ref());
        let (all, successors) = generator.sample_pairs(rows, y_max, &draw)?;
        let (d, labels) = (units.live.len(), uniform_labels(&members[self.member], "state", rows, y_max));
        let own = self.member * rows * d..(self.member + 1) * rows * d;
        // A row that is no numbers can neither be labelled nor simulated.
        let pairs = all[own.clone()].chunks_exact(d).zip(successors[own].chunks_exact(d)).zip(labels);
        let (mut s, mut s2, mut kept_labels) = (Vec::new(), Vec::new(), Vec::new());
        for ((state, successor), label) in pairs {
            if state.iter().chain(successor).all(|v| v.is_finite()) {
                s.extend_from_slice(state);
                s2.extend_from_slice(successor);
                kept_labels.push(label);
            }
        }
        let lost = rows - kept_labels.len();
        if kept_labels.is_empty() {
            let rows = Transitions::new(target.obs_dim, target.act_dim);
            let simulated = self.simulator.map(|_| Simulated::default());
            return Ok(Batch { rows, keep: vec![], labels: vec![], simulated, lost });
        }
        let mut keep = self.finisher.keep(&s, &s2);
        let rows = self.label(&units.put_back(&s), &units.put_back(&s2))?;
        if let Some(evaluator) = &self.evaluator {
            let possible = evaluator.possible(&rows, config.filter.margin);
            keep.iter_mut().zip(possible).for_each(|(keep, possible)| *keep &= possible);
        }
        let simulated = match self.simulator {
            Some((agent, shift)) => Some(simulate(agent, shift, &rows.observations, &rows.actions)?),
            None => None,
        };
        Ok(Batch { rows, keep, labels: kept_labels, simulated, lost })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_without_numbers_and_one_without_survivors_are_told_apart() {
        let batch = |keep: Vec<bool>, lost: usize| Batch {
            rows: Transitions::new(1, 1),
            labels: vec![0.0; keep.len()],
            keep,
            simulated: None,
            lost,
        };
        let filter =
            FilterConfig { enabled: true, by: tce_augment::config::FilterKind::Zscore, z_threshold: 3.0, margin: 2.0 };
        let told = |b: Batch| b.ensure_kept(&filter).map_err(|e| e.to_string());
        assert!(told(batch(vec![], 5)).unwrap_err().contains("none of 5 generated rows is made of finite numbers"));
        assert!(told(batch(vec![false; 3], 1)).unwrap_err().contains("the filter rejected all 4 generated rows"));
        assert_eq!(told(batch(vec![false, true], 1)), Ok(()));
    }
}
