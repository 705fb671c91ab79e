//! The decision transformer (Chen et al. 2021) of Meta-DT, one member's, of burn's modules.
//!
//! ```text
//! a step's tokens   R̂ W_R,  [s W_f; z] W_s,  a W_a, each with a bias and + the embedding of t
//! x = dropout(LN(tokens)), in the order R̂_0 s_0 a_0 R̂_1 s_1 a_1 ...
//! x ← x + dropout(attention(LN(x))),  x ← x + dropout(W_2 relu(LN(x) W_1))     a block (GPT-2's order)
//! π = tanh(LN(x) W_π) at the tokens of the states
//! ```
//!
//! Attention is causal: an action comes of what lies before it in the order above. Two short cuts change no output: the action of the
//! last step is no token, because nothing comes after it, and the last block computes the tokens of the states alone.
//!
//! GPT-2 also drops attention weights. burn's attention does that with its own generator, which does not repeat itself, so
//! that it is left out here; the three other places have masks from the member's streams.

use tce_base::Streams;
use tce_nn::burn::nn::activation::ActivationConfig;
use tce_nn::burn::nn::attention::{
    MhaInput, MultiHeadAttention, MultiHeadAttentionConfig, generate_autoregressive_mask,
};
use tce_nn::burn::nn::transformer::{PositionWiseFeedForward, PositionWiseFeedForwardConfig};
use tce_nn::burn::nn::{Embedding, EmbeddingConfig, Initializer, LayerNorm, LayerNormConfig, Linear};
use tce_nn::burn::tensor::Int;
use tce_nn::{Device, Module, Tensor};

use serde::{Deserialize, Serialize};

use crate::networks::{Dropout, Start, initialise};
use crate::world_model::linear;

/// Standard deviation of a block's first weights (GPT-2's).
const WEIGHT_STD: f32 = 0.02;

/// The sizes of a [`DecisionTransformer`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransformerSizes {
    /// Observation dimensions that are seen.
    pub inputs: usize,
    /// Action dimensions.
    pub actions: usize,
    /// Width of z.
    pub latent: usize,
    /// Width of s W_f.
    pub features: usize,
    /// Width of a token.
    pub embed: usize,
    /// Blocks.
    pub layers: usize,
    /// Heads of attention.
    pub heads: usize,
    /// Steps of an episode that are told apart; later ones look like the last.
    pub timesteps: usize,
}

impl TransformerSizes {
    /// Numbers that a transformer of these sizes holds.
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
        // GPT-2: what is added to the residual stream is smaller the more of it there is.
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

/// The steps of segments, `[B, K, ·]`; those of a segment come first, what stands behind them has no influence on them.
#[derive(Clone, Debug)]
pub struct TransformerInput {
    /// R̂ / scale, `[B, K, 1]`.
    pub returns: Tensor<3>,
    /// s
    pub states: Tensor<3>,
    /// z
    pub contexts: Tensor<3>,
    /// a; the last step's is not looked at.
    pub actions: Tensor<3>,
    /// t, `[B, K]`, below the number of time steps that are told apart.
    pub times: Tensor<2, Int>,
}

impl DecisionTransformer {
    /// The action of every step, `[B, K, A]`.
    pub(crate) fn forward(&self, steps: TransformerInput, mut dropout: Option<&mut Dropout>) -> Tensor<3> {
        let mut drop = |x: Tensor<3>| match dropout.as_mut() {
            Some(dropout) => dropout.apply(x),
            None => x,
        };
        let [batch, k, _] = steps.states.dims();
        let time = self.embed_time.forward(steps.times);
        let state = Tensor::cat(vec![self.features.forward(steps.states), steps.contexts], 2);
        let tokens = [
            self.embed_return.forward(steps.returns),
            self.embed_state.forward(state),
            self.embed_action.forward(steps.actions),
        ];
        let tokens = tokens.map(|t| t + time.clone()).to_vec();
        let width = tokens[0].dims()[2];
        let length = 3 * k - 1;
        let x = Tensor::stack::<4>(tokens, 2).reshape([batch, 3 * k, width]).narrow(1, 0, length);
        let mut x = drop(self.norm_in.forward(x));
        let device = x.device();
        let states = Tensor::<1, Int>::arange_step(1..length as i64, 3, &device);
        let mask = generate_autoregressive_mask(batch, length, &device);
        let state_mask = mask.clone().select(1, states.clone());
        for (index, block) in self.blocks.iter().enumerate() {
            let y = block.norm_1.forward(x.clone());
            let (query, mask) = match index + 1 == self.blocks.len() {
                true => {
                    x = x.select(1, states.clone());
                    (y.clone().select(1, states.clone()), state_mask.clone())
                }
                false => (y.clone(), mask.clone()),
            };
            let input = MhaInput::new(query, y.clone(), y).mask_attn(mask);
            x = x + drop(block.attention.forward(input).context);
            x = x.clone() + drop(block.feed_forward.forward(block.norm_2.forward(x)));
        }
        if self.blocks.is_empty() {
            x = x.select(1, states);
        }
        self.head.forward(self.norm_out.forward(x)).tanh()
    }
}
