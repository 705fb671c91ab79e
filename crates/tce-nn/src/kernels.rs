//! The dense layer on raw slices: one GEMM, bias and activation per block while it is in cache; forward and backward.
//!
//! Work is cut by shape, never by the number of threads, and each output element is one sequential sum: the bytes do not
//! depend on the thread count.

use gemm::Parallelism;
use rayon::prelude::*;

use crate::activation::{Activation, activation_gradient, bias_and_activation};

/// Rows of a block: small enough that few networks feed several threads evenly, large enough that packing the other
/// operand again for every block does not show (measured: 107 GFLOP/s on one core with and without blocks).
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

impl Shape {
    fn parallel(&self) -> bool {
        self.p * self.rows * self.i * self.o >= PARALLEL_FROM && rayon::current_num_threads() > 1
    }

}

/// A matrix in memory: first element, and the distance between rows and between columns.
#[derive(Clone, Copy)]
struct Matrix<'a> {
    data: &'a [f32],
    row: usize,
    column: usize,
}

fn plain(data: &[f32], width: usize) -> Matrix<'_> {
    Matrix { data, row: width, column: 1 }
}

fn transposed(data: &[f32], width: usize) -> Matrix<'_> {
    Matrix { data, row: 1, column: width }
}

/// out ← a b (+ out where `add`), with a `[m, k]`, b `[k, n]`, out `[m, n]` contiguous.
fn product(out: &mut [f32], a: Matrix, b: Matrix, m: usize, k: usize, n: usize, add: bool) {
    assert_eq!(out.len(), m * n);
    if m == 0 || n == 0 {
        return;
    }
    let reach = |rows: usize, columns: usize, x: &Matrix| (rows - 1) * x.row + (columns - 1) * x.column;
    assert!(k > 0 && reach(m, k, &a) < a.data.len() && reach(k, n, &b) < b.data.len());
    // SAFETY: the assertions above bound every element that the strides can reach.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            add,
            a.data.as_ptr(),
            a.column as isize,
            a.row as isize,
            b.data.as_ptr(),
            b.column as isize,
            b.row as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// Runs `task` on every item, on all threads if `parallel`.
fn run<T: Send>(parallel: bool, tasks: Vec<T>, task: impl Fn(T) + Sync + Send) {
    if parallel { tasks.into_par_iter().for_each(task) } else { tasks.into_iter().for_each(task) }
}

/// Forward pass. `kept` receives the pre-activations, for activations whose derivative needs them.
pub(crate) fn forward(
    shape: Shape,
    x: &[f32],
    w: &[f32],
    b: &[f32],
    act: Activation,
    y: &mut [f32],
    kept: Option<&mut [f32]>,
) {
    let Shape { p, px, rows, i, o } = shape;
    let (group, block) = (p / px, BLOCK.min(rows));
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
        product(y, plain(x, i), plain(&w[j * i * o..][..i * o], o), n, i, o, false);
        bias_and_activation(y, &b[j * o..][..o], act, kept);
    });
}

/// Gradients of a dense layer. `dw` and `db` may be left out for frozen weights, `dx` for inputs that need none.
#[allow(clippy::too_many_arguments)]
pub(crate) fn backward(
    shape: Shape,
    x: &[f32],
    w: &[f32],
    act: Activation,
    kept: &[f32],
    dy: &[f32],
    dw: Option<&mut [f32]>,
    db: &mut [f32],
    dx: Option<&mut [f32]>,
) {
    let Shape { p, px, rows, i, o } = shape;
    let group = p / px;
    let parallel = shape.parallel();
    let mut dz = vec![0.0; p * rows * o];
    let tasks: Vec<_> = dz.chunks_mut(rows * o).zip(db.chunks_mut(o)).enumerate().collect();
    run(parallel, tasks, |(j, (dz, db))| {
        let range = j * rows * o..(j + 1) * rows * o;
        activation_gradient(&dy[range.clone()], &kept[range], act, dz, db);
    });
    if let Some(dw) = dw {
        let block = BLOCK.min(i);
        let mut tasks = Vec::new();
        for (j, member) in dw.chunks_mut(i * o).enumerate() {
            tasks.extend(member.chunks_mut(block * o).enumerate().map(|(c, d)| (j, c * block, d)));
        }
        run(parallel, tasks, |(j, first, dw)| {
            // dw[first.., :] = x[:, first..]ᵀ dz
            let x = &x[j / group * rows * i..][..rows * i];
            let a = Matrix { data: &x[first..], row: 1, column: i };
            product(dw, a, plain(&dz[j * rows * o..][..rows * o], o), dw.len() / o, rows, o, false);
        });
    }
    if let Some(dx) = dx {
        let block = BLOCK.min(rows);
        let mut tasks = Vec::new();
        for (jx, member) in dx.chunks_mut(rows * i).enumerate() {
            tasks.extend(member.chunks_mut(block * i).enumerate().map(|(c, d)| (jx, c * block, d)));
        }
        run(parallel, tasks, |(jx, first, dx)| {
            let n = dx.len() / i;
            for g in 0..group {
                let j = jx * group + g;
                let dz = &dz[(j * rows + first) * o..][..n * o];
                product(dx, plain(dz, o), transposed(&w[j * i * o..][..i * o], o), n, o, i, g > 0);
            }
        });
    }
}
