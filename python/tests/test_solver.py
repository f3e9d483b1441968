"""Scenes and the solver."""

import threading
import time
from pathlib import Path

import eddy
import numpy as np
import pytest


def test_a_solver_is_an_iterator_of_frames() -> None:
    scene = eddy.Scene.generate("fluid", seed=1, id=4)
    frames = list(eddy.Solver(scene, duration=0.08))
    assert [frame.sequence for frame in frames] == [0, 1, 2, 3, 4]
    assert frames[1].time == 0.016 and frames[0].stream == 4
    assert frames[-1].position[:, 1].mean() < frames[0].position[:, 1].mean(), "it falls"


def test_threads_and_repeats_give_the_same_bits() -> None:
    scene = eddy.Scene.generate("multi-material", seed=5, id=2)
    runs = [list(eddy.Solver(scene, duration=0.05, threads=threads)) for threads in (1, 2, 1)]
    assert runs[0] == runs[1] == runs[2]


def test_a_scene_from_a_dictionary_and_from_a_file(tmp_path: Path) -> None:
    settings = {
        "frames": {"duration": 0.1},
        "bodies": [
            {"material": "jelly", "centre": [0.5, 0.3], "velocity": [0.0, -1.0], "shape": {"rectangle": [0.2, 0.2]}}
        ],
    }
    generated = eddy.Scene.generate("kinds", seed=2, id=1)
    assert eddy.Scene(generated.to_dict()) == generated
    with pytest.raises(ValueError, match="settings: .*unknown field `bodys`"):
        eddy.Scene({"bodys": settings["bodies"]})
    file = tmp_path / "scene.toml"
    file.write_text("cell_width = -1.0\n")
    with pytest.raises(eddy.SimulationError, match="cell_width: found -1"):
        eddy.Scene.load(file)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"substeps": 3}, eddy.SimulationError, "substeps: found 3, expected at least"),
        ({"duration": -1.0}, eddy.SimulationError, "frames.duration: found -1"),
        ({"law": "ice"}, ValueError, "law: unknown variant `ice`"),
        ({"threads": 0}, ValueError, "threads: found 0, expected at least 1"),
    ],
)
def test_wrong_settings_are_named(options: dict[str, object], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        eddy.Solver(eddy.Scene.generate("kinds"), **options)  # type: ignore[arg-type]


def test_tools_move_by_hand_and_say_what_pushes_them() -> None:
    scene = eddy.Scene(
        {
            "bodies": [{"material": "jelly", "position": [0.5, 0.2], "shape": {"rectangle": {"size": [0.2, 0.2]}}}],
            "tools": [
                {
                    "name": "disc",
                    "shape": {"disc": {"radius": 0.05}},
                    "contact": {"friction": 0.2},
                    "keyframes": [{"time": 0.0, "position": [0.3, 0.2]}],
                }
            ],
        }
    )
    solver = eddy.Solver(scene, duration=0.4)
    first = solver.step()
    assert first is not None
    impulse = 0.0
    for frame in range(10):
        solver.move_tools(np.array([[0.3 + 0.01 * frame, 0.2, 0.0]], np.float32))
        last = solver.step()
        assert last is not None
        impulse += solver.tool_loads()[0]["impulse"][0]
    assert last.position[:, 0].mean() > first.position[:, 0].mean() + 0.01, "the disc pushes the block"
    assert impulse < 0.0, "which pushes back"
    with pytest.raises(ValueError, match=r"poses: found shape \[1, 2\], expected shape \[N, 3\]"):
        solver.move_tools(np.zeros((1, 2), np.float32))
    with pytest.raises(eddy.SimulationError, match="tools: found 2 poses, expected 1"):
        solver.move_tools(np.zeros((2, 3), np.float32))


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(ValueError, match="preset: unknown variant `gravel`, expected one of"):
        eddy.Scene.generate("gravel")  # type: ignore[arg-type]


def test_energy_and_displacement() -> None:
    solver = eddy.Solver(eddy.Scene.generate("kinds", seed=1), duration=1.0)
    first = solver.step()
    assert first is not None
    before = solver.energy()
    solver.displace(np.tile(np.array([0.0, 0.001], np.float32), (len(first), 1)))
    assert solver.energy()["potential"] > before["potential"]
    with pytest.raises(ValueError, match="by: found 3 rows"):
        solver.displace(np.zeros((3, 2), np.float32))


def test_the_interpreter_runs_while_the_solver_computes() -> None:
    solver = eddy.Solver(eddy.Scene.generate("fluid", seed=1, particles=20_000), duration=2.0)
    solver.step()
    ticks = 0
    running = True

    def count() -> None:
        nonlocal ticks
        while running:
            ticks += 1
            time.sleep(0.001)

    thread = threading.Thread(target=count)
    thread.start()
    try:
        before = ticks
        solver.step()
        during = ticks - before
    finally:
        running = False
        thread.join()
    # A step takes tens of milliseconds; a thread that had to wait for it would count once at most.
    assert during > 3


def test_a_solver_may_be_called_from_several_threads() -> None:
    solver = eddy.Solver(eddy.Scene.generate("kinds", seed=1), duration=0.5)
    frames: list[eddy.Frame] = []

    def take() -> None:
        frames.extend(solver)

    threads = [threading.Thread(target=take) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(frame.sequence for frame in frames) == list(range(31))
