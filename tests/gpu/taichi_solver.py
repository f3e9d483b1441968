"""Time per substep of Taichi's MLS-MPM on a GPU, from the start that `solver time FOLDER` has written.

    pip install -r tests/peers/requirements-bench.txt
    python tests/gpu/taichi_solver.py FOLDER
"""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import taichi as ti

sys.path.append(str(Path(__file__).resolve().parents[1] / "peers"))
from taichi_mpm import Mpm128

STIFFNESS, GRAVITY = 1000.0, -9.8


def main():
    ti.init(arch=ti.cuda, default_fp=ti.f32, log_level=ti.WARN)
    for file in sorted(Path(sys.argv[1]).glob("start_*.f32")):
        _, cells, dt = file.stem.split("_")
        numbers = np.fromfile(file, np.float32).reshape(-1, 5)
        position, velocity, material = numbers[:, :2], numbers[:, 2:4], numbers[:, 4]
        frame = SimpleNamespace(
            position=position.ravel(), velocity=velocity.ravel(), material=material.astype(np.uint8)
        )
        solver = Mpm128(frame, int(cells), float(dt), STIFFNESS, GRAVITY)
        solver.run(64)
        times = sorted(solver.run(1000) for _ in range(5))
        print(f"taichi {ti.__version__}: {len(numbers)} particles, {cells} cells: {times[0]:.4f} ms a substep")


if __name__ == "__main__":
    main()
