//! The residual trunk of a score network, for inference with weights that stay: packed once, and passed through all
//! layers a block of rows at a time, so that activations never leave the second-level cache.
//!
//! h⁰ = x W + b + skip;  hⁱ = hⁱ⁻¹ + act(hⁱ⁻¹ Wᵢ + bᵢ);  y = h W' + b'

use burn::backend::Flex;
use burn::tensor::{Tensor, TensorData};
use burn_flex::FlexTensor;

use crate::activation::Activation;
use crate::dense::is_flex;
use crate::gemm::{Finish, Matrix, Packed, Right, Uninit, product};
use crate::kernels::{room, written};
use crate::layers::Dense;
use crate::tensors::host;

/// Rows that pass through all layers together: two buffers of 256 wide activations and a layer's weights fill half a
/// mebibyte. A multiple of the kernels' heights.
const ROWS: usize = 120;

/// See the head of this file. One set of weights per member of the population.
pub struct ResidualStack {
    members: Vec<Member>,
    activation: Activation,
    /// Widths of x, h and y.
    sizes: [usize; 3],
}

struct Member {
    input: Packed,
    blocks: Vec<Layer>,
    output: Layer,
}

struct Layer {
    weight: Packed,
    bias: Vec<f32>,
}

impl ResidualStack {
    /// Packs W `[P, d, H]`, the blocks `[P, H, H]` and the output layer `[P, H, o]`. None where the parameters do not lie
    /// on the CPU device; there the composition of layers is the way.
    ///
    /// # Panics
    /// If the sizes do not fit each other.
    pub fn pack(input: Tensor<3>, blocks: &[Dense], output: &Dense) -> Option<Self> {
        if !is_flex(&input) {
            return None;
        }
        let ([p, d, h], o) = (input.dims(), output.weight.dims()[2]);
        let input = host(input);
        let pack =
            |all: &[f32], m: usize, k: usize, n: usize| Packed::new(Matrix::plain(&all[m * k * n..][..k * n], n), k, n);
        let layers = |layer: &Dense| -> Vec<Layer> {
            let ([members, k, n], weight, bias) =
                (layer.weight.dims(), host(layer.weight.val()), host(layer.bias.val()));
            assert!(members == p && k == h, "a stack of {p} members, {h} wide, has no layer {:?}", [members, k, n]);
            let layer = |m| Layer { weight: pack(&weight, m, k, n), bias: bias[m * n..][..n].to_vec() };
            (0..p).map(layer).collect()
        };
        let activation = blocks.first().map_or(Activation::Identity, Dense::activation);
        let mut columns: Vec<_> = blocks.iter().map(|b| layers(b).into_iter()).collect();
        let mut outputs = layers(output).into_iter();
        let member = |m| Member {
            input: pack(&input, m, d, h),
            blocks: columns.iter_mut().filter_map(Iterator::next).collect(),
            output: outputs.next().expect("one per member"),
        };
        Some(Self { members: (0..p).map(member).collect(), activation, sizes: [d, h, o] })
    }

