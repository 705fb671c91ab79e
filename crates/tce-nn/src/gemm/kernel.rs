//! The loops, the packing and the micro-kernels of [`product`](super::product), for any vector; the caller has checked all
//! sizes.

use super::{Finish, Job, ROWS, Scratch, TERMS, View};
use crate::activation::Activation;
use crate::simd::Simd;

/// The loops around the micro-kernel.
#[inline(always)]
pub(super) unsafe fn drive<V: Simd, const MR: usize, const NV: usize, const NR: usize>(
    job: &Job,
    finish: &Finish,
    scratch: Scratch,
    pack_only: bool,
) {
    let &Job { m, n, k, a, b, packed, out } = job;
    let terms = k.div_ceil(k.div_ceil(TERMS));
    let rows = m.div_ceil(m.div_ceil(ROWS)).div_ceil(MR) * MR;
    let panels = n.div_ceil(NR);
    let fused = Fused::new(finish);
    // Few rows of a read b two or three times: packing it would cost more than it saves.
    let direct = packed.is_null() && !pack_only && b.column == 1 && m <= 3 * MR;
    // SAFETY: the caller's; every index stays below m, n and k.
    unsafe {
        for k0 in (0..k).step_by(terms) {
            let count = terms.min(k - k0);
            // A line between panels: rows of neighbouring panels must not fall into one set of the first-level cache.
            let stride = NR * count + 16;
            let whole = panels * (NR * k0 + 16 * (k0 / terms));
            let own = if pack_only { scratch.b.add(whole) } else { scratch.b };
            if packed.is_null() {
                // The last panel of a direct operand may be a partial one, which the kernel cannot read.
                let from = if direct { n / NR } else { 0 };
                // Whole panels of contiguous rows are packed row by row: memory is read in its order.
                let whole = if direct || b.column != 1 { from } else { n / NR };
                for i in 0..count {
                    for j in from..whole {
                        *own.add(j * stride + i * NR).cast::<[f32; NR]>() = *b.at(k0 + i, j * NR).cast::<[f32; NR]>();
                    }
                }
                for j in whole..panels {
                    pack_right::<V, NR>(b.from(k0, j * NR), count, NR.min(n - j * NR), own.add(j * stride));
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
                        false => (ready.add(j * stride), NR),
                    };
                    for i in (0..height).step_by(MR) {
                        let count_rows = MR.min(height - i);
                        let at = (m0 + i) * n + j * NR;
                        // The next rows of a, the first time they are read, and of the result.
                        for r in i + MR..height.min(i + 2 * MR) {
                            let lines = if j == 0 && a.column == 1 { count } else { 0 };
                            for t in (0..lines).step_by(16) {
                                V::prefetch(block.at(r, t));
                            }
                            V::prefetch(out.add((m0 + r) * n + j * NR));
                        }
                        let (a, a_row, a_column) = match a.column != 1 {
                            true => (scratch.a.add(i * count).cast_const(), 1, count_rows),
                            false => (block.at(i, 0), block.row, 1),
                        };
                        if width == NR {
                            let then = if last { fused.from(j * NR) } else { Fused::NONE };
                            tiles::<V, MR, NV>(
                                count_rows,
                                count,
                                a,
                                a_row,
                                a_column,
                                b,
                                b_row,
                                out.add(at),
                                n,
                                add,
                                then,
                            );
                            if last && !fused.whole {
                                finish_rows::<NR>(finish, out, at, n, j * NR, count_rows);
                            }
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
                            let none = Fused::NONE;
                            tiles::<V, MR, NV>(count_rows, count, a, a_row, a_column, b, b_row, edge, NR, add, none);
                            copy(edge, NR, out.add(at), n);
                            for x in 0..if last { width } else { 0 } {
                                finish_rows::<1>(finish, out, at + x, n, j * NR + x, count_rows);
                            }
                        }
                    }
                }
            }
        }
    }
}

/// What is done while a tile is still in registers: + bias, max(·, 0).
#[derive(Clone, Copy)]
struct Fused {
    /// Or null.
    bias: *const f32,
    relu: bool,
    /// Whether nothing is left to be done after it.
    whole: bool,
}

impl Fused {
    const NONE: Self = Self { bias: std::ptr::null(), relu: false, whole: false };

