//! The score networks of Tables B.1 and B.2, one architecture for both.
//!
//! h⁰ = Dense(256)(Concat[x, TimeMLP(t), ConditionMLP(c)]);  hⁱ = hⁱ⁻¹ + SiLU(Dense(256)(hⁱ⁻¹)), i = 1..4;  F = Dense(d)(h⁴)
//!
//! The state score network has the label as its condition (c = y, width 1), the transition score network the state
//! (c = s, width d_s).

use burn::module::Module;
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::{Activation, Dense, Device, Mlp, MlpConfig, ResidualStack, dense, host, tensor};

use crate::DiffusionError;

/// Sizes of a [`ScoreNetwork`].
///
/// | symbol | field | default | source |
/// |---|---|---|---|
/// | d | `dims` | – | width of the rows |
/// | – | `condition` | – | 1 (label) or d_s (state) |
/// | Dense(256) | `width` | 256 | Table B.1 |
/// | Dense(128) | `embedding` | 128 | Table B.2 |
/// | × 4 | `blocks` | 4 | Table B.1 |
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Width of a row.
    pub dims: usize,
    /// Width of the condition.
    pub condition: usize,
    /// Width of the residual blocks.
    pub width: usize,
    /// Width of the two embeddings.
    pub embedding: usize,
    /// Number of residual blocks.
    pub blocks: usize,
}

impl NetworkConfig {
    /// Tables B.1 and B.2 for rows of width `dims` and conditions of width `condition`.
    pub fn new(dims: usize, condition: usize) -> Self {
        Self { dims, condition, width: 256, embedding: 128, blocks: 4 }
    }

    /// Refuses empty layers.
    ///
    /// # Errors
    /// Names the field.
    pub fn check(&self) -> Result<(), DiffusionError> {
        let Self { dims, condition, width, embedding, .. } = *self;
        for (field, value) in [("dims", dims), ("condition", condition), ("width", width), ("embedding", embedding)] {
            if value == 0 {
                return Err(DiffusionError::input(format!("network.{field}"), 0, "at least 1"));
            }
        }
        Ok(())
    }

    /// One network per member, drawn from its streams `init/{name}/...`.
    pub fn init(&self, members: &[Streams], name: &str, device: &Device) -> ScoreNetwork {
        let &Self { dims, condition, width, embedding, blocks } = self;
        let embed = |part: &str, input: usize| {
            MlpConfig {
                input,
                hidden: vec![embedding],
                output: embedding,
                activation: Activation::Silu,
                output_activation: Activation::Silu,
                layer_norm: false,
            }
            .init(members, &format!("{name}/{part}"), device)
        };
        let layer = |part: &str, input: usize, output: usize, activation: Activation| {
            Dense::new(members, &format!("{name}/{part}"), input, output, activation, device)
        };
        ScoreNetwork {
            time: embed("time", 1),
            condition: embed("condition", condition),
            input: layer("input", dims + 2 * embedding, width, Activation::Identity),
            blocks: (0..blocks).map(|i| layer(&format!("block/{i}"), width, width, Activation::Silu)).collect(),
            output: layer("output", width, dims, Activation::Identity),
        }
    }
}

/// A population of score networks, Tables B.1 and B.2.
#[derive(Module, Debug)]
pub struct ScoreNetwork {
    time: Mlp,
    condition: Mlp,
    input: Dense,
    blocks: Vec<Dense>,
    output: Dense,
}

impl ScoreNetwork {
    /// F for rows `x` `[P, B, d]`, times `[P, B, 1]` and conditions `[P, B, c]`.
    pub fn forward(&self, x: Tensor<3>, time: Tensor<3>, condition: Tensor<3>) -> Tensor<3> {
        let input = Tensor::cat(vec![x, self.time.forward(time), self.condition.forward(condition)], 2);
        self.trunk(self.input.forward(input))
    }

    fn trunk(&self, h: Tensor<3>) -> Tensor<3> {
        let h = self.blocks.iter().fold(h, |h, block| h.clone() + block.forward(h));
        self.output.forward(h)
    }

    /// Members of the population.
    pub fn members(&self) -> usize {
        self.input.weight.dims()[0]
    }

    /// Where the parameters are.
    pub fn device(&self) -> Device {
        self.input.weight.device()
    }

