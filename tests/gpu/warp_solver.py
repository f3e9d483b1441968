"""Time per substep of an MLS-MPM in Warp on a GPU, from the start that `solver time FOLDER` has written.

The kernels are those of a first MLS-MPM, as Warp's and Taichi's documentation write it: atomic additions of floats to the
nodes, a launch each for particles, nodes and particles. Substeps are captured in a CUDA graph.

    pip install warp-lang==1.19.0
    python tests/gpu/warp_solver.py FOLDER [DEVICE]
"""

import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

DEVICE = sys.argv[2] if len(sys.argv) > 2 else "cuda"
STIFFNESS, NU, GRAVITY = 1000.0, 0.2, -9.8
MU, LAMBDA = STIFFNESS / (2 * (1 + NU)), STIFFNESS * NU / ((1 + NU) * (1 - 2 * NU))
LIQUID, SNOW, JELLY = 0, 1, 2
LEAST, MOST = 1.0 - 2.5e-2, 1.0 + 4.5e-3
# Substeps of a graph.
CAPTURED = 50

wp.config.quiet = True
wp.init()


@wp.func
def weight(i: int, f: float) -> float:
    """The quadratic B-spline of a node i cells from the first, for a particle f cells from it."""
    if i == 0:
        return 0.5 * (1.5 - f) * (1.5 - f)
    if i == 1:
        return 0.75 - (f - 1.0) * (f - 1.0)
    return 0.5 * (f - 0.5) * (f - 0.5)


@wp.kernel
def scatter(
    x: wp.array(dtype=wp.vec2),
    v: wp.array(dtype=wp.vec2),
    affine_velocity: wp.array(dtype=wp.mat22),
    deformation: wp.array(dtype=wp.mat22),
    plastic: wp.array(dtype=float),
    material: wp.array(dtype=wp.int32),
    momentum: wp.array2d(dtype=wp.vec2),
    mass: wp.array2d(dtype=float),
    dx: float,
    dt: float,
):
    p = wp.tid()
    identity = wp.mat22(1.0, 0.0, 0.0, 1.0)
    volume = 0.25 * dx * dx
    place = x[p] * (1.0 / dx)
    bx = int(place[0] - 0.5)
    by = int(place[1] - 0.5)
    fx = place[0] - float(bx)
    fy = place[1] - float(by)
    f = (identity + affine_velocity[p] * dt) * deformation[p]
    # The polar decomposition and the singular values q + r, q - r, in closed form.
    a = 0.5 * (f[0, 0] + f[1, 1])
    b = 0.5 * (f[1, 0] - f[0, 1])
    c = 0.5 * (f[0, 0] - f[1, 1])
    d = 0.5 * (f[1, 0] + f[0, 1])
    q = wp.max(wp.sqrt(a * a + b * b), 1.0e-12)
    r = wp.max(wp.sqrt(c * c + d * d), 1.0e-12)
    rotation = wp.mat22(a / q, -b / q, b / q, a / q)
    h = float(0.3)
    if material[p] == SNOW:
        h = wp.clamp(wp.exp(10.0 * (1.0 - plastic[p])), 0.1, 5.0)
        large = wp.clamp(q + r, LEAST, MOST)
        small = wp.clamp(q - r, LEAST, MOST)
        plastic[p] = plastic[p] * ((q + r) / large) * ((q - r) / small)
        stretch = 0.5 * (large - small) / r
        f = rotation * (0.5 * (large + small)) + wp.mat22(c, d, d, -c) * stretch
    area = wp.determinant(f)
    mu = MU * h
    la = LAMBDA * h
    if material[p] == LIQUID:
        mu = float(0.0)
        la = float(LAMBDA)
        f = identity * wp.sqrt(area)
    deformation[p] = f
    stress = (f - rotation) * wp.transpose(f) * (2.0 * mu) + identity * (la * area * (area - 1.0))
    affine = stress * (-dt * volume * 4.0 / (dx * dx)) + affine_velocity[p] * volume
    for i in range(3):
        for j in range(3):
            away = wp.vec2((float(i) - fx) * dx, (float(j) - fy) * dx)
            share = weight(i, fx) * weight(j, fy)
            wp.atomic_add(momentum, bx + i, by + j, (v[p] * volume + affine * away) * share)
            wp.atomic_add(mass, bx + i, by + j, share * volume)


