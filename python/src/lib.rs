//! The extension module `eddy._eddy` of the Python package `eddy`: the library's types on NumPy arrays.
//!
//! 1. `errors`: exceptions. `arrays`: checked arguments, and views without a copy. `values`: Python values as settings.
//! 2. `interrupt`: long work that Ctrl-C ends, and that calls back into Python.
//! 3. `frame`, `scene`, `solver`, `surrogate`, `bag`, `evaluate`, `train`, `node`: the classes and functions.
//!
//! Every computation releases the interpreter's lock. Classes are frozen; what changes is behind a mutex, so that calls
//! from several threads wait for each other.

mod arrays;
mod bag;
mod errors;
mod evaluate;
mod frame;
mod interrupt;
mod node;
mod scene;
mod solver;
mod surrogate;
mod tools;
mod train;
mod values;

use std::sync::{Mutex, MutexGuard, PoisonError};

use pyo3::prelude::*;

/// Waits for a mutex. A panic while it was held has left its contents usable: every change is one operation.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Works on what a mutex holds, without the interpreter's lock: neither a thread that waits here nor one that works stops
/// the others.
fn detached<T: Send, R: Send>(
    py: Python<'_>,
    mutex: &Mutex<T>,
    work: impl FnOnce(&mut T) -> R + Send,
) -> R {
    py.detach(|| work(&mut lock(mutex)))
}

#[pymodule]
mod _eddy {
    use pyo3::prelude::*;

    #[pymodule_export]
    use crate::{
        bag::{Bag, BagWriter, Frames, Message, Messages},
        errors::{
            BagError, CheckpointError, EddyError, EvaluationError, NodeError, SimulationError,
            TrainError,
        },
        evaluate::{Report, evaluate, evaluation_starts, skill},
        frame::Frame,
        node::Node,
        scene::Scene,
        solver::Solver,
        surrogate::{Stream, Surrogate},
        train::train_network,
    };

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
