//! The whole way from run folders to the page, on folders made up here.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use crate::common::{HOSTILE, add, method, quick, write_folder};
use serde_json::{Value, json};
use tce_data::{Agent, Quality, Shift, Task};
use tce_report::{Analysis, Cost, Missing, Run, RunFolder, Study, analyse};

fn task(agent: Agent, target: Quality) -> Task {
    Task { agent, shift: Shift::Morph, source: Quality::Medium, target }
}

/// Two tasks, four baselines, TCE(OG) and a method with a hostile name.
fn study(root: &Path) -> Study {
    let methods = vec![
        method("bc-raw", "BC, raw", true),
        method("bc", "BC, standardised", true),
        method("bc-top", "BC, best half", true),
        method("target-only", "Target Only", true),
        method("tce-og", "TCE(OG)", false),
        method("evil", HOSTILE, false),
    ];
    let mut study = Study {
        name: format!("demo {HOSTILE}"),
        sweep: true,
        directory: root.display().to_string(),
        methods: methods.clone(),
        runs: Vec::new(),
        missing: Vec::new(),
        conflicts: Vec::new(),
        notes: Vec::new(),
        diagnoses: Vec::new(),
        recommended: Vec::new(),
        costs: vec![Cost {
            stage: "Score networks".into(),
            agent: Agent::Hopper,
            seconds: 600.0,
            seeds: 1,
            memory: Some(3 << 29),
        }],
    };
    let tasks = [task(Agent::Hopper, Quality::Expert), task(Agent::Ant, Quality::Medium)];
    for (t, task) in tasks.into_iter().enumerate() {
        for (m, method) in methods.iter().enumerate() {
            let base = 10.0 * m as f64 + 5.0 * t as f64;
            let scores: Vec<(u64, Option<f64>)> = (0..5).map(|k| (k, Some(base + k as f64 / 8.0))).collect();
            let directory = root.join(format!("{t}/{m}"));
            write_folder(&directory, &scores, "[learner]\nsteps = 300 # <b>\n");
            add(&mut study, task, &method.id, &directory);
        }
    }
    study
}

fn page(study: &Study) -> (Analysis, String) {
    let analysis = analyse(study, &quick()).unwrap();
    let page = tce_report::html::page(study, &analysis);
    (analysis, page)
}

/// The page without the tags that HTML leaves open, as XML.
fn xml(page: &str) -> String {
    let mut out = page.replace("<!DOCTYPE html>", "").replace("<br>", "<br/>");
    while let Some(at) = out.find("<meta ") {
        let end = at + out[at..].find('>').unwrap();
        out.replace_range(at..=end, "");
    }
    out
}

fn with_class(document: &roxmltree::Document<'_>, name: &str, class: &str) -> usize {
    let has = |n: &roxmltree::Node<'_, '_>| n.attribute("class").is_some_and(|c| c.split(' ').any(|c| c == class));
    document.descendants().filter(|n| n.has_tag_name(name) && has(n)).count()
}

#[test]
fn the_page_is_well_formed_and_needs_no_network() {
    let root = tempfile::tempdir().unwrap();
    let study = study(root.path());
    let (_, page) = page(&study);
    let xml = xml(&page);
    let document = roxmltree::Document::parse(&xml).unwrap();
    for word in ["http://", "https://", "url(", "@import", "src="] {
        assert!(!page.contains(word), "{word}");
    }
    for node in document.descendants() {
        assert!(!["script", "link", "img", "iframe"].contains(&node.tag_name().name()));
        if let Some(link) = node.attribute("href") {
            let id = link.strip_prefix('#').expect("links stay on the page");
            assert!(document.descendants().any(|n| n.attribute("id") == Some(id)), "{link}");
        }
        // Numbers that are none would end a figure in silence.
        for attribute in node.attributes() {
            assert!(!attribute.value().contains("NaN") && !attribute.value().contains("inf"), "{attribute:?}");
        }
    }
}

