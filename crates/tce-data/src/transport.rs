//! Optimal-transport cost of every source row, as in OTDF: entropic transport between a block of source rows and all
//! target rows, with the cosine cost on [s, a, s'].
//!
//! C_ij = 1 - cos(x_i, y_j); ε = `relative_epsilon` · mean(C) (scaling C by its maximum, as OTDF does, cancels); uniform
//! marginals a = 1/n, b = 1/m; Sinkhorn iterations, target side first:
//! g_j = ε log b - ε LSE_i((f_i - C_ij)/ε), f_i = ε log a - ε LSE_j((g_j - C_ij)/ε); P_ij = exp((f_i + g_j - C_ij)/ε).
//!
//! OTDF casts the costs to float16 first; here everything is computed in float32 and float64. Untested: how half
//! precision affects plans with entries near 2e-8 (a ten-thousandth times a five-thousandth), below its smallest normal
//! number.
//!
//! The first iteration, and any in which the scalings grow too large, works on logarithms. The other iterations scale
//! the kernel P/a of the last such step by u and v, with one pass over it per iteration.

use rayon::prelude::*;
use tce_base::{Interrupted, Progress};

use crate::product::Transposed;
use crate::{DataError, Rows};

/// Source rows per partial sum. It is part of the definition of the result: partial sums are added in chunk order.
const CHUNK: usize = 256;
/// Source rows whose costs are computed together.
const TILE: usize = 32;
/// Larger scalings are moved into the logarithms.
const SCALING_LIMIT: f64 = 1e12;
/// Iterations between two checks of the marginals.
const CHECK_EVERY: usize = 10;

/// See [`transport_costs`]. The defaults are OTDF's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TransportOptions {
    /// Source rows per transport problem.
    pub block_rows: usize,
    /// ε in units of the mean cost of the block.
    pub relative_epsilon: f64,
    /// Largest L1 error of the target marginal at which the iterations may stop (checked every tenth iteration).
    pub threshold: f64,
    /// Largest number of iterations per block.
    pub max_iterations: usize,
    /// Multiply by the block's number of rows. This gives the mean cost along a row's transport, comparable between
    /// blocks of different sizes. OTDF does not, so the rows of its shorter last block look too expensive.
    pub per_row: bool,
}

impl Default for TransportOptions {
    fn default() -> Self {
        Self { block_rows: 10_000, relative_epsilon: 0.05, threshold: 1e-9, max_iterations: 100, per_row: false }
    }
}

/// The transport cost Σ_j P_ij C_ij of every source row, `[source.len()]`, not negative; small: close to the target.
///
/// Independent of the number of threads. Memory: 4 · `block_rows` · `target.len()` bytes.
///
/// # Errors
/// [`DataError::Interrupted`].
///
/// # Panics
/// If the dimensions differ, the target is empty, or `block_rows` is 0. Coordinates must be finite.
pub fn transport_costs(
    source: &Rows<'_>,
    target: &Rows<'_>,
    options: &TransportOptions,
) -> Result<Vec<f32>, DataError> {
    assert_eq!(source.dim(), target.dim(), "source and target have different dimensions");
    assert!(!target.is_empty() && options.block_rows > 0);
    let directions = Transposed::from_rows(&unit_rows(target, 0..target.len()), target.dim());
    let progress = (source.len() >= 50_000).then(|| Progress::new("optimal transport", source.len() as u64, "rows"));
    let mut out = Vec::with_capacity(source.len());
    let mut kernel = Vec::new();
    for first in (0..source.len()).step_by(options.block_rows) {
        let range = first..source.len().min(first + options.block_rows);
        let rows = unit_rows(source, range.clone());
        out.extend(Block::new(&rows, &directions, options).solve(&mut kernel)?);
        if let Some(p) = &progress {
            p.inc(range.len() as u64);
        }
    }
    if let Some(p) = progress {
        p.finish();
    }
    Ok(out)
}

