//! The configuration of a run, typed. What a field's comment says is what `tce config show KEY` tells a user ([`crate::keys`]): a sentence on
//! what the key does, and behind `Source:` where its value is from, if it is the same for every preset. Why a preset has a value is told
//! beside the value, in `presets/`; where a value comes from, by [`crate::layers`].

use serde::{Deserialize, Serialize};
use tce_augment::config::{FilterConfig, GeneratorConfig, LabelsConfig, SingleStageConfig};
use tce_data::ScoreTable;
use tce_learn::{
    BcConfig, BosaConfig, DaraConfig, DmcConfig, DynamicsConfig, IgdfConfig, IqlConfig, LearnError, MetaDtConfig, Mode,
    OtdfConfig, RebracConfig, RegulariserConfig, RegulariserKind, SrpoConfig, Td3BcConfig,
};

use crate::error::{Error, Result};

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
    /// One network over whole rows, for `mixture.generated` = synther and dmc.
    pub joint: SingleStageConfig,
    /// The data the policy is learned from.
    pub mixture: MixtureConfig,
    /// The learner of the policy.
    pub learner: LearnerConfig,
    /// How policies are judged.
    pub evaluation: EvaluationConfig,
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
        (_, Algorithm::Dmc) => used = serde_json::json!({ "scores": config.scores }),
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
    /// Whole transitions like the target's (`joint`).
    Synther,
    /// Whole transitions like the most target-like ones of source and target (`joint`).
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
}

/// Which algorithm learns the policy; what each of them is, `tce learn --list` tells ([`crate::methods`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Algorithm {
    /// Behaviour cloning.
    Bc,
    /// Implicit Q-learning.
    Iql,
    /// TD3+BC.
    Td3Bc,
    /// ReBRAC.
    Rebrac,
    /// DARA, on IQL.
    Dara,
    /// SRPO, on IQL.
    Srpo,
    /// IGDF, on IQL.
    Igdf,
    /// OTDF, on IQL.
    Otdf,
    /// BOSA.
    Bosa,
    /// DmC's: implicit Q-learning on filtered rows, weighed by their scores.
    Dmc,
    /// A decision transformer on contexts of a world model.
    MetaDt,
}

/// The learner; the keys of algorithms that are not trained are not looked at.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LearnerConfig {
    /// Which algorithm learns the policy; `tce learn --list` tells what each is. Source: the paper has iql.
    pub algorithm: Algorithm,
    /// Training steps of the policy.
    pub steps: u64,
    /// Rows per step. With other rows half of them are the target's; else all are. Source: Table C.4.
    #[schemars(range(min = 1))]
    pub batch: usize,
    /// Whether observations are standardised.
    pub standardise: bool,
    /// Share of the best trajectories that `bc` clones. 1: all of them. Source: "BC-10 %" of Chen et al.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub top: f64,
    /// Implicit Q-learning, and what the rivals that stand on it take from it.
    pub iql: IqlConfig,
    /// Behaviour cloning.
    pub bc: BcConfig,
    /// TD3+BC. Source: Fujimoto and Gu.
    pub td3_bc: Td3BcConfig,
    /// ReBRAC. Source: Tarasov et al.
    pub rebrac: RebracConfig,
    /// DARA, besides `learner.iql`.
    pub dara: DaraConfig,
    /// SRPO, besides `learner.iql`.
    pub srpo: SrpoConfig,
    /// IGDF, besides `learner.iql`.
    pub igdf: IgdfConfig,
    /// OTDF, besides `learner.iql`; its regulariser is `learner.behaviour`.
    pub otdf: OtdfConfig,
    /// BOSA.
    pub bosa: BosaConfig,
    /// DmC, besides `learner.iql`.
    pub dmc: DmcConfig,
    /// Meta-DT; `learner.steps` are the transformer's.
    pub meta_dt: MetaDtConfig,
    /// The model of the target's behaviour, for regularisers.
    pub behaviour: RegulariserConfig,
}

impl LearnerConfig {
    /// The IQL that the algorithm stands on, where it does.
    pub fn backbone(&self) -> Option<IqlConfig> {
        match self.algorithm {
            Algorithm::Iql | Algorithm::Dara | Algorithm::Srpo | Algorithm::Igdf => Some(self.iql.clone()),
            Algorithm::Otdf => Some(self.otdf.backbone(&self.iql)),
            Algorithm::Dmc => Some(self.dmc.backbone(&self.iql)),
            Algorithm::Bc | Algorithm::Td3Bc | Algorithm::Rebrac | Algorithm::Bosa | Algorithm::MetaDt => None,
        }
    }

    /// The behaviour model of the regulariser; as DmC publishes it, one that is not trained.
    pub fn behaviour(&self) -> RegulariserConfig {
        match self.algorithm {
            Algorithm::Dmc => self.dmc.behaviour(&self.behaviour),
            _ => self.behaviour.clone(),
        }
    }

    /// Training steps, by whether there are rows besides the target's.
    pub fn steps(&self, mixed: bool) -> u64 {
        match self.algorithm {
            Algorithm::Bc => self.bc.steps(self.steps, mixed),
            _ => self.steps,
        }
    }

