"""Exchange checkpoints between eddy and PyTorch in both directions.

    pip install -r tests/peers/requirements-bench.txt
    cargo build --release
    python tests/peers/torch_exchange.py target/release/eddy

For both architectures and every core, for particle models that are conditioned on the stiffness, without and with weights for
several stiffnesses, for one with weights of 16 bits, and for one with the rule `elastic`, a checkpoint written by PyTorch, and one trained by `eddy train` and loaded into PyTorch
with `strict=True`, each predict a bag with `eddy predict` and in PyTorch. A table shows the largest
difference relative to the largest value; exits with 1 if one exceeds 1e-5 (3e-4 with the rule `elastic`, which
enlarges the rounding of f32).
"""

import itertools
import subprocess
import sys
import tempfile
from pathlib import Path

import tomli_w
import torch
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from torch import Tensor

from torch_core import MATERIALS, Bodies
from torch_model import Model, describe, load, network, save
from torch_particle import ParticleModel, rest_neighbours, rest_shape

MSGS = Path(__file__).resolve().parents[2] / "msgs" / "eddy_msgs" / "msg"
FRAME = "eddy_msgs/msg/ParticleFrame"
CORES = ("mlp", "lstm", "gru", "minlstm", "mingru")
SIZES = {"encoder": 32, "hidden": 48, "layers": 2}
SURROUNDINGS = {"cell_width": 1 / 32, "channels": [5, 6, 7, 8], "spacing": 1 / 128}
# Nodes reject frames that are much faster than the training data.
FASTEST = 15.0
ELASTIC = {
    "modulus": 300.0, "poisson_ratio": 0.2, "cell_width": 3.5, "steps": 25, "viscosity": 0.07, "wall_distance": 2.85,
    "wall_stiffness": 1.0, "rebound": 0.8, "clear_distance": 7.0, "most_stretch": 1.25, "most_error": 0.1, "small_error": 0.035,
}  # fmt: skip
# Those of format version 1, and `elastic`.
RULES = {
    "elastic": ELASTIC,
    "area": {
        "cell_width": 2.0, "fill_limit": 1.25, "surface_fill": 0.5, "sweeps": 20, "relaxation": 1.7, "longest_shift": 0.5, "rate": 1.0,
    },
    "shape": {"strain_limit": 0.03, "sweeps": 5},
    "flight": {"wall_distance": 1.5},
    "rest": {"wall_distance": 1.5, "asleep_below": 0.25, "awake_from": 1.0},
}  # fmt: skip
# Keys of a network's description and of its training.
OPTIONS = {
    "-": {},
    "stiffness": {"stiffness": True},
    "knots": {"stiffness": True, "stiffness_knots": [1e2, 3e3, 1e5]},
    "f16": {"weights": "f16"},
    "elastic": {"format_version": 2, "rules": RULES},
}
NEAR = 1e-5
# A position's rounding gives jelly, whose motion PyTorch computes in f64, up to 1e-4 domain lengths per second.
NEAR_ELASTIC = 3e-4
# Young's modulus of the scenes.
STIFFNESS = 1e3


