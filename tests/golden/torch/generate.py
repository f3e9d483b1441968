"""Writes the golden data beside this script: what PyTorch computes in float64 with small frame models.

    pip install -r tests/peers/requirements-bench.txt
    python tests/golden/torch/generate.py

Each row of `ROWS` becomes `NAME.safetensors`. Its metadata `row` is JSON with `description` (the network,
as `model.toml` describes it) and `training` (what is minimised, and the clip), its tensors are

    weight.*                     initial weights, every one an f32
    input.position, .velocity    [T, B, N, 2], warm-up and future
    input.material               [B, N]
    forward.position, .velocity  the frame predicted after each of the T frames, [T, B, N, 2]
    unroll.position, .velocity   the future, predicted from the warm-up alone, [K, B, N, 2]
    loss                         [1]
    gradient.*                   of that loss
    change.*                     of the weights by ten steps of Adam on that loss

all computed in float64 and stored as f32 (loss: f64). In `checkpoints/CORE/` PyTorch wrote a checkpoint,
with `frames.safetensors`: the frames it was shown, [T, N, 2], and what it predicted after each of them.
`VERSIONS` says what computed.
"""

import json
import platform
import sys
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[1] / "peers"))
from torch_model import MATERIALS, Bodies, FrameModel, describe, save  # noqa: E402

FRAMES, WINDOWS, PARTICLES = 5, 3, 12
SIZES = {"encoder": 7, "hidden": 6, "layers": 2, "particles": PARTICLES}
# A whole pack of SIMD lanes, and one over.
WIDE = {"encoder": 33, "hidden": 17, "layers": 1, "particles": PARTICLES}
STEPS, LEARNING_RATE, EPSILON = 10, 1e-3, 1e-8

TEACHER = {"warm_up": 4, "observed_weight": 1.0, "clip": None}
UNROLL = {"warm_up": 3, "observed_weight": 0.5, "clip": 3e-4}
CORES = ("mlp", "lstm", "gru", "minlstm", "mingru")

# Name, core, what differs from the defaults, what is minimised.
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
]


def particles(frames: int, windows: int) -> tuple[Bodies, Tensor]:
    """Particles that fly nearly straight, and their materials."""
    push = 0.1 * torch.randn(frames, windows, PARTICLES, 2)
    push[0] = 2 * torch.rand(windows, PARTICLES, 2) - 1
    velocity = push.cumsum(0)
    start = 0.3 + 0.4 * torch.rand(windows, PARTICLES, 2)
    return (start + 0.016 * velocity.cumsum(0), velocity), torch.randint(len(MATERIALS), (windows, PARTICLES))


def unroll(model: FrameModel, observed: Bodies, kind: Tensor, frames: int) -> tuple[Bodies, Bodies]:
    """Predicts `frames` frames from its own output, and each frame after an observed one."""
    steps, state = model(observed, kind)
    future = [tuple(track[-1:] for track in steps)]
    while len(future) < frames:
        predicted, state = model(future[-1], kind, state)
        future.append(predicted)
    position, velocity = (torch.cat(track) for track in zip(*future))
    return (position, velocity), steps


def mean_squared_error(found: Bodies, truth: Bodies, unit: Tensor) -> Tensor:
    """Of positions and velocities in units of the features' ranges (the paper's eq. 2)."""
    return ((torch.cat(found, -1) - torch.cat(truth, -1)) / unit).square().mean()


def objective(
    model: FrameModel, bodies: Bodies, kind: Tensor, unit: Tensor, training: dict[str, Any]
) -> tuple[Tensor, Bodies]:
    """The loss of a free unroll and of the one-step predictions in the warm-up; the unroll."""
    warm_up = training["warm_up"]
    position, velocity = bodies
    observed, future = (position[:warm_up], velocity[:warm_up]), (position[warm_up:], velocity[warm_up:])
    predicted, (steps_position, steps_velocity) = unroll(model, observed, kind, FRAMES - warm_up)
    known = mean_squared_error(
        (steps_position[:-1], steps_velocity[:-1]), (observed[0][1:], observed[1][1:]), unit
    )
    return mean_squared_error(predicted, future, unit) + training["observed_weight"] * known, predicted


def golden(description: dict[str, Any], training: dict[str, Any]) -> dict[str, Tensor]:
    """The tensors of a row."""
    model = FrameModel(description).double()
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    bodies, material = particles(FRAMES, WINDOWS)
    scale = description["normalization"]
    kind = model.kind(material)
    unit = torch.tensor(scale["maximum"]).double() - torch.tensor(scale["minimum"]).double()

    forward, _ = model(bodies, kind)
    loss, predicted = objective(model, bodies, kind, unit, training)
    loss.backward()
    gradients = {name: tensor.grad.clone() for name, tensor in model.named_parameters()}

    adam = torch.optim.Adam(model.parameters(), LEARNING_RATE, eps=EPSILON)
    for _ in range(STEPS):
        adam.zero_grad()
        objective(model, bodies, kind, unit, training)[0].backward()
        if training["clip"] is not None:
            for tensor in model.parameters():  # each on its own
                tensor.grad *= (training["clip"] / tensor.grad.norm()).clamp(max=1)
        adam.step()

    data = {"loss": loss.reshape(1), "input.material": material.byte()}
    for name, (position, velocity) in {"input": bodies, "forward": forward, "unroll": predicted}.items():
        data |= {f"{name}.position": position.float(), f"{name}.velocity": velocity.float()}
    data |= {f"weight.{name}": tensor.float() for name, tensor in before.items()}
    data |= {f"gradient.{name}": tensor.float() for name, tensor in gradients.items()}
    data |= {f"change.{name}": (tensor - before[name]).float() for name, tensor in model.state_dict().items()}
    return {name: tensor.detach().contiguous() for name, tensor in data.items()}


def checkpoint(core: str) -> None:
    """A checkpoint, eight frames it was shown, and what it predicted after each of them."""
    directory = HERE / "checkpoints" / core
    description = describe(core, SIZES)
    model = FrameModel(description)
    save(model, description, directory)
    bodies, material = particles(8, 1)
    with torch.no_grad():
        predicted, _ = model.double()(bodies, model.kind(material))
    data = {"input.material": material[0].byte()}
    for name, (position, velocity) in {"input": bodies, "prediction": predicted}.items():
        data |= {f"{name}.position": position[:, 0].float(), f"{name}.velocity": velocity[:, 0].float()}
    save_file({name: tensor.contiguous() for name, tensor in data.items()}, directory / "frames.safetensors")


def main() -> None:
    torch.manual_seed(1)
    torch.use_deterministic_algorithms(True)
    for name, core, changes, training in ROWS:
        description = describe(core, warm_up=training["warm_up"], **{"sizes": SIZES} | changes)
        row = json.dumps({"description": description, "training": training})
        save_file(golden(description, training), HERE / f"{name}.safetensors", {"row": row})
    for core in CORES:
        checkpoint(core)
    found = {"python": platform.python_version(), "torch": torch.__version__, "machine": platform.machine()}
    (HERE / "VERSIONS").write_text("".join(f"{name} {version}\n" for name, version in found.items()))


if __name__ == "__main__":
    main()
