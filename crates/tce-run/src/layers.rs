//! Layers of TOML that make a configuration. Each value is stored with the layer that set it.
//!
//! Layers, from the lowest to the highest: the `default` preset (which lists every key), the chosen preset, the paper's task-specific
//! values (preset `paper` only), the variant, the user's file, `--set key=value`. A table with a `kind` (a process, a
//! sampler) is one value: another kind replaces it whole.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use tce_base::FileError;
use tce_data::{Agent, Quality, Shift, Task};
use tce_learn::OtherRows;
use toml::{Table, Value};

use crate::config::{Algorithm, Config};
use crate::error::{Error, Result};
use crate::learners::default_tables;
use crate::variant::Variant;
use crate::wrong_keys::{did_you_mean_key, in_words};

const DEFAULT: &str = include_str!("../presets/default.toml");
const PAPER: &str = include_str!("../presets/paper.toml");
const QUICK: &str = include_str!("../presets/quick.toml");

/// A named starting point.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// Appendix B and Tables C.4, C.5 as written.
    Paper,
    /// The settings that measure best, the same for all tasks.
    #[default]
    Default,
    /// `default`, sized to finish in minutes on two cores.
    Quick,
}

impl Preset {
    /// All of them.
    pub const ALL: [Preset; 3] = [Preset::Paper, Preset::Default, Preset::Quick];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Preset::Paper => "paper",
            Preset::Default => "default",
            Preset::Quick => "quick",
        }
    }

    /// The preset's own file, with its comments; `default` lists every key.
    pub fn text(self) -> &'static str {
        match self {
            Preset::Paper => PAPER,
            Preset::Default => DEFAULT,
            Preset::Quick => QUICK,
        }
    }

    fn layer(self) -> (&'static str, &'static str) {
        match self {
            Preset::Paper => ("preset paper", PAPER),
            Preset::Default => ("preset default", ""),
            Preset::Quick => ("preset quick", QUICK),
        }
    }
}

/// A configuration and, for every key, the layer that set it.
#[derive(Clone, Debug)]
pub struct Layered {
    table: Table,
    origin: BTreeMap<String, String>,
}

impl Layered {
    /// The layers a command names.
    ///
    /// # Errors
    /// [`Error::Usage`] for a file that cannot be read or parsed, an unknown key, or a malformed `--set`.
    pub fn new(
        preset: Preset,
        task: Option<Task>,
        variant: Option<Variant>,
        file: Option<&Path>,
        sets: &[String],
    ) -> Result<Self> {
        let mut layered = Self { table: Table::new(), origin: BTreeMap::new() };
        layered.merge_into(parse(DEFAULT, "preset default")?, "preset default", None)?;
        // What a method's own configuration says, where the preset says nothing.
        for (name, table) in default_tables() {
            let missing = layered.table.get("learner").and_then(Value::as_table).is_some_and(|t| !t.contains_key(name));
            if missing {
                let table = Table::from_iter([(name.to_owned(), table)]);
                let table = Table::from_iter([("learner".to_owned(), Value::Table(table))]);
                layered.merge_into(table, "the method's defaults", None)?;
            }
        }
        let known = layered.table.clone();
        let (name, text) = preset.layer();
        layered.merge_into(parse(text, name)?, name, Some(&known))?;
        if let (Preset::Paper, Some(task)) = (preset, task) {
            layered.merge_into(parse(&paper_values(task), "Table C.5")?, "Table C.5", Some(&known))?;
        }
        if let Some(variant) = variant {
            let name = format!("variant {variant}");
            layered.merge_into(
                parse(&variant.layer(layered.lambda_of_paper(task), task.map(|t| t.shift)), &name)?,
                &name,
                Some(&known),
            )?;
        }
        if let Some(path) = file {
            let name = path.display().to_string();
            let text =
                std::fs::read_to_string(path).map_err(|e| Error::Usage(FileError::new(path, "read", e).to_string()))?;
            layered.merge_into(parse(&text, &name)?, &name, Some(&known))?;
        }
        for set in sets {
            let name = format!("--set {set}");
            layered.merge_into(parse_set(set)?, &name, Some(&known))?;
        }
        layered.without_tce_regulariser(&["preset default", name])?;
        Ok(layered)
    }

