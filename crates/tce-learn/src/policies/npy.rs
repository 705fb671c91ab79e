//! Arrays in numpy's files (`.npy`, and the members of `.npz`), limited to what policies need: f32 and f64 numbers, and
//! text. Crates that support the complete format have thirty dependencies.

use std::io::{Error, ErrorKind, Result};

/// An array: its shape, and its values in C's order.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Array {
    /// All elements, concatenated.
    Text(String),
    /// Shape and values, row-major.
    Numbers(Vec<usize>, Vec<f64>),
}

/// Longest text in characters; texts are only names of kinds.
const LONGEST_TEXT: usize = 1000;

fn invalid<T>(what: String) -> Result<T> {
    Err(Error::new(ErrorKind::InvalidData, what))
}

/// The array in the bytes of a `.npy` file. Memory use is limited by these bytes, even if a damaged file declares more.
pub(crate) fn parse(bytes: &[u8]) -> Result<Array> {
    let (header, body) = split(bytes)?;
    let (descr, fortran, shape) = (text_of(header, "descr")?, is_fortran(header)?, shape_of(header)?);
    let Some(count) = shape.iter().try_fold(1_usize, |n, &d| n.checked_mul(d)) else {
        return invalid(format!("an array of shape {shape:?}"));
    };
    let values: Vec<f64> = match descr {
        "<f8" => body.as_chunks::<8>().0.iter().take(count).map(|b| f64::from_le_bytes(*b)).collect(),
        "<f4" => body.as_chunks::<4>().0.iter().take(count).map(|b| f32::from_le_bytes(*b).into()).collect(),
        _ => return text(descr, count, body),
    };
    if values.len() < count {
        return invalid(format!("{} numbers in an array of shape {shape:?}", values.len()));
    }
    let row_major = match (fortran, shape.as_slice()) {
        (true, &[rows, columns]) => (0..count).map(|k| values[k % columns * rows + k / columns]).collect(),
        (true, [_, _, ..]) => return invalid(format!("an array of {} dimensions in Fortran's order", shape.len())),
        _ => values,
    };
    Ok(Array::Numbers(shape, row_major))
}

/// Texts of up to n letters, four bytes each, padded with zeros.
fn text(descr: &str, count: usize, body: &[u8]) -> Result<Array> {
    let length = descr.strip_prefix("<U").and_then(|n| n.parse::<usize>().ok()).filter(|n| *n <= LONGEST_TEXT);
    let Some(length) = length else {
        return invalid(format!("an array of type {descr}; only <f4, <f8 and texts are read"));
    };
    let letters: Vec<u32> =
        body.as_chunks::<4>().0.iter().take(length.saturating_mul(count)).map(|b| u32::from_le_bytes(*b)).collect();
    if letters.len() < length.saturating_mul(count) {
        return invalid(format!("{} letters, expected {count} texts of {length}", letters.len()));
    }
    let text: Option<String> = letters.into_iter().filter(|c| *c != 0).map(char::from_u32).collect();
    text.map_or_else(|| invalid("letters that do not exist".into()), |t| Ok(Array::Text(t)))
}

/// Splits the header (a literal of a Python dict) from the data that follow.
fn split(bytes: &[u8]) -> Result<(&str, &[u8])> {
    let short = |n: &[u8; 2]| u16::from_le_bytes(*n) as usize;
    let long = |n: &[u8; 4]| u32::from_le_bytes(*n) as usize;
    let (size, rest) = match bytes.split_first_chunk::<8>() {
        Some((b"\x93NUMPY\x01\x00", rest)) => (rest.first_chunk().map(short), rest.get(2..)),
        Some((b"\x93NUMPY\x02\x00" | b"\x93NUMPY\x03\x00", rest)) => (rest.first_chunk().map(long), rest.get(4..)),
        Some(_) => return invalid("no array of numpy's format, versions 1 to 3".into()),
        None => (None, None),
    };
    match size.zip(rest).and_then(|(size, rest)| rest.split_at_checked(size)) {
        Some((header, body)) => match std::str::from_utf8(header) {
            Ok(header) => Ok((header, body)),
            Err(e) => invalid(format!("a header that is no text: {e}")),
        },
        None => invalid(format!("a header that is longer than the array's {} bytes", bytes.len())),
    }
}

/// The part of the header after `'name':`.
fn value_of<'a>(header: &'a str, name: &str) -> Result<&'a str> {
    let after = [format!("'{name}'"), format!("\"{name}\"")].iter().find_map(|key| header.split_once(key.as_str()));
    match after.and_then(|(_, rest)| rest.trim_start().strip_prefix(':')) {
        Some(value) => Ok(value.trim_start()),
        None => invalid(format!("a header without {name}: {}", header.trim())),
    }
}

