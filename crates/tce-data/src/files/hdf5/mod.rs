//! Reads numbers from HDF5 files of unknown origin.
//!
//! `hdf5-pure` reads the data sets. The rest is done here: links are followed ([`names`]), groups are opened once
//! ([`groups`]), newer layout messages are rewritten for the library ([`modern`]), missing data are detected before
//! memory is allocated ([`storage`]), and numbers that float32 cannot hold are reported ([`numbers`]).

mod groups;
mod heap;
mod image;
mod modern;
mod names;
mod numbers;
mod storage;
mod table;

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use hdf5_pure::{AttrValue, Dataset, Datatype, File, FormatError};
use tce_base::{FileError, file_inside};

use self::groups::Groups;
use self::names::{Broken, Found, Names};
use self::storage::Unwritten;
use super::rounding;
use crate::{DataError, Problem};

const REPAIR: &str = "The file is damaged or incomplete: fetch or write it again";
/// Command that copies any file that h5py reads into a file of plain data sets.
const COPY: &str = "`python -c \"import h5py; i = h5py.File('in.hdf5'); o = h5py.File('out.hdf5', 'w'); \
                    [o.create_dataset(k, data=i[k][()]) for k in i if isinstance(i.get(k), h5py.Dataset)]\"`";

/// An open file. Data sets are read on demand, so memory use depends on the data sets that are requested.
pub(super) struct Hdf5 {
    path: PathBuf,
    bytes: u64,
    file: File,
    names: Names,
    groups: Groups,
    notes: Arc<Mutex<Vec<String>>>,
}

/// One data set as a row-major f32 matrix.
pub(super) struct Column {
    pub data: Vec<f32>,
    pub rows: usize,
    pub dim: usize,
    /// Whether numbers were stored as f64 and have been rounded.
    pub rounded: bool,
    /// Of each column, what the rounding lost: see [`rounding::losses`].
    pub losses: Vec<f32>,
}

/// A field that was read before: a vector beside it has as many rows.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) struct Beside<'a> {
    pub field: &'a str,
    pub rows: usize,
}

/// The expected form of a field.
#[derive(Clone, Copy)]
enum Kind<'a> {
    /// (N, D), D >= 1. The data must have been written.
    Matrix,
    /// Like `Matrix`, but numbers may be NaN or infinite.
    Gaps,
    /// (N, D) or (N,). The data must have been written.
    Table,
    /// (N,) or (N, 1). Data that were never written are read as the fill value, if there are as many as beside it.
    Vector(Beside<'a>),
}

impl Hdf5 {
    pub fn open(path: &Path) -> Result<Self, DataError> {
        Self::open_noting(path, Arc::default())
    }

    /// A second handle for another thread. It shares the notes of this one.
    pub fn reopen(&self) -> Result<Self, DataError> {
        Self::open_noting(&self.path, Arc::clone(&self.notes))
    }

    fn open_noting(path: &Path, notes: Arc<Mutex<Vec<String>>>) -> Result<Self, DataError> {
        let io = |action| move |e: io::Error| DataError::File(FileError::new(path, action, e));
        let meta = fs::metadata(path).map_err(io("open"))?;
        if meta.is_dir() {
            let inside = file_inside(path, |p| p.extension().is_some_and(|e| e == "hdf5" || e == "h5"));
            let words = format!("it is a folder, not a file{inside}");
            return Err(io("open")(io::Error::new(io::ErrorKind::IsADirectory, words)));
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
        let superblock = file.superblock();
        let end = superblock.eof_address;
        if end > bytes {
            return Err(whole(Problem::Truncated, format!("{bytes} of {end} bytes"), REPAIR));
        }
        let names = Names::open(path, bytes, superblock).map_err(|e| unreadable(path, "file", e))?;
        Ok(Self { path: path.to_owned(), bytes, file, names, groups: Groups::default(), notes })
    }

    /// The names in the group at `path` (empty: the top level); `None` if it is not a group.
    pub fn names_in(&self, path: &str) -> Result<Option<Vec<String>>, DataError> {
        match self.names.find(path).map_err(|e| unreadable(&self.path, path, e))? {
            Found::Group(names) => Ok(Some(names)),
            _ => Ok(None),
        }
    }

    /// The paths of the data sets at the top level and in its groups (one level deep).
    pub fn all_datasets(&self) -> Result<Vec<String>, DataError> {
        let mut out = Vec::new();
        for name in self.names_in("")?.unwrap_or_default() {
            match self.names_in(&name)? {
                None => out.push(name),
                Some(inner) => out.extend(inner.into_iter().map(|inner| format!("{name}/{inner}"))),
            }
        }
        Ok(out)
    }

    /// Whether this name exists at the top level (data set, group or link), or whether this path leads to an object.
    pub fn has(&self, name: &str) -> bool {
        self.names.has(name)
    }

    /// Notes for the user on the numbers read so far: those that float32 cannot hold, those that were never written.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = self.notes.lock().unwrap_or_else(PoisonError::into_inner).clone();
        // Two handles may have read in parallel.
        notes.sort();
        notes
    }

