//! Matrix products on raw slices, with what follows a product done while its tile is in the first-level cache.
//!
//! out ← finish(a b) or out + a b, with a `[m, k]`, b `[k, n]`, out `[m, n]` contiguous.
//!
//! As Goto and van de Geijn (2008): b is packed into panels of NR columns, which stay in the first-level cache; a passes in
//! micro-panels of MR rows, packed only where its rows are not contiguous; MR × NR sums are held in registers. Why not the
//! `gemm` crate, whose kernels are as fast: packing, the separate passes for bias and activation, and narrow layers were a
//! third of an IQL update (`bench/speed.md`), and weights that many batches share can be packed once here.
//!
//! Every element is one sum over k in ascending order, one fused multiply-add a term: the bits depend neither on the
//! width of the vectors nor on how work is cut.

use std::cell::RefCell;
use std::mem::MaybeUninit;
use std::sync::OnceLock;

use crate::activation::Activation;
use crate::simd::{Portable, Simd};

/// Memory for results that are written before they are read: zeroing it first was a tenth of an IQL update.
pub(crate) type Uninit = [MaybeUninit<f32>];

/// Terms per pass: a panel of b and a micro-panel of a fit the first-level cache (16 · 320 and 6 · 320 numbers, 28 KiB).
const TERMS: usize = 320;
/// Rows of a per pass: they fit the second-level cache beside b.
const ROWS: usize = 128;

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
    /// skip + act(z + bias); z + bias goes to `kept`, skip to nothing where there is none.
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
}

impl Isa {
    /// The widest first.
    pub fn available() -> Vec<Self> {
        let mut out = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx2") {
                out.push(Self::Avx512);
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                out.push(Self::Avx2);
            }
        }
        out.push(Self::Portable);
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
        assert!(b.holds(k, n));
        let isa = Isa::best();
        let mut data = vec![0.0; n.div_ceil(isa.panel(n)) * isa.panel(n) * k];
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
        let packed_b = (n.max(m) + 32) * k.min(TERMS);
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
                run(isa, &job, &finish, scratch, false);
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
            (Isa::Portable, 8) => drive::<Portable, 4, 1, 8>(job, finish, scratch, pack_only),
            (Isa::Portable, _) => drive::<Portable, 4, 2, 16>(job, finish, scratch, pack_only),
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

// Sums in registers: 12 of 16 with AVX2, 24 of 32 with AVX-512.
kernel!(avx2, "avx2,fma", std::arch::x86_64::__m256, 6, 2, 16);
kernel!(avx2_narrow, "avx2,fma", std::arch::x86_64::__m256, 12, 1, 8);
kernel!(avx512, "avx512f,avx2,fma", std::arch::x86_64::__m512, 12, 2, 32);
kernel!(avx512_narrow, "avx512f,avx2,fma", std::arch::x86_64::__m512, 12, 1, 16);

