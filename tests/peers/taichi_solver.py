"""Compare eddy's solver with Taichi: time per substep and particle positions.

`eddy-lab bench solver --output` writes bags with the initial state and eddy's states after 20 and
200 substeps. This script runs Taichi's mpm128 example from the same initial states; with --sand
both have blocks of sand instead of liquid, snow and jelly, and Taichi a kernel of the same
published law. Runs alternate on the same number of threads. Prints a table: microseconds per
substep (fastest of five parts of a round; median of the rounds), the speed-up of eddy (median of
the rounds' ratios), and the largest difference of a coordinate after 20 and 200 substeps. Exits
with 1 if eddy is slower, or if a difference exceeds its tolerance at 2,500 particles; with more
particles and finer cells, the largest difference grows.

    pip install -r tests/peers/requirements-bench.txt
    cargo build --release -p eddy-lab
    python tests/peers/taichi_solver.py target/release/eddy-lab
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import taichi as ti
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from taichi_mpm import Mpm128, Sand

MSGS = Path(__file__).resolve().parents[2] / "msgs" / "eddy_msgs" / "msg"
FRAME = "eddy_msgs/msg/ParticleFrame"
# Largest difference of a coordinate (domain lengths) by number of substeps.
TOLERANCE = {20: 1e-6, 200: 1e-5}
# The same for sand, whose particles part and touch at other substeps.
SAND_TOLERANCE = {20: 1e-6, 200: 2e-5}
# Substeps before a measurement, and parts of a round, of which the fastest counts; those of
# `eddy-lab bench solver`.
WARM_UP, PARTS = 32, 5


def eddy(options, particles, seconds, output=None):
    """Run `eddy-lab bench solver` and return its report."""
    command = [options.program, "--quiet", "bench", "solver", "--law", "taichi", "--json"]
    command += ["--particles", str(particles), "--threads", str(options.threads)]
    command += ["--seconds", str(seconds), *(["--sand"] if options.sand else [])]
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
        report = eddy(options, particles, 0.1, folder)
        start, *ours = frames(Path(folder, f"particles_{particles}"))
    timing = report["timings"][0]
    settings = timing["cells"], timing["dt"], report["stiffness"], report["gravity"]
    if options.sand:
        peer = Sand(start, *settings, report["friction_angle_degrees"])
    else:
        peer = Mpm128(start, *settings)
    difference, done = {}, 0
    for number, frame in zip(report["compared"][1:], ours):
        peer.run(number - done)
        done = number
        difference[number] = np.abs(peer.x.to_numpy() - frame.position.reshape(-1, 2)).max()
    substeps = max(10, int(options.seconds / PARTS / (peer.run(10) / 10)))
    fast, slow = [], []
    for _ in range(options.rounds):
        again = eddy(options, particles, options.seconds)
        fast.append(again["timings"][0]["microseconds"])
        peer.start()
        peer.run(WARM_UP)
        slow.append(min(peer.run(substeps) for _ in range(PARTS)) * 1e6 / substeps)
    times = statistics.median(b / a for a, b in zip(fast, slow))
    fast, slow = statistics.median(fast), statistics.median(slow)
    far = "  ".join(f"{difference[number]:8.1e}" for number in TOLERANCE)
    cells = timing["cells"]
    print(
        f"{particles:9}  {cells:4}x{cells:<4}  {options.threads:7}  {fast:8.1f}  {slow:9.1f}"
        f"  {times:5.1f}  {far}",
        flush=True,
    )
    limits = SAND_TOLERANCE if options.sand else TOLERANCE
    near = all(difference[n] <= limit for n, limit in limits.items())
    return slow > fast and (near or particles != 2500)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", help="the built eddy-lab")
    parser.add_argument("--sand", action="store_true", help="blocks of sand")
    parser.add_argument("--particles", type=int, nargs="+", default=[2500, 10000, 100000, 1000000])
    parser.add_argument("--threads", type=int, help="number of threads [default: 1, then 2]")
    parser.add_argument("--seconds", type=float, default=2.0, help="duration of a round")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    if options.threads is None:
        # Taichi's number of threads is fixed per process.
        print(
            "particles       grid  threads   eddy us  taichi us  times  after 20  after 200",
            flush=True,
        )
        runs = [[sys.executable, *sys.argv, "--threads", str(threads)] for threads in (1, 2)]
        raise SystemExit(max(subprocess.run(run, check=False).returncode for run in runs))
    ti.init(arch=ti.cpu, cpu_max_num_threads=options.threads, default_fp=ti.f32, log_level=ti.WARN)
    good = [compare(options, particles) for particles in options.particles]
    raise SystemExit(0 if all(good) else 1)


if __name__ == "__main__":
    main()
