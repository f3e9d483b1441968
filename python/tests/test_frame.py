"""Frames: arrays in and out."""

import gc

import eddy
import numpy as np
import pytest

from conftest import lattice


def test_arrays_of_a_frame_are_views_that_keep_it_alive(block: eddy.Frame) -> None:
    position = block.position
    assert position.dtype == np.float32 and position.shape == (400, 2)
    assert not position.flags.owndata and not position.flags.writeable
    assert np.shares_memory(position, block.position)
    expected = lattice()
    del block
    gc.collect()
    assert np.array_equal(position, expected)


def test_a_view_cannot_be_written(block: eddy.Frame) -> None:
    with pytest.raises(ValueError):
        block.position[0, 0] = 1.0
    with pytest.raises(ValueError):
        block.position.flags.writeable = True


def test_materials_by_name_and_by_number() -> None:
    position = lattice(4)
    by_name = eddy.Frame(position, position * 0, "rope")
    by_number = eddy.Frame(position, position * 0, np.full(16, 3, np.uint8))
    assert by_name == by_number
    assert eddy.MATERIALS[by_name.material[0]] == "rope"
    assert by_name != "rope"


def test_attributes(block: eddy.Frame) -> None:
    frame = eddy.Frame(
        block.position, block.velocity, block.material, stream=7, sequence=3, time=0.048, upper=(2.0, 1.0)
    )
    assert (frame.stream, frame.sequence, frame.stamp, frame.dt) == (7, 3, 48_000_000, 0.016)
    assert (frame.lower, frame.upper, len(frame)) == ((0.0, 0.0), (2.0, 1.0), 400)
    assert repr(frame) == "Frame(stream=7, sequence=3, time=0.048, particles=400)"


P = lattice(4)
U = np.zeros(16, np.uint8)


@pytest.mark.parametrize(
    ("position", "velocity", "material", "message"),
    [
        (P.astype(np.float64), P, U, "position: found dtype float64, expected float32"),
        (P, P[:, 0], U, r"velocity: found shape \[16\], expected shape \[16, 2\]"),
        (P, P[:8], U, r"velocity: found shape \[8, 2\], expected shape \[16, 2\]"),
        (P.reshape(2, 16).T, P, U, "position: found an array with gaps or another order"),
        (np.asfortranarray(P), P, U, "position: found an array with gaps or another order"),
        (P, P, U[:3], r"material: found shape \[3\], expected shape \[16\]"),
        (P, P, U + np.uint8(9), r"material\[0\]: found 9, expected 0 \(liquid\)"),
        (P, P, U.astype(np.int64), "material: found dtype int64, expected uint8"),
        (P, P, "clay", "material: found clay, expected liquid, snow, jelly, rope or sand"),
        (P * np.float32(np.nan), P, U, r"position\[0\]: found NaN, expected a finite number"),
        (P[:0], P[:0], U[:0], "material: found 0 particles, expected at least 1"),
    ],
)
def test_wrong_arrays_are_named(position: object, velocity: object, material: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        eddy.Frame(position, velocity, material)  # type: ignore[arg-type]


def test_what_is_no_array_is_a_type_error() -> None:
    with pytest.raises(TypeError, match="position: found list, expected a NumPy array"):
        eddy.Frame([[0.5, 0.5]], P, U)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt": 0.0}, "dt: found 0 s, expected a positive number"),
        ({"time": float("nan")}, "time: found NaN, expected a finite number"),
        ({"upper": (0.0, 1.0)}, "lower, upper: found"),
        ({"sequence": 2**64 - 1}, "sequence: found"),
    ],
)
def test_wrong_numbers_are_named(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        eddy.Frame(P, P, U, **options)  # type: ignore[arg-type]


def test_arrays_with_the_dlpack_protocol_are_read() -> None:
    class Tensor:
        """As PyTorch's tensors on the CPU: no NumPy array, but the protocol."""

        def __init__(self, array: np.ndarray) -> None:
            self.array = array

        def __dlpack__(self, **options: object) -> object:
            return self.array.__dlpack__(**options)

        def __dlpack_device__(self) -> tuple[int, int]:
            return self.array.__dlpack_device__()

    class OnDevice(Tensor):
        def __dlpack_device__(self) -> tuple[int, int]:
            return (2, 0)

    frame = eddy.Frame(Tensor(P.copy()), Tensor(P.copy()), "snow")
    assert np.array_equal(frame.position, P)
    with pytest.raises(ValueError, match="position: found memory of a device"):
        eddy.Frame(OnDevice(P), P, "snow")
