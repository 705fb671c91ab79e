//! The typed configuration of a run. The doc comment of a field is the text of `tce config show KEY` ([`crate::keys`]): one sentence on
//! what the key does, and after `Source:` the origin of its value, if all presets share it. The reason for a preset's value is a comment
//! in `presets/`. [`crate::layers`] records which layer set a value.

use serde::{Deserialize, Serialize};
use tce_augment::config::{FilterConfig, GeneratorConfig, LabelsConfig, SingleStageConfig};
use tce_data::ScoreTable;
use tce_learn::{DynamicsConfig, FittedQConfig, LearnedRows, RowScores};

use crate::error::{Error, Result};
pub use crate::learners::{Algorithm, LearnerConfig};

/// Everything that decides a run's result, apart from its data and seeds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The target data: how much of them is used, and which trajectories are imitated.
    // Sweeps that were planned, and runs that were done, before there was this table have the whole target.
    #[serde(default)]
    pub target: TargetConfig,
    /// Source data that a task does not bring along.
    pub source: SourceConfig,
    /// The two score networks q_mix and q_tran, and how they are sampled.
    pub generator: GeneratorConfig,
    /// Which generated rows are left out.
    pub filter: FilterConfig,
    /// Inverse dynamics and reward models, and where terminal flags come from.
    pub labels: LabelsConfig,
    /// Learned dynamics of both domains, by which policies are tried and, with `filter.by = "consistency"`, rows are filtered.
    // Runs that were done before there was this table used no learned dynamics.
    #[serde(default)]
    pub dynamics: DynamicsConfig,
    /// Fitted Q evaluation, which shows what policies are worth where no simulator does.
    // It decides nothing, so that a run's key names it only where it is not as usual.
    #[serde(default, skip_serializing_if = "FittedQConfig::is_default")]
    pub fitted_q: FittedQConfig,
    /// One network over whole rows, for `mixture.generated` = synther and dmc.
    // It was called `joint`. Keys of finished runs are hashes of what is serialised: the old name stays there.
    #[serde(rename(serialize = "joint"), alias = "joint")]
    pub single_stage: SingleStageConfig,
    /// The data the policy is learned from.
    pub mixture: MixtureConfig,
    /// The learner of the policy.
    pub learner: LearnerConfig,
    /// How policies are evaluated.
    pub evaluation: EvaluationConfig,
}

/// A configuration with the names that people write: `single_stage` has its own.
#[derive(Serialize)]
struct Named<'a> {
    target: &'a TargetConfig,
    source: &'a SourceConfig,
    generator: &'a GeneratorConfig,
    filter: &'a FilterConfig,
    labels: &'a LabelsConfig,
    dynamics: &'a DynamicsConfig,
    #[serde(skip_serializing_if = "Option::is_none")]
    fitted_q: Option<&'a FittedQConfig>,
    single_stage: &'a SingleStageConfig,
    mixture: &'a MixtureConfig,
    learner: &'a LearnerConfig,
    evaluation: &'a EvaluationConfig,
}

impl<'a> From<&'a Config> for Named<'a> {
    fn from(config: &'a Config) -> Self {
        // A field that is forgotten here is noticed by the test that holds this form against the keyed one.
        Self {
            target: &config.target,
            source: &config.source,
            generator: &config.generator,
            filter: &config.filter,
            labels: &config.labels,
            dynamics: &config.dynamics,
            fitted_q: (!config.fitted_q.is_default()).then_some(&config.fitted_q),
            single_stage: &config.single_stage,
            mixture: &config.mixture,
            learner: &config.learner,
            evaluation: &config.evaluation,
        }
    }
}

/// How much of the target data is used.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TargetConfig {
    /// How many rows of the target file are used, from the first on, as if the log had ended there. 0: all of them.
    pub rows: usize,
    /// Which of the target's trajectories are imitated.
    // Runs that were done before there was this key imitate all of them.
    #[serde(default)]
    pub trajectories: Trajectories,
}

/// Which of the target's trajectories are imitated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Trajectories {
    /// All of them.
    #[default]
    All,
    /// The better ones, where the returns show two behaviours ([`tce_data::choose_trajectories`]); else all of them.
    Auto,
}

/// Source data that a task does not bring along.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SourceConfig {
    /// How many source rows are collected where a task names no source file. Source: Table C.1.
    #[schemars(range(min = 1))]
    pub rows: usize,
}

/// The keys of the single-stage generator that decide generated rows of this kind, or the scores of source rows alone: what a run's
/// identity depends on. None where no key does.
pub fn used_of_single_stage(
    config: &SingleStageConfig,
    generated: GeneratedRows,
    algorithm: Algorithm,
) -> Option<serde_json::Value> {
    let mut used = serde_json::json!(config);
    match (generated, algorithm) {
        (GeneratedRows::Dmc, _) => {}
        (GeneratedRows::Synther, _) => {
            let keys = used.as_object_mut().expect("a table");
            keys.remove("guidance");
            keys.remove("scores");
        }
        (_, algorithm) if algorithm.about().scores == RowScores::Density => {
            used = serde_json::json!({ "scores": config.scores });
        }
        _ => return None,
    }
    Some(used)
}

