//! Layer normalisation y = (x - mean) / √(var + ε) · γ + β over the last axis, as one operation of the CPU backend with its own
//! backward pass. Composed of burn's operations it is some twenty-five passes over memory, forward and back; here they are five.
//!
//! | symbol | shape | meaning |
//! |---|---|---|
//! | x, y | `[A, B, D]` | rows of D numbers |
//! | γ, β | `[A, 1, D]` or `[1, 1, D]` | scale and shift, of each of A networks or of all rows |
//! | ε | - | 1e-5 |
//!
//! With x̂ = (x - mean) / σ and g = dy · γ: dx = (g - mean(g) - x̂ mean(g x̂)) / σ, dγ = Σ dy x̂, dβ = Σ dy.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::{Tensor, TensorData};
use burn_flex::FlexTensor;
use multiversion::multiversion;

use crate::dense::is_flex;

const EPSILON: f32 = 1e-5;

/// Partial sums of a row: with one alone every addition would wait for the one before. Always as many, so that the bits do not
/// depend on the instruction set.
const LANES: usize = 16;

/// See the head of this file.
///
/// # Panics
/// If the shapes do not fit each other.
pub fn layer_norm(x: Tensor<3>, gamma: Tensor<3>, beta: Tensor<3>) -> Tensor<3> {
    let ([networks, _, width], [scales, one, columns]) = (x.dims(), gamma.dims());
    assert_eq!(gamma.dims(), beta.dims(), "layer_norm: a shift per scale");
    assert!(
        (scales == networks || scales == 1) && (one, columns) == (1, width),
        "layer_norm: {networks} networks of width {width}, scales {:?}",
        gamma.dims()
    );
    if !is_flex(&x) {
        return layer_norm_composed(x, gamma, beta);
    }
    Tensor::from_dispatch(<Dispatch as NormBackend>::fused_layer_norm(
        x.into_dispatch(),
        gamma.into_dispatch(),
        beta.into_dispatch(),
    ))
}

/// The definition of [`layer_norm`], of burn's operations.
pub fn layer_norm_composed(x: Tensor<3>, gamma: Tensor<3>, beta: Tensor<3>) -> Tensor<3> {
    let centred = x.clone() - x.mean_dim(2);
    let variance = centred.clone().square().mean_dim(2);
    centred / (variance + EPSILON).sqrt() * gamma + beta
}

/// The fused normalisation as an operation of a backend.
#[backend_extension(Flex, Autodiff)]
pub trait NormBackend: Backend {
    /// See [`layer_norm`](crate::layer_norm).
    fn fused_layer_norm(x: FloatTensor<Self>, gamma: FloatTensor<Self>, beta: FloatTensor<Self>) -> FloatTensor<Self>;
}

impl NormBackend for Flex {
    fn fused_layer_norm(x: FlexTensor, gamma: FlexTensor, beta: FlexTensor) -> FlexTensor {
        forward(&x.to_contiguous(), &gamma.to_contiguous(), &beta.to_contiguous()).0
    }
}

impl<C: CheckpointStrategy> NormBackend for Autodiff<Flex, C> {
    fn fused_layer_norm(x: FloatTensor<Self>, gamma: FloatTensor<Self>, beta: FloatTensor<Self>) -> FloatTensor<Self> {
        let guards = [x.node(), gamma.node(), beta.node()];
        let (x, gamma, beta) = (x.into_primitive(), gamma.into_primitive(), beta.into_primitive());
        let (x, gamma, beta) = (x.to_contiguous(), gamma.to_contiguous(), beta.to_contiguous());
        match NormGradient.prepare::<C>(guards).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (y, inverse) = forward(&x, &gamma, &beta);
                prep.finish(Saved { x, gamma, inverse }, y)
            }
            OpsKind::UnTracked(prep) => prep.finish(forward(&x, &gamma, &beta).0),
        }
    }
}

#[derive(Debug)]
struct NormGradient;

/// What the backward pass needs of the forward pass.
#[derive(Clone, Debug)]
struct Saved {
    x: FlexTensor,
    gamma: FlexTensor,
    /// mean and 1/σ of every row.
    inverse: Vec<[f32; 2]>,
}

impl Backward<Flex, 3> for NormGradient {
    type State = Saved;

    fn backward(self, ops: Ops<Saved, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node).to_contiguous();
        let Saved { x, gamma, inverse } = ops.state;
        let [shape, scales] = [&x, &gamma].map(|t| t.layout().shape().to_vec());
        let mut dx = vec![0.0; slice(&x).len()];
        let (mut dgamma, mut dbeta) = (vec![0.0; slice(&gamma).len()], vec![0.0; slice(&gamma).len()]);
        let (width, block) = (shape[2], block(dx.len(), &gamma));
        let inputs = slice(&x).chunks(block).zip(slice(&dy).chunks(block)).zip(inverse.chunks(block / width));
        let outputs = dx.chunks_mut(block).zip(dgamma.chunks_mut(width)).zip(dbeta.chunks_mut(width));
        for ((((x, dy), inverse), gamma), ((dx, dgamma), dbeta)) in inputs.zip(slice(&gamma).chunks(width)).zip(outputs)
        {
            rows_backward(x, gamma, inverse, dy, dx, dgamma, dbeta);
        }
        let [px, pgamma, pbeta] = ops.parents;
        for (parent, gradient, shape) in [(px, dx, &shape), (pgamma, dgamma, &scales), (pbeta, dbeta, &scales)] {
            if let Some(node) = parent {
                let shape = shape.clone();
                grads.register::<Flex>(node.id, FlexTensor::from_data(TensorData::new(gradient, shape)));
            }
        }
    }
}

