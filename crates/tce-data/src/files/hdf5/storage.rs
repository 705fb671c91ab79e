//! Checks that a data set's numbers are in the file and in a readable form, before any memory is allocated.

use hdf5_pure::{Chunk, ChunkIndex, Dataset, Error, FormatError, Layout};

use super::{Beside, COPY, Hdf5, REPAIR, guard};
use crate::{DataError, Problem};

/// Deflate cannot expand by more than 1032 : 1. If a data set declares more than this times the file's size, its data
/// cannot be in the file.
const MAX_EXPANSION: u64 = 1040;

/// How to treat a data set, or a part of one, that was created but never written.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Unwritten<'a> {
    /// Return an error: states and actions made up of zeros are not data.
    Refuse,
    /// Read it as its fill value (default: zero), as h5py does. The file's bytes do not limit its size. It must
    /// therefore have as many rows as a field that was read.
    Fill(Beside<'a>),
}

/// What the header says about a data set.
struct Told<'a> {
    name: &'a str,
    shape: Vec<u64>,
    /// Bytes per element.
    element: u64,
    /// Declared bytes of the whole data set; `None` above 2^64.
    announced: Option<u64>,
    /// Whether the file is large enough to hold them in compressed form.
    fits: bool,
    unwritten: Unwritten<'a>,
}

/// Bytes of a block of elements; `None` above 2^64.
fn bytes_of(element: u64, dims: &[u64]) -> Option<u64> {
    dims.iter().try_fold(element, |n, &d| n.checked_mul(d))
}

impl Hdf5 {
    /// Returns an error if the file's bytes cannot hold the data set, if it was never (completely) written, or if it is
    /// stored in an unsupported way. Otherwise returns a note about values that will be filled, if any.
    pub(super) fn ensure_stored(
        &self,
        name: &str,
        dataset: &Dataset,
        unwritten: Unwritten<'_>,
    ) -> Result<Option<String>, DataError> {
        let (shape, element) = guard(&self.path, name, || Ok((dataset.shape()?, dataset.element_size()?)))?;
        let announced = bytes_of(element, &shape);
        let fits = announced.is_some_and(|n| n <= self.bytes.saturating_mul(MAX_EXPANSION));
        let told = Told { name, shape, element, announced, fits, unwritten };
        match guard(&self.path, name, || dataset.layout())? {
            Layout::Contiguous { address: None, .. } => {
                // Raw data in an external file have the same layout message; only a read shows the difference.
                match guard(&self.path, name, || Ok(dataset.read_raw_rows(0, 1)))? {
                    Err(Error::Format(FormatError::UnsupportedExternalStorage)) => {
                        Err(self.elsewhere(name, "raw data in another file"))
                    }
                    _ => self.filled_or_refused(&told, "created, but never written".into()),
                }
            }
            Layout::Contiguous { .. } | Layout::Compact { .. } if announced.is_none_or(|n| n > self.bytes) => {
                Err(self.oversized(name, announced))
            }
            Layout::Chunked { index: ChunkIndex::BTreeV2, .. } => {
                let found = "chunks under a version 2 B-tree (several unlimited dimensions, libver=\"latest\")";
                let advice = format!("Store it anew: {COPY}");
                Err(self.invalid(Problem::Unsupported, name, found, "at most one unlimited dimension", advice))
            }
            Layout::Chunked { chunk_shape, .. } => self.ensure_chunks(&told, dataset, &chunk_shape),
            Layout::Virtual => Err(self.elsewhere(name, "a virtual data set")),
            _ => Ok(None),
        }
    }

    /// [`Self::ensure_stored`] for a chunked data set.
    fn ensure_chunks(
        &self,
        told: &Told<'_>,
        dataset: &Dataset,
        chunk_shape: &[u64],
    ) -> Result<Option<String>, DataError> {
        let Told { name, shape, element, announced, fits, .. } = told;
        let chunk = bytes_of(*element, chunk_shape);
        if chunk_shape.contains(&0) || chunk_shape.len() != shape.len() {
            return Err(self.oversized(name, chunk));
        }
        let grid = shape.iter().zip(chunk_shape).try_fold(1u64, |n, (s, c)| n.checked_mul(s.div_ceil(*c)));
        let grid = grid.ok_or_else(|| self.oversized(name, None))?;
        // Every stored chunk takes an address in the file or, without an index, an element. The others are missing.
        let mut note = None;
        if grid > self.bytes / element.clamp(&1, &8) {
            note = self.filled_or_refused(told, format!("most of its {grid} chunks never written"))?;
        }
        let chunks = guard(&self.path, name, || dataset.chunks())?;
        let inside = |c: &&Chunk| c.offset.iter().zip(shape).all(|(at, end)| at < end);
        let written = chunks.iter().filter(inside).count() as u64;
        if written < grid && note.is_none() {
            let what = match written {
                0 => "created, but never written".into(),
                _ => format!("{} of its {grid} chunks never written", grid - written),
            };
            note = self.filled_or_refused(told, what)?;
        }
        let past_end = |c: &Chunk| c.address.checked_add(c.storage_size).is_none_or(|end| end > self.bytes);
        if chunks.iter().any(past_end) {
            let found = "a chunk beyond the end of the file";
            return Err(self.invalid(Problem::Truncated, name, found, "every chunk in the file", REPAIR));
        }
        let stored: u64 = chunks.iter().map(|c| c.storage_size).fold(0, u64::saturating_add);
        let padded = (chunks.len() as u64).saturating_mul(chunk.unwrap_or(u64::MAX));
        if padded > stored.saturating_mul(MAX_EXPANSION) {
            return Err(self.oversized(name, Some(padded)));
        }
        self.ensure_filters(name, dataset, &chunks)?;
        if note.is_none() && !fits { Err(self.oversized(name, *announced)) } else { Ok(note) }
    }

