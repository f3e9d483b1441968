"""Write the golden data next to this script: results of small models, computed by PyTorch in float64.

    pip install -r tests/peers/requirements-bench.txt
    python tests/golden/torch/generate.py

Each row of `ROWS` and `PARTICLE_ROWS` becomes `NAME.safetensors`. Its metadata `row` is JSON with `description` (the network
as in `model.toml`) and `training` (the loss, the gradient clip, and the frames after which gradients through time are cut).
Its tensors are

    weight.*                     initial weights, exactly representable as f32
    input.position, .velocity    [T, B, N, 2], warm-up and future; the first frame is the rest shape
    input.material               [B, N]
    input.stiffness              [B], of a network that is conditioned on it
    forward.position, .velocity  prediction after each of the T frames, [T, B, N, 2]
    unroll.position, .velocity   free rollout from the warm-up, [K, B, N, 2]
    loss                         [1]
    gradient.*                   gradients of the loss
    change.*                     change of the weights after ten steps of Adam

all computed in float64 and stored as f32 (loss: f64). `checkpoints/NAME/` contains a checkpoint written by PyTorch
and `frames.safetensors`: input frames, [T, N, 2], and the prediction after each of them. `muon/steps.safetensors`
contains gradients of matrices, `gradient.NAME`, [steps, out, in], and how far torch.optim.Muon has moved these after each
step, `change.NAME`, with float64 in place of the bfloat16 in its iteration. `VERSIONS` lists the versions used.
"""

import inspect
import json
import platform
import sys
import zlib
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.optim import _muon

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[1] / "peers"))
from torch_core import MATERIALS, Bodies  # noqa: E402
from torch_model import Model, describe, load, network, save  # noqa: E402

FRAMES, WINDOWS, PARTICLES = 5, 3, 12
SIZES = {"encoder": 7, "hidden": 6, "layers": 2, "particles": PARTICLES}
# One more than a multiple of the SIMD width.
WIDE = {"encoder": 33, "hidden": 17, "layers": 1, "particles": PARTICLES}
STEPS, LEARNING_RATE, EPSILON = 10, 1e-3, 1e-8
MUON_STEPS = 3

TEACHER = {"warm_up": 4, "observed_weight": 1.0, "clip": None}
UNROLL = {"warm_up": 3, "observed_weight": 0.5, "clip": 3e-4}
TRUNCATED = UNROLL | {"truncation": 1}
CORES = ("mlp", "lstm", "gru", "minlstm", "mingru")

# Name, core, differences from the defaults, loss.
ROWS: list[tuple[str, str, dict[str, Any], dict[str, Any]]] = [
    *((f"{core}_teacher", core, {}, TEACHER) for core in CORES),
    *((f"{core}_unroll", core, {"sizes": WIDE}, UNROLL) for core in CORES),
    ("mingru_log", "mingru", {"form": "log"}, UNROLL),
    ("minlstm_log", "minlstm", {"form": "log"}, UNROLL),
    ("minlstm_unnormalized", "minlstm", {"normalize_gates": False}, UNROLL),
    ("minlstm_log_unnormalized", "minlstm", {"form": "log", "normalize_gates": False}, UNROLL),
    ("mingru_max", "mingru", {"frame": {"pooling": "max"}}, UNROLL),
    ("mingru_mean_max", "mingru", {"frame": {"pooling": "mean+max"}}, UNROLL),
    ("lstm_mean_max", "lstm", {"frame": {"pooling": "mean+max"}}, UNROLL),
    ("mlp_sigmoid", "mlp", {"frame": {"activation": "sigmoid"}}, UNROLL),
    ("mlp_tanh", "mlp", {"frame": {"activation": "tanh"}}, UNROLL),
    ("mlp_relu", "mlp", {"frame": {"activation": "relu"}}, UNROLL),
    ("mingru_scalar", "mingru", {"frame": {"material": "scalar"}}, UNROLL),
    ("mingru_z_score", "mingru", {"frame": {"scaling": "z-score"}}, UNROLL),
    ("mingru_residual", "mingru", {"frame": {"output": "residual"}}, UNROLL),
    ("mingru_position", "mingru", {"frame": {"output": "position"}}, UNROLL),
    ("lstm_truncated", "lstm", {}, TRUNCATED),
]

