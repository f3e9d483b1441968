//! Whether the machine has the memory that scenes need.

use anyhow::ensure;
use indicatif::HumanBytes;

use eddy::mpm::{MpmError, Scene};

/// Bytes that the machine, or the container, has left for this process.
pub(crate) fn available() -> u64 {
    let mut system = sysinfo::System::new();
    system.refresh_memory();
    let machine = system.available_memory();
    system.cgroup_limits().map_or(machine, |limits| limits.free_memory.min(machine))
}

/// Refuses a scene that does not fit, `at_once` of its size being simulated at a time.
pub(super) fn check(scene: &Scene, at_once: usize, available: u64) -> anyhow::Result<()> {
    let needed = memory(scene)?.saturating_mul(at_once as u64);
    ensure!(
        needed <= available,
        "memory: found {} needed ({:.1e} particles, {} x {} cells, {at_once} at once), expected at \
         most the {} that are free; make the spacing larger, the domain smaller, or give fewer --particles or --threads",
        HumanBytes(needed),
        scene.estimate(),
        scene.grid()?.cells[0],
        scene.grid()?.cells[1],
        HumanBytes(available)
    );
    Ok(())
}

fn memory(scene: &Scene) -> Result<u64, MpmError> {
    scene.check()?;
    scene.memory()
}