#[test]
fn figures_hold_a_mark_for_every_method() {
    let root = tempfile::tempdir().unwrap();
    let (_, page) = page(&study(root.path()));
    let xml = xml(&page);
    let document = roxmltree::Document::parse(&xml).unwrap();
    // Four aggregates and a profile of six methods, two against the best baseline, once over all and once on two tasks, scores and losses of six methods on two tasks.
    assert_eq!(with_class(&document, "g", "mark"), 4 * 6 + 6 + 2 + 2 * 2 + 2 * 2 * 6);
    assert_eq!(with_class(&document, "line", "thick"), 4 * 6 + 2 + 2 * 2);
    assert_eq!(with_class(&document, "polygon", "band"), 6 + 2 * 2 * 6);
    assert_eq!(
        document.descendants().filter(|n| n.has_tag_name("svg") && n.attribute("role").is_some()).count(),
        4 + 2 + 2 + 4
    );
}

#[test]
fn the_page_has_the_numbers_the_baselines_and_the_paper() {
    let root = tempfile::tempdir().unwrap();
    let study = study(root.path());
    let (analysis, page) = page(&study);
    // Ours on Ant and Hopper, the paper's figures of the same tasks, and both totals.
    for text in [
        "45.2",
        "40.2",
        "99.8",
        "41.8",
        "85.5",
        "141.6",
        "10.7",
        "36 tasks",
        "BC, raw",
        "BC, best half",
        "Target Only",
        "1.5 GiB",
    ] {
        assert!(page.contains(text), "{text}");
    }
    let c = analysis.comparison.as_ref().unwrap();
    assert_eq!((c.tasks.len(), c.methods.len(), c.baselines.len()), (2, 6, 4));
    assert_eq!(c.best_baseline(), Some(3));
    let og = c.methods.iter().find(|a| analysis.methods[a.method].id == "tce-og").unwrap();
    assert_eq!(c.improvement(og).unwrap().0.point, 1.0);
    assert!(page.contains("Of two methods compared with Target Only, two are shown to beat it"));
    assert!(analysis.warnings.is_empty(), "{:?}", analysis.warnings);
    for (text, name) in [
        (tce_report::text::markdown(&study, &analysis), "markdown"),
        (tce_report::text::latex(&study, &analysis), "latex"),
    ] {
        for number in ["85.5", "99.8", "141.6"] {
            assert!(text.contains(number), "{name}: {number}");
        }
    }
}

#[test]
fn hostile_names_are_text() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    study.missing.push(Missing {
        task: task(Agent::Hopper, Quality::Expert),
        method: "evil".into(),
        seed: None,
        what: HOSTILE.into(),
        why: HOSTILE.into(),
    });
    study.notes.push(HOSTILE.into());
    let (analysis, page) = page(&study);
    assert!(!page.contains("<script"));
    let text = xml(&page);
    let document = roxmltree::Document::parse(&text).unwrap();
    let title = document.descendants().find(|n| n.has_tag_name("h1")).unwrap().text().unwrap();
    assert_eq!(title, format!("demo {HOSTILE}"));
    assert!(document.descendants().filter(|n| n.has_tag_name("th") && n.text() == Some(HOSTILE)).count() >= 2);
    let markdown = tce_report::text::markdown(&study, &analysis);
    assert!(!markdown.contains("<script"));
    let rows: Vec<&str> = markdown.lines().filter(|l| l.starts_with('|')).collect();
    let cells = |line: &str| line.replace("\\|", "").matches('|').count();
    let first = rows.iter().position(|r| r.contains("Task")).unwrap();
    assert!(rows[first..].iter().all(|r| cells(r) == cells(rows[first])), "{markdown}");
    let latex = tce_report::text::latex(&study, &analysis);
    assert!(latex.contains("\\textless{}script\\textgreater{}") && latex.contains("\\textbackslash{}"));
}

fn warned(analysis: &Analysis, text: &str) -> bool {
    analysis.warnings.iter().any(|w| w.text.contains(text))
}

