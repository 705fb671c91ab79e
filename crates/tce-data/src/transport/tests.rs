//! Tests against closed forms, the definition in f64, and the best assignment.

use super::*;
use rand::RngExt;
use tce_base::Streams;

/// The formulas of the module, written directly in f64: (P, C).
fn oracle(
    x: &[f32],
    y: &[f32],
    dim: usize,
    relative_epsilon: f64,
    iterations: usize,
) -> (Vec<Vec<f64>>, Vec<Vec<f64>>) {
    let cos = |x: &[f32], y: &[f32]| {
        let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(&a, &b)| a as f64 * b as f64).sum::<f64>();
        dot(x, y) / (dot(x, x) * dot(y, y)).sqrt().max(1e-300)
    };
    let c: Vec<Vec<f64>> = x.chunks(dim).map(|x| y.chunks(dim).map(|y| 1.0 - cos(x, y)).collect()).collect();
    let (n, m) = (c.len(), c[0].len());
    let eps = relative_epsilon * c.iter().flatten().sum::<f64>() / (n * m) as f64;
    let lse = |z: Vec<f64>| {
        let top = z.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        top + z.iter().map(|z| (z - top).exp()).sum::<f64>().ln()
    };
    let (mut f, mut g) = (vec![0.0; n], vec![0.0; m]);
    for _ in 0..iterations {
        g = (0..m).map(|j| -eps * ((m as f64).ln() + lse((0..n).map(|i| (f[i] - c[i][j]) / eps).collect()))).collect();
        f = (0..n).map(|i| -eps * ((n as f64).ln() + lse((0..m).map(|j| (g[j] - c[i][j]) / eps).collect()))).collect();
    }
    let p = (0..n).map(|i| (0..m).map(|j| ((f[i] + g[j] - c[i][j]) / eps).exp()).collect()).collect();
    (p, c)
}

fn expected(p: &[Vec<f64>], c: &[Vec<f64>]) -> Vec<f64> {
    p.iter().zip(c).map(|(p, c)| p.iter().zip(c).map(|(p, c)| p * c).sum()).collect()
}

fn points(seed: u64, rows: usize, dim: usize, shift: f32) -> Vec<f32> {
    let mut rng = Streams::new(seed).stream("points");
    (0..rows * dim).map(|_| shift + rng.random_range(-1.0f32..1.0)).collect()
}

fn close(got: &[f32], want: &[f64], tolerance: f64) {
    assert_eq!(got.len(), want.len());
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        assert!((*g as f64 - w).abs() <= tolerance * w.abs(), "row {i}: {g} instead of {w}");
    }
}

fn costs(x: &[f32], y: &[f32], dim: usize, options: &TransportOptions) -> Vec<f32> {
    transport_costs(&Rows::new(x, dim), &Rows::new(y, dim), options).unwrap()
}

/// Two sources at angles 0 and 90 degrees, two targets likewise: C = [[0, 1], [1, 0]], mean 1/2. By symmetry P = [[p,
/// q], [q, p]] with q/p = exp(-1/ε), p + q = 1/2, so every row costs q.
#[test]
fn the_two_by_two_case_in_closed_form() {
    let axes = [1.0, 0.0, 0.0, 3.0];
    for relative_epsilon in [0.05, 0.5, 2.0] {
        let r = (-1.0f64 / (relative_epsilon * 0.5)).exp();
        let want = 0.5 * r / (1.0 + r);
        let options = TransportOptions { relative_epsilon, ..TransportOptions::default() };
        close(&costs(&axes, &axes, 2, &options), &[want, want], 1e-5);
    }
}

#[test]
fn it_follows_the_definition_iteration_by_iteration() {
    let (x, y) = (points(1, 600, 7, 0.3), points(2, 150, 7, -0.2));
    for max_iterations in [1, 2, 3, 40] {
        let (p, c) = oracle(&x, &y, 7, 0.05, max_iterations);
        let options = TransportOptions { max_iterations, ..TransportOptions::default() };
        close(&costs(&x, &y, 7, &options), &expected(&p, &c), 2e-4);
    }
}

