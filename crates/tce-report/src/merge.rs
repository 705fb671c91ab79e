//! Several studies as one: a record of last month beside the sweep of today.

use std::collections::{BTreeMap, BTreeSet};

use tce_data::Task;

use crate::folder::{RunFolder, Verdict};
use crate::study::{Method, Missing, Run, Study};

/// All of `studies` as one, in their order. A run that several of them have counts once. Where they differ about a run of the same
/// settings and data, the first one counts, and the difference is a conflict. Settings that share a name, a task and a seed become
/// columns of their own.
///
/// # Panics
/// If there is none.
pub fn merge(studies: Vec<Study>) -> Study {
    let alone = studies.len() == 1;
    let mut studies = studies.into_iter();
    let mut out = studies.next().expect("at least one study");
    if alone {
        return out;
    }
    for study in studies {
        join(&mut out, study);
    }
    // What one of them lacks another one may have.
    let done =
        |m: &Missing| out.runs.iter().any(|r| (r.task, &r.method, Some(r.member.seed)) == (m.task, &m.method, m.seed));
    let missing = std::mem::take(&mut out.missing);
    out.missing = missing.into_iter().filter(|m| !done(m)).collect();
    let runs: Vec<_> = out.runs.iter().map(|r| (r.task, r.method.as_str(), &*r.folder, r.member.seed)).collect();
    let (ids, notes) = columns(&runs);
    let mut split = BTreeSet::new();
    for (run, id) in out.runs.iter_mut().zip(ids).filter(|(run, id)| run.method != *id) {
        split.insert(run.method.clone());
        if !out.methods.iter().any(|m| m.id == id) {
            let of = out.methods.iter().position(|m| m.id == run.method).expect("every run has a method");
            let mark = &id[run.method.len()..];
            let method = &out.methods[of];
            let title = format!("{},{mark}", method.title);
            let method = Method { id: id.clone(), title, plain: false, ..method.clone() };
            // Behind the columns that came from the same one before.
            let behind =
                out.methods[of + 1..].iter().take_while(|m| m.id.starts_with(&format!("{} ", run.method))).count();
            out.methods.insert(of + 1 + behind, method);
        }
        run.method = id;
    }
    // A baseline keeps its column without runs: a table shows that it lacks it.
    let used = |id: &str| out.runs.iter().any(|r| r.method == id) || out.missing.iter().any(|r| r.method == id);
    out.methods.retain(|m| used(&m.id) || (m.baseline && !split.contains(&m.id)));
    out.methods.sort_by_key(|m| !m.baseline);
    add_new(&mut out.notes, notes);
    out
}

/// What makes two runs the same work.
fn same_work(a: &Run, b: &Run) -> bool {
    (a.task, &a.method, a.member.seed) == (b.task, &b.method, b.member.seed)
        && (&a.folder.config_hash, &a.folder.inputs) == (&b.folder.config_hash, &b.folder.inputs)
}

/// What makes two results the same: one result has many times and places.
fn same_result(a: &Run, b: &Run) -> bool {
    let bits = |r: &Run| match &r.member.verdict {
        Verdict::Score(score) => Some(score.to_bits()),
        Verdict::Diverged(_) | Verdict::Unscored => None,
    };
    bits(a) == bits(b)
}

fn join(out: &mut Study, other: Study) {
    let name = format!("{} + {}", out.name, other.name);
    // The name is a heading: three names are enough for one.
    out.name =
        if name.matches(" + ").count() < 3 { name } else { format!("{} + …", out.name.trim_end_matches(" + …")) };
    out.directory = format!("{}, {}", out.directory, other.directory);
    out.sweep |= other.sweep;
    let mut renamed = BTreeMap::new();
    for method in other.methods {
        match out.methods.iter().find(|m| m.id == method.id) {
            None => out.methods.push(method),
            Some(known) if *known == method => {}
            Some(_) => {
                // The same name for something else.
                let id = format!("{} ({})", method.id, other.name);
                renamed.insert(method.id.clone(), id.clone());
                let title = format!("{} ({})", method.title, other.name);
                out.methods.push(Method { id, title, plain: false, ..method });
            }
        }
    }
    let of = |id: String| renamed.get(&id).cloned().unwrap_or(id);
    for run in other.runs {
        let run = Run { method: of(run.method), ..run };
        match out.runs.iter().find(|r| same_work(r, &run)) {
            Some(first) if same_result(first, &run) => {}
            Some(first) => {
                let of = |r: &Run| format!("{} on {}", r.folder.directory.display(), r.folder.machine);
                let conflict =
                    format!("{}, {}, seed {}: {}, and {}", run.method, run.task, run.member.seed, of(first), of(&run));
                out.conflicts.push(conflict);
            }
            None => out.runs.push(run),
        }
    }
    let new =
        |known: &[String], notes: Vec<String>| notes.into_iter().filter(|n| !known.contains(n)).collect::<Vec<_>>();
    out.notes.extend(new(&out.notes, other.notes));
    out.conflicts.extend(new(&out.conflicts, other.conflicts));
    add_new(&mut out.missing, other.missing.into_iter().map(|m| Missing { method: of(m.method), ..m }));
    out.costs.extend(other.costs);
    out.diagnoses.extend(other.diagnoses);
    add_new(&mut out.recommended, other.recommended);
}

/// Those of `more` that `known` does not have yet.
fn add_new<T: PartialEq>(known: &mut Vec<T>, more: impl IntoIterator<Item = T>) {
    for one in more {
        if !known.contains(&one) {
            known.push(one);
        }
    }
}

/// The column of every run, given as task, name, folder and seed: its name. Where a task has two runs of one name and seed, they differ in
/// their settings or their data, and every setting, or else every folder, of that name is a column of its own. The second list tells
/// a reader which names that befell.
pub fn columns(runs: &[(Task, &str, &RunFolder, u64)]) -> (Vec<String>, Vec<String>) {
    let mut ids: Vec<String> = runs.iter().map(|r| r.1.to_owned()).collect();
    let mut notes = Vec::new();
    let marks: [fn(&RunFolder) -> String; 2] = [
        |f| f.config_hash[..6].to_owned(),
        |f| {
            let name = f.directory.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
            name.rsplit('-').next().unwrap_or_default().to_owned()
        },
    ];
    for mark in marks {
        let mut seen: BTreeSet<(Task, &str, u64)> = BTreeSet::new();
        let mut twice: BTreeSet<&str> = BTreeSet::new();
        for ((task, name, _, seed), id) in runs.iter().zip(&ids) {
            if !seen.insert((*task, id, *seed)) {
                twice.insert(name);
            }
        }
        for ((_, name, folder, _), id) in runs.iter().zip(&mut ids).filter(|((_, name, ..), _)| twice.contains(name)) {
            *id = format!("{name} {}", mark(folder));
        }
        for name in twice {
            let note = format!(
                "{name}: a task has several runs of one seed with different settings or data; each is a column of its own."
            );
            if !notes.contains(&note) {
                notes.push(note);
            }
        }
    }
    (ids, notes)
}