/// Scales rows to length 1 (a zero row stays zero: its cosine with everything is 0).
fn unit_rows(rows: &Rows<'_>, range: std::ops::Range<usize>) -> Vec<f32> {
    let mut out = vec![0.0; range.len() * rows.dim()];
    rows.copy_rows(range, &mut out);
    out.par_chunks_mut(rows.dim()).for_each(|row| {
        let norm = row.iter().map(|&x| x as f64 * x as f64).sum::<f64>().sqrt();
        if norm > 0.0 {
            row.iter_mut().for_each(|x| *x = (*x as f64 / norm) as f32);
        }
    });
    out
}

/// One transport problem: n source rows to all m target rows.
struct Block<'a> {
    rows: &'a [f32],
    target: &'a Transposed,
    options: &'a TransportOptions,
    n: usize,
    m: usize,
    inverse_epsilon: f64,
}

/// The plan P_ij = u_i K_ij v_j, and what the next step needs.
struct State {
    /// F_i = f_i / ε of the last step on logarithms, from which K was computed.
    log_f: Vec<f64>,
    log_g: Vec<f64>,
    u: Vec<f64>,
    v: Vec<f64>,
    /// Σ_i u_i K_ij.
    columns: Vec<f64>,
}

impl<'a> Block<'a> {
    fn new(rows: &'a [f32], target: &'a Transposed, options: &'a TransportOptions) -> Self {
        let n = rows.len() / target.dim;
        let mut block = Self { rows, target, options, n, m: target.len, inverse_epsilon: 0.0 };
        let sums: Vec<f64> = block.chunks(|b, i, tile| b.map_tiles(i, tile, |_, costs| sum(costs)).into_iter().sum());
        let mean = sums.iter().sum::<f64>() / (block.n * block.m) as f64;
        block.inverse_epsilon = if mean > 0.0 { 1.0 / (options.relative_epsilon * mean) } else { 0.0 };
        block
    }

    /// Returns one value per chunk of source rows, in order. Every thread gets a tile buffer.
    fn chunks<T: Send>(&self, work: impl Fn(&Self, std::ops::Range<usize>, &mut [f32]) -> T + Sync) -> Vec<T> {
        (0..self.n.div_ceil(CHUNK))
            .into_par_iter()
            .map_init(|| vec![0.0; TILE * self.m], |tile, c| work(self, c * CHUNK..self.n.min((c + 1) * CHUNK), tile))
            .collect()
    }

    /// Calls `work` with the first row and the costs (`[rows, m]`) of every tile of `range`.
    fn map_tiles<T>(
        &self,
        range: std::ops::Range<usize>,
        tile: &mut [f32],
        mut work: impl FnMut(usize, &[f32]) -> T,
    ) -> Vec<T> {
        let d = self.target.dim;
        range
            .clone()
            .step_by(TILE)
            .map(|i| {
                let end = range.end.min(i + TILE);
                let costs = &mut tile[..(end - i) * self.m];
                self.target.dot(&self.rows[i * d..end * d], 0, self.m, -1.0, costs);
                // Rounding may make the cosine of parallel rows larger than 1.
                costs.iter_mut().for_each(|c| *c = (1.0 + *c).max(0.0));
                work(i, costs)
            })
            .collect()
    }

    fn solve(&self, kernel: &mut Vec<f32>) -> Result<Vec<f32>, DataError> {
        if self.inverse_epsilon == 0.0 {
            return Ok(vec![0.0; self.n]);
        }
        kernel.resize(self.n * self.m, 0.0);
        let b = 1.0 / self.m as f64;
        let mut state = self.restart(&vec![0.0; self.n], kernel);
        for iteration in 1..self.options.max_iterations {
            if tce_base::interrupted() {
                return Err(DataError::from(Interrupted::nothing_kept()));
            }
            if iteration % CHECK_EVERY == 0 {
                let error: f64 = state.columns.iter().zip(&state.v).map(|(c, v)| (c * v - b).abs()).sum();
                if error < self.options.threshold {
                    break;
                }
            }
            self.step(&mut state, kernel);
        }
        Ok(self.costs(&state, kernel))
    }

