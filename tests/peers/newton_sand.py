"""Compare eddy's solver with Newton's implicit MPM on a collapsing column of sand.

`eddy simulate` solves a scene (by default the shipped `sand_column.toml`: 0.3 x 0.6 domain
lengths) and writes a bag. Newton starts from the particles of its first frame and runs to the time
of its last one. Newton is three-dimensional: its particles form a slab one voxel thick between
planes without friction. Both have the same voxels, walls and floor, and friction at them. Newton
has the material and solver settings of its own example `mpm_granular`, apart from the friction.

Prints a table: wall time of a run on one thread (s; least of the rounds, which alternate), the
front (domain lengths from the wall within which 99 % of the particles lie), the height of the
deposit (domain lengths), the largest speed at the end (domain lengths per s), and the Chamfer
distance of the deposit from eddy's (particle spacings; mean distance to the nearest particle of
the other deposit, of both directions). The row "eddy, 2 E" tells what the Chamfer distance of
equal deposits is: its particles end in other places. eddy's time is that of the whole process,
with its start and the writing of the bag; Newton's excludes its import, the compilation of its
kernels (minutes at the first run) and the construction of the solver.

    pip install -r tests/peers/requirements-bench.txt
    cargo build --release
    python tests/peers/newton_sand.py target/release/eddy
"""

import argparse
import math
import subprocess
import tempfile
import time
import tomllib
from pathlib import Path

import newton
import numpy as np
import tomli_w
import warp as wp
from newton.solvers import SolverImplicitMPM
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROOT = Path(__file__).resolve().parents[2]
MSGS = ROOT / "msgs" / "eddy_msgs" / "msg"
FRAME = "eddy_msgs/msg/ParticleFrame"
SCENE = ROOT / "launch_configs" / "scenes" / "sand_column.toml"
GRAVITY = 9.8
# Cells from the edge of eddy's domain to the surface of its wall.
WALL_CELLS = 2
# eddy's angle of internal friction by default (degrees).
FRICTION_ANGLE = 31.0
# Settings of Newton's example mpm_granular.
DENSITY = 1000.0
MATERIAL = {
    "young_modulus": 1e15,
    "poisson_ratio": 0.3,
    "yield_pressure": 1e12,
    "tensile_yield_ratio": 0.0,
    "yield_stress": 0.0,
    "hardening": 0.0,
    "dilatancy": 0.0,
    "viscosity": 0.0,
    "damping": 0.0,
}


def newton_friction(degrees):
    """Newton's coefficient for an angle of internal friction.

    Newton bounds sqrt(J2) by the coefficient times the mean pressure of three dimensions. Its flow
    has no dilatancy and is along the deviatoric stress. In plane strain nothing flows across the
    plane, so the stress across it is the mean of the other two once sand flows: sqrt(J2) is half
    of the difference of the principal stresses, the pressure is their mean, and Mohr and Coulomb's
    limit is the sine. (Matched in triaxial compression it would be 2 sqrt(3) sin / (3 - sin), .72
    for 31 degrees: too strong here.)
    """
    return math.sin(math.radians(degrees))


def eddy(program, scene, stiffness=None):
    """Run `eddy simulate` on one thread: seconds, the first and the last frame, the end (s)."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "scene.toml")
        file.write_text(tomli_w.dumps(scene))
        command = [program, "--quiet", "simulate", "--scene", file, "--threads", "1"]
        command += ["--output", Path(folder, "bags")]
        command += ["--stiffness", str(stiffness)] if stiffness else []
        before = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - before
        store = get_typestore(Stores.ROS2_JAZZY)
        for path in sorted(MSGS.glob("*.msg")):
            store.register(get_types_from_msg(path.read_text(), f"eddy_msgs/msg/{path.stem}"))
        with Reader(Path(folder, "bags", "scene_0000")) as reader:
            messages = [(stamp, raw) for _, stamp, raw in reader.messages()]
    first, last = (store.deserialize_cdr(messages[k][1], FRAME) for k in (0, -1))
    return seconds, first, last, (messages[-1][0] - messages[0][0]) * 1e-9


class Slab:
    """Newton's model of the scene."""

    def __init__(self, position, scene, voxel, options):
        # Newton's voxels are centred on multiples of their width; eddy's nodes lie on them.
        self.shift = 0.5 * voxel
        # The area of a particle of eddy times the thickness of the slab; Newton's is (2 r)^3.
        volume = (0.5 * voxel) ** 2 * voxel
        count = len(position)
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
        SolverImplicitMPM.register_custom_attributes(builder)
        places = np.column_stack([position - self.shift, np.zeros(count)])
        builder.add_particles(
            pos=[wp.vec3(*place) for place in places.tolist()],
            vel=[wp.vec3(0.0)] * count,
            mass=[DENSITY * volume] * count,
            radius=[0.5 * volume ** (1 / 3)] * count,
        )
        self.walls(builder, scene, voxel)
        self.model = builder.finalize()
        self.model.set_gravity((0.0, -GRAVITY, 0.0))
        for key, value in MATERIAL.items():
            getattr(self.model.mpm, key).fill_(value)
        self.model.mpm.friction.fill_(newton_friction(FRICTION_ANGLE))
        self.config = SolverImplicitMPM.Config()
        self.config.voxel_size = voxel
        for key, value in options.items():
            setattr(self.config, key, value)

    def walls(self, builder, scene, voxel):
        """Floor and end walls with friction, and the sides of the slab without."""
        near = WALL_CELLS * voxel - self.shift
        far = scene["domain"][0] - WALL_CELLS * voxel - self.shift
        friction = newton.ModelBuilder.ShapeConfig(mu=scene["materials"]["wall_friction"])
        for plane in [(0.0, 1.0, 0.0, -near), (1.0, 0.0, 0.0, -near), (-1.0, 0.0, 0.0, far)]:
            builder.add_shape_plane(plane, width=8.0, length=8.0, cfg=friction)
        # A node meets the closest wall only. The sides begin a little above the floor, whose nodes
        # would meet them otherwise.
        gap, top = 0.05 * voxel, scene["domain"][1]
        middle = 0.5 * (near + far), 0.5 * (near + gap + top)
        for side, turned in [(-0.5, 0.0), (0.5, math.pi)]:
            rotation = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), turned)
            builder.add_shape_plane(
                None,
                xform=wp.transform(wp.vec3(*middle, side * voxel), rotation),
                width=far - near - 2 * gap,
                length=top - near - gap,
                cfg=newton.ModelBuilder.ShapeConfig(mu=0.0),
            )

    def run(self, dt, steps):
        """Seconds, final positions (eddy's coordinates) and velocities."""
        solver = SolverImplicitMPM(self.model, config=self.config)
        old, new = self.model.state(), self.model.state()
        before = time.perf_counter()
        for _ in range(steps):
            solver.step(old, new, None, None, dt)
            solver.project_outside(new, new, dt)
            old, new = new, old
        wp.synchronize()
        seconds = time.perf_counter() - before
        position, velocity = (a.numpy()[:, :2] for a in (old.particle_q, old.particle_qd))
        return seconds, position + self.shift, velocity


