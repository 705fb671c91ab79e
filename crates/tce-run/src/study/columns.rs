//! Which runs of a folder are one column of the tables.

use std::sync::Arc;

use tce_base::sha256_hex;
use tce_data::Task;
use tce_report::{Recipe, RunFolder, Work, mixed};

/// A finished run of `tce run`.
pub struct Finished {
    pub task: Task,
    pub name: String,
    pub folder: RunFolder,
    pub recipe: Arc<Recipe>,
}

/// The column of every finished run: its name. Where a task has runs of one name that are no seeds of one work, they differ in their
/// settings or their data, and all settings, all data, or else all folders of that name are columns of their own.
pub fn columns(finished: &[Finished], notes: &mut Vec<String>) -> Vec<String> {
    let mut ids: Vec<String> = finished.iter().map(|run| run.name.clone()).collect();
    let marks: [fn(&RunFolder) -> String; 3] = [
        |f| f.config_hash[..6].to_owned(),
        |f| sha256_hex(serde_json::json!(f.inputs).to_string().as_bytes())[..6].to_owned(),
        |f| f.directory.display().to_string().rsplit('-').next().unwrap_or_default().to_owned(),
    ];
    for mark in marks {
        let works = finished.iter().zip(&ids).flat_map(|(run, id)| {
            let members = run.folder.members.iter();
            members.map(move |member| Work::of(run.task, id, member.seed, &run.recipe, &run.folder))
        });
        let mixed = mixed(works);
        for (Finished { name, folder, .. }, id) in finished.iter().zip(&mut ids).filter(|(_, id)| mixed.contains(*id)) {
            *id = format!("{id} {}", mark(folder));
            let note = format!(
                "{name}: a task has several runs with different settings or data; each is a column of its own."
            );
            if !notes.contains(&note) {
                notes.push(note);
            }
        }
    }
    ids
}
