//! Coverage expansion as one stage (Algorithm 1, lines 2 to 7): networks, samples, filter (Eq. 8), labels; one table of
//! generated transitions per member.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_data::{Agent, LoadOptions, Rows, Standardizer, Support, Transitions, load, save_d4rl, zscore_keep};
use tce_diffusion::Chunks;
use tce_learn::{LabelConfig, LabelErrors, LabelModels, Labelled, Learner, Member, TerminalHandling, train_labels};
use tce_nn::{Device, NamedParameters};
use tce_sim::terminal_rule;

use crate::config::{Config, FilterConfig, FilterKind, GeneratedRows, LabelsConfig, Terminal};
use crate::error::{Error, Result};
use crate::generator::Generator;
use crate::inputs::{InputSpec, Inputs};
use crate::joint;
use crate::judge::Judge;
use crate::stage::Stage;
use crate::units::Units;

/// What generating rows leaves behind, per member.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Generated {
    /// The file in the stage.
    pub file: String,
    /// Rows sampled.
    pub sampled: usize,
    /// Rows that passed the filter.
    pub kept: usize,
    /// Share of inferred action components outside of the box, before clipping.
    pub outside_box: f64,
    /// Share of terminal rows.
    pub terminal: f64,
    /// Network evaluations per row, both stages of sampling together.
    pub evaluations: usize,
    /// Errors of the member's label models on held-out target rows.
    pub labels: Option<LabelErrors>,
}

/// The inverse dynamics and reward models of a whole population: trained on the target rows, or taken from their stage.
pub fn label_models(
    inputs: &Inputs,
    config: &LabelsConfig,
    seeds: &[u64],
    root: &Path,
    device: &Device,
) -> Result<(LabelModels, Stage, Vec<Option<LabelErrors>>)> {
    #[derive(Serialize)]
    struct Spec<'a> {
        inputs: InputSpec,
        seeds: &'a [u64],
        labels: &'a LabelConfig,
    }
    let learn_terminals = terminals(inputs, config) == Terminal::Learned;
    let labels = LabelConfig { learn_terminals, ..config.training.clone() };
    let spec = Spec { inputs: inputs.spec(learn_terminals), seeds, labels: &labels };
    tce_base::begin_step("label models");
    let stage = Stage::open(root, "stages/labels", &spec, device)?;
    let target = Arc::new(inputs.target.rows.clone());
    let mut parts = vec![target.clone()];
    parts.extend(inputs.source.iter().filter(|_| learn_terminals).map(|s| Arc::new(s.rows.clone())));
    let member = |&seed: &u64| Member {
        streams: Streams::new(seed),
        parts: parts.clone(),
        standardizer: Standardizer::identity(target.obs_dim),
        reward_scale: 1.0,
        row_scores: None,
    };
    let members: Vec<_> = seeds.iter().map(member).collect();
    let file = "labels.safetensors";
    let path = stage.file(file);
    if let Some(errors) = stage.summary::<Vec<Option<LabelErrors>>>()? {
        let mut models = LabelModels::new(&members, &labels, device)?;
        models.restore(&NamedParameters::load(&path)?, &path)?;
        return Ok((models, stage, errors));
    }
    let attempt = stage.attempt()?;
    let models = train_labels(&members, &labels, &mut attempt.checkpoints("labels")?, device)?;
    let models = models.ok_or(Error::Interrupted)?;
    let errors = models.errors();
    models.state().save(&attempt.file(file))?;
    attempt.finish(&[file.to_owned()], &errors)?;
    Ok((models, stage, errors))
}

/// Where terminal flags of generated rows come from, for these files: a benchmark robot's rule only where the user named the robot, a
/// classifier only where a row of either file is terminal.
fn terminals(inputs: &Inputs, config: &LabelsConfig) -> Terminal {
    let any = || std::iter::once(&inputs.target).chain(&inputs.source).any(|t| t.rows.terminals.contains(&true));
    match config.terminal {
        Terminal::Rule if inputs.agent.is_some() => Terminal::Rule,
        Terminal::Rule | Terminal::Learned if any() => Terminal::Learned,
        _ => Terminal::None,
    }
}

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
    /// Whose rule, for [`Terminal::Rule`].
    pub agent: Option<Agent>,
}

