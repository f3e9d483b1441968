"""A two-dimensional MLS-MPM in Warp, on the CPU, and its surrogate.

    pip install warp-lang==1.19.0 eddy-surrogates
    python mpm_warp.py --output out/warp
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from surrogate_loop import DT, SPACING, main

CELLS = 64
DX = 1 / CELLS
SUBSTEPS = 160
STEP = DT / SUBSTEPS
VOLUME = SPACING**2
E, NU = 1000.0, 0.2
MU, LAMBDA = 0.3 * E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
GRAVITY = -9.8

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


@wp.func
def rotation(f: wp.mat22) -> wp.mat22:
    """The rotation of the polar decomposition."""
    x = f[0, 0] + f[1, 1]
    y = f[1, 0] - f[0, 1]
    length = wp.max(wp.sqrt(x * x + y * y), 1.0e-12)
    return wp.mat22(x / length, -y / length, y / length, x / length)


@wp.kernel
def scatter(
    x: wp.array(dtype=wp.vec2),
    v: wp.array(dtype=wp.vec2),
    affine_velocity: wp.array(dtype=wp.mat22),
    deformation: wp.array(dtype=wp.mat22),
    material: wp.array(dtype=wp.int32),
    momentum: wp.array2d(dtype=wp.vec2),
    mass: wp.array2d(dtype=float),
):
    p = wp.tid()
    identity = wp.mat22(1.0, 0.0, 0.0, 1.0)
    place = x[p] * (1.0 / DX)
    bx = int(place[0] - 0.5)
    by = int(place[1] - 0.5)
    fx = place[0] - float(bx)
    fy = place[1] - float(by)
    f = (identity + affine_velocity[p] * STEP) * deformation[p]
    area = wp.determinant(f)
    mu = float(MU)
    if material[p] == 0:
        mu = float(0.0)
        f = identity * wp.sqrt(area)
    deformation[p] = f
    stress = (f - rotation(f)) * wp.transpose(f) * (2.0 * mu) + identity * (LAMBDA * area * (area - 1.0))
    affine = stress * (-STEP * VOLUME * 4.0 / (DX * DX)) + affine_velocity[p] * VOLUME
    for i in range(3):
        for j in range(3):
            away = wp.vec2((float(i) - fx) * DX, (float(j) - fy) * DX)
            share = weight(i, fx) * weight(j, fy)
            wp.atomic_add(momentum, bx + i, by + j, (v[p] * VOLUME + affine * away) * share)
            wp.atomic_add(mass, bx + i, by + j, share * VOLUME)


@wp.kernel
def update(momentum: wp.array2d(dtype=wp.vec2), mass: wp.array2d(dtype=float)):
    i, j = wp.tid()
    if mass[i, j] > 0.0:
        v = momentum[i, j] / mass[i, j]
        vx = v[0]
        vy = v[1] + STEP * GRAVITY
        if (i < 3 and vx < 0.0) or (i > CELLS - 3 and vx > 0.0):
            vx = 0.0
        if (j < 3 and vy < 0.0) or (j > CELLS - 3 and vy > 0.0):
            vy = 0.0
        momentum[i, j] = wp.vec2(vx, vy)


@wp.kernel
def gather(
    x: wp.array(dtype=wp.vec2),
    v: wp.array(dtype=wp.vec2),
    affine_velocity: wp.array(dtype=wp.mat22),
    grid: wp.array2d(dtype=wp.vec2),
):
    p = wp.tid()
    place = x[p] * (1.0 / DX)
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
            affine = affine + wp.outer(weighted, away) * (4.0 / DX)
    v[p] = velocity
    affine_velocity[p] = affine
    x[p] = x[p] + velocity * STEP


class Solver:
    """Particles on a grid of 64 x 64 cells; liquid (0) has no shear stiffness."""

    def __init__(self, position: NDArray[np.float32], velocity: NDArray[np.float32], material: NDArray[np.uint8]) -> None:
        count = len(position)
        identity = np.tile(np.eye(2, dtype=np.float32), (count, 1, 1))
        with wp.ScopedDevice("cpu"):
            self.x = wp.array(position, dtype=wp.vec2)
            self.v = wp.array(velocity, dtype=wp.vec2)
            self.affine = wp.zeros(count, dtype=wp.mat22)
            self.deformation = wp.array(identity, dtype=wp.mat22)
            self.material = wp.array(material.astype(np.int32), dtype=wp.int32)
            self.momentum = wp.zeros((CELLS, CELLS), dtype=wp.vec2)
            self.mass = wp.zeros((CELLS, CELLS), dtype=float)

    def step(self) -> None:
        particles, nodes = len(self.x), (CELLS, CELLS)
        with wp.ScopedDevice("cpu"):
            for _ in range(SUBSTEPS):
                self.momentum.zero_()
                self.mass.zero_()
                wp.launch(
                    scatter,
                    particles,
                    [self.x, self.v, self.affine, self.deformation, self.material, self.momentum, self.mass],
                )
                wp.launch(update, nodes, [self.momentum, self.mass])
                wp.launch(gather, particles, [self.x, self.v, self.affine, self.momentum])

    def state(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return self.x.numpy().copy(), self.v.numpy().copy()


if __name__ == "__main__":
    main(Solver)