fn text_of<'a>(header: &'a str, name: &str) -> Result<&'a str> {
    let value = value_of(header, name)?;
    let quoted = value.strip_prefix(['\'', '"']).and_then(|rest| rest.split(['\'', '"']).next());
    quoted.map_or_else(|| invalid(format!("a header with {name} {}; expected a text", value.trim())), Ok)
}

fn is_fortran(header: &str) -> Result<bool> {
    match value_of(header, "fortran_order")? {
        value if value.starts_with("True") => Ok(true),
        value if value.starts_with("False") => Ok(false),
        value => invalid(format!("a header with fortran_order {}; expected True or False", value.trim())),
    }
}

fn shape_of(header: &str) -> Result<Vec<usize>> {
    let value = value_of(header, "shape")?;
    let inside = value.strip_prefix('(').and_then(|rest| rest.split_once(')')).map(|(inside, _)| inside);
    // `(3,)` has a comma after its only number.
    let numbers = |inside: &str| {
        let numbers = inside.trim().trim_end_matches(',').split(',').map(str::trim).filter(|n| !n.is_empty());
        numbers.map(|n| n.parse().ok()).collect()
    };
    inside.and_then(numbers).map_or_else(|| invalid(format!("a header with shape {}", value.trim())), Ok)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A version 1 file with this header, padded to a multiple of 64 bytes as numpy does.
    fn file(header: &str, body: &[u8]) -> Vec<u8> {
        let header = format!("{header:<117}\n");
        let size = (header.len() as u16).to_le_bytes();
        [b"\x93NUMPY\x01\x00".as_slice(), &size, header.as_bytes(), body].concat()
    }

    fn numbers(values: &[f64]) -> Vec<u8> {
        values.iter().flat_map(|v| v.to_le_bytes()).collect()
    }

    #[test]
    fn numbers_come_in_cs_order() {
        let body = numbers(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        let c = file("{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), }", &body);
        assert_eq!(parse(&c).unwrap(), Array::Numbers(vec![2, 3], vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
        let fortran = file("{'descr': '<f8', 'fortran_order': True, 'shape': (2, 3), }", &body);
        assert_eq!(parse(&fortran).unwrap(), Array::Numbers(vec![2, 3], vec![1.0, 3.0, 5.0, 2.0, 4.0, 6.0]));
        let singles: Vec<u8> = [0.5_f32, -1.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let row = file("{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }", &singles);
        assert_eq!(parse(&row).unwrap(), Array::Numbers(vec![2], vec![0.5, -1.0]));
        let scalar = file("{'descr': '<f8', 'fortran_order': False, 'shape': (), }", &numbers(&[7.0]));
        assert_eq!(parse(&scalar).unwrap(), Array::Numbers(vec![], vec![7.0]));
        let nothing = file("{'descr': '<f8', 'fortran_order': True, 'shape': (0, 3), }", &[]);
        assert_eq!(parse(&nothing).unwrap(), Array::Numbers(vec![0, 3], vec![]));
    }

    #[test]
    fn texts_end_where_their_zeros_begin() {
        let body: Vec<u8> = "relu\0\0".chars().flat_map(|c| (c as u32).to_le_bytes()).collect();
        let text = file("{'descr': '<U6', 'fortran_order': False, 'shape': (), }", &body);
        assert_eq!(parse(&text).unwrap(), Array::Text("relu".into()));
    }

    #[test]
    fn what_is_damaged_is_told() {
        let body = numbers(&[1.0]);
        for (bytes, needle) in [
            (b"PK".to_vec(), "longer than"),
            (b"NUMPY 12".to_vec(), "no array of numpy's format"),
            (b"\x93NUMPY\x02\x00\xff\xff\xff\xff{".to_vec(), "longer than"),
            (file("{'descr': '<f8', 'shape': (1,)}", &body), "without fortran_order"),
            (file("{'descr': '<f8', 'fortran_order': False, 'shape': (2,), }", &body), "1 numbers"),
            (file("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }", &body), "shape (-1,)"),
            (file("{'descr': '<i8', 'fortran_order': False, 'shape': (1,), }", &body), "type <i8"),
            (file("{'descr': '<U9999', 'fortran_order': False, 'shape': (), }", &body), "type <U9999"),
            (file("{'descr': '<f8', 'fortran_order': 1, 'shape': (1,), }", &body), "expected True or False"),
            (
                file(&format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({0}, {0}), }}", u64::MAX), &body),
                "shape",
            ),
        ] {
            let error = parse(&bytes).unwrap_err().to_string();
            assert!(error.contains(needle), "{error}");
        }
    }

    proptest! {
        #[test]
        fn no_bytes_bring_the_reader_down(bytes in proptest::collection::vec(any::<u8>(), 0..300), at in 0_usize..200, to: u8) {
            let _ = parse(&bytes);
            let mut near = file("{'descr': '<f4', 'fortran_order': True, 'shape': (3, 4), }", &[1; 48]);
            if let Some(byte) = near.get_mut(at) {
                *byte = to;
            }
            let _ = parse(&near);
        }
    }
}