#[test]
fn whatever_is_wrong_is_said_first() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    let hopper = task(Agent::Hopper, Quality::Expert);
    // TCE(OG) loses Ant and some seeds of Hopper, and one of its policies diverges.
    study.runs.retain(|r| r.method != "tce-og");
    let directory = root.path().join("other");
    write_folder(&directory, &[(0, Some(30.0)), (1, None)], "[a.b]\nmode = \"published\"\n");
    add(&mut study, hopper, "tce-og", &directory);
    // bc is missing on Ant.
    study.runs.retain(|r| !(r.method == "bc" && r.task.agent == Agent::Ant));
    study.missing.push(Missing {
        task: hopper,
        method: "tce-og".into(),
        seed: None,
        what: "tce-og, seed 2".into(),
        why: "not done".into(),
    });
    let (analysis, page) = page(&study);
    for text in [
        "Partial results: 1 of ",
        "1 policy could not act to the end of its evaluation: counted as 0 points",
        "Published mode: TCE(OG) follow",
        "Few seeds: 2 to 5",
        "Unequal numbers of seeds, 2 to 5",
        "Baselines are missing: BC, standardised on 1 of 2",
        "Means over tasks are of the 1 of 2 tasks",
        // Two runs below five: chance does that in 2 of 21 cases.
        "Not proved to differ from the best baseline, Target Only: TCE(OG) (",
    ] {
        assert!(warned(&analysis, text), "{text}: {:#?}", analysis.warnings);
    }
    assert!(page.contains("published mode") && page.contains("15.0") && page.contains("†"));
    let og = analysis.methods.iter().position(|m| m.id == "tce-og").unwrap();
    assert!(analysis.needs_mark(og));
    // Once is enough.
    let mut told = analysis.clone();
    told.methods[og].title = "TCE(OG) (published)".into();
    assert!(!told.needs_mark(og) && !tce_report::text::markdown(&study, &told).contains("(published mode)"));
    assert!(page.find("Partial results").unwrap() < page.find("<table").unwrap());
    // A diverged policy is a result: 30 and 0.
    let c = analysis.comparison.unwrap();
    let og = c.methods.iter().find(|a| analysis.methods[a.method].id == "tce-og").unwrap();
    assert_eq!(og.over_seeds[2].point, 15.0);
}

/// Markdown cannot fold a list of hundreds away; the page has it.
#[test]
fn long_lists_of_what_is_missing_are_cut_in_markdown_alone() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    for seed in 0..23 {
        study.missing.push(Missing {
            task: task(Agent::Hopper, Quality::Expert),
            method: "tce-og".into(),
            seed: None,
            what: format!("tce-og, seed {}", 100 + seed),
            why: "not done".into(),
        });
    }
    let (analysis, page) = page(&study);
    let text = tce_report::text::markdown(&study, &analysis);
    assert!(text.contains("seed 109: not done") && !text.contains("seed 110"), "{text}");
    assert!(text.contains("and 13 more, all of them in report.html"), "{text}");
    assert!(page.contains("seed 122"));
}

#[test]
fn methods_without_a_common_task_are_left_out_by_name() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    study.runs.retain(|r| match r.method.as_str() {
        "tce-og" => r.task.agent == Agent::Hopper,
        "evil" => r.task.agent == Agent::Ant && r.member.seed == 0,
        _ => true,
    });
    let (analysis, _) = page(&study);
    let c = analysis.comparison.as_ref().unwrap();
    assert_eq!(c.left_out, [5]);
    assert_eq!(c.tasks, [task(Agent::Hopper, Quality::Expert)]);
    assert!(warned(&analysis, "Left out of the means over tasks"));
}

