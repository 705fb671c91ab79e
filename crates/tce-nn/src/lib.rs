//! Networks with a population axis.
//!
//! Every parameter has the shape `[P, ...]` and every batch `[P, B, D]`: P independent networks (seeds, tasks,
//! ensembles) are one set of tensors and one training. Tensors, autodiff and modules are burn's; what the CPU does more
//! than once per step (dense layers, layer normalisation, Adam, moving averages, a score network's trunk in sampling) goes through fused operations ([`dense`],
//! [`Adam`], [`ResidualStack`]), of which
//! the plain composition of burn operations is the definition and the test oracle.
//!
//! ```
//! use tce_base::Streams;
//! use tce_nn::{MlpConfig, Tensor, cpu};
//!
//! // Two networks of 3 inputs, one hidden layer and 1 output, of seeds 0 and 1: one set of tensors.
//! let members = [Streams::new(0), Streams::new(1)];
//! let networks = MlpConfig::relu(3, &[16], 1).init(&members, "critic", &cpu());
//! let outputs = networks.forward(Tensor::<3>::ones([2, 5, 3], &cpu()));
//! assert_eq!(outputs.dims(), [2, 5, 1]);
//! ```

use std::sync::OnceLock;

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
pub use probe::{instructions, machine, processor, product_rate};
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

/// Does `work` on the threads that operations on `device` are best called from: all of them for the CPU, one for a GPU, where what
/// several threads queue has to be put in order again.
///
/// # Panics
/// If that one thread cannot be started.
pub fn on_threads_of<R: Send>(device: &Device, work: impl FnOnce() -> R + Send) -> R {
    static ONE: OnceLock<rayon::ThreadPool> = OnceLock::new();
    if is_cpu(device) {
        return work();
    }
    let one = || rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread for the GPU");
    ONE.get_or_init(one).install(work)
}

/// The CPU: burn's `flex` device, without autodiff.
pub fn cpu() -> Device {
    Device::flex()
}

/// The first GPU that Vulkan offers, without autodiff. A software driver counts as one, but Mesa's crashes in burn's matrix products.
///
/// # Errors
/// If there is none, or the program was built without the feature `vulkan`.
#[cfg(feature = "vulkan")]
pub fn vulkan() -> Result<Device, NetworkError> {
    use burn::tensor::wgpu::WgpuBackend;
    // burn refuses to begin a second time.
    static DEVICE: OnceLock<Result<Device, String>> = OnceLock::new();
    let start = || Device::wgpu_options().graphics_api(WgpuBackend::Vulkan).init().map_err(|e| e.to_string());
    let device = DEVICE.get_or_init(start).clone();
    device.map_err(|e| NetworkError::NoGpu(format!("{e}; is there a Vulkan driver (`vulkaninfo --summary`)?")))
}

/// See the feature `vulkan`.
///
/// # Errors
/// Always: the program was built without it.
#[cfg(not(feature = "vulkan"))]
pub fn vulkan() -> Result<Device, NetworkError> {
    Err(NetworkError::NoGpu("this program was built for the CPU alone; build it with `--features vulkan`".into()))
}
