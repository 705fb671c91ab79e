//! Matrix products on raw slices, with what follows a product done while its tile is in the first-level cache.
//!
//! out ← finish(a b) or out + a b, with a `[m, k]`, b `[k, n]`, out `[m, n]` contiguous.
//!
//! As Goto and van de Geijn (2008): b is packed into panels of NR columns, which stay in the first-level cache; a passes in
//! micro-panels of MR rows, packed only where its rows are not contiguous; MR × NR sums are held in registers. Why not the
//! `gemm` crate, whose kernels are as fast: packing, the separate passes for bias and activation, and narrow layers were a
//! third of an IQL update (`bench/speed.md`), and weights that many batches share can be packed once here.
//!
//! Every element is one sum over k in ascending order, one fused multiply-add a term (sixteen interleaved sums where b has
//! few columns and was not packed before): the bits depend neither on the width of the vectors nor on how work is cut.

use std::cell::RefCell;
use std::mem::MaybeUninit;
use std::sync::OnceLock;

use crate::activation::Activation;
use crate::simd::Portable;
use kernel::{dots, drive};

mod kernel;

/// Memory for results that are written before they are read: zeroing it first was a tenth of an IQL update.
pub(crate) type Uninit = [MaybeUninit<f32>];

/// Terms per pass: a panel of b and a micro-panel of a fit the first-level cache (16 · 320 and 6 · 320 numbers, 28 KiB).
const TERMS: usize = 320;
/// Rows of a per pass: they fit the second-level cache beside b.
const ROWS: usize = 128;

/// Most columns of a right operand that are multiplied row by column: as many sums as the registers hold.
const DOTS: usize = 6;

/// A matrix in memory: first element, and the distance between rows and between columns.
#[derive(Clone, Copy)]
pub(crate) struct Matrix<'a> {
    data: &'a [f32],
    row: usize,
    column: usize,
}

impl<'a> Matrix<'a> {
    /// Row-major rows of `width`.
    pub fn plain(data: &'a [f32], width: usize) -> Self {
        Self { data, row: width, column: 1 }
    }

    /// The transpose of row-major rows of `width`.
    pub fn transposed(data: &'a [f32], width: usize) -> Self {
        Self { data, row: 1, column: width }
    }

    fn turn(self) -> Self {
        Self { row: self.column, column: self.row, ..self }
    }

    fn holds(&self, rows: usize, columns: usize) -> bool {
        rows > 0 && columns > 0 && (rows - 1) * self.row + (columns - 1) * self.column < self.data.len()
    }

    #[inline(always)]
    fn view(&self) -> View {
        View { data: self.data.as_ptr(), row: self.row, column: self.column }
    }
}

/// [`Matrix`] without its length.
#[derive(Clone, Copy)]
struct View {
    data: *const f32,
    row: usize,
    column: usize,
}

impl View {
    #[inline(always)]
    unsafe fn at(self, row: usize, column: usize) -> *const f32 {
        // SAFETY: the caller stays inside of the matrix.
        unsafe { self.data.add(row * self.row + column * self.column) }
    }

    #[inline(always)]
    unsafe fn from(self, row: usize, column: usize) -> Self {
        // SAFETY: as above.
        Self { data: unsafe { self.at(row, column) }, ..self }
    }
}

/// The right operand of a product.
#[derive(Clone, Copy)]
pub(crate) enum Right<'a> {
    /// Packed on the way.
    Matrix(Matrix<'a>),
    /// Packed before.
    Packed(&'a Packed),
}

/// What becomes of z = a b.
#[derive(Clone, Copy)]
pub(crate) enum Finish<'a> {
    /// It is the result.
    Store,
    /// It is added to what is there.
    Add,
    /// skip + act(z + bias), with act'(z + bias) to `kept`.
    Activate {
        /// `[n]`
        bias: &'a [f32],
        act: Activation,
        /// `[m, n]`, or null.
        kept: *mut f32,
        /// `[m, n]`
        skip: Option<&'a [f32]>,
    },
}

/// Which kernels this machine runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Isa {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    Portable,
    /// AVX-512's shapes on portable vectors: the tests of a machine without it.
    #[cfg(test)]
    Wide,
}

