//! A run's folder, as `tce run` and the runs of a sweep leave it: `done.json`, `config.toml`, `spec.json`, `metrics.jsonl`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;
use tce_base::{first_damaged, read_if_there, sha256_hex};

use crate::error::{ReportError, Result};

/// What to do about a damaged file of a run.
const AGAIN: &str = "remove the run's folder and run it again";

/// A finished run: one method on one task, one member per seed.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RunFolder {
    /// Where it is.
    pub directory: PathBuf,
    /// The program that made it.
    pub program: String,
    /// The processor that it ran on; empty where nobody noted it.
    #[serde(default)]
    pub machine: String,
    /// One member each.
    pub members: Vec<Member>,
    /// Seconds from data to scores, of all attempts, without stages that were there already.
    pub seconds: f64,
    /// Seconds of learning and evaluation, of all attempts and all members.
    pub learning_seconds: f64,
    /// Rows that joined the target rows.
    pub extra_rows: u64,
    /// Generated rows by member: sampled, and kept by the filter.
    pub generated: Vec<(u64, u64)>,
    /// SHA-256 of its files.
    pub files: BTreeMap<String, String>,
    /// The configuration, as `config.toml` has it.
    #[serde(skip)]
    pub config: String,
    /// The start of the configuration's SHA-256.
    pub config_hash: String,
    /// Whether the configuration asks for published, bug-compatible behaviour somewhere (`mode = "published"`).
    pub published: bool,
    /// What the run is keyed by in `spec.json`: SHA-256 of the data files, agent and shift.
    pub inputs: BTreeMap<String, String>,
    /// Figures during training, by member and by name.
    #[serde(skip)]
    pub curves: Vec<Curves>,
}

/// One seed of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Member {
    /// Its seed.
    pub seed: u64,
    /// What became of its policy.
    pub verdict: Verdict,
    /// Undiscounted returns of the episodes that evaluated it.
    pub returns: Vec<f64>,
    /// How many of these episodes ended because the physics became unstable.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub unstable: u64,
}

fn is_zero(count: &u64) -> bool {
    *count == 0
}

/// What an evaluation came to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The normalised score.
    Score(f64),
    /// The policy could not act to the end, and why.
    Diverged(String),
    /// Nobody looked: there was no simulator, or no reference returns.
    Unscored,
}

/// Figures of a member during training: by name, steps and values in ascending order of steps.
pub type Curves = BTreeMap<String, Vec<(f64, f64)>>;

/// A JSON file, and what it is asked for.
struct Document<'a> {
    path: &'a Path,
    root: Value,
}

impl<'a> Document<'a> {
    fn read(path: &'a Path) -> Result<Self> {
        let bytes = read_if_there(path)?.ok_or_else(|| ReportError::Nothing {
            path: path.to_owned(),
            what: format!("there is no such file; {AGAIN}"),
        })?;
        let root = serde_json::from_slice(&bytes)
            .map_err(|e| ReportError::field(path, "(the whole file)", e.to_string(), "JSON", AGAIN))?;
        Ok(Self { path, root })
    }

    fn wrong(&self, pointer: &str, expected: &str) -> ReportError {
        let found = match self.root.pointer(pointer) {
            None => "nothing".to_owned(),
            Some(value) => {
                let text = value.to_string();
                // The start is enough to recognise it by.
                if text.chars().count() > 60 { text.chars().take(57).chain("...".chars()).collect() } else { text }
            }
        };
        ReportError::field(self.path, pointer.trim_start_matches('/').replace('/', "."), found, expected, AGAIN)
    }

    fn get<'b, T>(&'b self, pointer: &str, expected: &str, f: impl FnOnce(&'b Value) -> Option<T>) -> Result<T> {
        self.root.pointer(pointer).and_then(f).ok_or_else(|| self.wrong(pointer, expected))
    }

    fn array(&self, pointer: &str) -> Result<&Vec<Value>> {
        self.get(pointer, "a list", Value::as_array)
    }

