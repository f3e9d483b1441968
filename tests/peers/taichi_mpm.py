"""Taichi's two-dimensional MLS-MPM, the rival of eddy's solver."""

import math
import time

import numpy as np
import taichi as ti

LIQUID, SNOW, JELLY, ROPE = range(4)


@ti.data_oriented
class Mpm128:
    """mpm128.py of Taichi 1.7.4, with eddy's rope, stiffness, gravity and one more node on each side."""

    def __init__(self, frame, cells, dt, stiffness, gravity):
        self.frame, self.n, self.cells = frame, len(frame.material), cells
        self.dt, self.gravity, self.dx = dt, gravity, 1 / cells
        self.volume = (self.dx * 0.5) ** 2
        self.mass = self.volume
        self.mu = stiffness / (2 * (1 + 0.2))
        self.la = stiffness * 0.2 / ((1 + 0.2) * (1 - 2 * 0.2))
        self.x = ti.Vector.field(2, float, self.n)
        self.v = ti.Vector.field(2, float, self.n)
        self.C = ti.Matrix.field(2, 2, float, self.n)
        self.F = ti.Matrix.field(2, 2, float, self.n)
        self.Jp = ti.field(float, self.n)
        self.material = ti.field(int, self.n)
        self.grid_v = ti.Vector.field(2, float, (cells + 1, cells + 1))
        self.grid_m = ti.field(float, (cells + 1, cells + 1))
        self.start()

    def start(self):
        self.x.from_numpy(self.frame.position.reshape(-1, 2))
        self.v.from_numpy(self.frame.velocity.reshape(-1, 2))
        self.C.fill(0)
        self.F.from_numpy(np.tile(np.eye(2, dtype=np.float32), (self.n, 1, 1)))
        self.Jp.fill(1)
        self.material.from_numpy(self.frame.material.astype(np.int32))

    @ti.kernel
    def substep(self):
        for i, j in self.grid_m:
            self.grid_v[i, j] = [0, 0]
            self.grid_m[i, j] = 0
        for p in self.x:
            base = (self.x[p] / self.dx - 0.5).cast(int)
            fx = self.x[p] / self.dx - base.cast(float)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            self.F[p] = (ti.Matrix.identity(float, 2) + self.dt * self.C[p]) @ self.F[p]
            h = ti.max(0.1, ti.min(5, ti.exp(10 * (1.0 - self.Jp[p]))))
            if self.material[p] == JELLY:
                h = 0.3
            if self.material[p] == ROPE:
                h = 2.0
            mu, la = self.mu * h, self.la * h
            if self.material[p] == LIQUID:
                mu, la = 0.0, self.la
            U, sig, V = ti.svd(self.F[p])
            J = 1.0
            for d in ti.static(range(2)):
                new_sig = sig[d, d]
                if self.material[p] == SNOW:
                    new_sig = ti.min(ti.max(sig[d, d], 1 - 2.5e-2), 1 + 4.5e-3)
                self.Jp[p] *= sig[d, d] / new_sig
                sig[d, d] = new_sig
                J *= new_sig
            if self.material[p] == LIQUID:
                self.F[p] = ti.Matrix.identity(float, 2) * ti.sqrt(J)
            elif self.material[p] == SNOW:
                self.F[p] = U @ sig @ V.transpose()
            stress = 2 * mu * (self.F[p] - U @ V.transpose()) @ self.F[p].transpose()
            stress += ti.Matrix.identity(float, 2) * la * J * (J - 1)
            stress = (-self.dt * self.volume * 4 / self.dx**2) * stress
            affine = stress + self.mass * self.C[p]
            for i, j in ti.static(ti.ndrange(3, 3)):
                offset = ti.Vector([i, j])
                dpos = (offset.cast(float) - fx) * self.dx
                weight = w[i][0] * w[j][1]
                self.grid_v[base + offset] += weight * (self.mass * self.v[p] + affine @ dpos)
                self.grid_m[base + offset] += weight * self.mass
        for i, j in self.grid_m:
            self.advance_node(i, j)
        for p in self.x:
            self.gather(p)

    @ti.func
    def advance_node(self, i, j):
        if self.grid_m[i, j] > 0:
            self.grid_v[i, j] = self.grid_v[i, j] / self.grid_m[i, j]
            self.grid_v[i, j][1] += self.dt * self.gravity
            if i < 3 and self.grid_v[i, j][0] < 0:
                self.grid_v[i, j][0] = 0
            if i > self.cells - 3 and self.grid_v[i, j][0] > 0:
                self.grid_v[i, j][0] = 0
            if j < 3 and self.grid_v[i, j][1] < 0:
                self.grid_v[i, j][1] = 0
            if j > self.cells - 3 and self.grid_v[i, j][1] > 0:
                self.grid_v[i, j][1] = 0

    @ti.func
    def gather(self, p):
        base = (self.x[p] / self.dx - 0.5).cast(int)
        fx = self.x[p] / self.dx - base.cast(float)
        w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
        new_v = ti.Vector.zero(float, 2)
        new_C = ti.Matrix.zero(float, 2, 2)
        for i, j in ti.static(ti.ndrange(3, 3)):
            dpos = ti.Vector([i, j]).cast(float) - fx
            g_v = self.grid_v[base + ti.Vector([i, j])]
            weight = w[i][0] * w[j][1]
            new_v += weight * g_v
            new_C += 4 / self.dx * weight * g_v.outer_product(dpos)
        self.v[p], self.C[p] = new_v, new_C
        self.x[p] += self.dt * self.v[p]

    def run(self, substeps):
        """Time of this number of substeps (s)."""
        ti.sync()
        before = time.perf_counter()
        for _ in range(substeps):
            self.substep()
        ti.sync()
        return time.perf_counter() - before


