//! From state pairs to transitions: the filter (Eq. 8), then actions, rewards and terminal flags.

use std::sync::Arc;

use tce_base::{Interrupted, Streams};
use tce_data::{Rows, Standardizer, Transitions, zscore_keep};
use tce_learn::{LabelConfig, LabelModels, Labelled, Member, TerminalHandling, train_labels};
use tce_nn::{Checkpoints, Device};

use crate::config::{FilterConfig, FilterKind, Terminal};
use crate::error::{Error, Result};
use crate::units::Units;

/// The members that label models learn from: the rows of `target`, and for a classifier of terminals those of `source`, too.
pub fn label_members(target: Arc<Transitions>, source: Option<Arc<Transitions>>, seeds: &[u64]) -> Vec<Member> {
    let obs_dim = target.obs_dim;
    let parts: Vec<_> = std::iter::once(target).chain(source).collect();
    let member = |&seed: &u64| Member {
        streams: Streams::new(seed),
        parts: parts.clone(),
        standardizer: Standardizer::identity(obs_dim),
        reward_scale: 1.0,
        row_scores: None,
    };
    seeds.iter().map(member).collect()
}

/// Trains inverse dynamics and reward models, and a classifier of terminals where `config` says so.
///
/// # Errors
/// If the rows or the settings cannot be used, a checkpoint cannot be kept, or the user interrupts.
pub fn fit_labels(
    members: &[Member],
    config: &LabelConfig,
    checkpoints: &mut Checkpoints,
    device: &Device,
) -> Result<LabelModels> {
    train_labels(members, config, checkpoints, device)?.ok_or_else(|| Interrupted::resumable().into())
}

/// A robot's own rule: whether a state ends an episode.
pub type TerminalRule = Arc<dyn Fn(&[f32]) -> bool + Send + Sync>;

/// Filters and labels state pairs of live dimensions.
pub struct Finisher<'a> {
    /// The units of the pairs.
    pub units: &'a Units,
    /// Inverse dynamics and reward.
    pub models: &'a LabelModels,
    /// Eq. 8.
    pub filter: &'a FilterConfig,
    /// Where terminal flags come from.
    pub terminal: Terminal,
    /// The rule for [`Terminal::Rule`].
    pub rule: Option<TerminalRule>,
}

impl Finisher<'_> {
    /// Which pairs `[rows, d]` pass the filter; pairs that hold a number that is not finite, and those that begin in a state that a
    /// known rule calls terminal, never do.
    pub fn keep(&self, states: &[f32], successors: &[f32]) -> Vec<bool> {
        let d = self.units.live.len();
        let finite = states
            .chunks_exact(d)
            .zip(successors.chunks_exact(d))
            .map(|(s, s2)| s.iter().chain(s2).all(|v| v.is_finite()));
        let mut keep: Vec<bool> = finite.collect();
        if let (Terminal::Rule, Some(ends)) = (self.terminal, &self.rule) {
            // No episode goes on from a state that has ended it.
            let whole = self.units.put_back(states);
            let states = whole.chunks_exact(whole.len() / keep.len().max(1));
            keep.iter_mut().zip(states).for_each(|(keep, s)| *keep = *keep && !ends(s));
        }
        if self.filter.enabled && self.filter.by == FilterKind::Zscore {
            let (states, successors) = (choose(states, d, &keep), choose(successors, d, &keep));
            let pairs = Rows::join(&[(&states, d), (&successors, d)]);
            let inliers = zscore_keep(&pairs, self.filter.z_threshold);
            keep.iter_mut().filter(|k| **k).zip(inliers).for_each(|(keep, inlier)| *keep = inlier);
        }
        keep
    }

    /// Filters, labels, and makes tables of what is left: one pair of `[rows, d]` per member of the label models.
    pub fn finish(&self, pairs: &[(&[f32], &[f32])]) -> Result<Vec<Labelled>> {
        let d = self.units.live.len();
        let mut kept = Vec::new();
        for (states, successors) in pairs {
            let keep = self.keep(states, successors);
            let whole = |rows: &[f32]| self.units.put_back(&choose(rows, d, &keep));
            let (s, s2) = (whole(states), whole(successors));
            if s.is_empty() {
                return Err(everything_rejected(keep.len(), self.filter));
            }
            kept.push((s, s2));
        }
        self.label(&kept)
    }

    /// Labels pairs of whole states, one pair of tables per member.
    pub fn label(&self, pairs: &[(Vec<f32>, Vec<f32>)]) -> Result<Vec<Labelled>> {
        let ends = self.rule.as_ref().map(|rule| move |_: &[f32], s2: &[f32]| rule(s2));
        let terminals = match (self.terminal, &ends) {
            (Terminal::None, _) => TerminalHandling::None,
            (Terminal::Rule, Some(ends)) => TerminalHandling::Rule(ends),
            (Terminal::Rule | Terminal::Learned, _) => TerminalHandling::Learned,
        };
        Ok(self.models.label(pairs, terminals)?)
    }
}

/// Of `rows` generated rows none is left.
pub fn everything_rejected(rows: usize, filter: &FilterConfig) -> Error {
    let threshold = match filter.by {
        FilterKind::Zscore => format!("z_threshold = {}", filter.z_threshold),
        FilterKind::Consistency => format!("margin = {}", filter.margin),
    };
    Error::Failed(format!("the filter rejected all {rows} generated rows; is filter.{threshold} meant?"))
}

fn choose(rows: &[f32], d: usize, keep: &[bool]) -> Vec<f32> {
    let kept = rows.chunks_exact(d).zip(keep).filter(|(_, keep)| **keep);
    kept.flat_map(|(row, _)| row.iter().copied()).collect()
}
