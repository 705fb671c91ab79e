//! The rows of the paper's tables, each as a layer of configuration and nothing else.

use std::fmt;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

/// A method of the comparison.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Variant {
    /// TCE with generated rows alone (λ = 0).
    TceOg,
    /// TCE with the λ share of source rows nearest to the target (Eq. 9).
    TceNn,
    /// TCE with source rows selected by optimal transport (OTDF's costs).
    TceOt,
    /// Generated from target states alone (Table 3, "Simple Aug.").
    SimpleAug,
    /// IQL on the target rows alone, observations standardised.
    TargetOnly,
    /// IQL on target and source rows as they are (IQL*).
    TargetSource,
    /// IQL on target rows and source rows with inferred actions (Table G.2).
    IqlSwt,
    /// TCE(OG) without the z-score filter.
    TceNoFilter,
    /// TCE(OG) without the behaviour-policy term.
    TceNoReg,
    /// IQL on target rows and rows of a model of whole target transitions (SynthER).
    Synther,
    /// DmC, corrected: source rows and guided generated rows, filtered and weighed by their scores.
    Dmc,
    /// DmC as its code runs.
    DmcPublished,
    /// Behaviour cloning of the target rows, observations as they are.
    BcRaw,
    /// Behaviour cloning of the target rows, observations standardised: the floor.
    Bc,
    /// Behaviour cloning of the best half of the target trajectories, observations standardised.
    BcTop,
}

impl Variant {
    /// The floors that stand beside every result.
    pub const FLOORS: [Variant; 4] = [Variant::BcRaw, Variant::Bc, Variant::BcTop, Variant::TargetOnly];

    /// The name on the command line and in files.
    pub fn name(self) -> String {
        self.to_possible_value().expect("no variant is hidden").get_name().to_owned()
    }

    /// The name in tables.
    pub fn title(self) -> &'static str {
        match self {
            Variant::TceOg => "TCE(OG)",
            Variant::TceNn => "TCE(NN)",
            Variant::TceOt => "TCE(OT)",
            Variant::SimpleAug => "Simple Aug.",
            Variant::TargetOnly => "Target Only (IQL)",
            Variant::TargetSource => "Target+Source (IQL*)",
            Variant::IqlSwt => "IQL*(SwT)",
            Variant::TceNoFilter => "TCE(OG) w/o filtering",
            Variant::TceNoReg => "TCE(OG) w/o policy reg.",
            Variant::Synther => "SynthER",
            Variant::Dmc => "DmC",
            Variant::DmcPublished => "DmC, as published",
            Variant::BcRaw => "BC, raw observations",
            Variant::Bc => "BC, standardised",
            Variant::BcTop => "BC, best half",
        }
    }

    /// What the variant changes, as TOML; `lambda` is the λ of variants that mix source rows in.
    pub(crate) fn layer(self, lambda: f64) -> String {
        let iql = |generated: &str, source: &str, lambda: f64| {
            format!("mixture = {{ generated = {generated:?}, source = {source:?}, lambda = {lambda:?} }}\n")
        };
        let bc = |rest: &str| format!("{}learner.algorithm = \"bc\"\n{rest}", iql("none", "none", 0.0));
        match self {
            Variant::TceOg => iql("tce", "none", 0.0),
            Variant::TceNn => iql("tce", "nearest", lambda),
            Variant::TceOt => iql("tce", "transport", lambda),
            Variant::SimpleAug => {
                format!("{}generator.y_max = 0.0\ngenerator.source_states = false\n", iql("tce", "none", 0.0))
            }
            Variant::TargetOnly => {
                format!("{}learner.standardise = true\nlearner.iql.regulariser = \"none\"\n", iql("none", "none", 0.0))
            }
            Variant::TargetSource => format!("{}learner.iql.regulariser = \"none\"\n", iql("none", "all", 1.0)),
            Variant::IqlSwt => format!("{}learner.iql.regulariser = \"none\"\n", iql("none", "relabelled", 1.0)),
            Variant::TceNoFilter => format!("{}filter.enabled = false\n", iql("tce", "none", 0.0)),
            Variant::TceNoReg => format!("{}learner.iql.regulariser = \"none\"\n", iql("tce", "none", 0.0)),
            Variant::Synther => format!("{}learner.iql.regulariser = \"none\"\n", iql("synther", "none", 0.0)),
            // As many generated rows as source rows, as DmC generates them.
            Variant::Dmc => format!("{}learner.algorithm = \"dmc\"\n", iql("dmc", "all", 0.5)),
            Variant::DmcPublished => format!("{}learner.dmc.mode = \"published\"\n", Variant::Dmc.layer(lambda)),
            Variant::BcRaw => bc("learner.standardise = false\n"),
            Variant::Bc => bc("learner.standardise = true\n"),
            Variant::BcTop => bc("learner.standardise = true\nlearner.top = 0.5\n"),
        }
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::{Layered, Preset};

    #[test]
    fn every_variant_is_a_valid_layer_on_every_preset() {
        for preset in [Preset::Paper, Preset::Default, Preset::Quick] {
            for &variant in Variant::value_variants() {
                let config = Layered::new(preset, None, Some(variant), None, &[]).unwrap().config().unwrap();
                assert!(
                    config.mixture.lambda > 0.0 || matches!(config.mixture.source, crate::config::SourceRows::None)
                );
            }
        }
    }
}