fn slice(t: &FlexTensor) -> &[f32] {
    t.as_slice().expect("a contiguous f32 tensor")
}

/// How many of `numbers` are in the rows that share a scale of `gamma`: at least one row, where there are none.
fn block(numbers: usize, gamma: &FlexTensor) -> usize {
    let shape = gamma.layout().shape();
    (numbers / shape[0]).max(shape[2])
}

/// y, and mean and 1/σ of every row.
fn forward(x: &FlexTensor, gamma: &FlexTensor, beta: &FlexTensor) -> (FlexTensor, Vec<[f32; 2]>) {
    let shape: Vec<usize> = x.layout().shape().to_vec();
    let width = shape[2];
    let mut y = vec![0.0; slice(x).len()];
    let mut inverse = vec![[0.0; 2]; y.len() / width];
    let block = block(y.len(), gamma);
    let outputs = y.chunks_mut(block).zip(inverse.chunks_mut(block / width));
    let scales = slice(gamma).chunks(width).zip(slice(beta).chunks(width));
    for ((x, (gamma, beta)), (y, inverse)) in slice(x).chunks(block).zip(scales).zip(outputs) {
        rows_forward(x, gamma, beta, y, inverse);
    }
    (FlexTensor::from_data(TensorData::new(y, shape)), inverse)
}

/// Σ term(i), in [`LANES`] parts.
#[inline(always)]
fn sum(n: usize, term: impl Fn(usize) -> f32) -> f32 {
    let mut parts = [0.0; LANES];
    let whole = n - n % LANES;
    for at in (0..whole).step_by(LANES) {
        for (lane, part) in parts.iter_mut().enumerate() {
            *part += term(at + lane);
        }
    }
    for (lane, part) in parts.iter_mut().enumerate().take(n - whole) {
        *part += term(whole + lane);
    }
    parts.iter().sum()
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn rows_forward(x: &[f32], gamma: &[f32], beta: &[f32], y: &mut [f32], inverse: &mut [[f32; 2]]) {
    let n = gamma.len();
    for ((x, y), inverse) in x.chunks_exact(n).zip(y.chunks_exact_mut(n)).zip(inverse) {
        let mean = sum(n, |i| x[i]) / n as f32;
        let variance = sum(n, |i| (x[i] - mean) * (x[i] - mean)) / n as f32;
        let scale = 1.0 / (variance + EPSILON).sqrt();
        *inverse = [mean, scale];
        for (((y, x), gamma), beta) in y.iter_mut().zip(x).zip(gamma).zip(beta) {
            *y = (*x - mean) * scale * *gamma + *beta;
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn rows_backward(
    x: &[f32],
    gamma: &[f32],
    inverse: &[[f32; 2]],
    dy: &[f32],
    dx: &mut [f32],
    dgamma: &mut [f32],
    dbeta: &mut [f32],
) {
    let n = gamma.len();
    let rows = x.chunks_exact(n).zip(dy.chunks_exact(n)).zip(dx.chunks_exact_mut(n)).zip(inverse);
    for (((x, dy), dx), &[mean, scale]) in rows {
        for i in 0..n {
            dgamma[i] += dy[i] * ((x[i] - mean) * scale);
            dbeta[i] += dy[i];
        }
        let g_mean = sum(n, |i| dy[i] * gamma[i]) / n as f32;
        let gx_mean = sum(n, |i| dy[i] * gamma[i] * ((x[i] - mean) * scale)) / n as f32;
        for i in 0..n {
            dx[i] = (dy[i] * gamma[i] - g_mean - (x[i] - mean) * scale * gx_mean) * scale;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;
    use tce_base::{Streams, random::fill_normal};

    /// Outputs and all three gradients agree with burn's own.
    #[test]
    fn fused_follows_the_composition() {
        let device = Device::flex().autodiff();
        for (a, b, d, scales) in
            [(2, 3, 1, 1), (1, 4, 7, 1), (5, 3, 16, 5), (5, 3, 16, 1), (3, 9, 37, 3), (4, 23, 128, 1), (2, 23, 128, 2)]
        {
            let normal = |name: &str, n: usize| {
                let mut data = vec![0.0; n];
                fill_normal(&mut Streams::new(7).stream(name), &mut data);
                Tensor::<1>::from_floats(&data[..], &device)
            };
            let run = |fused: bool| {
                let x = (normal("x", a * b * d) * 3.0 + 1.0).reshape([a, b, d]).detach().require_grad();
                let [gamma, beta] = ["gamma", "beta"].map(|name| normal(name, scales * d));
                let [gamma, beta] = [gamma, beta].map(|t| t.reshape([scales, 1, d]).detach().require_grad());
                let norm = if fused { layer_norm } else { layer_norm_composed };
                let y = norm(x.clone(), gamma.clone(), beta.clone());
                let g = (y.clone() * normal("g", a * b * d).reshape([a, b, d])).sum().backward();
                let all = [y.inner(), x.grad(&g).unwrap()].map(crate::host);
                let shared = [gamma, beta].map(|t| crate::host(t.grad(&g).unwrap()));
                all.into_iter().chain(shared).collect::<Vec<_>>()
            };
            for (fused, composed) in run(true).into_iter().zip(run(false)) {
                let scale = composed.iter().fold(1.0f32, |m, v| m.max(v.abs()));
                // One number has no variance: what is left is rounding over √ε.
                let tolerance = if d == 1 { 1e-3 } else { 2e-5 };
                assert!(
                    fused.iter().zip(&composed).all(|(f, c)| (f - c).abs() <= tolerance * scale),
                    "{a} {b} {d} {scales}"
                );
            }
        }
    }
}
