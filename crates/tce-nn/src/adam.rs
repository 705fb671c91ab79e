//! Adam (Kingma & Ba 2015), one pass over memory per parameter on the CPU.
//!
//! m ← β₁ m + (1 − β₁) g,  v ← β₂ v + (1 − β₂) g²,  θ ← θ − lr · m̂ / (√v̂ + ε), with m̂ = m / (1 − β₁ᵗ) and v̂ likewise.
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | β₁, β₂ | `beta_1`, `beta_2` | 0.9, 0.999 | PyTorch's defaults, as in every code of the field |
//! | ε | `epsilon` | 1e-8 | the same |
//! | λ | `weight_decay` | 0 | decoupled (AdamW), multiplied by lr |

use burn::backend::Flex;
use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{Gradients, Tensor};
use multiversion::multiversion;
use serde::{Deserialize, Serialize};

use crate::dense::is_flex;

/// The constants of [`Adam`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AdamConfig {
    /// β₁
    pub beta_1: f64,
    /// β₂
    pub beta_2: f64,
    /// ε
    pub epsilon: f64,
    /// Decoupled weight decay.
    pub weight_decay: f64,
}

impl Default for AdamConfig {
    fn default() -> Self {
        Self { beta_1: 0.9, beta_2: 0.999, epsilon: 1e-8, weight_decay: 0.0 }
    }
}

impl AdamConfig {
    /// An optimiser that has not seen a step.
    pub fn init(self) -> Adam {
        Adam { config: self, time: 0, moments: Vec::new() }
    }
}

/// The optimiser of one module. Parameters are told apart by their order in the module.
#[derive(Clone, Debug)]
pub struct Adam {
    config: AdamConfig,
    time: i32,
    /// (m, v) of each parameter, flat.
    moments: Vec<(Tensor<1>, Tensor<1>)>,
}

impl Adam {
    /// One step along `grads`. Parameters without a gradient stay as they are.
    pub fn step<M: Module>(&mut self, lr: f64, module: M, grads: &mut Gradients) -> M {
        self.time += 1;
        let c = self.config;
        let coefficients = Coefficients {
            beta_1: c.beta_1 as f32,
            beta_2: c.beta_2 as f32,
            // lr m̂ / (√v̂ + ε) = step · m / (√v + eps)
            step: (lr * (1.0 - c.beta_2.powi(self.time)).sqrt() / (1.0 - c.beta_1.powi(self.time))) as f32,
            epsilon: (c.epsilon * (1.0 - c.beta_2.powi(self.time)).sqrt()) as f32,
            keep: (1.0 - lr * c.weight_decay) as f32,
        };
        module.map(&mut Stepper { index: 0, moments: &mut self.moments, grads, coefficients })
    }

    /// Steps taken, and (m, v) of each parameter in module order; what a checkpoint holds.
    pub fn state(&self) -> (i32, &[(Tensor<1>, Tensor<1>)]) {
        (self.time, &self.moments)
    }

    /// Puts back what [`Adam::state`] gave.
    pub fn restore(&mut self, time: i32, moments: Vec<(Tensor<1>, Tensor<1>)>) {
        (self.time, self.moments) = (time, moments);
    }
}

#[derive(Clone, Copy)]
struct Coefficients {
    beta_1: f32,
    beta_2: f32,
    step: f32,
    epsilon: f32,
    keep: f32,
}

struct Stepper<'a> {
    index: usize,
    moments: &'a mut Vec<(Tensor<1>, Tensor<1>)>,
    grads: &'a mut Gradients,
    coefficients: Coefficients,
}

impl ModuleMapper for Stepper<'_> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, tensor, mapper) = param.consume();
        let grad = tensor.grad_remove(self.grads);
        let shape = tensor.shape();
        let flat: Tensor<1> = tensor.inner().reshape([-1]);
        let index = self.index;
        self.index += 1;
        if self.moments.len() <= index {
            let zeros = || Tensor::zeros([shape.num_elements()], &flat.device());
            self.moments.push((zeros(), zeros()));
        }
        let flat = match grad {
            None => flat,
            Some(grad) => {
                let slot = &mut self.moments[index];
                let empty = || Tensor::empty([0], &flat.device());
                let (m, v) = std::mem::replace(slot, (empty(), empty()));
                let (flat, m, v) = update(flat, grad.reshape([-1]), m, v, self.coefficients);
                *slot = (m, v);
                flat
            }
        };
        let tensor = Tensor::from_inner(flat.reshape(shape)).require_grad();
        Param::from_mapped_value(id, tensor, mapper)
    }
}

