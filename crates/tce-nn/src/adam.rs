//! Adam (Kingma & Ba 2015), one pass over memory per parameter on the CPU, together with the moving average of the parameters
//! where there is one.
//!
//! m ← β₁ m + (1 − β₁) g,  v ← β₂ v + (1 − β₂) g²,  θ ← θ − lr · m̂ / (√v̂ + ε), with m̂ = m / (1 − β₁ᵗ) and v̂ likewise;
//! θ' ← θ' + ρ (θ − θ').
//!
//! | symbol | field | default | source |
//! |---|---|---|---|
//! | β₁, β₂ | `beta_1`, `beta_2` | 0.9, 0.999 | PyTorch's defaults, as in every code of the field |
//! | ε | `epsilon` | 1e-8 | the same |
//! | λ | `weight_decay` | 0 | decoupled (AdamW), multiplied by lr |
//! | c | `max_norm` | none | g ← g · min(1, c / (‖g‖ + 1e-6)), ‖g‖ over all parameters, as PyTorch's `clip_grad_norm_` |
//! | ρ | argument of [`Adam::step_averaged`] | – | the learner's |

use std::collections::VecDeque;

use burn::backend::Flex;
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Gradients, Tensor};
use multiversion::multiversion;
use serde::{Deserialize, Serialize};

use crate::dense::is_flex;
use crate::params::follow;
use crate::tensors::host;

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
    /// Greatest norm of the gradient of all parameters together; a longer one is shortened. The norm is that of the whole
    /// module: a population in one module would be clipped as one, so hold one module per member.
    pub max_norm: Option<f64>,
}

impl Default for AdamConfig {
    fn default() -> Self {
        Self { beta_1: 0.9, beta_2: 0.999, epsilon: 1e-8, weight_decay: 0.0, max_norm: None }
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
        self.advance(lr, module, grads, None)
    }

    /// [`Adam::step`], then `average` a step of `rate` towards the result; parameters without a gradient included.
    /// `average` is outside of autodiff.
    pub fn step_averaged<M: Module>(
        &mut self,
        lr: f64,
        module: M,
        grads: &mut Gradients,
        average: M,
        rate: f64,
    ) -> (M, M) {
        let mut followers = Followers { rate: rate as f32, tensors: Default::default() };
        // Taken out of the module, the tensors have one owner and are changed in place.
        let average = average.map(&mut Taker { out: &mut followers.tensors });
        let module = self.advance(lr, module, grads, Some(&mut followers));
        (module, average.map(&mut Giver { from: &mut followers.tensors }))
    }

    fn advance<M: Module>(
        &mut self,
        lr: f64,
        module: M,
        grads: &mut Gradients,
        followers: Option<&mut Followers>,
    ) -> M {
        self.time += 1;
        let c = self.config;
        let coefficients = Coefficients {
            beta_1: c.beta_1 as f32,
            beta_2: c.beta_2 as f32,
            // lr m̂ / (√v̂ + ε) = step · m / (√v + eps)
            step: (lr * (1.0 - c.beta_2.powi(self.time)).sqrt() / (1.0 - c.beta_1.powi(self.time))) as f32,
            epsilon: (c.epsilon * (1.0 - c.beta_2.powi(self.time)).sqrt()) as f32,
            keep: (1.0 - lr * c.weight_decay) as f32,
            shorten: c.max_norm.map_or(1.0, |max| (max / (gradient_norm(&module, grads) + 1e-6)).min(1.0)) as f32,
        };
        module.map(&mut Stepper { index: 0, moments: &mut self.moments, grads, coefficients, followers })
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
    /// Factor on the gradient.
    shorten: f32,
}

/// ‖g‖ over all parameters of `module` that have a gradient. Added up in double precision and in a fixed order.
pub(crate) fn gradient_norm<M: Module>(module: &M, grads: &Gradients) -> f64 {
    struct Norm<'a> {
        grads: &'a Gradients,
        squares: f64,
    }
    impl ModuleVisitor for Norm<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let Some(g) = param.val().grad(self.grads) else { return };
            if !is_flex(&g) {
                self.squares += host(g.square().sum())[0] as f64;
                return;
            }
            let g = g.try_into_primitive::<Flex>().expect("on the CPU and outside of autodiff").to_contiguous();
            // Sixteen running sums, because one alone waits for itself at every addition.
            let mut sums = [0.0; 16];
            for chunk in g.as_slice::<f32>().expect("contiguous").chunks(sums.len()) {
                sums.iter_mut().zip(chunk).for_each(|(sum, g)| *sum += *g as f64 * *g as f64);
            }
            self.squares += sums.iter().sum::<f64>();
        }
    }
    let mut norm = Norm { grads, squares: 0.0 };
    module.visit(&mut norm);
    norm.squares.sqrt()
}

