//! Several studies as one: a record of last month beside the sweep of today.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};

use tce_data::Task;

use crate::folder::{RunFolder, Verdict};
use crate::study::{Method, Missing, Run, Study};

/// All of `studies` as one, in their order. A run that several of them have counts once. Where they differ about a run of the same
/// settings and data, the first one counts, and the difference is a conflict. Where studies have different settings or data for a method
/// and task, each of them has a column of its own.
///
/// # Panics
/// If there is none.
pub fn merge(studies: Vec<Study>) -> Study {
    let alone = studies.len() == 1;
    let mut studies = studies.into_iter();
    let first = studies.next().expect("at least one study");
    if alone {
        return first;
    }
    let mut merging = Merging {
        names: vec![first.name.clone()],
        origins: vec![0; first.runs.len()],
        places: BTreeMap::new(),
        renamed: Vec::new(),
        out: first,
    };
    for (place, run) in merging.out.runs.iter().enumerate() {
        merging.places.entry(Work::of(run)).or_insert(place);
    }
    studies.for_each(|study| merging.join(study));
    merging.split();
    let mut out = merging.out;
    // What one of them lacks another one may have.
    let done: BTreeSet<_> = out.runs.iter().map(|r| (r.task, r.method.as_str(), Some(r.member.seed))).collect();
    out.missing.retain(|m| !done.contains(&(m.task, m.method.as_str(), m.seed)));
    out.methods.sort_by_key(|m| !m.baseline);
    out
}

/// Studies on their way into one.
struct Merging {
    out: Study,
    /// The study that each run of `out` came from.
    origins: Vec<usize>,
    /// The place of the first run of every work in `out`.
    places: BTreeMap<Work, usize>,
    /// The studies' names, each once.
    names: Vec<String>,
    /// Methods that have another id than in their study, because that was taken: as they were, and the new id.
    renamed: Vec<(Method, String)>,
}

/// What makes two runs the same work.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct Work {
    task: Task,
    method: String,
    seed: u64,
    config_hash: String,
    inputs: BTreeMap<String, String>,
}

impl Work {
    fn of(run: &Run) -> Self {
        Self {
            task: run.task,
            method: run.method.clone(),
            seed: run.member.seed,
            config_hash: run.folder.config_hash.clone(),
            inputs: run.folder.inputs.clone(),
        }
    }
}

/// The column of `method` for the runs of the study `name`.
fn of_study(method: &Method, name: &str) -> Method {
    let named = |text: &str| format!("{text} ({name})");
    Method { id: named(&method.id), title: named(&method.title), plain: false, ..method.clone() }
}

impl Merging {
    /// The id that a method of the study `name` has from now on.
    fn id(&mut self, method: Method, name: &str) -> String {
        match self.out.methods.iter().find(|m| m.id == method.id) {
            Some(known) if *known == method => method.id,
            Some(_) => match self.renamed.iter().find(|(original, _)| *original == method) {
                Some((_, id)) => id.clone(),
                None => {
                    // The same name for something else.
                    let new = of_study(&method, name);
                    let id = new.id.clone();
                    self.renamed.push((method, id.clone()));
                    self.out.methods.push(new);
                    id
                }
            },
            None => {
                let id = method.id.clone();
                self.out.methods.push(method);
                id
            }
        }
    }

    fn join(&mut self, other: Study) {
        let number = self.names.len();
        let mut name = other.name.clone();
        while self.names.contains(&name) {
            name += "'";
        }
        self.names.push(name.clone());
        let ids: BTreeMap<String, String> =
            other.methods.into_iter().map(|m| (m.id.clone(), self.id(m, &name))).collect();
        let of = |id: String| ids.get(&id).cloned().unwrap_or(id);
        for run in other.runs {
            self.add(Run { method: of(run.method), ..run }, number);
        }
        let out = &mut self.out;
        // The name is a heading: some names are enough for one.
        if number < 3 {
            out.name = format!("{} + {}", out.name, other.name);
        } else if !out.name.ends_with(" + …") {
            out.name += " + …";
        }
        out.directory = format!("{}, {}", out.directory, other.directory);
        out.sweep |= other.sweep;
        add_new(&mut out.notes, other.notes);
        add_new(&mut out.conflicts, other.conflicts);
        add_new(&mut out.missing, other.missing.into_iter().map(|m| Missing { method: of(m.method), ..m }));
        add_new(&mut out.recommended, other.recommended);
        out.costs.extend(other.costs);
        out.diagnoses.extend(other.diagnoses);
    }

