//! The bytes of a file: read at an address, split into fields, or patched for the HDF5 library.

use std::fs::File;
use std::io::{Error, ErrorKind, Read, Result, Seek, SeekFrom};
use std::sync::{Mutex, PoisonError};

use hdf5_pure::Superblock;

/// More than any header block, heap segment or tree node of a valid file.
pub(super) const MAX_READ: u64 = 16 << 20;

/// A file with some bytes replaced and others appended.
pub(super) struct Patch {
    /// Replaces the file's own bytes from this position on.
    pub start: u64,
    pub bytes: Vec<u8>,
    /// Appended after the file's end.
    pub behind: Vec<u8>,
}

/// The file, read as addresses and fields of the widths that its superblock declares.
pub(super) struct Image {
    /// Reading moves the file's position, so one thread reads at a time.
    file: Mutex<File>,
    pub bytes: u64,
    pub base: u64,
    /// Bytes per address.
    pub offset: usize,
    /// Bytes per length.
    pub length: usize,
}

pub(super) fn malformed(what: impl Into<String>) -> Error {
    Error::new(ErrorKind::InvalidData, what.into())
}

/// Little-endian fields from the start of a block.
pub(super) struct Fields<'a>(pub &'a [u8]);

impl<'a> Fields<'a> {
    pub fn take(&mut self, n: usize) -> Result<&'a [u8]> {
        let (head, tail) = self.0.split_at_checked(n).ok_or_else(|| malformed("a block that ends within a field"))?;
        self.0 = tail;
        Ok(head)
    }

    /// An unsigned number of `n` <= 8 bytes.
    pub fn uint(&mut self, n: usize) -> Result<u64> {
        Ok(self.take(n)?.iter().rev().fold(0, |value, &byte| value << 8 | u64::from(byte)))
    }

    pub fn byte(&mut self) -> Result<u8> {
        Ok(self.take(1)?[0])
    }

    pub fn signature(&mut self, name: &str) -> Result<()> {
        let found = self.take(name.len())?;
        if found == name.as_bytes() { Ok(()) } else { Err(malformed(format!("no {name} block where one should be"))) }
    }

    pub fn text(&mut self, n: usize) -> Result<String> {
        Ok(String::from_utf8_lossy(self.take(n)?).into_owned())
    }
}

impl Image {
    pub fn new(file: File, bytes: u64, superblock: &Superblock) -> Self {
        let (offset, length) = (superblock.offset_size as usize, superblock.length_size as usize);
        Self { file: Mutex::new(file), bytes, base: superblock.base_address.get(), offset, length }
    }

    /// Whether an address means "no object".
    pub fn undefined(&self, address: u64) -> bool {
        address == u64::MAX >> (64 - 8 * self.offset.clamp(1, 8))
    }

    /// Reads `length` bytes at `address`.
    pub fn read(&self, address: u64, length: u64) -> Result<Vec<u8>> {
        let start = self.base.checked_add(address).filter(|_| !self.undefined(address));
        let start = start.ok_or_else(|| malformed("an address outside of the file"))?;
        if length > MAX_READ {
            return Err(malformed(format!("a block of {length} bytes")));
        }
        if start.checked_add(length).is_none_or(|end| end > self.bytes) {
            return Err(Error::new(ErrorKind::UnexpectedEof, format!("a block beyond the end, at byte {start}")));
        }
        let mut block = vec![0; length as usize];
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(start))?;
        file.read_exact(&mut block)?;
        Ok(block)
    }
}