/// The parameters of a moving average, in module order; each goes to the end of the queue when it has moved.
struct Followers {
    rate: f32,
    tensors: VecDeque<Tensor<1>>,
}

struct Taker<'a> {
    out: &'a mut VecDeque<Tensor<1>>,
}

impl ModuleMapper for Taker<'_> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, tensor, mapper) = param.consume();
        // A view that keeps the shape and none of the memory.
        let place = Tensor::<D>::zeros([1; D], &tensor.device()).expand(tensor.shape());
        self.out.push_back(tensor.reshape([-1]));
        Param::from_mapped_value(id, place, mapper)
    }
}

struct Giver<'a> {
    from: &'a mut VecDeque<Tensor<1>>,
}

impl ModuleMapper for Giver<'_> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, place, mapper) = param.consume();
        let tensor = self.from.pop_front().expect("one per parameter");
        Param::from_mapped_value(id, tensor.reshape(place.shape()), mapper)
    }
}

struct Stepper<'a> {
    followers: Option<&'a mut Followers>,
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
        let mut follower =
            self.followers.as_mut().map(|f| (f.tensors.pop_front().expect("networks of one kind"), f.rate));
        let flat = match grad {
            None => {
                follower = follower.map(|(average, rate)| (follow(average, flat.clone(), rate), rate));
                flat
            }
            Some(grad) => {
                let slot = &mut self.moments[index];
                let empty = || Tensor::empty([0], &flat.device());
                let (m, v) = std::mem::replace(slot, (empty(), empty()));
                let state = State { theta: flat, m, v, follower };
                let state = update(state, grad.reshape([-1]), self.coefficients);
                *slot = (state.m, state.v);
                follower = state.follower;
                state.theta
            }
        };
        if let (Some(followers), Some((average, _))) = (self.followers.as_mut(), follower) {
            followers.tensors.push_back(average);
        }
        let tensor = Tensor::from_inner(flat.reshape(shape)).require_grad();
        Param::from_mapped_value(id, tensor, mapper)
    }
}

/// What a step changes of one parameter: θ, m, v, and θ' with ρ.
struct State {
    theta: Tensor<1>,
    m: Tensor<1>,
    v: Tensor<1>,
    follower: Option<(Tensor<1>, f32)>,
}

fn update(state: State, g: Tensor<1>, c: Coefficients) -> State {
    if !is_flex(&state.theta) {
        return update_composed(state, g, c);
    }
    let primitive = |t: Tensor<1>| t.try_into_primitive::<Flex>().expect("on the CPU and outside of autodiff");
    let (mut theta, mut m, mut v) = (primitive(state.theta), primitive(state.m), primitive(state.v));
    let g = primitive(g).to_contiguous();
    let g = g.as_slice().expect("contiguous");
    let follower = match state.follower {
        None => {
            fused(theta.storage_mut(), g, m.storage_mut(), v.storage_mut(), c);
            None
        }
        Some((average, rate)) => {
            let mut average = primitive(average);
            let (theta, m, v) = (theta.storage_mut(), m.storage_mut(), v.storage_mut());
            fused_averaged(theta, g, m, v, c, average.storage_mut(), rate);
            Some((Tensor::from_primitive::<Flex>(average), rate))
        }
    };
    let tensor = Tensor::from_primitive::<Flex>;
    State { theta: tensor(theta), m: tensor(m), v: tensor(v), follower }
}

