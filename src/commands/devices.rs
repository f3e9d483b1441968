//! `eddy devices`: what networks can be trained on.

use eddy_cli::terminal;
use eddy_learning::model::DeviceKind;
use eddy_pages::Table;

/// Lists the devices.
pub fn run() -> anyhow::Result<()> {
    let mut table = Table::new("devices", ["--device", "memory", "description"]);
    let threads = std::thread::available_parallelism()?.get();
    let cpu = format!("this machine's CPU, {threads} threads");
    table.row(DeviceKind::Flex.name(), ["", &cpu]);
    #[cfg(feature = "cuda")]
    let missing = gpus(&mut table);
    println!("{}", table.plain(terminal::columns()));
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
        table.row(name, [format!("{} MiB", gpu.memory >> 20), what]);
    }
    eddy_cuda::gpu::check(0).err()
}
