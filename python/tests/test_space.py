"""Frames of three dimensions: what carries frames carries them, what computes with them says that it knows two."""

import gc
from pathlib import Path

import eddy
import numpy as np
import pytest

PARTICLES = 30
TWO = "found a frame of 3 dimensions, expected one of 2"


def frame(sequence: int = 0) -> eddy.Frame:
    """A block that falls in a cube."""
    place = np.arange(PARTICLES, dtype=np.float32)[:, None] * np.float32([0.01, 0.02, 0.03])
    position = place + np.float32([0, 0.2 - 0.01 * sequence, 0])
    return eddy.Frame(position, 0 * position, "jelly", sequence=sequence, time=0.016 * sequence)


def test_arrays_have_three_columns_and_keep_the_frame() -> None:
    position = frame().position
    gc.collect()
    assert position.shape == (PARTICLES, 3) and not position.flags.writeable
    assert np.allclose(position[2], [0.02, 0.24, 0.06])
    assert (frame().lower, frame().upper) == ((0.0,) * 3, (1.0,) * 3)
    assert frame() == frame() and frame() != frame(1) and len(frame()) == PARTICLES


def test_frames_and_arrays_come_back_from_a_bag(tmp_path: Path) -> None:
    frames = [frame(sequence) for sequence in range(4)]
    with eddy.BagWriter(tmp_path / "bag") as writer:
        for one in frames:
            writer.write_frame(one)
    bag = eddy.Bag(tmp_path / "bag")
    assert list(bag.frames()) == frames
    arrays = bag.arrays()
    assert arrays["position"].shape == (4, PARTICLES, 3)
    assert np.array_equal(arrays["position"][3], frames[3].position)


def test_arrays_of_frames_of_both_dimensions_are_refused(tmp_path: Path) -> None:
    flat = eddy.Frame(frame().position[:, :2].copy(), frame().velocity[:, :2].copy(), "jelly", sequence=1, time=0.016)
    with eddy.BagWriter(tmp_path / "bag") as writer:
        writer.write_frame(frame())
        writer.write_frame(flat)
    assert [one.position.shape[1] for one in eddy.Bag(tmp_path / "bag").frames()] == [3, 2]
    with pytest.raises(ValueError, match="/particles: found 2 dimensions at sequence 1, expected 3"):
        eddy.Bag(tmp_path / "bag").arrays()


def test_what_knows_two_dimensions_says_so(block: eddy.Frame) -> None:
    surrogate = eddy.Surrogate()
    stream = surrogate.stream(block)
    refused = [
        lambda: surrogate.stream(frame()),
        lambda: surrogate.warnings(frame()),
        lambda: surrogate.step([stream], [frame()]),
        lambda: stream.step(frame()),
        lambda: stream.rollout(frame(), 2),
        lambda: eddy.skill([frame()], np.zeros((1, 1, 1, 2), np.float32), np.zeros((1, 1, 1, 2), np.float32)),
    ]
    for call in refused:
        with pytest.raises(ValueError, match=TWO):
            call()
    with pytest.raises(ValueError, match="source: found frames of 3 dimensions, expected 2"):
        eddy.Player([frame()])


@pytest.mark.parametrize(
    ("columns", "options", "message"),
    [
        (4, {}, r"position: found shape \[5, 4\], expected shape \[N, 2\] or \[N, 3\]"),
        (3, {"lower": (0.0, 0.0)}, r"lower: found \[0.0, 0.0\], expected 3 numbers, one for each axis of position"),
        (2, {"upper": (1.0, 1.0, 1.0)}, r"upper: found \[1.0, 1.0, 1.0\], expected 2 numbers"),
        (3, {"upper": (1.0, 1.0, -1.0)}, r"lower, upper: found 0 to 1 x 0 to 1 x 0 to -1"),
    ],
)
def test_numbers_of_axes_that_differ_are_named(columns: int, options: dict[str, object], message: str) -> None:
    position = np.full((5, columns), 0.5, np.float32)
    with pytest.raises(ValueError, match=message):
        eddy.Frame(position, position, "snow", **options)  # type: ignore[arg-type]
