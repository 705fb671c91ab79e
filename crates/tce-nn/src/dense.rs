//! The dense layer y = act(x W + b) over a population, as one operation of the CPU backend with its own backward pass.
//!
//! | symbol | shape | meaning |
//! |---|---|---|
//! | x | `[Px, B, I]` | input; weight member j reads input member j / (P / Px) |
//! | W, b | `[P, I, O]`, `[P, 1, O]` | P independent layers |
//! | y | `[P, B, O]` | output |
//!
//! With P = k Px, k neighbouring members read the same input without a copy of it (an ensemble per seed).

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::{DType, Shape as TensorShape, Tensor};
use burn_flex::FlexTensor;

use crate::activation::Activation;
use crate::kernels::{self, Shape, room, written};

/// act(x W + b); see the head of this file for the shapes.
///
/// # Panics
/// If the shapes do not fit each other, or the batch is empty.
pub fn dense(x: Tensor<3>, w: Tensor<3>, b: Tensor<3>, act: Activation) -> Tensor<3> {
    if !is_flex(&w) {
        return dense_composed(x, w, b, act);
    }
    Tensor::from_dispatch(<Dispatch as DenseBackend>::dense(
        x.into_dispatch(),
        w.into_dispatch(),
        b.into_dispatch(),
        act,
    ))
}

/// The definition of [`dense`] in burn's own operations: the path of every device but the CPU, and the oracle in tests.
pub fn dense_composed(x: Tensor<3>, w: Tensor<3>, b: Tensor<3>, act: Activation) -> Tensor<3> {
    let ([px, rows, i], p) = (x.dims(), w.dims()[0]);
    let x = if px == p { x } else { x.reshape([px, 1, rows, i]).expand([px, p / px, rows, i]).reshape([p, rows, i]) };
    act.compose(x.matmul(w) + b)
}

/// Whether the tensor lives on the CPU device that has the fused operations.
pub(crate) fn is_flex<const D: usize>(t: &Tensor<D>) -> bool {
    crate::is_cpu(&t.device())
}

/// The fused dense layer as an operation of a backend.
#[backend_extension(Flex, Autodiff)]
pub trait DenseBackend: Backend {
    /// See [`dense`](crate::dense).
    fn dense(x: FloatTensor<Self>, w: FloatTensor<Self>, b: FloatTensor<Self>, act: Activation) -> FloatTensor<Self>;
}

impl DenseBackend for Flex {
    fn dense(x: FlexTensor, w: FlexTensor, b: FlexTensor, act: Activation) -> FlexTensor {
        forward(&x.to_contiguous(), &w.to_contiguous(), &b.to_contiguous(), act, false).0
    }
}

impl<C: CheckpointStrategy> DenseBackend for Autodiff<Flex, C> {
    fn dense(x: FloatTensor<Self>, w: FloatTensor<Self>, b: FloatTensor<Self>, act: Activation) -> FloatTensor<Self> {
        let guards = [x.node(), w.node(), b.node()];
        let (x, w, b) = (x.into_primitive(), w.into_primitive(), b.into_primitive());
        let (x, w, b) = (x.to_contiguous(), w.to_contiguous(), b.to_contiguous());
        match DenseGradient.prepare::<C>(guards).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (y, kept) = forward(&x, &w, &b, act, act.keeps_slope());
                let kept = kept.unwrap_or_else(|| y.clone());
                prep.finish(Saved { x, w, kept, act }, y)
            }
            OpsKind::UnTracked(prep) => prep.finish(forward(&x, &w, &b, act, false).0),
        }
    }
}

#[derive(Debug)]
struct DenseGradient;

/// What the backward pass needs of the forward pass.
#[derive(Clone, Debug)]
struct Saved {
    x: FlexTensor,
    w: FlexTensor,
    /// act'(z) for SiLU, y for the other activations.
    kept: FlexTensor,
    act: Activation,
}

impl Backward<Flex, 3> for DenseGradient {
    type State = Saved;

    fn backward(self, ops: Ops<Saved, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        // The gradient of y is nobody else's: dz is computed where it stands (a shared one would be copied first).
        let mut dy = grads.consume::<Flex>(&ops.node);
        if !dy.is_contiguous() || dy.layout().start_offset() != 0 {
            dy = dy.to_contiguous();
        }
        let Saved { x, w, kept, act } = ops.state;
        let shape = shape_of(&x, &w);
        let [px, pw, pb] = ops.parents;
        let mut dw = pw.as_ref().map(|_| room(shape.p * shape.i * shape.o));
        let mut dx = px.as_ref().map(|_| room(shape.px * shape.rows * shape.i));
        let mut db = vec![0.0; shape.p * shape.o];
        kernels::backward(
            shape,
            slice(&x),
            slice(&w),
            act,
            slice(&kept),
            &mut dy.storage_mut::<f32>()[..shape.p * shape.rows * shape.o],
            dw.as_deref_mut(),
            &mut db,
            dx.as_deref_mut(),
        );
        // SAFETY: the backward pass has written all of them.
        let (dw, dx) = unsafe { (dw.map(|d| written(d)), dx.map(|d| written(d))) };
        if let (Some(node), Some(dx)) = (px, dx) {
            grads.register::<Flex>(node.id, flex(dx, [shape.px, shape.rows, shape.i]));
        }
        if let (Some(node), Some(dw)) = (pw, dw) {
            grads.register::<Flex>(node.id, flex(dw, [shape.p, shape.i, shape.o]));
        }
        if let Some(node) = pb {
            grads.register::<Flex>(node.id, flex(db, [shape.p, 1, shape.o]));
        }
    }
}

