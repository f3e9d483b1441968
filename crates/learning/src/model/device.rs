//! The compute devices.

use std::panic;

use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};

/// A compute device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum DeviceKind {
    /// CPU through burn-flex, the default.
    #[default]
    Flex,
    /// CPU through burn-ndarray; deprecated upstream, kept for comparison.
    Ndarray,
    /// The best GPU that Vulkan finds.
    #[cfg(feature = "vulkan")]
    Vulkan,
}

impl DeviceKind {
    /// Its name in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Flex => "flex",
            Self::Ndarray => "ndarray",
            #[cfg(feature = "vulkan")]
            Self::Vulkan => "vulkan",
        }
    }

    /// Checks that the device is available.
    ///
    /// # Errors
    /// [`NoDevice`] if the first operation fails, as without a driver.
    pub fn check(self) -> Result<(), NoDevice> {
        // burn reports a missing device by a panic, also on its own threads.
        let hook = panic::take_hook();
        panic::set_hook(Box::new(|_| {}));
        let outcome = panic::catch_unwind(|| Tensor::<1>::zeros([1], &self.device()).into_data());
        panic::set_hook(hook);
        outcome.map(|_| ()).map_err(|_| NoDevice { found: self.name() })
    }

    /// The device in burn, without gradients.
    pub(crate) fn device(self) -> Device {
        match self {
            Self::Flex => Device::flex(),
            #[expect(deprecated, reason = "selectable on purpose, see the variant")]
            Self::Ndarray => Device::ndarray(),
            #[cfg(feature = "vulkan")]
            Self::Vulkan => Device::vulkan(burn::tensor::DeviceKind::DefaultDevice),
        }
    }
}

/// The device is not available.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "device: found no driver for {found}, expected a device that this machine has, such as flex"
)]
pub struct NoDevice {
    found: &'static str,
}