    /// The error for more data than the file can hold.
    fn oversized(&self, name: &str, announced: Option<u64>) -> DataError {
        let announced = announced.map_or("more than 2^64".to_owned(), |n| n.to_string());
        let found = format!("{announced} bytes announced, in a file of {} bytes", self.bytes);
        self.invalid(Problem::Oversized, name, found, "no more data than the file can hold", REPAIR)
    }

    /// Returns the note that missing data will be filled, or an error.
    fn filled_or_refused(&self, told: &Told<'_>, what: String) -> Result<Option<String>, DataError> {
        let Told { name, shape, announced, fits, unwritten, .. } = told;
        match unwritten {
            Unwritten::Refuse if !fits => Err(self.oversized(name, *announced)),
            Unwritten::Refuse => Err(self.invalid(
                Problem::Truncated,
                name,
                format!("no complete data ({what})"),
                "every row written",
                "The program that made the file did not finish: write it again, or cut the file to the written rows",
            )),
            Unwritten::Fill(Beside { field, rows }) => {
                let here = shape.first().copied().unwrap_or(1);
                if here != *rows as u64 {
                    return Err(self.invalid(
                        Problem::RowCount,
                        name,
                        format!("{here} rows, {what}"),
                        format!("{rows} rows, as in `{field}`"),
                        "The fields must have one row per transition: write the file again",
                    ));
                }
                Ok(Some(format!("`{name}`: {what}; read as its fill value, as h5py does")))
            }
        }
    }

    /// The error for data that are stored in another file.
    pub(super) fn elsewhere(&self, name: &str, found: impl Into<String>) -> DataError {
        let advice = format!("Copy the data into one file: {COPY}");
        self.invalid(Problem::Unsupported, name, found, "numbers in this very file", advice)
    }

    /// Returns an error for unsupported compressions, unless every chunk was stored uncompressed.
    fn ensure_filters(&self, name: &str, dataset: &Dataset, chunks: &[Chunk]) -> Result<(), DataError> {
        for (i, filter) in dataset.filters().into_iter().enumerate() {
            let Some(unread) = unread_filter(filter) else { continue };
            let skipped = |c: &Chunk| i < 32 && c.filter_mask >> i & 1 == 1;
            if chunks.iter().all(skipped) {
                continue;
            }
            let found = format!("compression by {} (HDF5 filter {filter})", unread.name);
            let advice = match unread.part_of_hdf5 {
                true => "Store it anew: `h5repack -f GZIP=4 in.hdf5 out.hdf5`".to_owned(),
                false => format!(
                    "Store it anew, after `pip install hdf5plugin`: {}",
                    COPY.replace("h5py;", "h5py, hdf5plugin;")
                ),
            };
            return Err(self.invalid(Problem::Unsupported, name, found, "gzip, lzf or no compression", advice));
        }
        Ok(())
    }
}

struct Unread {
    name: &'static str,
    /// Whether h5repack reads the filter without a plugin.
    part_of_hdf5: bool,
}

/// Returns a filter that `hdf5-pure` cannot undo.
fn unread_filter(id: u16) -> Option<Unread> {
    let (name, part_of_hdf5) = match id {
        // Deflate, shuffle, Fletcher-32, scale-offset, LZF.
        1..=3 | 6 | 32000 => return None,
        4 => ("szip", true),
        5 => ("n-bit", true),
        305 => ("LZO", false),
        307 => ("bzip2", false),
        32001 => ("Blosc", false),
        32004 => ("LZ4", false),
        32008 => ("bitshuffle", false),
        32013 => ("ZFP", false),
        32015 => ("Zstandard", false),
        32026 => ("Blosc2", false),
        _ => ("an unknown plugin", false),
    };
    Some(Unread { name, part_of_hdf5 })
}
