//! Layers and the multi-layer perceptron, all over a population.

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use tce_base::{Streams, random::fill_uniform};

use crate::activation::Activation;
use crate::dense::dense;
use crate::norm::layer_norm;
use crate::tensors::tensor;

/// act(x W + b). PyTorch's default initialisation: W and b from U(±1/√fan_in).
#[derive(Module, Debug)]
pub struct Dense {
    /// `[P, I, O]`
    pub weight: Param<Tensor<3>>,
    /// `[P, 1, O]`
    pub bias: Param<Tensor<3>>,
    #[module(skip)]
    activation: Activation,
}

impl Dense {
    /// A layer for every member of `members`, drawn from the member's stream `name`.
    ///
    /// Give an autodiff device for parameters that are to be trained.
    pub fn new(
        members: &[Streams],
        name: &str,
        input: usize,
        output: usize,
        activation: Activation,
        device: &Device,
    ) -> Self {
        let bound = 1.0 / (input as f32).sqrt();
        let draw = |part: &str, len: usize| -> Vec<f32> {
            let mut all = vec![0.0; members.len() * len];
            for (chunk, streams) in all.chunks_mut(len).zip(members) {
                fill_uniform(&mut streams.stream(&format!("init/{name}/{part}")), chunk);
                chunk.iter_mut().for_each(|v| *v = (2.0 * *v - 1.0) * bound);
            }
            all
        };
        let p = members.len();
        let weight = tensor(draw("weight", input * output), [p, input, output], device);
        let bias = tensor(draw("bias", output), [p, 1, output], device);
        Self { weight: trainable(weight), bias: trainable(bias), activation }
    }

    /// What follows the affine map.
    pub(crate) fn activation(&self) -> Activation {
        self.activation
    }

    /// x `[P, B, I]` (or fewer members, see [`dense`]) → `[P, B, O]`.
    pub fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        dense(x, self.weight.val(), self.bias.val(), self.activation)
    }
}

/// A parameter; it requires gradients if the tensor is on an autodiff device.
fn trainable(t: Tensor<3>) -> Param<Tensor<3>> {
    Param::from_tensor(t)
}

/// Layer normalisation over the last axis with a learned scale and shift, ε = 1e-5.
#[derive(Module, Debug)]
pub struct LayerNorm {
    /// `[P, 1, D]`
    pub scale: Param<Tensor<3>>,
    /// `[P, 1, D]`
    pub shift: Param<Tensor<3>>,
}

impl LayerNorm {
    /// Scale 1 and shift 0 for `members` networks of width `width`.
    pub fn new(members: usize, width: usize, device: &Device) -> Self {
        Self {
            scale: trainable(Tensor::ones([members, 1, width], device)),
            shift: trainable(Tensor::zeros([members, 1, width], device)),
        }
    }

    /// `[P, B, D]` → `[P, B, D]`.
    pub fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        layer_norm(x, self.scale.val(), self.shift.val())
    }
}

/// The sizes of a [`Mlp`].
#[derive(Clone, Debug, PartialEq)]
pub struct MlpConfig {
    /// Input width.
    pub input: usize,
    /// Widths of the hidden layers.
    pub hidden: Vec<usize>,
    /// Output width.
    pub output: usize,
    /// Of the hidden layers.
    pub activation: Activation,
    /// Of the output layer.
    pub output_activation: Activation,
    /// Whether every hidden layer is normalised, behind its activation.
    pub layer_norm: bool,
}

impl MlpConfig {
    /// Input → `hidden` (ReLU) → output, linear.
    pub fn relu(input: usize, hidden: &[usize], output: usize) -> Self {
        Self {
            input,
            hidden: hidden.to_vec(),
            output,
            activation: Activation::Relu,
            output_activation: Activation::Identity,
            layer_norm: false,
        }
    }

    /// The same with layer normalisation.
    pub fn with_layer_norm(self) -> Self {
        Self { layer_norm: true, ..self }
    }

    /// The same with another activation in the hidden layers.
    pub fn with_activation(self, activation: Activation) -> Self {
        Self { activation, ..self }
    }

