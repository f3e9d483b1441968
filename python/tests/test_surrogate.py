"""Surrogates and their streams."""

import threading
from pathlib import Path

import eddy
import numpy as np
import pytest

SHIPPED = eddy.Surrogate(threads=2)


def test_the_shipped_model_predicts_a_fall(block: eddy.Frame) -> None:
    stream = SHIPPED.stream(block)
    frames = stream.rollout(block, 10)
    assert [frame.sequence for frame in frames] == list(range(1, 11))
    assert frames[-1].position[:, 1].mean() < block.position[:, 1].mean()
    for frame in frames:
        frame.check()


def test_arrays_frames_and_rollouts_give_the_same_bits(block: eddy.Frame) -> None:
    rollout = SHIPPED.stream(block).rollout(block, 3)
    by_frame, by_array = SHIPPED.stream(block), SHIPPED.stream(block)
    frame, position, velocity = block, block.position, block.velocity
    for expected in rollout:
        frame = by_frame.step(frame)
        position, velocity = by_array.step_arrays(position, velocity)
        assert np.array_equal(frame.position, expected.position)
        assert np.array_equal(position, expected.position)
        assert np.array_equal(velocity, expected.velocity)


def test_many_streams_at_once_are_as_one_by_one(block: eddy.Frame) -> None:
    others = [eddy.Frame(block.position + np.float32(0.01 * k), block.velocity, "jelly") for k in range(5)]
    together = [SHIPPED.stream(frame) for frame in others]
    alone = [SHIPPED.stream(frame) for frame in others]
    frames = others
    for _ in range(3):
        frames = SHIPPED.step(together, frames)
    for other, stream, frame in zip(others, alone, frames, strict=True):
        assert stream.rollout(other, 3)[-1] == frame


def test_a_copy_looks_ahead_without_a_trace(block: eddy.Frame) -> None:
    stream, reference = SHIPPED.stream(block), SHIPPED.stream(block)
    stream.step(block)
    reference.step(block)
    stream.copy().rollout(block, 5)
    assert stream.step(block) == reference.step(block)
    stream.forget()
    assert stream.step(block) == SHIPPED.stream(block).step(block)


def test_frames_of_another_stream_are_refused(block: eddy.Frame) -> None:
    stream = SHIPPED.stream(block)
    short = eddy.Frame(block.position[:9].copy(), block.velocity[:9].copy(), "jelly")
    with pytest.raises(ValueError, match="frame: found 9 particles, expected 400"):
        stream.step(short)
    with pytest.raises(ValueError, match="frame: found other materials"):
        stream.step(eddy.Frame(block.position, block.velocity, "snow"))
    with pytest.raises(ValueError, match="dt: found 0.02 s, expected 0.016 s"):
        stream.step(eddy.Frame(block.position, block.velocity, "jelly", dt=0.02))
    with pytest.raises(ValueError, match=r"position: found shape \[9, 2\], expected shape \[400, 2\]"):
        stream.step_arrays(short.position, short.velocity)
    nan = np.full_like(block.position, np.nan)
    with pytest.raises(ValueError, match=r"position\[0\]: found NaN"):
        stream.step_arrays(nan, block.velocity)
    assert stream.step(block) == SHIPPED.stream(block).step(block), "nothing was observed"


def test_streams_must_be_different_and_of_this_surrogate(block: eddy.Frame) -> None:
    stream, other = SHIPPED.stream(block), eddy.Surrogate(threads=1).stream(block)
    with pytest.raises(ValueError, match=r"streams\[1\]: found a stream that is there twice"):
        SHIPPED.step([stream, stream], [block, block])
    with pytest.raises(ValueError, match=r"streams\[0\]: found a stream of another surrogate"):
        SHIPPED.step([other], [block])
    with pytest.raises(ValueError, match="frames: found 0 frames, expected 1"):
        SHIPPED.step([stream], [])
    assert SHIPPED.step([], []) == []


def test_threads_share_a_surrogate(block: eddy.Frame) -> None:
    expected = SHIPPED.stream(block).rollout(block, 20)
    results: dict[int, list[eddy.Frame]] = {}

    def run(number: int) -> None:
        stream = SHIPPED.stream(block)
        frame, frames = block, []
        for _ in range(20):
            frame = stream.step(frame) if number % 2 else SHIPPED.step([stream], [frame])[0]
            frames.append(frame)
        results[number] = frames

    threads = [threading.Thread(target=run, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(results[number] == expected for number in range(6))


def test_warnings_and_description(block: eddy.Frame) -> None:
    wide = eddy.Frame(block.position, block.velocity, "jelly", upper=(2.0, 1.0))
    assert any("domain is 2 x 1" in warning for warning in SHIPPED.warnings(wide))
    assert SHIPPED.dt == 0.016 and SHIPPED.warm_up >= 1
    assert SHIPPED.description["architecture"] == "particle" and len(SHIPPED.digest) == 64


def test_a_folder_without_a_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(eddy.CheckpointError, match="model.toml"):
        eddy.Surrogate(tmp_path)
    with pytest.raises(ValueError, match="threads: found 0"):
        eddy.Surrogate(threads=0)