    /// Eq. 10 is TCE's: prior methods that build on plain IQL have no such term, unless it comes from somewhere else than `presets`.
    fn without_tce_regulariser(&mut self, presets: &[&str]) -> Result<()> {
        let algorithm = self.table["learner"].get("algorithm").and_then(Value::as_str).unwrap_or_default().to_owned();
        let key = "learner.iql.regulariser";
        let from_preset = self.origin.get(key).is_some_and(|o| presets.contains(&o.as_str()));
        let plain = Algorithm::from_str(&algorithm, false).is_ok_and(Algorithm::stands_on_plain_iql);
        if from_preset && plain {
            self.merge_into(parse_set(&format!("{key}=none"))?, &format!("learner {algorithm}"), None)?;
        }
        Ok(())
    }

    /// λ for variants that mix source rows in: Table C.5.
    fn lambda_of_paper(&self, task: Option<Task>) -> f64 {
        match task {
            Some(Task { agent: Agent::HalfCheetah, shift: Shift::Gravity, .. }) => 0.9,
            _ => 0.1,
        }
    }

    fn merge_into(&mut self, layer: Table, name: &str, known: Option<&Table>) -> Result<()> {
        merge(&mut self.table, layer, "", name, known, &mut self.origin)
    }

    /// The typed configuration.
    pub fn config(&self) -> Result<Config> {
        let config: Config = serde_path_to_error::deserialize(Value::Table(self.table.clone())).map_err(|e| {
            let path = e.path().to_string();
            let origin = self.origin.iter().find(|(key, _)| path.starts_with(key.as_str()) || key.starts_with(&path));
            let origin = origin.map_or("the configuration", |(_, o)| o);
            let reason = e.inner().to_string();
            Error::Usage(format!(
                "{origin}: key `{path}`: {}",
                in_words(reason.lines().next().unwrap_or_default().trim())
            ))
        })?;
        config.validate()?;
        Ok(config)
    }

    /// (key, value, layer) of every value, in the order of the keys.
    pub fn values(&self) -> Vec<(String, String, String)> {
        let value_at = |key: &str| {
            let mut value = None;
            let mut table = &self.table;
            for part in key.split('.') {
                value = table.get(part);
                match value {
                    Some(Value::Table(inner)) => table = inner,
                    _ => break,
                }
            }
            value.map(ToString::to_string).unwrap_or_default()
        };
        self.origin.iter().map(|(key, origin)| (key.clone(), value_at(key), origin.clone())).collect()
    }
}

fn parse(text: &str, name: &str) -> Result<Table> {
    let parsed = text.parse::<Table>();
    let mut table = parsed.map_err(|e| Error::Usage(format!("{name}: not TOML: {}", e.to_string().trim_end())))?;
    with_current_names(&mut table);
    Ok(table)
}

/// Renames tables that earlier versions called otherwise: `joint` is `single_stage`.
pub(crate) fn with_current_names(table: &mut Table) {
    if !table.contains_key("single_stage")
        && let Some(value) = table.remove("joint")
    {
        table.insert("single_stage".to_owned(), value);
    }
}

/// `learner.steps=1000` as a table; a value that is not TOML is a string.
fn parse_set(set: &str) -> Result<Table> {
    let (key, value) = set.split_once('=').ok_or_else(|| Error::Usage(format!("--set {set}: expected key=value")))?;
    let value = format!("v = {value}").parse::<Table>().ok().and_then(|mut t| t.remove("v"));
    let mut value = value.unwrap_or_else(|| Value::String(set[key.len() + 1..].to_owned()));
    for part in key.trim().split('.').rev() {
        value = Value::Table(Table::from_iter([(part.to_owned(), value)]));
    }
    match value {
        Value::Table(mut table) => {
            with_current_names(&mut table);
            Ok(table)
        }
        _ => Err(Error::Usage(format!("--set {set}: expected key=value"))),
    }
}

