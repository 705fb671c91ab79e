//! Explanations of configuration keys. They come from doc comments and ranges of the fields ([`Config`], read by `schemars`), from the
//! presets, and from comments in the presets.

use serde::Serialize;
use serde_json::Value;

use crate::config::Config;
use crate::error::Result;
use crate::layers::{Layered, Preset};

/// The explanation of a key.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Explanation {
    /// The key.
    pub key: String,
    /// Its value.
    pub value: String,
    /// The layer that set it.
    pub from: String,
    /// Its value in every preset; None where a preset has no such key.
    pub presets: Vec<(&'static str, Option<String>)>,
    /// The type of its values, in words.
    pub kind: String,
    /// The words that it accepts, with their meaning.
    pub choices: Vec<(String, String)>,
    /// The range of its numbers; None where the type says all.
    pub range: Option<String>,
    /// What it does.
    pub what: String,
    /// Origin of its value: a table or equation of the paper, a method's authors, or our own.
    pub source: Option<String>,
    /// Comments of presets on its value or its table, with the preset.
    pub notes: Vec<(&'static str, String)>,
}

/// The schema of [`Config`].
pub fn schema() -> Value {
    let settings = schemars::generate::SchemaSettings::default().with(|s| s.inline_subschemas = true);
    settings.into_generator().into_root_schema_for::<Config>().to_value()
}

/// Explains `key`, which has a value in `layered`; None where it has none. `presets` are the layers of the presets alone.
pub fn explain(layered: &Layered, presets: &[(Preset, Layered)], schema: &Value, key: &str) -> Option<Explanation> {
    let values = layered.values();
    let (_, value, from) = values.iter().find(|(k, ..)| k == key)?.clone();
    let value_of = |key: &str| values.iter().find(|(k, ..)| k == key).map(|(_, v, _)| v.trim_matches('"').to_owned());
    let (mut node, mut path) = (schema, String::new());
    // What a table with a kind says of the kind stands with the table.
    let mut table = schema;
    for part in key.split('.') {
        let kind = value_of(&format!("{path}kind"));
        table = node;
        node = match variants(node) {
            Some(variants) if part != "kind" => {
                let of_kind = |v: &&Value| v["properties"]["kind"]["const"].as_str() == kind.as_deref();
                &variants.iter().find(of_kind)?["properties"][part]
            }
            Some(_) => node,
            None => &node["properties"][part],
        };
        path = format!("{path}{part}.");
    }
    let is_kind = variants(node).is_some() && std::ptr::eq(node, table);
    let (what, source) = sentences(node["description"].as_str()?);
    let choices = if is_kind { kinds(node) } else { choices(node) };
    let in_preset = |l: &Layered| l.values().into_iter().find(|(k, ..)| k == key).map(|(_, v, _)| v);
    let texts = Preset::ALL.map(|p| (p.name(), notes(p.text(), key)));
    Some(Explanation {
        key: key.to_owned(),
        value,
        from,
        presets: presets.iter().map(|(p, l)| (p.name(), in_preset(l))).collect(),
        kind: if choices.is_empty() { kind(node) } else { "one of the words below".into() },
        choices,
        range: range(node),
        what,
        source,
        notes: texts.into_iter().flat_map(|(name, all)| all.into_iter().map(move |note| (name, note))).collect(),
    })
}

/// What the table `prefix` is for.
pub fn table(schema: &Value, prefix: &str) -> Option<String> {
    let node = prefix.split('.').try_fold(schema, |node, part| node["properties"].get(part))?;
    node["description"].as_str().map(|text| sentences(text).0)
}

/// The presets alone.
///
/// # Errors
/// None: they come with the program.
pub fn presets() -> Result<Vec<(Preset, Layered)>> {
    Preset::ALL.into_iter().map(|p| Ok((p, Layered::new(p, None, None, None, &[])?))).collect()
}

/// The forms of a table with a `kind`.
fn variants(node: &Value) -> Option<&Vec<Value>> {
    let all = node["oneOf"].as_array()?;
    all.iter().all(|v| v["properties"]["kind"].is_object()).then_some(all)
}

fn kinds(node: &Value) -> Vec<(String, String)> {
    let one = |v: &Value| {
        let word = v["properties"]["kind"]["const"].as_str()?.to_owned();
        Some((word, v["description"].as_str().map_or_else(String::new, |d| sentences(d).0)))
    };
    variants(node).into_iter().flatten().filter_map(one).collect()
}

/// The words of an enumeration.
fn choices(node: &Value) -> Vec<(String, String)> {
    let plain =
        node["enum"].as_array().into_iter().flatten().filter_map(|v| Some((v.as_str()?.to_owned(), String::new())));
    let described = node["oneOf"].as_array().into_iter().flatten().flat_map(|v| {
        let words =
            v["const"].as_str().into_iter().chain(v["enum"].as_array().into_iter().flatten().filter_map(Value::as_str));
        let what = v["description"].as_str().map_or_else(String::new, |d| sentences(d).0);
        words.map(move |word| (word.to_owned(), what.clone())).collect::<Vec<_>>()
    });
    plain.chain(described).collect()
}

/// A type in words.
fn kind(node: &Value) -> String {
    if let Some(all) = node["anyOf"].as_array() {
        return all.iter().map(kind).collect::<Vec<_>>().join(", or ");
    }
    if let Some(word) = node["const"].as_str() {
        return format!("{word:?}");
    }
    match node["type"].as_str() {
        Some("integer") => "a whole number".into(),
        Some("number") => "a number".into(),
        Some("boolean") => "true or false".into(),
        Some("string") => "a text".into(),
        Some("array") => format!("a list, each item {}", kind(&node["items"])),
        _ => "a value".into(),
    }
}

fn range(node: &Value) -> Option<String> {
    let number = |key: &str| node[key].as_f64().map(plain);
    if node["minimum"].as_f64() == Some(0.0) && node.get("maximum").is_none() {
        return Some("0 or more".into());
    }
    match (number("minimum"), number("maximum"), number("exclusiveMinimum")) {
        (Some(low), Some(high), _) => Some(format!("{low} to {high}")),
        (Some(low), None, _) => Some(format!("{low} or more")),
        (None, high, Some(low)) => {
            Some(high.map_or(format!("more than {low}"), |h| format!("more than {low}, up to {h}")))
        }
        (None, Some(high), None) => Some(format!("up to {high}")),
        (None, None, None) => None,
    }
}

fn plain(x: f64) -> String {
    if x.abs() >= 1e7 { format!("{x:e}") } else { x.to_string() }
}

/// The text of a comment before and after `Source:`.
fn sentences(description: &str) -> (String, Option<String>) {
    // Links and line breaks are for rustdoc, and so is everything after the first paragraph.
    let first = description.split("\n\n").next().unwrap_or_default();
    let text = first.split_whitespace().collect::<Vec<_>>().join(" ").replace("[`", "`").replace("`]", "`");
    match text.split_once(" Source: ") {
        Some((what, source)) => (what.to_owned(), Some(source.trim_end_matches('.').to_owned())),
        None => (text, None),
    }
}

/// The comment of a preset's file on the value of `key`, or on its table.
fn notes(toml: &str, key: &str) -> Vec<String> {
    let (mut table, mut last) = (String::new(), String::new());
    let mut found: Vec<(String, String)> = Vec::new();
    for line in toml.lines() {
        let (code, comment) = line.split_once('#').map_or((line, ""), |(code, comment)| (code, comment.trim()));
        let code = code.trim();
        if let Some(name) = code.strip_prefix('[').and_then(|c| c.strip_suffix(']')) {
            table = name.to_owned();
            last = table.clone();
        } else if let Some((name, _)) = code.split_once('=') {
            last = format!("{table}.{}", name.trim());
        } else if !line.starts_with(' ') {
            // A comment of its own belongs to no key; one that stands in goes on with the line before.
            last.clear();
        }
        if !comment.is_empty() && !last.is_empty() {
            match found.last_mut().filter(|(of, _)| code.is_empty() && *of == last) {
                Some((_, text)) => *text += &format!(" {comment}"),
                None => found.push((last.clone(), comment.to_owned())),
            }
        }
    }
    let above = |of: &str| key == of || key.strip_prefix(of).is_some_and(|rest| rest.starts_with('.'));
    found.into_iter().filter(|(of, _)| above(of)).map(|(_, text)| text).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::variant::Variant;
    use clap::ValueEnum;

    #[test]
    fn every_key_is_explained() {
        let (schema, presets) = (schema(), presets().unwrap());
        let variants =
            Variant::value_variants().iter().map(|v| Layered::new(Preset::Default, None, Some(*v), None, &[]).unwrap());
        let kinds = [
            "generator.process={kind=\"vp\"}",
            "generator.sampler={kind=\"heun\",steps=9}",
            "generator.sampler={kind=\"dpm-solver\",steps=9}",
            "generator.sampler={kind=\"euler-maruyama\",steps=9}",
        ];
        let kinds = kinds.map(|set| Layered::new(Preset::Default, None, None, None, &[set.to_owned()]).unwrap());
        for layered in presets.iter().map(|(_, l)| l.clone()).chain(variants).chain(kinds) {
            for (key, ..) in layered.values() {
                let e = explain(&layered, &presets, &schema, &key).unwrap_or_else(|| panic!("{key}: no explanation"));
                assert!(e.what.len() > 15 && e.what.ends_with('.'), "{key}: {:?}", e.what);
                assert_ne!(e.kind, "a value", "{key}");
                for (word, what) in &e.choices {
                    assert!(!what.is_empty(), "{key}: {word} is not explained");
                }
            }
        }
    }

    /// The ranges that are told are those that are kept: a value a little outside of them is refused.
    #[test]
    fn ranges_are_kept() {
        let (schema, presets) = (schema(), presets().unwrap());
        let node = |key: &str| key.split('.').fold(&schema, |node, part| &node["properties"][part]).clone();
        let (_, layered) = &presets[1];
        let mut limits = 0;
        for (key, value, _) in layered.values() {
            let whole = value.parse::<i64>().is_ok();
            let refused = |v: f64| {
                let set = if whole { format!("{key}={}", v as i64) } else { format!("{key}={v:?}") };
                Layered::new(Preset::Default, None, None, None, &[set]).and_then(|l| l.config()).is_err()
            };
            // An algorithm is checked where it is the one that is trained.
            let node = node(&key);
            let step = |limit: f64| if whole { 1.0 } else { 1e-3 * limit.abs().max(1e-3) };
            for (limit, sign) in [("minimum", -1.0), ("maximum", 1.0), ("exclusiveMinimum", -1.0)] {
                let Some(limit) = node[limit].as_f64().filter(|l| l.abs() < 1e15) else { continue };
                limits += 1;
                assert!(refused(limit + sign * step(limit)), "{key}: {} is taken", limit + sign * step(limit));
            }
        }
        assert!(limits > 100, "{limits}");
    }

    #[test]
    fn a_key_tells_its_type_range_source_and_notes() {
        let (schema, presets) = (schema(), presets().unwrap());
        let sets = ["generator.y_max=0.1".to_owned()];
        let layered = Layered::new(Preset::Quick, None, None, None, &sets).unwrap();
        let explain = |key: &str| explain(&layered, &presets, &schema, key).unwrap();
        let e = explain("generator.y_max");
        assert_eq!((e.value.as_str(), e.from.as_str()), ("0.1", "--set generator.y_max=0.1"));
        assert_eq!((e.kind.as_str(), e.range.as_deref()), ("a number", Some("0 to 1")));
        assert_eq!(e.source.as_deref(), Some("Table C.5"));
        assert_eq!(e.notes, [("default", "ŷ ~ U(0, y_max) [C.5]".to_owned())]);
        assert_eq!(e.presets, ["paper", "default", "quick"].map(|p| (p, Some("0.2".to_owned()))));
        let e = explain("generator.process.sigma_max");
        assert_eq!(e.presets[0], ("paper", None), "the paper has another process");
        let e = explain("generator.process.kind");
        assert!(e.choices.iter().any(|(word, _)| word == "ve"), "{:?}", e.choices);
        let e = explain("learner.iql.policy_extraction");
        assert!(e.choices.iter().any(|(word, what)| word == "awr_mse" && !what.is_empty()), "{:?}", e.choices);
        assert_eq!(explain("generator.state_steps").kind, "a whole number, or \"auto\"");
        assert_eq!(explain("learner.iql.hidden").kind, "a list, each item a whole number");
        let advantage = explain("learner.iql.advantage").notes;
        assert!(advantage[0].1.ends_with("and a third are dead"), "{advantage:?}");
    }
}
