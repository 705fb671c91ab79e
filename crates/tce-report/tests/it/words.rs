//! What the pages say first, in all cases: the gap before the doubt, and whether to use generated rows.

use std::sync::Arc;

use crate::common::{add, diagnosis, hopper, one_task, quick, write_folder};
use tce_data::{Agent, Quality, Shift, Task};
use tce_diagnosis::{Answer, Coverage, Diagnosis, ImpliedRollout, Spread};
use tce_report::analysis::{gap_words, opening};
use tce_report::{Analysis, Budget, Change, Recipe, Recommended, Study, analyse};

fn said(study: &Study) -> String {
    opening(&analyse(study, &quick()).unwrap()).join(" ")
}

/// The opening of a report with a cloned baseline and some methods.
fn opened(baseline: &[f64], methods: &[(&str, &[f64])]) -> String {
    let root = tempfile::tempdir().unwrap();
    let mut all = vec![("bc", "BC", baseline)];
    let ids = ["tce-og", "tce-nn", "igdf"];
    all.extend(ids.iter().zip(methods).map(|(id, (title, scores))| (*id, *title, *scores)));
    said(&one_task(root.path(), &all))
}

fn one(baseline: &[f64], method: &[f64]) -> String {
    opened(baseline, &[("TCE(OG)", method)])
}

#[test]
fn the_opening_says_the_gap_and_then_the_doubt() {
    let five = |from: f64| (0..5).map(|k| from + f64::from(k)).collect::<Vec<_>>();
    let forty = |score: fn(usize) -> f64| (0..40).map(score).collect::<Vec<_>>();
    let cases = [
        ("above, proved", one(&five(60.0), &five(70.0))),
        ("below, proved", one(&five(60.0), &five(0.0))),
        ("above, two seeds", one(&[95.0, 95.4], &[96.0, 97.0])),
        ("below, two seeds", one(&[95.0, 95.4], &[0.0, 0.4])),
        ("equal, two seeds", one(&[95.0, 96.0], &[95.0, 96.0])),
        ("above, one seed", one(&[95.0], &[96.0])),
        ("below, one seed", one(&[95.0], &[0.4])),
        ("equal, one seed", one(&[95.0], &[95.0])),
        ("above, the interval holds one half", one(&five(60.0), &five(61.0))),
        ("unequal seeds", one(&[95.0, 95.4, 96.0], &[94.0])),
        // Seven of ten runs are higher, and three bad ones pull the mean down.
        ("lower mean, higher runs", one(&forty(|_| 60.0), &forty(|k| if k % 10 < 7 { 61.0 } else { 0.0 }))),
        ("higher mean, lower runs", one(&forty(|k| if k % 10 < 7 { 61.0 } else { 0.0 }), &forty(|_| 60.0))),
        ("several", opened(&five(60.0), &[("TCE(OG)", &five(70.0)), ("TCE(NN)", &five(61.0)), ("IGDF", &five(0.0))])),
        ("several, one seed", opened(&[60.0], &[("TCE(OG)", &[70.0]), ("TCE(NN)", &[50.0])])),
        ("baselines alone", opened(&five(60.0), &[])),
        ("no baseline", {
            let root = tempfile::tempdir().unwrap();
            said(&one_task(root.path(), &[("tce-og", "TCE(OG)", &[1.0])]))
        }),
    ];
    let text: String = cases.iter().map(|(case, text)| format!("{case}\n  {text}\n")).collect();
    insta::assert_snapshot!("openings", text);
}

/// Interquartile means by hand: of five runs the middle three, 71, 72, 73 and 61, 62, 63.
#[test]
fn the_gap_is_the_difference_of_interquartile_means() {
    let root = tempfile::tempdir().unwrap();
    let scores = ([60.0, 61.0, 62.0, 63.0, 99.0], [0.0, 71.0, 72.0, 73.0, 74.0]);
    let study = one_task(root.path(), &[("bc", "BC", &scores.0), ("tce-og", "TCE(OG)", &scores.1)]);
    let analysis = analyse(&study, &quick()).unwrap();
    let c = analysis.comparison.unwrap();
    let gap = c.gap(&c.methods[1]).unwrap();
    assert!((gap - 10.0).abs() < 1e-9, "{gap}");
    assert_eq!(c.gap(&c.methods[0]), None, "a baseline is not compared with itself");
    assert_eq!(c.methods[1].seeds, (5, 5));
    for (gap, words) in [
        (10.0, "10.0 points above"),
        (-94.9, "94.9 points below"),
        (1.0, "1.0 point above"),
        (0.04, "level with"),
        (-0.04, "level with"),
        (-0.06, "0.1 points below"),
    ] {
        assert_eq!(gap_words(gap), words);
    }
}

