//! A run: one variant on one pair of data sets, from rows to scores, in one directory.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tce_augment::config::{FilterConfig, GeneratorConfig, LabelsConfig};
use tce_augment::mixture::ScoredRows;
use tce_base::{write_atomically, write_json};
use tce_learn::{DynamicsConfig, LearnedRows, Mode, RowScores};
use tce_nn::Device;
use tce_report::analysis::counts_for;
use tce_zoo::actors::{Arena, Evaluation};

use crate::augment::single_stage;
use crate::augment::{Generated, augment_rows, label_models};
use crate::clones::take_actions;
use crate::config::{Config, EvaluationConfig, GeneratedRows, MixtureConfig, SourceRows, used_of_single_stage};
use crate::error::{Error, Result};
use crate::inputs::{Domains, InputSpec, Inputs};
use crate::methods::{negated_costs, row_scores};
use crate::mixture::{distances, extra_rows};
use crate::policy_training::{Learned, MemberData, learn, policy_file, save_policies};
use crate::stage::{Attempt, Stage};
use crate::variant::Variant;

/// The outcome of a variant.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// The variant's name, or what the user called the run.
    pub name: String,
    /// Whether the learner is the public code's or the paper's, where they differ.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mode: Option<Mode>,
    /// The seeds, one member each.
    pub seeds: Vec<u64>,
    /// Normalised score per seed; None if its policy could not be evaluated. Empty without a simulator.
    pub scores: Vec<Option<f64>>,
    /// Learning and evaluation.
    pub learned: Learned,
    /// Rows that joined the target rows, per member.
    pub extra_rows: usize,
    /// The generated rows, per member; empty if there are none.
    pub generated: Vec<Generated>,
    /// How far the actions of clones are from the own ones of the rows that have them, per member: the root mean square; empty if none have.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub action_distances: Vec<f64>,
    /// Seconds from data to scores, without stages that were finished before. Interrupted attempts count up to their last checkpoint.
    pub seconds: f64,
    /// The directory of the run.
    pub directory: PathBuf,
    /// The files of the target's and the source's rows, if it had any, as they were called at the time.
    #[serde(default)]
    pub data: Vec<PathBuf>,
}

impl Summary {
    /// What the seeds' policies count for ([`counts_for`]); one that could not act to the end has diverged.
    pub fn counted(&self) -> Vec<f64> {
        let of = |(score, evaluation): (&Option<f64>, &Evaluation)| counts_for(*score, evaluation.failed.is_some());
        self.scores.iter().zip(&self.learned.evaluations).filter_map(of).collect()
    }

    /// The policies' files, one per seed.
    pub fn policies(&self) -> Vec<PathBuf> {
        self.seeds.iter().map(|seed| self.directory.join(policy_file(*seed))).collect()
    }
}

/// The inputs of a run's key. Settings that the variant does not use are left out, so that presets share baselines.
#[derive(Serialize)]
struct RunSpec<'a> {
    inputs: InputSpec,
    seeds: &'a [u64],
    mixture: MixtureConfig,
    learner: serde_json::Value,
    evaluation: &'a EvaluationConfig,
    generator: Option<&'a GeneratorConfig>,
    filter: Option<&'a FilterConfig>,
    labels: Option<&'a LabelsConfig>,
    #[serde(skip_serializing_if = "Option::is_none")]
    dynamics: Option<&'a DynamicsConfig>,
    joint: Option<serde_json::Value>,
}

impl<'a> RunSpec<'a> {
    fn new(inputs: &Inputs, config: &'a Config, seeds: &'a [u64]) -> Self {
        Self {
            inputs: inputs.spec_imitated(Domains::with_source(config.needs_source()), &config.target),
            seeds,
            mixture: config.mixture.used(),
            learner: config.learner.used(config.mixture.learned_rows()),
            evaluation: &config.evaluation,
            generator: config.uses("generator").then_some(&config.generator),
            filter: config.uses("filter").then_some(&config.filter),
            labels: config.uses("labels").then_some(&config.labels),
            dynamics: config.uses("dynamics").then_some(&config.dynamics),
            joint: used_of_single_stage(&config.single_stage, config.mixture.generated, config.learner.algorithm),
        }
    }
}

