//! One file a subcommand: wires parts of the library together, adds the context to errors, prints.

pub mod bag;
pub mod record;
pub mod replay;
pub mod simulate;
pub mod train;

mod interrupt;

pub use interrupt::Interrupt;