    fn seconds(&self, pointer: &str) -> Result<f64> {
        self.get(pointer, "seconds, a number from 0", |v| v.as_f64().filter(|s| *s >= 0.0))
    }

    fn strings(&self, pointer: &str) -> Result<BTreeMap<String, String>> {
        let map = self.get(pointer, "names and texts", Value::as_object)?;
        map.iter()
            .map(|(k, v)| match v.as_str() {
                Some(text) => Ok((k.clone(), text.to_owned())),
                None => Err(self.wrong(&format!("{pointer}/{}", k.replace('~', "~0").replace('/', "~1")), "a text")),
            })
            .collect()
    }
}

impl RunFolder {
    /// Reads the folder of a run; none if it is not finished.
    ///
    /// # Errors
    /// If a file is damaged: which one, where, and what was expected there.
    pub fn read(directory: &Path) -> Result<Option<Self>> {
        let path = directory.join("done.json");
        if !path.exists() {
            return Ok(None);
        }
        let done = Document::read(&path)?;
        let seeds = done.array("/summary/seeds")?;
        let scores = done.array("/summary/scores")?;
        let evaluations = done.array("/summary/learned/evaluations")?;
        for (name, list) in [("scores", scores), ("learned/evaluations", evaluations)] {
            if !(list.is_empty() || list.len() == seeds.len()) {
                let expected = format!("as many as seeds, {}, or none", seeds.len());
                let field = format!("summary.{}", name.replace('/', "."));
                return Err(ReportError::field(&path, field, format!("{} values", list.len()), expected, AGAIN));
            }
        }
        let members = (0..seeds.len()).map(|m| member(&done, m));
        let generated = done.array("/summary/generated")?;
        let rows = |m: usize, what: &str| {
            done.get(&format!("/summary/generated/{m}/{what}"), "a number of rows", Value::as_u64)
        };
        let generated = (0..generated.len()).map(|m| Ok((rows(m, "sampled")?, rows(m, "kept")?)));

        let config_path = directory.join("config.toml");
        let bytes = read_if_there(&config_path)?.ok_or_else(|| ReportError::Nothing {
            path: config_path.clone(),
            what: format!("there is no such file; {AGAIN}"),
        })?;
        let bad = |found: String| ReportError::field(&config_path, "(the whole file)", found, "TOML", AGAIN);
        let config = String::from_utf8(bytes).map_err(|e| bad(e.to_string()))?;
        let config_hash = config_hash(&config);
        let table: toml::Table = config.parse().map_err(|e: toml::de::Error| bad(e.message().to_owned()))?;

        let spec_path = directory.join("spec.json");
        let spec = Document::read(&spec_path)?;
        let inputs = spec.get("/spec/inputs", "agent, shift and hashes of the data", Value::as_object)?;
        let inputs = inputs.iter().filter_map(|(k, v)| Some((k.clone(), v.as_str()?.to_owned()))).collect();
        let members = members.collect::<Result<Vec<_>>>()?;
        Ok(Some(Self {
            directory: directory.to_owned(),
            program: done.get("/program", "the program's name", Value::as_str)?.to_owned(),
            machine: done.root.pointer("/machine").and_then(Value::as_str).unwrap_or_default().to_owned(),
            seconds: done.seconds("/summary/seconds")?,
            learning_seconds: done.seconds("/summary/learned/seconds")?,
            extra_rows: done.get("/summary/extra_rows", "a number of rows", Value::as_u64)?,
            generated: generated.collect::<Result<_>>()?,
            files: done.strings("/files")?,
            published: published(&toml::Value::Table(table)),
            config,
            config_hash,
            inputs,
            curves: curves(&directory.join("metrics.jsonl"), members.len())?,
            members,
        }))
    }

    /// The first file that is not what `done.json` says it was.
    pub fn damage(&self) -> Option<String> {
        first_damaged(&self.directory, &self.files)
    }
}

