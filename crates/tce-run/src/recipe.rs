//! Which preset a finished run is of. A run's folder keeps its settings and not the name of the preset that they came from, so that the
//! preset is found again: it is the one that fewest settings differ from.

use std::collections::BTreeMap;
use std::sync::Arc;

use clap::ValueEnum;
use tce_data::Task;
use tce_learn::LearnedRows;
use tce_report::{Budget, Change, Recipe, RunFolder};

use crate::config::Config;
use crate::layers::{Layered, Preset, with_current_names};
use crate::variant::Variant;

/// A preset for a task and a variant.
struct Known {
    name: String,
    settings: BTreeMap<String, String>,
    config: Config,
}

/// Finds recipes. A preset's settings are worked out once for a task and a variant, and a recipe once for all seeds.
#[derive(Default)]
pub struct Recipes {
    presets: BTreeMap<(String, String), Vec<Known>>,
    found: BTreeMap<(String, String, String, LearnedRows), Arc<Recipe>>,
}

/// Every setting by its full name.
fn flat(table: &toml::Table, prefix: &str, out: &mut BTreeMap<String, String>) {
    for (key, value) in table {
        let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        match value {
            // The keys of a table depend on its kind, so that it is one setting.
            toml::Value::Table(inner) if !inner.contains_key("kind") => flat(inner, &name, out),
            value => {
                out.insert(name, value.to_string());
            }
        }
    }
}

/// Settings that a configuration leaves out where they have these values, because they came later than it: keys of finished runs are
/// hashes of the text.
const LEFT_OUT: [(&str, &str); 8] = [
    ("learner.bc.fade", "0.0"),
    ("learner.bc.dropout", "0.0"),
    ("learner.bc.batch", "0"),
    ("learner.bc.loss", "\"squared\""),
    ("learner.bc.scale_by", "\"all\""),
    ("filter.by", "\"zscore\""),
    ("filter.margin", "2.0"),
    ("mixture.actions", "\"own\""),
];

fn table(text: &str) -> Option<toml::Table> {
    let mut table = text.parse::<toml::Table>().ok()?;
    with_current_names(&mut table);
    Some(table)
}

/// None where another version wrote the text, with other keys.
fn config(text: &str) -> Option<Config> {
    table(text)?.try_into().ok()
}

fn settings(text: &str) -> BTreeMap<String, String> {
    let mut out: BTreeMap<String, String> = LEFT_OUT.map(|(k, v)| (k.to_owned(), v.to_owned())).into();
    table(text).iter().for_each(|table| flat(table, "", &mut out));
    out
}

fn budget(config: &Config, rows: LearnedRows) -> Budget {
    Budget { learner: config.learner.algorithm.about().name.to_owned(), updates: config.learner.steps(rows) }
}

fn presets(task: Task, variant: Variant) -> Vec<Known> {
    let known = |preset: &Preset| {
        let config = Layered::new(*preset, Some(task), Some(variant), None, &[]).and_then(|l| l.config()).ok()?;
        let name = preset.to_possible_value()?.get_name().to_owned();
        Some(Known { name, settings: settings(&config.to_toml()), config })
    };
    [Preset::Default, Preset::Quick, Preset::Paper].iter().filter_map(known).collect()
}

/// What differs of the settings that are `used`; what only one of them has is another version's and no difference. None if they have less
/// than half of the preset's settings in common.
fn changes(
    own: &BTreeMap<String, String>,
    preset: &BTreeMap<String, String>,
    used: impl Fn(&str) -> bool,
) -> Option<Vec<Change>> {
    let common: Vec<_> = preset.iter().filter_map(|(key, value)| Some((key, own.get(key)?, value))).collect();
    if 2 * common.len() < preset.len() {
        return None;
    }
    let differ = common.into_iter().filter(|(key, a, b)| a != b && used(key));
    let change = |(key, value, preset): (&String, &String, &String)| Change {
        key: key.clone(),
        value: value.clone(),
        preset: preset.clone(),
    };
    Some(differ.map(change).collect())
}

/// The preset that fewest of the `used` settings differ from, and these. Of presets that are as near, it is the one that is nearest in all
/// settings.
fn nearest<'a>(
    known: &'a [Known],
    own: &BTreeMap<String, String>,
    used: impl Fn(&str) -> bool,
) -> Option<(&'a Known, Vec<Change>)> {
    let all = |k: &Known| changes(own, &k.settings, |_| true).map_or(0, |all| all.len());
    let of = |k: &'a Known| Some((k, changes(own, &k.settings, &used)?));
    known.iter().filter_map(of).min_by_key(|(k, changed)| (changed.len(), all(k)))
}

