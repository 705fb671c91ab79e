//! Helpers for networks made of burn's modules.
//!
//! - Initial weights and dropout from named streams. Burn draws both from one generator for the whole process, so its
//!   numbers depend on the order of the threads.
//! - The fused operations of `tce-nn` on the parameters of burn's modules. The modules' own forward passes are the
//!   definition, and the reference in tests. They make a decision transformer's update two and a half times as slow.

use rand::Rng as _;
use tce_base::random::{fill_normal, fill_uniform};
use tce_base::{Rng, Streams};
use tce_nn::burn::module::{ModuleMapper, Param};
use tce_nn::burn::nn::attention::MultiHeadAttention;
use tce_nn::burn::nn::transformer::PositionWiseFeedForward;
use tce_nn::burn::nn::{Initializer, LayerNorm, Linear, LinearConfig};
use tce_nn::burn::tensor::Bool;
use tce_nn::burn::tensor::activation::softmax;
use tce_nn::burn::tensor::{Tensor, TensorData};
use tce_nn::{Activation, Device, Module, dense, layer_norm};

/// Initial value of one parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Start {
    /// The value from the module's constructor: scale 1 and shift 0 of a normalisation.
    Kept,
    /// 0
    Zero,
    /// N(0, σ²)
    Normal(f32),
    /// U(±bound)
    Uniform(f32),
    /// U(±1/√fan-in), for weights and biases alike: PyTorch's linear layer.
    Linear,
}

/// `module` with the weights of a member. Each is drawn from the stream `init/{name}/{path}` as `rule` returns.
pub(crate) fn initialise<M: Module>(module: M, name: &str, streams: Streams, rule: impl Fn(&str) -> Start) -> M {
    module.map(&mut Initialiser { path: vec![format!("init/{name}")], streams, rule, fan_in: 1 })
}

struct Initialiser<R> {
    path: Vec<String>,
    streams: Streams,
    rule: R,
    /// Fan-in of the last weight; its bias comes next.
    fan_in: usize,
}

impl<R: Fn(&str) -> Start> ModuleMapper for Initialiser<R> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, old, mapper) = param.consume();
        let dims = old.dims();
        if D == 2 {
            self.fan_in = dims[0];
        }
        let mut values = vec![0.0; dims.iter().product()];
        let mut rng = self.streams.stream(&self.path.join("/"));
        let mut uniform = |bound: f32| {
            fill_uniform(&mut rng, &mut values);
            values.iter_mut().for_each(|v| *v = (2.0 * *v - 1.0) * bound);
        };
        match (self.rule)(&self.path[1..].join(".")) {
            Start::Kept => return Param::from_mapped_value(id, old, mapper),
            Start::Zero => {}
            Start::Uniform(bound) => uniform(bound),
            Start::Linear => uniform(1.0 / (self.fan_in as f32).sqrt()),
            Start::Normal(std) => {
                fill_normal(&mut rng, &mut values);
                values.iter_mut().for_each(|v| *v *= std);
            }
        }
        let new = Tensor::from_data(TensorData::new(values, dims), &old.device());
        let new = if old.is_require_grad() { new.require_grad() } else { new };
        Param::from_mapped_value(id, new, mapper)
    }
}

/// Dropout with masks from a member's random stream.
pub(crate) struct Dropout {
    rng: Option<Rng>,
    /// Dropped share, in units of 1/65536.
    dropped: u32,
}

impl Dropout {
    /// Sets elements to 0 with probability `rate` and divides the others by 1 - `rate`.
    pub(crate) fn new(rate: f64, rng: Rng) -> Self {
        Self { rng: Some(rng), dropped: (rate * 65536.0).round() as u32 }
    }

    /// Dropout of a network that is not trained: none.
    pub(crate) fn none() -> Self {
        Self { rng: None, dropped: 0 }
    }

    /// Applies the next mask.
    pub(crate) fn apply<const D: usize>(&mut self, x: Tensor<D>) -> Tensor<D> {
        Self::apply_members(std::slice::from_mut(self), x)
    }

    /// Applies to each member of a population `[P, ...]` its own next mask.
    pub(crate) fn apply_members<const D: usize>(members: &mut [Self], x: Tensor<D>) -> Tensor<D> {
        if members.iter().all(|m| m.rng.is_none() || m.dropped == 0) {
            return x;
        }
        let dims = x.dims();
        let elements = dims.iter().product::<usize>();
        let mut mask = vec![1.0; elements];
        let share = elements / members.len();
        // Two bytes per element: a float each would take twice the time, which is a tenth of an update.
        let mut bytes = vec![0; 2 * share];
        for (member, mask) in members.iter_mut().zip(mask.chunks_exact_mut(share)) {
            let dropped = member.dropped;
            let Some(rng) = member.rng.as_mut().filter(|_| dropped > 0) else { continue };
            rng.fill_bytes(&mut bytes);
            let kept = 65536.0 / (65536 - dropped) as f32;
            let draws = bytes.chunks_exact(2).map(|b| u32::from(u16::from_le_bytes([b[0], b[1]])));
            mask.iter_mut().zip(draws).for_each(|(mask, draw)| *mask = if draw < dropped { 0.0 } else { kept });
        }
        let device = x.device().inner();
        x * Tensor::from_inner(Tensor::from_data(TensorData::new(mask, dims), &device))
    }
}

/// Applies the layer and the activation to `x` `[A, B, I]`: `[A, B, O]`.
pub(crate) fn affine(layer: &Linear, x: Tensor<3>, act: Activation) -> Tensor<3> {
    let ([a, b, i], weight) = (x.dims(), layer.weight.val());
    let o = weight.dims()[1];
    let bias = layer.bias.as_ref().expect("every layer here has one").val().reshape([1, 1, o]);
    dense(x.reshape([1, a * b, i]), weight.reshape([1, i, o]), bias, act).reshape([a, b, o])
}

