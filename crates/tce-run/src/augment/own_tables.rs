//! A user's own target table, widened: its rows and generated ones in one table, in the user's units.

use std::collections::BTreeMap;
use std::path::Path;

use tce_data::Transitions;
use tce_nn::Device;

use crate::augment::{Generated, augment_rows};
use crate::config::Config;
use crate::course::Course;
use crate::error::Result;
use crate::inputs::Inputs;

/// Generated rows of one seed, and what they were made of.
#[derive(Clone, Debug)]
pub struct Augmented {
    /// The generated rows, each an episode of its own, actions in the user's units.
    pub generated: Transitions,
    /// What was noticed.
    pub report: Generated,
    /// What a file says of its rows: hashes of the tables, seed, settings, program.
    pub attributes: BTreeMap<String, String>,
}

impl Augmented {
    /// Trains the networks and samples rows as `config` says, or takes what is there from `cache`.
    ///
    /// # Errors
    /// If a table or a setting cannot be used, a network diverges, or the user interrupts.
    pub fn new(inputs: &Inputs, config: &Config, seed: u64, cache: &Path, device: &Device) -> Result<Self> {
        let dims = (inputs.target.rows.obs_dim, inputs.target.rows.act_dim);
        let mut course = Course::new(format!("{}x{}", dims.0, dims.1), 1, device, cache);
        course.generating(config);
        course.plan();
        let augmentation = augment_rows(inputs, config, &[seed], cache, device)?;
        let attributes = BTreeMap::from([
            ("source_sha256".to_owned(), inputs.source.as_ref().map_or_else(String::new, |s| s.hash.clone())),
            ("target_sha256".to_owned(), inputs.target.hash.clone()),
            ("seed".to_owned(), seed.to_string()),
            // The names of keys: equal settings give equal bytes in every version.
            ("config".to_owned(), config.to_keyed_toml()),
            ("program".to_owned(), tce_base::PROGRAM.to_owned()),
        ]);
        let generated = inputs.in_own_units(&augmentation.tables[0]);
        Ok(Self { generated, report: augmentation.reports[0].clone(), attributes })
    }
}

/// The rows of `target`, then `generated` ones; the second column, `origin`, is 0 for a target row and 1 for a generated one.
pub fn joined(target: &Transitions, generated: &Transitions) -> (Transitions, Vec<f32>) {
    let rows = target.len() + generated.len();
    let mut all = Transitions::with_capacity(target.obs_dim, target.act_dim, rows);
    all.extend(target);
    // The last episode of the target must not run on into the generated rows.
    if let (Some(timeout), Some(false)) = (all.timeouts.last_mut(), target.terminals.last()) {
        *timeout = true;
    }
    all.extend(generated);
    let mut origin = vec![0.0; target.len()];
    origin.resize(rows, 1.0);
    (all, origin)
}
