//! Data sets that HDF5 2.0 writes with libver="latest".
//!
//! The layout message of a compressed one has version 5, which `hdf5-pure` refuses. It differs from version 4 in one
//! thing: the size of a compressed chunk takes eight bytes in the chunk index, not as few as will do. The index states
//! how wide its entries are and `hdf5-pure` goes by that, so that it reads such a data set once its header says 4. The
//! library is shown the file with this one header changed: the version, and the checksum over it.

use std::fs;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use hdf5_pure::{Error, File, FormatError, Source};

use super::table::Patch;

/// Opens the file with `patch` in its place.
pub(super) fn open(path: &Path, bytes: u64, patch: Patch) -> Result<File, Error> {
    let file = fs::File::open(path).map_err(Error::Io)?;
    File::from_source(Patched { file: Mutex::new(file), bytes, patch })
}

struct Patched {
    file: Mutex<fs::File>,
    bytes: u64,
    patch: Patch,
}

impl Source for Patched {
    fn len(&self) -> u64 {
        self.bytes
    }

    fn read_at(&self, offset: u64, buf: &mut [u8]) -> Result<(), FormatError> {
        let told = |e: io::Error| FormatError::Source(e.to_string());
        {
            let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
            file.seek(SeekFrom::Start(offset)).map_err(told)?;
            file.read_exact(buf).map_err(told)?;
        }
        let Patch { start, bytes } = &self.patch;
        let first = offset.max(*start);
        let last = (offset + buf.len() as u64).min(start + bytes.len() as u64);
        if first < last {
            let new = &bytes[(first - start) as usize..(last - start) as usize];
            buf[(first - offset) as usize..(last - offset) as usize].copy_from_slice(new);
        }
        Ok(())
    }
}

/// Bob Jenkins's lookup3 (`hashlittle`, seed 0): HDF5's checksum of metadata.
pub(super) fn lookup3(data: &[u8]) -> u32 {
    let seed = 0xdead_beef_u32.wrapping_add(data.len() as u32);
    let [mut a, mut b, mut c] = [seed; 3];
    // The last block, of up to twelve bytes, is mixed in another way.
    let blocks = data.len().div_ceil(12);
    for (i, block) in data.chunks(12).enumerate() {
        let word = |n: usize| block.iter().skip(4 * n).take(4).rev().fold(0u32, |w, &byte| w << 8 | u32::from(byte));
        a = a.wrapping_add(word(0));
        b = b.wrapping_add(word(1));
        c = c.wrapping_add(word(2));
        if i + 1 < blocks {
            for shift in [[4, 6, 8], [16, 19, 4]] {
                a = a.wrapping_sub(c) ^ c.rotate_left(shift[0]);
                c = c.wrapping_add(b);
                b = b.wrapping_sub(a) ^ a.rotate_left(shift[1]);
                a = a.wrapping_add(c);
                c = c.wrapping_sub(b) ^ b.rotate_left(shift[2]);
                b = b.wrapping_add(a);
            }
        } else {
            for [x, y, z] in [[14, 11, 25], [16, 4, 14]] {
                c = (c ^ b).wrapping_sub(b.rotate_left(x));
                a = (a ^ c).wrapping_sub(c.rotate_left(y));
                b = (b ^ a).wrapping_sub(a.rotate_left(z));
            }
            c = (c ^ b).wrapping_sub(b.rotate_left(24));
        }
    }
    c
}

#[cfg(test)]
mod tests {
    use super::lookup3;

    /// Jenkins's own examples, and lengths around a block.
    #[test]
    fn known_sums() {
        assert_eq!(lookup3(b""), 0xdead_beef);
        assert_eq!(lookup3(b"Four score and seven years ago"), 0x1777_0551);
    }
}
