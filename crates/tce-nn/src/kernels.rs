//! The dense layer on raw slices, forward and backward.
//!
//! Work is cut by shape, never by the number of threads, and each output element is one sequential sum: the bytes do not
//! depend on the thread count.

use std::mem::MaybeUninit;

use rayon::prelude::*;

use crate::activation::{Activation, activation_gradient};
use crate::gemm::{Finish, Matrix, Right, Uninit, product};

/// Rows of a task where a layer is spread over threads.
const BLOCK: usize = 128;
/// Below this many multiply-adds a layer stays on its thread. High, because two cores that take turns at one training
/// step fetch each other's activations and gradients from the other's cache: measured on three 256-256 networks of 256
/// rows, two threads made 740 updates/s and one thread 950. Trainings side by side scale; one training does not.
const PARALLEL_FROM: usize = 1 << 28;

/// y[j] = act(x[j / g] w[j] + b[j]) for weight members j = 0..p, g = p / px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shape {
    /// Members of the weights.
    pub p: usize,
    /// Members of the input; divides `p`.
    pub px: usize,
    /// Rows per member.
    pub rows: usize,
    /// Input width.
    pub i: usize,
    /// Output width.
    pub o: usize,
}

/// Room for `n` numbers.
pub(crate) fn room(n: usize) -> Vec<MaybeUninit<f32>> {
    let mut out = Vec::with_capacity(n);
    out.resize_with(n, MaybeUninit::uninit);
    out
}

/// The numbers, all of them written.
///
/// # Safety
/// Every element must have been written.
pub(crate) unsafe fn written(room: Vec<MaybeUninit<f32>>) -> Vec<f32> {
    let mut room = std::mem::ManuallyDrop::new(room);
    // SAFETY: `MaybeUninit<f32>` has the layout of `f32`, and the caller has written every element.
    unsafe { Vec::from_raw_parts(room.as_mut_ptr().cast(), room.len(), room.capacity()) }
}

impl Shape {
    /// Whether the layer is cut into blocks of rows at all. Decided by shape alone, never by the number of threads.
    fn large(&self) -> bool {
        self.p * self.rows * self.i * self.o >= PARALLEL_FROM
    }

    fn parallel(&self) -> bool {
        self.large() && rayon::current_num_threads() > 1
    }

    /// Rows of a task when `rows` could be one: packing the other operand again for every block costs a few percent.
    fn block(&self, rows: usize) -> usize {
        if self.large() { BLOCK.min(rows) } else { rows }
    }
}

/// Runs `task` on every item, on all threads if `parallel`.
fn run<T: Send>(parallel: bool, tasks: Vec<T>, task: impl Fn(T) + Sync + Send) {
    if parallel { tasks.into_par_iter().for_each(task) } else { tasks.into_iter().for_each(task) }
}

/// Forward pass; writes all of `y`. `kept` receives act'(z), for activations whose derivative is no function of y.
pub(crate) fn forward(
    shape: Shape,
    x: &[f32],
    w: &[f32],
    b: &[f32],
    act: Activation,
    y: &mut Uninit,
    kept: Option<&mut Uninit>,
) {
    let Shape { p, px, rows, i, o } = shape;
    let (group, block) = (p / px, shape.block(rows));
    let mut tasks = Vec::new();
    let mut kept_members = kept.map(|k| k.chunks_mut(rows * o));
    for (j, y_member) in y.chunks_mut(rows * o).enumerate() {
        let mut kept_blocks = kept_members.as_mut().and_then(Iterator::next).map(|k| k.chunks_mut(block * o));
        for (c, y_block) in y_member.chunks_mut(block * o).enumerate() {
            tasks.push((j, c, y_block, kept_blocks.as_mut().and_then(Iterator::next)));
        }
    }
    run(shape.parallel(), tasks, |(j, c, y, kept)| {
        let n = y.len() / o;
        let x = &x[(j / group * rows + c * block) * i..][..n * i];
        let kept = kept.map_or(std::ptr::null_mut(), |k| k.as_mut_ptr().cast());
        let finish = Finish::Activate { bias: &b[j * o..][..o], act, kept, skip: None };
        let w = Matrix::plain(&w[j * i * o..][..i * o], o);
        product(y, Matrix::plain(x, i), Right::Matrix(w), [n, i, o], finish);
    });
}

/// Gradients of a dense layer; writes all of `db`, `dw` and `dx`, and leaves dz where dy was. `dw` may be left out for
/// frozen weights, `dx` for inputs that need none.
#[allow(clippy::too_many_arguments)]
pub(crate) fn backward(
    shape: Shape,
    x: &[f32],
    w: &[f32],
    act: Activation,
    kept: &[f32],
    dy: &mut [f32],
    dw: Option<&mut Uninit>,
    db: &mut [f32],
    dx: Option<&mut Uninit>,
) {
    let Shape { p, px, rows, i, o } = shape;
    let group = p / px;
    let parallel = shape.parallel();
    let tasks: Vec<_> = dy.chunks_mut(rows * o).zip(db.chunks_mut(o)).enumerate().collect();
    run(parallel, tasks, |(j, (dz, db))| {
        activation_gradient(dz, &kept[j * rows * o..][..rows * o], act, db);
    });
    let dz: &[f32] = dy;
    if let Some(dw) = dw {
        let block = shape.block(i);
        let mut tasks = Vec::new();
        for (j, member) in dw.chunks_mut(i * o).enumerate() {
            tasks.extend(member.chunks_mut(block * o).enumerate().map(|(c, d)| (j, c * block, d)));
        }
        run(parallel, tasks, |(j, first, dw)| {
            // dw[first.., :] = x[:, first..]ᵀ dz
            let x = Matrix::transposed(&x[j / group * rows * i..][first..rows * i], i);
            let dz = Matrix::plain(&dz[j * rows * o..][..rows * o], o);
            let sizes = [dw.len() / o, rows, o];
            product(dw, x, Right::Matrix(dz), sizes, Finish::Store);
        });
    }
    if let Some(dx) = dx {
        let block = shape.block(rows);
        let mut tasks = Vec::new();
        for (jx, member) in dx.chunks_mut(rows * i).enumerate() {
            tasks.extend(member.chunks_mut(block * i).enumerate().map(|(c, d)| (jx, c * block, d)));
        }
        run(parallel, tasks, |(jx, first, dx)| {
            let n = dx.len() / i;
            for g in 0..group {
                let j = jx * group + g;
                let dz = &dz[(j * rows + first) * o..][..n * o];
                let w = Matrix::transposed(&w[j * i * o..][..i * o], o);
                let finish = if g > 0 { Finish::Add } else { Finish::Store };
                product(dx, Matrix::plain(dz, o), Right::Matrix(w), [n, o, i], finish);
            }
        });
    }
}
