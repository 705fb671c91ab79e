//! A file of transitions, as a run takes it.

use std::borrow::Cow;
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Serialize;
use tce_base::{sha256_file, sha256_parts};
use tce_data::{
    ActionRange, LoadOptions, Loaded, ReferenceScores, Standardizer, Transitions, load, main_file, read_attributes,
};

use crate::error::{Error, Result};

/// Below this, nothing can be held out and nothing be learned.
const LEAST_ROWS: usize = 10;
/// An attribute of every file of `tce augment`, whose column `origin` tells target rows (0) from others.
const AUGMENTED: &str = "target_sha256";

/// Whether `tce augment` wrote this file.
pub fn is_augmented(path: &Path) -> bool {
    read_attributes(path).is_ok_and(|attributes| attributes.contains_key(AUGMENTED))
}

/// A loaded file.
#[derive(Clone, Debug)]
pub struct Table {
    /// The rows whose successor is known.
    pub rows: Arc<Transitions>,
    /// All rows, where there are terminal ones without a successor among them.
    pub(crate) complete: Option<Arc<Transitions>>,
    /// All rows' actions as the file has them, where they were scaled.
    pub(crate) own_actions: Option<Vec<f32>>,
    /// The file.
    pub file: PathBuf,
    /// SHA-256 of the file, and how many of its rows these are, if not all.
    pub hash: String,
}

/// What a data set is, and how good the policy was that collected it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Behaviour {
    /// The file.
    pub file: PathBuf,
    /// Its rows.
    pub rows: usize,
    /// Whole episodes.
    pub episodes: usize,
    /// Their mean return.
    pub mean: f64,
    /// The spread of their returns.
    pub std: f64,
    /// The mean return, normalised in the domain that the rows come from; None if no episode came to its end.
    pub score: Option<f64>,
}

/// SHA-256 of everything that rows in memory are.
fn content_hash(rows: &Transitions) -> String {
    let dims = [rows.obs_dim, rows.act_dim].iter().flat_map(|&dim| (dim as u64).to_le_bytes()).collect();
    let numbers = [&rows.observations, &rows.actions, &rows.rewards, &rows.next_observations];
    let numbers = numbers.into_iter().flat_map(|column| column.chunks(1 << 14));
    let numbers = numbers.map(|part| part.iter().flat_map(|x| x.to_le_bytes()).collect());
    let flags = [&rows.terminals, &rows.timeouts, &rows.known];
    let flags = flags.into_iter().map(|column| column.iter().map(|&flag| u8::from(flag)).collect());
    sha256_parts(std::iter::once(dims).chain(numbers).chain(flags))
}

impl Table {
    pub(crate) fn read(path: &Path, options: &LoadOptions) -> Result<Self> {
        let (loaded, hash) = Self::loaded(path, options)?;
        Ok(Self::new(loaded.transitions, path, hash))
    }

    /// What is in the file, which is told, and the file's hash.
    fn loaded(path: &Path, options: &LoadOptions) -> Result<(Loaded, String)> {
        let loaded = load(path, options)?;
        tce_base::note!("{}", loaded.report);
        Ok((loaded, sha256_file(&main_file(path))?))
    }

    /// The rows of a file that are not the target's. `tce augment` writes those beside the generated ones, and a learner that takes half of
    /// every batch from the target would see them twice.
    pub(crate) fn besides(path: &Path, options: &LoadOptions, target: &Self) -> Result<Self> {
        let options = LoadOptions { all_columns: true, ..options.clone() };
        let (Loaded { transitions, columns, .. }, hash) = Self::loaded(path, &options)?;
        // In a file of the user's own a column of this name may mean anything.
        let origin = columns.get("origin").filter(|_| is_augmented(path));
        Self::without_target(transitions.into(), origin.map(Vec::as_slice), path, hash, target)
    }

