//! Rewrites layout messages that `hdf5-pure` does not read into messages that it reads.
//!
//! h5py writes two such kinds with libver="latest":
//! - Version 5 (HDF5 2.0, compressed data sets). It differs from version 4 in one point: the size of a compressed chunk
//!   takes eight bytes in the chunk index instead of the fewest possible. The library reads the width of the entries
//!   from the index, so it reads such a data set once the message says version 4.
//! - Chunk sides of three bytes (HDF5 1.10 and later, chunks of 65,536 rows and more). The library knows 1, 2, 4 and 8.
//!
//! The library is given a view of the file whose header has the rewritten message.

use std::fs;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use hdf5_pure::{Error, File, FormatError, Source};

use super::image::Patch;

/// Opens the file with `patch` applied.
pub(super) fn open(path: &Path, bytes: u64, patch: Patch) -> Result<File, Error> {
    let file = fs::File::open(path).map_err(Error::Io)?;
    File::from_source(Patched { file: Mutex::new(file), bytes, patch })
}

/// The rewritten message; `None` if the library reads the message as it is, or if it is of neither kind above.
pub(super) fn rewritten(layout: &[u8]) -> Option<Vec<u8>> {
    let &[version @ (4 | 5), class, ref rest @ ..] = layout else {
        return None;
    };
    // 2: chunked, followed by flags, the number of sides, their width, and the sides.
    let &[flags, sides, width, ref rest @ ..] = rest else {
        return None;
    };
    let wider = match width {
        3 => 4,
        5..=7 => 8,
        other => other,
    };
    if class != 2 || wider == width || rest.len() < usize::from(sides) * usize::from(width) {
        return (version == 5).then(|| [&[4], &layout[1..]].concat());
    }
    let mut new = vec![4, class, flags, sides, wider];
    let (old, rest) = rest.split_at(usize::from(sides) * usize::from(width));
    for side in old.chunks_exact(usize::from(width)) {
        new.extend(side);
        new.resize(new.len() + usize::from(wider - width), 0);
    }
    new.extend(rest);
    Some(new)
}

struct Patched {
    file: Mutex<fs::File>,
    bytes: u64,
    patch: Patch,
}

impl Source for Patched {
    fn len(&self) -> u64 {
        self.bytes + self.patch.behind.len() as u64
    }

    fn read_at(&self, offset: u64, buf: &mut [u8]) -> Result<(), FormatError> {
        let told = |e: io::Error| FormatError::Source(e.to_string());
        let inside = buf.len().min(self.bytes.saturating_sub(offset) as usize);
        {
            let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
            file.seek(SeekFrom::Start(offset)).map_err(told)?;
            file.read_exact(&mut buf[..inside]).map_err(told)?;
        }
        overlay(buf, offset, &self.patch.bytes, self.patch.start);
        overlay(buf, offset, &self.patch.behind, self.bytes);
        if offset.saturating_add(buf.len() as u64) > self.len() {
            return Err(FormatError::Source("beyond the end of the file".into()));
        }
        Ok(())
    }
}

/// Copies the overlap of `new`, which starts at `start`, and `buf`, which starts at `offset`, into `buf`.
fn overlay(buf: &mut [u8], offset: u64, new: &[u8], start: u64) {
    let first = offset.max(start);
    let last = offset.saturating_add(buf.len() as u64).min(start + new.len() as u64);
    if first < last {
        let new = &new[(first - start) as usize..(last - start) as usize];
        buf[(first - offset) as usize..(last - offset) as usize].copy_from_slice(new);
    }
}

/// Bob Jenkins's lookup3 (`hashlittle`, seed 0), HDF5's metadata checksum.
pub(super) fn lookup3(data: &[u8]) -> u32 {
    let seed = 0xdead_beef_u32.wrapping_add(data.len() as u32);
    let [mut a, mut b, mut c] = [seed; 3];
    // The last block, of up to twelve bytes, is mixed differently.
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
    use super::{lookup3, overlay, rewritten};

    /// Jenkins's own examples, and lengths close to a multiple of the block.
    #[test]
    fn known_sums() {
        assert_eq!(lookup3(b""), 0xdead_beef);
        assert_eq!(lookup3(b"Four score and seven years ago"), 0x1777_0551);
    }

    #[test]
    fn layouts_are_rewritten() {
        // Version 4 with two-byte sides: no change. Version 5: only the version changes. Three-byte sides: four bytes.
        assert_eq!(rewritten(&[4, 2, 1, 2, 2, 7, 0, 4, 0, 1, 9]), None);
        assert_eq!(rewritten(&[5, 2, 1, 2, 2, 7, 0, 4, 0, 1, 9]).unwrap(), [4, 2, 1, 2, 2, 7, 0, 4, 0, 1, 9]);
        let wide = [4, 2, 1, 2, 4, 0, 0, 1, 0, 4, 0, 0, 0, 1, 9];
        assert_eq!(rewritten(&[4, 2, 1, 2, 3, 0, 0, 1, 4, 0, 0, 1, 9]).unwrap(), wide);
        assert_eq!(rewritten(&[5, 2, 1, 2, 3, 0, 0, 1, 4, 0, 0, 1, 9]).unwrap(), wide);
        assert_eq!(rewritten(&[3, 2, 1, 2, 3, 0, 0, 1]), None);
        assert_eq!(rewritten(&[4, 2, 1, 200, 3, 0, 0, 1]), None);
        assert_eq!(rewritten(&[4]), None);
    }

    #[test]
    fn overlays_meet_at_every_offset() {
        let whole = [0, 1, 2, 13, 14, 15, 6, 7];
        for start in 0..8u64 {
            for end in start..=8 {
                let mut buf: Vec<u8> = (start as u8..end as u8).collect();
                overlay(&mut buf, start, &[13, 14, 15], 3);
                assert_eq!(buf, whole[start as usize..end as usize], "{start}..{end}");
            }
        }
    }
}
