"""The frame model (the paper's Table 1) in PyTorch, with eddy's names for its tensors.

A model is described by what is in `model.toml`. Its `state_dict` has the names and shapes of
`model.safetensors`, so that checkpoints go either way: `load` and `save`. Letters in shapes: T frames,
B windows, N particles, F features, E encoder width, H hidden width. There is no dropout: every
comparison runs without.
"""

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tomli_w
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional

MATERIALS = ("liquid", "snow", "jelly", "rope")
ACTIVATIONS = {"sigmoid": torch.sigmoid, "tanh": torch.tanh, "relu": functional.relu, "elu": functional.elu}

# What is carried from frame to frame: [layers, B, H], or such a pair for an LSTM.
State = Tensor | tuple[Tensor, Tensor] | None
# Positions and velocities, [T, B, N, 2] each.
Bodies = tuple[Tensor, Tensor]


def recurrence(step: Callable[..., Tensor], carried: Tensor | None, *tracks: Tensor) -> Tensor:
    """Every state h_t = step(h_{t-1}, each track at t), [T, B, H], from zero if none is carried.

    The plain loop: for T = 16 and more, doubling and the scan in logarithms took several times as long
    on two cores (B = 16, H = 1250, forward and backward), and at T = 2 they are no faster.
    """
    hidden = torch.zeros_like(tracks[0][0]) if carried is None else carried
    states = []
    for frame in zip(*(track.unbind() for track in tracks)):
        hidden = step(hidden, *frame)
        states.append(hidden)
    return torch.stack(states)


def positive(candidate: Tensor) -> Tensor:
    """g(c) of the log form: c + 1/2 for c >= 0, sigmoid(c) below (Feng et al. 2024, appendix B)."""
    return torch.where(candidate >= 0, candidate + 0.5, torch.sigmoid(candidate))


class MinGRU(nn.Module):
    """One layer: z = sigmoid(W_z x), c = W_h x, h_t = (1 - z) h_{t-1} + z c."""

    def __init__(self, inputs: int, hidden: int, log_form: bool) -> None:
        super().__init__()
        self.gate = nn.Linear(inputs, hidden)
        self.candidate = nn.Linear(inputs, hidden)
        self.log_form = log_form

    def forward(self, signal: Tensor, carried: Tensor | None = None) -> Tensor:
        update = torch.sigmoid(self.gate(signal))
        candidate = self.candidate(signal)
        if self.log_form:
            candidate = positive(candidate)
        return recurrence(torch.lerp, carried, candidate, update)


class MinLSTM(nn.Module):
    """One layer: f and i from sigmoids, normalised to f + i = 1 if asked, h_t = f h_{t-1} + i c."""

    def __init__(self, inputs: int, hidden: int, log_form: bool, normalize_gates: bool) -> None:
        super().__init__()
        self.forget_gate = nn.Linear(inputs, hidden)
        self.input_gate = nn.Linear(inputs, hidden)
        self.candidate = nn.Linear(inputs, hidden)
        self.log_form, self.normalize_gates = log_form, normalize_gates

    def forward(self, signal: Tensor, carried: Tensor | None = None) -> Tensor:
        forget = torch.sigmoid(self.forget_gate(signal))
        update = torch.sigmoid(self.input_gate(signal))
        candidate = self.candidate(signal)
        if self.log_form:
            candidate = positive(candidate)
        if self.normalize_gates:
            return recurrence(torch.lerp, carried, candidate, update / (forget + update))
        entering = update * candidate
        return recurrence(lambda hidden, f, e: torch.addcmul(e, f, hidden), carried, forget, entering)


class MinimalCore(nn.ModuleList):
    """Layers of a minimal recurrence, called as `nn.GRU` is."""

    def forward(self, signal: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        last = []
        for layer, carried in zip(self, [None] * len(self) if state is None else state):
            signal = layer(signal, carried)
            last.append(signal[-1])
        return signal, torch.stack(last)


class MLP(nn.Module):
    """One layer of the core without recurrence."""

    def __init__(self, inputs: int, hidden: int, activation: str) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, hidden)
        self.activation = ACTIVATIONS[activation]

    def forward(self, signal: Tensor) -> Tensor:
        return self.activation(self.linear(signal))


class MLPCore(nn.ModuleList):
    """Layers without recurrence, called as `nn.GRU` is; nothing is carried."""

    def forward(self, signal: Tensor, _: None = None) -> tuple[Tensor, None]:
        for layer in self:
            signal = layer(signal)
        return signal, None


def core(description: dict[str, Any], inputs: int) -> nn.Module:
    """The described core: [T, B, inputs] and a state to [T, B, H] and the state after it."""
    hidden, layers = description["sizes"]["hidden"], description["sizes"]["layers"]
    widths = [inputs] + [hidden] * (layers - 1)
    log_form = description["form"] == "log"
    match description["core"]:
        case "mlp":
            activation = options(description)["activation"]
            return MLPCore(MLP(width, hidden, activation) for width in widths)
        case "lstm":
            return nn.LSTM(inputs, hidden, layers)
        case "gru":
            return nn.GRU(inputs, hidden, layers)
        case "minlstm":
            normalize = description.get("normalize_gates", True)
            return MinimalCore(MinLSTM(width, hidden, log_form, normalize) for width in widths)
        case "mingru":
            return MinimalCore(MinGRU(width, hidden, log_form) for width in widths)
        case unknown:
            raise ValueError(f"core: found {unknown}")