/// The loops around the micro-kernel.
#[inline(always)]
unsafe fn drive<V: Simd, const MR: usize, const NV: usize, const NR: usize>(
    job: &Job,
    finish: &Finish,
    scratch: Scratch,
    pack_only: bool,
) {
    let &Job { m, n, k, a, b, packed, out } = job;
    let terms = k.div_ceil(k.div_ceil(TERMS));
    let rows = m.div_ceil(m.div_ceil(ROWS)).div_ceil(MR) * MR;
    let panels = n.div_ceil(NR);
    // Few rows of a read b once or twice: packing it would cost more than it saves.
    let direct = packed.is_null() && !pack_only && b.column == 1 && m <= MR;
    // SAFETY: the caller's; every index stays below m, n and k.
    unsafe {
        for k0 in (0..k).step_by(terms) {
            let count = terms.min(k - k0);
            let whole = panels * NR * k0;
            let own = if pack_only { scratch.b.add(whole) } else { scratch.b };
            if packed.is_null() {
                // The last panel of a direct operand may be a partial one, which the kernel cannot read.
                let from = if direct { n / NR } else { 0 };
                for j in from..panels {
                    pack_right::<V, NR>(b.from(k0, j * NR), count, NR.min(n - j * NR), own.add(j * NR * count));
                }
            }
            if pack_only {
                continue;
            }
            let ready = if packed.is_null() { own.cast_const() } else { packed.add(whole) };
            let add = k0 > 0 || matches!(finish, Finish::Add);
            let last = k0 + count == k;
            for m0 in (0..m).step_by(rows) {
                let height = rows.min(m - m0);
                let block = a.from(m0, k0);
                if a.column != 1 {
                    pack_left::<MR>(block, height, count, scratch.a);
                }
                for j in 0..panels {
                    let width = NR.min(n - j * NR);
                    let (b, b_row) = match direct && width == NR {
                        true => (b.at(k0, j * NR), b.row),
                        false => (ready.add(j * NR * count), NR),
                    };
                    for i in (0..height).step_by(MR) {
                        let count_rows = MR.min(height - i);
                        let at = (m0 + i) * n + j * NR;
                        let (a, a_row, a_column) = match a.column != 1 {
                            true => (scratch.a.add(i * count).cast_const(), 1, count_rows),
                            false => (block.at(i, 0), block.row, 1),
                        };
                        if width == NR {
                            tiles::<V, MR, NV>(count_rows, count, a, a_row, a_column, b, b_row, out.add(at), n, add);
                        } else {
                            let mut edge = [[0.0f32; NR]; MR];
                            let edge: *mut f32 = edge.as_mut_ptr().cast();
                            let copy = |from: *const f32, step: usize, to: *mut f32, to_step: usize| {
                                for r in 0..count_rows {
                                    std::ptr::copy_nonoverlapping(from.add(r * step), to.add(r * to_step), width);
                                }
                            };
                            if add {
                                copy(out.add(at), n, edge, NR);
                            }
                            tiles::<V, MR, NV>(count_rows, count, a, a_row, a_column, b, b_row, edge, NR, add);
                            copy(edge, NR, out.add(at), n);
                        }
                        if last && let Finish::Activate { bias, act, kept, skip } = *finish {
                            let bias = bias.as_ptr().add(j * NR);
                            for r in 0..count_rows {
                                let at = at + r * n;
                                let kept = if kept.is_null() { kept } else { kept.add(at) };
                                let skip = skip.map_or(std::ptr::null(), |s| s.as_ptr().add(at));
                                // A width the compiler knows makes whole vectors of the row.
                                let width = if width == NR { NR } else { width };
                                activate(out.add(at), bias, kept, skip, width, act);
                            }
                        }
                    }
                }
            }
        }
    }
}

#[inline(always)]
unsafe fn activate(z: *mut f32, bias: *const f32, kept: *mut f32, skip: *const f32, width: usize, act: Activation) {
    // SAFETY: the caller's: `width` numbers each, and no two of them overlap.
    let (z, bias) = unsafe { (std::slice::from_raw_parts_mut(z, width), std::slice::from_raw_parts(bias, width)) };
    for (z, b) in z.iter_mut().zip(bias) {
        *z += b;
    }
    if !kept.is_null() {
        // SAFETY: as above.
        unsafe { std::ptr::copy_nonoverlapping(z.as_ptr(), kept, width) };
    }
    act.apply(z);
    if !skip.is_null() {
        // SAFETY: as above.
        let skip = unsafe { std::slice::from_raw_parts(skip, width) };
        for (z, s) in z.iter_mut().zip(skip) {
            *z += s;
        }
    }
}

