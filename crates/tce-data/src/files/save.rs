//! Writes [`Transitions`] to a file that D4RL's loaders and h5py read.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use hdf5_pure::{AttrValue, DatasetBuilder, Datatype, EnumTypeBuilder, FileBuilder, make_i8_type};
use tce_base::{AtomicFile, FileError};

use super::{FORMAT, FORMAT_ATTRIBUTE, KNOWN};
use crate::{DataError, Problem, Transitions};

/// Bytes per chunk before compression: large enough to compress well, small enough to decompress a few at a time.
const CHUNK_BYTES: usize = 512 * 1024;
/// Longest side of a chunk, in elements. `hdf5-pure` writes a side of 65,536 or more with four bytes, where three are
/// enough. HDF5 2.0 recomputes the width and rejects any other ("stored chunk dimension encoding length"). For sides of
/// up to 255 and of up to 65,535, both use the same width.
const MAX_CHUNK_SIDE: usize = 65_535;
/// Float32 noise hardly compresses. Higher levels cost time and save no space.
const DEFLATE_LEVEL: u32 = 4;

/// Writes `data` in D4RL's layout with `next_observations`: `observations`, `actions`, `next_observations` (f32, (N,
/// D)), `rewards` (f32, (N,)), `terminals`, `timeouts` (h5py booleans, (N,)), compressed with gzip and shuffle.
/// `attributes` are written to the root, `columns` (f32, (N,)) beside the other fields; a column named `GROUP/NAME` is
/// written into a group. The file is complete or absent.
///
/// # Errors
/// No rows, columns of other lengths, a column with a reserved name, a full disk.
pub fn save_d4rl(
    path: &Path,
    data: &Transitions,
    attributes: &BTreeMap<String, String>,
    columns: &[(&str, &[f32])],
) -> Result<(), DataError> {
    validate(path, data, columns)?;
    let mut builder = FileBuilder::new();
    let boolean = boolean();
    for (name, values, dim) in [
        ("observations", &data.observations, data.obs_dim),
        ("actions", &data.actions, data.act_dim),
        ("next_observations", &data.next_observations, data.obs_dim),
    ] {
        let dataset = builder.create_dataset(name).with_f32_data(values);
        compress(dataset, &[data.len(), dim], 4);
    }
    compress(builder.create_dataset("rewards").with_f32_data(&data.rewards), &[data.len()], 4);
    let mut all_flags = vec![("terminals", &data.terminals), ("timeouts", &data.timeouts)];
    if !data.known.iter().all(|&known| known) {
        all_flags.push((KNOWN, &data.known));
    }
    for (name, flags) in all_flags {
        let bytes = flags.iter().map(|&f| f as u8).collect();
        let dataset = builder.create_dataset(name).with_raw_data(boolean.clone(), bytes, data.len() as u64);
        compress(dataset, &[data.len()], 1);
    }
    let (mut plain, mut grouped) = (Vec::new(), BTreeMap::<&str, Vec<_>>::new());
    for (name, values) in columns {
        match name.split_once('/') {
            None => plain.push((name, values)),
            Some((group, name)) => grouped.entry(group).or_default().push((name, values)),
        }
    }
    for (name, values) in plain {
        compress(builder.create_dataset(name).with_f32_data(values), &[data.len()], 4);
    }
    for (name, members) in grouped {
        let mut group = builder.create_group(name);
        for (name, values) in members {
            compress(group.create_dataset(name).with_f32_data(values), &[data.len()], 4);
        }
        builder.add_group(group.finish());
    }
    builder.set_attr(FORMAT_ATTRIBUTE, AttrValue::VarLenString(FORMAT.into()));
    for (name, value) in attributes.iter().filter(|(n, _)| *n != FORMAT_ATTRIBUTE) {
        builder.set_attr(name, AttrValue::VarLenString(value.clone()));
    }
    let mut file = AtomicFile::create(path)?;
    finish(builder, file.file(), path)?;
    file.commit()?;
    Ok(())
}

/// The type of h5py's booleans.
pub(super) fn boolean() -> Datatype {
    let values = EnumTypeBuilder::with_base(make_i8_type()).u8_value("FALSE", 0).u8_value("TRUE", 1);
    values.build().expect("a constant type")
}

/// Writes the content of `builder` to `file`; `path` is for messages.
pub(super) fn finish(builder: FileBuilder, file: &mut File, path: &Path) -> Result<(), FileError> {
    builder.finish_to(file).map_err(|e| {
        let source = match e {
            hdf5_pure::Error::Io(e) => e,
            other => std::io::Error::other(other.to_string()),
        };
        FileError::new(path, "write", source)
    })
}

fn compress(dataset: &mut DatasetBuilder, shape: &[usize], element: usize) {
    let row_bytes = element * shape[1..].iter().product::<usize>();
    let mut chunk: Vec<u64> = shape.iter().map(|&d| d.min(MAX_CHUNK_SIDE) as u64).collect();
    chunk[0] = chunk[0].min((CHUNK_BYTES / row_bytes).max(1) as u64);
    let shape: Vec<u64> = shape.iter().map(|&d| d as u64).collect();
    dataset.with_shape(&shape).with_chunks(&chunk).with_shuffle().with_deflate(DEFLATE_LEVEL);
}

fn validate(path: &Path, data: &Transitions, columns: &[(&str, &[f32])]) -> Result<(), DataError> {
    let refuse = |problem, field: &str, found: String, expected: String| {
        let advice = "Nothing was written; this is a mistake of the calling program";
        Err(DataError::invalid(problem, path, field, found, expected, advice))
    };
    let n = data.len();
    if n == 0 || data.obs_dim == 0 || data.act_dim == 0 {
        let found = format!("{n} rows of {} observations and {} actions", data.obs_dim, data.act_dim);
        return refuse(Problem::Empty, "observations", found, "at least one of each".into());
    }
    let own = [
        ("observations", data.observations.len(), n * data.obs_dim),
        ("actions", data.actions.len(), n * data.act_dim),
        ("next_observations", data.next_observations.len(), n * data.obs_dim),
        ("terminals", data.terminals.len(), n),
        ("timeouts", data.timeouts.len(), n),
        (KNOWN, data.known.len(), n),
    ];
    let more = columns.iter().map(|(name, values)| (*name, values.len(), n));
    for (name, found, expected) in own.into_iter().chain(more) {
        if found != expected {
            return refuse(Problem::RowCount, name, format!("{found} values"), format!("{expected} values"));
        }
    }
    for (i, (name, _)) in columns.iter().enumerate() {
        let taken = own.iter().any(|o| o.0 == *name) || *name == "rewards" || columns[..i].iter().any(|c| c.0 == *name);
        let parts: Vec<&str> = name.split('/').collect();
        if taken || parts.len() > 2 || parts.contains(&"") || parts.len() == 2 && own.iter().any(|o| o.0 == parts[0]) {
            let expected = "a new name, or GROUP/NAME".to_owned();
            return refuse(Problem::Value, name, "a reserved or repeated name".into(), expected);
        }
    }
    Ok(())
}