/// A method that has just begun does not take the others' tasks away.
#[test]
fn a_beginning_does_not_shrink_the_comparison() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    let runs = study.runs.clone();
    for (agent, quality) in [
        (Agent::Hopper, Quality::Medium),
        (Agent::Ant, Quality::Expert),
        (Agent::Hopper, Quality::MediumExpert),
        (Agent::Ant, Quality::MediumExpert),
    ] {
        let more = runs.iter().filter(|r| r.method != "evil" && r.task.agent == agent).cloned();
        study.runs.extend(more.map(|r| Run { task: task(agent, quality), ..r }));
    }
    study.runs.retain(|r| r.method != "evil" || r.task.agent == Agent::Ant);
    let (analysis, _) = page(&study);
    let c = analysis.comparison.as_ref().unwrap();
    assert_eq!((c.left_out.as_slice(), c.tasks.len()), ([5].as_slice(), 6));
    assert!(warned(&analysis, "Left out of the means over tasks, because they share too few tasks with the others"));
}

/// Two methods, each with a baseline that the other has not: the two that can be compared are.
#[test]
fn a_method_and_a_baseline_with_a_common_task_are_compared() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    let runs = study.runs.clone();
    // TCE(OG) and one baseline on Ant alone; the other baselines on Hopper, and the other method on a third task, with more seeds of it all.
    study.runs.retain(|r| match r.method.as_str() {
        "tce-og" | "target-only" => r.task.agent == Agent::Ant,
        "evil" => false,
        _ => r.task.agent == Agent::Hopper,
    });
    for quality in [Quality::Medium, Quality::MediumExpert] {
        let more = runs.iter().filter(|r| r.method == "evil" && r.task.agent == Agent::Hopper).cloned();
        study.runs.extend(more.map(|r| Run { task: task(Agent::Walker2d, quality), ..r }));
    }
    let (analysis, page) = page(&study);
    let c = analysis.comparison.as_ref().unwrap();
    let compared: Vec<&str> = c.methods.iter().map(|a| analysis.methods[a.method].id.as_str()).collect();
    assert_eq!(
        (compared, c.tasks.as_slice()),
        (vec!["target-only", "tce-og"], [task(Agent::Ant, Quality::Medium)].as_slice())
    );
    assert!(!page.contains("share no task") && warned(&analysis, "BC, raw (1 task)"));
}

/// Baselines on six tasks, methods on two of them: the methods are what a reader wants compared.
#[test]
fn baselines_on_more_tasks_do_not_stand_alone() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    let runs = study.runs.clone();
    for quality in [Quality::MediumExpert, Quality::Medium] {
        let baselines = runs.iter().filter(|r| r.method.starts_with("bc") && r.task.agent == Agent::Hopper).cloned();
        study.runs.extend(baselines.map(|r| Run { task: task(Agent::Walker2d, quality), ..r }));
        let baselines = runs.iter().filter(|r| r.method.starts_with("bc") && r.task.agent == Agent::Hopper).cloned();
        study.runs.extend(baselines.map(|r| Run { task: task(Agent::HalfCheetah, quality), ..r }));
    }
    let (analysis, _) = page(&study);
    let c = analysis.comparison.as_ref().unwrap();
    assert_eq!((c.left_out.len(), c.tasks.len(), c.methods.len()), (0, 2, 6));
}

#[test]
fn one_seed_has_no_interval_and_no_finding() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    study.runs.retain(|r| r.member.seed == 0);
    let (analysis, page) = page(&study);
    assert!(warned(&analysis, "Few seeds: 1 for each task"));
    assert!(page.contains(">one seed<") && page.contains("two are not proved to differ from it"));
}

/// Two seeds of one task, all above: the interval is a point, and still nothing is shown.
#[test]
fn two_seeds_of_one_task_show_nothing() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    study.runs.retain(|r| r.member.seed < 2 && r.task.agent == Agent::Hopper);
    let (analysis, page) = page(&study);
    let c = analysis.comparison.as_ref().unwrap();
    let og = c.methods.iter().find(|a| analysis.methods[a.method].id == "tce-og").unwrap();
    assert_eq!(c.improvement(og).unwrap().0.interval, Some((1.0, 1.0)));
    assert!(og.p_value.unwrap() > 0.2, "{:?}", og.p_value);
    assert!(page.contains(">too few runs<") && warned(&analysis, "Not proved to differ from the best baseline"));
}