/// Member `m`. The lists of scores and evaluations are empty where nobody evaluated.
fn member(done: &Document<'_>, m: usize) -> Result<Member> {
    let filled = |list: &str| done.array(list).map(|l| !l.is_empty());
    let seed = done.get(&format!("/summary/seeds/{m}"), "a whole number from 0", Value::as_u64)?;
    let number = "a finite number, or null where the policy could not be evaluated";
    let score = match filled("/summary/scores")? {
        true => done.get(&format!("/summary/scores/{m}"), number, |v| match v {
            Value::Null => Some(None),
            v => v.as_f64().filter(|s| s.is_finite()).map(Some),
        })?,
        false => None,
    };
    let at = |rest: &str| format!("/summary/learned/evaluations/{m}/{rest}");
    let evaluated = filled("/summary/learned/evaluations")?;
    let failed = done.root.pointer(&at("failed")).and_then(Value::as_str).filter(|_| evaluated);
    let returns = match evaluated {
        true => done.get(&at("returns"), "a list of numbers", |v| {
            v.as_array()?.iter().map(Value::as_f64).collect::<Option<Vec<_>>>()
        })?,
        false => Vec::new(),
    };
    let verdict = match (score, failed) {
        (Some(score), _) => Verdict::Score(score),
        (None, Some(why)) => Verdict::Diverged(why.to_owned()),
        (None, None) => Verdict::Unscored,
    };
    let unstable = done.root.pointer(&at("unstable")).and_then(Value::as_u64).unwrap_or(0);
    Ok(Member { seed, verdict, returns, unstable })
}

/// The start of a configuration's SHA-256.
pub(crate) fn config_hash(config: &str) -> String {
    sha256_hex(with_old_names(config).as_bytes())[..16].to_owned()
}

/// A configuration as earlier versions wrote it, so that equal settings have equal hashes: `[single_stage]` was `[joint]`.
fn with_old_names(config: &str) -> String {
    config.replace("\n[single_stage", "\n[joint")
}

/// Whether `mode = "published"` stands anywhere.
fn published(value: &toml::Value) -> bool {
    match value {
        toml::Value::Table(table) => {
            table.iter().any(|(k, v)| k == "mode" && v.as_str() == Some("published") || published(v))
        }
        toml::Value::Array(list) => list.iter().any(published),
        _ => false,
    }
}

/// Metrics are for eyes and no part of the result: a run without them, or with a line cut off at the end, is whole.
fn curves(path: &Path, members: usize) -> Result<Vec<Curves>> {
    let bytes = read_if_there(path)?.unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let mut curves = vec![Curves::new(); members];
    let lines: Vec<&str> = text.lines().collect();
    for (n, line) in lines.iter().enumerate() {
        let value: Value = match serde_json::from_str(line) {
            Ok(value) => value,
            Err(_) if n + 1 == lines.len() => break,
            Err(e) => {
                let field = format!("(line {})", n + 1);
                return Err(ReportError::field(
                    path,
                    field,
                    e.to_string(),
                    "one JSON object a line",
                    "remove the file",
                ));
            }
        };
        let wrong = |field: &str, expected: &str| {
            let found = value.get(field).map_or_else(|| "nothing".into(), Value::to_string);
            ReportError::field(path, format!("{field} (line {})", n + 1), found, expected, "remove the file")
        };
        let stage = value["stage"].as_str().ok_or_else(|| wrong("stage", "a text"))?;
        let step = value["step"].as_f64().ok_or_else(|| wrong("step", "a number of steps"))?;
        let member = value["member"].as_u64().and_then(|m| usize::try_from(m).ok()).filter(|m| *m < members);
        let member = member.ok_or_else(|| wrong("member", &format!("a number below {members}")))?;
        for (name, figure) in value.as_object().into_iter().flatten() {
            if matches!(name.as_str(), "stage" | "step" | "member") {
                continue;
            }
            if let Some(figure) = figure.as_f64() {
                curves[member].entry(format!("{stage}/{name}")).or_default().push((step, figure));
            }
        }
    }
    for points in curves.iter_mut().flat_map(BTreeMap::values_mut) {
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        points.dedup_by(|later, first| later.0 == first.0);
    }
    Ok(curves)
}