    /// One iteration on logarithms from F = f/ε: sets K = exp(F_i + G_j - C_ij/ε) / a with the new F and G.
    fn restart(&self, log_f: &[f64], kernel: &mut [f32]) -> State {
        let parts: Vec<(Vec<f32>, Vec<f64>)> = self.chunks(|block, rows, tile| block.column_sums(rows, tile, log_f));
        let log_b = -(self.m as f64).ln();
        let log_g = (0..self.m)
            .map(|j| {
                let top = parts.iter().fold(f32::NEG_INFINITY, |t, p| t.max(p.0[j])) as f64;
                log_b - top - parts.iter().map(|p| p.1[j] * (p.0[j] as f64 - top).exp()).sum::<f64>().ln()
            })
            .collect();
        self.restart_rows(log_g, kernel)
    }

    /// For each column j over some rows: the largest F_i - C_ij/ε, and the sum of the exponentials relative to it.
    fn column_sums(&self, rows: std::ops::Range<usize>, tile: &mut [f32], log_f: &[f64]) -> (Vec<f32>, Vec<f64>) {
        let mut top = vec![f32::NEG_INFINITY; self.m];
        let mut sums = vec![0.0f64; self.m];
        let mut before = vec![0.0f32; self.m];
        let mut z = vec![0.0f32; TILE * self.m];
        self.map_tiles(rows, tile, |first, costs| {
            before.copy_from_slice(&top);
            for (r, costs) in costs.chunks_exact(self.m).enumerate() {
                let z = &mut z[r * self.m..(r + 1) * self.m];
                let f = log_f[first + r];
                for ((z, &c), t) in z.iter_mut().zip(costs).zip(&mut top) {
                    *z = (f - c as f64 * self.inverse_epsilon) as f32;
                    *t = if *z > *t { *z } else { *t };
                }
            }
            for ((s, &t), &b) in sums.iter_mut().zip(&top).zip(&before) {
                *s *= ((b - t) as f64).exp();
            }
            for z in z.chunks_exact(self.m).take(costs.len() / self.m) {
                for ((s, &z), &t) in sums.iter_mut().zip(z).zip(&top) {
                    *s += (z - t).exp() as f64;
                }
            }
        });
        (top, sums)
    }

    /// The row half of an iteration on logarithms: computes F from G, and K.
    fn restart_rows(&self, log_g: Vec<f64>, kernel: &mut [f32]) -> State {
        let a = 1.0 / self.n as f64;
        let parts: Vec<(Vec<f64>, Vec<f64>)> = kernel
            .par_chunks_mut(CHUNK * self.m)
            .enumerate()
            .map_init(
                || vec![0.0; TILE * self.m],
                |tile, (c, kernel)| {
                    let range = c * CHUNK..self.n.min((c + 1) * CHUNK);
                    let mut log_f = Vec::with_capacity(range.len());
                    let mut columns = Columns::new(self.m);
                    self.map_tiles(range.clone(), tile, |first, costs| {
                        for (r, costs) in costs.chunks_exact(self.m).enumerate() {
                            let at = (first + r - range.start) * self.m;
                            let k = &mut kernel[at..at + self.m];
                            let mut top = f32::NEG_INFINITY;
                            for ((k, &c), g) in k.iter_mut().zip(costs).zip(&log_g) {
                                *k = (g - c as f64 * self.inverse_epsilon) as f32;
                                top = if *k > top { *k } else { top };
                            }
                            k.iter_mut().for_each(|k| *k = (*k - top).exp());
                            let total = sum(k);
                            let scale = (1.0 / total) as f32;
                            k.iter_mut().for_each(|k| *k *= scale);
                            log_f.push(a.ln() - top as f64 - total.ln());
                            columns.add(a as f32, k);
                        }
                    });
                    (log_f, columns.finish())
                },
            )
            .collect();
        let columns = add_up(parts.iter().map(|p| &p.1), self.m);
        let log_f = parts.into_iter().flat_map(|p| p.0).collect();
        State { log_f, log_g, u: vec![a; self.n], v: vec![1.0; self.m], columns }
    }