    /// The attributes of the root group, as text.
    pub fn attributes(&self) -> Result<BTreeMap<String, String>, DataError> {
        let attributes = guard(&self.path, "attributes", || self.file.root().attrs())?;
        let text = |v: AttrValue| v.as_str().map_or_else(|| v.to_string(), str::to_owned);
        Ok(attributes.into_iter().map(|(k, v)| (k, text(v))).collect())
    }

    /// Reads a matrix of shape (N, D), D >= 1.
    pub fn matrix(&self, name: &str) -> Result<Column, DataError> {
        self.read(name, Kind::Matrix)
    }

    /// Reads a matrix that may hold NaN and infinity.
    pub fn matrix_with_gaps(&self, name: &str) -> Result<Column, DataError> {
        self.read(name, Kind::Gaps)
    }

    /// Reads a matrix, or a vector as a matrix of one column: shape (N, D) or (N,).
    pub fn table(&self, name: &str) -> Result<Column, DataError> {
        self.read(name, Kind::Table)
    }

    /// Reads a vector: shape (N,) or (N, 1). Only one that was never written is compared with `beside`.
    pub fn vector(&self, name: &str, beside: Beside<'_>) -> Result<Column, DataError> {
        self.read(name, Kind::Vector(beside))
    }

    /// Reads a vector of 0 and 1, stored as any number type.
    pub fn flags(&self, name: &str, beside: Beside<'_>) -> Result<Vec<bool>, DataError> {
        let column = self.vector(name, beside)?;
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

    /// The error for a missing field.
    pub fn missing(&self, name: &str) -> DataError {
        let names = self.names.list();
        let keys = if names.is_empty() { "no data sets".into() } else { names.join(", ") };
        self.invalid(
            Problem::MissingField,
            name,
            format!("no such data set (the file has {keys})"),
            "a data set of this name",
            "Check that the file holds transitions in the layout of D4RL, OTDF, Minari or robomimic",
        )
    }

    fn note(&self, note: String) {
        self.notes.lock().unwrap_or_else(PoisonError::into_inner).push(note);
    }

    /// The data set with this `name`, through any links.
    fn open_dataset(&self, name: &str) -> Result<Dataset, DataError> {
        let (path, header) = match self.names.find(name).map_err(|e| unreadable(&self.path, name, e))? {
            Found::At { path, header } => (path, header),
            Found::Absent => return Err(self.missing(name)),
            Found::Group(members) => {
                let members =
                    if members.is_empty() { "without members".into() } else { format!("of {}", members.join(", ")) };
                return Err(self.invalid(
                    Problem::WrongType,
                    name,
                    format!("a group {members}"),
                    "a data set of this name",
                    "Store the numbers as one data set, or rename the group",
                ));
            }
            Found::Nowhere(broken) => return Err(self.broken_link(name, broken)),
        };
        let other = |_| {
            let (found, expected) = ("an object that is neither a data set nor a group", "a data set of this name");
            self.invalid(Problem::WrongType, name, found, expected, "Store the numbers as a data set of this name")
        };
        let patch = self.names.readable_layout(header).map_err(|e| unreadable(&self.path, name, e))?;
        let shown =
            patch.map(|patch| guard(&self.path, name, || modern::open(&self.path, self.bytes, patch))).transpose()?;
        let open = || match &shown {
            Some(file) => file.dataset(&path),
            None => self.groups.dataset(&self.file, &path),
        };
        guard(&self.path, name, || match open() {
            Err(hdf5_pure::Error::NotADataset(what)) => Ok(Err(other(what))),
            opened => opened.map(Ok),
        })?
    }

    fn broken_link(&self, name: &str, broken: Broken) -> DataError {
        let found = match broken {
            Broken::External { file, path } => {
                return self.elsewhere(name, format!("an external link to `{path}` in the file `{file}`"));
            }
            Broken::Dangling(target) => format!("a soft link to `{target}`, which is not in the file"),
            Broken::Circle(target) => format!("a soft link to `{target}` that leads in a circle, or too far"),
            Broken::Unknown(kind) => format!("a link of kind {kind}, which only its writer can follow"),
        };
        let advice = format!("Store the numbers under this name, or remove the link: `del file[\"{name}\"]` in h5py");
        self.invalid(Problem::MissingField, name, found, "a data set of this name", advice)
    }

    fn read(&self, name: &str, kind: Kind<'_>) -> Result<Column, DataError> {
        let dataset = self.open_dataset(name)?;
        let (shape, datatype) = guard(&self.path, name, || Ok((dataset.shape()?, dataset.datatype()?)))?;
        if !numbers::is_number(&datatype) {
            let advice = "Store numbers as float32, flags as integers or booleans";
            let expected = "float32, float64, float16, an integer or a boolean type";
            return Err(self.invalid(Problem::WrongType, name, format!("type {datatype}"), expected, advice));
        }
        let (rows, dim) = match (kind, &shape[..]) {
            (Kind::Matrix | Kind::Gaps | Kind::Table, &[n, d]) if d > 0 => (n, d),
            (Kind::Table, &[n]) | (Kind::Vector(_), &[n] | &[n, 1]) => (n, 1),
            _ => {
                let expected = match kind {
                    Kind::Matrix | Kind::Gaps => "shape (N, D)",
                    Kind::Table => "shape (N, D) or (N,)",
                    Kind::Vector(_) => "shape (N,) or (N, 1)",
                };
                let advice = "Reshape it: one row per transition";
                return Err(self.invalid(Problem::WrongRank, name, format!("shape {shape:?}"), expected, advice));
            }
        };
        if rows == 0 {
            return Err(self.invalid(Problem::Empty, name, "0 rows", "at least one row", "Use another file"));
        }
        let unwritten = match kind {
            Kind::Matrix | Kind::Gaps | Kind::Table => Unwritten::Refuse,
            Kind::Vector(beside) => Unwritten::Fill(beside),
        };
        let filled = self.ensure_stored(name, &dataset, unwritten)?;
        let data = guard(&self.path, name, || numbers::read_f32(&dataset, &datatype))?;
        // The product does not overflow: `ensure_stored` has compared it with the file's size.
        if data.len() as u64 != rows * dim {
            let found = format!("{} numbers for shape {shape:?}", data.len());
            return Err(self.invalid(Problem::Malformed, name, found, "as many as the shape says", REPAIR));
        }
        let (rows, dim) = (rows as usize, dim as usize);
        if !matches!(kind, Kind::Gaps) {
            self.ensure_finite(name, &dataset, &datatype, &data, dim)?;
        }
        if let Some(inexact) = guard(&self.path, name, || numbers::inexact_integers(&dataset, &datatype, &data, dim))? {
            let (at, number) = inexact.first;
            self.note(format!(
                "`{name}`: {} integers have more digits than float32 holds and were rounded, the first of them {number} \
                 in row {}, column {}",
                inexact.count,
                at / dim,
                at % dim
            ));
        }
        filled.into_iter().for_each(|note| self.note(note));
        let rounded = matches!(datatype, Datatype::FloatingPoint { size: 8, .. });
        let losses = if rounded && !matches!(kind, Kind::Gaps) && rounding::is_doubtful(&data, dim) {
            // Only a note depends on these numbers.
            let stored = guard(&self.path, name, || numbers::first_f64(&dataset, rows)).unwrap_or_default();
            rounding::losses(&stored, &data, dim)
        } else {
            vec![0.0; dim]
        };
        Ok(Column { data, rows, dim, rounded, losses })
    }

    fn ensure_finite(
        &self,
        name: &str,
        dataset: &Dataset,
        datatype: &Datatype,
        data: &[f32],
        dim: usize,
    ) -> Result<(), DataError> {
        let Some(at) = data.iter().position(|x| !x.is_finite()) else {
            return Ok(());
        };
        let bad = data.iter().filter(|x| !x.is_finite()).count();
        let place = format!("in row {}, column {} ({bad} such values)", at / dim, at % dim);
        // An infinity may be a finite float64 in the file.
        let stored = guard(&self.path, name, || Ok(numbers::finite_f64(dataset, datatype, at, dim)))?;
        let (found, advice) = match stored {
            Some(x) => {
                (format!("{x:e} {place}, which does not fit float32"), "Scale the numbers, or remove these rows")
            }
            None => (format!("{} {place}", data[at]), "Remove these rows first"),
        };
        Err(self.invalid(Problem::NonFinite, name, found, "finite numbers (float32, up to 3.4e38)", advice))
    }
}

/// Converts a failure of the link tables into a `DataError`.
fn unreadable(path: &Path, field: &str, e: io::Error) -> DataError {
    let problem = match e.kind() {
        io::ErrorKind::InvalidData => Problem::Malformed,
        io::ErrorKind::UnexpectedEof => Problem::Truncated,
        _ => return FileError::new(path, "read", e).into(),
    };
    DataError::invalid(problem, path, field, e.to_string(), "a file that follows the HDF5 format", REPAIR)
}

/// Runs one call of the HDF5 library and converts a failure, also a panic, into a `DataError`.
fn guard<T>(path: &Path, field: &str, call: impl FnOnce() -> Result<T, hdf5_pure::Error>) -> Result<T, DataError> {
    let malformed = |problem, found: String| {
        // A feature that the library does not support yet is not damage.
        let repair = if found.contains("version") || found.contains("unsupported") {
            format!("Written by a newer HDF5, or damaged. Store it anew: {COPY}")
        } else {
            REPAIR.to_owned()
        };
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
