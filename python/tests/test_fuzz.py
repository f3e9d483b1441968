"""Bad input, drawn at random: an exception that says what is wrong, never the end of the interpreter.

A panic of the library would be a `PanicException`, which is no `Exception` and fails these tests.
"""

import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import eddy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

SHIPPED = Path(__file__).parents[2] / "checkpoints" / "particle-mingru"
#: The same examples in each run; more of them find nothing else, they take longer.
EXAMPLES = settings(
    max_examples=500, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)

shapes = st.sampled_from([(), (0,), (0, 2), (5,), (5, 2), (2, 5), (5, 3), (5, 2, 2), (1, 2), (400, 2)])
dtypes = st.sampled_from(["<f4", ">f4", "<f8", "<f2", "<i4", "|u1", "?", "<c8", "S3", "U2", "O", "M8[s]", "f4,f4"])


@st.composite
def odd_arrays(draw: st.DrawFn) -> Any:
    """Arrays of any shape, type, byte order, memory order and alignment."""
    shape, dtype = draw(shapes), np.dtype(draw(dtypes))
    if dtype.kind == "f" and dtype.itemsize == 4:
        array = draw(arrays.arrays(dtype, shape, elements=st.floats(width=32)))
    else:
        array = np.zeros(shape, dtype)
    change = draw(st.sampled_from(["", "reversed", "fortran", "strided", "broadcast", "unaligned", "masked", "matrix"]))
    if change == "reversed" and array.ndim:
        return array[::-1]
    if change == "fortran":
        return np.asfortranarray(array)
    if change == "strided" and array.ndim:
        return np.repeat(array, 2, axis=0)[::2]
    if change == "broadcast" and array.ndim == 2:
        return np.broadcast_to(array[:1], array.shape)
    if change == "unaligned" and not dtype.hasobject:
        memory = np.zeros(array.nbytes + 1, np.uint8)
        return np.frombuffer(memory.data, dtype, array.size, offset=1).reshape(shape)
    if change == "masked":
        return np.ma.masked_array(array)
    if change == "matrix" and array.ndim == 2:
        return array.view(np.matrix)
    return array


class Exporter:
    """Something with the DLPack protocol whose answers are anything."""

    def __init__(self, device: Any, capsule: Any) -> None:
        self.device, self.capsule = device, capsule

    def __dlpack_device__(self) -> Any:
        return self.answer(self.device)

    def __dlpack__(self, **options: Any) -> Any:
        return self.answer(self.capsule)

    @staticmethod
    def answer(value: Any) -> Any:
        if isinstance(value, type) and issubclass(value, Exception):
            raise value("no")
        return value


exporters = st.builds(
    Exporter,
    st.sampled_from([(1, 0), (2, 0), (1,), None, "cpu", (-1, 2**70), RuntimeError, BufferError]),
    st.sampled_from([None, 0, "capsule", object(), np.zeros(3), RuntimeError, BufferError]),
)
values = st.one_of(
    odd_arrays(), exporters, st.none(), st.integers(), st.floats(), st.text(max_size=5), st.binary(max_size=5),
    st.lists(st.floats(), max_size=4),
)