/// With a tiny ε, the scalings leave the range of the kernel, and the transport becomes the best assignment.
#[test]
fn without_entropy_it_is_the_best_assignment() {
    for seed in 0..5 {
        let (x, y) = (points(seed, 5, 4, 0.0), points(seed + 50, 5, 4, 0.0));
        let (_, c) = oracle(&x, &y, 4, 1.0, 1);
        let mut best = f64::INFINITY;
        permutations(&mut [0, 1, 2, 3, 4], 0, &mut |p| {
            best = best.min((0..5).map(|i| c[i][p[i]]).sum::<f64>() / 5.0);
        });
        let options =
            TransportOptions { relative_epsilon: 1e-3, max_iterations: 50_000, ..TransportOptions::default() };
        let total: f64 = costs(&x, &y, 4, &options).iter().map(|&c| c as f64).sum();
        assert!((total - best).abs() < 2e-3 * best, "seed {seed}: {total} instead of {best}");
    }
}

fn permutations(p: &mut [usize; 5], k: usize, visit: &mut impl FnMut(&[usize; 5])) {
    if k == p.len() {
        visit(p);
    }
    for i in k..p.len() {
        p.swap(k, i);
        permutations(p, k + 1, visit);
        p.swap(k, i);
    }
}

/// The row marginals hold after every iteration. With `per_row`, a cost is therefore a weighted mean of the row's C.
#[test]
fn both_marginals_hold() {
    let (x, y) = (points(3, 500, 5, 0.1), points(4, 120, 5, 0.1));
    let options = TransportOptions { max_iterations: 2000, ..TransportOptions::default() };
    let target = Transposed::from_rows(&unit_rows(&Rows::new(&y, 5), 0..120), 5);
    let rows = unit_rows(&Rows::new(&x, 5), 0..500);
    let block = Block::new(&rows, &target, &options);
    let mut kernel = vec![0.0; 500 * 120];
    let mut state = block.restart(&[0.0; 500], &mut kernel);
    for _ in 0..2000 {
        block.step(&mut state, &mut kernel);
    }
    let p = |i: usize, j: usize| state.u[i] * kernel[i * 120 + j] as f64 * state.v[j];
    for i in 0..500 {
        let row: f64 = (0..120).map(|j| p(i, j)).sum();
        assert!((row * 500.0 - 1.0).abs() < 1e-5, "row {i}: {row}");
    }
    for j in 0..120 {
        let column: f64 = (0..500).map(|i| p(i, j)).sum();
        assert!((column * 120.0 - 1.0).abs() < 1e-4, "column {j}: {column}");
    }
}

#[test]
fn blocks_are_independent_and_per_row_undoes_their_size() {
    let (x, y) = (points(5, 330, 4, 0.0), points(6, 40, 4, 0.0));
    let options = TransportOptions { block_rows: 100, ..TransportOptions::default() };
    let all = costs(&x, &y, 4, &options);
    assert_eq!(all[100..200], costs(&x[400..800], &y, 4, &options)[..]);
    assert_eq!(all[300..], costs(&x[1200..], &y, 4, &options)[..]);
    let per_row = costs(&x, &y, 4, &TransportOptions { per_row: true, ..options });
    assert!((per_row[0] / all[0] - 100.0).abs() < 1e-3 && (per_row[329] / all[329] - 30.0).abs() < 1e-3);
}

#[test]
fn one_thread_gives_the_same_bytes_and_extreme_rows_stay_finite() {
    let (mut x, y) = (points(7, 700, 6, 2.0), points(8, 80, 6, 2.0));
    // Many nearly parallel rows make ε tiny; one opposite row and a zero row are far from all others.
    x[..6].fill(-5.0);
    x[6..12].fill(0.0);
    let run = || costs(&x, &y, 6, &TransportOptions::default());
    let pool = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
    let got = pool(1).install(run);
    assert_eq!(got, pool(2).install(run));
    let (p, c) = oracle(&x, &y, 6, 0.05, 100);
    close(&got, &expected(&p, &c), 1e-3);
    let same = costs(&[1.0, 1.0, 2.0, 2.0], &[3.0, 3.0], 2, &TransportOptions::default());
    assert!(same.iter().all(|&c| c.abs() < 1e-6), "parallel rows cost nothing: {same:?}");
}