/// Normalises `x` over its last axis.
pub(crate) fn normalise(norm: &LayerNorm, x: Tensor<3>) -> Tensor<3> {
    let [gamma, beta] = [&norm.gamma, norm.beta.as_ref().expect("every normalisation here has one")];
    layer_norm(x, gamma.val().reshape([1, 1, -1]), beta.val().reshape([1, 1, -1]))
}

/// Applies the two layers with a ReLU between them.
pub(crate) fn feed_forward(layers: &PositionWiseFeedForward, x: Tensor<3>) -> Tensor<3> {
    affine(&layers.linear_outer, affine(&layers.linear_inner, x, Activation::Relu), Activation::Identity)
}

/// Attention of `query` `[B, Q, E]` to `keys` `[B, S, E]`, including the layer of the values. `mask` `[B, 1, Q, S]` is
/// true where attention is blocked. `drop` is applied to the attention weights.
pub(crate) fn attention(
    layers: &MultiHeadAttention,
    query: Tensor<3>,
    keys: Tensor<3>,
    mask: Tensor<4, Bool>,
    drop: impl FnOnce(Tensor<4>) -> Tensor<4>,
) -> Tensor<3> {
    let [batch, rows, width] = query.dims();
    let heads = |layer: &Linear, x: Tensor<3>| {
        let [batch, length, _] = x.dims();
        let y = affine(layer, x, Activation::Identity);
        y.reshape([batch, length, layers.n_heads, layers.d_k]).swap_dims(1, 2)
    };
    let (q, k, v) = (heads(&layers.query, query), heads(&layers.key, keys.clone()), heads(&layers.value, keys));
    let scores = q.matmul(k.transpose()) / (layers.d_k as f64).sqrt();
    let weights = drop(softmax(scores.mask_fill(mask, layers.min_float), 3));
    let seen = weights.matmul(v).swap_dims(1, 2).reshape([batch, rows, width]);
    affine(&layers.output, seen, Activation::Identity)
}

/// A layer whose weights are drawn later.
pub(crate) fn linear(input: usize, output: usize, device: &Device) -> Linear {
    LinearConfig::new(input, output).with_initializer(Initializer::Zeros).init(device)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_nn::burn::nn::{Linear, LinearConfig};
    use tce_nn::{cpu, host};

    #[test]
    fn dropout_keeps_the_mean_and_repeats_itself() {
        let x = Tensor::<2>::ones([100, 100], &cpu().autodiff());
        let draw = |index| host(Dropout::new(0.1, Streams::new(1).indexed("dropout", index)).apply(x.clone()));
        let y = draw(3);
        let zeros = y.iter().filter(|v| **v == 0.0).count();
        assert!((900..1100).contains(&zeros), "{zeros}");
        assert!(y.iter().all(|v| *v == 0.0 || (v - 1.0 / 0.9).abs() < 1e-4));
        assert_eq!(y, draw(3));
        assert_ne!(y, draw(4));
        assert_eq!(host(Dropout::new(0.0, Streams::new(1).stream("d")).apply(x.clone())), host(x));
    }

    /// Compares with the forward passes of burn's modules.
    #[test]
    fn fused_passes_follow_the_modules() {
        use tce_nn::burn::nn::activation::ActivationConfig;
        use tce_nn::burn::nn::attention::{MhaInput, MultiHeadAttentionConfig, generate_autoregressive_mask};
        use tce_nn::burn::nn::{LayerNormConfig, transformer::PositionWiseFeedForwardConfig};
        let device = cpu();
        let normal = |_: &str| Start::Normal(0.3);
        let streams = Streams::new(2);
        let config = MultiHeadAttentionConfig::new(12, 3).with_dropout(0.0);
        let mha = initialise(config.init(&device), "mha", streams, normal);
        let config = PositionWiseFeedForwardConfig::new(12, 20).with_dropout(0.0);
        let config = config.with_activation(ActivationConfig::Relu);
        let pair = initialise(config.init(&device), "pair", streams, normal);
        let norm = initialise(LayerNormConfig::new(12).init(&device), "norm", streams, normal);
        let mut values = vec![0.0; 2 * 5 * 12];
        fill_normal(&mut streams.stream("x"), &mut values);
        let x = tce_nn::tensor(values, [2, 5, 12], &device);
        let mask = generate_autoregressive_mask(2, 5, &device);
        let own = attention(&mha, x.clone(), x.clone(), mask.clone().reshape([2, 1, 5, 5]), |w| w);
        let input = MhaInput::self_attn(x.clone()).mask_attn(mask);
        for (fused, module) in [
            (own, mha.forward(input).context),
            (feed_forward(&pair, x.clone()), pair.forward(x.clone())),
            (normalise(&norm, x.clone()), norm.forward(x)),
        ] {
            let far = host(fused).iter().zip(host(module)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(far < 1e-5, "{far}");
        }
    }

    #[test]
    fn weights_come_from_the_members_stream() {
        let device = cpu().autodiff();
        let make = |seed| -> Linear {
            let rule = |path: &str| if path == "weight" { Start::Linear } else { Start::Normal(0.5) };
            initialise(LinearConfig::new(100, 50).init(&device), "layer", Streams::new(seed), rule)
        };
        let (a, b, c) = (make(1), make(1), make(2));
        let weight = |l: &Linear| host(l.weight.val());
        assert_eq!(weight(&a), weight(&b));
        assert_ne!(weight(&a), weight(&c));
        assert!(weight(&a).iter().all(|w| w.abs() <= 0.1) && weight(&a).iter().any(|w| w.abs() > 0.09));
        assert!(a.weight.val().is_require_grad());
    }
}