    /// Adds a run of study `number`, unless it is there.
    fn add(&mut self, run: Run, number: usize) {
        let at = match self.places.entry(Work::of(&run)) {
            Entry::Occupied(known) => *known.get(),
            Entry::Vacant(new) => {
                new.insert(self.out.runs.len());
                self.out.runs.push(run);
                self.origins.push(number);
                return;
            }
        };
        let first = &self.out.runs[at];
        match (&first.member.verdict, &run.member.verdict) {
            (_, Verdict::Unscored) => {}
            // Somebody looked since.
            (Verdict::Unscored, _) => (self.out.runs[at], self.origins[at]) = (run, number),
            (a, b) if a == b => {}
            (a, b) => {
                let told = |r: &Run, verdict: &Verdict| {
                    let came_to = match verdict {
                        Verdict::Score(score) => format!("{score:.1}"),
                        Verdict::Diverged(_) | Verdict::Unscored => "diverged".to_owned(),
                    };
                    format!("{came_to} ({}, {}, {})", r.folder.directory.display(), r.folder.program, r.folder.machine)
                };
                let (task, seed) = (run.task, run.member.seed);
                let conflict =
                    format!("{}, {task}, seed {seed}: {}, and {}", run.method, told(first, a), told(&run, b));
                self.out.conflicts.push(conflict);
            }
        }
    }

    /// Gives every study a column of its own where their runs of one method and task are different work.
    fn split(&mut self) {
        let runs = self.out.runs.iter();
        for id in mixed(runs.map(|r| (r.task, r.method.as_str(), &*r.folder, r.member.seed))) {
            let at = self.out.methods.iter().position(|m| m.id == id).expect("every run has a method");
            let method = self.out.methods.remove(at);
            let mut columns = 0;
            for (number, name) in self.names.iter().enumerate() {
                let own = of_study(&method, name);
                let runs = self
                    .out
                    .runs
                    .iter_mut()
                    .zip(&self.origins)
                    .filter(|(r, origin)| r.method == id && **origin == number);
                let count = runs.map(|(run, _)| run.method.clone_from(&own.id)).count();
                if count > 0 {
                    self.out.methods.insert(at + columns, own);
                    columns += 1;
                }
            }
            let note =
                format!("{id}: several studies have it with different settings or data; each is a column of its own.");
            add_new(&mut self.out.notes, [note]);
        }
    }
}

/// The names of which some task has runs that are no seeds of one work: they have other settings or other data, or a seed is there twice.
pub fn mixed<'a>(runs: impl IntoIterator<Item = (Task, &'a str, &'a RunFolder, u64)>) -> BTreeSet<String> {
    let mut seen: BTreeMap<(Task, &str), (&RunFolder, BTreeSet<u64>)> = BTreeMap::new();
    let mut mixed = BTreeSet::new();
    for (task, name, folder, seed) in runs {
        let (first, seeds) = seen.entry((task, name)).or_insert_with(|| (folder, BTreeSet::new()));
        let same = (&first.config_hash, &first.inputs) == (&folder.config_hash, &folder.inputs);
        if !seeds.insert(seed) || !same {
            mixed.insert(name.to_owned());
        }
    }
    mixed
}

/// Those of `more` that `known` does not have yet.
fn add_new<T: PartialEq>(known: &mut Vec<T>, more: impl IntoIterator<Item = T>) {
    for one in more {
        if !known.contains(&one) {
            known.push(one);
        }
    }
}
