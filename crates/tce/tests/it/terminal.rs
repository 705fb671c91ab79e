//! What a person sees: widths, colours, lines that change in place; and what programs get.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::common::{TINY, data_pair, program, tce, tce_json};
use tce_data::{Agent, Shift};

fn text(output: &std::process::Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// Lines that are longer than `width` although they could be broken.
fn too_long(text: &str, width: usize) -> Vec<&str> {
    text.lines().filter(|l| l.chars().count() > width && l.trim().contains(' ')).collect()
}

#[test]
fn everything_fits_its_columns() {
    let dir = tempfile::tempdir().unwrap();
    let (source, target) = data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let (source, target) =
        (source.file_name().unwrap().to_str().unwrap(), target.file_name().unwrap().to_str().unwrap());
    let calls: [&[&str]; 9] = [
        &["learn", "--list"],
        &["zoo", "list"],
        &["zoo", "show", "hopper-source-medium"],
        &["config", "show"],
        &["config", "show", "learner.iql.policy_extraction"],
        &["data", "inspect", source, target],
        &["data", "inspect", target, "--dimensions"],
        &["data", "check", target],
        &["--help"],
    ];
    for width in [80, 120] {
        for call in calls {
            let text = text(&program(dir.path(), call).env("COLUMNS", width.to_string()).output().unwrap());
            assert_eq!(too_long(&text, width), Vec::<&str>::new(), "tce {call:?} at {width}");
            assert!(!text.contains('\u{1b}'), "tce {call:?}: colours in a pipe");
        }
    }
}

#[test]
fn csv_has_the_rows_of_json() {
    let dir = tempfile::tempdir().unwrap();
    let json = tce_json(dir.path(), &["zoo", "list"]);
    let csv = text(&tce(dir.path(), &["zoo", "list", "--csv"]));
    let mut reader = csv::Reader::from_reader(csv.as_bytes());
    let header = reader.headers().unwrap().clone();
    let rows: Vec<_> = reader.records().map(Result::unwrap).collect();
    let items = json.as_array().unwrap();
    assert_eq!(rows.len(), items.len());
    for (row, item) in rows.iter().zip(items) {
        for (name, cell) in header.iter().zip(row) {
            match &item[name] {
                serde_json::Value::Null => assert!(cell.is_empty() || name.contains('.'), "{name}: {cell}"),
                serde_json::Value::String(text) => assert_eq!(cell, text),
                other => assert_eq!(cell, other.to_string(), "{name}"),
            }
        }
    }
    let both = tce(dir.path(), &["zoo", "list", "--csv", "--json"]);
    assert_eq!(both.status.code(), Some(2));
}

#[test]
fn a_key_is_explained_and_a_table_lists_its_keys() {
    let dir = tempfile::tempdir().unwrap();
    let call = ["config", "show", "generator.y_max", "--preset", "quick", "--set", "generator.y_max=0.1"];
    let expected = "\
generator.y_max
  what it does  How far generated states may go from the target's to
                the source's: ŷ ~ U(0, y_max).
  value         0.1
  from          --set generator.y_max=0.1
  in presets    paper 0.2, default 0.2, quick 0.2
  type          a number
  range         0 to 1
  source        Table C.5
  note          ŷ ~ U(0, y_max) [C.5] (in preset default)
  to change it  --set generator.y_max=0.1
";
    assert_eq!(text(&program(dir.path(), &call).env("COLUMNS", "70").output().unwrap()), expected);
    let json = tce_json(dir.path(), &["config", "show", "learner.bc"]);
    let keys: Vec<_> = json.as_array().unwrap().iter().map(|e| e["key"].as_str().unwrap()).collect();
    assert!(keys.contains(&"learner.bc.ensemble") && keys.iter().all(|k| k.starts_with("learner.bc.")), "{keys:?}");
    let json = tce_json(
        dir.path(),
        &["config", "show", "filter.z_threshold", "walker2d-morph:medium->medium-expert", "--preset", "paper"],
    );
    assert_eq!((json["value"].as_str(), json["from"].as_str()), (Some("2.5"), Some("Table C.5")));
    let unknown = tce(dir.path(), &["config", "show", "generator.ymax"]);
    assert_eq!(unknown.status.code(), Some(2));
}

#[test]
fn shells_and_man_get_what_they_read() {
    let dir = tempfile::tempdir().unwrap();
    for (shell, word) in [("bash", "complete -F"), ("zsh", "#compdef tce"), ("fish", "complete -c tce")] {
        assert!(text(&tce(dir.path(), &["completions", shell])).contains(word), "{shell}");
    }
    text(&tce(dir.path(), &["man", "--out", "man1"]));
    let page = |name: &str| fs::read_to_string(dir.path().join("man1").join(name)).unwrap();
    assert!(page("tce.1").contains(".TH"));
    let run = page("tce-run.1");
    assert!(run.contains("Examples:") && run.contains("hopper") && !run.contains('\u{1b}'), "{run}");
    assert!(page("tce-sweep-launch.1").contains("slurm"));
}

/// What a terminal of 80 columns shows at the end of `tce ARGS`, with all that has scrolled away; None where there is no `script`.
fn on_terminal(directory: &Path, args: &str, variables: &str) -> Option<(Vec<u8>, String)> {
    let line = format!("stty cols 80 rows 40; {variables} {} {args}", env!("CARGO_BIN_EXE_tce"));
    let mut command = Command::new("script");
    command.args(["-qec", &line, "/dev/null"]).current_dir(directory).env("TERM", "xterm-256color");
    command.env_remove("NO_COLOR").env_remove("COLUMNS").env("TCE_SHARED", directory.join("no-shared-folder"));
    let Ok(output) = command.output() else {
        eprintln!("SKIPPED: no `script` to make a terminal with");
        return None;
    };
    let mut screen = vt100::Parser::new(200, 80, 0);
    screen.process(&output.stdout);
    Some((output.stdout, screen.screen().contents()))
}

#[test]
fn bars_leave_no_line_behind_on_a_terminal() {
    let dir = tempfile::tempdir().unwrap();
    data_pair(dir.path(), Agent::Hopper, Shift::Morph);
    let tiny = TINY.join(" ");
    let args = format!(
        "augment --source source.hdf5 --target target.hdf5 --out wider.hdf5 {tiny} --set generator.transition_steps=2000 --set generator.rows=6000 --set generator.sampler.steps=10"
    );
    let Some((bytes, shown)) = on_terminal(dir.path(), &args, "") else { return };
    let raw = String::from_utf8_lossy(&bytes);
    assert!(raw.contains("step 1 of 3") && raw.contains("step 3 of 3"), "the line above the bars: {raw}");
    assert!(raw.contains('━'), "bars");
    for stale in ["step ", "━", "─ "] {
        let lines: Vec<_> = shown.lines().filter(|l| l.contains(stale) && !l.starts_with(['┌', '└'])).collect();
        assert!(lines.is_empty(), "{lines:?} in\n{shown}");
    }
    assert_eq!(shown.matches("train transition: 2,000 steps in").count(), 1, "{shown}");
    assert!(shown.contains("wider.hdf5"), "the result stays: {shown}");
    assert!(raw.contains("\u{1b}[1m"), "headings are bold");
    for (variables, bars) in [("NO_COLOR=1", true), ("TERM=dumb", false)] {
        fs::remove_dir_all(dir.path().join("runs")).unwrap();
        fs::remove_file(dir.path().join("wider.hdf5")).unwrap();
        let (bytes, shown) = on_terminal(dir.path(), &args, variables).unwrap();
        let raw = String::from_utf8_lossy(&bytes);
        assert_eq!(raw.contains('━'), bars, "{variables}: {raw}");
        assert!(!raw.contains("\u{1b}[1m") && !raw.contains("\u{1b}[3"), "{variables}: {raw:?}");
        assert!(shown.contains("train transition: 2,000 steps in"), "{variables}: {shown}");
    }
}
