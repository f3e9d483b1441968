"""Streams of particles for the rivals: training windows on a device, and the starts of an evaluation.

Letters in shapes: S scenes, T frames, B windows, N particles. Positions are fractions of the domain's width, velocities
fractions of it per frame.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy
import torch
from torch import Tensor


@dataclass
class Window:
    """Successive frames of B scenes."""

    position: Tensor
    """[B, T, N, 2]"""
    velocity: Tensor
    """[B, T, N, 2]; that of the simulation, which is not the difference of two positions."""
    material: Tensor
    """[B, N], int64"""


class Scenes:
    """Data sets of `eddy bag export --format npz`, all in the memory of the device."""

    def __init__(self, folder: Path, device: torch.device) -> None:
        files = sorted(folder.glob("*.npz"))
        if not files:
            raise SystemExit(f"{folder}: found no .npz, expected the output of `eddy bag export --format npz`")
        arrays = [numpy.load(file) for file in files]
        shapes = {array["position"].shape for array in arrays}
        if len(shapes) != 1:
            raise SystemExit(f"{folder}: found scenes of shapes {sorted(shapes)}, expected one number of frames and of particles")
        units = [Unit(array["lower"], array["upper"], float(array["dt"])) for array in arrays]
        scaled = [unit.scaled(array["position"], array["velocity"]) for unit, array in zip(units, arrays)]
        self.position, self.velocity = (torch.from_numpy(numpy.stack(values)).to(device) for values in zip(*scaled))
        self.material = torch.from_numpy(numpy.stack([array["material"] for array in arrays]).astype(numpy.int64)).to(device)

    def windows(self, count: int, frames: int, generator: torch.Generator) -> Window:
        """`count` windows from anywhere, each mirrored left to right by chance."""
        scenes, length = self.position.shape[:2]
        device = self.position.device
        draw = lambda below: torch.randint(below, (count,), generator=generator).to(device)
        scene, start = draw(scenes), draw(length - frames + 1)
        at = start[:, None] + torch.arange(frames, device=device)
        position, velocity = self.position[scene[:, None], at], self.velocity[scene[:, None], at]
        is_mirrored = draw(2).bool()[:, None, None]
        x = torch.where(is_mirrored, 1 - position[..., 0], position[..., 0])
        u = torch.where(is_mirrored, -velocity[..., 0], velocity[..., 0])
        return Window(
            torch.stack((x, position[..., 1]), -1), torch.stack((u, velocity[..., 1]), -1), self.material[scene]
        )  # fmt: skip


@dataclass
class Unit:
    """From domain lengths and seconds to fractions of the domain and frames, and back."""

    lower: numpy.ndarray
    upper: numpy.ndarray
    dt: float

    def __post_init__(self) -> None:
        self.lower, self.upper = (numpy.asarray(corner, numpy.float64)[:2] for corner in (self.lower, self.upper))
        self.width = self.upper - self.lower
        if not numpy.allclose(self.width[0], self.width[1]):
            raise SystemExit(f"found a domain of {self.width.tolist()}, expected a square")

    def scaled(self, position, velocity) -> tuple[numpy.ndarray, numpy.ndarray]:
        return (
            ((position - self.lower) / self.width).astype(numpy.float32),
            (velocity * self.dt / self.width).astype(numpy.float32),
        )

    def restored(self, position, velocity) -> tuple[numpy.ndarray, numpy.ndarray]:
        return (
            (position * self.width + self.lower).astype(numpy.float32),
            (velocity * self.width / self.dt).astype(numpy.float32),
        )


def before(window: Window, frames: int) -> Window:
    """The window with enough frames in front of it that it has `frames`: particles fly on a parabola, whose curvature is the change
    of velocity between the first two frames (0 if there is but one)."""
    missing = frames - window.position.shape[1]
    if missing <= 0:
        return Window(window.position[:, -frames:], window.velocity[:, -frames:], window.material)
    position, velocity = window.position[:, :1], window.velocity[:, :1]
    change = window.velocity[:, 1:2] - velocity if window.velocity.shape[1] > 1 else torch.zeros_like(velocity)
    back = torch.arange(missing, 0, -1, device=position.device)[None, :, None, None]
    earlier = position - back * velocity + back**2 / 2 * change
    return Window(
        torch.cat((earlier, window.position), 1), torch.cat((velocity - back * change, window.velocity), 1), window.material
    )  # fmt: skip