fn merge(
    into: &mut Table,
    layer: Table,
    prefix: &str,
    name: &str,
    known: Option<&Table>,
    origin: &mut BTreeMap<String, String>,
) -> Result<()> {
    for (key, value) in layer {
        let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        if known.is_some_and(|k| !k.contains_key(&key)) {
            let siblings: Vec<_> = known.into_iter().flat_map(|k| k.keys().map(String::as_str)).collect();
            let hint = did_you_mean_key(&key, prefix, &siblings, &parse(DEFAULT, "preset default")?);
            return Err(Error::Usage(format!(
                "{name}: unknown key `{path}`; expected one of {}{hint}",
                siblings.join(", ")
            )));
        }
        match value {
            Value::Table(inner) => {
                let known = known.and_then(|k| k.get(&key)).and_then(Value::as_table);
                let slot = into.entry(&key).or_insert_with(|| Value::Table(Table::new()));
                let Value::Table(slot) = slot else {
                    return Err(Error::Usage(format!("{name}: key `{path}`: expected a single value, found a table")));
                };
                let kinds = known.is_some_and(|k| k.contains_key("kind"));
                if inner.contains_key("kind") && slot.get("kind") != inner.get("kind") {
                    slot.clear();
                    origin.retain(|k, _| !k.starts_with(&format!("{path}.")));
                }
                // What a kind may hold is known to its type, not to the default preset.
                merge(slot, inner, &path, name, known.filter(|_| !kinds), origin)?;
            }
            value => {
                if matches!(into.get(&key), Some(Value::Table(_))) {
                    return Err(Error::Usage(format!("{name}: key `{path}`: found {value}, expected a table")));
                }
                // 3 for 3.0 is what people write.
                let value = match (into.get(&key), &value) {
                    (Some(Value::Float(_)), Value::Integer(i)) => Value::Float(*i as f64),
                    _ => value,
                };
                origin.insert(path, name.to_owned());
                into.insert(key, value);
            }
        }
    }
    Ok(())
}

/// Table C.5 (and its text) for `task`.
fn paper_values(task: Task) -> String {
    use Agent::*;
    use Quality::*;
    let y_max = if (task.agent, task.shift) == (HalfCheetah, Shift::Morph) { 0.1 } else { 0.2 };
    let walker_morph = (task.agent, task.shift) == (Walker2d, Shift::Morph);
    let z = if walker_morph && task.target == MediumExpert { 2.5 } else { 3.0 };
    let beta = match (task.agent, task.shift) {
        (Walker2d, Shift::Morph) if task.target == MediumExpert && task.source != Medium => 2.0,
        (Walker2d, Shift::Kinematic) => 0.5,
        _ => 0.001,
    };
    format!("generator.y_max = {y_max:?}\nfilter.z_threshold = {z:?}\nlearner.iql.beta_reg = {beta:?}\n")
}

/// What commands with a configuration accept.
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "Settings")]
pub struct ConfigArgs {
    /// Where the configuration starts from.
    #[arg(long, value_enum, default_value_t)]
    pub preset: Preset,
    /// A TOML file with the keys to change. `tce config show` lists them; `tce config show KEY` explains one.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// One key to change, such as learner.steps=1000. May be given several times.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
}

impl ConfigArgs {
    /// The same with another learner, if one is given.
    pub fn with_learner(mut self, learner: Option<Algorithm>) -> Self {
        self.sets.extend(learner.map(|l| format!("learner.algorithm={:?}", l.about().name)));
        self
    }

    /// The same for a training on tables of the user's own, by `learner` if one is given, with the share `top` of the best trajectories.
    pub fn with_own_tables(self, learner: Option<Algorithm>, top: Option<f64>) -> Self {
        let mut own = self.with_learner(learner);
        own.sets.extend(top.map(|top| format!("learner.top={top:?}")));
        if learner.is_some_and(|learner| learner.about().needs == OtherRows::Scored) {
            // The rows are in the tables here; without scores of their own they are scored as source rows are.
            own.sets.splice(0..0, ["mixture.generated=none".to_owned(), "mixture.source=all".to_owned()]);
        }
        own
    }

    /// Whether no argument was given.
    pub fn is_empty(&self) -> bool {
        self.preset == Preset::default() && self.config.is_none() && self.sets.is_empty()
    }

    /// The layers for `task` and `variant`.
    pub fn layered(&self, task: Option<Task>, variant: Option<Variant>) -> Result<Layered> {
        Layered::new(self.preset, task, variant, self.config.as_deref(), &self.sets)
    }
}

#[cfg(test)]
mod tests {
    use tce_learn::LearnedRows;

    use super::*;
    use tce_diffusion::Process;
    use tce_learn::RegulariserKind;