    /// The same with an activation behind the output layer.
    pub fn with_output_activation(self, output_activation: Activation) -> Self {
        Self { output_activation, ..self }
    }

    /// One network per member, drawn from its streams `init/{name}/...`.
    pub fn init(&self, members: &[Streams], name: &str, device: &Device) -> Mlp {
        let mut layers = Vec::new();
        let mut width = self.input;
        for (k, &hidden) in self.hidden.iter().enumerate() {
            layers.push(Dense::new(members, &format!("{name}/{k}"), width, hidden, self.activation, device));
            width = hidden;
        }
        let last = format!("{name}/{}", self.hidden.len());
        layers.push(Dense::new(members, &last, width, self.output, self.output_activation, device));
        let normalised = if self.layer_norm { self.hidden.as_slice() } else { &[] };
        let norms = normalised.iter().map(|&width| LayerNorm::new(members.len(), width, device)).collect();
        Mlp { layers, norms }
    }
}

/// A stack of dense layers over a population.
#[derive(Module, Debug)]
pub struct Mlp {
    /// From input to output.
    pub layers: Vec<Dense>,
    /// Behind the hidden layers; none without layer normalisation.
    norms: Vec<LayerNorm>,
}

impl Mlp {
    /// `[P, B, input]` → `[P, B, output]`; fewer input members are shared between neighbouring networks.
    pub fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        self.forward_with(x, |h| h)
    }

    /// The same with `hidden` applied to the output of every hidden layer: dropout, say.
    pub fn forward_with(&self, x: Tensor<3>, mut hidden: impl FnMut(Tensor<3>) -> Tensor<3>) -> Tensor<3> {
        let last = self.layers.len() - 1;
        self.layers.iter().enumerate().fold(x, |x, (k, layer)| {
            let y = layer.forward(x);
            let y = match self.norms.get(k) {
                Some(norm) => norm.forward(y),
                None => y,
            };
            if k < last { hidden(y) } else { y }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Module, cpu, host};

    #[test]
    fn a_member_of_a_population_equals_a_network_of_its_own() {
        let config = MlpConfig::relu(5, &[32, 32], 3);
        let device = cpu();
        let streams = [Streams::new(1), Streams::new(2), Streams::new(3)];
        let all = config.init(&streams, "pi", &device);
        let one = config.init(&streams[1..2], "pi", &device);
        let x = Tensor::<3>::ones([1, 7, 5], &device);
        let y = host(all.forward(x.clone()));
        assert_eq!(y[7 * 3..2 * 7 * 3], host(one.forward(x)));
    }

    #[test]
    fn hidden_layers_may_be_normalised() {
        let (device, members) = (cpu(), [Streams::new(1)]);
        let config = MlpConfig::relu(3, &[8, 8], 2);
        let x = Tensor::<3>::from_floats([[[0.3, -1.0, 2.0], [1.0, 0.0, 5.0]]], &device);
        let (plain, normalised) =
            (config.init(&members, "q", &device), config.clone().with_layer_norm().init(&members, "q", &device));
        let norm = LayerNorm::new(1, 8, &device).valid();
        let h = norm.forward(plain.layers[0].forward(x.clone()));
        let h = norm.forward(plain.layers[1].forward(h));
        assert_eq!(host(normalised.forward(x.clone())), host(plain.layers[2].forward(h)));
        assert_ne!(host(normalised.forward(x.clone())), host(plain.forward(x)));
    }

    #[test]
    fn layer_norm_has_zero_mean_and_unit_variance() {
        let device = cpu();
        let x = tensor((0..24).map(|v| (v * v) as f32).collect(), [2, 3, 4], &device);
        let y = host(LayerNorm::new(2, 4, &device).valid().forward(x));
        for row in y.chunks(4) {
            let mean: f32 = row.iter().sum::<f32>() / 4.0;
            let var: f32 = row.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / 4.0;
            assert!(mean.abs() < 1e-5 && (var - 1.0).abs() < 1e-3);
        }
    }
}