#[test]
fn an_empty_study_is_refused() {
    let root = tempfile::tempdir().unwrap();
    let mut study = study(root.path());
    study.runs.clear();
    let message = analyse(&study, &quick()).unwrap_err().to_string();
    assert!(message.contains("found no finished run, expected at least one"), "{message}");
}

#[test]
fn the_same_runs_give_the_same_page() {
    let root = tempfile::tempdir().unwrap();
    let study = study(root.path());
    assert_eq!(page(&study).1, page(&study).1);
    let out = root.path().join("out");
    let written = tce_report::write(&study, &page(&study).0, &out).unwrap();
    let sizes: BTreeMap<_, _> = written.iter().map(|p| (p.clone(), fs::metadata(p).unwrap().len())).collect();
    assert!(sizes.len() == 3 && sizes.values().all(|s| *s > 1000), "{sizes:?}");
}

/// Changes a field of `done.json` and expects to be told.
#[test]
fn damaged_records_are_refused_by_file_and_field() {
    let root = tempfile::tempdir().unwrap();
    let directory = root.path().join("run");
    let reset = || write_folder(&directory, &[(0, Some(1.0)), (1, Some(2.0))], "a = 1\n");
    for (pointer, value, needles) in [
        ("/summary/seeds/1", json!("one"), ["summary.seeds.1", "\"one\"", "whole number"]),
        ("/summary/scores", json!([1.0]), ["summary.scores", "1 values", "as many as seeds, 2"]),
        ("/summary/scores/0", json!({}), ["summary.scores.0", "{}", "finite number"]),
        ("/summary/seconds", json!(-3), ["summary.seconds", "-3", "number from 0"]),
        ("/summary/learned/evaluations/0/returns", json!([1, "x"]), ["returns", "\"x\"", "numbers"]),
        ("/files", json!(7), ["files", "7", "names and texts"]),
        ("/program", Value::Null, ["program", "null", "name"]),
    ] {
        reset();
        let path = directory.join("done.json");
        let mut done: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        *done.pointer_mut(pointer).unwrap() = value;
        fs::write(&path, done.to_string()).unwrap();
        let message = RunFolder::read(&directory).unwrap_err().to_string();
        for needle in needles.iter().chain(&["done.json", "found", "expected", "run it again"]) {
            assert!(message.contains(needle), "{pointer}: {needle}: {message}");
        }
    }
    for (file, text) in [("done.json", "{"), ("config.toml", "= ="), ("spec.json", "[]"), ("metrics.jsonl", "x\n{}\n")]
    {
        reset();
        fs::write(directory.join(file), text).unwrap();
        let message = RunFolder::read(&directory).unwrap_err().to_string();
        assert!(message.contains(file) && message.contains("found") && message.contains("expected"), "{message}");
    }
    reset();
    fs::write(directory.join("metrics.jsonl"), "{\"stage\":\"learn\",\"step\":1,\"member\":7,\"x\":1}\n{}\n").unwrap();
    let message = RunFolder::read(&directory).unwrap_err().to_string();
    assert!(message.contains("member (line 1)") && message.contains("below 2"), "{message}");
    reset();
    fs::remove_file(directory.join("metrics.jsonl")).unwrap();
    assert!(RunFolder::read(&directory).unwrap().unwrap().curves.iter().all(BTreeMap::is_empty));
    fs::write(directory.join("config.toml"), "a = 2\n").unwrap();
    assert!(RunFolder::read(&directory).unwrap().unwrap().damage().unwrap().contains("config.toml"));
    fs::remove_file(directory.join("done.json")).unwrap();
    assert!(RunFolder::read(&directory).unwrap().is_none());
}