def chamfer(a, b):
    """Mean distance to the nearest point of the other set, of both directions."""

    def one_way(a, b):
        parts = np.array_split(a, max(1, len(a) // 500))
        near = [((part[:, None] - b[None]) ** 2).sum(-1).min(1) for part in parts]
        return np.sqrt(np.concatenate(near)).mean()

    return 0.5 * (one_way(a, b) + one_way(b, a))


def row(name, seconds, ours, found, voxel):
    """Print one row of the table. `ours` are eddy's seconds and final positions."""
    position, velocity = found
    surface = WALL_CELLS * voxel
    front = np.quantile(position[:, 0], 0.99) - surface
    height = position[:, 1].max() - surface
    speed = np.linalg.norm(velocity, axis=1).max()
    distance = chamfer(ours[1], position) / (0.5 * voxel)
    print(
        f"{name:24}  {seconds:8.2f}  {seconds / ours[0]:6.1f}  {front:6.3f}  {height:6.3f}"
        f"  {speed:7.4f}  {distance:7.2f}",
        flush=True,
    )


def peers(rates):
    """Newton's runs: name, settings that differ from its example's, and steps per second."""
    for rate in rates:
        yield f"Newton, 1/{rate} s", {}, rate
    # The iterations of Isaac Lab's pouring task.
    few = {"solver": "jacobi", "max_iterations": 24}
    yield f"Newton, 1/{rates[0]} s, 24 Jacobi", few, rates[0]


def compare(options, scene, voxel):
    """Run both programs in turn and print the table."""
    fast, slow, found = [], {}, {}
    _, first, last, end = eddy(options.program, scene)
    start = first.position.reshape(-1, 2)
    print(f"{len(start)} particles, {end:.2f} s, voxels of {voxel}", flush=True)
    runs = []
    for name, changes, rate in peers(options.steps_per_second):
        slab = Slab(start, scene, voxel, changes)
        # Compiles the kernels.
        slab.run(1 / rate, 2)
        runs.append((name, slab, rate))
    for _ in range(options.rounds):
        fast.append(eddy(options.program, scene)[0])
        for name, slab, rate in runs:
            seconds, *found[name] = slab.run(1 / rate, round(end * rate))
            slow[name] = min(seconds, slow.get(name, math.inf))
    ours = min(fast), last.position.reshape(-1, 2)
    print("run                       seconds   times   front  height    speed  Chamfer")
    row("eddy", ours[0], ours, (ours[1], last.velocity.reshape(-1, 2)), voxel)
    stiffness = 2 * scene["materials"].get("stiffness", 1000.0)
    seconds, _, last, _ = eddy(options.program, scene, stiffness)
    other = last.position.reshape(-1, 2), last.velocity.reshape(-1, 2)
    row("eddy, 2 E", seconds, ours, other, voxel)
    for name, *_ in runs:
        row(name, slow[name], ours, found[name], voxel)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", help="the built eddy")
    parser.add_argument("--scene", type=Path, default=SCENE)
    parser.add_argument("--cell-width", type=float, default=1 / 64, help="domain lengths")
    parser.add_argument("--steps-per-second", type=int, nargs="+", default=[60, 240, 480])
    parser.add_argument("--rounds", type=int, default=2)
    options = parser.parse_args()
    scene = tomllib.loads(options.scene.read_text())
    scene["cell_width"] = options.cell_width
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    with wp.ScopedDevice("cpu"):
        compare(options, scene, options.cell_width)


if __name__ == "__main__":
    main()