def typestore() -> Typestore:
    """ROS 2's messages and eddy's."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(MSGS.glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(), f"eddy_msgs/msg/{path.stem}"))
    return store


def frames(bag: Path, topic: str, store: Typestore) -> dict[int, object]:
    """The frames on a topic of a bag by sequence number."""
    with Reader(bag) as reader:
        chosen = [connection for connection in reader.connections if connection.topic == topic]
        found = [store.deserialize_cdr(data, FRAME) for _, _, data in reader.messages(chosen)]
    return {frame.sequence: frame for frame in found}


def stack(found: list[object]) -> Bodies:
    """Positions and velocities of frames, [T, 1, N, 2]."""
    position, velocity = (
        torch.stack([torch.from_numpy(getattr(frame, part).copy()).reshape(1, -1, 2) for frame in found])
        for part in ("position", "velocity")
    )
    return position, velocity


def difference(eddy: str, model: Model, checkpoint: Path, bag: Path, work: Path) -> float:
    """Largest difference between eddy's and PyTorch's predictions, relative to the largest value."""
    store = typestore()
    output = work / f"predicted_{checkpoint.name}"
    command = [eddy, "--quiet", "predict", "--checkpoint", checkpoint, "--input", bag, "--output", output]
    subprocess.run(command, check=True)
    shown = frames(bag, "/particles", store)
    predicted = frames(output, "/prediction", store)
    material = torch.from_numpy(shown[0].material.copy()).long().unsqueeze(0)
    bodies = stack([shown[number] for number in sorted(shown)])
    with torch.no_grad():
        conditioned = {"stiffness": torch.tensor([STIFFNESS])} if getattr(model, "is_conditioned", False) else {}
        expected, _ = model.double()(bodies, model.matter(material, bodies[0][0], **conditioned))
        if isinstance(model, ParticleModel):
            expected = apply_rules(model, material, bodies, expected)
    apart = 0.0
    for found, expected in zip(stack([predicted[number] for number in sorted(predicted)]), expected):
        expected = expected[-len(found) :]  # without the warm-up
        apart = max(apart, float((found - expected).abs().max() / expected.abs().max()))
    return apart


def apply_rules(model: ParticleModel, material: Tensor, bodies: Bodies, predicted: Bodies) -> Bodies:
    """Apply the rules to the network's predictions, [T, 1, N, 2]: jelly moves by its elasticity, liquids keep their area, solids their shape, bodies in free
    flight their momentum and angular momentum."""
    rest = bodies[0][0]
    neighbours = rest_neighbours(rest, material, model.spacing)[:2]
    matter = tuple(part[0] for part in (rest_shape(rest, material, model.spacing), *neighbours))
    elastic = model.elastic
    linked = (neighbours[0][0] > 0) & (material[0] == MATERIALS.index("jelly")).unsqueeze(1)
    lattices = elastic.lattices(rest[0], linked) if elastic else []
    both, moved = [], 0
    for shown, next in zip(zip(*(track[:, 0] for track in bodies)), zip(*(track[:, 0] for track in predicted))):
        if elastic:
            replaced = elastic.replace(shown, next, lattices)
            moved, next = moved + int(not replaced[0].equal(next[0])), replaced
        next = model.keep_shape(matter, model.keep_area(material[0], next))
        both.append(model.keep_momentum(shown, next))
    if elastic and moved == 0:
        raise ValueError("the rule `elastic`: found no frame in which it moves jelly, expected some")
    position, velocity = zip(*both)
    return torch.stack(position).unsqueeze(1), torch.stack(velocity).unsqueeze(1)


def main() -> None:
    [eddy] = sys.argv[1:]
    torch.manual_seed(1)
    apart: list[float] = []  # relative to what is allowed
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        simulate = [eddy, "--quiet", "simulate", "--scenes", "3", "--duration", "0.5"]
        subprocess.run([*simulate, "--seed", "6", "--output", work / "truth"], check=True)
        subprocess.run([*simulate, "--preset", "kinds", "--seed", "3", "--output", work / "kinds"], check=True)
        # Liquid and snow, in free flight for some frames; two bodies of jelly, which meet in the end.
        bags = dict.fromkeys(OPTIONS, work / "truth" / "scene_0000") | {"elastic": work / "kinds" / "scene_0002"}
        particles = len(frames(bags["-"], "/particles", typestore())[0].material)
        for option, keys in OPTIONS.items():
            training = {
                "epochs": 1,
                "unroll": [{"share": 1.0, "frames": 2}],
                "network": SIZES | {"channels": SURROUNDINGS["channels"]} | ({} if option == "elastic" else keys),
                "elastic_modulus": ELASTIC["modulus"] if option == "elastic" else 0.0,
                "windows": {"per_epoch": 64},
                "validation": {"horizon": 4},
            }
            (work / f"{option}.toml").write_text(tomli_w.dumps(training))
        own = {
            "frame": {"sizes": SIZES | {"particles": particles}},
            "particle": {"sizes": SIZES, "surroundings": SURROUNDINGS},
        }
        print("model    core     option    by PyTorch  by eddy")
        rows = [*itertools.product(own, CORES, ["-"]), *(("particle", "mingru", option) for option in OPTIONS if option != "-")]
        for architecture, core, option in rows:
            name = f"{architecture}_{core}_{option}"
            written = work / f"{name}_torch"
            description = describe(core, architecture=architecture, **own[architecture], **OPTIONS[option])
            scale = description["normalization"]
            scale["minimum"][2:], scale["maximum"][2:] = [-FASTEST] * 2, [FASTEST] * 2
            knots = len(description.get("stiffness_knots", []))
            save([network(description) for _ in range(knots)] or network(description), description, written)
            trained = work / f"{name}_eddy"
            train = ["--architecture", architecture, "--core", core, "--config", work / f"{option}.toml"]
            train += ["--data", work / "truth", "--output", trained]
            subprocess.run([eddy, "--quiet", "train", *train], check=True)
            both = [
                difference(eddy, load(written, STIFFNESS), written, bags[option], work),
                difference(eddy, load(trained, STIFFNESS), trained, bags[option], work),
            ]
            print(f"{architecture:8} {core:8} {option:9} {both[0]:10.1e} {both[1]:8.1e}", flush=True)
            apart += [number / (NEAR_ELASTIC if option == "elastic" else NEAR) for number in both]
    raise SystemExit(0 if max(apart) <= 1 else 1)


if __name__ == "__main__":
    main()