impl Recipes {
    /// The recipe of a run of `variant`, as its folder is called.
    pub fn of(&mut self, task: Task, variant: &str, folder: &RunFolder) -> Arc<Recipe> {
        let rows = if folder.extra_rows > 0 { LearnedRows::Mixed } else { LearnedRows::Target };
        let key = (task.to_string(), variant.to_owned(), folder.config_hash.clone(), rows);
        if let Some(recipe) = self.found.get(&key) {
            return recipe.clone();
        }
        let config = config(&folder.config);
        let learner = config.as_ref().map(|c| budget(c, rows));
        let mut recipe = Recipe { learner, ..Recipe::default() };
        if let Ok(variant) = Variant::from_str(variant, false) {
            let place = (key.0.clone(), key.1.clone());
            let known = self.presets.entry(place).or_insert_with(|| presets(task, variant));
            let own = settings(&folder.config);
            let used = |key: &str| config.as_ref().is_none_or(|c| c.uses(key));
            if let Some((preset, changed)) = nearest(known, &own, used) {
                (recipe.preset, recipe.changed) = (Some(preset.name.clone()), changed);
            }
            recipe.paper = known.iter().find(|k| k.name == "paper").map(|k| budget(&k.config, rows));
        }
        let recipe = Arc::new(recipe);
        self.found.insert(key, recipe.clone());
        recipe
    }
}

#[cfg(test)]
mod tests {
    use tce_learn::Mode;

    use super::*;
    use crate::config::Algorithm;

    fn task() -> Task {
        "hopper-morph:medium->expert".parse().unwrap()
    }

    /// The settings of `preset` with `sets`, recognised.
    fn found(preset: Preset, variant: Variant, sets: &[&str]) -> Option<(String, Vec<String>)> {
        let sets: Vec<String> = sets.iter().map(|s| (*s).to_owned()).collect();
        let own = Layered::new(preset, Some(task()), Some(variant), None, &sets).unwrap().config().unwrap();
        let (known, settings) = (presets(task(), variant), settings(&own.to_toml()));
        let (preset, changed) = nearest(&known, &settings, |key| own.uses(key))?;
        Some((preset.name.clone(), changed.iter().map(ToString::to_string).collect()))
    }

    #[test]
    fn presets_are_recognised_by_their_settings() {
        for (preset, name) in [(Preset::Default, "default"), (Preset::Quick, "quick"), (Preset::Paper, "paper")] {
            for variant in [
                Variant::TceOg,
                Variant::Bc,
                Variant::TargetOnly,
                Variant::Prior(Algorithm::Rebrac, Mode::Corrected),
                Variant::Prior(Algorithm::Igdf, Mode::Corrected),
            ] {
                assert_eq!(found(preset, variant, &[]), Some((name.to_owned(), vec![])), "{variant}");
            }
        }
        let changed = found(Preset::Quick, Variant::TceOg, &["learner.steps=60"]);
        assert_eq!(changed, Some(("quick".into(), vec!["learner.steps = 60 (12000)".into()])));
        // What a configuration leaves out at its usual value is a change all the same.
        for (preset, set, told) in [
            (Preset::Default, "learner.bc.batch=0", "learner.bc.batch = 0 (128)"),
            (Preset::Default, "learner.bc.loss=likelihood", "learner.bc.loss = \"likelihood\" (\"squared\")"),
            (Preset::Default, "learner.bc.dropout=0.2", "learner.bc.dropout = 0.2 (\"auto\")"),
            (Preset::Paper, "learner.bc.batch=64", "learner.bc.batch = 64 (0)"),
        ] {
            assert_eq!(found(preset, Variant::Bc, &[set]).unwrap().1, [told]);
        }
        // What says how other rows are learned from is nothing to one who has none.
        for (set, told) in [
            ("mixture.actions=clones", "mixture.actions = \"clones\" (\"own\")"),
            ("learner.bc.scale_by=all", "learner.bc.scale_by = \"all\" (\"target\")"),
        ] {
            assert_eq!(found(Preset::Default, Variant::TceOg, &[set]).unwrap().1, [told]);
            assert_eq!(found(Preset::Default, Variant::BcEnsemble, &[set]).unwrap().1, [""; 0]);
        }
        for (set, told) in [
            ("filter.by=consistency", "filter.by = \"consistency\" (\"zscore\")"),
            ("filter.margin=3.5", "filter.margin = 3.5 (2.0)"),
        ] {
            assert_eq!(found(Preset::Default, Variant::TceOg, &[set]).unwrap().1, [told]);
            assert_eq!(found(Preset::Default, Variant::Bc, &[set]).unwrap().1, [""; 0], "a clone does not filter");
        }
        assert_eq!(changes(&settings("a = 1"), &presets(task(), Variant::Bc)[0].settings, |_| true), None);
    }

    /// The keys of a sampler hang on its kind, so that the whole table is given, in a form that `--set` reads.
    #[test]
    fn a_table_of_another_kind_is_one_change() {
        let sampler = "generator.sampler={ kind = \"predictor-corrector\", steps = 100, snr = 0.3 }";
        let (_, changed) = found(Preset::Default, Variant::TceOg, &[sampler]).unwrap();
        let [told] = &changed[..] else { panic!("one change: {changed:?}") };
        let set = told.split_once(" (").unwrap().0;
        assert!(set.starts_with("generator.sampler = {") && set.contains("snr = 0.3"), "{told}");
        assert_eq!(found(Preset::Default, Variant::TceOg, &[set]).unwrap().1, changed);
    }
}
