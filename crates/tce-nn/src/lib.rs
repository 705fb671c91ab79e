//! Networks with a population axis.
//!
//! Every parameter has the shape `[P, ...]` and every batch `[P, B, D]`: P independent networks (seeds, tasks,
//! ensembles) are one set of tensors and one training. Tensors, autodiff and modules are burn's; what the CPU does more
//! than once per step (dense layers, layer normalisation, Adam, moving averages, a score network's trunk in sampling) goes through fused operations ([`dense`],
//! [`Adam`], [`ResidualStack`]), of which
//! the plain composition of burn operations is the definition and the test oracle.

mod activation;
mod adam;
mod checkpoint;
mod dense;
mod gemm;
mod kernels;
mod layers;
mod norm;
mod params;
mod probe;
mod simd;
mod stack;
mod tensors;
mod trained;

pub use activation::Activation;
pub use adam::{Adam, AdamConfig};
pub use checkpoint::{Checkpoints, set_checkpoint_seconds};
pub use dense::{dense, dense_composed};
pub use layers::{Dense, LayerNorm, Mlp, MlpConfig};
pub use norm::{layer_norm, layer_norm_composed};
pub use params::{NamedParameters, NetworkError, moving_average, parameter_count};
pub use probe::{instructions, product_rate};
pub use stack::ResidualStack;
pub use tensors::{Batch, cosine_decay, host, tensor};

pub use trained::{Averaged, Trained};

pub use burn;
pub use burn::module::Module;
pub use burn::tensor::{Device, Tensor};

/// Whether networks on `device` are computed by the CPU: there the members of a population gain nothing from being one
/// set of tensors, and scale over cores as trainings of their own.
pub fn is_cpu(device: &Device) -> bool {
    matches!(device.clone().inner().as_dispatch(), burn::backend::DispatchDevice::Flex(_))
}

/// The CPU: burn's `flex` device, without autodiff.
pub fn cpu() -> Device {
    Device::flex()
}
