"""eddy's models in PyTorch: `torch_frame` has the frame model of the paper, `torch_particle` the particle model.

A model is described by the contents of `model.toml`. Its `state_dict` has the names and shapes of
`model.safetensors`, so that checkpoints can be exchanged in both directions with `load` and `save`.
"""

import math
import tomllib
from pathlib import Path
from typing import Any

import tomli_w
import torch
from safetensors.torch import load_file, save_file

from torch_core import MATERIALS
from torch_frame import FrameModel
from torch_particle import ParticleModel

Model = FrameModel | ParticleModel


def network(description: dict[str, Any]) -> Model:
    """The described network with PyTorch's initial weights."""
    kinds = {"frame": FrameModel, "particle": ParticleModel}
    return kinds[description["architecture"]](description)


def load(directory: Path, stiffness: float | None = None) -> Model:
    """The network of a checkpoint, which must have exactly the expected tensors. One with weights for several stiffnesses has those
    for streams of the given one."""
    description = tomllib.loads((directory / "model.toml").read_text())
    model, tensors = network(description), load_file(directory / "model.safetensors")
    if knots := description.get("stiffness_knots"):
        tensors = {name: between(knots, values.float(), stiffness) for name, values in tensors.items()}
    model.load_state_dict(tensors, strict=True)
    return model


def between(knots: list[float], values: torch.Tensor, stiffness: float | None) -> torch.Tensor:
    """Values of several stiffnesses, along the first axis, interpolated linearly in its logarithm; the nearest ones beyond the ends."""
    if stiffness is None:
        raise ValueError("found no stiffness, expected one: the checkpoint has weights for several")
    places = [math.log(knot) for knot in knots]
    here = min(max(math.log(stiffness), places[0]), places[-1])
    upper = next(number for number in range(1, len(places)) if here <= places[number])
    share = (here - places[upper - 1]) / (places[upper] - places[upper - 1])
    return (1 - share) * values[upper - 1] + share * values[upper]


def save(model: Model | list[Model], description: dict[str, Any], directory: Path) -> None:
    """Write a checkpoint; one with weights for several stiffnesses from a network for each."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "model.toml").write_text(tomli_w.dumps(description))
    dtype = torch.float16 if description.get("weights") == "f16" else torch.float32
    if isinstance(model, list):
        states = [of_knot.state_dict() for of_knot in model]
        tensors = {name: torch.stack([state[name] for state in states]) for name in states[0]}
    else:
        tensors = model.state_dict()
    save_file({name: tensor.to(dtype) for name, tensor in tensors.items()}, directory / "model.safetensors")


def describe(core: str, sizes: dict[str, int], **changes: Any) -> dict[str, Any]:
    """A description with eddy's defaults, as if trained on particles anywhere in the unit square."""
    return {
        "format_version": 1,
        "architecture": "frame",
        "core": core,
        "form": "plain",
        "normalize_gates": True,
        "dt": 0.016,
        "warm_up": 2,
        "gravity": [0.0, -9.8],
        "materials": list(MATERIALS),
        "data": "none",
        "sizes": sizes,
        "domain": {"lower": [0.0, 0.0], "upper": [1.0, 1.0]},
        "normalization": {
            "minimum": [0.05, 0.05, -3.0, -4.0],
            "maximum": [0.95, 0.95, 3.0, 3.0],
            "mean": [0.5, 0.3, 0.1, -0.5],
            "standard_deviation": [0.2, 0.2, 0.7, 0.9],
        },
        "training": {
            "command": "PyTorch",
            "seed": 0,
            "epochs": 0,
            "best_epoch": 0,
            "training_loss": 0.0,
            "validation_loss": 0.0,
            "samples": 0,
        },
    } | changes