# Cells and spacing large enough for a few particles to fill the grid.
SURROUNDINGS = {"cell_width": 0.125, "channels": [3, 4, 5], "spacing": 0.0625}
# A scene's bodies: columns and rows, distance between particles (spacings), lower left corner, velocity. The jelly is
# so dense that not every particle in range is a neighbour, the thread so thin that none is.
BODIES = {
    "jelly": ((4, 4), 0.8, (0.2, 0.5), (1.0, -0.5)),
    "rope": ((4, 2), 1.0, (0.3, 0.07), (0.2, -1.0)),
    "thread": ((4, 1), 1.0, (0.06, 0.3), (-0.5, 0.5)),
}
DROPS, FLAKES = 3, 2
SCENE = torch.tensor([2] * 16 + [3] * 12 + [0] * DROPS + [1] * FLAKES)  # materials
# With PyTorch's initial weights, signals shrink in so many ReLU layers until gradients are smaller than Adam's
# epsilon.
GAIN = 2.0

# Stiffness of each window, for a network that is conditioned on it; the second one is beyond the limit.
STIFFNESSES = (1e3, 5e6)


def surroundings(**changes: Any) -> dict[str, Any]:
    return {"surroundings": SURROUNDINGS | changes}


# Rows of the particle model.
PARTICLE_ROWS: list[tuple[str, str, dict[str, Any], dict[str, Any]]] = [
    *((f"particle_{core}", core, {}, UNROLL) for core in CORES),
    ("particle_two_levels", "mingru", surroundings(channels=[3, 4]), UNROLL),
    ("particle_four_levels", "mingru", surroundings(channels=[3, 4, 5, 6], cell_width=0.0625), UNROLL),
    ("particle_stiffness", "mingru", {"stiffness": True}, UNROLL),
    ("particle_truncated", "lstm", {}, TRUNCATED),
]


def particles(frames: int, windows: int) -> tuple[Bodies, Tensor]:
    """Particles that move almost in straight lines, and their materials."""
    push = 0.1 * torch.randn(frames, windows, PARTICLES, 2)
    push[0] = 2 * torch.rand(windows, PARTICLES, 2) - 1
    velocity = push.cumsum(0)
    start = 0.3 + 0.4 * torch.rand(windows, PARTICLES, 2)
    return (start + 0.016 * velocity.cumsum(0), velocity), torch.randint(len(MATERIALS), (windows, PARTICLES))


def body(shape: tuple[int, int], apart: float, corner: tuple[float, float], flies: tuple[float, float]) -> Bodies:
    """The particles of a flying, rotating body, [N, 2] each, slightly disordered."""
    step = apart * SURROUNDINGS["spacing"]
    places = step * torch.cartesian_prod(*(torch.arange(count) for count in shape)) + torch.tensor(corner)
    places += 0.2 * step * (torch.rand(places.shape) - 0.5)
    across = (places - places.mean(0)).flip(1) * torch.tensor([-1.0, 1.0])
    return places, torch.tensor(flies) + 3 * across


def scene(frames: int, windows: int) -> tuple[Bodies, Tensor]:
    """A flying jelly, a rope on the floor, a thread at a wall, drops in a corner, and single flakes."""
    places, thrown = [], []
    for _ in range(windows):
        bodies = [body(*row) for row in BODIES.values()]
        loose = torch.cat([0.94 - 0.1 * torch.rand(DROPS, 2), 0.5 + 0.3 * torch.rand(FLAKES, 2)])
        bodies.append((loose, torch.rand(loose.shape)))
        for track, parts in zip((places, thrown), zip(*bodies)):
            track.append(torch.cat(parts))
    push = 0.2 * torch.randn(frames, windows, len(SCENE), 2)
    push[0] = torch.stack(thrown)
    velocity = push.cumsum(0)
    position = torch.stack(places) + 0.016 * velocity.cumsum(0)
    return (position.clamp(0.051, 0.949), velocity), SCENE.expand(windows, -1)


