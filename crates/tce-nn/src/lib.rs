//! Networks with a population axis.
//!
//! Every parameter has the shape `[P, ...]` and every batch `[P, B, D]`: P independent networks (seeds, tasks, twin
//! critics) are one set of tensors and one training. Tensors, autodiff and modules are burn's; what the CPU does more
//! than once per step (dense layers, Adam, moving averages) goes through fused operations ([`dense`], [`Adam`]), of which
//! the plain composition of burn operations is the definition and the test oracle.

mod activation;
mod adam;
mod dense;
mod kernels;
mod layers;
mod params;
mod tensors;

pub use activation::Activation;
pub use adam::{Adam, AdamConfig};
pub use dense::{dense, dense_composed};
pub use layers::{Dense, LayerNorm, Mlp, MlpConfig};
pub use params::{NamedParameters, NetworkError, moving_average, parameter_count};
pub use tensors::{Batch, cosine_decay, host, tensor};

pub use burn;
pub use burn::module::Module;
pub use burn::tensor::{Device, Tensor};

/// The CPU: burn's `flex` device, without autodiff.
pub fn cpu() -> Device {
    Device::flex()
}