impl Isa {
    /// The widest first.
    pub fn available() -> Vec<Self> {
        let mut out = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                if is_x86_feature_detected!("avx512f") {
                    out.push(Self::Avx512);
                }
                out.push(Self::Avx2);
            }
        }
        out.push(Self::Portable);
        #[cfg(test)]
        out.push(Self::Wide);
        out
    }

    /// The one that is used.
    pub fn best() -> Self {
        static BEST: OnceLock<Isa> = OnceLock::new();
        *BEST.get_or_init(|| Self::available()[0])
    }

    /// Columns of a panel for a right operand of `n` columns.
    fn panel(self, n: usize) -> usize {
        let lanes = match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => 16,
            #[cfg(test)]
            Self::Wide => 16,
            _ => 8,
        };
        if n <= lanes { lanes } else { 2 * lanes }
    }
}

/// A right operand in the kernels' own layout, for many products: `[blocks of terms][panels][terms][NR]`.
pub(crate) struct Packed {
    isa: Isa,
    k: usize,
    n: usize,
    data: Vec<f32>,
}

impl Packed {
    /// Packs b `[k, n]`.
    pub fn new(b: Matrix, k: usize, n: usize) -> Self {
        Self::on(Isa::best(), b, k, n)
    }

    fn on(isa: Isa, b: Matrix, k: usize, n: usize) -> Self {
        assert!(b.holds(k, n));
        let mut data = vec![0.0; n.div_ceil(isa.panel(n)) * (isa.panel(n) * k + 16 * k.div_ceil(TERMS))];
        let job = Job { m: 1, n, k, a: b.view(), b: b.view(), packed: std::ptr::null(), out: std::ptr::null_mut() };
        // SAFETY: the matrix holds what is read, and `data` has room for all panels.
        unsafe { run(isa, &job, &Finish::Store, Scratch { b: data.as_mut_ptr(), a: std::ptr::null_mut() }, true) };
        Self { isa, k, n, data }
    }
}

thread_local! {
    static SCRATCH: RefCell<Vec<[f32; 16]>> = const { RefCell::new(Vec::new()) };
}

/// The product; see the head of this file. Without [`Finish::Add`] all of `out` is written and none of it read.
///
/// # Panics
/// If the operands do not hold what the sizes say.
pub(crate) fn product(out: &mut Uninit, a: Matrix, b: Right, [m, k, n]: [usize; 3], finish: Finish) {
    product_on(Isa::best(), out, a, b, [m, k, n], finish);
}

fn product_on(isa: Isa, out: &mut Uninit, a: Matrix, b: Right, [m, k, n]: [usize; 3], finish: Finish) {
    assert!(out.len() == m * n && a.holds(m, k));
    if let Finish::Activate { bias, skip, .. } = finish {
        assert!(bias.len() == n && skip.is_none_or(|s| s.len() == m * n));
    }
    let (b, packed) = match b {
        Right::Matrix(b) => {
            assert!(b.holds(k, n));
            (b, std::ptr::null())
        }
        Right::Packed(p) => {
            assert!(p.isa == isa && p.k == k && p.n == n);
            (Matrix { data: &p.data, row: n, column: 1 }, p.data.as_ptr())
        }
    };
    SCRATCH.with_borrow_mut(|scratch| {
        let packed_b = ((n.max(m) + 32) * (k.min(TERMS) + 16)).max(DOTS * k);
        let packed_a = (ROWS + 16) * TERMS;
        // A narrow product is turned over: its result passes through here.
        let turned = m.min(n) * m.max(n);
        let lines = (packed_b + packed_a + turned).div_ceil(16);
        if scratch.len() < lines {
            scratch.resize(lines, [0.0; 16]);
        }
        let start: *mut f32 = scratch.as_mut_ptr().cast();
        let out: *mut f32 = out.as_mut_ptr().cast();
        let job = Job { m, n, k, a: a.view(), b: b.view(), packed, out };
        // SAFETY: the assertions bound everything that the strides can reach, and the scratch has room for the panels.
        unsafe {
            let scratch = Scratch { b: start, a: start.add(packed_b) };
            // Few columns of an operand that would have to be packed (weights of the last layer's gradient): the
            // transpose has few rows, and passes over a as it lies in memory.
            if a.column != 1 && n < 8 && m > n && packed.is_null() && matches!(finish, Finish::Store | Finish::Add) {
                let turned = start.add(packed_b + packed_a);
                let job = Job { m: n, n: m, k, a: b.turn().view(), b: a.turn().view(), packed, out: turned };
                run(isa, &job, &Finish::Store, scratch, false);
                let add = matches!(finish, Finish::Add);
                for (i, j) in (0..m).flat_map(|i| (0..n).map(move |j| (i, j))) {
                    let (to, z) = (out.add(i * n + j), *turned.add(j * m + i));
                    *to = if add { *to + z } else { z };
                }
            } else {
                match (isa, packed.is_null() && a.column == 1 && n <= DOTS) {
                    (Isa::Portable, true) => dots_portable(&job, &finish, scratch.b),
                    #[cfg(test)]
                    (Isa::Wide, true) => dots_wide(&job, &finish, scratch.b),
                    #[cfg(target_arch = "x86_64")]
                    (Isa::Avx2, true) => dots_avx2(&job, &finish, scratch.b),
                    #[cfg(target_arch = "x86_64")]
                    (Isa::Avx512, true) => dots_avx512(&job, &finish, scratch.b),
                    _ => run(isa, &job, &finish, scratch, false),
                }
            }
        }
    });
}