def options(description: dict[str, Any]) -> dict[str, str]:
    """The frame model's choices, with the defaults that `model.toml` leaves out."""
    defaults = {"pooling": "mean", "activation": "elu", "material": "one-hot", "scaling": "min-max"}
    return defaults | description.get("frame", {})


class FrameModel(nn.Module):
    """Predicts the frame after each of T frames."""

    def __init__(self, description: dict[str, Any]) -> None:
        super().__init__()
        sizes = description["sizes"]
        chosen = options(description)
        self.particles, self.dt = sizes["particles"], description["dt"]
        self.pooling, self.one_hot = chosen["pooling"], chosen["material"] == "one-hot"
        self.activation = ACTIVATIONS[chosen["activation"]]
        features, width, hidden = 4 + (len(MATERIALS) if self.one_hot else 1), sizes["encoder"], sizes["hidden"]

        self.encoder = nn.ModuleList([nn.Linear(features, width), nn.Linear(width, hidden)])
        self.core = core(description, 2 * hidden if self.pooling == "mean+max" else hidden)
        self.mixer = nn.Linear(hidden, hidden)
        self.decoder = nn.Linear(hidden, 2 * self.particles)

        scale = {name: torch.tensor(values) for name, values in description["normalization"].items()}
        if chosen["scaling"] == "min-max":
            offset, unit = scale["minimum"], scale["maximum"] - scale["minimum"]
        else:
            offset, unit = scale["mean"], scale["standard_deviation"]
        self.register_buffer("offset", offset, persistent=False)
        self.register_buffer("unit", unit, persistent=False)

    def kind(self, material: Tensor) -> Tensor:
        """Materials [B, N], numbers as in `MATERIALS`, as features [B, N, F - 4]."""
        if self.one_hot:
            return functional.one_hot(material, len(MATERIALS)).float()
        return material.unsqueeze(-1) / (len(MATERIALS) - 1)

    def forward(self, bodies: Bodies, kind: Tensor, state: State = None) -> tuple[Bodies, State]:
        """The frame after each of T frames, and the state after the last; `kind` is from `kind()`."""
        position, velocity = bodies
        signal, state = self.core(self.encode(position, velocity, kind), state)
        change = self.decoder(self.activation(self.mixer(signal)))  # [T, B, 2 N]
        velocity = velocity + change.unflatten(-1, (self.particles, 2))
        return (position + velocity * self.dt, velocity), state

    def encode(self, position: Tensor, velocity: Tensor, kind: Tensor) -> Tensor:
        """[T, B, H], or [T, B, 2 H] with both poolings."""
        scaled = (torch.cat([position, velocity], -1) - self.offset) / self.unit
        features = torch.cat([scaled, kind.expand(len(scaled), -1, -1, -1)], -1)  # [T, B, N, F]
        points = self.activation(self.encoder[0](features))  # [T, B, N, E]
        pooled = []
        if "mean" in self.pooling:  # commutes with the second layer
            pooled.append(self.encoder[1](points.mean(2)))
        if "max" in self.pooling:
            pooled.append(self.encoder[1](points).amax(2))
        return torch.cat(pooled, -1)


def load(directory: Path) -> FrameModel:
    """The network of a checkpoint; every tensor must be there, and no other."""
    model = FrameModel(tomllib.loads((directory / "model.toml").read_text()))
    model.load_state_dict(load_file(directory / "model.safetensors"), strict=True)
    return model


def save(model: FrameModel, description: dict[str, Any], directory: Path) -> None:
    """Writes a checkpoint."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "model.toml").write_text(tomli_w.dumps(description))
    save_file({name: tensor.float() for name, tensor in model.state_dict().items()}, directory / "model.safetensors")


def describe(core: str, sizes: dict[str, int], **changes: Any) -> dict[str, Any]:
    """A description with eddy's defaults, as if trained on particles anywhere in the unit square."""
    return {
        "format_version": 1,
        "architecture": "frame",
        "core": core,
        "form": "plain",
        "normalize_gates": True,
        "dt": 0.016,
        "warm_up": 2,
        "gravity": [0.0, -9.8],
        "materials": list(MATERIALS),
        "data": "none",
        "sizes": sizes,
        "domain": {"lower": [0.0, 0.0], "upper": [1.0, 1.0]},
        "normalization": {
            "minimum": [0.05, 0.05, -3.0, -4.0],
            "maximum": [0.95, 0.95, 3.0, 3.0],
            "mean": [0.5, 0.3, 0.1, -0.5],
            "standard_deviation": [0.2, 0.2, 0.7, 0.9],
        },
        "training": {
            "command": "PyTorch",
            "seed": 0,
            "epochs": 0,
            "best_epoch": 0,
            "training_loss": 0.0,
            "validation_loss": 0.0,
            "samples": 0,
        },
    } | changes
