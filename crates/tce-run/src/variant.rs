//! The rows of the paper's tables, each as a layer of configuration and nothing else.

use std::fmt;
use std::sync::LazyLock;

use clap::ValueEnum;
use clap::builder::PossibleValue;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use tce_data::Shift;
use tce_learn::{Mode, OtherRows};

use crate::config::Algorithm;

/// A method of the comparison.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
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
    /// TCE(OG), cloned with the actions of clones of the target rows.
    TceClones,
    /// Clones of target and source rows, which have the actions of clones of the target rows.
    SourceClones,
    /// A method of the registry on target and source rows, in one of its forms.
    Prior(Algorithm, Mode),
    /// IQL on target rows and rows of a model of whole target transitions (SynthER).
    Synther,
    /// Behaviour cloning of the target rows, observations as they are.
    BcRaw,
    /// Behaviour cloning of the target rows, observations standardised.
    Bc,
    /// Behaviour cloning of the best half of the target trajectories, observations standardised.
    BcTop,
    /// The mean of five clones of the target rows, observations standardised: what TCE's policy is without generated rows.
    BcEnsemble,
}

/// A variant and its name on the command line and in files.
struct Named {
    variant: Variant,
    name: String,
}

/// All variants, in the order of the help.
static ALL: LazyLock<Vec<Variant>> = LazyLock::new(|| NAMED.iter().map(|n| n.variant).collect());

/// All variants with their names: TCE and its ablations, prior methods, baselines.
static NAMED: LazyLock<Vec<Named>> = LazyLock::new(|| {
    use Variant::*;
    let tce = [
        TceOg,
        TceNn,
        TceOt,
        SimpleAug,
        TargetOnly,
        TargetSource,
        IqlSwt,
        TceNoFilter,
        TceNoReg,
        TceClones,
        SourceClones,
    ];
    // BC and IQL are the learners of other variants.
    let prior = Algorithm::ALL.iter().filter(|a| !matches!(a, Algorithm::Bc | Algorithm::Iql));
    let forms = prior.flat_map(|&algorithm| {
        let published = algorithm.about().published.map(|_| Prior(algorithm, Mode::Published));
        std::iter::once(Prior(algorithm, Mode::Corrected)).chain(published)
    });
    let all = tce.into_iter().chain(forms).chain([Synther, BcRaw, Bc, BcTop, BcEnsemble]);
    all.map(|variant| {
        let (name, ..) = variant.about();
        let form = if variant.mode() == Mode::Published { "-published" } else { "" };
        Named { variant, name: format!("{name}{form}") }
    })
    .collect()
});

impl Variant {
    /// The baselines that stand beside every result.
    pub const BASELINES: [Variant; 5] =
        [Variant::BcRaw, Variant::Bc, Variant::BcTop, Variant::TargetOnly, Variant::BcEnsemble];