fn recommended(folder: &str, seed: u64, sure: bool) -> Recommended {
    Recommended {
        task: hopper(),
        folder: Some(folder.into()),
        seed: Some(seed),
        method: "as it was called".into(),
        sure,
        among: Vec::new(),
    }
}

/// Regret by hand: the best policy is TCE(OG)'s seed 0 with 95.9, the recommended one BC's seed 1 with 95.2.
#[test]
fn recommended_policies_have_a_score_and_a_regret() {
    let root = tempfile::tempdir().unwrap();
    let mut study = one_task(root.path(), &[("bc", "BC", &[95.3, 95.2]), ("tce-og", "TCE(OG)", &[95.9, 94.7])]);
    let mut cases = String::new();
    for (case, given) in [
        ("regret", recommended("bc", 1, true)),
        ("none, not sure", recommended("tce-og", 0, false)),
        ("not here", recommended("elsewhere", 0, true)),
    ] {
        study.recommended = vec![given];
        cases += &format!("{case}\n  {}\n", said(&study));
    }
    study.recommended = vec![recommended("bc", 1, true)];
    let found = analyse(&study, &quick()).unwrap().recommendations.remove(0);
    assert!((found.regret().unwrap() - 0.7).abs() < 1e-9 && found.score == Some(95.2), "{found:?}");
    assert_eq!((found.method.as_str(), found.best.unwrap().seed), ("BC", 0));

    // A second task: BC's 40 beside 50. The mean regret is (0.7 + 10) / 2.
    let ant = Task { agent: Agent::Ant, shift: Shift::Morph, source: Quality::Medium, target: Quality::Expert };
    for (id, score) in [("bc", 40.0), ("tce-og", 50.0)] {
        let directory = root.path().join(format!("ant-{id}"));
        write_folder(&directory, &[(0, Some(score)), (1, Some(score))], "a = 1\n");
        add(&mut study, ant, id, &directory);
    }
    study.recommended.push(Recommended { task: ant, ..recommended("ant-bc", 0, true) });
    cases += &format!("two tasks\n  {}\n", said(&study));
    let analysis = analyse(&study, &quick()).unwrap();
    assert!(tce_report::html::page(&study, &analysis).contains("Recommended policies and their"));
    // Three seeds of one task are three recommendations and one task, which counts once in a mean.
    study.recommended.push(Recommended { task: ant, ..recommended("ant-tce-og", 0, true) });
    study.recommended.push(Recommended { task: ant, ..recommended("ant-tce-og", 1, true) });
    cases += &format!("two tasks, four recommendations\n  {}\n", said(&study));
    insta::assert_snapshot!("recommended", cases);
}

fn with_recipe(study: &mut Study, recipe: &Recipe) -> Analysis {
    let recipe = Arc::new(recipe.clone());
    study.runs.iter_mut().for_each(|r| r.recipe = recipe.clone());
    analyse(study, &quick()).unwrap()
}