impl Config {
    /// Whether runs of this configuration look at the setting, or the table, of this full name. It decides a run's key.
    pub fn uses(&self, key: &str) -> bool {
        let (section, rest) = key.split_once('.').unwrap_or((key, ""));
        let table = rest.split('.').next().unwrap_or_default();
        let two_stages = self.mixture.generated == GeneratedRows::Tce;
        let mixed = self.mixture.learned_rows() == LearnedRows::Mixed;
        match section {
            "generator" | "filter" => two_stages,
            "labels" => two_stages || self.mixture.source == SourceRows::Relabelled,
            "dynamics" => two_stages && self.filter.by_dynamics(),
            "single_stage" => {
                let used = used_of_single_stage(&self.single_stage, self.mixture.generated, self.learner.algorithm);
                used.is_some_and(|used| used.get(table).is_some())
            }
            "mixture" => mixed || table != "actions",
            "learner" => {
                let used = self.learner.used(self.mixture.learned_rows()).get(table).is_some();
                used && (mixed || key != "learner.bc.scale_by")
            }
            "source" => self.needs_source(),
            // Verdicts on files of one's own alone.
            "fitted_q" => false,
            _ => true,
        }
    }
}

/// What a run says about its policies: `result.json`.
#[derive(Serialize)]
struct Outcome<'a> {
    seeds: &'a [u64],
    scores: &'a [Option<f64>],
    evaluations: &'a [Evaluation],
}

impl Config {
    /// Whether source rows are looked at, in any stage.
    pub fn needs_source(&self) -> bool {
        let generating = match self.mixture.generated {
            GeneratedRows::None | GeneratedRows::Synther => false,
            GeneratedRows::Tce => self.generator.source_states || self.generator.rows == 0 || self.filter.by_dynamics(),
            GeneratedRows::Dmc => true,
        };
        generating || self.mixture.source != SourceRows::None || self.row_scores() == RowScores::Density
    }

    /// Which distances of source rows decide, in the mixture or in the learner, if any.
    pub fn distances(&self) -> Option<SourceRows> {
        match self.mixture.source {
            kind @ (SourceRows::Nearest | SourceRows::Transport) => Some(kind),
            SourceRows::All if self.source_alone() && self.row_scores() == RowScores::Transport => {
                Some(SourceRows::Transport)
            }
            _ => None,
        }
    }

    /// By which numbers the learner chooses among other rows.
    fn row_scores(&self) -> RowScores {
        self.learner.algorithm.about().scores
    }

    /// Whether the rows besides the target's are the source's, as they are.
    fn source_alone(&self) -> bool {
        self.mixture.source == SourceRows::All && self.mixture.generated == GeneratedRows::None
    }

    /// The number of every source row by which the learner chooses, where it is computed once for all seeds.
    fn source_scores(&self, inputs: &Inputs, root: &Path) -> Result<Option<Arc<Vec<f32>>>> {
        match self.row_scores() {
            RowScores::Density => {
                Ok(Some(Arc::new(single_stage::scores(inputs, &self.single_stage.scores, root)?.source)))
            }
            RowScores::Transport if self.source_alone() => {
                Ok(Some(negated_costs(distances(inputs, SourceRows::Transport, root)?)))
            }
            _ => Ok(None),
        }
    }
}

