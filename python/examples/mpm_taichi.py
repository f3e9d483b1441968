"""A two-dimensional MLS-MPM in Taichi, as in Taichi's own example, and its surrogate.

    pip install taichi==1.7.4 eddy-surrogates
    python mpm_taichi.py --output out/taichi
"""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from surrogate_loop import DT, SPACING, main

CELLS = 64
DX = 1 / CELLS
SUBSTEPS = 160
STEP = DT / SUBSTEPS
VOLUME = SPACING**2
E, NU = 1000.0, 0.2
MU, LAMBDA = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
GRAVITY = -9.8

ti.init(arch=ti.cpu, log_level=ti.ERROR)


@ti.data_oriented
class Solver:
    """Particles on a grid of 64 x 64 cells; liquid (0) has no shear stiffness, jelly (2) is softer than at Taichi's."""

    def __init__(self, position: NDArray[np.float32], velocity: NDArray[np.float32], material: NDArray[np.uint8]) -> None:
        count = len(position)
        self.x = ti.Vector.field(2, ti.f32, count)
        self.v = ti.Vector.field(2, ti.f32, count)
        self.C = ti.Matrix.field(2, 2, ti.f32, count)
        self.F = ti.Matrix.field(2, 2, ti.f32, count)
        self.material = ti.field(ti.i32, count)
        self.grid_v = ti.Vector.field(2, ti.f32, (CELLS, CELLS))
        self.grid_m = ti.field(ti.f32, (CELLS, CELLS))
        self.x.from_numpy(position)
        self.v.from_numpy(velocity)
        self.material.from_numpy(material.astype(np.int32))
        self.F.from_numpy(np.tile(np.eye(2, dtype=np.float32), (count, 1, 1)))

    @ti.kernel
    def substep(self):
        for node in ti.grouped(self.grid_m):
            self.grid_v[node] = [0, 0]
            self.grid_m[node] = 0
        for p in self.x:
            base = (self.x[p] / DX - 0.5).cast(int)
            fx = self.x[p] / DX - base.cast(float)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            F = (ti.Matrix.identity(float, 2) + STEP * self.C[p]) @ self.F[p]
            J = F.determinant()
            mu = MU * 0.3
            if self.material[p] == 0:
                mu = 0.0
                F = ti.Matrix.identity(float, 2) * ti.sqrt(J)
            self.F[p] = F
            U, _, V = ti.svd(F)
            stress = 2 * mu * (F - U @ V.transpose()) @ F.transpose()
            stress += ti.Matrix.identity(float, 2) * LAMBDA * J * (J - 1)
            affine = -STEP * VOLUME * 4 / DX**2 * stress + VOLUME * self.C[p]
            for i, j in ti.static(ti.ndrange(3, 3)):
                offset = ti.Vector([i, j])
                away = (offset.cast(float) - fx) * DX
                weight = w[i][0] * w[j][1]
                self.grid_v[base + offset] += weight * (VOLUME * self.v[p] + affine @ away)
                self.grid_m[base + offset] += weight * VOLUME
        for i, j in self.grid_m:
            if self.grid_m[i, j] > 0:
                v = self.grid_v[i, j] / self.grid_m[i, j]
                v[1] += STEP * GRAVITY
                if i < 3 and v[0] < 0 or i > CELLS - 3 and v[0] > 0:
                    v[0] = 0
                if j < 3 and v[1] < 0 or j > CELLS - 3 and v[1] > 0:
                    v[1] = 0
                self.grid_v[i, j] = v
        for p in self.x:
            base = (self.x[p] / DX - 0.5).cast(int)
            fx = self.x[p] / DX - base.cast(float)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            velocity = ti.Vector.zero(float, 2)
            C = ti.Matrix.zero(float, 2, 2)
            for i, j in ti.static(ti.ndrange(3, 3)):
                away = ti.Vector([i, j]).cast(float) - fx
                weighted = w[i][0] * w[j][1] * self.grid_v[base + ti.Vector([i, j])]
                velocity += weighted
                C += 4 / DX * weighted.outer_product(away)
            self.v[p], self.C[p] = velocity, C
            self.x[p] += STEP * velocity

    def step(self) -> None:
        for _ in range(SUBSTEPS):
            self.substep()

    def state(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return self.x.to_numpy(), self.v.to_numpy()


if __name__ == "__main__":
    main(Solver)
