//! Exceptions. An argument that is wrong by itself is a `ValueError` or a `TypeError`; all others are subclasses of
//! `EddyError`, with the sentences of the program.

use std::{error::Error, fmt::Display};

use pyo3::{PyErr, PyTypeInfo, create_exception, exceptions::PyException};

create_exception!(eddy, EddyError, PyException, "Base class of eddy's exceptions.");
create_exception!(eddy, BagError, EddyError, "A bag cannot be read or written.");
create_exception!(eddy, CheckpointError, EddyError, "A checkpoint cannot be read.");
create_exception!(
    eddy,
    SimulationError,
    EddyError,
    "A scene is invalid, or a simulation diverged."
);
create_exception!(eddy, EvaluationError, EddyError, "Streams or checkpoints cannot be evaluated.");
create_exception!(eddy, TrainError, EddyError, "A network cannot be trained.");
create_exception!(eddy, NodeError, EddyError, "A node cannot start, or has failed.");

/// An error of the library as an exception of type `E`.
pub(crate) fn raise<E: PyTypeInfo>(error: impl Display) -> PyErr {
    PyErr::new::<E, _>(error.to_string())
}

/// An error with its causes in one sentence, as the program prints them.
pub(crate) fn chain(error: &(dyn Error + 'static)) -> String {
    let causes = std::iter::successors(Some(error), |&error| error.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}