def detached(values: Any) -> Any:
    """The same tensors, which may be in lists and tuples, without gradients."""
    if values is None:
        return None
    if isinstance(values, Tensor):
        return values.detach()
    return type(values)(detached(value) for value in values)


def unroll(model: Model, observed: Bodies, matter: Any, frames: int, truncation: int = 0) -> tuple[Bodies, Bodies]:
    """Predict `frames` frames in a free rollout, and one frame after each observed one; no gradient goes back beyond every
    `truncation` free frames, unless that is 0."""
    steps, state = model(observed, matter)
    future = [tuple(track[-1:] for track in steps)]
    while len(future) < frames:
        last = future[-1]
        if truncation and len(future) % truncation == 0:
            last, state = detached((last, state))
        predicted, state = model(last, matter, state)
        future.append(predicted)
    position, velocity = (torch.cat(track) for track in zip(*future))
    return (position, velocity), steps


def mean_squared_error(found: Bodies, truth: Bodies, unit: Tensor) -> Tensor:
    """Mean squared error of positions and velocities, scaled by the features' ranges (the paper's eq. 2)."""
    return ((torch.cat(found, -1) - torch.cat(truth, -1)) / unit).square().mean()


def objective(
    model: Model, bodies: Bodies, matter: Any, unit: Tensor, training: dict[str, Any]
) -> tuple[Tensor, Bodies]:
    """The loss of a free rollout and of the one-step predictions in the warm-up; also returns the rollout."""
    warm_up = training["warm_up"]
    position, velocity = bodies
    observed, future = (position[:warm_up], velocity[:warm_up]), (position[warm_up:], velocity[warm_up:])
    predicted, (steps_position, steps_velocity) = unroll(
        model, observed, matter, FRAMES - warm_up, training.get("truncation", 0)
    )
    known = mean_squared_error(
        (steps_position[:-1], steps_velocity[:-1]), (observed[0][1:], observed[1][1:]), unit
    )
    return mean_squared_error(predicted, future, unit) + training["observed_weight"] * known, predicted


def golden(description: dict[str, Any], training: dict[str, Any]) -> dict[str, Tensor]:
    """The tensors of a row."""
    model = network(description).double()
    if description["architecture"] == "particle":
        for tensor in model.parameters():
            tensor.data *= GAIN if tensor.dim() == 2 else 1
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    make, windows = (particles, WINDOWS) if description["architecture"] == "frame" else (scene, 2)
    bodies, material = make(FRAMES, windows)
    scale = description["normalization"]
    conditioned = {"stiffness": torch.tensor(STIFFNESSES)} if description.get("stiffness") else {}
    matter = model.matter(material, bodies[0][0], **conditioned)
    unit = torch.tensor(scale["maximum"]).double() - torch.tensor(scale["minimum"]).double()

    forward, _ = model(bodies, matter)
    loss, predicted = objective(model, bodies, matter, unit, training)
    loss.backward()
    gradients = {name: tensor.grad.clone() for name, tensor in model.named_parameters()}

    adam = torch.optim.Adam(model.parameters(), LEARNING_RATE, eps=EPSILON)
    for _ in range(STEPS):
        adam.zero_grad()
        objective(model, bodies, matter, unit, training)[0].backward()
        if training["clip"] is not None:
            for tensor in model.parameters():  # clip each tensor separately
                tensor.grad *= (training["clip"] / tensor.grad.norm()).clamp(max=1)
        adam.step()

    data = {"loss": loss.reshape(1), "input.material": material.byte()}
    data |= {f"input.{name}": values for name, values in conditioned.items()}
    for name, (position, velocity) in {"input": bodies, "forward": forward, "unroll": predicted}.items():
        data |= {f"{name}.position": position.float(), f"{name}.velocity": velocity.float()}
    data |= {f"weight.{name}": tensor.float() for name, tensor in before.items()}
    data |= {f"gradient.{name}": tensor.float() for name, tensor in gradients.items()}
    data |= {f"change.{name}": (tensor - before[name]).float() for name, tensor in model.state_dict().items()}
    return {name: tensor.detach().contiguous() for name, tensor in data.items()}


