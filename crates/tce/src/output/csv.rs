//! The rows of a JSON document as CSV.
//!
//! The rows are the items of the document, where it is a list; the items of the member that holds the rows ([`ROWS`]), where it has one; and
//! otherwise the document is one row. An object in a row is spread over columns, `card.mean` for the member `mean` of `card`; a list stays
//! JSON text in its cell; what is null, or missing in a row, is an empty cell. Single values beside the rows (the task, say) are repeated in
//! each of them. Columns stand in the order in which they first come.

use std::fmt;

use serde::de::{MapAccess, SeqAccess, Visitor};
use serde::ser::{SerializeMap, SerializeSeq};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;

/// The members of documents that hold rows.
const ROWS: [&str; 6] = ["rows", "policies", "workloads", "arrays", "bounds_of_y", "methods"];

/// JSON whose objects keep the order of their members, which `serde_json::Value` does not.
#[derive(Clone, Debug)]
enum Json {
    Object(Vec<(String, Json)>),
    List(Vec<Json>),
    Single(Value),
}

impl<'de> Deserialize<'de> for Json {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Json;
            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("JSON")
            }
            fn visit_unit<E>(self) -> Result<Json, E> {
                Ok(Json::Single(Value::Null))
            }
            fn visit_bool<E>(self, v: bool) -> Result<Json, E> {
                Ok(Json::Single(v.into()))
            }
            fn visit_u64<E>(self, v: u64) -> Result<Json, E> {
                Ok(Json::Single(v.into()))
            }
            fn visit_i64<E>(self, v: i64) -> Result<Json, E> {
                Ok(Json::Single(v.into()))
            }
            fn visit_f64<E>(self, v: f64) -> Result<Json, E> {
                Ok(Json::Single(v.into()))
            }
            fn visit_str<E>(self, v: &str) -> Result<Json, E> {
                Ok(Json::Single(v.into()))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Json, A::Error> {
                let mut list = Vec::new();
                while let Some(item) = items.next_element()? {
                    list.push(item);
                }
                Ok(Json::List(list))
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Json, A::Error> {
                let mut members = Vec::new();
                while let Some(member) = map.next_entry()? {
                    members.push(member);
                }
                Ok(Json::Object(members))
            }
        }
        from.deserialize_any(Any)
    }
}

impl Serialize for Json {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self {
            Json::Object(members) => {
                let mut map = to.serialize_map(Some(members.len()))?;
                members.iter().try_for_each(|(name, value)| map.serialize_entry(name, value))?;
                map.end()
            }
            Json::List(items) => {
                let mut list = to.serialize_seq(Some(items.len()))?;
                items.iter().try_for_each(|item| list.serialize_element(item))?;
                list.end()
            }
            Json::Single(value) => value.serialize(to),
        }
    }
}

/// `json`, a document, as CSV.
pub fn of(json: &str) -> String {
    let document = serde_json::from_str(json).expect("results are JSON");
    let (beside, rows) = rows(document);
    let mut header: Vec<String> = Vec::new();
    let mut lines = Vec::new();
    for row in rows {
        let mut own = Vec::new();
        spread("", row, &mut own);
        let mut cells = beside.clone();
        cells.retain(|(name, _)| own.iter().all(|(other, _)| other != name));
        cells.extend(own);
        for (name, _) in &cells {
            if !header.contains(name) {
                header.push(name.clone());
            }
        }
        lines.push(cells);
    }
    if header.is_empty() {
        return String::new();
    }
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(&header).expect("memory takes everything");
    for cells in &lines {
        let cell = |name: &String| cells.iter().find(|(n, _)| n == name).map_or("", |(_, value)| value);
        writer.write_record(header.iter().map(cell)).expect("memory takes everything");
    }
    let bytes = writer.into_inner().expect("memory takes everything");
    String::from_utf8(bytes).expect("made of text")
}

/// The single values beside the rows, and the rows.
fn rows(document: Json) -> (Vec<(String, String)>, Vec<Json>) {
    let members = match document {
        Json::List(items) => return (Vec::new(), items),
        Json::Single(_) => return (Vec::new(), vec![document]),
        Json::Object(members) => members,
    };
    let objects = |json: &Json| match json {
        Json::List(items) if items.iter().all(|i| matches!(i, Json::Object(_))) => Some(items.clone()),
        _ => None,
    };
    let found =
        ROWS.iter().find_map(|name| members.iter().find(|(n, _)| n == name).and_then(|(_, json)| objects(json)));
    match found {
        Some(rows) => {
            let single = members.into_iter().filter(|(_, v)| matches!(v, Json::Single(_)));
            (single.map(|(name, v)| (name, cell(&v))).collect(), rows)
        }
        None => (Vec::new(), vec![Json::Object(members)]),
    }
}

/// Adds the cells of a row; `path` stands before their names.
fn spread(path: &str, row: Json, cells: &mut Vec<(String, String)>) {
    match row {
        Json::Object(members) if !members.is_empty() => {
            for (name, value) in members {
                let path = if path.is_empty() { name } else { format!("{path}.{name}") };
                spread(&path, value, cells);
            }
        }
        other => cells.push((if path.is_empty() { "value".into() } else { path.to_owned() }, cell(&other))),
    }
}

/// A value as a cell: texts without their quotes, lists as they are.
fn cell(json: &Json) -> String {
    match json {
        Json::Single(Value::Null) => String::new(),
        Json::Single(Value::String(text)) => text.clone(),
        other => serde_json::to_string(other).expect("it was JSON"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_is_a_row_for_each_item() {
        let json = r#"[{"name":"a, b","card":{"mean":1.5,"notes":[1,"x"]},"score":null},{"name":"c","new":true}]"#;
        let expected = "name,card.mean,card.notes,score,new\n\"a, b\",1.5,\"[1,\"\"x\"\"]\",,\nc,,,,true\n";
        assert_eq!(of(json), expected);
    }

    #[test]
    fn single_values_beside_the_rows_are_repeated() {
        let json = r#"{"task":"hopper","source":{"mean":1},"rows":[{"title":"BC","task":"own"},{"title":"IQL"}],"verdict":[]}"#;
        assert_eq!(of(json), "title,task\nBC,own\nIQL,hopper\n");
    }

    #[test]
    fn anything_else_is_one_row_or_values() {
        assert_eq!(of(r#"{"policies":["a"],"seeds":[0,1]}"#), "policies,seeds\n\"[\"\"a\"\"]\",\"[0,1]\"\n");
        assert_eq!(of(r#"["a","b"]"#), "value\na\nb\n");
        assert_eq!(of("[]"), "");
    }
}
