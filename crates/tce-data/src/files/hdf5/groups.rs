//! Opens data sets in groups, and each group once.
//!
//! For every object that it opens, `hdf5-pure` goes through the names of all groups on the way. In a file with a group for
//! each of thousands of episodes that takes minutes. So all groups beside a wanted one are opened together, and kept.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

use hdf5_pure::{Dataset, Error, File, Group};

/// Levels whose groups are kept: the top level, and one group of it at a time (robomimic's `data`).
const LEVELS: usize = 2;

/// The groups in one group.
struct Level {
    /// The path of that group.
    above: String,
    members: HashMap<String, Group>,
}

/// The groups that were opened.
#[derive(Default)]
pub(super) struct Groups {
    levels: Mutex<[Option<Level>; LEVELS]>,
}

impl Groups {
    /// Opens the data set at this path of hard links.
    pub fn dataset(&self, file: &File, path: &str) -> Result<Dataset, Error> {
        match path.rsplit_once('/') {
            None => file.dataset(path),
            Some((above, name)) => self.group(file, above)?.dataset(name),
        }
    }

    fn group(&self, file: &File, path: &str) -> Result<Group, Error> {
        if path.is_empty() {
            return Ok(file.root());
        }
        let (above, name) = path.rsplit_once('/').unwrap_or(("", path));
        let parent = self.group(file, above)?;
        let depth = if above.is_empty() { 0 } else { 1 + above.matches('/').count() };
        if depth >= LEVELS {
            return parent.group(name);
        }
        let mut levels = self.levels.lock().unwrap_or_else(PoisonError::into_inner);
        let level = &mut levels[depth];
        if level.as_ref().is_none_or(|level| level.above != above) {
            // If another member is damaged, there is no list; the wanted one may still be opened by its name.
            let members = parent.iter_groups().map(Iterator::collect).unwrap_or_default();
            *level = Some(Level { above: above.to_owned(), members });
        }
        match level.as_ref().and_then(|level| level.members.get(name)) {
            Some(group) => Ok(group.clone()),
            None => parent.group(name),
        }
    }
}
