//! The pages in a real browser: nothing on its console, and all that is drawn arrives in its document.
//!
//! Needs Chromium (`apt install chromium`); without it these tests are skipped, and say so.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::common::{diagnosis, hopper, one_task, quick};
use tce_data::{Agent, Quality, Shift, Task};

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
        // Errors over distance are one line; all others compare two things at least.
        let least = if figure.contains("Label error against distance") { 1 } else { 2 };
        assert!(drawn(figure) >= least, "{figure}");
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

/// The page's width and its window's, in windows of 1280 and 390 pixels. The pages themselves run no script: one around them looks in.
fn widths(browser: &Path, page: &str) -> Vec<(u32, u32)> {
    let source = page.replace('&', "&amp;").replace('"', "&quot;");
    let frame = |width: u32| {
        format!("<iframe width=\"{width}\" height=\"2000\" style=\"border:0\" srcdoc=\"{source}\"></iframe>")
    };
    let script = "addEventListener('load', () => { document.title = 'widths ' + [...document.querySelectorAll('iframe')].map(f => \
                  f.contentDocument.documentElement.scrollWidth + ' ' + f.contentWindow.innerWidth).join(' '); });";
    let around =
        format!("<!DOCTYPE html><meta charset=\"utf-8\"><script>{script}</script>{}{}", frame(1280), frame(390));
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("around.html");
    std::fs::write(&path, around).unwrap();
    let (document, _) = open(browser, &path);
    let title =
        document.split("<title>widths ").nth(1).and_then(|t| t.split("</title>").next()).expect("the script ran");
    let numbers: Vec<u32> = title.split(' ').map(|n| n.parse().unwrap()).collect();
    numbers.chunks(2).map(|n| (n[0], n[1])).collect()
}

#[test]
fn pages_fit_a_screen_and_a_phone() {
    let Some(browser) = browser() else { return };
    let root = tempfile::tempdir().unwrap();
    let mut study = one_task(
        root.path(),
        &[
            ("bc-raw", "BC, raw observations", &[1.0, 2.0]),
            ("bc-ensemble", "BC, ensemble of 5", &[95.0, 95.5]),
            ("tce-og", "TCE(OG), a_setting_with_quite_a_long_name=0.123456789", &[0.4, 0.5]),
            ("igdf", "IGDF", &[20.0, 30.0]),
        ],
    );
    study.diagnoses.push(diagnosis(Some(hopper())));
    let analysis = tce_report::analyse(&study, &quick()).unwrap();
    let report = tce_report::html::page(&study, &analysis);
    for page in [&report, &tce_report::diagnosis_page(&diagnosis(Some(hopper())))] {
        let found = widths(&browser, page);
        assert_eq!(found.iter().map(|w| w.1).collect::<Vec<_>>(), [1280, 390]);
        assert!(found.iter().all(|(page, window)| page <= window), "{found:?}");
        // A page that is too wide is told on.
        let wide = page.replace("</main>", "<div style=\"width: 2000px\">wide</div></main>");
        assert!(widths(&browser, &wide).iter().all(|(page, window)| page > window));
    }
}