/// Packs `width` columns of b, filled up with zeros: `[terms][NR]`.
#[inline(always)]
unsafe fn pack_right<V: Simd, const NR: usize>(b: View, terms: usize, width: usize, to: *mut f32) {
    // SAFETY: the caller's.
    unsafe {
        if width == NR && b.column == 1 {
            for i in 0..terms {
                *to.add(i * NR).cast::<[f32; NR]>() = *b.at(i, 0).cast::<[f32; NR]>();
            }
            return;
        }
        let blocks = if width == NR && b.row == 1 { terms / 8 * 8 } else { 0 };
        for i in (0..blocks).step_by(8) {
            for c in (0..NR).step_by(8) {
                V::transpose(b.at(i, c), b.column, to.add(i * NR + c), NR);
            }
        }
        for i in blocks..terms {
            for c in 0..NR {
                *to.add(i * NR + c) = if c < width { *b.at(i, c) } else { 0.0 };
            }
        }
    }
}

/// Packs rows of a into micro-panels `[terms][MR]`, the last one as wide as there are rows left.
#[inline(always)]
unsafe fn pack_left<const MR: usize>(a: View, rows: usize, terms: usize, to: *mut f32) {
    let (full, rest) = (rows / MR, rows % MR);
    // SAFETY: the caller's.
    unsafe {
        for i in 0..terms {
            for p in 0..full {
                let to = to.add((p * terms + i) * MR);
                if a.row == 1 {
                    *to.cast::<[f32; MR]>() = *a.at(p * MR, i).cast::<[f32; MR]>();
                } else {
                    for r in 0..MR {
                        *to.add(r) = *a.at(p * MR + r, i);
                    }
                }
            }
            for r in 0..rest {
                *to.add(full * terms * MR + i * rest + r) = *a.at(full * MR + r, i);
            }
        }
    }
}

/// [`tile`] for as many rows as there are.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
unsafe fn tiles<V: Simd, const MR: usize, const NV: usize>(
    rows: usize,
    terms: usize,
    a: *const f32,
    a_row: usize,
    a_column: usize,
    b: *const f32,
    b_row: usize,
    out: *mut f32,
    out_row: usize,
    add: bool,
) {
    macro_rules! rows {
        ($($r:literal)*) => {
            match rows {
                // The strides are constants where it matters.
                r if r == MR && a_row == 1 => tile::<V, MR, NV>(terms, a, 1, MR, b, b_row, out, out_row, add),
                r if r == MR => tile::<V, MR, NV>(terms, a, a_row, 1, b, b_row, out, out_row, add),
                $($r if $r < MR => tile::<V, $r, NV>(terms, a, a_row, a_column, b, b_row, out, out_row, add),)*
                _ => unreachable!("a micro-panel has at most MR rows"),
            }
        };
    }
    // SAFETY: the caller's.
    unsafe { rows!(1 2 3 4 5 6 7 8 9 10 11) }
}

/// The micro-kernel: MR × NV vectors of sums in registers.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
unsafe fn tile<V: Simd, const MR: usize, const NV: usize>(
    terms: usize,
    mut a: *const f32,
    a_row: usize,
    a_column: usize,
    mut b: *const f32,
    b_row: usize,
    out: *mut f32,
    out_row: usize,
    add: bool,
) {
    // SAFETY: the caller's.
    unsafe {
        let mut sums = [[V::splat(0.0); NV]; MR];
        if add {
            for (r, sums) in sums.iter_mut().enumerate() {
                for (j, sum) in sums.iter_mut().enumerate() {
                    *sum = V::load(out.add(r * out_row + j * V::LANES));
                }
            }
        }
        for _ in 0..terms {
            let mut right = [V::splat(0.0); NV];
            for (j, right) in right.iter_mut().enumerate() {
                *right = V::load(b.add(j * V::LANES));
            }
            for (r, sums) in sums.iter_mut().enumerate() {
                let left = V::splat(*a.add(r * a_row));
                for (sum, right) in sums.iter_mut().zip(&right) {
                    *sum = sum.fma(left, *right);
                }
            }
            a = a.add(a_column);
            b = b.add(b_row);
        }
        for (r, sums) in sums.iter().enumerate() {
            for (j, sum) in sums.iter().enumerate() {
                sum.store(out.add(r * out_row + j * V::LANES));
            }
        }
    }
}

#[cfg(test)]
mod tests;