    fn layered(preset: Preset, task: Option<&str>, sets: &[&str]) -> Result<Layered> {
        let sets: Vec<_> = sets.iter().map(|s| s.to_string()).collect();
        Layered::new(preset, task.map(|t| t.parse().unwrap()), None, None, &sets)
    }

    /// The library's recommended settings are the preset's, written twice.
    #[test]
    fn the_library_recommends_the_default_preset() {
        use tce_augment::config::{FilterConfig, GeneratorConfig, LabelsConfig, SingleStageConfig};
        let config = layered(Preset::Default, None, &[]).unwrap().config().unwrap();
        assert_eq!(config.generator, GeneratorConfig::recommended());
        assert_eq!(config.filter, FilterConfig::recommended());
        assert_eq!(config.labels, LabelsConfig::recommended());
        assert_eq!(config.single_stage, SingleStageConfig::recommended());
    }

    /// The library's settings of the paper are the preset's.
    #[test]
    fn the_library_has_the_paper_preset() {
        use tce_learn::cvae::CvaeConfig;
        use tce_learn::pair_model::PairInput;
        use tce_learn::{BcConfig, IqlConfig, LabelConfig};
        let paper = layered(Preset::Paper, None, &[]).unwrap().config().unwrap();
        let term = IqlConfig { regulariser: RegulariserKind::ForwardKl, ..IqlConfig::paper() };
        assert_eq!(paper.learner.iql, term);
        assert_eq!(paper.learner.behaviour.cvae, CvaeConfig::paper());
        let mut labels = LabelConfig::paper();
        (labels.model.input, labels.model.cosine) = (PairInput::Next, false);
        assert_eq!(paper.labels.training, labels);
        assert_eq!(paper.learner.bc, BcConfig::default(), "one clone with the networks of IQL's policy");
    }

    /// What the program's own defaults say of a learner is what the default preset says; clones are the exception, see above.
    #[test]
    fn defaults_of_learners_are_those_of_the_default_preset() {
        let learner = layered(Preset::Default, None, &[]).unwrap().config().unwrap().learner;
        let preset = serde_json::to_value(&learner).unwrap();
        for (name, table) in default_tables().into_iter().filter(|(name, _)| *name != "bc") {
            let own = serde_json::to_value(table).unwrap();
            let (own, preset) = (own.as_object().unwrap(), preset[name].as_object().unwrap());
            for (key, value) in own {
                let same = match (value.as_f64(), preset[key].as_f64()) {
                    (Some(a), Some(b)) => (a - b).abs() <= 1e-6 * a.abs(),
                    _ => *value == preset[key],
                };
                assert!(same, "{name}.{key}: {value} and {}", preset[key]);
            }
        }
    }

    #[test]
    fn other_rows_fade_or_are_cloned_for_fewer_steps() {
        let of = |preset, set: &[&str]| layered(preset, None, set).unwrap().config().unwrap().learner;
        let mut learner = of(Preset::Default, &[]);
        assert_eq!(learner.steps(LearnedRows::Mixed), 50_000);
        assert_eq!(learner.fade(), Some(30_000));
        learner.algorithm = Algorithm::Iql;
        assert_eq!(learner.fade(), None, "clones alone");
        let mut short = of(Preset::Default, &["learner.bc.mixed_steps=15_000"]);
        assert_eq!((short.steps(LearnedRows::Target), short.steps(LearnedRows::Mixed)), (50_000, 15_000));
        let done = crate::config::LearnerConfig { steps: short.steps(LearnedRows::Mixed), ..short.clone() };
        assert_eq!(done.fade(), Some(9_000), "of the steps that are done");
        short.steps = 300;
        assert_eq!(short.steps(LearnedRows::Mixed), 300, "it is no more than was asked for");
        let paper = of(Preset::Paper, &["learner.algorithm=bc"]);
        assert_eq!((paper.steps(LearnedRows::Mixed), paper.fade()), (paper.steps, None));
    }

    #[test]
    fn every_preset_is_a_whole_configuration() {
        for preset in [Preset::Paper, Preset::Default, Preset::Quick] {
            let config = layered(preset, None, &[]).unwrap().config().unwrap();
            assert_eq!(
                toml::from_str::<Config>(&config.to_toml()).unwrap(),
                config,
                "{preset:?} survives a round trip"
            );
        }
    }

