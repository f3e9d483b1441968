//! The compute devices.

use std::{num::NonZeroUsize, panic};

use burn::tensor::{Device, Tensor};
#[cfg(feature = "cuda")]
use eddy_cuda::{MOST_GPUS, gpu_number};
use eddy_inference::engine::Precision;
use serde::{Deserialize, Serialize};

/// A compute device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "&'static str", try_from = "String")]
pub enum DeviceKind {
    /// CPU through burn-flex, the default.
    #[default]
    Flex,
    /// CPU through burn-ndarray; deprecated upstream, kept for comparison.
    Ndarray,
    /// The best GPU that Vulkan finds.
    #[cfg(feature = "vulkan")]
    Vulkan,
    /// An NVIDIA GPU by its number, below [`MOST_GPUS`].
    #[cfg(feature = "cuda")]
    Cuda(u8),
    /// An NVIDIA GPU where there is one and the network can be trained on it, otherwise `flex`.
    Auto,
}

#[cfg(feature = "cuda")]
const CUDA_NAMES: [&str; MOST_GPUS] = [
    "cuda", "cuda:1", "cuda:2", "cuda:3", "cuda:4", "cuda:5", "cuda:6", "cuda:7", "cuda:8",
    "cuda:9", "cuda:10", "cuda:11", "cuda:12", "cuda:13", "cuda:14", "cuda:15",
];

/// Every device that this build knows, in the order of the help.
const ALL: &[DeviceKind] = &[
    DeviceKind::Flex,
    DeviceKind::Ndarray,
    #[cfg(feature = "vulkan")]
    DeviceKind::Vulkan,
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(0),
    DeviceKind::Auto,
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(1),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(2),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(3),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(4),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(5),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(6),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(7),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(8),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(9),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(10),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(11),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(12),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(13),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(14),
    #[cfg(feature = "cuda")]
    DeviceKind::Cuda(15),
];

impl DeviceKind {
    /// The name in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Flex => "flex",
            Self::Ndarray => "ndarray",
            #[cfg(feature = "vulkan")]
            Self::Vulkan => "vulkan",
            #[cfg(feature = "cuda")]
            Self::Cuda(number) => CUDA_NAMES[usize::from(number)],
            Self::Auto => "auto",
        }
    }

    /// The GPU `ahead` places after this one; other devices stay the same.
    #[must_use]
    pub fn plus(self, ahead: usize) -> Self {
        match self {
            #[cfg(feature = "cuda")]
            Self::Cuda(number) => {
                let last = CUDA_NAMES.len() - 1;
                Self::Cuda((usize::from(number) + ahead).min(last) as u8)
            }
            other => {
                let _ = ahead;
                other
            }
        }
    }

    /// The device that is meant, for a network that can be trained on an NVIDIA GPU or not: never [`DeviceKind::Auto`].
    #[must_use]
    pub fn resolve(self, runs_on_gpus: bool) -> Self {
        match self {
            #[cfg(feature = "cuda")]
            Self::Auto if runs_on_gpus && Self::Cuda(0).check().is_ok() => Self::Cuda(0),
            Self::Auto => {
                let _ = runs_on_gpus;
                Self::Flex
            }
            known => known,
        }
    }

    /// Whether it is an NVIDIA GPU, which is not used through burn.
    pub fn is_cuda(self) -> bool {
        match self {
            #[cfg(feature = "cuda")]
            Self::Cuda(_) => true,
            _ => false,
        }
    }

    /// The device whose steps burn takes: that of the CPU in the place of an NVIDIA GPU, which is not used through burn.
    #[must_use]
    pub fn through_burn(self) -> Self {
        match self {
            #[cfg(feature = "cuda")]
            Self::Cuda(_) => Self::Flex,
            Self::Auto => Self::Flex,
            known => known,
        }
    }

    /// Checks that the device is available.
    ///
    /// # Errors
    /// [`NoDevice`] where the first operation fails, as it does without a driver.
    pub fn check(self) -> Result<(), NoDevice> {
        #[cfg(feature = "cuda")]
        if let Self::Cuda(number) = self {
            return eddy_cuda::gpu::check(number.into()).map_err(NoDevice::Cuda);
        }
        // burn reports a missing device by a panic, also on its own threads.
        let hook = panic::take_hook();
        panic::set_hook(Box::new(|_| {}));
        let outcome = panic::catch_unwind(|| Tensor::<1>::zeros([1], &self.device()).into_data());
        panic::set_hook(hook);
        outcome.map(|_| ()).map_err(|_| NoDevice::Driver { found: self.name() })
    }

    /// burn's device, without a record for gradients. An NVIDIA GPU is not used through burn: then it is the one that
    /// holds the weights between epochs.
    pub(crate) fn device(self) -> Device {
        match self.through_burn() {
            #[expect(deprecated, reason = "selectable on purpose, see the variant")]
            Self::Ndarray => Device::ndarray(),
            #[cfg(feature = "vulkan")]
            Self::Vulkan => Device::vulkan(burn::tensor::DeviceKind::DefaultDevice),
            _ => Device::flex(),
        }
    }
}