#[derive(Clone, Copy)]
struct Job {
    m: usize,
    n: usize,
    k: usize,
    a: View,
    b: View,
    /// Panels of b, or null.
    packed: *const f32,
    out: *mut f32,
}

#[derive(Clone, Copy)]
struct Scratch {
    b: *mut f32,
    a: *mut f32,
}

/// The product, or only the packing of b.
unsafe fn run(isa: Isa, job: &Job, finish: &Finish, scratch: Scratch, pack_only: bool) {
    // SAFETY: the instruction set was detected; the rest is the caller's.
    unsafe {
        match (isa, isa.panel(job.n)) {
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx512, 16) => avx512_narrow(job, finish, scratch, pack_only),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx512, _) => avx512(job, finish, scratch, pack_only),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx2, 8) => avx2_narrow(job, finish, scratch, pack_only),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx2, _) => avx2(job, finish, scratch, pack_only),
            #[cfg(test)]
            (Isa::Wide, 16) => drive::<Portable<16>, 12, 1, 16>(job, finish, scratch, pack_only),
            #[cfg(test)]
            (Isa::Wide, _) => drive::<Portable<16>, 12, 2, 32>(job, finish, scratch, pack_only),
            (Isa::Portable, 8) => drive::<Portable<8>, 4, 1, 8>(job, finish, scratch, pack_only),
            (Isa::Portable, _) => drive::<Portable<8>, 4, 2, 16>(job, finish, scratch, pack_only),
        }
    }
}

macro_rules! kernel {
    ($name:ident, $features:literal, $vector:ty, $mr:literal, $nv:literal, $nr:literal) => {
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = $features)]
        unsafe fn $name(job: &Job, finish: &Finish, scratch: Scratch, pack_only: bool) {
            // SAFETY: the caller's.
            unsafe { drive::<$vector, $mr, $nv, $nr>(job, finish, scratch, pack_only) }
        }
    };
}

/// [`dots`] for as many columns as there are, at most [`DOTS`].
macro_rules! dots {
    ($name:ident, $vector:ty, $vectors:literal, $(#[$attribute:meta])*) => {
        $(#[$attribute])*
        unsafe fn $name(job: &Job, finish: &Finish, columns: *mut f32) {
            // SAFETY: the caller's.
            unsafe {
                match job.n {
                    1 => dots::<$vector, 1, $vectors>(job, finish, columns),
                    2 => dots::<$vector, 2, $vectors>(job, finish, columns),
                    3 => dots::<$vector, 3, $vectors>(job, finish, columns),
                    4 => dots::<$vector, 4, $vectors>(job, finish, columns),
                    5 => dots::<$vector, 5, $vectors>(job, finish, columns),
                    _ => dots::<$vector, 6, $vectors>(job, finish, columns),
                }
            }
        }
    };
}

dots!(dots_portable, Portable<8>, 2,);
dots!(dots_wide, Portable<16>, 1, #[cfg(test)]);
dots!(dots_avx2, std::arch::x86_64::__m256, 2, #[cfg(target_arch = "x86_64")] #[target_feature(enable = "avx2,fma")]);
dots!(dots_avx512, std::arch::x86_64::__m512, 1,
    #[cfg(target_arch = "x86_64")] #[target_feature(enable = "avx512f,avx2,fma")]);

// Sums in registers: 12 of 16 with AVX2, 24 of 32 with AVX-512.
kernel!(avx2, "avx2,fma", std::arch::x86_64::__m256, 6, 2, 16);
kernel!(avx2_narrow, "avx2,fma", std::arch::x86_64::__m256, 12, 1, 8);
kernel!(avx512, "avx512f,avx2,fma", std::arch::x86_64::__m512, 12, 2, 32);
kernel!(avx512_narrow, "avx512f,avx2,fma", std::arch::x86_64::__m512, 12, 1, 16);

#[cfg(test)]
mod tests;