    /// The rows that are not the target's: neither marked by `origin` as such, nor equal to one.
    ///
    /// # Errors
    /// If the rows are of another robot, or all of them are the target's.
    pub(crate) fn without_target(
        rows: Arc<Transitions>,
        origin: Option<&[f32]>,
        file: &Path,
        hash: String,
        target: &Self,
    ) -> Result<Self> {
        let bits = |t: &Transitions, i: usize| -> Vec<u32> {
            let parts = [t.observation(i), t.action(i), t.next_observation(i)];
            parts.into_iter().flatten().map(|x| x.to_bits()).collect()
        };
        let own = target.complete();
        if (rows.obs_dim, rows.act_dim) != (own.obs_dim, own.act_dim) {
            return Err(Error::Failed(format!(
                "{}: found extra rows of {} observations and {} actions, expected {} and {} as in the target, {}; give --extra (Python: extra=) \
                 rows of the same robot",
                file.display(),
                rows.obs_dim,
                rows.act_dim,
                own.obs_dim,
                own.act_dim,
                target.file.display()
            )));
        }
        let known: HashSet<Vec<u32>> = (0..own.len()).map(|i| bits(own, i)).collect();
        let is_target = |i: usize| origin.is_some_and(|o| o[i] == 0.0) || known.contains(bits(&rows, i).as_slice());
        let others: Vec<usize> = (0..rows.len()).filter(|&i| !is_target(i)).collect();
        if others.len() == rows.len() {
            return Ok(Self::new(rows, file, hash));
        }
        if others.is_empty() {
            return Err(Error::Usage(format!(
                "{}: found the rows of {} alone, expected others; leave out --extra, or give a file with generated or source rows",
                file.display(),
                target.file.display()
            )));
        }
        let left_out = rows.len() - others.len();
        tce_base::note!(
            "{}: {left_out} of its {} rows are target rows and are left out, for --target brings them",
            file.display(),
            rows.len()
        );
        Ok(Self::new(rows.select(&others), file, format!("{hash}, without {left_out} target rows")))
    }

    /// Rows that are in memory; `name` stands for the file.
    pub(crate) fn in_memory(rows: Arc<Transitions>, name: &str) -> Self {
        let hash = content_hash(&rows);
        Self::new(rows, Path::new(name), hash)
    }

    pub(crate) fn new(rows: impl Into<Arc<Transitions>>, file: &Path, hash: String) -> Self {
        let rows = rows.into();
        let known = match rows.with_successors() {
            Cow::Borrowed(_) => None,
            Cow::Owned(known) => Some(Arc::new(known)),
        };
        let (rows, complete) = match known {
            None => (rows, None),
            Some(known) => (known, Some(rows)),
        };
        Self { rows, complete, own_actions: None, file: file.to_owned(), hash }
    }

    /// Refuses rows of which nothing can be learned.
    pub(crate) fn usable(&self) -> Result<()> {
        let refuse = |found: String, expected: &str| {
            let file = self.file.display();
            Err(Error::Failed(format!("{file}: found {found}, expected {expected}; record more of this robot")))
        };
        if self.rows.len() < LEAST_ROWS {
            return refuse(format!("{} rows with a next state", self.rows.len()), &format!("at least {LEAST_ROWS}"));
        }
        let varies = |values: &[f32], dim: usize| Standardizer::fit(values, dim).dead.len() < dim;
        if !varies(&self.rows.observations, self.rows.obs_dim) {
            return refuse("states that never change".into(), "at least one column of `observations` that does");
        }
        let pairs = self.rows.next_observations.iter().zip(&self.rows.observations);
        if pairs.clone().all(|(next, state)| next == state) {
            return refuse("next states that are the states".into(), "a robot that moves");
        }
        Ok(())
    }

    /// Whether rows follow each other: half of them do at least.
    pub fn has_episodes(&self) -> bool {
        2 * self.complete().episodes().len() <= self.complete().len()
    }

    /// All rows, for whoever learns without looking at s' where an episode ended.
    pub fn complete(&self) -> &Transitions {
        self.complete.as_deref().unwrap_or(&self.rows)
    }

    /// [`Self::complete`], shared.
    pub(crate) fn all_rows(&self) -> Arc<Transitions> {
        self.complete.as_ref().unwrap_or(&self.rows).clone()
    }

    pub(crate) fn scale(&mut self, range: &ActionRange) {
        range.to_unit(&mut Arc::make_mut(&mut self.rows).actions);
        self.complete.iter_mut().for_each(|t| range.to_unit(&mut Arc::make_mut(t).actions));
    }

    pub(crate) fn behaviour(&self, reference: Option<ReferenceScores>, limit: Option<usize>) -> Behaviour {
        let content = tce_data::inspect(self.complete(), limit);
        let (returns, score) = (&content.returns, content.normalised_score(reference));
        Behaviour {
            file: self.file.clone(),
            rows: self.rows.len(),
            episodes: returns.count,
            mean: returns.mean,
            std: returns.std,
            score,
        }
    }
}
