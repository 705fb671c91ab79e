//! `tce config show`.

use clap::{Args, Subcommand};
use serde::Serialize;
use tce_data::Task;
use tce_run::error::{Error, Result};
use tce_run::keys::{Explanation, explain, presets, schema, table as table_of};
use tce_run::layers::ConfigArgs;
use tce_run::variant::Variant;

use crate::output::{Output, heading, list, table};

/// Show the configuration.
#[derive(Debug, Subcommand)]
pub enum Config {
    /// Show every setting, its value, and the layer it comes from; or explain one.
    Show(Show),
}

/// Arguments of `show`.
#[derive(Debug, Args)]
pub struct Show {
    /// A key to be explained (generator.y_max), or a table whose keys are shown (learner.iql); and the task, for the paper's
    /// task-specific values.
    #[arg(value_name = "KEY or TASK", num_args = 0..=2, value_parser = subject)]
    about: Vec<Subject>,
    /// The variant whose changes are to be included.
    #[arg(long, value_enum)]
    variant: Option<Variant>,
    #[command(flatten)]
    config: ConfigArgs,
}

/// What is asked for.
#[derive(Clone, Debug)]
enum Subject {
    Task(Task),
    Key(String),
}

/// A task has a slash (or, in its first form, a colon), a key has neither.
fn subject(text: &str) -> std::result::Result<Subject, String> {
    match text.parse::<Task>() {
        Ok(task) => Ok(Subject::Task(task)),
        Err(e) if text.contains([':', '/']) => Err(e.to_string()),
        Err(_) => Ok(Subject::Key(text.trim_end_matches('.').to_owned())),
    }
}

#[derive(Serialize)]
struct Entry {
    key: String,
    value: String,
    from: String,
}

impl Config {
    /// Runs the subcommand.
    pub fn run(self, output: Output) -> Result<()> {
        let Config::Show(args) = self;
        let (mut task, mut key) = (None, None);
        for about in args.about {
            match about {
                Subject::Task(t) if task.is_none() => task = Some(t),
                Subject::Key(k) if key.is_none() => key = Some(k),
                _ => {
                    return Err(Error::Usage(
                        "config show: found two keys or two tasks, expected one of each at most".into(),
                    ));
                }
            }
        }
        let layered = args.config.layered(task, args.variant)?;
        // A configuration that does not hold together is refused, not shown.
        layered.config()?;
        let entries = layered.values().into_iter().map(|(key, value, from)| Entry { key, value, from });
        let Some(key) = key else {
            output.print(&entries.collect::<Vec<_>>(), |entries| show(entries));
            return Ok(());
        };
        let schema = schema();
        if let Some(explanation) = explain(&layered, &presets()?, &schema, &key) {
            output.print(&explanation, render);
            return Ok(());
        }
        let below: Vec<_> =
            entries.filter(|e| e.key.strip_prefix(&key).is_some_and(|rest| rest.starts_with('.'))).collect();
        if below.is_empty() {
            return Err(Error::Usage(format!(
                "{key}: no key, and no table of keys; `tce config show` lists all of them"
            )));
        }
        let what = table_of(&schema, &key).unwrap_or_default();
        output.print(&below, |below| format!("{}: {what}\n{}", heading(&key), show(below)));
        Ok(())
    }
}

fn show(entries: &[Entry]) -> String {
    table(&["key", "value", "from"], entries.iter().map(|e| [e.key.clone(), e.value.clone(), e.from.clone()]))
}

fn render(e: &Explanation) -> String {
    let presets = e.presets.iter().map(|(name, v)| match v {
        Some(value) => format!("{name} {value}"),
        None => format!("{name} has no such key"),
    });
    let mut header = vec!["key", "what it does", "value", "from", "in presets", "type", "range", "source"];
    let mut row = vec![
        e.key.clone(),
        e.what.clone(),
        e.value.clone(),
        e.from.clone(),
        presets.collect::<Vec<_>>().join(", "),
        e.kind.clone(),
        e.range.clone().unwrap_or_default(),
        e.source.clone().unwrap_or_default(),
    ];
    for (preset, note) in &e.notes {
        header.push("note");
        row.push(format!("{note} (in preset {preset})"));
    }
    for (word, what) in &e.choices {
        header.push(word);
        row.push(what.clone());
    }
    // As a shell takes it.
    let change = match e.value.trim_matches('"') {
        value if value.contains([' ', '"', '{']) => format!("--set '{}={value}'", e.key),
        value => format!("--set {}={value}", e.key),
    };
    header.push("to change it");
    row.push(change);
    list(&header, [row])
}
