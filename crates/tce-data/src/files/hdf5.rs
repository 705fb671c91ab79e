//! Reading numbers out of HDF5 files that may be anything.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use hdf5_pure::{AttrValue, Datatype, File, FormatError, Layout};
use tce_base::FileError;

use crate::{DataError, Problem};

/// Deflate cannot expand by more than 1032 : 1. A data set that announces more than this times the file's size is not
/// in the file.
const MAX_EXPANSION: u64 = 1040;
const REPAIR: &str = "The file is damaged or incomplete: fetch or write it again";
const NEWER: &str = "Written by a newer HDF5, or damaged: write it again by h5py with libver=\"v110\"";

/// An open file. Reads on demand, so that memory follows the data sets that are asked for.
pub(super) struct Hdf5 {
    path: PathBuf,
    bytes: u64,
    file: File,
    names: Vec<String>,
}

/// One data set as a row-major f32 matrix.
pub(super) struct Column {
    pub data: Vec<f32>,
    pub rows: usize,
    pub dim: usize,
    /// Whether numbers were stored as f64 and have been rounded.
    pub rounded: bool,
}

impl Hdf5 {
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let io = |action| move |e: io::Error| DataError::File(FileError::new(path, action, e));
        let meta = fs::metadata(path).map_err(io("open"))?;
        if meta.is_dir() {
            return Err(io("open")(io::Error::new(io::ErrorKind::IsADirectory, "it is a directory, not a file")));
        }
        let bytes = meta.len();
        let whole = |problem, found: String, advice: &str| {
            DataError::invalid(problem, path, "file", found, "an HDF5 file in D4RL's or OTDF's layout", advice)
        };
        if bytes == 0 {
            return Err(whole(Problem::Empty, "0 bytes".into(), REPAIR));
        }
        if !hdf5_pure::is_hdf5(path).map_err(io("read"))? {
            let found = format!("{bytes} bytes without the HDF5 signature");
            return Err(whole(Problem::NotHdf5, found, "Convert the data to HDF5 first, or check the path"));
        }
        let file = guard(path, "file", || File::open_streaming(path))?;
        let end = file.superblock().eof_address;
        if end > bytes {
            return Err(whole(Problem::Truncated, format!("{bytes} of {end} bytes"), REPAIR));
        }
        let names = guard(path, "file", || file.root().datasets())?;
        Ok(Self { path: path.to_owned(), bytes, file, names })
    }

    pub fn has(&self, name: &str) -> bool {
        self.names.iter().any(|n| n == name)
    }

    /// The root's attributes as text.
    pub fn attributes(&self) -> Result<BTreeMap<String, String>, DataError> {
        let attributes = guard(&self.path, "attributes", || self.file.root().attrs())?;
        let text = |v: AttrValue| v.as_str().map_or_else(|| v.to_string(), str::to_owned);
        Ok(attributes.into_iter().map(|(k, v)| (k, text(v))).collect())
    }

    /// A matrix: shape (N, D), D >= 1.
    pub fn matrix(&self, name: &str) -> Result<Column, DataError> {
        let column = self.read(name, |shape| match shape {
            &[n, d] if d > 0 => Some((n, d)),
            _ => None,
        })?;
        self.finite(name, column)
    }

    /// A vector: shape (N,) or (N, 1).
    pub fn vector(&self, name: &str) -> Result<Column, DataError> {
        let column = self.read(name, |shape| match *shape {
            [n] | [n, 1] => Some((n, 1)),
            _ => None,
        })?;
        self.finite(name, column)
    }

    /// A vector of 0 and 1, however it is stored.
    pub fn flags(&self, name: &str) -> Result<Vec<bool>, DataError> {
        let column = self.vector(name)?;
        if let Some(row) = column.data.iter().position(|&x| x != 0.0 && x != 1.0) {
            let found = format!("{} in row {row}", column.data[row]);
            return Err(self.invalid(Problem::Value, name, found, "0 or 1", "Store flags as 0 and 1"));
        }
        Ok(column.data.iter().map(|&x| x == 1.0).collect())
    }

    pub fn invalid(
        &self,
        problem: Problem,
        field: &str,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> DataError {
        DataError::invalid(problem, &self.path, field, found, expected, advice)
    }

    fn finite(&self, name: &str, column: Column) -> Result<Column, DataError> {
        let Some(at) = column.data.iter().position(|x| !x.is_finite()) else {
            return Ok(column);
        };
        let (row, col) = (at / column.dim, at % column.dim);
        let bad = column.data.iter().filter(|x| !x.is_finite()).count();
        let found = format!("{} in row {row}, column {col} ({bad} such values)", column.data[at]);
        Err(self.invalid(Problem::NonFinite, name, found, "finite numbers (float32)", "Remove these rows first"))
    }

    fn read(&self, name: &str, rank: impl Fn(&[u64]) -> Option<(u64, u64)>) -> Result<Column, DataError> {
        if !self.has(name) {
            let keys = if self.names.is_empty() { "no data sets".into() } else { self.names.join(", ") };
            return Err(self.invalid(
                Problem::MissingField,
                name,
                format!("no such data set (the file has {keys})"),
                "a data set of this name at the top level",
                "Check that the file holds transitions in D4RL's or OTDF's layout",
            ));
        }
        let dataset = guard(&self.path, name, || self.file.dataset(name))?;
        let (shape, datatype) = guard(&self.path, name, || Ok((dataset.shape()?, dataset.datatype()?)))?;
        if !is_number(&datatype) {
            let advice = "Store numbers as float32, flags as integers or booleans";
            let expected = "float32, float64, an integer or a boolean type";
            return Err(self.invalid(Problem::WrongType, name, format!("type {datatype}"), expected, advice));
        }
        let Some((rows, dim)) = rank(&shape) else {
            let expected = if rank(&[1, 2]).is_some() { "shape (N, D)" } else { "shape (N,) or (N, 1)" };
            let advice = "Reshape it: one row per transition";
            return Err(self.invalid(Problem::WrongRank, name, format!("shape {shape:?}"), expected, advice));
        };
        if rows == 0 {
            return Err(self.invalid(Problem::Empty, name, "0 rows", "at least one row", "Use another file"));
        }
        let size = datatype.type_size() as u64;
        self.ensure_stored(name, &dataset, &shape, size)?;
        let data = guard(&self.path, name, || dataset.read_f32())?;
        // The product fits: `ensure_stored` has compared it with the file's size.
        if data.len() as u64 != rows * dim {
            let found = format!("{} numbers for shape {shape:?}", data.len());
            return Err(self.invalid(Problem::Malformed, name, found, "as many as the shape says", REPAIR));
        }
        let rounded = matches!(datatype, Datatype::FloatingPoint { size: 8, .. });
        Ok(Column { data, rows: rows as usize, dim: dim as usize, rounded })
    }

    /// Refuses a data set that the file's bytes cannot hold or that was never (completely) written, before anything is
    /// allocated for it.
    fn ensure_stored(
        &self,
        name: &str,
        dataset: &hdf5_pure::Dataset,
        shape: &[u64],
        element: u64,
    ) -> Result<(), DataError> {
        let product = |dims: &[u64]| dims.iter().try_fold(element, |n, &d| n.checked_mul(d));
        let oversized = |announced: Option<u64>| {
            let announced = announced.map_or("more than 2^64".to_owned(), |n| n.to_string());
            let found = format!("{announced} bytes announced, in a file of {} bytes", self.bytes);
            self.invalid(Problem::Oversized, name, found, "no more data than the file can hold", REPAIR)
        };
        let incomplete = |found: String| {
            self.invalid(
                Problem::Truncated,
                name,
                found,
                "every row written",
                "The writer did not finish: write it again",
            )
        };
        let announced = product(shape);
        let limit = self.bytes.saturating_mul(MAX_EXPANSION);
        let total = announced.filter(|&n| n <= limit).ok_or_else(|| oversized(announced))?;
        match guard(&self.path, name, || dataset.layout())? {
            Layout::Contiguous { address: None, .. } => Err(incomplete("no data written".into())),
            Layout::Contiguous { .. } | Layout::Compact { .. } if total > self.bytes => Err(oversized(announced)),
            Layout::Chunked { chunk_shape, .. } => {
                let chunk = product(&chunk_shape);
                if chunk_shape.contains(&0) || chunk.is_none_or(|n| n > limit) {
                    return Err(oversized(chunk));
                }
                let grid = shape.iter().zip(&chunk_shape).try_fold(1u64, |n, (s, c)| n.checked_mul(s.div_ceil(*c)));
                // Every chunk costs at least an address.
                let grid = grid.filter(|&n| n <= self.bytes / 8).ok_or_else(|| oversized(grid))?;
                let chunks = guard(&self.path, name, || dataset.chunks())?;
                if (chunks.len() as u64) < grid {
                    return Err(incomplete(format!("{} of {grid} chunks", chunks.len())));
                }
                let past_end =
                    |c: &hdf5_pure::Chunk| c.address.checked_add(c.storage_size).is_none_or(|end| end > self.bytes);
                if chunks.iter().any(past_end) {
                    return Err(incomplete("a chunk beyond the end of the file".into()));
                }
                let stored: u64 = chunks.iter().map(|c| c.storage_size).fold(0, u64::saturating_add);
                let padded = grid.saturating_mul(chunk.unwrap_or(u64::MAX));
                if padded > stored.saturating_mul(MAX_EXPANSION) {
                    return Err(oversized(Some(padded)));
                }
                Ok(())
            }
            Layout::Virtual => {
                let advice = "Copy the data into one file (h5repack)";
                Err(self.invalid(Problem::Malformed, name, "a virtual data set", "numbers in this very file", advice))
            }
            _ => Ok(()),
        }
    }
}

