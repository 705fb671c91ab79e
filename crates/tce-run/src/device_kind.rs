//! What computes the networks: the CPU, or a GPU through Vulkan where the program was built for it.

use std::fmt;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use tce_nn::{Device, cpu, is_cpu};

use crate::error::Result;

/// A kind of device. Simulation, nearest neighbours, transport and files are the CPU's in any case.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DeviceKind {
    /// The CPU: the same seed gives the same bytes, at any number of threads.
    #[default]
    Cpu,
    /// The first GPU that Vulkan offers. All seeds of a training are one set of tensors there. Numbers differ from the
    /// CPU's by rounding, and may do so from run to run.
    Vulkan,
}

impl DeviceKind {
    /// Adds the device to what decides a result, unless it is the CPU.
    pub fn sign(self, spec: &mut serde_json::Value) {
        if self != Self::Cpu {
            spec["device"] = self.to_string().into();
        }
    }

    /// The device, without autodiff.
    ///
    /// # Errors
    /// If the program was built without it, or the machine has none.
    pub fn device(self) -> Result<Device> {
        Ok(match self {
            Self::Cpu => cpu(),
            Self::Vulkan => tce_nn::vulkan()?,
        })
    }
}

impl From<&Device> for DeviceKind {
    fn from(device: &Device) -> Self {
        if is_cpu(device) { Self::Cpu } else { Self::Vulkan }
    }
}

impl fmt::Display for DeviceKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Cpu => "cpu",
            Self::Vulkan => "vulkan",
        })
    }
}
