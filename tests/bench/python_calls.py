"""Measures what Python adds: the import, views, and calls with a frame of one particle, where the network hardly counts.

    python tests/bench/python_calls.py     with the interpreter that has the wheel

Prints the fastest of many repetitions, which other programs on the machine disturb least, and the load.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable

import eddy
import numpy as np

FRAMES = 100


def fastest(call: Callable[[], object], rounds: int) -> float:
    """Time of the fastest call (s)."""
    best = float("inf")
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - start)
    return best


def main() -> None:
    for module in ("sys", "numpy", "eddy"):
        seconds = fastest(lambda: subprocess.run([sys.executable, "-c", f"import {module}"], check=True), 15)
        print(f"a process that imports {module}: {seconds:.3f} s")
    position = np.full((1, 2), 0.5, np.float32)
    velocity = np.zeros_like(position)
    frame = eddy.Frame(position, velocity, "liquid")
    stream = eddy.Surrogate(threads=1).stream(frame)

    def views() -> None:
        for _ in range(FRAMES):
            frame.position

    def frames() -> None:
        last = frame
        for _ in range(FRAMES):
            last = stream.step(last)

    def arrays() -> None:
        last = position, velocity
        for _ in range(FRAMES):
            last = stream.step_arrays(*last)

    cases = {
        "view of an array": views,
        "predicted frame, loop in Rust (rollout)": lambda: stream.rollout(frame, FRAMES),
        "predicted frame, loop in Python (step)": frames,
        "predicted arrays, loop in Python (step_arrays)": arrays,
    }
    for name, case in cases.items():
        print(f"{name}: {1e6 * fastest(case, 1000) / FRAMES:.2f} us")
    print(f"load: {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