/// Runs `config` on `inputs`, or takes the result from its directory under `root` if it is there.
pub fn run(
    name: &str,
    inputs: &Inputs,
    config: &Config,
    seeds: &[u64],
    root: &Path,
    place: &str,
    device: &Device,
) -> Result<Summary> {
    inputs.ensure_episodes(&config.learner)?;
    let inputs = &*inputs.seen_by(config);
    let spec = RunSpec::new(inputs, config, seeds);
    let stage = Stage::open(root, &format!("{place}/{name}"), &spec, device)?;
    if let Some(summary) = stage.summary::<Summary>()? {
        tce_base::note!("{name}: done before, in {}", stage.directory().display());
        // The folder may have been moved since.
        return Ok(Summary { directory: stage.directory().to_owned(), ..summary });
    }
    tce_base::note!("{name}: {}", stage.directory().display());
    let attempt = stage.attempt()?;
    write_atomically(&attempt.file("config.toml"), config.to_toml().as_bytes())?;
    let mut files = vec!["config.toml".to_owned()];

    // The policies whose actions other rows get: the baseline, a run of its own beside this one.
    let clones = match config.mixture.by_clones() {
        true => run(Variant::BcEnsemble.name(), inputs, &config.of_clones(), seeds, root, place, device)?.policies(),
        false => Vec::new(),
    };
    let (extra, reports) = other_rows(inputs, config, seeds, root, &attempt, &mut files, device)?;
    if let Some(choice) = inputs.choice(&config.target) {
        tce_base::note!("{name}: {}", choice.reason);
    }
    let mut data = members(inputs, config, extra.as_deref(), seeds)?;
    let extra_count = extra.as_ref().map_or(0, |e| e[0].rows.len());
    // So that actions are replaced in place where no other member has the rows.
    drop(extra);
    let action_distances = take_actions(&mut data, &clones)?;
    let arena = match (inputs.agent, inputs.shift) {
        (Some(agent), Some(shift)) => Some(Arena::new(agent, shift, config.evaluation.scores)),
        _ => None,
    };
    let place = (attempt.directory(), attempt.key());
    tce_base::begin_step(&crate::course::training_step(name));
    // The end of the attempt removes what the training leaves.
    let (learned, _) = learn(data, &config.learner, &config.evaluation, arena, place, device, |policies| {
        save_policies(policies, seeds, attempt.directory(), inputs)?;
        files.extend(seeds.iter().map(|&seed| policy_file(seed)));
        Ok(())
    })?;
    let summary = Summary {
        name: name.to_owned(),
        mode: config.learner.mode(),
        seeds: seeds.to_vec(),
        scores: learned.scores(),
        learned,
        extra_rows: extra_count,
        generated: reports,
        action_distances,
        seconds: attempt.seconds(),
        directory: stage.directory().to_owned(),
        data: inputs.files(),
    };
    // No times: two copies of a run have the same bytes.
    let result = "result.json".to_owned();
    write_json(
        &attempt.file(&result),
        &Outcome { seeds, scores: &summary.scores, evaluations: &summary.learned.evaluations },
    )?;
    files.push(result);
    attempt.finish(&files, &summary)?;
    Ok(summary)
}

/// The rows besides the target's, per member; None for target rows alone. And what there is to tell of generated ones: their files are linked
/// into `attempt`, and added to `files`.
fn other_rows(
    inputs: &Inputs,
    config: &Config,
    seeds: &[u64],
    root: &Path,
    attempt: &Attempt,
    files: &mut Vec<String>,
    device: &Device,
) -> Result<(Option<Vec<ScoredRows>>, Vec<Generated>)> {
    let (mut reports, mut tables) = (Vec::new(), None);
    if config.mixture.generated != GeneratedRows::None {
        let augmentation = augment_rows(inputs, config, seeds, root, device)?;
        files.extend(augmentation.link_into(attempt)?);
        reports = augmentation.reports;
        let scored = augmentation.tables.into_iter().zip(augmentation.scores);
        tables = Some(scored.map(|(rows, scores)| ScoredRows { rows, scores }).collect::<Vec<_>>());
    }
    let relabelled = config.mixture.source == SourceRows::Relabelled;
    let models = if relabelled { Some(label_models(inputs, &config.labels, seeds, root, device)?.0) } else { None };
    let scores = config.source_scores(inputs, root)?;
    let extra = extra_rows(inputs, config, tables.as_deref(), models.as_ref(), scores, seeds, root)?;
    Ok((extra, reports))
}

/// What every member learns from: the target's rows, and its `extra` ones.
fn members(inputs: &Inputs, config: &Config, extra: Option<&[ScoredRows]>, seeds: &[u64]) -> Result<Vec<MemberData>> {
    let target = inputs.learned_from(&config.target);
    let mut trajectories = vec![target.clone()];
    if let (SourceRows::All, Some(extra)) = (config.mixture.source, extra) {
        // Generated rows are no trajectories.
        let generated = config.mixture.generated != GeneratedRows::None;
        trajectories.push(if generated { inputs.source()?.rows.clone() } else { extra[0].rows.clone() });
    }
    let scores = |rows: &ScoredRows| match &rows.scores {
        Some(scores) => Ok(Some(scores.clone())),
        // Generated rows among them are each seed's own.
        None => row_scores(config, &target, &rows.rows),
    };
    let scores = extra.iter().copied().flatten().map(scores).collect::<Result<Vec<_>>>()?;
    let data = |(m, &seed): (usize, &u64)| MemberData {
        seed,
        target: target.clone(),
        extra: extra.map(|e| e[m].rows.clone()),
        row_scores: scores.get(m).cloned().flatten(),
        trajectories: trajectories.clone(),
    };
    Ok(seeds.iter().enumerate().map(data).collect())
}

/// `n` seeds from `first` on.
pub fn seeds(first: u64, n: usize) -> Result<Vec<u64>> {
    if n == 0 {
        return Err(Error::Usage("--seeds must be at least 1".into()));
    }
    Ok((first..first + n as u64).collect())
}