impl From<DeviceKind> for &'static str {
    fn from(device: DeviceKind) -> Self {
        device.name()
    }
}

impl TryFrom<String> for DeviceKind {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        #[cfg(feature = "cuda")]
        if let Some(number) = gpu_number(&name) {
            return Ok(Self::Cuda(number));
        }
        let known = ALL.iter().find(|device| device.name() == name);
        known
            .copied()
            .ok_or_else(|| format!("device: found {name}, expected a device of this build"))
    }
}

#[cfg(feature = "clap")]
impl clap::ValueEnum for DeviceKind {
    fn value_variants<'a>() -> &'a [Self] {
        ALL
    }

    fn to_possible_value(&self) -> Option<clap::builder::PossibleValue> {
        let value = clap::builder::PossibleValue::new(self.name());
        Some(match self {
            Self::Flex => value.alias("cpu").help("CPU through burn-flex"),
            Self::Ndarray => {
                value.help("CPU through burn-ndarray; deprecated upstream, kept for comparison")
            }
            #[cfg(feature = "vulkan")]
            Self::Vulkan => value.help("The best GPU that Vulkan finds"),
            #[cfg(feature = "cuda")]
            Self::Cuda(0) => value.alias("cuda:0").help("An NVIDIA GPU, cuda:1 for the second"),
            #[cfg(feature = "cuda")]
            Self::Cuda(_) => value.hide(true),
            Self::Auto => {
                value.help("An NVIDIA GPU where it can train the network, otherwise flex")
            }
        })
    }
}

/// How GPUs are used.
#[derive(Clone, Copy, Debug)]
pub struct GpuOptions {
    /// How many GPUs train together, each on its part of every batch.
    pub count: NonZeroUsize,
    /// How they multiply.
    pub precision: Precision,
}

impl Default for GpuOptions {
    /// One GPU, in TF32.
    fn default() -> Self {
        Self { count: NonZeroUsize::MIN, precision: Precision::default() }
    }
}

/// The device is not available.
#[derive(Debug, thiserror::Error)]
pub enum NoDevice {
    /// burn finds no driver.
    #[error(
        "device: found no driver for {found}, expected a device that this machine has, such as flex"
    )]
    Driver {
        /// The device's name.
        found: &'static str,
    },
    /// There is no GPU, or a library is missing.
    #[cfg(feature = "cuda")]
    #[error(transparent)]
    Cuda(eddy_cuda::CudaError),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_is_found_again_by_its_name() {
        for &device in ALL {
            assert_eq!(DeviceKind::try_from(device.name().to_owned()), Ok(device));
        }
        #[cfg(feature = "cuda")]
        assert_eq!(DeviceKind::try_from("cuda:0".to_owned()), Ok(DeviceKind::Cuda(0)));
        let error = DeviceKind::try_from("cuda:99".to_owned()).unwrap_err();
        assert!(error.contains("found cuda:99"), "{error}");
    }
}