    #[test]
    fn table_c5_is_applied_to_the_paper_preset_only() {
        let task = Some("walker2d-morph:medium-replay->medium-expert");
        let paper = layered(Preset::Paper, task, &[]).unwrap().config().unwrap();
        assert_eq!((paper.filter.z_threshold, paper.learner.iql.beta_reg, paper.generator.y_max), (2.5, 2.0, 0.2));
        let default = layered(Preset::Default, task, &[]).unwrap().config().unwrap();
        assert_eq!(default.filter.z_threshold, 3.0);
        let cheetah = layered(Preset::Paper, Some("halfcheetah-morph:medium->expert"), &[]).unwrap().config().unwrap();
        assert_eq!(cheetah.generator.y_max, 0.1);
    }

    #[test]
    fn the_last_layer_wins_and_is_remembered() {
        let layers =
            layered(Preset::Quick, None, &["learner.steps=7", "learner.algorithm=bc", "filter.z_threshold=2"]).unwrap();
        let config = layers.config().unwrap();
        assert_eq!(
            (config.learner.steps, config.learner.algorithm, config.filter.z_threshold),
            (7, Algorithm::Bc, 2.0)
        );
        let values = layers.values();
        let origin = |key: &str| values.iter().find(|v| v.0 == key).unwrap().2.clone();
        assert_eq!(origin("learner.steps"), "--set learner.steps=7");
        assert_eq!(origin("labels.training.steps"), "preset quick");
        assert_eq!(origin("learner.iql.expectile"), "preset default");
    }

    /// The behaviour term is TCE's. Prior methods have one of their own or none, unless somebody asks for it.
    #[test]
    fn prior_methods_have_no_term_of_tce() {
        let regulariser =
            |sets: &[&str]| layered(Preset::Quick, None, sets).unwrap().config().unwrap().learner.iql.regulariser;
        assert_eq!(regulariser(&[]), RegulariserKind::ForwardKl);
        for method in ["dara", "srpo", "igdf"] {
            let algorithm = format!("learner.algorithm={method}");
            assert_eq!(regulariser(&[&algorithm]), RegulariserKind::None);
            assert_eq!(regulariser(&[&algorithm, "learner.iql.regulariser=forward_kl"]), RegulariserKind::ForwardKl);
        }
    }

    /// `[single_stage]` was `[joint]`: files, `--set` and keys of runs from then stay good.
    #[test]
    fn the_old_name_of_a_table_is_read() {
        let config = |set: &str| layered(Preset::Default, None, &[set]).unwrap().config().unwrap();
        let (old, new) = (config("joint.steps=7"), config("single_stage.steps=7"));
        assert_eq!((old.single_stage.steps, &old), (7, &new));
        assert!(new.to_toml().contains("\n[single_stage.guidance]") && !new.to_toml().contains("joint"));
        let keyed = new.to_keyed_toml();
        assert_eq!(new.to_toml(), keyed.replace("\n[joint", "\n[single_stage"), "nothing else differs");
        assert!(keyed.contains("\n[joint]\n") && !keyed.contains("single_stage"));
        assert_eq!(toml::from_str::<Config>(&keyed).unwrap(), new);
        assert!(serde_json::to_value(&new).unwrap().get("joint").is_some(), "what keys are hashed from");
    }

    #[test]
    fn mistakes_are_named() {
        let message = |sets: &[&str]| match layered(Preset::Default, None, sets).and_then(|l| l.config()) {
            Err(Error::Usage(text)) => text,
            other => panic!("expected a usage error, got {other:?}"),
        };
        assert!(message(&["learner.step=7"]).contains("unknown key `learner.step`"));
        assert!(message(&["learner.steps=many"]).contains("learner.steps"));
        assert!(message(&["generator.y_max=1.5"]).contains("from 0 to 1"));
        assert!(message(&["generator.process.kind=\"foo\""]).contains("generator.process"));
        assert!(message(&["oops"]).contains("key=value"));
    }

    #[test]
    fn another_kind_replaces_the_whole_table() {
        let layers = layered(Preset::Paper, None, &[]).unwrap();
        assert!(layers.values().iter().all(|v| v.0 != "generator.process.sigma_min"));
        assert!(matches!(layers.config().unwrap().generator.process, Process::Ve(_)));
    }
}
