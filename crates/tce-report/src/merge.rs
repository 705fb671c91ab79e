//! Several studies as one: a record of last month beside the sweep of today.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};

use tce_data::Task;

use crate::folder::Verdict;
use crate::study::{Method, Missing, Run, Study, Work};

/// All of `studies` as one, in their order. A run that several of them have counts once. Where they differ about a run of the same
/// settings and data, the first one counts, and the difference is a conflict. Where studies have different settings for a method and task,
/// all settings of the method have a column each; where they have different data, all studies.
///
/// # Panics
/// If there is none.
pub fn merge(studies: Vec<Study>) -> Study {
    let studies = match <[Study; 1]>::try_from(studies) {
        Ok([alone]) => return alone,
        Err(studies) => studies,
    };
    assert!(!studies.is_empty(), "at least one study");
    let mut merging = Merging::default();
    studies.into_iter().for_each(|study| merging.join(study));
    // What one of them lacks another one may have; so far a method has one name.
    let done: BTreeSet<_> = merging.out.runs.iter().map(|r| (r.task, r.method.as_str(), Some(r.member.seed))).collect();
    merging.out.missing.retain(|m| !done.contains(&(m.task, m.method.as_str(), m.seed)));
    merging.split("settings", |run, _| run.settings());
    merging.split("data", |_, study| study.to_string());
    let mut out = merging.out;
    out.methods.sort_by_key(|m| !m.baseline);
    out
}

/// Studies on their way into one.
#[derive(Default)]
struct Merging {
    out: Study,
    /// The study that each run of `out` came from.
    origins: Vec<usize>,
    /// The place of the first run of every work in `out`.
    places: BTreeMap<Work, usize>,
    /// The studies' names, each once; of a merged study also those that its columns are called after.
    names: Vec<String>,
    /// Studies joined so far.
    joined: usize,
    /// Methods that have another id than in their study, because that was taken: as they were, and the new id.
    renamed: Vec<(Method, String)>,
}

/// The column of `method` for the runs of the study `name`.
fn of_study(method: &Method, name: &str) -> Method {
    let named = |text: &str| format!("{text} ({name})");
    Method { id: named(&method.id), title: named(&method.title), plain: false, ..method.clone() }
}

/// The method of a column that was called after a study ([`of_study`]), and that study; others as they are.
fn without_study(method: Method) -> (Method, Option<String>) {
    let suffix = method.id.strip_prefix(&method.variant).filter(|s| s.starts_with(" (") && s.ends_with(')'));
    match suffix.and_then(|suffix| Some((suffix, method.title.strip_suffix(suffix)?))) {
        Some((suffix, title)) => {
            let name = suffix[2..suffix.len() - 1].to_owned();
            (Method { id: method.variant.clone(), title: title.to_owned(), plain: true, ..method }, Some(name))
        }
        None => (method, None),
    }
}

impl Merging {
    /// The number of the study `name`.
    fn number(&mut self, name: &str) -> usize {
        self.names.iter().position(|n| n == name).unwrap_or_else(|| {
            self.names.push(name.to_owned());
            self.names.len() - 1
        })
    }

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
        let mut name = other.name.clone();
        while self.names.contains(&name) {
            name += "'";
        }
        let number = self.number(&name);
        // Columns of a merged study come apart again: its runs may be one column with those of this one.
        let mut ids: BTreeMap<String, (String, usize)> = BTreeMap::new();
        for method in other.methods {
            let id = method.id.clone();
            let (method, study) = without_study(method);
            let origin = study.map_or(number, |study| self.number(&study));
            ids.insert(id, (self.id(method, &name), origin));
        }
        for run in other.runs {
            let (method, origin) = ids.get(&run.method).cloned().unwrap_or_else(|| (run.method.clone(), number));
            self.add(Run { method, ..run }, origin);
        }
        let of = |id: String| ids.get(&id).map_or(id, |known| known.0.clone());
        let out = &mut self.out;
        // The name is a heading: some names are enough for one.
        match self.joined {
            0 => out.name = other.name,
            1 | 2 => out.name = format!("{} + {}", out.name, other.name),
            _ if !out.name.ends_with(" + …") => out.name += " + …",
            _ => {}
        }
        if self.joined > 0 {
            out.directory += ", ";
        }
        out.directory += &other.directory;
        self.joined += 1;
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
        let at = match self.places.entry(run.work()) {
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

    /// Where runs of one method and task are different work, all runs of the method with the same `mark` are a column of their own. A mark is
    /// made from a run and the number of its study. The columns are called after the studies that they are from.
    fn split(&mut self, by: &str, mark: impl Fn(&Run, usize) -> String) {
        for id in mixed(self.out.runs.iter().map(Run::work)) {
            let at = self.out.methods.iter().position(|m| m.id == id).expect("every run has a method");
            let method = self.out.methods.remove(at);
            // The runs of every mark, in the order of the studies.
            let mut columns: Vec<(String, Vec<usize>)> = Vec::new();
            for place in (0..self.out.runs.len()).filter(|k| self.out.runs[*k].method == id) {
                let of = mark(&self.out.runs[place], self.origins[place]);
                match columns.iter_mut().find(|(known, _)| *known == of) {
                    Some((_, runs)) => runs.push(place),
                    None => columns.push((of, vec![place])),
                }
            }
            for (number, (_, runs)) in columns.iter().enumerate() {
                let mut studies: Vec<&str> = Vec::new();
                for &place in runs {
                    let name = self.names[self.origins[place]].as_str();
                    if !studies.contains(&name) {
                        studies.push(name);
                    }
                }
                let more = if studies.len() > 2 { ", …" } else { "" };
                let mut name = format!("{}{more}", studies[..studies.len().min(2)].join(", "));
                while self.out.methods.iter().any(|m| m.id == of_study(&method, &name).id) {
                    name += "'";
                }
                let own = of_study(&method, &name);
                runs.iter().for_each(|&place| self.out.runs[place].method.clone_from(&own.id));
                self.out.methods.insert(at + number, own);
            }
            let note = format!("{id}: the studies have it with different {by}; each of these is a column of its own.");
            add_new(&mut self.out.notes, [note]);
        }
    }
}

/// The methods of which some task has runs that are no seeds of one work: they have other settings or other data, or a seed is there twice.
pub fn mixed(runs: impl IntoIterator<Item = Work>) -> BTreeSet<String> {
    let mut seen: BTreeMap<(Task, String), (Work, BTreeSet<u64>)> = BTreeMap::new();
    let mut mixed = BTreeSet::new();
    for work in runs {
        let known = seen.entry((work.task, work.method.clone()));
        let (first, seeds) = known.or_insert_with(|| (work.clone(), BTreeSet::new()));
        let same = (&first.settings, &first.inputs) == (&work.settings, &work.inputs);
        if !seeds.insert(work.seed) || !same {
            mixed.insert(work.method);
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
