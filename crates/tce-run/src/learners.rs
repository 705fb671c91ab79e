//! The registry of learners: a line makes a method known to configurations, `--learner`, `--list`, layers, keys and tests.

use serde::{Deserialize, Serialize};
use tce_learn::{
    About, BcConfig, BosaConfig, DaraConfig, DmcConfig, IgdfConfig, IqlConfig, LearnError, LearnedRows, MetaDtConfig,
    Method, Mode, OtdfConfig, RebracConfig, RegulariserConfig, RegulariserKind, ScaleBy, SrpoConfig, Td3BcConfig,
};

use crate::error::{Error, Result};

#[cfg(test)]
mod toy;

#[cfg(test)]
use toy::ToyConfig;

/// A line for each: `Variant("what it is") => table: Configuration("what the table is");`, in the order of the list. IQL's table is the one
/// that several methods stand on, so that it has no configuration here.
macro_rules! learners {
    ($($variant:ident($what:literal) => $table:ident $(: $config:ident($keys:literal))?;)*) => {
        /// Which algorithm learns the policy; what each of them is, `tce learn --list` tells.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, clap::ValueEnum, schemars::JsonSchema)]
        #[serde(rename_all = "kebab-case")]
        pub enum Algorithm {
            $(#[doc = $what] $variant,)*
        }

        /// The learner; the keys of algorithms that are not trained are not looked at.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
        #[serde(deny_unknown_fields)]
        pub struct LearnerConfig {
            /// Which algorithm learns the policy; `tce learn --list` tells what each is. Source: the paper has iql.
            pub algorithm: Algorithm,
            /// Training steps of the policy.
            pub steps: u64,
            /// Rows per step; `bc` has its own, `learner.bc.batch`. With other rows half of them are the target's, except where `learner.bc.fade`
            /// lowers the others' share. Source: Table C.4.
            #[schemars(range(min = 1))]
            pub batch: usize,
            /// Whether observations are standardised.
            pub standardise: bool,
            /// Share of the best trajectories that `bc` clones. 1: all of them. Source: "BC-10 %" of Chen et al.
            #[schemars(range(min = 0.001, max = 1.0))]
            pub top: f64,
            /// Implicit Q-learning, and what the prior methods that stand on it take from it.
            pub iql: IqlConfig,
            $($(
                // Runs that were done before there was this method have no such table.
                #[doc = $keys] #[serde(default)] pub $table: $config,
            )?)*
            /// The model of the target's behaviour, for regularisers.
            pub behaviour: RegulariserConfig,
        }

        impl Algorithm {
            /// All of them, in the order of the list.
            pub const ALL: &'static [Algorithm] = &[$(Algorithm::$variant,)*];
        }

        impl LearnerConfig {
            /// The configuration of `algorithm`.
            pub fn method(&self, algorithm: Algorithm) -> &dyn Method {
                match algorithm {
                    $(Algorithm::$variant => &self.$table,)*
                }
            }

            /// The table of `algorithm`, as a value.
            fn table(&self, algorithm: Algorithm) -> serde_json::Value {
                match algorithm {
                    $(Algorithm::$variant => serde_json::json!(self.$table),)*
                }
            }
        }

        /// Tables that a preset need not have: the configurations' own defaults, by name.
        pub fn default_tables() -> Vec<(&'static str, toml::Value)> {
            let mut tables = Vec::new();
            $($(
                tables.extend(toml::Value::try_from($config::default()).ok().map(|value| (stringify!($table), value)));
            )?)*
            tables
        }

        impl Algorithm {
            /// A configuration of its own defaults.
            fn fresh(self) -> Box<dyn Method> {
                match self {
                    $(Algorithm::$variant => Box::new(fresh!($table $($config)?)),)*
                }
            }
        }
    };
}

/// The default configuration of a table's method.
macro_rules! fresh {
    (iql) => {
        IqlConfig::paper()
    };
    ($table:ident $config:ident) => {
        $config::default()
    };
}

/// The registry: a line a method, and in tests that of a toy.
macro_rules! registry {
    ($($further:tt)*) => {
        learners! {
            Bc("Behaviour cloning.") => bc: BcConfig("Behaviour cloning.");
            Iql("Implicit Q-learning.") => iql;
            Td3Bc("TD3+BC.") => td3_bc: Td3BcConfig("TD3+BC. Source: Fujimoto and Gu.");
            Rebrac("ReBRAC.") => rebrac: RebracConfig("ReBRAC. Source: Tarasov et al.");
            Dara("DARA, on IQL.") => dara: DaraConfig("DARA, besides `learner.iql`.");
            Srpo("SRPO, on IQL.") => srpo: SrpoConfig("SRPO, besides `learner.iql`.");
            Igdf("IGDF, on IQL.") => igdf: IgdfConfig("IGDF, besides `learner.iql`.");
            Otdf("OTDF, on IQL.") => otdf: OtdfConfig("OTDF, besides `learner.iql`; its regulariser is `learner.behaviour`.");
            Bosa("BOSA.") => bosa: BosaConfig("BOSA.");
            Dmc("DmC's: implicit Q-learning on filtered rows, weighed by their scores.") => dmc: DmcConfig("DmC, besides `learner.iql`.");
            MetaDt("A decision transformer on contexts of a world model.") => meta_dt: MetaDtConfig("Meta-DT; `learner.steps` are the transformer's.");
            $($further)*
        }
    };
}

#[cfg(not(test))]
registry! {}
#[cfg(test)]
registry! { Toy("A learner that a test adds.") => toy: ToyConfig("A learner that a test adds."); }

impl Algorithm {
    /// What it is.
    pub fn about(self) -> About {
        self.fresh().about()
    }

    /// Whether it stands on IQL as `learner.iql` has it, without being IQL.
    pub fn stands_on_plain_iql(self) -> bool {
        let iql = IqlConfig::paper();
        self != Self::Iql && self.fresh().backbone(&iql) == Some(iql)
    }
}

impl LearnerConfig {
    /// Clones of all rows, with the same settings: the baseline of a policy.
    pub fn of_clones(&self) -> Self {
        Self { algorithm: Algorithm::Bc, standardise: true, top: 1.0, ..self.clone() }
    }

    /// The configuration of the chosen algorithm.
    pub fn own(&self) -> &dyn Method {
        self.method(self.algorithm)
    }

    /// The IQL that the algorithm stands on, where it does.
    pub fn backbone(&self) -> Option<IqlConfig> {
        self.own().backbone(&self.iql)
    }

    /// The behaviour model of the regulariser.
    pub fn behaviour(&self) -> RegulariserConfig {
        self.own().behaviour(&self.behaviour)
    }

    /// Training steps on `rows`.
    pub fn steps(&self, rows: LearnedRows) -> u64 {
        self.own().steps(self.steps, rows)
    }

    /// The step, of `steps`, from which on only target rows are learned from; None: other rows are, to the end.
    pub fn fade(&self) -> Option<u64> {
        self.own().fade(self.steps)
    }

    /// Rows of each update.
    pub fn batch(&self) -> usize {
        self.own().batch(self.batch)
    }

    /// Whether the method is trained as its public code has it, where that differs from its paper; None where there is one form.
    pub fn mode(&self) -> Option<Mode> {
        self.own().mode()
    }

    /// The keys that the algorithm looks at: what a run's identity depends on.
    pub fn used(&self, rows: LearnedRows) -> serde_json::Value {
        let Self { algorithm, steps, batch, standardise, .. } = self;
        let mut used = serde_json::json!({
            "algorithm": algorithm, "steps": steps, "batch": batch, "standardise": standardise,
        });
        used[algorithm.about().table] = self.table(*algorithm);
        if *algorithm == Algorithm::Bc {
            used["top"] = serde_json::json!(self.top);
            if let (LearnedRows::Target, Some(table)) = (rows, used["bc"].as_object_mut()) {
                // There is one table to scale by.
                table.remove("scale_by");
            }
        }
        if let Some(iql) = self.backbone() {
            if iql.regulariser != RegulariserKind::None {
                used["behaviour"] = serde_json::json!(self.behaviour());
            }
            used["iql"] = serde_json::json!(iql);
        }
        used
    }

    /// Whether observations are scaled by the target's rows alone, whatever others there are.
    pub fn scales_by_target(&self) -> bool {
        self.algorithm == Algorithm::Bc && self.bc.scale_by == ScaleBy::Target
    }

    /// Refuses numbers out of range, in the tables of all methods.
    ///
    /// # Errors
    /// Names the table and the key.
    pub fn check(&self) -> Result<()> {
        let named = |name: &str, check: std::result::Result<(), LearnError>| {
            check.map_err(|e| Error::Usage(format!("learner.{name}: {e}")))
        };
        // As the chosen method makes it of the table.
        named("iql", self.backbone().unwrap_or_else(|| self.iql.clone()).check())?;
        let mut others = Algorithm::ALL.iter().filter(|a| **a != Algorithm::Iql);
        others.try_for_each(|a| named(a.about().table, self.method(*a).check()))
    }
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum;

    use super::*;

    #[test]
    fn the_list_is_whole_and_names_are_those_of_the_command_line() {
        assert_eq!(Algorithm::ALL, Algorithm::value_variants());
        for algorithm in Algorithm::ALL {
            let name = algorithm.about().name;
            assert_eq!(algorithm.to_possible_value().unwrap().get_name(), name);
            assert_eq!(serde_json::json!(algorithm), name);
            assert_eq!(algorithm.about().table, name.replace('-', "_"));
        }
        let plain: Vec<_> = Algorithm::ALL.iter().filter(|a| a.stands_on_plain_iql()).map(|a| a.about().name).collect();
        assert_eq!(plain, ["dara", "srpo", "igdf"]);
    }
}
