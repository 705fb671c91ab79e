use proptest::prelude::*;
use tce_base::{Streams, random::fill_normal};

use super::*;
use crate::kernels::{room, written};

fn normal(name: &str, n: usize) -> Vec<f32> {
    let mut data = vec![0.0; n];
    fill_normal(&mut Streams::new(3).stream(name), &mut data);
    data
}

impl Isa {
    fn is_portable(self) -> bool {
        matches!(self, Isa::Portable | Isa::Wide)
    }
}

fn matrix(data: &[f32], rows: usize, columns: usize, transposed: bool) -> Matrix<'_> {
    if transposed { Matrix::transposed(data, rows) } else { Matrix::plain(data, columns) }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Against sums in f64, for every instruction set of this machine, and all of them alike to the bit.
    #[test]
    fn products_are_sums_of_products(
        m in prop_oneof![1usize..40, 100usize..300], k in prop_oneof![1usize..40, 300usize..700], n in 1usize..70,
        (ta, tb, kind, packed) in (any::<bool>(), any::<bool>(), 0..4, any::<bool>()),
    ) {
        let (a, b) = (normal("a", m * k), normal("b", k * n));
        let (left, right) = (matrix(&a, m, k, ta), matrix(&b, k, n, tb));
        let (bias, skip, before) = (normal("bias", n), normal("skip", m * n), normal("before", m * n));
        let mut kept = vec![0.0; m * n];
        let finish = match kind {
            0 => Finish::Store,
            1 => Finish::Add,
            2 => Finish::Activate { bias: &bias, act: Activation::Relu, kept: std::ptr::null_mut(), skip: None },
            _ => Finish::Activate { bias: &bias, act: Activation::Silu, kept: kept.as_mut_ptr(), skip: Some(&skip) },
        };
        let expected = |i: usize, j: usize| {
            let term = |t: usize| left.data[i * left.row + t * left.column] as f64
                * right.data[t * right.row + j * right.column] as f64;
            // The result and, for the last kind, the slope.
            let z = (0..k).map(term).sum::<f64>();
            let active = z + bias[j] as f64;
            match kind {
                0 => (z, z),
                1 => (z + before[i * n + j] as f64, z),
                2 => (active.max(0.0), active),
                _ => {
                    let s = 1.0 / (1.0 + (-active).exp());
                    (active * s + skip[i * n + j] as f64, s * (1.0 + active * (1.0 - s)))
                }
            }
        };
        let mut first: Option<(Isa, Vec<f32>)> = None;
        for isa in Isa::available() {
            let mut out = room(m * n);
            before.iter().zip(&mut out).for_each(|(b, o)| { o.write(*b); });
            let whole;
            let right = match packed {
                true => { whole = Packed::on(isa, right, k, n); Right::Packed(&whole) }
                false => Right::Matrix(right),
            };
            product_on(isa, &mut out, left, right, [m, k, n], finish);
            // SAFETY: `before` was written, whatever the product did.
            let out = unsafe { written(out) };
            let tolerance = 4e-6 * (k as f64).sqrt() * 4.0;
            for (i, j) in (0..m).flat_map(|i| (0..n).map(move |j| (i, j))) {
                let (y, z) = expected(i, j);
                prop_assert!((out[i * n + j] as f64 - y).abs() < tolerance, "{isa:?} [{i}, {j}]");
                prop_assert!(kind != 3 || (kept[i * n + j] as f64 - z).abs() < tolerance, "kept, {isa:?} [{i}, {j}]");
            }
            match &first {
                None => first = Some((isa, out)),
                // Alike among those with a fused multiply-add, and among the portable ones, which on x86 have none.
                Some((other, bits)) if isa.is_portable() == other.is_portable() => {
                    prop_assert_eq!(bits, &out, "{:?} and {:?}", other, isa)
                }
                _ => first = Some((isa, out)),
            }
        }
    }
}

#[test]
#[should_panic = "holds"]
fn sizes_that_do_not_fit_are_refused() {
    let (a, b) = (normal("a", 12), normal("b", 11));
    product(&mut room(9), Matrix::plain(&a, 4), Right::Matrix(Matrix::plain(&b, 3)), [3, 4, 3], Finish::Store);
}