fn is_number(datatype: &Datatype) -> bool {
    match datatype {
        Datatype::FixedPoint { size, .. } => *size <= 8,
        // The library does not read float16.
        Datatype::FloatingPoint { size, .. } => matches!(size, 4 | 8),
        // h5py's booleans are an enumeration over int8.
        Datatype::Enumeration { base_type, .. } => matches!(**base_type, Datatype::FixedPoint { .. }),
        _ => false,
    }
}

/// Runs one call of the HDF5 library and puts its failure, a panic included, into our words.
fn guard<T>(path: &Path, field: &str, call: impl FnOnce() -> Result<T, hdf5_pure::Error>) -> Result<T, DataError> {
    let malformed = |problem, found: String| {
        // What the library does not know yet is no damage.
        let repair = if found.contains("version") || found.contains("unsupported") { NEWER } else { REPAIR };
        DataError::invalid(problem, path, field, found, "a file that follows the HDF5 format", repair)
    };
    match catch_unwind(AssertUnwindSafe(call)) {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(hdf5_pure::Error::Io(e))) if e.kind() != io::ErrorKind::UnexpectedEof => {
            Err(FileError::new(path, "read", e).into())
        }
        Ok(Err(e)) => {
            let short =
                matches!(e, hdf5_pure::Error::Io(_) | hdf5_pure::Error::Format(FormatError::UnexpectedEof { .. }));
            let problem = if short { Problem::Truncated } else { Problem::Malformed };
            Err(malformed(problem, e.to_string()))
        }
        Err(_) => Err(malformed(Problem::Malformed, "bytes that the HDF5 reader cannot follow".into())),
    }
}
