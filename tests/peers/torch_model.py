"""eddy's models in PyTorch: `torch_frame` has the frame model of the paper, `torch_particle` the particle model.

A model is described by the contents of `model.toml`. Its `state_dict` has the names and shapes of
`model.safetensors`, so that checkpoints can be exchanged in both directions with `load` and `save`.
"""

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


def load(directory: Path) -> Model:
    """The network of a checkpoint, which must have exactly the expected tensors."""
    model = network(tomllib.loads((directory / "model.toml").read_text()))
    model.load_state_dict(load_file(directory / "model.safetensors"), strict=True)
    return model


def save(model: Model, description: dict[str, Any], directory: Path) -> None:
    """Write a checkpoint."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "model.toml").write_text(tomli_w.dumps(description))
    dtype = torch.float16 if description.get("weights") == "f16" else torch.float32
    save_file({name: tensor.to(dtype) for name, tensor in model.state_dict().items()}, directory / "model.safetensors")


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
