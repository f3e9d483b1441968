"""Compare eddy's solver with Taichi: time per substep and particle positions.

`eddy bench solver --output` writes bags with the initial state and eddy's states after 20 and 200
substeps. This script runs Taichi's mpm128 example from the same initial states. Runs alternate
on the same number of threads. Prints a table: microseconds per substep (median of the rounds),
the speed-up of eddy, and the largest difference of a coordinate after 20 and 200 substeps.
Exits with 1 if eddy is slower, or if a difference exceeds its tolerance at 2,500 particles; with more
particles and finer cells, the largest difference grows.

    pip install -r tests/peers/requirements-bench.txt
    cargo build --release
    python tests/peers/taichi_solver.py target/release/eddy
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import taichi as ti
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MSGS = Path(__file__).resolve().parents[2] / "msgs" / "eddy_msgs" / "msg"
FRAME = "eddy_msgs/msg/ParticleFrame"
# Largest difference of a coordinate (domain lengths) by number of substeps.
TOLERANCE = {20: 1e-6, 200: 1e-5}
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
        """Time of this number of substeps (s)."""
        ti.sync()
        before = time.perf_counter()
        for _ in range(substeps):
            self.substep()
        ti.sync()
        return time.perf_counter() - before


def eddy(program, particles, threads, seconds, output=None):
    """Run `eddy bench solver` and return its report."""
    command = [program, "--quiet", "bench", "solver", "--law", "taichi", "--json"]
    command += ["--particles", str(particles), "--threads", str(threads), "--seconds", str(seconds)]
    command += ["--output", output] if output else []
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def frames(bag):
    """The particle frames of a bag."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(MSGS.glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(), f"eddy_msgs/msg/{path.stem}"))
    with Reader(bag) as reader:
        return [store.deserialize_cdr(raw, FRAME) for _, _, raw in reader.messages()]


def compare(options, particles):
    """Print one row of the table; return whether it meets the requirements."""
    with tempfile.TemporaryDirectory() as folder:
        report = eddy(options.program, particles, options.threads, 0.1, folder)
        start, *ours = frames(Path(folder, f"particles_{particles}"))
    timing = report["timings"][0]
    settings = timing["cells"], timing["dt"], report["stiffness"], report["gravity"]
    peer = Mpm128(start, *settings)
    difference, done = {}, 0
    for number, frame in zip(report["compared"][1:], ours):
        peer.run(number - done)
        done = number
        difference[number] = np.abs(peer.x.to_numpy() - frame.position.reshape(-1, 2)).max()
    once = peer.run(10) / 10
    substeps = max(10, int(options.seconds / once))
    fast, slow = [], []
    for _ in range(options.rounds):
        again = eddy(options.program, particles, options.threads, options.seconds)
        fast.append(again["timings"][0]["microseconds"])
        slow.append(peer.run(substeps) * 1e6 / substeps)
    fast, slow = statistics.median(fast), statistics.median(slow)
    far = "  ".join(f"{difference[number]:8.1e}" for number in TOLERANCE)
    cells = timing["cells"]
    print(
        f"{particles:9}  {cells:4}x{cells:<4}  {options.threads:7}  {fast:8.1f}  {slow:9.1f}"
        f"  {slow / fast:5.1f}  {far}",
        flush=True,
    )
    near = all(difference[n] <= limit for n, limit in TOLERANCE.items())
    return slow > fast and (near or particles != 2500)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", help="the built eddy")
    parser.add_argument("--particles", type=int, nargs="+", default=[2500, 10000, 100000, 1000000])
    parser.add_argument("--threads", type=int, help="number of threads [default: 1, then 2]")
    parser.add_argument("--seconds", type=float, default=2.0, help="duration of a round")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    if options.threads is None:
        # Taichi's number of threads is fixed per process.
        print("particles       grid  threads   eddy us  taichi us  times  after 20  after 200", flush=True)
        runs = [[sys.executable, *sys.argv, "--threads", str(threads)] for threads in (1, 2)]
        raise SystemExit(max(subprocess.run(run, check=False).returncode for run in runs))
    ti.init(
        arch=ti.cpu, cpu_max_num_threads=options.threads, default_fp=ti.f32, log_level=ti.WARN
    )
    good = [compare(options, particles) for particles in options.particles]
    raise SystemExit(0 if all(good) else 1)


if __name__ == "__main__":
    main()