    /// One iteration: v = b / Kᵀu, then u = a / Kv.
    fn step(&self, state: &mut State, kernel: &mut [f32]) {
        let (a, b) = (1.0 / self.n as f64, 1.0 / self.m as f64);
        let small = |x: f64| (1.0 / SCALING_LIMIT..SCALING_LIMIT).contains(&x);
        let v: Vec<f64> = state.columns.iter().map(|c| b / c).collect();
        if !v.iter().all(|&v| small(v)) {
            let log_f: Vec<f64> = state.log_f.iter().zip(&state.u).map(|(f, u)| f + (u / a).ln()).collect();
            *state = self.restart(&log_f, kernel);
            return;
        }
        let v32: Vec<f32> = v.iter().map(|&v| v as f32).collect();
        let parts: Vec<(Vec<f64>, Vec<f64>)> = kernel
            .par_chunks(CHUNK * self.m)
            .map(|kernel| {
                let mut columns = Columns::new(self.m);
                let rows = kernel.chunks_exact(self.m);
                let u = rows
                    .map(|k| {
                        let u = a / dot(k, &v32);
                        columns.add(u as f32, k);
                        u
                    })
                    .collect();
                (u, columns.finish())
            })
            .collect();
        let u: Vec<f64> = parts.iter().flat_map(|p| p.0.iter().copied()).collect();
        if !u.iter().all(|&u| small(u / a)) {
            let log_g = state.log_g.iter().zip(&v).map(|(g, v)| g + v.ln()).collect();
            *state = self.restart_rows(log_g, kernel);
            return;
        }
        state.columns = add_up(parts.iter().map(|p| &p.1), self.m);
        (state.u, state.v) = (u, v);
    }

    fn costs(&self, state: &State, kernel: &[f32]) -> Vec<f32> {
        let v32: Vec<f32> = state.v.iter().map(|&v| v as f32).collect();
        let scale = if self.options.per_row { self.n as f64 } else { 1.0 };
        let parts: Vec<Vec<f32>> = self.chunks(|block, rows, tile| {
            let mut out = Vec::with_capacity(rows.len());
            block.map_tiles(rows, tile, |first, costs| {
                for (r, costs) in costs.chunks_exact(block.m).enumerate() {
                    let k = &kernel[(first + r) * block.m..(first + r + 1) * block.m];
                    let mut lanes = [0.0f64; 8];
                    for (i, ((&k, &v), &c)) in k.iter().zip(&v32).zip(costs).enumerate() {
                        lanes[i % 8] += (k * v) as f64 * c as f64;
                    }
                    out.push((scale * state.u[first + r] * lanes.iter().sum::<f64>()) as f32);
                }
            });
            out
        });
        parts.concat()
    }
}

/// Σ_i u_i K_ij, summed in float32 within a few dozen rows and in float64 beyond.
struct Columns {
    near: Vec<f32>,
    far: Vec<f64>,
    rows: usize,
}

impl Columns {
    fn new(m: usize) -> Self {
        Self { near: vec![0.0; m], far: vec![0.0; m], rows: 0 }
    }

    fn add(&mut self, u: f32, k: &[f32]) {
        self.near.iter_mut().zip(k).for_each(|(s, k)| *s += u * k);
        self.rows += 1;
        if self.rows.is_multiple_of(32) {
            self.flush();
        }
    }

    fn flush(&mut self) {
        for (far, near) in self.far.iter_mut().zip(&mut self.near) {
            *far += *near as f64;
            *near = 0.0;
        }
    }

    fn finish(mut self) -> Vec<f64> {
        self.flush();
        self.far
    }
}

fn add_up<'a>(parts: impl Iterator<Item = &'a Vec<f64>>, m: usize) -> Vec<f64> {
    let mut total = vec![0.0; m];
    parts.for_each(|p| total.iter_mut().zip(p).for_each(|(t, p)| *t += p));
    total
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut lanes = [0.0f32; 32];
    let (x, y) = (a.chunks_exact(32), b.chunks_exact(32));
    let rest: f64 = x.remainder().iter().zip(y.remainder()).map(|(x, y)| *x as f64 * *y as f64).sum();
    for (x, y) in x.zip(y) {
        lanes.iter_mut().zip(x).zip(y).for_each(|((l, x), y)| *l += x * y);
    }
    rest + lanes.iter().map(|&l| l as f64).sum::<f64>()
}

fn sum(a: &[f32]) -> f64 {
    a.chunks(64).map(|c| c.iter().sum::<f32>() as f64).sum()
}

#[cfg(test)]
mod tests;
