"""From a simulator to its surrogate: simulate, record, train, and run the surrogate in the simulator's own loop.

`mpm_taichi.py` and `mpm_warp.py` call `main` with their solver. A solver is a class of your own with three members:

    Solver(position, velocity, material)   float32 [N, 2], float32 [N, 2], uint8 [N]; unit square, gravity -9.8
    step()                                 advances by DT
    state()                                position, velocity: float32 [N, 2]
"""

import argparse
import time
from pathlib import Path
from typing import Any, Protocol

import eddy
import numpy as np
from numpy.typing import NDArray

#: Time between two frames (s).
DT = 0.016
#: Distance between neighbouring particles (domain lengths): half a cell of a 64 x 64 grid.
SPACING = 1 / 128
#: Particles on a side of a square.
SIDE = 20

Array = NDArray[np.float32]


class Solver(Protocol):
    """What a simulator has to offer."""

    def __init__(self, position: Array, velocity: Array, material: NDArray[np.uint8]) -> None: ...
    def step(self) -> None: ...
    def state(self) -> tuple[Array, Array]: ...


def scene(seed: int) -> tuple[Array, Array, NDArray[np.uint8]]:
    """Two squares of liquid or jelly, side by side, thrown at random."""
    random = np.random.default_rng(seed)
    axis = SPACING * np.arange(SIDE, dtype=np.float32)
    square = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    corners = [[random.uniform(0.1, 0.3), random.uniform(0.1, 0.6)], [random.uniform(0.55, 0.75), random.uniform(0.1, 0.6)]]
    position = np.concatenate([square + np.array(corner, np.float32) for corner in corners])
    throws = random.uniform(-1.5, 1.5, (2, 2)).astype(np.float32)
    velocity = np.repeat(throws, SIDE * SIDE, axis=0)
    material = np.repeat(random.choice([0, 2], 2).astype(np.uint8), SIDE * SIDE)
    return position.astype(np.float32), velocity, material


def record(solver: type[Solver], seed: int, frames: int, bag: Path) -> float:
    """Simulates a scene into a bag; the time of a frame (s)."""
    position, velocity, material = scene(seed)
    simulation = solver(position, velocity, material)
    spent = 0.0
    with eddy.BagWriter(bag) as writer:
        for number in range(frames):
            frame = eddy.Frame(
                *simulation.state(), material, stream=seed, sequence=number, time=number * DT, dt=DT
            )
            writer.write_frame(frame)
            start = time.perf_counter()
            simulation.step()
            simulation.state()
            spent += time.perf_counter() - start
    return spent / frames


def judge(solver: type[Solver], surrogate: eddy.Surrogate, seeds: range, observed: int, ahead: int) -> None:
    """Runs both side by side on new scenes: the surrogate observes, then predicts on its own."""
    starts, truth, predicted = [], [], []
    solver_time = surrogate_time = 0.0
    for seed in seeds:
        position, velocity, material = scene(seed)
        simulation = solver(position, velocity, material)
        frame = eddy.Frame(position, velocity, material, dt=DT)
        stream = surrogate.stream(frame)
        for number in range(observed):
            frame = eddy.Frame(*simulation.state(), material, sequence=number, time=number * DT, dt=DT)
            start = time.perf_counter()
            position, velocity = stream.step_arrays(*simulation.state())
            surrogate_time += time.perf_counter() - start
            simulation.step()
        starts.append(frame)
        rollout, reference = [position], [simulation.state()[0]]
        for _ in range(ahead - 1):
            start = time.perf_counter()
            position, velocity = stream.step_arrays(position, velocity)
            surrogate_time += time.perf_counter() - start
            start = time.perf_counter()
            simulation.step()
            state = simulation.state()
            solver_time += time.perf_counter() - start
            rollout.append(position)
            reference.append(state[0])
        truth.append(reference)
        predicted.append(rollout)
    skill = eddy.skill(starts, np.array(truth), np.array(predicted))
    frames = [frame for frame in (1, 5, 10, 20, 50) if frame <= ahead]
    print("skill on", len(seeds), "new scenes, at frame", ", ".join(f"{k}: {skill[k - 1]:+.2f}" for k in frames))
    per_frame = surrogate_time / (len(seeds) * (observed + ahead - 1))
    reference_time = solver_time / (len(seeds) * (ahead - 1))
    print(
        f"a frame: solver {1e3 * reference_time:.2f} ms, surrogate {1e3 * per_frame:.2f} ms:"
        f" {reference_time / per_frame:.1f} times as fast"
    )


def main(solver: type[Solver]) -> None:
    """The whole way, with options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True, help="folder for bags and checkpoint; must not exist")
    parser.add_argument("--scenes", type=int, default=20, help="simulated scenes [default: 20]")
    parser.add_argument("--frames", type=int, default=100, help="frames of a scene [default: 100]")
    parser.add_argument("--epochs", type=int, default=4, help="epochs of training [default: 4]")
    parser.add_argument("--windows", type=int, default=1024, help="training windows of an epoch [default: 1024]")
    options = parser.parse_args()
    options.output.mkdir(parents=True)
    bags = options.output / "bags"
    times = [record(solver, seed, options.frames, bags / f"scene_{seed:04}") for seed in range(options.scenes)]
    print(f"simulated {options.scenes} scenes, {1e3 * float(np.median(times)):.2f} ms a frame")

    config: dict[str, Any] = {"architecture": "particle", "epochs": options.epochs}
    config["windows"] = {"per_epoch": options.windows}
    eddy.train(
        bags,
        options.output / "model",
        config,
        callback=lambda epoch: print(
            f"epoch {epoch['epoch']}: validation loss {epoch['validation_loss']:.3f} (best trivial predictor: 1)"
        ),
    )
    surrogate = eddy.Surrogate(options.output / "model", threads=1)
    judge(solver, surrogate, range(1000, 1010), observed=10, ahead=min(50, options.frames - 10))