fn update_composed(state: State, g: Tensor<1>, c: Coefficients) -> State {
    let g = g * c.shorten;
    let m = state.m * c.beta_1 + g.clone() * (1.0 - c.beta_1);
    let v = state.v * c.beta_2 + g.square() * (1.0 - c.beta_2);
    let theta = state.theta * c.keep - m.clone() * c.step / (v.clone().sqrt() + c.epsilon);
    let follower = state.follower.map(|(average, rate)| (average.clone() + (theta.clone() - average) * rate, rate));
    State { theta, m, v, follower }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn fused(theta: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32], c: Coefficients) {
    for (((theta, g), m), v) in theta.iter_mut().zip(g).zip(m).zip(v) {
        step(theta, *g, m, v, c);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn fused_averaged(
    theta: &mut [f32],
    g: &[f32],
    m: &mut [f32],
    v: &mut [f32],
    c: Coefficients,
    average: &mut [f32],
    rate: f32,
) {
    for ((((theta, g), m), v), average) in theta.iter_mut().zip(g).zip(m).zip(v).zip(average) {
        step(theta, *g, m, v, c);
        *average += rate * (*theta - *average);
    }
}

#[inline(always)]
fn step(theta: &mut f32, g: f32, m: &mut f32, v: &mut f32, c: Coefficients) {
    let g = g * c.shorten;
    *m = *m * c.beta_1 + g * (1.0 - c.beta_1);
    *v = *v * c.beta_2 + (g * g) * (1.0 - c.beta_2);
    *theta = *theta * c.keep - *m * c.step / (v.sqrt() + c.epsilon);
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

    /// Weight decay and clipping, against the formulas in f64: the gradient (6, 8) of length 10 is shortened to length 1.
    #[test]
    fn decays_and_clips_as_the_formula_says() {
        let device = Device::flex().autodiff();
        let mut layer = Dense::new(&[Streams::new(0)], "x", 1, 2, Activation::Identity, &device);
        let before = host(layer.weight.val());
        let config = AdamConfig { weight_decay: 0.1, max_norm: Some(1.0), epsilon: 1e-2, ..AdamConfig::default() };
        let slopes = Tensor::<3>::from_floats([[[6.0, 8.0]]], &device);
        let mut grads = (layer.weight.val() * slopes).sum().backward();
        assert!((gradient_norm(&layer, &grads) - 10.0).abs() < 1e-6);
        layer = config.init().step(0.5, layer, &mut grads);
        for ((after, before), g) in host(layer.weight.val()).into_iter().zip(before).zip([0.6, 0.8]) {
            // At the first step m̂ = g and √v̂ = |g|.
            let expected = before as f64 * (1.0 - 0.5 * 0.1) - 0.5 * g / (g + 1e-2);
            assert!((after as f64 - expected).abs() < 1e-5, "{after} {expected}");
        }
        assert_eq!(host(layer.bias.val()).len(), 2);
    }

    #[test]
    fn fused_follows_the_composition() {
        let device = Device::flex();
        let vector = |scale: f32| Tensor::<1>::from_floats([0.5, -1.0, 2.0, 1e-3].map(|v: f32| v * scale), &device);
        let c = Coefficients { beta_1: 0.9, beta_2: 0.999, step: 1e-2, epsilon: 1e-8, keep: 0.99, shorten: 0.5 };
        let start = || (vector(1.0), vector(-0.3), vector(0.1), vector(1.0).abs());
        for average in [false, true] {
            let state = |(theta, _, m, v): (_, Tensor<1>, _, _)| State {
                theta,
                m,
                v,
                follower: average.then(|| (vector(3.0), 0.25)),
            };
            let (a, b) = (update(state(start()), start().1, c), update_composed(state(start()), start().1, c));
            let follower = |s: &State| s.follower.as_ref().map_or_else(|| vector(0.0), |f| f.0.clone());
            for (a, b) in [(follower(&a), follower(&b)), (a.theta, b.theta), (a.m, b.m), (a.v, b.v)] {
                for (a, b) in host(a).into_iter().zip(host(b)) {
                    assert!((a - b).abs() <= 1e-6 * b.abs().max(1.0));
                }
            }
        }
    }

    /// The same bytes as a step and then an average, for parameters with and without a gradient.
    #[test]
    fn a_step_with_an_average_is_both() {
        let device = Device::flex().autodiff();
        let streams = [Streams::new(1)];
        let layer = || Dense::new(&streams, "x", 5, 3, Activation::Identity, &device);
        // The bias takes no part in the loss.
        let loss = |l: &Dense| l.weight.val().square().sum();
        let start = || crate::moving_average(layer().valid(), &layer(), 0.0);
        let (mut both, mut average, mut one) = (layer(), start(), AdamConfig::default().init());
        let (mut alone, mut after, mut two) = (layer(), start(), AdamConfig::default().init());
        for _ in 0..3 {
            let mut grads = loss(&both).backward();
            (both, average) = one.step_averaged(1e-2, both, &mut grads, average, 0.1);
            let mut grads = loss(&alone).backward();
            alone = two.step(1e-2, alone, &mut grads);
            after = crate::moving_average(after, &alone, 0.1);
        }
        let values = |l: &Dense| [host(l.weight.val()), host(l.bias.val())];
        assert_eq!(values(&both), values(&alone));
        assert_eq!(values(&average), values(&after));
        assert_eq!(average.weight.dims(), [1, 5, 3]);
    }
}
