//! The pages in a real browser: nothing on its console, and all that is drawn arrives in its document.
//!
//! Needs Chromium (`apt install chromium`); without it these tests are skipped, and say so.

use std::path::{Path, PathBuf};
use std::process::Command;

use tce_data::{Agent, Quality, Shift, Task};
use tce_diagnosis::{
    AtBound, Bounds, Choice, Coverage, Curve, Diagnosis, Embedding, ErrorOverDistance, Group, Histogram, Implied,
    ImpliedActions, ImpliedErrors, ImpliedRollout, Labels, Memorisation, Rated, Reliability, Sampled, Spread,
};

fn browser() -> Option<PathBuf> {
    let names = ["chromium", "chromium-browser", "google-chrome"];
    let found = names.iter().flat_map(|name| {
        std::env::split_paths(&std::env::var_os("PATH").unwrap_or_default())
            .map(move |d| d.join(name))
            .collect::<Vec<_>>()
    });
    let found = found.into_iter().find(|p| p.exists());
    if found.is_none() {
        eprintln!("SKIPPED: no Chromium in PATH");
    }
    found
}

/// Lines and clouds of a figure that have at least two places; the samples of its key do not count.
fn drawn(figure: &str) -> usize {
    let figure = figure.split("</figure>").next().unwrap();
    let drawing = figure.split("class=\"fig\"").nth(1).expect("a figure has a drawing");
    let places = |start: &str, attribute: &str| {
        let parts = drawing.split(start).skip(1).map(|p| p.split('>').next().unwrap().to_owned());
        let value = move |tag: String| tag.split(attribute).nth(1).and_then(|v| v.split('"').next()).map(str::to_owned);
        parts.filter_map(value).collect::<Vec<_>>()
    };
    let lines = places("<polyline", "points=\"").into_iter().filter(|p| p.split_whitespace().count() > 1);
    let clouds = places("class=\"dots", "d=\"").into_iter().filter(|d| d.matches('M').count() > 1);
    lines.count() + clouds.count()
}

#[test]
fn drawings_without_data_are_not_taken_for_drawn() {
    let key = "<div class=\"keys\"><svg class=\"sample dot m0\"><path class=\"dots\" d=\"M5 5h0\"></path></svg></div>";
    let svg = |inner: &str| format!("{key}<svg class=\"fig\">{inner}</svg></figure>");
    assert_eq!(drawn(&svg("<path class=\"dots m0\" d=\"\"></path><polyline points=\"1,2\"></polyline>")), 0);
    let full =
        "<path class=\"dots m0\" d=\"M1 1h0M2 2h0\"></path><polyline class=\"line\" points=\"1,2 3,4\"></polyline>";
    assert_eq!(drawn(&svg(full)), 2);
}

/// The document as the browser has it, and what it wrote on its console.
fn open(browser: &Path, page: &Path) -> (String, Vec<String>) {
    let profile = tempfile::tempdir().unwrap();
    let output = Command::new(browser)
        .args(["--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom"])
        .arg(format!("--user-data-dir={}", profile.path().display()))
        .arg(format!("file://{}", page.display()))
        .output()
        .expect("the browser runs");
    let console = String::from_utf8_lossy(&output.stderr);
    let console = console.lines().filter(|l| l.contains("CONSOLE")).map(str::to_owned).collect();
    (String::from_utf8_lossy(&output.stdout).into_owned(), console)
}

fn spread(median: f64) -> Option<Spread> {
    Spread::of([median * 0.5, median, median * 2.0])
}

fn reliability(y: f64) -> Reliability {
    Reliability {
        rows: 90,
        distance: spread(0.1 + y),
        transition_kl: spread(1.0 + 10.0 * y),
        reward_difference: spread(0.01 + y),
        reward_error: spread(0.02 + y),
        consistency: spread(0.05 + y),
    }
}

fn embedding(groups: &[Group]) -> Embedding {
    let points = |k: usize| (0..50).map(|i| [(i * 7 % 13) as f32 + k as f32, (i * 5 % 11) as f32]).collect();
    Embedding { groups: groups.iter().enumerate().map(|(k, g)| (*g, points(k))).collect() }
}

