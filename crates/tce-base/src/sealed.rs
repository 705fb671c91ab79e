//! Files with a cache key and a checksum in their first line.
//!
//! `tce-sealed 1 KEY SHA256\n`. The key is the hash of the specification that the bytes belong to: leftovers of other work
//! are recognised by it. The checksum covers key and bytes, and detects damage.

use std::path::Path;

use sha2::{Digest, Sha256};

use crate::files::{FileError, hex, read_if_there, write_atomically};

const MAGIC: &str = "tce-sealed 1";

/// What [`read_sealed`] found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sealed {
    /// No file.
    Absent,
    /// A whole file of other work.
    Foreign,
    /// A file that is cut, changed, or none of ours.
    Damaged,
    /// The bytes.
    Whole(Vec<u8>),
}

fn header(key: &str, bytes: &[u8]) -> String {
    let mut hash = Sha256::new();
    hash.update(key.as_bytes());
    hash.update(b"\n");
    hash.update(bytes);
    format!("{MAGIC} {key} {}\n", hex(&hash.finalize()))
}

/// Writes `bytes` to `path`, whole or not at all. `key` is one word.
///
/// # Errors
/// If the file cannot be written.
pub fn write_sealed(path: &Path, key: &str, bytes: &[u8]) -> Result<(), FileError> {
    assert!(!key.is_empty() && !key.contains(char::is_whitespace), "a key is one word, not {key:?}");
    let mut all = header(key, bytes).into_bytes();
    all.extend_from_slice(bytes);
    write_atomically(path, &all)
}

/// Reads what [`write_sealed`] wrote.
///
/// # Errors
/// If there is a file that cannot be read at all; damage is no error.
pub fn read_sealed(path: &Path, key: &str) -> Result<Sealed, FileError> {
    let Some(mut all) = read_if_there(path)? else { return Ok(Sealed::Absent) };
    let Some(end) = all.iter().position(|b| *b == b'\n') else { return Ok(Sealed::Damaged) };
    let Some(line) = std::str::from_utf8(&all[..end]).ok().and_then(|l| l.strip_prefix(MAGIC)) else {
        return Ok(Sealed::Damaged);
    };
    let Some(found) = line.trim_start().split(' ').next().map(str::to_owned) else { return Ok(Sealed::Damaged) };
    let sound = header(&found, &all[end + 1..]).as_bytes() == &all[..=end];
    Ok(match (sound, found == key) {
        (false, _) => Sealed::Damaged,
        (true, false) => Sealed::Foreign,
        (true, true) => {
            all.drain(..=end);
            Sealed::Whole(all)
        }
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn any_change_is_noticed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x");
        assert_eq!(read_sealed(&path, "k").unwrap(), Sealed::Absent);
        write_sealed(&path, "k", b"some\nbytes").unwrap();
        assert_eq!(read_sealed(&path, "k").unwrap(), Sealed::Whole(b"some\nbytes".to_vec()));
        assert_eq!(read_sealed(&path, "other").unwrap(), Sealed::Foreign);
        let whole = fs::read(&path).unwrap();
        for cut in 0..whole.len() {
            fs::write(&path, &whole[..cut]).unwrap();
            assert_eq!(read_sealed(&path, "k").unwrap(), Sealed::Damaged, "cut at {cut}");
        }
        for bit in 0..8 * whole.len() {
            let mut bytes = whole.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            fs::write(&path, &bytes).unwrap();
            assert_eq!(read_sealed(&path, "k").unwrap(), Sealed::Damaged, "bit {bit}");
        }
    }
}