fn update(
    theta: Tensor<1>,
    g: Tensor<1>,
    m: Tensor<1>,
    v: Tensor<1>,
    c: Coefficients,
) -> (Tensor<1>, Tensor<1>, Tensor<1>) {
    if !is_flex(&theta) {
        return update_composed(theta, g, m, v, c);
    }
    let primitive = |t: Tensor<1>| t.try_into_primitive::<Flex>().expect("on the CPU and outside of autodiff");
    let (mut theta, g, mut m, mut v) = (primitive(theta), primitive(g), primitive(m), primitive(v));
    let g = g.to_contiguous();
    fused(theta.storage_mut(), g.as_slice().expect("contiguous"), m.storage_mut(), v.storage_mut(), c);
    let tensor = Tensor::from_primitive::<Flex>;
    (tensor(theta), tensor(m), tensor(v))
}

fn update_composed(
    theta: Tensor<1>,
    g: Tensor<1>,
    m: Tensor<1>,
    v: Tensor<1>,
    c: Coefficients,
) -> (Tensor<1>, Tensor<1>, Tensor<1>) {
    let m = m * c.beta_1 + g.clone() * (1.0 - c.beta_1);
    let v = v * c.beta_2 + g.square() * (1.0 - c.beta_2);
    let theta = theta * c.keep - m.clone() * c.step / (v.clone().sqrt() + c.epsilon);
    (theta, m, v)
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn fused(theta: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32], c: Coefficients) {
    for (((theta, g), m), v) in theta.iter_mut().zip(g).zip(m).zip(v) {
        *m = *m * c.beta_1 + g * (1.0 - c.beta_1);
        *v = *v * c.beta_2 + (g * g) * (1.0 - c.beta_2);
        *theta = *theta * c.keep - *m * c.step / (v.sqrt() + c.epsilon);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Activation, Dense, Device, host};
    use tce_base::Streams;

    /// Three steps on one weight with gradient g = 2θ, against Adam written out in f64.
    #[test]
    fn follows_the_formula() {
        let device = Device::flex().autodiff();
        let mut layer = Dense::new(&[Streams::new(0)], "x", 1, 1, Activation::Identity, &device);
        let mut theta = host(layer.weight.val())[0] as f64;
        let mut adam = AdamConfig::default().init();
        let (mut m, mut v) = (0.0, 0.0);
        for t in 1..=3 {
            let mut grads = layer.weight.val().square().sum().backward();
            layer = adam.step(1e-2, layer, &mut grads);
            let g = 2.0 * theta;
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            theta -= 1e-2 * (m / (1.0 - 0.9f64.powi(t))) / ((v / (1.0 - 0.999f64.powi(t))).sqrt() + 1e-8);
            assert!((host(layer.weight.val())[0] as f64 - theta).abs() < 1e-6, "step {t}");
        }
    }

    #[test]
    fn fused_follows_the_composition() {
        let device = Device::flex();
        let vector = |scale: f32| Tensor::<1>::from_floats([0.5, -1.0, 2.0, 1e-3].map(|v: f32| v * scale), &device);
        let c = Coefficients { beta_1: 0.9, beta_2: 0.999, step: 1e-2, epsilon: 1e-8, keep: 0.99 };
        let start = || (vector(1.0), vector(-0.3), vector(0.1), vector(1.0).abs());
        let (t, g, m, v) = start();
        let a = update(t, g, m, v, c);
        let (t, g, m, v) = start();
        let b = update_composed(t, g, m, v, c);
        for (a, b) in [(a.0, b.0), (a.1, b.1), (a.2, b.2)] {
            for (a, b) in host(a).into_iter().zip(host(b)) {
                assert!((a - b).abs() <= 1e-6 * b.abs().max(1.0));
            }
        }
    }
}
