"""Exchange checkpoints between eddy and PyTorch in both directions.

    pip install -r tests/peers/requirements-bench.txt
    cargo build --release
    python tests/peers/torch_exchange.py target/release/eddy

For both architectures and every core, for particle models that are conditioned on the stiffness, without and with weights for
several stiffnesses, for one with weights of 16 bits, and for one with elastic impulses of jelly, a checkpoint written by PyTorch, and one trained by `eddy train` and loaded into PyTorch
with `strict=True`, each predict a bag with `eddy predict` and in PyTorch. A table shows the largest
difference relative to the largest value; exits with 1 if one exceeds 1e-5 (1e-3 with elastic impulses, which
enlarge the rounding of f32).
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

from torch_core import Bodies
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
    "wall_stiffness": 1.0, "rebound": 0.8, "contact_distance": 3.5, "contact_stiffness": 0.2, "contact_viscosity": 4.0,
}  # fmt: skip
# Keys of a network's description and of its training.
OPTIONS = {
    "-": {},
    "stiffness": {"stiffness": True},
    "knots": {"stiffness": True, "stiffness_knots": [1e2, 3e3, 1e5]},
    "f16": {"weights": "f16"},
    "elastic": {"elastic": ELASTIC},
}
# Settings of a training that say the same, where they have another key.
SETTINGS = {"elastic": {"elastic_modulus": 300.0}}
NEAR = 1e-5
# A position's rounding gives jelly, whose impulses PyTorch computes in f64, up to 1e-4 domain lengths per second; contact, whose viscosity is
# not far below what is stable, magnifies that.
NEAR_ELASTIC = 1e-3
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
    """Apply the rules to the network's predictions, [T, 1, N, 2]: liquids keep their area, solids their shape, bodies in free
    flight their momentum and angular momentum."""
    rest = bodies[0][0]
    neighbours = rest_neighbours(rest, material, model.spacing)[:2]
    matter = tuple(part[0] for part in (rest_shape(rest, material, model.spacing), *neighbours))
    both = []
    for shown, next in zip(zip(*(track[:, 0] for track in bodies)), zip(*(track[:, 0] for track in predicted))):
        next = model.keep_shape(matter, model.keep_area(material[0], next))
        both.append(model.keep_momentum(shown, next))
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
        # Liquid and snow, in free flight for some frames; two bodies of jelly, which meet.
        bags = dict.fromkeys(OPTIONS, work / "truth" / "scene_0000") | {"elastic": work / "kinds" / "scene_0002"}
        particles = len(frames(bags["-"], "/particles", typestore())[0].material)
        for option, keys in OPTIONS.items():
            training = {
                "epochs": 1,
                "unroll": [{"share": 1.0, "frames": 2}],
                "network": SIZES | {"channels": SURROUNDINGS["channels"]} | SETTINGS.get(option, keys),
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
