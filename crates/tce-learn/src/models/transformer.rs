//! The decision transformer (Chen et al. 2021) of Meta-DT for one member, made of burn's modules.
//!
//! ```text
//! a step's tokens   R̂ W_R,  [s W_f; z] W_s,  a W_a, each with a bias and + the embedding of t
//! x = dropout(LN(tokens)), in the order R̂_0 s_0 a_0 R̂_1 s_1 a_1 ...
//! x ← x + dropout(attention(LN(x))),  x ← x + dropout(W_2 relu(LN(x) W_1))     a block (GPT-2's order)
//! π = tanh(LN(x) W_π) at the tokens of the states
//! ```
//!
//! Attention is causal: an action depends only on what precedes it in the order above. Two shortcuts do not change the
//! output: the last action has no token, because nothing follows it, and the last block computes only the tokens of
//! states.
//!
//! Dropout is as in GPT-2: on tokens, attention weights and a block's output. Its masks come from the member's streams.

use tce_base::Streams;
use tce_nn::burn::nn::activation::ActivationConfig;
use tce_nn::burn::nn::attention::{MultiHeadAttention, MultiHeadAttentionConfig, generate_autoregressive_mask};
use tce_nn::burn::nn::transformer::{PositionWiseFeedForward, PositionWiseFeedForwardConfig};
use tce_nn::burn::nn::{Embedding, EmbeddingConfig, Initializer, LayerNorm, LayerNormConfig, Linear};
use tce_nn::burn::tensor::Int;
use tce_nn::{Activation, Device, Module, Tensor};

use serde::{Deserialize, Serialize};

use crate::networks::{Dropout, Start, affine, attention, feed_forward, initialise, linear, normalise};

/// Standard deviation of a block's initial weights (GPT-2's).
const WEIGHT_STD: f32 = 0.02;

/// The sizes of a [`DecisionTransformer`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransformerSizes {
    /// Number of observation dimensions that the network sees.
    pub inputs: usize,
    /// Number of action dimensions.
    pub actions: usize,
    /// Width of z.
    pub latent: usize,
    /// Width of s W_f.
    pub features: usize,
    /// Width of a token.
    pub embed: usize,
    /// Number of blocks.
    pub layers: usize,
    /// Number of attention heads.
    pub heads: usize,
    /// Steps of an episode that have different embeddings; later steps share the last one.
    pub timesteps: usize,
}

impl TransformerSizes {
    /// Number of parameters of a transformer of these sizes.
    pub(crate) fn parameters(&self) -> f64 {
        let c = [self.inputs, self.actions, self.latent, self.features, self.embed, self.layers, self.timesteps];
        let [d, a, z, f, e, l, t] = c.map(|n| n as f64);
        let tokens = (d + 1.0) * f + (f + z + 1.0) * e + 2.0 * e + (a + 1.0) * e + t * e + 2.0 * e;
        let block = 4.0 * (e + 1.0) * e + (e + 1.0) * 4.0 * e + (4.0 * e + 1.0) * e + 4.0 * e;
        tokens + l * block + 2.0 * e + (e + 1.0) * a
    }

    /// New networks of one member.
    pub(crate) fn init(&self, streams: Streams, device: &Device) -> DecisionTransformer {
        let e = self.embed;
        let norm = || LayerNormConfig::new(e).init(device);
        let attention = MultiHeadAttentionConfig::new(e, self.heads).with_dropout(0.0);
        let feed_forward = PositionWiseFeedForwardConfig::new(e, 4 * e)
            .with_dropout(0.0)
            .with_activation(ActivationConfig::Relu)
            .with_initializer(Initializer::Zeros);
        let block = || Block {
            norm_1: norm(),
            attention: attention.clone().with_initializer(Initializer::Zeros).init(device),
            norm_2: norm(),
            feed_forward: feed_forward.init(device),
        };
        let net = DecisionTransformer {
            features: linear(self.inputs, self.features, device),
            embed_return: linear(1, e, device),
            embed_state: linear(self.features + self.latent, e, device),
            embed_action: linear(self.actions, e, device),
            embed_time: EmbeddingConfig::new(self.timesteps, e).with_initializer(Initializer::Zeros).init(device),
            norm_in: norm(),
            blocks: (0..self.layers).map(|_| block()).collect(),
            norm_out: norm(),
            head: linear(e, self.actions, device),
        };
        // As in GPT-2: contributions to the residual stream are smaller if there are more of them.
        let residual = WEIGHT_STD / (2.0 * self.layers as f32).sqrt();
        initialise(net, "transformer", streams, |path| match path {
            p if p.ends_with("gamma") || p.ends_with("beta") => Start::Kept,
            p if p.starts_with("embed_time") => Start::Normal(1.0),
            p if !p.starts_with("blocks") => Start::Linear,
            p if p.ends_with("bias") => Start::Zero,
            p if p.contains("attention.output") || p.contains("linear_outer") => Start::Normal(residual),
            _ => Start::Normal(WEIGHT_STD),
        })
    }
}

#[derive(Module, Debug)]
struct Block {
    norm_1: LayerNorm,
    attention: MultiHeadAttention,
    norm_2: LayerNorm,
    feed_forward: PositionWiseFeedForward,
}

/// The network; see the [module](self).
#[derive(Module, Debug)]
pub struct DecisionTransformer {
    features: Linear,
    embed_return: Linear,
    embed_state: Linear,
    embed_action: Linear,
    embed_time: Embedding,
    norm_in: LayerNorm,
    blocks: Vec<Block>,
    norm_out: LayerNorm,
    head: Linear,
}

