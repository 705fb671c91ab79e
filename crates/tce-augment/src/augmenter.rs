//! The whole method on two tables: fit once, then sample, filter and label as many rows as one likes.

use std::sync::Arc;

use tce_base::Streams;
use tce_data::{Support, Transitions};
use tce_learn::{LabelConfig, LabelModels, Labelled};

use crate::config::{FilterConfig, GeneratorConfig, LabelsConfig, Terminal};
use crate::error::{Error, Result};
use crate::finish::{Finisher, TerminalRule, fit_labels, label_members};
use crate::two_stage::{Draw, Generator};
use crate::work::Work;

/// Settings of the whole method.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// The score networks.
    pub generator: GeneratorConfig,
    /// Which generated rows are left out.
    pub filter: FilterConfig,
    /// Inverse dynamics, reward and terminal flags.
    pub labels: LabelsConfig,
}

impl Settings {
    /// What measures best with one setting for all tasks: the values of the preset `default`.
    pub fn recommended() -> Self {
        Self {
            generator: GeneratorConfig::recommended(),
            filter: FilterConfig::recommended(),
            labels: LabelsConfig::recommended(),
        }
    }
}

/// Generated state pairs of a population: live dimensions in the data's units, `[P, rows, d]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Pairs {
    /// ŝ.
    pub states: Vec<f32>,
    /// ŝ'.
    pub successors: Vec<f32>,
    /// Rows of one member.
    pub rows: usize,
}

/// TCE fitted to a source and a target table.
pub struct Augmenter {
    /// q_mix and q_tran.
    pub generator: Generator,
    /// Inverse dynamics and reward.
    pub labels: LabelModels,
    settings: Settings,
    terminal: Terminal,
    rule: Option<TerminalRule>,
    support: Option<Support>,
    target: Transitions,
}

impl Augmenter {
    /// Trains label models and score networks for every seed of `work`. Actions are in [-1, 1]. `rule` tells whether a state ends an
    /// episode, where the robot's rule is known. Rows whose s' is unknown are left out.
    ///
    /// # Errors
    /// If a table or a setting cannot be used, a network diverges, or the user interrupts.
    pub fn fit(
        source: &Transitions,
        target: &Transitions,
        settings: &Settings,
        rule: Option<TerminalRule>,
        work: &Work,
    ) -> Result<Self> {
        if settings.filter.by_dynamics() {
            return Err(Error::Failed(
                "filter.by: found \"consistency\", expected \"zscore\": learned dynamics are the caller's (tce_learn::dynamics)".into(),
            ));
        }
        let source = &*source.with_successors();
        let target = &*target.with_successors();
        let any_terminal = source.terminals.iter().chain(&target.terminals).any(|terminal| *terminal);
        let terminal = settings.labels.terminal_for(rule.is_some(), any_terminal);
        let learn_terminals = terminal == Terminal::Learned;
        let config = LabelConfig { learn_terminals, ..settings.labels.training.clone() };
        let both = learn_terminals.then(|| Arc::new(source.clone()));
        let members = label_members(Arc::new(target.clone()), both, work.seeds);
        let labels = fit_labels(&members, &config, &mut work.keeper.checkpoints("labels")?, work.device)?;
        let (generator, _) = Generator::fit(Some(source), target, &settings.generator, Some(&labels), work)?;
        let support = settings.generator.support.then(|| support_of(&[target, source]));
        let (settings, target) = (settings.clone(), target.clone());
        Ok(Self { generator, labels, settings, terminal, rule, support, target })
    }

    /// Samples `rows` state pairs per member under ŷ ~ U(0, `y_max`): 0 is the target's own states, 1 the source's. One seed for each
    /// member; the same seed gives the same rows.
    ///
    /// # Errors
    /// If there are more or fewer seeds than members, or the user interrupts.
    pub fn sample(&self, rows: usize, y_max: f32, seeds: &[u64]) -> Result<Pairs> {
        let members = self.generator.state.members();
        if seeds.len() != members {
            let found = seeds.len();
            return Err(Error::Failed(format!("seeds: found {found}, expected {members}: one for each member")));
        }
        let streams: Vec<_> = seeds.iter().map(|&seed| Streams::new(seed)).collect();
        let draw = Draw::new(&self.settings.generator.sampler, &streams, &self.target).within(self.support.as_ref());
        let (states, successors) = self.generator.sample_pairs(rows, y_max, &draw)?;
        Ok(Pairs { states, successors, rows })
    }

    /// Which pairs of each member pass the filter.
    pub fn filter(&self, pairs: &Pairs) -> Vec<Vec<bool>> {
        let finisher = self.finisher();
        self.members(pairs).map(|(states, successors)| finisher.keep(states, successors)).collect()
    }

    /// Filters pairs, and infers actions, rewards and terminal flags of those that are left: one table per member, each row an episode
    /// of its own.
    ///
    /// # Errors
    /// If the filter leaves nothing.
    pub fn label(&self, pairs: &Pairs) -> Result<Vec<Labelled>> {
        self.finisher().finish(&self.members(pairs).collect::<Vec<_>>())
    }

    fn members<'a>(&self, pairs: &'a Pairs) -> impl Iterator<Item = (&'a [f32], &'a [f32])> {
        let n = (pairs.rows * self.generator.units.live.len()).max(1);
        pairs.states.chunks(n).zip(pairs.successors.chunks(n))
    }

    fn finisher(&self) -> Finisher<'_> {
        Finisher {
            units: &self.generator.units,
            models: &self.labels,
            filter: &self.settings.filter,
            terminal: self.terminal,
            rule: self.rule.clone(),
        }
    }
}

/// What the observations of all `tables` respect: clipped ranges, constants, unit quaternions.
pub fn support_of(tables: &[&Transitions]) -> Support {
    let rows: Vec<&[f32]> =
        tables.iter().flat_map(|t| [t.observations.as_slice(), t.next_observations.as_slice()]).collect();
    Support::fit(&rows, tables.first().map_or(0, |t| t.obs_dim))
}