    /// The network for rows that keep their condition `[P or 1, B, c]` over many evaluations: the condition passes its
    /// share of the first layers once.
    pub fn bind(&self, condition: Tensor<3>) -> BoundNetwork<'_> {
        let weight = self.input.weight.val();
        let ([p, inputs, width], device) = (weight.dims(), weight.device());
        let embedding = self.time.layers[0].weight.dims()[2];
        let dims = inputs - 2 * embedding;
        let part = |from: usize, rows: usize| {
            // Through host memory, so that the part is contiguous and no evaluation has to copy it.
            tensor(host(weight.clone().narrow(1, from, rows)), [p, rows, width], &device)
        };
        let zero = Tensor::zeros([p, 1, width], &device);
        let embedded = self.condition.forward(condition);
        let row_weight = part(0, dims);
        BoundNetwork {
            network: self,
            stack: ResidualStack::pack(row_weight.clone(), &self.blocks, &self.output),
            row_weight,
            time_weight: part(dims, embedding),
            condition: dense(embedded, part(dims + embedding, embedding), zero, Activation::Identity),
        }
    }
}

/// A [`ScoreNetwork`] with its conditions put in; see [`ScoreNetwork::bind`].
pub struct BoundNetwork<'a> {
    network: &'a ScoreNetwork,
    /// The fused trunk, on the CPU.
    stack: Option<ResidualStack>,
    row_weight: Tensor<3>,
    time_weight: Tensor<3>,
    /// `[P, B, width]`
    condition: Tensor<3>,
}

impl BoundNetwork<'_> {
    /// F for rows `[P, B, d]` that share one time.
    pub fn forward(&self, x: Tensor<3>, time: f64) -> Tensor<3> {
        let time = tensor(vec![time as f32], [1, 1, 1], &x.device());
        let embedded = self.network.time.forward(time);
        let bias = dense(embedded, self.time_weight.clone(), self.network.input.bias.val(), Activation::Identity);
        match &self.stack {
            Some(stack) => stack.forward(x, bias, self.condition.clone()),
            None => self.trunk(x, bias),
        }
    }

    /// The same as a composition of layers.
    fn trunk(&self, x: Tensor<3>, bias: Tensor<3>) -> Tensor<3> {
        let h = dense(x, self.row_weight.clone(), bias, Activation::Identity) + self.condition.clone();
        self.network.trunk(h)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_base::random::fill_normal;
    use tce_nn::{cpu, parameter_count};

    fn normal(name: &str, shape: [usize; 3]) -> Tensor<3> {
        let mut data = vec![0.0; shape.iter().product()];
        fill_normal(&mut Streams::new(5).stream(name), &mut data);
        tensor(data, shape, &cpu())
    }

    /// Counted by hand from Tables B.1 and B.2.
    #[test]
    fn sizes_are_those_of_the_tables() {
        let embed = |input: usize| (input + 1) * 128 + 129 * 128;
        let trunk = |d: usize| (d + 256 + 1) * 256 + 4 * 257 * 256 + 257 * d;
        let count = |d, c| parameter_count(&NetworkConfig::new(d, c).init(&[Streams::new(0)], "q", &cpu()));
        assert_eq!(count(17, 1), embed(1) + embed(1) + trunk(17));
        assert_eq!(count(11, 11), embed(1) + embed(11) + trunk(11));
    }

    #[test]
    fn the_bound_network_is_the_network() {
        let streams = [Streams::new(1), Streams::new(2)];
        let network = NetworkConfig::new(5, 3).init(&streams, "q", &cpu());
        let (x, c) = (normal("x", [2, 40, 5]), normal("c", [2, 40, 3]));
        let bound = network.bind(c.clone());
        for time in [1e-5, 0.3, 1.0] {
            let times = Tensor::full([2, 40, 1], time, &cpu());
            let (a, b) = (host(network.forward(x.clone(), times, c.clone())), host(bound.forward(x.clone(), time)));
            assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 2e-6), "time {time}");
        }
    }

    #[test]
    fn time_and_condition_matter() {
        let network = NetworkConfig::new(2, 1).init(&[Streams::new(1)], "q", &cpu());
        let (x, c) = (normal("x", [1, 4, 2]), normal("c", [1, 4, 1]));
        let y = host(network.bind(c.clone()).forward(x.clone(), 0.5));
        assert_ne!(y, host(network.bind(c.clone()).forward(x.clone(), 0.6)));
        assert_ne!(y, host(network.bind(c + 1.0).forward(x, 0.5)));
    }
}
