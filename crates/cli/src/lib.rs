//! What eddy's programs have in common on the command line.
//!
//! 1. [`arguments`]: options of every command, and how all command lines are read.
//! 2. [`values`]: parsers of option values; [`Device`]: where the solver runs, or a network predicts.
//! 3. [`SceneArgs`]: which scenes to simulate.
//! 4. [`RealTimeArgs`]: how the operating system treats the process; [`keep_freed_memory`]: how its allocator works.
//! 5. [`Interrupt`]: SIGINT and SIGTERM.
//! 6. [`terminal`]: standard output and standard error; [`TerminalProgress`]: progress bars; [`logs`]: the log.
//! 7. [`Output`]: one rule for outputs that already exist.
//! 8. [`exit_code`]: how a program ends.

/// Prints a line, as in the standard library, but without its panic when the reader of a pipe is gone (`| head`, `less`
/// and `q`): a command must still close its bag or save its checkpoint.
#[macro_export]
macro_rules! println {
    () => { $crate::terminal::print(format_args!("\n")) };
    ($($arguments:tt)*) => {
        $crate::terminal::print(format_args!("{}\n", format_args!($($arguments)*)))
    };
}

/// Prints lines that already end, as `println`.
#[macro_export]
macro_rules! print {
    ($($arguments:tt)*) => { $crate::terminal::print(format_args!($($arguments)*)) };
}

/// Prints an error or a warning on standard error, whether or not somebody reads it.
#[macro_export]
macro_rules! eprintln {
    ($($arguments:tt)*) => {
        $crate::terminal::print_error(format_args!("{}\n", format_args!($($arguments)*)))
    };
}

pub mod arguments;
pub mod terminal;
pub mod values;

mod allocator;
mod device;
mod exit;
mod interrupt;
mod log;
mod output;
mod progress;
mod real_time;
mod scenes;

pub use allocator::keep_freed_memory;
pub use device::Device;
pub use exit::exit_code;
pub use interrupt::Interrupt;
pub use log::logs;
pub use output::{Output, OutputKind, on_disk, unused};
pub use progress::{TerminalProgress, progress_bar};
pub use real_time::RealTimeArgs;
pub use scenes::{SceneArgs, with_usage};

/// Compiles and runs the example of the README.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
