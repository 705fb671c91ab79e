//! The bytes of a file: read at addresses, cut into fields, or shown with others in their place.

use std::fs::File;
use std::io::{Error, ErrorKind, Read, Result, Seek, SeekFrom};
use std::sync::{Mutex, PoisonError};

use hdf5_pure::Superblock;

/// More than any header block, heap segment or tree node of a valid file has.
pub(super) const MAX_READ: u64 = 16 << 20;

/// A file with other bytes in some places, and more of them.
pub(super) struct Patch {
    /// Shown from this position on in the place of the file's own bytes.
    pub start: u64,
    pub bytes: Vec<u8>,
    /// Shown behind the file's end.
    pub behind: Vec<u8>,
}

/// The file as addresses and fields of the widths its superblock announces.
pub(super) struct Image {
    /// Reading moves the file's position: one thread at a time.
    file: Mutex<File>,
    pub bytes: u64,
    pub base: u64,
    /// Bytes of an address.
    pub offset: usize,
    /// Bytes of a length.
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

    /// Whether an address means "nothing there".
    pub fn undefined(&self, address: u64) -> bool {
        address == u64::MAX >> (64 - 8 * self.offset.clamp(1, 8))
    }

    /// `length` bytes at `address`.
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
