//! What a plan will cost on this machine: hours of one core, by tier.
//!
//! The workloads behind it have HalfCheetah's sizes, so that the estimate is good to a factor of about two.

use std::collections::BTreeMap;

use serde::Serialize;
use tce_run::config::Config;
use tce_run::error::Result;
use tce_run::sweep::{Entry, Kind, Manifest};

use crate::costs::Rates;

/// The cost of a tier.
#[derive(Debug, Serialize)]
pub(super) struct TierCost {
    /// Its name; empty where there are no tiers.
    pub tier: String,
    /// Pieces of work.
    pub pieces: usize,
    /// Hours of one core.
    pub core_hours: f64,
}

/// Seconds that `entry` takes.
fn piece(rates: &mut Rates, manifest: &Manifest, entry: &Entry, config: &Config) -> Result<f64> {
    let environment = format!("env-{}", entry.task.agent);
    match entry.kind {
        Kind::Source => rates.seconds(&environment, config.source.rows as f64),
        Kind::Target => rates.seconds(&environment, tce_zoo::recipes::TARGET_ROWS as f64),
        Kind::Distances => rates.distances(config),
        Kind::Augment => rates.augmentation(config),
        Kind::Run => {
            // Clones whose actions other rows get are a run of their own where the plan has the baseline, and part of this one elsewhere.
            let planned = entry.needs.iter().any(|&index| manifest.entries[index].kind == Kind::Run);
            let clones =
                if config.mixture.by_clones() && !planned { rates.training(&config.of_clones())? } else { 0.0 };
            Ok(clones + rates.training(config)? + rates.evaluation(&environment, config)?)
        }
        Kind::Verdict => rates.dynamics(config),
    }
}

/// The cost of every tier of `manifest`, in their order.
///
/// # Errors
/// If a configuration cannot be read, or the user interrupts.
pub(super) fn costs(manifest: &Manifest) -> Result<Vec<TierCost>> {
    tce_sim::open_library()?;
    let mut rates = Rates::new(&[]);
    let mut configs: BTreeMap<&str, Config> = BTreeMap::new();
    let tier = |name: &str| TierCost { tier: name.to_owned(), pieces: 0, core_hours: 0.0 };
    let mut tiers: Vec<TierCost> = manifest.tiers().into_iter().map(tier).collect();
    for entry in &manifest.entries {
        if !configs.contains_key(entry.config.as_str()) {
            configs.insert(&entry.config, manifest.config(entry)?);
        }
        let seconds = piece(&mut rates, manifest, entry, &configs[entry.config.as_str()])?;
        for tier in tiers.iter_mut().filter(|t| t.tier == entry.tier) {
            tier.pieces += 1;
            tier.core_hours += seconds / 3600.0;
        }
    }
    Ok(tiers)
}