#[test]
fn presets_and_updates_are_named_and_the_papers_figures_doubted() {
    let root = tempfile::tempdir().unwrap();
    let budget = |learner: &str, updates: u64| Some(Budget { learner: learner.into(), updates });
    let quick = Recipe {
        preset: Some("quick".into()),
        changed: vec![],
        learner: budget("bc", 12_000),
        paper: budget("iql", 1_000_000),
    };
    let five = [70.0, 71.0, 72.0, 73.0, 74.0];
    let methods: [(&str, &str, &[f64]); 2] = [("bc", "BC", &five), ("tce-og", "TCE(OG)", &five)];
    let mut study = one_task(root.path(), &methods);
    let analysis = with_recipe(&mut study, &quick);
    assert_eq!((analysis.recipes.names(), analysis.recipes.updates), ("quick".into(), Some((12_000, 12_000))));
    let doubt = |a: &Analysis| a.tables[0].doubt.clone().unwrap_or_else(|| "none".into());
    let mut cases = format!("quick\n  {}\n", doubt(&analysis));
    let page = tce_report::html::page(&study, &analysis);
    let text = |html: &str| html.replace('\u{a0}', " ");
    let (header, rest) = page.split_once("</header>").unwrap();
    assert!(header.contains("<b>quick</b>") && text(header).contains("<b>12 000</b>"), "{header}");
    // The doubt stands above the table that holds the paper's column.
    let (before, _) = rest.split_once("paper, Table").unwrap();
    assert!(before.contains("Do not compare the paper's figures with ours"), "{before}");
    for other in [tce_report::text::markdown(&study, &analysis), tce_report::text::latex(&study, &analysis)] {
        assert!(other.contains("Do not compare the paper's figures") && other.contains("Preset quick"), "{other}");
    }

    let change = Change { key: "learner.steps".into(), value: "60".into(), preset: "12000".into() };
    let changed = Recipe { changed: vec![change], learner: budget("bc", 60), ..quick.clone() };
    let analysis = with_recipe(&mut study, &changed);
    cases += &format!("changed\n  {}\n", doubt(&analysis));
    assert!(tce_report::html::page(&study, &analysis).contains("learner.steps = 60 (12000)"));
    cases += &format!("unknown\n  {}\n", doubt(&with_recipe(&mut study, &Recipe::default())));
    let paper = Recipe { preset: Some("paper".into()), learner: quick.paper.clone(), ..quick };
    cases += &format!("the paper's, five seeds\n  {}\n", doubt(&with_recipe(&mut study, &paper)));
    study.runs.retain(|r| r.member.seed < 2);
    cases += &format!("the paper's, two seeds\n  {}\n", doubt(&with_recipe(&mut study, &paper)));
    insta::assert_snapshot!("doubts", text(&cases));
}

/// Whoever does not know the project finds its words in the list.
#[test]
fn the_words_of_the_pages_are_explained() {
    let root = tempfile::tempdir().unwrap();
    let mut study = one_task(root.path(), &[("bc", "BC", &[1.0, 2.0]), ("tce-og", "TCE(OG)", &[3.0, 4.0])]);
    study.diagnoses.push(diagnosis(Some(hopper())));
    let learner = Some(Budget { learner: "bc".into(), updates: 12_000 });
    let analysis = with_recipe(&mut study, &Recipe { learner, ..Recipe::default() });
    let report = tce_report::html::page(&study, &analysis);
    let alone = tce_report::diagnosis_page(&diagnosis(None));
    let diagnosed = [
        "y",
        "coverage",
        "lambda",
        "theorem",
        "generated",
        "source",
        "filter",
        "consistency",
        "implied",
        "tsne",
        "kl",
        "rms",
        "inverse",
    ];
    let scored = [
        "score",
        "bc",
        "baseline",
        "iqm",
        "seed",
        "interval",
        "improvement",
        "p",
        "profile",
        "gap",
        "preset",
        "updates",
        "expectile",
    ];
    for (page, words) in [(&report, [&diagnosed[..], &scored].concat()), (&alone, diagnosed.to_vec())] {
        for word in words {
            assert!(page.contains(&format!("href=\"#word-{word}\"")), "{word} is not linked");
            assert_eq!(page.matches(&format!("id=\"word-{word}\"")).count(), 1, "{word}");
        }
    }
    assert!(!alone.contains("id=\"word-iqm\""), "a word that the page does not use");
}

fn rollout(score: Option<(f64, f64)>, episodes: usize) -> ImpliedRollout {
    ImpliedRollout { episodes, score, returns: Some((1000.0, 50.0)), length: Some(900.0), failed: None }
}

/// The fixture with a policy that scores so, beside target data that score 90.
fn taught(rollout: Option<ImpliedRollout>) -> Diagnosis {
    let mut d = diagnosis(None);
    d.implied.as_mut().unwrap().rollout = rollout;
    d
}

