//! What a message says of a configuration's key or value that is wrong.

use tce_base::{did_you_mean, nearest};
use toml::{Table, Value};

/// What to say of an unknown `key` below `prefix`: a key beside it (`siblings`) that is much like it, or one of that very
/// name elsewhere in `all`.
pub fn did_you_mean_key(key: &str, prefix: &str, siblings: &[&str], all: &Table) -> String {
    if let Some(near) = nearest(key, siblings.iter().copied()) {
        let near = if prefix.is_empty() { near.to_owned() } else { format!("{prefix}.{near}") };
        return format!("; did you mean `{near}`?");
    }
    let mut elsewhere = Vec::new();
    keys_called(key, all, "", &mut elsewhere);
    match &elsewhere[..] {
        [] => String::new(),
        [one] => format!("; did you mean `{one}`?"),
        several => format!("; there is `{}`", several.join("`, `")),
    }
}

/// Whole names of the keys below `table` whose last part is `key`.
fn keys_called(key: &str, table: &Table, prefix: &str, found: &mut Vec<String>) {
    for (name, value) in table {
        let path = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
        if name == key {
            found.push(path.clone());
        }
        if let Value::Table(inner) = value {
            keys_called(key, inner, &path, found);
        }
    }
}

/// serde's words about a value of the wrong type or name, without Rust's names of types.
pub fn in_words(reason: &str) -> String {
    if let Some(rest) = reason.strip_prefix("unknown variant `")
        && let Some((found, expected)) = rest.split_once("`, expected ")
    {
        let known: Vec<&str> = expected.split('`').skip(1).step_by(2).collect();
        return format!("found `{found}`, expected {}{}", one_of(&known), did_you_mean(found, known.iter().copied()));
    }
    if let Some(rest) = reason.strip_prefix("unknown field `")
        && let Some((found, expected)) = rest.split_once("`, expected ")
    {
        let known: Vec<&str> = expected.split('`').skip(1).step_by(2).collect();
        let hint = did_you_mean(found, known.iter().copied());
        return format!("unknown key `{found}`, expected {}{hint}", one_of(&known));
    }
    let wrong = reason.strip_prefix("invalid type: ").or_else(|| reason.strip_prefix("invalid value: "));
    let Some((found, expected)) = wrong.and_then(|r| r.rsplit_once(", expected ")) else { return reason.to_owned() };
    let expected = match expected {
        "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number, not below 0",
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
        "f32" | "f64" => "a number",
        "a boolean" => "true or false",
        "a sequence" => "a list, as in [256, 256]",
        other => other,
    };
    let plain = [
        ("string ", ""),
        ("integer ", ""),
        ("floating point ", ""),
        ("boolean ", ""),
        ("sequence", "a list"),
        ("map", "a table"),
    ];
    let found = plain.iter().find_map(|(rust, words)| found.strip_prefix(rust).map(|rest| format!("{words}{rest}")));
    format!("found {}, expected {expected}", found.as_deref().unwrap_or("a value of another kind"))
}

fn one_of(known: &[&str]) -> String {
    match known {
        [one] => format!("`{one}`"),
        several => format!("one of {}", several.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_are_words() {
        for (reason, expected) in [
            ("invalid type: string \"many\", expected u64", "found \"many\", expected a whole number, not below 0"),
            ("invalid value: integer `-5`, expected u64", "found `-5`, expected a whole number, not below 0"),
            ("invalid type: floating point `2.5`, expected usize", "found `2.5`, expected a whole number, not below 0"),
            ("invalid type: string \"maybe\", expected a boolean", "found \"maybe\", expected true or false"),
            ("invalid type: integer `3`, expected a sequence", "found `3`, expected a list, as in [256, 256]"),
            (
                "unknown variant `td3bc`, expected one of `bc`, `td3-bc`",
                "found `td3bc`, expected one of bc, td3-bc; did you mean `td3-bc`?",
            ),
            ("unknown variant `x`, expected `a` or `b`", "found `x`, expected one of a, b"),
            ("missing field `kind`", "missing field `kind`"),
        ] {
            assert_eq!(in_words(reason), expected);
        }
    }

    #[test]
    fn a_key_is_found_beside_and_elsewhere() {
        let all: Table = "[learner]\nsteps = 1\nbatch = 2\n[labels.training]\nsteps = 3\nlr = 4.0".parse().unwrap();
        let hint = |key: &str, prefix: &str, siblings: &[&str]| did_you_mean_key(key, prefix, siblings, &all);
        assert_eq!(hint("step", "learner", &["steps", "batch"]), "; did you mean `learner.steps`?");
        assert_eq!(hint("lr", "", &["learner", "labels"]), "; did you mean `labels.training.lr`?");
        assert_eq!(hint("steps", "", &["learner", "labels"]), "; there is `labels.training.steps`, `learner.steps`");
        assert_eq!(hint("frog", "", &["learner", "labels"]), "");
    }
}