    fn new(finish: &Finish) -> Self {
        match *finish {
            Finish::Activate { bias, act: act @ (Activation::Identity | Activation::Relu), kept, skip: None }
                if kept.is_null() =>
            {
                Self { bias: bias.as_ptr(), relu: act == Activation::Relu, whole: true }
            }
            Finish::Activate { .. } => Self::NONE,
            Finish::Store | Finish::Add => Self { whole: true, ..Self::NONE },
        }
    }

    #[inline(always)]
    unsafe fn from(self, column: usize) -> Self {
        // SAFETY: the caller stays inside of the bias.
        Self { bias: if self.bias.is_null() { self.bias } else { unsafe { self.bias.add(column) } }, ..self }
    }
}

/// [`Finish::Activate`] for N columns of `rows` rows, the first number of which is `out[at]`.
#[inline(always)]
unsafe fn finish_rows<const N: usize>(
    finish: &Finish,
    out: *mut f32,
    at: usize,
    row: usize,
    column: usize,
    rows: usize,
) {
    let Finish::Activate { bias, act, kept, skip } = *finish else { return };
    // SAFETY: the caller's.
    unsafe {
        let bias: *const [f32; N] = bias.as_ptr().add(column).cast();
        for at in (0..rows).map(|r| at + r * row) {
            let kept = if kept.is_null() { kept } else { kept.add(at) };
            let skip = skip.map_or(std::ptr::null(), |s| s.as_ptr().add(at));
            activate_row::<N>(out.add(at).cast(), bias, kept.cast(), skip.cast(), act);
        }
    }
}

/// N neighbours of a row at once, in registers.
#[inline(always)]
unsafe fn activate_row<const N: usize>(
    z: *mut [f32; N],
    bias: *const [f32; N],
    kept: *mut [f32; N],
    skip: *const [f32; N],
    act: Activation,
) {
    // SAFETY: the caller's; `kept` and `skip` may be null.
    unsafe {
        let (mut row, bias) = (z.read_unaligned(), bias.read_unaligned());
        for (z, b) in row.iter_mut().zip(bias) {
            *z += b;
        }
        if kept.is_null() {
            act.apply(&mut row);
        } else {
            let mut slope = [0.0; N];
            act.apply_with_slope(&mut row, &mut slope);
            kept.write_unaligned(slope);
        }
        if !skip.is_null() {
            for (z, s) in row.iter_mut().zip(skip.read_unaligned()) {
                *z += s;
            }
        }
        z.write_unaligned(row);
    }
}

