//! Names of variants in tables, which depend on their configuration.

use tce_learn::Mode;

use crate::config::Config;
use crate::layers::{Layered, Preset};
use crate::variant::Variant;

impl Variant {
    /// The variant's own configuration.
    pub(crate) fn own(self) -> Config {
        Layered::new(Preset::Default, None, Some(self), None, &[]).and_then(|l| l.config()).expect("tested for all")
    }

    /// The name in tables of a row whose configuration is the variant's own.
    pub fn own_title(self) -> String {
        self.row_title(&self.own())
    }

    /// The name in tables of a row that `config` decides: its learner, if that is not the variant's own, and its mode.
    pub fn row_title(self, config: &Config) -> String {
        let algorithm = config.learner.algorithm;
        let mut title = self.title().to_owned();
        if self.own().learner.algorithm != algorithm {
            title += &format!(", {}", algorithm.about().name);
        }
        if config.learner.mode() == Some(Mode::Published) {
            title += " (published)";
        }
        title
    }
}

#[cfg(test)]
mod tests {
    use clap::ValueEnum;

    use super::*;

    #[test]
    fn every_variant_is_a_valid_layer_on_every_preset() {
        for preset in [Preset::Paper, Preset::Default, Preset::Quick] {
            for &variant in Variant::value_variants() {
                let config = Layered::new(preset, None, Some(variant), None, &[]).unwrap().config().unwrap();
                let published = variant.mode() == Mode::Published;
                assert_eq!(config.learner.mode() == Some(Mode::Published), published);
                assert_eq!(variant.row_title(&config).ends_with(" (published)"), published);
                assert!(
                    config.mixture.lambda > 0.0 || matches!(config.mixture.source, crate::config::SourceRows::None)
                );
            }
        }
    }
}