fn diagnosis(task: Option<Task>) -> Diagnosis {
    let memorisation = Memorisation {
        generated: spread(1.0).unwrap(),
        held_out: spread(0.9).unwrap(),
        identical: 0.0,
        probability: 0.45,
        of_copies: 0.9,
    };
    let at = |y: f64| AtBound {
        y_max: y,
        lost: 0,
        coverage: Some(Coverage { target: 0.9 - y, source: Some(0.1 + y) }),
        rejected: 0.1,
        memorisation: Some(memorisation),
        kept: reliability(y),
        outliers: Some(reliability(2.0 * y)),
    };
    let generated: Vec<f64> = (0..100).map(|i| 0.2 + 0.001 * f64::from(i)).collect();
    let sources: Vec<f64> = (0..100).map(|i| 0.5 + 0.01 * f64::from(i)).collect();
    let curve = Curve::of(&Rated::certain(sources), &Rated::certain(generated));
    let histogram = |n: u64| Histogram { low: 0.0, high: 0.2, counts: (0..20).map(|k| n + k % 3).collect() };
    let implied = ImpliedErrors {
        rows: 2000,
        lost: 0,
        draws: 8,
        single: 0.25,
        mean: 0.2,
        between_draws: 0.15,
        inverse: 0.03,
        spread: 0.5,
    };
    Diagnosis {
        of: "tce-og-<b>".into(),
        task,
        seed: 3,
        y_max: 0.2,
        z_threshold: Some(3.0),
        lambda: 0.0,
        rows: 100,
        target_rows: 5000,
        coverage_rows: 45,
        covered_by_target: Some(Coverage { target: 0.96, source: Some(0.05) }),
        covered_by_fresh: true,
        bounds_of_y: [0.0, 0.1, 0.2].map(at).into(),
        sampled: Sampled {
            y_kept: histogram(5),
            y_rejected: histogram(1),
            z: histogram(4),
            z_real: histogram(3),
            real_rejected: 0.07,
        },
        transitions: Some(embedding(&[Group::Source, Group::NearestSource, Group::Target, Group::Generated])),
        states: vec![(0.2, embedding(&[Group::Source, Group::Target, Group::Generated]))],
        labels: Labels {
            held_out_action: Some((0.01, 0.5)),
            held_out_reward: Some((0.02, 0.6)),
            at_source: Some((0.2, 0.3)),
            at_generated: Some((0.1, 0.2)),
            terminal: Some(0.01),
        },
        implied: Some(Implied {
            actions: ImpliedActions { trained: Some(implied), held_out: Some(implied) },
            rollout: Some(ImpliedRollout {
                episodes: 10,
                score: Some((61.0, 4.0)),
                returns: Some((1000.0, 50.0)),
                length: Some(900.0),
                failed: None,
            }),
            behaviour_score: Some(90.0),
        }),
        error_over_distance: ErrorOverDistance::of(
            (1..=100).map(|i| (0.01 * f64::from(i), 0.02 * f64::from(i))).collect(),
            Some(0.3),
            true,
        ),
        choice: curve.as_ref().map(Choice::of),
        choice_by_simulator: curve.as_ref().map(Choice::of),
        theorem: Some(Bounds {
            discount: 0.99,
            r_max: 5.0,
            transition: curve.clone(),
            value: curve.clone(),
            transition_alone: curve.clone(),
            value_alone: curve,
            held_out: Some((0.1, 0.05)),
        }),
        notes: vec!["a <note>".into()],
    }
}

#[test]
fn a_diagnosis_opens_without_a_word_and_with_all_its_figures() {
    let page = tce_report::diagnosis_page(&diagnosis(Some(Task {
        agent: Agent::Ant,
        shift: Shift::Morph,
        source: Quality::Medium,
        target: Quality::Expert,
    })));
    assert!(
        page.contains("it scores 61.0 ± 4.0; the target data score 90.0")
            && page.contains("Label error against distance")
    );
    assert!(!page.contains("<b>tce") && !page.contains("NaN") && !page.contains("inf\""), "{page}");
    let Some(browser) = browser() else { return };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("diagnosis.html");
    std::fs::write(&path, &page).unwrap();
    let (document, console) = open(&browser, &path);
    assert_eq!(console, Vec::<String>::new());
    let figures: Vec<&str> = document.split("<figure>").skip(1).collect();
    // Coverage, copies, five of reliability, errors over distance, two pictures, two histograms, two bounds.
    assert_eq!(figures.len(), 14);
    for figure in figures {
        assert!(drawn(figure) >= 2, "{figure}");
    }
    for expected in ["λ = 0", "no copies", "tce-og-&lt;b&gt;", "a &lt;note&gt;"] {
        assert!(document.contains(expected), "{expected}");
    }
}

/// What the others look for can be found: a page that breaks its promise is told on.
#[test]
fn a_broken_promise_shows_on_the_console() {
    let Some(browser) = browser() else { return };
    let page = tce_report::diagnosis_page(&diagnosis(None));
    let page = page.replace("</main>", "<script>document.title = 'x'</script></main>");
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("broken.html");
    std::fs::write(&path, page).unwrap();
    let (_, console) = open(&browser, &path);
    assert!(console.iter().any(|l| l.contains("Content Security Policy")), "{console:?}");
}
