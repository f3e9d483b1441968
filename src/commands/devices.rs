//! `eddy devices`: what networks can be trained on.

use comfy_table::{Table, presets::UTF8_BORDERS_ONLY};
use eddy_learning::model::DeviceKind;

/// Lists the devices.
pub fn run() -> anyhow::Result<()> {
    let mut table = Table::new();
    table.load_style(UTF8_BORDERS_ONLY);
    table.set_header(["--device", "description", "memory"]);
    let threads = std::thread::available_parallelism()?.get();
    table.add_row([DeviceKind::Flex.name(), &format!("this machine's CPU, {threads} threads"), ""]);
    #[cfg(feature = "cuda")]
    let missing = gpus(&mut table);
    println!("{table}");
    #[cfg(feature = "cuda")]
    if let Some(reason) = missing {
        println!("no usable NVIDIA GPU: {reason}");
    }
    Ok(())
}

/// Adds every GPU; returns why none can be used.
#[cfg(feature = "cuda")]
fn gpus(table: &mut Table) -> Option<eddy_cuda::CudaError> {
    let gpus = match eddy_cuda::gpu::list() {
        Ok(gpus) => gpus,
        Err(reason) => return Some(reason),
    };
    for gpu in &gpus {
        let name = if gpu.number == 0 { "cuda".to_owned() } else { format!("cuda:{}", gpu.number) };
        let (major, minor) = gpu.capability;
        let what = format!(
            "{}, compute capability {major}.{minor}, {} multiprocessors",
            gpu.name, gpu.multiprocessors
        );
        table.add_row([name, what, format!("{} MiB", gpu.memory >> 20)]);
    }
    eddy_cuda::gpu::check(0).err()
}