impl<'a> Finisher<'a> {
    /// What `config` says about filter and terminals, for the data of `inputs`.
    pub fn new(units: &'a Units, models: &'a LabelModels, config: &'a Config, inputs: &Inputs) -> Self {
        Self { units, models, filter: &config.filter, terminal: terminals(inputs, &config.labels), agent: inputs.agent }
    }

    /// Which pairs `[rows, d]` pass the filter; pairs that hold a number that is not finite, and those that begin in a state that a
    /// known rule calls terminal, never do.
    pub(crate) fn keep(&self, states: &[f32], successors: &[f32]) -> Vec<bool> {
        let d = self.units.live.len();
        let finite = states
            .chunks_exact(d)
            .zip(successors.chunks_exact(d))
            .map(|(s, s2)| s.iter().chain(s2).all(|v| v.is_finite()));
        let mut keep: Vec<bool> = finite.collect();
        if let (Terminal::Rule, Some(agent)) = (self.terminal, self.agent) {
            // No episode goes on from a state that has ended it.
            let whole = self.units.put_back(states);
            let states = whole.chunks_exact(whole.len() / keep.len().max(1));
            keep.iter_mut().zip(states).for_each(|(keep, s)| *keep = *keep && !terminal_rule(agent, s));
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
    pub(crate) fn label(&self, pairs: &[(Vec<f32>, Vec<f32>)]) -> Result<Vec<Labelled>> {
        let rule = |agent: Agent| move |_: &[f32], s2: &[f32]| terminal_rule(agent, s2);
        let agent_rule = self.agent.map(rule);
        let terminals = match (self.terminal, &agent_rule) {
            (Terminal::None, _) => TerminalHandling::None,
            (Terminal::Rule, Some(rule)) => TerminalHandling::Rule(rule),
            (Terminal::Rule | Terminal::Learned, _) => TerminalHandling::Learned,
        };
        Ok(self.models.label(pairs, terminals)?)
    }
}

/// Of `rows` generated rows none is left.
pub(crate) fn everything_rejected(rows: usize, filter: &FilterConfig) -> Error {
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

/// Generated tables, one per member, and where they are.
pub struct Expansion {
    /// The tables.
    pub tables: Vec<Arc<Transitions>>,
    /// A score per row, where the rows have any ([`crate::joint`]).
    pub scores: Vec<Option<Arc<Vec<f32>>>>,
    /// What was noticed.
    pub reports: Vec<Generated>,
    /// The stage with the files.
    pub stage: Stage,
}

/// The generated rows that `config.mixture` asks for, made or taken from their stage.
pub fn expand(inputs: &Inputs, config: &Config, seeds: &[u64], root: &Path, device: &Device) -> Result<Expansion> {
    match config.mixture.generated {
        GeneratedRows::Tce => two_stages(inputs, config, seeds, root, device),
        GeneratedRows::Synther | GeneratedRows::Dmc => joint::expand(inputs, config, seeds, root, device),
        GeneratedRows::None => Err(Error::Usage(
            "mixture.generated: found \"none\", expected \"tce\", \"synther\" or \"dmc\": there is nothing to generate"
                .into(),
        )),
    }
}

/// What the observations of both domains respect.
fn support(inputs: &Inputs) -> Support {
    let tables = std::iter::once(&inputs.target).chain(&inputs.source);
    let rows: Vec<&[f32]> =
        tables.flat_map(|t| [t.rows.observations.as_slice(), t.rows.next_observations.as_slice()]).collect();
    let support = Support::fit(&rows, inputs.target.rows.obs_dim);
    support.describe().iter().for_each(|finding| tce_base::note!("generated rows respect: {finding}"));
    support
}

/// Runs, or takes from its stage, TCE's whole expansion.
fn two_stages(inputs: &Inputs, config: &Config, seeds: &[u64], root: &Path, device: &Device) -> Result<Expansion> {
    #[derive(Serialize)]
    struct Spec<'a> {
        networks: String,
        labels: String,
        sampler: tce_diffusion::Sampler,
        y_max: f32,
        rows: usize,
        #[serde(skip_serializing_if = "std::ops::Not::not")]
        support: bool,
        /// The models that filter, where any do.
        #[serde(skip_serializing_if = "Option::is_none")]
        dynamics: Option<String>,
        filter: &'a FilterConfig,
        terminal: Terminal,
    }
    let (generator, networks, _) = Generator::train(inputs, config, seeds, root, device)?;
    let (models, labels, label_errors) = label_models(inputs, &config.labels, seeds, root, device)?;
    let rows = match config.generator.rows {
        0 => ((1.0 - config.mixture.lambda) * inputs.source_rows()?.len() as f64).round() as usize,
        rows => rows,
    };
    let judge = match config.filter.by_dynamics() {
        true => Some(Judge::train(inputs, &config.dynamics, root, device)?),
        false => None,
    };
    let spec = Spec {
        networks: networks.name(),
        labels: labels.name(),
        dynamics: judge.as_ref().map(|j| j.stage.name()),
        sampler: config.generator.sampler,
        y_max: config.generator.y_max,
        rows,
        support: config.generator.support,
        filter: &config.filter,
        terminal: config.labels.terminal,
    };
    tce_base::begin_step("generated rows");
    let stage = Stage::open(root, "stages/generated", &spec, device)?;
    let (reports, tables) = match stage.summary::<Vec<Generated>>()? {
        Some(reports) => {
            let read = |g: &Generated| Ok(Arc::new(load(&stage.file(&g.file), &LoadOptions::default())?.transitions));
            let tables = reports.iter().map(read).collect::<Result<Vec<_>>>()?;
            (reports, tables)
        }
        None => {
            let attempt = stage.attempt()?;
            let members: Vec<_> = seeds.iter().map(|&s| Streams::new(s)).collect();
            let target = &*inputs.imitated(&config.target);
            let support = config.generator.support.then(|| support(inputs));
            let kept = Chunks { directory: attempt.directory(), key: attempt.key() };
            let (states, successors) =
                generator.sample_pairs(rows, &config.generator, &members, target, support.as_ref(), Some(kept))?;
            let finisher = Finisher::new(&generator.units, &models, config, inputs);
            let per_member = rows * generator.units.live.len();
            let pairs: Vec<_> = states.chunks(per_member).zip(successors.chunks(per_member)).collect();
            let mut finished = finisher.finish(&pairs)?;
            if let Some(judge) = &judge {
                for labelled in &mut finished {
                    let keep = judge.possible(&labelled.transitions, config.filter.margin);
                    if keep.is_empty() {
                        return Err(everything_rejected(rows, &config.filter));
                    }
                    labelled.transitions = labelled.transitions.select(&keep);
                }
            }
            drop((states, successors));
            let (mut reports, mut tables) = (Vec::new(), Vec::new());
            for ((&seed, labelled), errors) in seeds.iter().zip(finished).zip(&label_errors) {
                let table = labelled.transitions;
                let file = format!("generated-seed{seed}.hdf5");
                let attributes = BTreeMap::from([
                    ("spec".to_owned(), serde_json::to_string(&spec).expect("plain data")),
                    ("seed".to_owned(), seed.to_string()),
                ]);
                save_d4rl(&attempt.file(&file), &table, &attributes, &[])?;
                let terminals = table.terminals.iter().filter(|t| **t).count();
                reports.push(Generated {
                    file,
                    sampled: rows,
                    kept: table.len(),
                    outside_box: labelled.outside_box,
                    terminal: terminals as f64 / table.len() as f64,
                    evaluations: 2 * config.generator.sampler.evaluations(),
                    labels: *errors,
                });
                tables.push(Arc::new(table));
            }
            let files: Vec<_> = reports.iter().map(|r| r.file.clone()).collect();
            attempt.finish(&files, &reports)?;
            (reports, tables)
        }
    };
    let scores = vec![None; tables.len()];
    Ok(Expansion { tables, scores, reports, stage })
}
