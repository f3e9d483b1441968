"""Data that several tests share: simulated once."""

from pathlib import Path

import eddy
import numpy as np
import pytest


def lattice(side: int = 20, spacing: float = 1 / 128, corner: float = 0.4) -> np.ndarray:
    """Positions of a square of particles, float32 [side^2, 2]."""
    axis = corner + spacing * np.arange(side, dtype=np.float32)
    return np.stack(np.meshgrid(axis, axis, indexing="xy"), axis=-1).reshape(-1, 2).astype(np.float32)


@pytest.fixture
def block() -> eddy.Frame:
    """A falling square of jelly."""
    position = lattice()
    velocity = np.zeros_like(position)
    velocity[:, 1] = -1.0
    return eddy.Frame(position, velocity, "jelly")


@pytest.fixture(scope="session")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of ten short scenes of few particles, written from Python."""
    folder = tmp_path_factory.mktemp("bags")
    for number in range(10):
        scene = eddy.Scene.generate("multi-material", seed=3, id=number, particles=300)
        with eddy.BagWriter(folder / f"scene_{number:04}") as bag:
            for frame in eddy.Solver(scene, duration=0.8):
                bag.write_frame(frame)
    return folder