    /// y `[P, B, o]` of x `[P, B, d]`, b `[P, 1, H]` and skip `[P, B, H]`, all on the CPU; no part of autodiff. Runs on
    /// the calling thread.
    ///
    /// # Panics
    /// If the shapes do not fit.
    pub fn forward(&self, x: Tensor<3>, bias: Tensor<3>, skip: Tensor<3>) -> Tensor<3> {
        let [p, rows, _] = x.dims();
        let [d, h, o] = self.sizes;
        assert!(p == self.members.len() && x.dims() == [p, rows, d]);
        assert!(bias.dims() == [p, 1, h] && skip.dims() == [p, rows, h]);
        let primitive = |t: Tensor<3>| -> FlexTensor {
            t.inner().try_into_primitive::<Flex>().expect("a tensor of the CPU device").to_contiguous()
        };
        let (x, bias, skip) = (primitive(x), primitive(bias), primitive(skip));
        let slice = |t: &FlexTensor| -> *const [f32] { t.as_slice::<f32>().expect("a contiguous f32 tensor") };
        // SAFETY: the tensors live until the end of this function, and nobody writes to them.
        let (x, bias, skip) = unsafe { (&*slice(&x), &*slice(&bias), &*slice(&skip)) };
        let mut y = room(p * rows * o);
        let (mut one, mut two) = (room(ROWS * h), room(ROWS * h));
        for (m, member) in self.members.iter().enumerate() {
            let bias = &bias[m * h..][..h];
            for first in (0..rows).step_by(ROWS) {
                let n = ROWS.min(rows - first);
                let part = |width: usize| (m * rows + first) * width..(m * rows + first + n) * width;
                let (x, skip) = (&x[part(d)], &skip[part(h)]);
                self.block(member, x, bias, skip, n, &mut one[..n * h], &mut two[..n * h], &mut y[part(o)]);
            }
        }
        // SAFETY: every block has been written.
        let y = unsafe { written(y) };
        Tensor::from_primitive::<Flex>(FlexTensor::from_data(TensorData::new(y, [p, rows, o])))
    }

    #[allow(clippy::too_many_arguments)]
    fn block(
        &self,
        member: &Member,
        x: &[f32],
        bias: &[f32],
        skip: &[f32],
        n: usize,
        one: &mut Uninit,
        two: &mut Uninit,
        y: &mut Uninit,
    ) {
        let ([d, h, o], kept) = (self.sizes, std::ptr::null_mut());
        let finish = |bias, act, skip| Finish::Activate { bias, act, kept, skip };
        let (mut from, mut to) = (one, two);
        let first = finish(bias, Activation::Identity, Some(skip));
        product(from, Matrix::plain(x, d), Right::Packed(&member.input), [n, d, h], first);
        for block in &member.blocks {
            // SAFETY: the product before has written all of it.
            let z = unsafe { &*(std::ptr::from_ref(from) as *const [f32]) };
            let finish = finish(&block.bias, self.activation, Some(z));
            product(to, Matrix::plain(z, h), Right::Packed(&block.weight), [n, h, h], finish);
            (from, to) = (to, from);
        }
        // SAFETY: as above.
        let z = unsafe { &*(std::ptr::from_ref(from) as *const [f32]) };
        let last = finish(&member.output.bias, Activation::Identity, None);
        product(y, Matrix::plain(z, h), Right::Packed(&member.output.weight), [n, h, o], last);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{cpu, dense, tensor};
    use tce_base::{Streams, random::fill_normal};

    #[test]
    fn it_follows_the_composition_of_layers() {
        let streams = [Streams::new(1), Streams::new(2)];
        let layer = |name: &str, i, o, act| Dense::new(&streams, name, i, o, act, &cpu());
        let normal = |name: &str, shape: [usize; 3]| {
            let mut data = vec![0.0; shape.iter().product()];
            fill_normal(&mut Streams::new(3).stream(name), &mut data);
            tensor(data, shape, &cpu())
        };
        for (rows, width) in [(1, 32), (119, 48), (250, 37)] {
            let input = normal("w", [2, 5, width]);
            let blocks: Vec<_> = (0..3).map(|i| layer(&format!("{i}"), width, width, Activation::Silu)).collect();
            let output = layer("out", width, 5, Activation::Identity);
            let (x, bias, skip) =
                (normal("x", [2, rows, 5]), normal("b", [2, 1, width]), normal("s", [2, rows, width]));
            let stack = ResidualStack::pack(input.clone(), &blocks, &output).expect("on the CPU");
            let fused = host(stack.forward(x.clone(), bias.clone(), skip.clone()));
            let h = dense(x, input, bias, Activation::Identity) + skip;
            let composed = host(output.forward(blocks.iter().fold(h, |h, b| h.clone() + b.forward(h))));
            assert!(fused.iter().zip(&composed).all(|(a, b)| (a - b).abs() < 2e-5 * b.abs().max(1.0)));
        }
    }
}
