"""Times eddy's solver against Taichi and compares where the particles go.

Runs the law of Taichi's mpm128 example on the initial states that `examples/solver_bench.rs`
writes, both on one thread and in the same run, and prints a table: microseconds a substep (median
of the rounds, taken in turns), their ratio, and the largest difference of a coordinate after 20 and
200 substeps. Exits with 1 if eddy is slower or a difference exceeds its tolerance.

    pip install -r tests/peers/requirements-bench.txt
    cargo build --release --example solver_bench
    python tests/peers/taichi_solver.py target/release/examples/solver_bench
"""

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import taichi as ti

# Scenes that hold every material, as (preset, id).
SCENES = [("multi-material", 0), ("multi-material", 1), ("multi-material", 2), ("fluid", 0)]
# Largest difference of a coordinate (domain lengths) after so many substeps.
TOLERANCE = {20: 1e-6, 200: 1e-5}
LIQUID, SNOW, JELLY, ROPE = range(4)


@ti.data_oriented
class Mpm128:
    """mpm128.py of Taichi 1.7.4, with eddy's rope, stiffness, gravity and a node more on each side."""

    def __init__(self, table, cells, dt, stiffness, gravity):
        self.n, self.cells = len(table), cells
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
        self.start(table)

    def start(self, table):
        self.x.from_numpy(np.ascontiguousarray(table[:, 0:2]))
        self.v.from_numpy(np.ascontiguousarray(table[:, 2:4]))
        self.C.fill(0)
        self.F.from_numpy(np.tile(np.eye(2, dtype=np.float32), (self.n, 1, 1)))
        self.Jp.fill(1)
        self.material.from_numpy(table[:, 4].astype(np.int32))

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
                mu = 0.0
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
            if self.grid_m[i, j] > 0:
                self.grid_v[i, j] = self.grid_v[i, j] / self.grid_m[i, j]
                self.grid_v[i, j][1] -= self.dt * self.gravity
                if i < 3 and self.grid_v[i, j][0] < 0:
                    self.grid_v[i, j][0] = 0
                if i > self.cells - 3 and self.grid_v[i, j][0] > 0:
                    self.grid_v[i, j][0] = 0
                if j < 3 and self.grid_v[i, j][1] < 0:
                    self.grid_v[i, j][1] = 0
                if j > self.cells - 3 and self.grid_v[i, j][1] > 0:
                    self.grid_v[i, j][1] = 0
        for p in self.x:
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
        """Seconds that so many substeps take."""
        ti.sync()
        before = time.perf_counter()
        for _ in range(substeps):
            self.substep()
        ti.sync()
        return time.perf_counter() - before


def eddy(program, scene, substeps, folder):
    """Runs `solver_bench`, which leaves its tables in the folder."""
    command = [program, scene[0], str(scene[1]), str(substeps), folder]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def table(folder, substeps):
    return np.loadtxt(Path(folder, f"after_{substeps}.csv"), delimiter=",", dtype=np.float32)


def compare(program, scene, substeps, rounds):
    """One scene: microseconds of eddy and of Taichi, and the differences by number of substeps."""
    with tempfile.TemporaryDirectory() as folder:
        about = eddy(program, scene, 1, folder)
        start = table(folder, 0)
        peer = Mpm128(start, about["cells"], about["dt"], about["stiffness"], about["gravity"])
        difference, done = {}, 0
        for number in TOLERANCE:
            peer.run(number - done)
            done = number
            difference[number] = np.abs(peer.x.to_numpy() - table(folder, number)[:, :2]).max()
        ours, theirs = [], []
        for _ in range(rounds):
            ours.append(eddy(program, scene, substeps, folder)["microseconds"])
            peer.start(start)
            theirs.append(peer.run(substeps) * 1e6 / substeps)
    return statistics.median(ours), statistics.median(theirs), difference


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", help="the built example solver_bench")
    parser.add_argument("--substeps", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    ti.init(arch=ti.cpu, cpu_max_num_threads=1, default_fp=ti.f32, log_level=ti.WARN)
    good = True
    print("scene             eddy us  taichi us  ratio  after 20  after 200")
    for scene in SCENES:
        ours, theirs, difference = compare(
            options.program, scene, options.substeps, options.rounds
        )
        far = "  ".join(f"{difference[number]:8.1e}" for number in TOLERANCE)
        print(f"{' '.join(map(str, scene)):16}  {ours:7.1f}  {theirs:9.1f}  {ours / theirs:5.2f}  {far}")
        good &= ours <= theirs and all(difference[n] <= limit for n, limit in TOLERANCE.items())
    raise SystemExit(0 if good else 1)


if __name__ == "__main__":
    main()