/// The steps of segments, `[B, K, ·]`. The steps of a segment come first; padding after them does not affect them.
#[derive(Clone, Debug)]
pub struct TransformerInput {
    /// R̂ / scale, `[B, K, 1]`.
    pub returns: Tensor<3>,
    /// s
    pub states: Tensor<3>,
    /// z
    pub contexts: Tensor<3>,
    /// a; the last step's action is ignored.
    pub actions: Tensor<3>,
    /// t, `[B, K]`, less than the number of time steps with embeddings.
    pub times: Tensor<2, Int>,
}

impl DecisionTransformer {
    /// The action of every step, `[B, K, A]`; `dropout` is applied in training.
    pub(crate) fn forward(&self, input: TransformerInput, dropout: &mut Dropout) -> Tensor<3> {
        let [batch, k, _] = input.states.dims();
        let time = self.embed_time.forward(input.times);
        let token = |layer: &Linear, x: Tensor<3>| affine(layer, x, Activation::Identity);
        let state = Tensor::cat(vec![token(&self.features, input.states), input.contexts], 2);
        let tokens = [
            token(&self.embed_return, input.returns),
            token(&self.embed_state, state),
            token(&self.embed_action, input.actions),
        ];
        let tokens = tokens.map(|t| t + time.clone()).to_vec();
        let width = tokens[0].dims()[2];
        let length = 3 * k - 1;
        let x = Tensor::stack::<4>(tokens, 2).reshape([batch, 3 * k, width]).narrow(1, 0, length);
        let mut x = dropout.apply(normalise(&self.norm_in, x));
        let states = Tensor::<1, Int>::arange_step(1..length as i64, 3, &x.device());
        let mask = generate_autoregressive_mask(batch, length, &x.device()).reshape([batch, 1, length, length]);
        for (index, block) in self.blocks.iter().enumerate() {
            let keys = normalise(&block.norm_1, x.clone());
            let (mut query, mut mask) = (keys.clone(), mask.clone());
            if index + 1 == self.blocks.len() {
                x = x.select(1, states.clone());
                query = query.select(1, states.clone());
                mask = mask.select(2, states.clone());
            }
            let seen = attention(&block.attention, query, keys, mask, |w| dropout.apply(w));
            x = x + dropout.apply(seen);
            let more = feed_forward(&block.feed_forward, normalise(&block.norm_2, x.clone()));
            x = x + dropout.apply(more);
        }
        affine(&self.head, normalise(&self.norm_out, x), Activation::Tanh)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_base::random::fill_normal;
    use tce_nn::burn::tensor::TensorData;
    use tce_nn::{NamedParameters, cpu, host, tensor};

    const K: usize = 4;

    fn sizes() -> TransformerSizes {
        TransformerSizes {
            inputs: 3,
            actions: 2,
            latent: 4,
            features: 5,
            embed: 12,
            layers: 3,
            heads: 2,
            timesteps: 10,
        }
    }

    /// Two segments; `change` alters the numbers (R̂, s, z, a) of the first.
    fn forward(net: &DecisionTransformer, change: impl Fn(&mut [Vec<f32>; 4])) -> Vec<f32> {
        let mut all = [1, 3, 4, 2].map(|width| {
            let mut values = vec![0.0; 2 * K * width];
            fill_normal(&mut Streams::new(6).indexed("tokens", width as u64), &mut values);
            values
        });
        change(&mut all);
        let [returns, states, contexts, actions] = all.map(|v| {
            let width = v.len() / (2 * K);
            tensor(v, [2, K, width], &cpu())
        });
        let times = TensorData::new((0..2 * K as i32).collect::<Vec<_>>(), [2, K]);
        let times = Tensor::<2, Int>::from_data(times, &cpu());
        host(net.forward(TransformerInput { returns, states, contexts, actions, times }, &mut Dropout::none()))
    }

    /// π at a step changes with R̂, s and z of that step and with all earlier steps, but not with later ones.
    #[test]
    fn an_action_comes_of_what_lies_before_it() {
        let net = sizes().init(Streams::new(1), &cpu());
        let plain = forward(&net, |_| {});
        assert_eq!(plain.len(), 2 * K * 2);
        for step in 0..K {
            for (kind, width) in [1, 3, 4, 2].into_iter().enumerate() {
                let changed = forward(&net, |all| all[kind][step * width] += 3.0);
                // An action affects the outputs from the next step on.
                let first = if kind == 3 { step + 1 } else { step };
                assert_eq!(plain[..2 * first], changed[..2 * first], "kind {kind}, step {step}: looked ahead");
                assert_eq!(plain[2 * K..], changed[2 * K..], "another segment changed");
                for seen in first..K {
                    assert_ne!(plain[2 * seen..][..2], changed[2 * seen..][..2], "kind {kind}, step {step}: not seen");
                }
            }
        }
    }

    #[test]
    fn there_are_as_many_numbers_as_promised() {
        let mut weights = NamedParameters::default();
        weights.collect("t", &sizes().init(Streams::new(1), &cpu()));
        assert_eq!(weights.tensors.values().map(|t| t.1.len()).sum::<usize>() as f64, sizes().parameters());
    }

    /// Every mask is used, and the same stream gives the same masks again.
    #[test]
    fn training_drops_and_repeats_itself() {
        let net = sizes().init(Streams::new(1), &cpu());
        let zeros = |width| Tensor::<3>::ones([2, K, width], &cpu());
        let run = |index| {
            let input = TransformerInput {
                returns: zeros(1),
                states: zeros(3),
                contexts: zeros(4),
                actions: zeros(2),
                times: Tensor::<2, Int>::zeros([2, K], &cpu()),
            };
            host(net.forward(input, &mut Dropout::new(0.3, Streams::new(2).indexed("dropout", index))))
        };
        assert_eq!(run(0), run(0));
        assert_ne!(run(0), run(1));
    }
}
