//! Where the solver runs, or a network predicts.

use eddy_mpm::Accelerator;

/// Where the solver runs, or a network predicts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Device {
    /// On the processor.
    Cpu,
    /// On the NVIDIA GPU of this number.
    #[cfg(feature = "cuda")]
    Cuda(u8),
}

impl Device {
    /// Parses `cpu`, `cuda` or `cuda:N`.
    ///
    /// # Errors
    /// What was expected.
    #[cfg(feature = "cuda")]
    pub fn parse(text: &str) -> Result<Self, String> {
        use eddy_cuda::{MOST_GPUS, gpu_number};
        let expected = || format!("expected cpu, cuda or cuda:N, N up to {}", MOST_GPUS - 1);
        match text {
            "cpu" => Ok(Self::Cpu),
            _ => gpu_number(text).map(Self::Cuda).ok_or_else(expected),
        }
    }

    /// Parses `cpu`.
    ///
    /// # Errors
    /// What was expected.
    #[cfg(not(feature = "cuda"))]
    pub fn parse(text: &str) -> Result<Self, String> {
        match text {
            "cpu" => Ok(Self::Cpu),
            _ => Err("expected cpu: this program was built without the feature cuda".to_owned()),
        }
    }

    /// Opens it for the solver; `None` for the processor.
    ///
    /// # Errors
    /// When the GPU cannot be used.
    pub fn open_solver(self) -> anyhow::Result<Option<Box<dyn Accelerator>>> {
        match self {
            Self::Cpu => Ok(None),
            #[cfg(feature = "cuda")]
            Self::Cuda(number) => Ok(Some(Box::new(eddy_cuda::open_solver(number.into())?))),
        }
    }
}