@ti.data_oriented
class Sand(Mpm128):
    """The same solver for sand alone, with the law of Klar et al. 2016.

    That is "Drucker-Prager Elastoplasticity for Sand Animation": Hencky strain, and plastic flow
    that keeps the volume. With the volume correction of Tampubolon et al. 2017: area that grains
    gain when they part must be given back before they resist again. In the plane the yield surface
    is that of Mohr and Coulomb for `degrees`. The kernel has no branches for other materials.
    """

    def __init__(self, frame, cells, dt, stiffness, gravity, degrees):
        super().__init__(frame, cells, dt, stiffness, gravity)
        # Largest half difference of the strains relative to their mean compression.
        self.slope = math.sin(math.radians(degrees)) * (self.la + self.mu) / self.mu

    def start(self):
        """Jp is the logarithm of the area gained."""
        super().start()
        self.Jp.fill(0)

    @ti.func
    def stress(self, p):
        """Advance the deformation; return the Kirchhoff stress."""
        U, sig, V = ti.svd((ti.Matrix.identity(float, 2) + self.dt * self.C[p]) @ self.F[p])
        first = ti.log(ti.max(sig[0, 0], 0.05))
        second = ti.log(ti.max(sig[1, 1], 0.05))
        mean = 0.5 * (first + second + self.Jp[p])
        stress = ti.Matrix.zero(float, 2, 2)
        if mean >= 0:
            self.F[p] = U @ V.transpose()
            self.Jp[p] = 2 * mean
        else:
            most = -self.slope * mean
            shear = ti.max(-most, ti.min(most, 0.5 * (first - second)))
            kept = ti.Matrix([[ti.exp(mean + shear), 0.0], [0.0, ti.exp(mean - shear)]])
            self.F[p] = U @ kept @ V.transpose()
            self.Jp[p] = 0
            pressure, half = 2 * (self.la + self.mu) * mean, 2 * self.mu * shear
            principal = ti.Matrix([[pressure + half, 0.0], [0.0, pressure - half]])
            stress = U @ principal @ U.transpose()
        return stress

    @ti.kernel
    def substep(self):
        for i, j in self.grid_m:
            self.grid_v[i, j] = [0, 0]
            self.grid_m[i, j] = 0
        for p in self.x:
            base = (self.x[p] / self.dx - 0.5).cast(int)
            fx = self.x[p] / self.dx - base.cast(float)
            w = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2]
            stress = (-self.dt * self.volume * 4 / self.dx**2) * self.stress(p)
            affine = stress + self.mass * self.C[p]
            for i, j in ti.static(ti.ndrange(3, 3)):
                offset = ti.Vector([i, j])
                dpos = (offset.cast(float) - fx) * self.dx
                weight = w[i][0] * w[j][1]
                self.grid_v[base + offset] += weight * (self.mass * self.v[p] + affine @ dpos)
                self.grid_m[base + offset] += weight * self.mass
        for i, j in self.grid_m:
            self.advance_node(i, j)
        for p in self.x:
            self.gather(p)