@wp.kernel
def update(momentum: wp.array2d(dtype=wp.vec2), mass: wp.array2d(dtype=float), cells: int, dt: float):
    i, j = wp.tid()
    if mass[i, j] > 0.0:
        v = momentum[i, j] / mass[i, j]
        vx = v[0]
        vy = v[1] + dt * GRAVITY
        if (i < 3 and vx < 0.0) or (i > cells - 3 and vx > 0.0):
            vx = 0.0
        if (j < 3 and vy < 0.0) or (j > cells - 3 and vy > 0.0):
            vy = 0.0
        momentum[i, j] = wp.vec2(vx, vy)


@wp.kernel
def gather(
    x: wp.array(dtype=wp.vec2),
    v: wp.array(dtype=wp.vec2),
    affine_velocity: wp.array(dtype=wp.mat22),
    grid: wp.array2d(dtype=wp.vec2),
    dx: float,
    dt: float,
):
    p = wp.tid()
    place = x[p] * (1.0 / dx)
    bx = int(place[0] - 0.5)
    by = int(place[1] - 0.5)
    fx = place[0] - float(bx)
    fy = place[1] - float(by)
    velocity = wp.vec2(0.0, 0.0)
    affine = wp.mat22(0.0, 0.0, 0.0, 0.0)
    for i in range(3):
        for j in range(3):
            away = wp.vec2(float(i) - fx, float(j) - fy)
            weighted = grid[bx + i, by + j] * (weight(i, fx) * weight(j, fy))
            velocity = velocity + weighted
            affine = affine + wp.outer(weighted, away) * (4.0 / dx)
    v[p] = velocity
    affine_velocity[p] = affine
    x[p] = x[p] + velocity * dt


class Solver:
    """Particles of the unit square."""

    def __init__(self, numbers, cells, dt):
        count = len(numbers)
        self.cells, self.dx, self.dt = cells, 1.0 / cells, dt
        self.x = wp.array(numbers[:, :2].copy(), dtype=wp.vec2)
        self.v = wp.array(numbers[:, 2:4].copy(), dtype=wp.vec2)
        self.affine = wp.zeros(count, dtype=wp.mat22)
        self.deformation = wp.array(np.tile(np.eye(2, dtype=np.float32), (count, 1, 1)), dtype=wp.mat22)
        self.plastic = wp.ones(count, dtype=float)
        self.material = wp.array(numbers[:, 4].astype(np.int32), dtype=wp.int32)
        self.momentum = wp.zeros((cells + 1, cells + 1), dtype=wp.vec2)
        self.mass = wp.zeros((cells + 1, cells + 1), dtype=float)

    def substep(self):
        self.momentum.zero_()
        self.mass.zero_()
        state = [self.x, self.v, self.affine, self.deformation, self.plastic, self.material]
        wp.launch(scatter, len(self.x), [*state, self.momentum, self.mass, self.dx, self.dt])
        wp.launch(update, self.mass.shape, [self.momentum, self.mass, self.cells, self.dt])
        wp.launch(gather, len(self.x), [self.x, self.v, self.affine, self.momentum, self.dx, self.dt])


def main():
    wp.set_device(DEVICE)
    for file in sorted(Path(sys.argv[1]).glob("start_*.f32")):
        _, cells, dt = file.stem.split("_")
        numbers = np.fromfile(file, np.float32).reshape(-1, 5)
        solver = Solver(numbers, int(cells), float(dt))
        solver.substep()
        with wp.ScopedCapture() as capture:
            for _ in range(CAPTURED):
                solver.substep()
        times = []
        for _ in range(5):
            wp.synchronize()
            before = time.perf_counter()
            for _ in range(1000 // CAPTURED):
                wp.capture_launch(capture.graph)
            wp.synchronize()
            times.append(time.perf_counter() - before)
        print(f"warp {wp.__version__}: {len(numbers)} particles, {cells} cells: {min(times):.4f} ms a substep")


if __name__ == "__main__":
    main()