#[test]
fn a_diagnosis_says_first_whether_to_use_the_rows() {
    let own = |change: &dyn Fn(&mut Diagnosis)| {
        let mut d = taught(Some(rollout(Some((88.0, 3.0)), 10)));
        change(&mut d);
        d
    };
    let at_own = |d: &mut Diagnosis, change: &dyn Fn(&mut tce_diagnosis::AtBound)| {
        let y = d.y_max;
        d.bounds_of_y.iter_mut().filter(|b| b.y_max == y).for_each(change);
    };
    let cases = [
        ("use", own(&|_| {}), Answer::Use),
        ("lower score", taught(Some(rollout(Some((61.0, 4.0)), 10))), Answer::DoNotUse),
        (
            "cannot act",
            own(&|d| {
                let failed = ImpliedRollout { failed: Some("actions that are not finite".into()), ..rollout(None, 10) };
                d.implied.as_mut().unwrap().rollout = Some(failed);
            }),
            Answer::DoNotUse,
        ),
        (
            "few states",
            own(&|d| {
                at_own(d, &|b| b.coverage = Some(Coverage { target: 0.1, source: Some(0.2) }));
            }),
            Answer::DoNotUse,
        ),
        ("wrong steps", own(&|d| at_own(d, &|b| b.kept.consistency = Spread::of([0.8]))), Answer::DoNotUse),
        (
            "copies",
            own(&|d| {
                at_own(d, &|b| b.memorisation.as_mut().unwrap().probability = 0.88);
            }),
            Answer::DoNotUse,
        ),
        (
            "blind actions",
            own(&|d| {
                d.implied.as_mut().unwrap().actions.held_out.as_mut().unwrap().single = 0.6;
            }),
            Answer::DoNotUse,
        ),
        (
            "two reasons",
            {
                let mut d = taught(Some(rollout(Some((61.0, 4.0)), 10)));
                at_own(&mut d, &|b| b.kept.consistency = Spread::of([0.8]));
                d
            },
            Answer::DoNotUse,
        ),
        ("too uncertain", taught(Some(rollout(Some((80.0, 17.3)), 4))), Answer::NotTold),
        ("one episode", taught(Some(rollout(Some((90.0, 0.0)), 1))), Answer::NotTold),
        ("no reference returns", taught(Some(rollout(None, 10))), Answer::NotTold),
        ("no simulator", taught(None), Answer::NotTold),
    ];
    let mut text = String::new();
    for (case, d, answer) in cases {
        let advice = d.advice();
        assert_eq!(advice.answer, answer, "{case}: {advice}");
        let page = tce_report::diagnosis_page(&d);
        // It is the first thing on the page after the name.
        let (_, lede) = page.split_once("<p class=\"lede\">").unwrap();
        assert!(lede.starts_with(&advice.to_string()), "{case}: {}", &lede[..300]);
        text += &format!("{case}\n  {advice}\n");
    }
    insta::assert_snapshot!("advice", text);
}

/// By hand: 90 less a tenth is 81. With ten episodes of ± 3, two standard errors are 1.90.
#[test]
fn scores_are_told_apart_by_two_standard_errors() {
    for (score, answer) in
        [(83.0, Answer::Use), (82.8, Answer::NotTold), (79.2, Answer::NotTold), (79.0, Answer::DoNotUse)]
    {
        assert_eq!(taught(Some(rollout(Some((score, 3.0)), 10))).advice().answer, answer, "{score}");
    }
}

/// Every entry of a figure's key has a colour or dashes, and words, of its own.
#[test]
fn no_two_entries_of_a_key_look_or_read_the_same() {
    let page = tce_report::diagnosis_page(&diagnosis(Some(hopper())));
    for figure in page.split("<figure>").skip(1) {
        let figure = figure.split("class=\"fig\"").next().unwrap();
        let entries: Vec<(&str, &str)> = figure
            .split("<svg class=\"sample ")
            .skip(1)
            .map(|e| (e.split('"').next().unwrap(), e.split("</svg>").nth(1).unwrap().split("</span>").next().unwrap()))
            .collect();
        for (k, (class, words)) in entries.iter().enumerate() {
            let colour = |class: &str| class.replace("dot ", "").replace(" again", "");
            let same = |e: &&(&str, &str)| colour(e.0) == colour(class) || e.1 == *words;
            assert!(!entries[..k].iter().any(|e| same(&e)), "{entries:?}");
        }
    }
}

#[test]
fn shares_stand_beside_what_would_be_good() {
    let page = tce_report::diagnosis_page(&diagnosis(None));
    for expected in [
        "96 %, which as many rows of other target episodes reach",
        "more than 5.0 %, which as many rows of other target episodes reach",
        "about 50 %; copies would have 90 %; below 25 % they lie beside the data",
        "about 7.0 %, its share of real target rows",
        "0; 1 is as wrong as a whole step",
        "90.0: the target data's",
    ] {
        assert!(page.contains(expected), "{expected}");
    }
}