/// Which generated rows join the target rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum GeneratedRows {
    /// None.
    None,
    /// TCE's: states, successors, filter, labels (`generator`, `filter`, `labels`).
    Tce,
    /// Whole transitions like the target's (`single_stage`).
    Synther,
    /// Whole transitions like the most target-like ones of source and target (`single_stage`).
    Dmc,
}

/// Which source rows join the target rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SourceRows {
    /// None of them.
    None,
    /// The λ share nearest to a target row (Eq. 9).
    Nearest,
    /// The λ share with the least optimal-transport cost (OTDF's).
    Transport,
    /// All of them.
    All,
    /// All of them, with actions inferred by the target's inverse dynamics (SwT, Appendix G.2).
    Relabelled,
}

/// Which actions rows besides the target's are cloned with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum RowActions {
    /// Their own; a generated row's is inferred by the inverse dynamics.
    #[default]
    Own,
    /// Those of clones of the target rows in the same states. Only `bc` can learn from such rows: these actions do not lead to the rows' next
    /// states.
    Clones,
}

impl RowActions {
    fn is_own(&self) -> bool {
        *self == Self::Own
    }
}

/// The data the policy is learned from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MixtureConfig {
    /// Which generated rows join the target rows.
    pub generated: GeneratedRows,
    /// Which source rows join the target rows.
    pub source: SourceRows,
    /// λ, the share of source rows in the mixture; the rest are generated. Source: Eq. 9, Table C.5.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lambda: f64,
    /// Which actions generated and source rows are cloned with. `tce learn` tries both unless this is "clones" or `--actions` says one.
    // Runs that were done before there was this key have the rows' own, and keep their keys.
    #[serde(default, skip_serializing_if = "RowActions::is_own")]
    pub actions: RowActions,
}

impl MixtureConfig {
    /// The target's rows alone.
    pub fn none() -> Self {
        Self { generated: GeneratedRows::None, source: SourceRows::None, lambda: 0.0, actions: RowActions::Own }
    }

    /// The same with these actions.
    pub fn with_actions(&self, actions: RowActions) -> Self {
        Self { actions, ..self.clone() }
    }

    /// What a run depends on: target rows keep their actions.
    pub fn used(&self) -> Self {
        self.with_actions(if self.by_clones() { RowActions::Clones } else { RowActions::Own })
    }

    /// Whether clones of the target rows are learned first, for the actions of other rows.
    pub fn by_clones(&self) -> bool {
        self.by_clones_on(self.learned_rows())
    }

    /// The same for a training on these rows, which are the user's own.
    pub fn by_clones_on(&self, rows: LearnedRows) -> bool {
        self.actions == RowActions::Clones && rows == LearnedRows::Mixed
    }

    /// Whether rows besides the target's are learned from.
    pub fn learned_rows(&self) -> LearnedRows {
        match (self.generated, self.source) {
            (GeneratedRows::None, SourceRows::None) => LearnedRows::Target,
            _ => LearnedRows::Mixed,
        }
    }
}

/// How policies are evaluated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Episodes of an evaluation.
    #[schemars(range(min = 1))]
    pub episodes: usize,
    /// Steps between evaluations on the way. 0: only the last policy is evaluated.
    pub every: u64,
    /// Whose reference returns a normalised score is measured by.
    pub scores: ScoreTable,
}

/// Refuses layers without units, anywhere below the key `path`. Every network has its `hidden` layers; one rule serves all of them.
fn ensure_layers(path: &str, value: &serde_json::Value) -> Result<()> {
    let Some(table) = value.as_object() else { return Ok(()) };
    for (key, value) in table {
        let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        let widths = value.as_array().map_or(std::slice::from_ref(value), Vec::as_slice);
        if key == "hidden" && widths.contains(&0.into()) {
            return Err(Error::Usage(format!(
                "key `{path}`: found {value}, expected layers of at least one unit each"
            )));
        }
        ensure_layers(&path, value)?;
    }
    Ok(())
}

impl Config {
    /// Clones of the target rows alone, with the same settings: an ensemble, where `learner.bc` is one.
    pub fn of_clones(&self) -> Self {
        Self { mixture: MixtureConfig::none(), learner: self.learner.of_clones(), ..self.clone() }
    }

    /// Refuses actions of clones for a learner that has to know where actions lead to.
    ///
    /// # Errors
    /// Names the setting.
    pub fn ensure_actions(&self, rows: LearnedRows) -> Result<()> {
        let algorithm = self.learner.algorithm;
        if !self.mixture.by_clones_on(rows) || algorithm == Algorithm::Bc {
            return Ok(());
        }
        Err(Error::Usage(format!(
            "mixture.actions = \"clones\": found the learner {}, expected bc: actions of clones do not lead to the rows' next states, which \
             other learners learn from; use mixture.actions = \"own\", or the learner bc",
            algorithm.about().name
        )))
    }

