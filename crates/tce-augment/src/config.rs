//! Settings of the generators, their filter and their labels. What a field's comment says is what `tce config show KEY` tells a user: a
//! sentence on what the key does, and behind `Source:` where its value is from, if it is the same for every preset.

use serde::{Deserialize, Serialize};
use tce_base::OrAuto;
use tce_data::DensityOptions;
use tce_diffusion::{Edm, Process, Sampler, Schedule, Target, UntilDone};
use tce_learn::LabelConfig;

/// The two score networks and how they are sampled.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GeneratorConfig {
    /// The noise process of the score networks, chosen by its `kind`.
    pub process: Process,
    /// How rows are drawn from the score networks, chosen by its `kind`.
    pub sampler: Sampler,
    /// What q_tran generates: the next state, or its difference from the state. Source: the paper has the next state.
    pub target: Target,
    /// Updates of q_mix, the network over states, or "auto": until it no longer helps (`generator.until_done`).
    pub state_steps: OrAuto<u64>,
    /// Updates of q_tran, the network from a state to the next one, or "auto": until it no longer helps (`generator.until_done`).
    pub transition_steps: OrAuto<u64>,
    /// When training ends where a length is "auto".
    // Runs that were done before there was this table have fixed lengths.
    #[serde(default)]
    pub until_done: UntilDoneConfig,
    /// Rows per update of a score network. Source: Table C.4.
    #[schemars(range(min = 1))]
    pub batch: usize,
    /// Learning rate of the score networks at the beginning. Source: Table C.4: 1e-4.
    pub learning_rate: f64,
    /// The learning rate over the updates.
    pub schedule: Schedule,
    /// Share of its past that the averaged network keeps in each update. 0: no average.
    #[schemars(range(min = 0.0, max = 0.999999))]
    pub ema: f64,
    /// Whether half of each batch of q_mix is from the target and half from the source. Otherwise rows are drawn evenly from both.
    pub balanced: bool,
    /// Whether q_mix sees source states. Without them this is Simple Aug. Source: Table 3.
    pub source_states: bool,
    /// Whether generated rows keep to what both data sets keep to: clipped ranges, constants, unit quaternions. Source: own.
    // Runs that were done before there was this key did without.
    #[serde(default)]
    pub support: bool,
    /// How far generated states may go from the target's to the source's: ŷ ~ U(0, y_max). Source: Table C.5.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub y_max: f32,
    /// Rows that are generated per seed, before filtering. 0: (1 - λ) times the source rows. Source: the paper has 0.
    pub rows: usize,
}

impl GeneratorConfig {
    /// What measures best with one setting for all tasks: the values of the preset `default`.
    pub fn recommended() -> Self {
        Self {
            process: Process::Edm(Edm { sigma_max: 20.0, ..Edm::default() }),
            sampler: Sampler::SdeDpmSolver { steps: 20 },
            target: Target::Delta,
            state_steps: OrAuto::Auto,
            transition_steps: OrAuto::Auto,
            until_done: UntilDoneConfig::default(),
            batch: 128,
            learning_rate: 1e-3,
            schedule: Schedule::Cosine,
            ema: 0.999,
            balanced: true,
            source_states: true,
            support: true,
            y_max: 0.2,
            rows: 100_000,
        }
    }

    /// How many rows are generated beside a share λ of so many source rows (Eq. 9).
    pub fn rows_beside(&self, lambda: f64, source: usize) -> usize {
        match self.rows {
            0 => ((1.0 - lambda) * source as f64).round() as usize,
            rows => rows,
        }
    }
}

/// When a network whose length is `"auto"` is done.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct UntilDoneConfig {
    /// Updates of the first cycle; every further one is twice as long. Source: own.
    pub first: u64,
    /// Most updates of all cycles of q_mix together. Source: own.
    pub state_limit: u64,
    /// Most updates of all cycles of q_tran together. Source: own.
    pub transition_limit: u64,
    /// Share by which a cycle has to lower q_mix's held-out loss, or the error of the actions that q_tran implies at held-out
    /// states, for another one to follow. Source: own.
    pub gain: f64,
    /// Share of the target rows that is held out, in runs of 25 steps. Source: own.
    #[schemars(range(min = 0.001, max = 0.5))]
    pub held_out: f64,
}

impl Default for UntilDoneConfig {
    fn default() -> Self {
        Self { first: 7_500, state_limit: 60_000, transition_limit: 120_000, gain: 0.1, held_out: 0.05 }
    }
}

impl UntilDoneConfig {
    /// The plan of q_mix.
    pub fn state(&self) -> UntilDone {
        UntilDone { first: self.first, limit: self.state_limit, gain: self.gain }
    }

    /// The plan of q_tran.
    pub fn transition(&self) -> UntilDone {
        UntilDone { first: self.first, limit: self.transition_limit, gain: self.gain }
    }
}

/// Which generated rows are left out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FilterConfig {
    /// Whether generated rows are filtered.
    pub enabled: bool,
    /// By what rows are told to be bad.
    #[serde(default, skip_serializing_if = "FilterKind::is_zscore")]
    pub by: FilterKind,
    /// How many standard deviations from the mean a dimension of a row may be, with `by = "zscore"`. Source: Eq. 8, Table C.5.
    #[schemars(range(min = 0.1, max = 1000000000.0))]
    pub z_threshold: f64,
    /// How many times the error that 95 % of held-out real rows stay below a row's error may be, with `by = "consistency"`. Source:
    /// own.
    // In runs that were done before there was this key the z-score decides.
    #[serde(default = "FilterConfig::default_margin", skip_serializing_if = "FilterConfig::is_default_margin")]
    #[schemars(range(min = 0.01, max = 1000000000.0))]
    pub margin: f64,
}