    /// The algorithm's own table, and its name.
    fn own(&self) -> (&'static str, serde_json::Value) {
        use serde_json::json;
        match self.algorithm {
            Algorithm::Bc => ("bc", json!(self.bc)),
            Algorithm::Iql => ("iql", json!(self.iql)),
            Algorithm::Td3Bc => ("td3_bc", json!(self.td3_bc)),
            Algorithm::Rebrac => ("rebrac", json!(self.rebrac)),
            Algorithm::Dara => ("dara", json!(self.dara)),
            Algorithm::Srpo => ("srpo", json!(self.srpo)),
            Algorithm::Igdf => ("igdf", json!(self.igdf)),
            Algorithm::Otdf => ("otdf", json!(self.otdf)),
            Algorithm::Bosa => ("bosa", json!(self.bosa)),
            Algorithm::Dmc => ("dmc", json!(self.dmc)),
            Algorithm::MetaDt => ("meta_dt", json!(self.meta_dt)),
        }
    }

    /// Whether the method is trained as its public code has it, where that differs from its paper; None where there is one form.
    pub fn mode(&self) -> Option<Mode> {
        serde_json::from_value(self.own().1.get("mode")?.clone()).ok()
    }

    /// The keys that the algorithm looks at: what a run's identity depends on.
    pub fn used(&self) -> serde_json::Value {
        let Self { algorithm, steps, batch, standardise, .. } = self;
        let mut used = serde_json::json!({
            "algorithm": algorithm, "steps": steps, "batch": batch, "standardise": standardise,
        });
        let (name, own) = self.own();
        used[name] = own;
        if *algorithm == Algorithm::Bc {
            used["top"] = serde_json::json!(self.top);
        }
        if let Some(iql) = self.backbone() {
            if iql.regulariser != RegulariserKind::None {
                used["behaviour"] = serde_json::json!(self.behaviour());
            }
            used["iql"] = serde_json::json!(iql);
        }
        used
    }

    fn check(&self) -> Result<()> {
        let Self { iql, td3_bc, rebrac, dara, srpo, igdf, otdf, bosa, dmc, meta_dt, .. } = self;
        let iql = self.backbone().unwrap_or_else(|| iql.clone());
        let checks = [
            ("iql", iql.check()),
            ("bc", self.bc.check()),
            ("td3_bc", td3_bc.check()),
            ("rebrac", rebrac.check()),
            ("dara", dara.check()),
            ("srpo", srpo.check()),
            ("igdf", igdf.check()),
            ("otdf", otdf.check()),
            ("bosa", bosa.check()),
            ("dmc", dmc.check()),
            ("meta_dt", meta_dt.check()),
        ];
        let named = |(name, check): (&str, std::result::Result<(), LearnError>)| {
            check.map_err(|e| Error::Usage(format!("learner.{name}: {e}")))
        };
        checks.into_iter().try_for_each(named)
    }
}

/// How policies are judged.
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

impl Config {
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
        let joint = &self.joint;
        within("joint.ema", joint.ema, 0.0, 0.999_999)?;
        within("joint.guidance.dropout", joint.guidance.dropout, 0.0, 0.999)?;
        within("joint.guidance.weight", joint.guidance.weight, 0.0, 100.0)?;
        within("joint.guidance.from", joint.guidance.from, 0.0, 0.99)?;
        // A row is its own nearest neighbour.
        within("joint.scores.neighbour", joint.scores.neighbour as f64, 2.0, 1e6)?;
        within("joint.scores.reference", joint.scores.reference as f64, joint.scores.neighbour as f64, 1e12)?;
        for (key, value) in [
            ("joint.width", joint.width),
            ("joint.embedding", joint.embedding),
            ("joint.batch", joint.batch),
            ("joint.rows", joint.rows),
        ] {
            within(key, value as f64, 1.0, 1e12)?;
        }
        joint.process.check().map_err(|e| Error::Usage(format!("joint.process: {e}")))?;
        joint.sampler.check().map_err(|e| Error::Usage(format!("joint.sampler: {e}")))?;
        if self.learner.algorithm == Algorithm::Dmc {
            let MixtureConfig { generated, source, .. } = self.mixture;
            let scored = matches!(generated, GeneratedRows::None | GeneratedRows::Dmc)
                && source != SourceRows::Relabelled
                && (generated, source) != (GeneratedRows::None, SourceRows::None);
            if !scored {
                return Err(Error::Usage(format!(
                    "learner.algorithm = \"dmc\": found mixture.generated = {generated:?} and mixture.source = {source:?}, expected \
                     rows that have scores; use generated = \"dmc\", or \"none\" with source = \"all\", \"nearest\" or \"transport\""
                )));
            }
        }
        self.learner.dmc.check().map_err(|e| Error::Usage(format!("learner.dmc: {e}")))?;
        if self.mixture.generated == GeneratedRows::Tce && self.generator.rows == 0 && self.mixture.lambda == 1.0 {
            return Err(Error::Usage(
                "generator.rows = 0 means (1 - mixture.lambda) times the source rows, which is none at mixture.lambda = 1; give \
                 a number of rows, a smaller lambda, or mixture.generated = \"none\""
                    .into(),
            ));
        }
        self.generator.process.check().map_err(|e| Error::Usage(format!("generator.process: {e}")))?;
        self.generator.sampler.check().map_err(|e| Error::Usage(format!("generator.sampler: {e}")))?;
        self.learner.check()
    }

    /// As TOML, for a run's directory.
    pub fn to_toml(&self) -> String {
        toml::to_string_pretty(self).expect("a configuration is plain data")
    }
}