    /// The name on the command line and in files.
    pub fn name(self) -> &'static str {
        NAMED.iter().find(|n| n.variant == self).map_or(self.base(), |n| &n.name)
    }

    /// The name without the form that the method has: `dara` of both `dara` and `dara-published`.
    pub fn base(self) -> &'static str {
        self.about().0
    }

    /// The form of a method whose public code differs from its paper.
    pub fn mode(self) -> Mode {
        match self {
            Variant::Prior(_, mode) => mode,
            _ => Mode::Corrected,
        }
    }

    /// The name in tables, without the mode, which is the configuration's to tell.
    pub(crate) fn title(self) -> &'static str {
        self.about().1
    }

    /// Name without the form, title, and what it is.
    fn about(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Variant::TceOg => ("tce-og", "TCE(OG)", "TCE with generated rows alone (λ = 0)"),
            Variant::TceNn => {
                ("tce-nn", "TCE(NN)", "TCE with the λ share of source rows nearest to the target (Eq. 9)")
            }
            Variant::TceOt => {
                ("tce-ot", "TCE(OT)", "TCE with source rows selected by optimal transport (OTDF's costs)")
            }
            Variant::SimpleAug => {
                ("simple-aug", "Simple Aug.", "Generated from target states alone (Table 3, \"Simple Aug.\")")
            }
            Variant::TargetOnly => {
                ("target-only", "Target Only (IQL)", "IQL on the target rows alone, observations standardised")
            }
            Variant::TargetSource => {
                ("target-source", "Target+Source (IQL*)", "IQL on target and source rows as they are (IQL*)")
            }
            Variant::IqlSwt => {
                ("iql-swt", "IQL*(SwT)", "IQL on target rows and source rows with inferred actions (Table G.2)")
            }
            Variant::TceNoFilter => ("tce-no-filter", "TCE(OG) w/o filtering", "TCE(OG) without the z-score filter"),
            Variant::TceNoReg => ("tce-no-reg", "TCE(OG) w/o policy reg.", "TCE(OG) without the behaviour-policy term"),
            Variant::TceClones => (
                "tce-clones",
                "TCE(OG), clones' actions",
                "Clones of target and generated rows, which have the actions of clones of the target rows",
            ),
            Variant::SourceClones => (
                "source-clones",
                "Source states, clones' actions",
                "Clones of target and source rows, which have the actions of clones of the target rows",
            ),
            Variant::Prior(algorithm, _) => {
                let about = algorithm.about();
                (about.name, about.title, about.description)
            }
            Variant::Synther => {
                ("synther", "SynthER", "IQL on target rows and rows of a model of whole target transitions (SynthER)")
            }
            Variant::BcRaw => {
                ("bc-raw", "BC, raw observations", "Behaviour cloning of the target rows, observations as they are")
            }
            Variant::Bc => {
                ("bc", "BC, standardised", "Behaviour cloning of the target rows, observations standardised")
            }
            Variant::BcTop => (
                "bc-top",
                "BC, best half",
                "Behaviour cloning of the best half of the target trajectories, observations standardised",
            ),
            Variant::BcEnsemble => (
                "bc-ensemble",
                "BC, ensemble of 5",
                "The mean of five clones of the target rows, observations standardised",
            ),
        }
    }

    /// What the variant changes, as TOML; `lambda` is the λ of variants that mix source rows in.
    pub(crate) fn layer(self, lambda: f64, shift: Option<Shift>) -> String {
        // What is not the program's own imitates all trajectories, as published. The ensemble of clones is what TCE has to beat, and states
        // of the source are the alternative to generated ones: they imitate what TCE imitates.
        let own = |generated: &str| generated == "tce" || matches!(self, Variant::BcEnsemble | Variant::SourceClones);
        let rows = |generated: &str, source: &str, lambda: f64| {
            let all = if own(generated) { "" } else { "target.trajectories = \"all\"\n" };
            // Dotted keys, so that a variant can add to the table.
            format!(
                "mixture.generated = {generated:?}\nmixture.source = {source:?}\nmixture.lambda = {lambda:?}\n{all}"
            )
        };
        // IQL without TCE's regulariser.
        let iql = |generated: &str, source: &str, lambda: f64| {
            let learner = "learner.algorithm = \"iql\"\nlearner.iql.regulariser = \"none\"\n";
            rows(generated, source, lambda) + learner
        };
        let prior = |algorithm: Algorithm, mode: Mode| {
            let about = algorithm.about();
            // As many generated rows as source rows, as where DmC generates a million beside a million; it does so for smaller sources, too.
            let mixture = match about.needs {
                OtherRows::Scored => rows("dmc", "all", 0.5),
                OtherRows::Any | OtherRows::Source => rows("none", "all", 1.0),
            };
            let learner = format!("learner.algorithm = {:?}\nlearner.iql.regulariser = \"none\"\n", about.name);
            // OTDF's own choice of its β_reg.
            let beta_reg = match (algorithm, shift) {
                (Algorithm::Otdf, Some(Shift::Kinematic)) => "learner.otdf.beta_reg = 0.1\n",
                _ => "",
            };
            let mode = match mode {
                Mode::Published => format!("learner.{}.mode = \"published\"\n", about.table),
                Mode::Corrected => String::new(),
            };
            mixture + &learner + beta_reg + &mode
        };
        let bc = |ensemble: usize, rest: &str| {
            let learner = format!("learner.algorithm = \"bc\"\nlearner.bc.ensemble = {ensemble}\n");
            rows("none", "none", 0.0) + &learner + rest
        };
        let clones_actions = "mixture.actions = \"clones\"\nlearner.algorithm = \"bc\"\n";
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
            Variant::TceClones => rows("tce", "none", 0.0) + clones_actions,
            Variant::SourceClones => rows("none", "all", 1.0) + clones_actions,
            Variant::Prior(algorithm, mode) => prior(algorithm, mode),
            Variant::Synther => iql("synther", "none", 0.0),
            Variant::BcRaw => bc(1, "learner.standardise = false\n"),
            Variant::Bc => bc(1, "learner.standardise = true\n"),
            Variant::BcTop => bc(1, "learner.standardise = true\nlearner.top = 0.5\n"),
            Variant::BcEnsemble => bc(5, "learner.standardise = true\n"),
        }
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl ValueEnum for Variant {
    fn value_variants<'a>() -> &'a [Self] {
        &ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        let what = self.about().2;
        Some(PossibleValue::new(self.name()).help(match self.mode() {
            Mode::Published => "The same as its public code has it",
            Mode::Corrected => what,
        }))
    }
}

impl Serialize for Variant {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Variant {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        static NAMES: LazyLock<Vec<&'static str>> = LazyLock::new(|| NAMED.iter().map(|n| n.name.as_str()).collect());
        let name = String::deserialize(from)?;
        let found = NAMED.iter().find(|n| n.name == name);
        found.map(|n| n.variant).ok_or_else(|| D::Error::unknown_variant(&name, &NAMES))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_programs_own_methods_choose_trajectories() {
        use crate::config::Trajectories::{All, Auto};
        for (variant, expected) in [
            (Variant::TceOg, Auto),
            (Variant::BcEnsemble, Auto),
            (Variant::SourceClones, Auto),
            (Variant::Bc, All),
            (Variant::BcTop, All),
            (Variant::Prior(Algorithm::Otdf, Mode::Corrected), All),
        ] {
            assert_eq!(variant.own().target.trajectories, expected, "{variant}");
        }
    }

    #[test]
    fn forms_of_prior_methods_come_from_the_registry() {
        let published = Variant::Prior(Algorithm::Dara, Mode::Published);
        assert_eq!((published.name(), published.base()), ("dara-published", "dara"));
        assert_eq!(Variant::from_str("dara-published", false).unwrap(), published);
        assert_eq!(serde_json::from_str::<Variant>("\"dara-published\"").unwrap(), published);
        assert!(Variant::from_str("rebrac-published", false).is_err(), "it has one form");
        let toy = Variant::Prior(Algorithm::Toy, Mode::Corrected);
        assert_eq!(toy.name(), "toy", "a further learner is a variant, too");
        for variant in Variant::value_variants() {
            assert_eq!(serde_json::to_value(variant).unwrap(), variant.name());
        }
    }
}
