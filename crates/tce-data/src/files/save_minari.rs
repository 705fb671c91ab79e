//! Writes [`Transitions`] to a folder that `minari.load_dataset` reads.

use std::ops::Range;
use std::path::Path;

use hdf5_pure::{AttrValue, FileBuilder};
use tce_base::{AtomicFile, AtomicFolder, write_json};

use super::episodes::continued;
use super::save::{boolean, finish};
use crate::{ActionRange, DataError, Problem, Transitions};

/// Minari 0.5 reads this version.
const VERSION: &str = "0.5.0";

/// Writes `data` as the Minari data set `id` (`robot/task-v0`) into the folder `path`: `data/main_data.hdf5` and
/// `data/metadata.json`. Minari finds it if `path` is its `MINARI_DATASETS_PATH` followed by `id`. `range` is the range
/// of the action space; `None`: [-1, 1].
///
/// Every episode is a group. The layout has one state between two rows, so an episode is cut where s' is not the next
/// row's state ([`continued`]): rows without order, such as generated rows, become episodes of a single step, and every
/// s' is written, up to rounding. The layout does not say which successors are known: a row without one
/// ([`Transitions::known`]) is terminal, and its s' is written as it is here, equal to s.
///
/// The folder is complete or absent; existing files are never replaced.
///
/// # Errors
/// No rows; an existing folder; a full disk.
pub fn save_minari(path: &Path, id: &str, data: &Transitions, range: Option<&ActionRange>) -> Result<(), DataError> {
    let refuse = |found: String, expected: &str| {
        let advice = "Nothing was written; choose another name, or remove what is there";
        Err(DataError::invalid(Problem::Value, path, "file", found, expected, advice))
    };
    if path.exists() {
        return refuse("something is there already".into(), "a new folder");
    }
    if data.is_empty() {
        return refuse("no rows to write".into(), "at least one row");
    }
    let whole = AtomicFolder::create(path)?;
    let folder = whole.path().join("data");

    let mut builder = FileBuilder::new();
    let boolean = boolean();
    let (d, a) = (data.obs_dim, data.act_dim);
    let episodes = pieces(data);
    for (k, rows) in episodes.iter().enumerate() {
        let n = rows.len();
        let mut states = data.observations[rows.start * d..rows.end * d].to_vec();
        states.extend_from_slice(data.next_observation(rows.end - 1));
        let mut group = builder.create_group(&format!("episode_{k}"));
        group.set_attr("id", AttrValue::I64(k as i64));
        group.set_attr("total_steps", AttrValue::I64(n as i64));
        group.create_dataset("observations").with_f32_data(&states).with_shape(&[n as u64 + 1, d as u64]);
        let actions = &data.actions[rows.start * a..rows.end * a];
        group.create_dataset("actions").with_f32_data(actions).with_shape(&[n as u64, a as u64]);
        group.create_dataset("rewards").with_f32_data(&data.rewards[rows.clone()]);
        let truncations: Vec<bool> = rows.clone().map(|i| i + 1 == rows.end && !data.terminals[i]).collect();
        for (name, flags) in [("terminations", &data.terminals[rows.clone()]), ("truncations", &truncations)] {
            let bytes = flags.iter().map(|&f| u8::from(f)).collect();
            group.create_dataset(name).with_raw_data(boolean.clone(), bytes, n as u64);
        }
        builder.add_group(group.finish());
    }
    let mut file = AtomicFile::create(&folder.join("main_data.hdf5"))?;
    finish(builder, file.file(), path)?;
    file.commit()?;
    let (low, high) = match range {
        Some(range) => (range.low.clone(), range.high.clone()),
        None => (vec![-1.0; a], vec![1.0; a]),
    };
    write_json(
        &folder.join("metadata.json"),
        &serde_json::json!({
            "total_episodes": episodes.len(),
            "total_steps": data.len(),
            "data_format": "hdf5",
            "jpeg_encoding": false,
            "observation_space": space(&vec!["-Infinity"; d], &vec!["Infinity"; d]),
            "action_space": space(&words(&low), &words(&high)),
            "dataset_size": data.len() as f64 * (d + a + 2) as f64 * 4e-6,
            "dataset_id": id,
            "algorithm_name": "tce",
            "minari_version": VERSION,
        }),
    )?;
    Ok(whole.commit()?)
}

/// The longest runs of rows in which every row but the last is continued by the next one.
fn pieces(data: &Transitions) -> Vec<Range<usize>> {
    let (mut pieces, mut start) = (Vec::new(), 0);
    for (i, continues) in continued(data).into_iter().enumerate() {
        // Nothing continues the last row.
        if !continues {
            pieces.push(start..i + 1);
            start = i + 1;
        }
    }
    pieces
}

fn words(values: &[f32]) -> Vec<String> {
    values.iter().map(|v| format!("{v:?}")).collect()
}

/// A Box of float32 in the form of Minari's `serialize_space`: JSON with Python's `Infinity`.
fn space(low: &[impl AsRef<str>], high: &[impl AsRef<str>]) -> String {
    let list = |v: &[&str]| v.join(", ");
    let (n, low): (usize, Vec<&str>) = (low.len(), low.iter().map(AsRef::as_ref).collect());
    let high: Vec<&str> = high.iter().map(AsRef::as_ref).collect();
    format!(
        r#"{{"type": "Box", "dtype": "float32", "shape": [{n}], "low": [{}], "high": [{}]}}"#,
        list(&low),
        list(&high)
    )
}
