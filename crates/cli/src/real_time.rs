//! Processors, priority and memory of a process, for predictable latencies.

use anyhow::Context as _;
use clap::Args;

/// How the operating system treats a process.
#[derive(Debug, Args)]
pub struct RealTimeArgs {
    /// Run on these processors only, for example 2,3 or 4-7 [default: all].
    #[arg(long, value_name = "LIST", value_parser = CpuList::parse)]
    pub cpu: Option<CpuList>,
    /// Run all threads with this real-time priority (SCHED_FIFO), 1 to 99: before all ordinary processes. Requires the right
    /// to do so [default: no real-time priority].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=99))]
    pub priority: Option<u8>,
    /// Keep all memory in RAM: nothing is swapped out. Requires the right to do so.
    #[arg(long)]
    pub lock_memory: bool,
}

/// A list of processors.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CpuList(Vec<usize>);

/// Number of processors that Linux's set has room for.
const MAX_CPUS: usize = 1024;

impl CpuList {
    /// Parses numbers and ranges, for example `0,2-4`.
    fn parse(text: &str) -> Result<Self, String> {
        let range = |part: &str| {
            let (first, last) = part.split_once('-').unwrap_or((part, part));
            let [first, last] = [first, last].map(|number| number.trim().parse::<usize>().ok());
            let (first, last) = (first?, last?);
            (first <= last && last < MAX_CPUS).then_some(first..=last)
        };
        let ranges: Option<Vec<_>> = text.split(',').map(range).collect();
        let ranges = ranges.ok_or_else(|| {
            format!(
                "expected numbers from 0 to {} and ranges, for example 2,3 or 4-7",
                MAX_CPUS - 1
            )
        })?;
        Ok(Self(ranges.into_iter().flatten().collect()))
    }
}

impl RealTimeArgs {
    /// Applies the options to this thread and those that it will start.
    ///
    /// # Errors
    /// Which right is missing and how it is given, or what the system says.
    pub fn apply(&self) -> anyhow::Result<()> {
        if let Some(CpuList(cpus)) = &self.cpu {
            system::run_on(cpus).with_context(|| {
                let usable = std::thread::available_parallelism().map_or(1, usize::from);
                format!(
                    "--cpu: found {cpus:?}, expected some of the {usable} that this process may use"
                )
            })?;
        }
        if let Some(priority) = self.priority {
            system::prioritize(priority).with_context(|| {
                format!(
                    "--priority: found {priority}, expected at most {}, the limit of this process (RLIMIT_RTPRIO): raise it \
                     with `rtprio` in /etc/security/limits.conf, LimitRTPRIO= in a systemd unit or docker's --ulimit, or \
                     give the program the capability CAP_SYS_NICE",
                    system::limit(Limit::Priority)
                )
            })?;
        }
        if self.lock_memory {
            system::lock_memory().with_context(|| {
                format!(
                    "--lock-memory: this process may lock {} bytes, expected unlimited (RLIMIT_MEMLOCK): raise the limit \
                     with `memlock` in /etc/security/limits.conf, LimitMEMLOCK= in a systemd unit or docker's --ulimit, or \
                     give the program the capability CAP_IPC_LOCK",
                    system::limit(Limit::LockedMemory)
                )
            })?;
        }
        Ok(())
    }
}

/// A limit on what a process may do.
#[derive(Clone, Copy)]
enum Limit {
    Priority,
    /// Bytes.
    LockedMemory,
}

/// The calls of the system.
#[cfg(target_os = "linux")]
#[expect(
    unsafe_code,
    reason = "rustix has no real-time scheduling, so that this is the C library's"
)]
mod system {
    use std::{io, mem};

    use rustix::process::{Resource, getrlimit};

    use super::Limit;

    pub(super) fn run_on(cpus: &[usize]) -> io::Result<()> {
        // SAFETY: a set of bits, all zero: no processors.
        let mut set: libc::cpu_set_t = unsafe { mem::zeroed() };
        for &cpu in cpus {
            // SAFETY: `cpu` is less than the size of the set, see `CpuList::parse`.
            unsafe { libc::CPU_SET(cpu, &mut set) };
        }
        // SAFETY: the set lives during the call, and its size is the one given; 0 is this thread.
        checked(unsafe { libc::sched_setaffinity(0, size_of_val(&set), &set) })
    }

    pub(super) fn prioritize(priority: u8) -> io::Result<()> {
        // SAFETY: a struct of numbers.
        let mut parameters: libc::sched_param = unsafe { mem::zeroed() };
        parameters.sched_priority = priority.into();
        // SAFETY: the parameters live during the call; 0 is this thread.
        checked(unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &parameters) })
    }

    /// Locks pages as they are used: otherwise the address space that libraries reserve would be filled.
    pub(super) fn lock_memory() -> io::Result<()> {
        // SAFETY: it changes no memory that the program can see.
        checked(unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE | libc::MCL_ONFAULT) })
    }

    /// The limit of this process on a resource.
    pub(super) fn limit(limit: Limit) -> String {
        let resource = match limit {
            Limit::Priority => Resource::Rtprio,
            Limit::LockedMemory => Resource::Memlock,
        };
        getrlimit(resource).current.map_or("unlimited".to_owned(), |limit| limit.to_string())
    }

    fn checked(status: i32) -> io::Result<()> {
        if status == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
    }
}

/// Other systems have other calls.
#[cfg(not(target_os = "linux"))]
mod system {
    use std::io;

    pub(super) fn run_on(_: &[usize]) -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub(super) fn prioritize(_: u8) -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub(super) fn lock_memory() -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub(super) fn limit(_: super::Limit) -> String {
        "nothing on this system".to_owned()
    }
}