fn slice(t: &FlexTensor) -> &[f32] {
    t.as_slice().expect("a contiguous f32 tensor")
}

fn flex(data: Vec<f32>, shape: [usize; 3]) -> FlexTensor {
    let data = burn::tensor::TensorData::new(data, shape);
    debug_assert_eq!(data.dtype(), DType::F32);
    FlexTensor::from_data(data)
}

fn shape_of(x: &FlexTensor, w: &FlexTensor) -> Shape {
    let dims = |t: &FlexTensor| -> [usize; 3] {
        let shape: &TensorShape = t.layout().shape();
        [shape[0], shape[1], shape[2]]
    };
    let ([px, rows, i], [p, wi, o]) = (dims(x), dims(w));
    assert!(rows > 0 && i == wi && px > 0 && p % px == 0, "dense: x {:?} does not fit w {:?}", dims(x), dims(w));
    Shape { p, px, rows, i, o }
}

/// y and, where wanted, act'(z).
fn forward(
    x: &FlexTensor,
    w: &FlexTensor,
    b: &FlexTensor,
    act: Activation,
    keep: bool,
) -> (FlexTensor, Option<FlexTensor>) {
    let shape = shape_of(x, w);
    let out = [shape.p, shape.rows, shape.o];
    assert_eq!(slice(b).len(), shape.p * shape.o, "dense: one bias per output");
    let mut y = room(out.iter().product());
    let mut kept = keep.then(|| room(y.len()));
    kernels::forward(shape, slice(x), slice(w), slice(b), act, &mut y, kept.as_deref_mut());
    // SAFETY: the forward pass has written all of them.
    unsafe { (flex(written(y), out), kept.map(|k| flex(written(k), out))) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};
    use proptest::prelude::*;
    use tce_base::{Streams, random::fill_normal};

    fn normal(name: &str, shape: [usize; 3], device: &Device) -> Tensor<3> {
        let mut data = vec![0.0; shape.iter().product()];
        fill_normal(&mut Streams::new(7).stream(name), &mut data);
        Tensor::from_data(TensorData::new(data, shape), device)
    }

    fn close(a: Tensor<3>, b: Tensor<3>, tolerance: f32) -> bool {
        let (a, b) = (a.into_data().try_to_vec::<f32>().unwrap(), b.into_data().try_to_vec::<f32>().unwrap());
        let scale = b.iter().fold(1.0f32, |m, v| m.max(v.abs()));
        a.len() == b.len() && a.iter().zip(&b).all(|(a, b)| (a - b).abs() <= tolerance * scale)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        /// Outputs and all three gradients agree with the composition of burn operations.
        #[test]
        fn fused_follows_the_composition(
            px in 1usize..4, group in 1usize..3, rows in 1usize..300, i in 1usize..40, o in 1usize..70, act in 0usize..4,
        ) {
            let act = [Activation::Identity, Activation::Relu, Activation::Silu, Activation::Tanh][act];
            let device = Device::flex().autodiff();
            let p = px * group;
            let run = |fused: bool| {
                let x = normal("x", [px, rows, i], &device).require_grad();
                let w = normal("w", [p, i, o], &device).require_grad();
                let b = normal("b", [p, 1, o], &device).require_grad();
                let dense = if fused { dense } else { dense_composed };
                let y = dense(x.clone(), w.clone(), b.clone(), act);
                let g = (y.clone() * normal("g", [p, rows, o], &device)).sum().backward();
                [y.inner(), x.grad(&g).unwrap(), w.grad(&g).unwrap(), b.grad(&g).unwrap()]
            };
            for (fused, composed) in run(true).into_iter().zip(run(false)) {
                prop_assert!(close(fused, composed, 2e-5));
            }
        }
    }

    #[test]
    fn constants_and_frozen_weights_get_no_gradient() {
        let device = Device::flex().autodiff();
        let x = normal("x", [1, 8, 4], &device).require_grad();
        let w = normal("w", [2, 4, 3], &device).inner();
        let b = normal("b", [2, 1, 3], &device).inner();
        let y = dense(x.clone(), w.clone(), b.clone(), Activation::Tanh);
        let grads = y.sum().backward();
        let expected = {
            let x = x.clone().detach().require_grad();
            let g = dense_composed(x.clone(), w, b, Activation::Tanh).sum().backward();
            x.grad(&g).unwrap()
        };
        assert!(close(x.grad(&grads).unwrap(), expected, 1e-5));
    }
}