/// Packs `width` columns of b, filled up with zeros: `[terms][NR]`.
#[inline(always)]
unsafe fn pack_right<V: Simd, const NR: usize>(b: View, terms: usize, width: usize, to: *mut f32) {
    // SAFETY: the caller's.
    unsafe {
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
    then: Fused,
) {
    let panel = NV * V::LANES;
    macro_rules! rows {
        ($($r:literal)*) => {
            match rows {
                // The strides are constants where it matters.
                r if r == MR && b_row == panel && a_row == 1 => {
                    tile::<V, MR, NV>(terms, a, 1, MR, b, panel, out, out_row, add, then)
                }
                r if r == MR && b_row == panel => {
                    tile::<V, MR, NV>(terms, a, a_row, 1, b, panel, out, out_row, add, then)
                }
                r if r == MR => tile::<V, MR, NV>(terms, a, a_row, a_column, b, b_row, out, out_row, add, then),
                $($r if $r < MR => tile::<V, $r, NV>(terms, a, a_row, a_column, b, b_row, out, out_row, add, then),)*
                _ => unreachable!("a micro-panel has at most MR rows"),
            }
        };
    }
    // SAFETY: the caller's.
    unsafe { rows!(1 2 3 4 5 6 7 8 9 10 11) }
}

/// The same pointer, in a register of its own.
#[inline(always)]
#[allow(clippy::pointers_in_nomem_asm_block)] // the pointer is passed through, not followed
fn opaque(mut pointer: *const f32) -> *const f32 {
    #[cfg(not(miri))]
    // SAFETY: no instruction at all.
    unsafe {
        std::arch::asm!("/* {0} */", inout(reg) pointer, options(pure, nomem, nostack, preserves_flags))
    };
    pointer
}

/// The micro-kernel: MR × NV vectors of sums in registers.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
unsafe fn tile<V: Simd, const MR: usize, const NV: usize>(
    terms: usize,
    a: *const f32,
    a_row: usize,
    a_column: usize,
    mut b: *const f32,
    b_row: usize,
    out: *mut f32,
    out_row: usize,
    add: bool,
    then: Fused,
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
        // A pointer for three rows each: the rest of an address fits the instruction. Left alone, the compiler adds the stride
        // again and again, one instruction per row and term.
        let mut lefts = [a; 4];
        for (g, left) in lefts.iter_mut().enumerate().take(MR.div_ceil(3)) {
            *left = a.add(3 * g * a_row);
            if a_row != 1 {
                *left = opaque(*left);
            }
        }
        macro_rules! step {
            ($count:literal) => {
                for u in 0..$count {
                    let mut right = [V::splat(0.0); NV];
                    for (j, right) in right.iter_mut().enumerate() {
                        *right = V::load(b.add(u * b_row + j * V::LANES));
                    }
                    for (r, sums) in sums.iter_mut().enumerate() {
                        let left = V::splat(*lefts[r / 3].add(r % 3 * a_row + u * a_column));
                        for (sum, right) in sums.iter_mut().zip(&right) {
                            *sum = sum.fma(left, *right);
                        }
                    }
                }
                // After the last term these point past their matrix, which only `wrapping_add` may.
                for left in &mut lefts {
                    *left = left.wrapping_add($count * a_column);
                }
                b = b.wrapping_add($count * b_row);
            };
        }
        for _ in 0..terms / 4 {
            step!(4);
        }
        for _ in 0..terms % 4 {
            step!(1);
        }
        if !then.bias.is_null() {
            for j in 0..NV {
                let bias = V::load(then.bias.add(j * V::LANES));
                for sums in &mut sums {
                    sums[j] = sums[j].add(bias);
                    if then.relu {
                        sums[j] = sums[j].positive();
                    }
                }
            }
        }
        for (r, sums) in sums.iter().enumerate() {
            for (j, sum) in sums.iter().enumerate() {
                sum.store(out.add(r * out_row + j * V::LANES));
            }
        }
    }
}

/// Sums that a row's product with a column is cut into, whatever the width of the vectors.
const STRIPES: usize = 16;

/// The product for N columns, few enough that a panel would be mostly empty: rows of a times columns of b, both contiguous.
/// Term t goes to sum t mod 16; the sums are added pairwise, then what the last whole sixteen left over.
#[inline(always)]
pub(super) unsafe fn dots<V: Simd, const N: usize, const VECTORS: usize>(
    job: &Job,
    finish: &Finish,
    columns: *mut f32,
) {
    let &Job { m, k, a, b, out, .. } = job;
    let (whole, add) = (k / STRIPES * STRIPES, matches!(finish, Finish::Add));
    // SAFETY: the caller's: `columns` has room for N k numbers, and a row of a is contiguous.
    unsafe {
        for (j, t) in (0..N).flat_map(|j| (0..k).map(move |t| (j, t))) {
            *columns.add(j * k + t) = *b.at(t, j);
        }
        for i in 0..m {
            let row = a.at(i, 0);
            let mut sums = [[V::splat(0.0); VECTORS]; N];
            for t in (0..whole).step_by(STRIPES) {
                for v in 0..VECTORS {
                    let left = V::load(row.add(t + v * V::LANES));
                    for (j, sums) in sums.iter_mut().enumerate() {
                        sums[v] = sums[v].fma(left, V::load(columns.add(j * k + t + v * V::LANES)));
                    }
                }
            }
            for (j, sums) in sums.iter().enumerate() {
                let mut stripes = [0.0f32; STRIPES];
                for (v, sum) in sums.iter().enumerate() {
                    sum.store(stripes.as_mut_ptr().add(v * V::LANES));
                }
                for half in [8, 4, 2, 1] {
                    for s in 0..half {
                        stripes[s] += stripes[s + half];
                    }
                }
                let rest = (whole..k).map(|t| *row.add(t) * *columns.add(j * k + t));
                let to = out.add(i * N + j);
                let z = rest.fold(stripes[0], |sum, term| sum + term);
                *to = if add { *to + z } else { z };
            }
            for j in 0..N {
                finish_rows::<1>(finish, out, i * N + j, N, j, 1);
            }
        }
    }
}