    /// The ranges that types cannot express.
    pub fn validate(&self) -> Result<()> {
        let within = |key: &str, value: f64, low: f64, high: f64| match value {
            v if v >= low && v <= high => Ok(()),
            v => Err(Error::Usage(format!("key `{key}`: found {v}, expected a number from {low} to {high}"))),
        };
        within("generator.y_max", self.generator.y_max.into(), 0.0, 1.0)?;
        within("generator.ema", self.generator.ema, 0.0, 0.999_999)?;
        let until_done = &self.generator.until_done;
        within("generator.until_done.held_out", until_done.held_out, 0.001, 0.5)?;
        for plan in [until_done.state(), until_done.transition()] {
            plan.check().map_err(|e| Error::Usage(format!("generator.until_done: {e}")))?;
        }
        self.fitted_q.check().map_err(|e| Error::Usage(format!("fitted_q.{e}")))?;
        within("mixture.lambda", self.mixture.lambda, 0.0, 1.0)?;
        within("learner.top", self.learner.top, 0.001, 1.0)?;
        within("filter.z_threshold", self.filter.z_threshold, 0.1, 1e9)?;
        within("filter.margin", self.filter.margin, 0.01, 1e9)?;
        for (key, value) in [
            ("source.rows", self.source.rows),
            ("generator.batch", self.generator.batch),
            ("dynamics.batch", self.dynamics.batch),
            ("labels.training.batch", self.labels.training.batch),
            ("learner.batch", self.learner.batch),
            ("learner.steps", usize::try_from(self.learner.steps).unwrap_or(usize::MAX)),
            ("evaluation.episodes", self.evaluation.episodes),
        ] {
            within(key, value as f64, 1.0, 1e12)?;
        }
        let single_stage = &self.single_stage;
        within("single_stage.ema", single_stage.ema, 0.0, 0.999_999)?;
        within("single_stage.guidance.dropout", single_stage.guidance.dropout, 0.0, 0.999)?;
        within("single_stage.guidance.weight", single_stage.guidance.weight, 0.0, 100.0)?;
        within("single_stage.guidance.from", single_stage.guidance.from, 0.0, 0.99)?;
        // A row is its own nearest neighbour.
        within("single_stage.scores.neighbour", single_stage.scores.neighbour as f64, 2.0, 1e6)?;
        within(
            "single_stage.scores.reference",
            single_stage.scores.reference as f64,
            single_stage.scores.neighbour as f64,
            1e12,
        )?;
        for (key, value) in [
            ("single_stage.width", single_stage.width),
            ("single_stage.embedding", single_stage.embedding),
            ("single_stage.batch", single_stage.batch),
            ("single_stage.rows", single_stage.rows),
        ] {
            within(key, value as f64, 1.0, 1e12)?;
        }
        single_stage.process.check().map_err(|e| Error::Usage(format!("single_stage.process: {e}")))?;
        single_stage.sampler.check().map_err(|e| Error::Usage(format!("single_stage.sampler: {e}")))?;
        let about = self.learner.algorithm.about();
        if about.scores == RowScores::Density {
            let MixtureConfig { generated, source, .. } = self.mixture;
            let scored = matches!(generated, GeneratedRows::None | GeneratedRows::Dmc)
                && source != SourceRows::Relabelled
                && (generated, source) != (GeneratedRows::None, SourceRows::None);
            if !scored {
                return Err(Error::Usage(format!(
                    "learner.algorithm = {:?}: found mixture.generated = {generated:?} and mixture.source = {source:?}, expected \
                     rows that have scores; use generated = \"dmc\", or \"none\" with source = \"all\", \"nearest\" or \"transport\"",
                    about.name
                )));
            }
        }
        self.ensure_actions(self.mixture.learned_rows())?;
        if self.mixture.generated == GeneratedRows::Tce && self.generator.rows == 0 && self.mixture.lambda == 1.0 {
            return Err(Error::Usage(
                "generator.rows = 0 means (1 - mixture.lambda) times the source rows, which is none at mixture.lambda = 1; give \
                 a number of rows, a smaller lambda, or mixture.generated = \"none\""
                    .into(),
            ));
        }
        ensure_layers("", &serde_json::json!(Named::from(self)))?;
        self.generator.process.check().map_err(|e| Error::Usage(format!("generator.process: {e}")))?;
        self.generator.sampler.check().map_err(|e| Error::Usage(format!("generator.sampler: {e}")))?;
        self.learner.check()
    }

    /// As TOML, for a run's directory.
    pub fn to_toml(&self) -> String {
        toml::to_string_pretty(&Named::from(self)).expect("a configuration is plain data")
    }

    /// As TOML with the names that keys are hashed from: the table `single_stage` is called `joint`, as in earlier versions.
    pub(crate) fn to_keyed_toml(&self) -> String {
        toml::to_string_pretty(self).expect("a configuration is plain data")
    }
}