def fails_well(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Calls a function, which may succeed or raise what its documentation says."""
    try:
        return function(*arguments, **options)
    except (TypeError, ValueError, OverflowError, eddy.EddyError) as error:
        assert str(error), "a sentence"
        return None


@EXAMPLES
@given(values, values, st.one_of(values, st.sampled_from(["liquid", "rope"])))
def test_frames_of_anything(position: Any, velocity: Any, material: Any) -> None:
    frame = fails_well(eddy.Frame, position, velocity, material)
    if frame is not None:
        assert frame.position.shape == position.shape and frame.position.dtype == np.float32
        assert np.array_equal(frame.position, position) and np.array_equal(frame.velocity, velocity)


@EXAMPLES
@given(arrays.arrays(np.float32, st.sampled_from([(7, 2), (7, 3)]), elements=st.floats(0, 1, width=32)), st.integers(0, 3))
def test_valid_arrays_come_back(position: np.ndarray, material: int) -> None:
    frame = eddy.Frame(position, position, np.full(7, material, np.uint8))
    assert np.array_equal(frame.position, position) and frame.material[0] == material


#: Numbers of frames: no rollout of days.
odd_numbers = st.one_of(
    st.integers(max_value=3), st.integers(min_value=2**64), st.floats(), st.text(max_size=3), st.none()
)


@EXAMPLES
@given(position=values, velocity=values, frames=st.one_of(exporters, odd_numbers))
def test_a_stream_is_as_before_after_wrong_arguments(position: Any, velocity: Any, frames: Any) -> None:
    start = np.full((5, 2), 0.5, np.float32) + np.arange(10, dtype=np.float32).reshape(5, 2) / 128
    block = eddy.Frame(start, np.zeros_like(start), "jelly")
    stream = SURROGATE.stream(block)
    if fails_well(stream.step_arrays, position, velocity) is None:
        fails_well(stream.step, position)
        fails_well(SURROGATE.step, [stream], [position])
        assert stream.step(block) == SURROGATE.stream(block).step(block)
    fails_well(stream.rollout, block, frames)


SURROGATE = eddy.Surrogate(threads=1)

numbers = st.one_of(st.integers(-(2**65), 2**65), st.floats(), st.sampled_from([0, 1, 2**63, 2**64 - 1]))


@EXAMPLES
@given(
    st.fixed_dictionaries(
        {},
        optional={
            **dict.fromkeys(["stream", "sequence", "time", "dt"], numbers),
            **dict.fromkeys(["lower", "upper"], st.tuples(numbers, numbers)),
        },
    )
)
def test_numbers_of_a_frame(options: dict[str, Any]) -> None:
    position = np.full((2, 2), 0.5, np.float32)
    frame = fails_well(eddy.Frame, position, position, "snow", **options)
    if frame is not None:
        assert isinstance(repr(frame), str) and frame.dt > 0
        fails_well(SURROGATE.stream, frame)


json_values = st.recursive(
    st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=6), st.sampled_from(["jelly", "disc", "particle"])),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=8), inner, max_size=3)),
    max_leaves=8,
)
keys = st.sampled_from(["bodies", "frames", "domain", "material", "epochs", "architecture", "network", "horizon", "x"])


@EXAMPLES
@given(st.dictionaries(keys, json_values, max_size=3))
def test_settings_of_anything(found: dict[str, Any]) -> None:
    fails_well(eddy.Scene, found)
    fails_well(eddy.Node, settings=found)
    # Settings are checked before the data are read: there are none.
    fails_well(eddy.train, "/absent", "/absent/model", found)


@EXAMPLES
@given(data=st.data())
def test_a_bag_that_changes_while_it_is_read(data: st.DataObject, bags: Path, tmp_path_factory: Any) -> None:
    copy = tmp_path_factory.mktemp("changing") / "bag.mcap"
    shutil.copy(next((bags / "scene_0007").glob("*.mcap")), copy)
    bag = eddy.Bag(copy)
    frames, messages = bag.frames(), bag.messages()
    for _ in range(data.draw(st.integers(0, 3))):
        next(frames), next(messages)
    size = copy.stat().st_size
    change = data.draw(st.sampled_from(["cut", "flip", "grow", "empty", "remove", "replace"]))
    place = data.draw(st.integers(0, size - 1))
    with copy.open("r+b") as file:
        if change == "cut":
            file.truncate(place)
        elif change == "empty":
            file.truncate(0)
        elif change == "flip":
            file.seek(place)
            file.write(data.draw(st.binary(min_size=1, max_size=64)))
        elif change == "grow":
            file.seek(0, 2)
            file.write(bytes(1000))
    if change == "remove":
        copy.unlink()
    elif change == "replace":
        copy.write_bytes(data.draw(st.binary(max_size=200)))
    for iterator in (frames, messages):
        # At most one exception and then the end, as Python expects from an iterator.
        fails_well(list, iterator)
        assert fails_well(list, iterator) in ([], None)
    fails_well(bag.arrays)
    fails_well(eddy.Bag, copy)


@EXAMPLES
@given(data=st.data())
def test_checkpoints_of_another_version_or_damaged(data: st.DataObject, tmp_path_factory: Any) -> None:
    folder = tmp_path_factory.mktemp("model") / "model"
    shutil.copytree(SHIPPED, folder)
    description = folder / "model.toml"
    change = data.draw(st.sampled_from(["line", "bytes", "weights", "missing"]))
    if change == "line":
        lines = description.read_text().splitlines()
        place = data.draw(st.integers(0, len(lines) - 1))
        name = lines[place].split("=")[0].strip()
        value = data.draw(st.sampled_from(["0", "99", "-1", "1e30", "nan", '"other"', "[]", "true", "{}"]))
        lines[place] = data.draw(st.sampled_from(["", f"{name} = {value}", "[other]"]))
        description.write_text("\n".join(lines))
    elif change == "missing":
        data.draw(st.sampled_from(sorted(folder.iterdir()))).unlink()
    else:
        file = description if change == "bytes" else next(folder.glob("*.safetensors"))
        content = bytearray(file.read_bytes())
        place = data.draw(st.integers(0, min(len(content), 4096) - 1))
        content[place : place + 8] = data.draw(st.binary(max_size=8))
        file.write_bytes(content[: data.draw(st.integers(place, len(content)))] if data.draw(st.booleans()) else content)
    surrogate = fails_well(eddy.Surrogate, folder, threads=1)
    if surrogate is not None:
        position = np.full((3, 2), 0.5, np.float32)
        frame = eddy.Frame(position, position * 0, "liquid")
        if (stream := fails_well(surrogate.stream, frame)) is not None:
            fails_well(stream.step, frame)


def test_a_checkpoint_of_another_format_is_named(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED, tmp_path / "model")
    description = tmp_path / "model" / "model.toml"
    text = description.read_text()
    first = text.splitlines()[0]
    description.write_text(text.replace(first, "format_version = 99"))
    with pytest.raises(eddy.CheckpointError, match="99"):
        eddy.Surrogate(tmp_path / "model")


def at_once(*calls: Callable[[], Any], repeat: int = 30) -> None:
    """Runs calls on a thread each, again and again; fails with what is not an expected exception."""
    wrong: list[BaseException] = []

    def run(call: Callable[[], Any]) -> None:
        try:
            for _ in range(repeat):
                fails_well(call)
        except BaseException as error:
            wrong.append(error)

    threads = [threading.Thread(target=run, args=(call,)) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
        assert not thread.is_alive(), "waits for ever"
    assert wrong == []


def test_one_object_on_several_threads(tmp_path: Path, bags: Path, block: eddy.Frame) -> None:
    writer = eddy.BagWriter(tmp_path / "bag")
    at_once(*[lambda: writer.write_frame(block)] * 3, lambda: [writer.write_frame(block), writer.close()])
    assert eddy.Bag(tmp_path / "bag").damage is None
    frames = eddy.Bag(bags / "scene_0008").frames()
    at_once(*[lambda: next(frames, None)] * 4)
    solver = eddy.Solver(eddy.Scene.generate("kinds", particles=300), duration=0.1)
    at_once(solver.step, solver.energy, lambda: solver.displace(np.zeros((300, 2), np.float32)), solver.step, repeat=10)
    stream, other = SURROGATE.stream(block), SURROGATE.stream(block)
    at_once(
        lambda: SURROGATE.step([stream, other], [block, block]),
        lambda: SURROGATE.step([other, stream], [block, block]),
        lambda: stream.step(block),
        stream.forget,
        other.copy,
    )
    at_once(*[lambda: eddy.Frame(block.position, block.velocity, block.material)] * 4)


def test_a_node_on_several_threads() -> None:
    node = eddy.Node(f"shm:/fuzz_{threading.get_native_id()}", f"shm:/fuzz_{threading.get_native_id()}/ahead")
    at_once(
        node.start, node.stop, node.reset, lambda: node.set({"horizon": 2}), lambda: node.settings,
        lambda: node.counters, lambda: node.wait(0.01), repeat=4,
    )
    node.stop()
    assert not node.running