impl FilterConfig {
    /// No filter: what measures best with one setting for all tasks, the values of the preset `default`.
    pub fn recommended() -> Self {
        Self { enabled: false, by: FilterKind::Zscore, z_threshold: 3.0, margin: Self::default_margin() }
    }

    /// Whether learned dynamics tell which rows stay.
    pub fn by_dynamics(&self) -> bool {
        self.enabled && self.by == FilterKind::Consistency
    }

    fn default_margin() -> f64 {
        2.0
    }

    fn is_default_margin(margin: &f64) -> bool {
        *margin == Self::default_margin()
    }
}

/// By what rows are told to be bad.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FilterKind {
    /// A dimension far from the mean of the generated rows (Eq. 8). It cuts the start of every episode.
    #[default]
    Zscore,
    /// A successor far from what models of both domains' dynamics expect of the row's state and action.
    Consistency,
}

impl FilterKind {
    fn is_zscore(&self) -> bool {
        *self == Self::Zscore
    }
}

/// Inverse dynamics and reward models, and where terminal flags come from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LabelsConfig {
    /// Where a generated row's terminal flag comes from. Source: the paper says nothing.
    pub terminal: Terminal,
    /// Training of inverse dynamics and reward models, on the target rows.
    pub training: LabelConfig,
}

impl LabelsConfig {
    /// What measures best with one setting for all tasks: the values of the preset `default`.
    pub fn recommended() -> Self {
        Self { terminal: Terminal::Rule, training: LabelConfig { steps: 20_000, ..LabelConfig::paper() } }
    }

    /// Where terminal flags come from, for a robot whose rule is known or not, and data with or without terminal rows: a rule only where
    /// it is known, a classifier only where there is something to learn.
    pub fn terminal_for(&self, rule_known: bool, any_terminal: bool) -> Terminal {
        match self.terminal {
            Terminal::Rule if rule_known => Terminal::Rule,
            Terminal::Rule | Terminal::Learned if any_terminal => Terminal::Learned,
            _ => Terminal::None,
        }
    }
}

/// Where a generated row's terminal flag comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Terminal {
    /// Never terminal.
    None,
    /// The agent's own rule on ŝ'; where the agent is unknown, `learned`.
    Rule,
    /// A classifier trained on the target's and the source's rows. Without any terminal row: `none`.
    Learned,
}

/// The network over whole transitions, for `mixture.generated` = synther and dmc, and how it is sampled.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SingleStageConfig {
    /// The noise process of the single-stage network, chosen by its `kind`.
    pub process: Process,
    /// How rows are drawn from the single-stage network, chosen by its `kind`.
    pub sampler: Sampler,
    /// What stands in a generated row for s': s' itself, or its difference from s. Source: SynthER and DmC have the next state.
    pub target: Target,
    /// Width of the single-stage network's layers. Source: SynthER, DmC: 2048.
    #[schemars(range(min = 1))]
    pub width: usize,
    /// Width of the embedding of the noise level.
    #[schemars(range(min = 1))]
    pub embedding: usize,
    /// Residual blocks of the single-stage network. Source: SynthER, DmC: 6.
    pub blocks: usize,
    /// Training steps of the single-stage network. Source: SynthER, DmC: 100 000.
    pub steps: u64,
    /// Rows per step of the single-stage network. Source: SynthER, DmC: 1024, 256 for small data.
    #[schemars(range(min = 1))]
    pub batch: usize,
    /// Learning rate of the single-stage network at the beginning. Source: SynthER, DmC: 3e-4.
    pub learning_rate: f64,
    /// The learning rate over the steps.
    pub schedule: Schedule,
    /// Share of its past that the averaged network keeps in each step. 0: no average.
    #[schemars(range(min = 0.0, max = 0.999999))]
    pub ema: f64,
    /// Rows that are generated per seed. Source: SynthER: 5M; DmC: as many as source rows, at least 1M.
    #[schemars(range(min = 1))]
    pub rows: usize,
    /// How scores guide DmC's generator.
    pub guidance: GuidanceConfig,
    /// How source rows are scored: 1 / (1 + ρ - min ρ), ρ the log ratio of distances to target and source neighbours. Source: DmC.
    pub scores: DensityOptions,
}

impl SingleStageConfig {
    /// What measures best with one setting for all tasks: the values of the preset `default`.
    pub fn recommended() -> Self {
        Self {
            process: Process::Edm(Edm { sigma_max: 20.0, ..Edm::default() }),
            sampler: Sampler::SdeDpmSolver { steps: 20 },
            target: Target::Next,
            width: 256,
            embedding: 128,
            blocks: 4,
            steps: 30_000,
            batch: 128,
            learning_rate: 5e-4,
            schedule: Schedule::Cosine,
            ema: 0.999,
            rows: 200_000,
            guidance: GuidanceConfig { dropout: 0.25, weight: 1.2, from: 0.9, rescore: false },
            scores: DensityOptions::default(),
        }
    }
}

/// How scores guide DmC's generator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GuidanceConfig {
    /// Share of training rows that the network sees without their score. Source: DmC.
    #[schemars(range(min = 0.0, max = 0.999))]
    pub dropout: f64,
    /// w, how strongly rows are drawn towards their score. Source: DmC.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub weight: f64,
    /// Rows are drawn under the whole percentiles of the training scores from this one to the 99th, equally likely. Source: DmC.
    #[schemars(range(min = 0.0, max = 0.99))]
    pub from: f64,
    /// Whether a generated row's score is measured anew. Otherwise it keeps the one that it was drawn under.
    pub rescore: bool,
}
