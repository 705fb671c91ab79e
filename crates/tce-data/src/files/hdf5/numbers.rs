//! Number types, and values that change when converted to float32.

use hdf5_pure::{Dataset, Datatype, DatatypeByteOrder, Error, FixedPointLayout, FloatingPointLayout};

/// From this number on, float32 cannot represent every integer.
const EXACT_INTEGERS: f32 = 16_777_216.0;
/// Rows per step when the stored numbers are checked again.
const WINDOW: u64 = 1 << 16;

/// Whether numbers of this type can be read.
pub(super) fn is_number(datatype: &Datatype) -> bool {
    match datatype {
        Datatype::FixedPoint { size, .. } => *size <= 8,
        Datatype::FloatingPoint { size, .. } => matches!(size, 4 | 8) || half_order(datatype).is_some(),
        // h5py stores booleans as an enumeration over int8.
        Datatype::Enumeration { base_type, .. } => matches!(**base_type, Datatype::FixedPoint { .. }),
        _ => false,
    }
}

/// Reads all numbers of a data set, row by row.
pub(super) fn read_f32(dataset: &Dataset, datatype: &Datatype) -> Result<Vec<f32>, Error> {
    let Some(order) = half_order(datatype) else {
        return dataset.read_f32();
    };
    let number: fn([u8; 2]) -> u16 = match order {
        DatatypeByteOrder::BigEndian => u16::from_be_bytes,
        _ => u16::from_le_bytes,
    };
    let raw = dataset.read_raw()?;
    Ok(raw.chunks_exact(2).map(|b| half_to_f32(number([b[0], b[1]]))).collect())
}

/// The byte order of IEEE float16, which the library does not read; `None` for any other type.
fn half_order(datatype: &Datatype) -> Option<DatatypeByteOrder> {
    let Datatype::FloatingPoint { size: 2, byte_order, layout } = datatype else {
        return None;
    };
    let ieee = FloatingPointLayout {
        bit_offset: 0,
        bit_precision: 16,
        exponent_location: 10,
        exponent_size: 5,
        mantissa_location: 0,
        mantissa_size: 10,
        exponent_bias: 15,
    };
    (*layout == ieee && *byte_order != DatatypeByteOrder::Vax).then_some(*byte_order)
}

/// The conversion is exact: float32 holds every float16.
fn half_to_f32(bits: u16) -> f32 {
    let sign = u32::from(bits >> 15) << 31;
    let (exponent, mantissa) = (u32::from(bits >> 10 & 0x1f), u32::from(bits & 0x3ff));
    let magnitude = match exponent {
        // Subnormal: multiples of 2^-24.
        0 => (mantissa as f32 * 2f32.powi(-24)).to_bits(),
        31 => 0x7f80_0000 | mantissa << 13,
        _ => (exponent + 112) << 23 | mantissa << 13,
    };
    f32::from_bits(sign | magnitude)
}

/// The stored number `at` (counted row by row, `dim` per row) if it is a finite float64.
pub(super) fn finite_f64(dataset: &Dataset, datatype: &Datatype, at: usize, dim: usize) -> Option<f64> {
    if !matches!(datatype, Datatype::FloatingPoint { size: 8, .. }) {
        return None;
    }
    let row = dataset.read_f64_rows((at / dim) as u64, 1).ok()?;
    row.get(at % dim).copied().filter(|x| x.is_finite())
}

/// The first numbers of a float64 data set of this many rows: enough of them to judge the others by.
pub(super) fn first_f64(dataset: &Dataset, rows: usize) -> Result<Vec<f64>, Error> {
    dataset.read_f64_rows(0, WINDOW.min(rows as u64))
}

/// The number of integers that differ from the stored ones; place (counted row by row) and value of the first one.
pub(super) struct Inexact {
    pub count: usize,
    pub first: (usize, i128),
}

/// Compares the float32 numbers with the stored integers; `None` if all are equal or the data set holds no integers.
pub(super) fn inexact_integers(
    dataset: &Dataset,
    datatype: &Datatype,
    data: &[f32],
    dim: usize,
) -> Result<Option<Inexact>, Error> {
    let Datatype::FixedPoint { layout: FixedPointLayout { signed, .. }, size: 4..=8, .. } = datatype else {
        return Ok(None);
    };
    // Integers up to 2^24 are exact, so nearly every file returns here.
    if data.iter().all(|x| x.abs() < EXACT_INTEGERS) {
        return Ok(None);
    }
    let mut found: Option<Inexact> = None;
    let rows = (data.len() / dim) as u64;
    for start in (0..rows).step_by(WINDOW as usize) {
        let count = WINDOW.min(rows - start);
        let stored: Vec<i128> = if *signed {
            dataset.read_i64_rows(start, count)?.into_iter().map(i128::from).collect()
        } else {
            dataset.read_u64_rows(start, count)?.into_iter().map(i128::from).collect()
        };
        let offset = start as usize * dim;
        for (i, (&number, &read)) in stored.iter().zip(&data[offset..]).enumerate() {
            if read as i128 != number {
                found.get_or_insert(Inexact { count: 0, first: (offset + i, number) }).count += 1;
            }
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::half_to_f32;

    #[test]
    fn halves() {
        for (bits, value) in [
            (0x0000, 0.0),
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x3555, 0.333_251_95),
            (0x7bff, 65504.0),
            (0x0001, 5.960_464_5e-8),
            (0x03ff, 6.097_555e-5),
            (0x0400, 6.103_515_6e-5),
            (0x7c00, f32::INFINITY),
            (0xfc00, f32::NEG_INFINITY),
        ] {
            assert_eq!(half_to_f32(bits), value, "{bits:#06x}");
        }
        assert!(half_to_f32(0x8000).is_sign_negative());
        assert!(half_to_f32(0x7e01).is_nan());
    }
}
