"""Recurrent surrogates for particle simulations.

Solver, surrogates, bags, evaluation, training and live nodes on NumPy arrays. Lengths are domain lengths (the side of the unit square),
times are seconds, unless a name says otherwise. Arrays of positions and velocities are float32 ``[N, 2]``,
in space ``[N, 3]``, in C order; arrays of
other libraries are read in place through the DLPack protocol.
"""

from ._eddy import (
    Bag,
    BagError,
    BagWriter,
    CheckpointError,
    EddyError,
    EvaluationError,
    Frame,
    Frames,
    Message,
    Messages,
    Node,
    NodeError,
    Report,
    Scene,
    SimulationError,
    Solver,
    Stream,
    Surrogate,
    TrainError,
    __version__,
    evaluate,
    evaluation_starts,
    skill,
    train,
)
from ._player import Player

#: Names of the materials, by their numbers in ``Frame.material``.
MATERIALS = ("liquid", "snow", "jelly", "rope", "sand")

__all__ = [
    "MATERIALS",
    "Bag",
    "BagError",
    "BagWriter",
    "CheckpointError",
    "EddyError",
    "EvaluationError",
    "Frame",
    "Frames",
    "Message",
    "Messages",
    "Node",
    "NodeError",
    "Player",
    "Report",
    "Scene",
    "SimulationError",
    "Solver",
    "Stream",
    "Surrogate",
    "TrainError",
    "__version__",
    "evaluate",
    "evaluation_starts",
    "skill",
    "train",
]
