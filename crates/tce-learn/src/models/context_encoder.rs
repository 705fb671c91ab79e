//! The encoder of contexts z. Meta-DT's world model trains it ([`crate::world_model`]), and its policy uses it.

use serde::{Deserialize, Serialize};
use tce_base::Streams;
use tce_nn::burn::nn::{Initializer, Linear, gru::Gru, gru::GruConfig};
use tce_nn::burn::tensor::activation::relu;
use tce_nn::{Device, Module, Tensor};

use crate::networks::{Start, initialise, linear};

/// The sizes of a [`ContextEncoder`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderSizes {
    /// Number of observation dimensions that the networks see.
    pub inputs: usize,
    /// Number of action dimensions.
    pub actions: usize,
    /// Width of each part of f.
    pub features: usize,
    /// Width of the GRU.
    pub hidden: usize,
    /// Width of z.
    pub latent: usize,
    /// h
    pub horizon: usize,
}

impl EncoderSizes {
    /// Number of parameters of an encoder of these sizes.
    pub(crate) fn parameters(&self) -> f64 {
        let [d, a, f, g, z] = [self.inputs, self.actions, self.features, self.hidden, self.latent].map(|n| n as f64);
        (d + a + 1.0 + 3.0) * f + 3.0 * (3.0 * f + g + 2.0) * g + (g + 1.0) * z
    }

    /// New networks; `name` distinguishes their random streams from others.
    pub(crate) fn init(&self, name: &str, streams: Streams, device: &Device) -> ContextEncoder {
        let c = self;
        let encoder = ContextEncoder {
            state: linear(c.inputs, c.features, device),
            action: linear(c.actions, c.features, device),
            reward: linear(1, c.features, device),
            gru: GruConfig::new(3 * c.features, c.hidden, true).with_initializer(Initializer::Zeros).init(device),
            latent: linear(c.hidden, c.latent, device),
            horizon: c.horizon,
        };
        // As in PyTorch's GRU: all weights and biases are within ± one over the root of the hidden width.
        let bound = 1.0 / (c.hidden as f32).sqrt();
        initialise(encoder, name, streams, |path| match path.starts_with("gru.") {
            true => Start::Uniform(bound),
            false => Start::Linear,
        })
    }
}

/// Computes z from the previous steps; see [`crate::world_model`].
#[derive(Module, Debug)]
pub struct ContextEncoder {
    state: Linear,
    action: Linear,
    reward: Linear,
    gru: Gru,
    latent: Linear,
    /// h
    pub(crate) horizon: usize,
}

impl ContextEncoder {
    /// z of every step of segments: strips `[B, h + K - 1, ·]` of states, actions and rewards → `[B, K, Z]`.
    pub fn contexts(&self, [states, actions, rewards]: [Tensor<3>; 3]) -> Tensor<3> {
        let [batch, strip, _] = states.dims();
        let h = self.horizon;
        let steps = strip + 1 - h;
        let features = [self.state.forward(states), self.action.forward(actions), self.reward.forward(rewards)];
        let features = relu(Tensor::cat(features.to_vec(), 2));
        let windows = (0..steps).map(|k| features.clone().narrow(1, k, h)).collect();
        let hidden = self.gru.forward(Tensor::cat(windows, 0), None).narrow(1, h - 1, 1);
        let z = self.latent.forward(hidden);
        let width = z.dims()[2];
        z.reshape([steps, batch, width]).swap_dims(0, 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tce_base::random::fill_normal;
    use tce_nn::{NamedParameters, cpu, host, tensor};

    fn sizes() -> EncoderSizes {
        EncoderSizes { inputs: 3, actions: 2, features: 4, hidden: 5, latent: 6, horizon: 3 }
    }

    fn noise(shape: [usize; 3], name: &str) -> Vec<f32> {
        let mut values = vec![0.0; shape.iter().product()];
        fill_normal(&mut Streams::new(1).stream(name), &mut values);
        values
    }

    /// Computes z of the second step of a segment in f64 from the weights.
    #[test]
    fn contexts_follow_the_formula_and_see_nothing_of_their_own_step() {
        let encoder = sizes().init("e", Streams::new(4), &cpu());
        let strip = 4;
        let (s, a, r) = (noise([2, strip, 3], "s"), noise([2, strip, 2], "a"), noise([2, strip, 1], "r"));
        let run = |s: &[f32], r: &[f32]| {
            let on = |v: &[f32], d: usize| tensor(v.to_vec(), [2, strip, d], &cpu());
            encoder.contexts([on(s, 3), on(&a, 2), on(r, 1)])
        };
        let z = run(&s, &r);
        assert_eq!(z.dims(), [2, 2, 6]);
        let mut weights = NamedParameters::default();
        weights.collect("e", &encoder);
        assert_eq!(weights.tensors.values().map(|t| t.1.len()).sum::<usize>() as f64, sizes().parameters());
        let affine = |name: &str, x: &[f64]| -> Vec<f64> {
            let (w, b) =
                (&weights.tensors[&format!("e.{name}.weight")].1, &weights.tensors[&format!("e.{name}.bias")].1);
            let out = |j: usize| (0..x.len()).map(|i| x[i] * w[i * b.len() + j] as f64).sum::<f64>() + b[j] as f64;
            (0..b.len()).map(out).collect()
        };
        let wide = |v: &[f32]| v.iter().map(|x| *x as f64).collect::<Vec<_>>();
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        let mut h = vec![0.0; 5];
        for t in 1..4 {
            // Batch entry 1.
            let at = strip + t;
            let mut f = affine("state", &wide(&s[3 * at..][..3]));
            f.extend(affine("action", &wide(&a[2 * at..][..2])));
            f.extend(affine("reward", &wide(&r[at..][..1])));
            f.iter_mut().for_each(|x| *x = x.max(0.0));
            let gate = |name: &str| {
                (
                    affine(&format!("gru.{name}.input_transform"), &f),
                    affine(&format!("gru.{name}.hidden_transform"), &h),
                )
            };
            let (u, reset, new) = (gate("update_gate"), gate("reset_gate"), gate("new_gate"));
            h = (0..5)
                .map(|j| {
                    let (u, reset) = (sigmoid(u.0[j] + u.1[j]), sigmoid(reset.0[j] + reset.1[j]));
                    (1.0 - u) * (new.0[j] + reset * new.1[j]).tanh() + u * h[j]
                })
                .collect();
        }
        let expected = affine("latent", &h);
        for (z, e) in host(z.clone())[18..24].iter().zip(expected) {
            assert!((*z as f64 - e).abs() < 1e-5, "{z} {e}");
        }
        // The last step of the strip belongs to the history of the segment's last step only.
        let (mut other, mut rewards) = (s.clone(), r.clone());
        (other[9], rewards[3]) = (9.0, 9.0);
        let (z, changed) = (host(z), host(run(&other, &rewards)));
        assert_eq!(z[..6], changed[..6]);
        assert_ne!(z[6..12], changed[6..12]);
    }
}
