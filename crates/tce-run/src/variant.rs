//! The rows of the paper's tables, each as a layer of configuration and nothing else.

use std::fmt;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use tce_data::Shift;

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
    /// DARA on target and source rows.
    Dara,
    /// DARA as its public code has it.
    DaraPublished,
    /// BOSA on target and source rows.
    Bosa,
    /// BOSA as its public code has it.
    BosaPublished,
    /// SRPO on target and source rows.
    Srpo,
    /// SRPO as its public code has it.
    SrpoPublished,
    /// IGDF on target and source rows.
    Igdf,
    /// IGDF as its public code has it.
    IgdfPublished,
    /// OTDF on target and source rows.
    Otdf,
    /// OTDF as its public code has it.
    OtdfPublished,
    /// Meta-DT on target and source rows, zero-shot.
    MetaDt,
    /// TD3+BC on target and source rows.
    Td3Bc,
    /// ReBRAC on target and source rows.
    Rebrac,
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
    /// The mean of five clones of the target rows, observations standardised: what TCE's policy is without generated rows.
    BcEnsemble,
}

impl Variant {
    /// The floors that stand beside every result.
    pub const FLOORS: [Variant; 5] =
        [Variant::BcRaw, Variant::Bc, Variant::BcTop, Variant::TargetOnly, Variant::BcEnsemble];

    /// The name on the command line and in files.
    pub fn name(self) -> String {
        self.to_possible_value().expect("no variant is hidden").get_name().to_owned()
    }

    /// The name in tables, without the mode, which is the configuration's to tell.
    pub(crate) fn title(self) -> &'static str {
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
            Variant::Dara | Variant::DaraPublished => "DARA",
            Variant::Bosa | Variant::BosaPublished => "BOSA",
            Variant::Srpo | Variant::SrpoPublished => "SRPO",
            Variant::Igdf | Variant::IgdfPublished => "IGDF",
            Variant::Otdf | Variant::OtdfPublished => "OTDF",
            Variant::MetaDt => "Meta-DT*",
            Variant::Td3Bc => "TD3+BC",
            Variant::Rebrac => "ReBRAC",
            Variant::Synther => "SynthER",
            Variant::Dmc | Variant::DmcPublished => "DmC",
            Variant::BcRaw => "BC, raw observations",
            Variant::Bc => "BC, standardised",
            Variant::BcTop => "BC, best half",
            Variant::BcEnsemble => "BC, ensemble of 5",
        }
    }

    /// What the variant changes, as TOML; `lambda` is the λ of variants that mix source rows in.
    pub(crate) fn layer(self, lambda: f64, shift: Option<Shift>) -> String {
        // What is not TCE imitates all trajectories, as published.
        let rows = |generated: &str, source: &str, lambda: f64| {
            let all = if generated == "tce" { "" } else { "target.trajectories = \"all\"\n" };
            format!("mixture = {{ generated = {generated:?}, source = {source:?}, lambda = {lambda:?} }}\n{all}")
        };
        // IQL without TCE's regulariser.
        let iql = |generated: &str, source: &str, lambda: f64| {
            let learner = "learner.algorithm = \"iql\"\nlearner.iql.regulariser = \"none\"\n";
            rows(generated, source, lambda) + learner
        };
        let rival = |algorithm: &str, table: &str, rest: &str| {
            // As many generated rows as source rows, as where DmC generates a million beside a million; it does so for smaller sources, too.
            let mixture = if table == "dmc" { rows("dmc", "all", 0.5) } else { rows("none", "all", 1.0) };
            format!("{mixture}learner.algorithm = {algorithm:?}\nlearner.iql.regulariser = \"none\"\n")
                + rest
                + &match self.name().ends_with("-published") {
                    true => format!("learner.{table}.mode = \"published\"\n"),
                    false => String::new(),
                }
        };
        // OTDF's own choice of its β_reg.
        let beta_reg = if shift == Some(Shift::Kinematic) { "learner.otdf.beta_reg = 0.1\n" } else { "" };
        let bc = |ensemble: usize, rest: &str| {
            let learner = format!("learner.algorithm = \"bc\"\nlearner.bc.ensemble = {ensemble}\n");
            rows("none", "none", 0.0) + &learner + rest
        };
        match self {
            Variant::TceOg => rows("tce", "none", 0.0),
            Variant::TceNn => rows("tce", "nearest", lambda),
            Variant::TceOt => rows("tce", "transport", lambda),
            Variant::SimpleAug => rows("tce", "none", 0.0) + "generator.y_max = 0.0\ngenerator.source_states = false\n",
            Variant::TargetOnly => iql("none", "none", 0.0) + "learner.standardise = true\n",
            Variant::TargetSource => iql("none", "all", 1.0),
            Variant::IqlSwt => iql("none", "relabelled", 1.0),
            Variant::TceNoFilter => rows("tce", "none", 0.0) + "filter.enabled = false\n",
            Variant::TceNoReg => iql("tce", "none", 0.0),
            Variant::Dara | Variant::DaraPublished => rival("dara", "dara", ""),
            Variant::Bosa | Variant::BosaPublished => rival("bosa", "bosa", ""),
            Variant::Srpo | Variant::SrpoPublished => rival("srpo", "srpo", ""),
            Variant::Igdf | Variant::IgdfPublished => rival("igdf", "igdf", ""),
            Variant::Otdf | Variant::OtdfPublished => rival("otdf", "otdf", beta_reg),
            Variant::Synther => iql("synther", "none", 0.0),
            Variant::Dmc | Variant::DmcPublished => rival("dmc", "dmc", ""),
            Variant::MetaDt => rival("meta-dt", "meta_dt", ""),
            Variant::Td3Bc => rival("td3-bc", "td3_bc", ""),
            Variant::Rebrac => rival("rebrac", "rebrac", ""),
            Variant::BcRaw => bc(1, "learner.standardise = false\n"),
            Variant::Bc => bc(1, "learner.standardise = true\n"),
            Variant::BcTop => bc(1, "learner.standardise = true\nlearner.top = 0.5\n"),
            Variant::BcEnsemble => bc(5, "learner.standardise = true\n"),
        }
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&self.name())
    }
}