def checkpoint(name: str, core: str, **changes: Any) -> None:
    """Write a checkpoint with eight input frames and the prediction after each of them."""
    directory = HERE / "checkpoints" / name
    torch.manual_seed(zlib.crc32(name.encode()))
    description = describe(core, SIZES, **changes)
    save(network(description), description, directory)
    bodies, material = particles(8, 1)
    # With the weights of the file, which may be rounded.
    model = load(directory)
    with torch.no_grad():
        predicted, _ = model.double()(bodies, model.matter(material))
    data = {"input.material": material[0].byte()}
    for name, (position, velocity) in {"input": bodies, "prediction": predicted}.items():
        data |= {f"{name}.position": position[:, 0].float(), f"{name}.velocity": velocity[:, 0].float()}
    save_file({name: tensor.contiguous() for name, tensor in data.items()}, directory / "frames.safetensors")


def muon() -> None:
    """Write the changes of matrices by steps of Muon, the size of whose steps is that of Adam's."""
    torch.manual_seed(zlib.crc32(b"muon"))
    iteration = inspect.getsource(_muon._zeropower_via_newtonschulz)
    exec(iteration.replace("torch.bfloat16", "torch.float64"), vars(_muon))
    data = {}
    for name, shape in {"tall": (24, 10), "wide": (7, 40), "square": (12, 12)}.items():
        # Singular values from 1 to .01.
        left, _, right = torch.linalg.svd(torch.randn(MUON_STEPS, *shape).double(), full_matrices=False)
        gradients = (left * torch.logspace(0, -2, min(shape)) @ right).float()
        matrix = torch.nn.Parameter(torch.zeros(shape).double())
        optimizer = torch.optim.Muon([matrix], LEARNING_RATE, weight_decay=0, adjust_lr_fn="match_rms_adamw")
        changes = []
        for gradient in gradients:
            matrix.grad = gradient.double()
            optimizer.step()
            changes.append(matrix.detach().float())
        data |= {f"gradient.{name}": gradients.contiguous(), f"change.{name}": torch.stack(changes)}
    (HERE / "muon").mkdir(exist_ok=True)
    save_file(data, HERE / "muon" / "steps.safetensors")


def write(rows: list[tuple[str, str, dict[str, Any], dict[str, Any]]], defaults: dict[str, Any]) -> None:
    """Write the files of some rows."""
    for name, core, changes, training in rows:
        # A new row does not change the others.
        torch.manual_seed(zlib.crc32(name.encode()))
        description = describe(core, warm_up=training["warm_up"], **defaults | changes)
        row = json.dumps({"description": description, "training": training})
        save_file(golden(description, training), HERE / f"{name}.safetensors", {"row": row})


def main() -> None:
    torch.use_deterministic_algorithms(True)
    write(ROWS, {"sizes": SIZES})
    for core in CORES:
        checkpoint(core, core)
    checkpoint("mingru_f16", "mingru", weights="f16")
    muon()
    sizes = {name: size for name, size in SIZES.items() if name != "particles"}
    write(PARTICLE_ROWS, {"architecture": "particle", "sizes": sizes, "surroundings": SURROUNDINGS})
    found = {"python": platform.python_version(), "torch": torch.__version__, "machine": platform.machine()}
    (HERE / "VERSIONS").write_text("".join(f"{name} {version}\n" for name, version in found.items()))


if __name__ == "__main__":
    main()
