"""The recurrent cores in PyTorch, with eddy's tensor names; shared by both models and by the benchmarks.

Letters in shapes: T frames, B windows, N particles, E encoder width, H hidden width. Dropout is not
implemented: no comparison uses it.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

MATERIALS = ("liquid", "snow", "jelly", "rope")
# Materials that a network has inputs for, unless its description says otherwise.
MATERIAL_INPUTS = 4
ACTIVATIONS = {"sigmoid": torch.sigmoid, "tanh": torch.tanh, "relu": functional.relu, "elu": functional.elu}

# Hidden state carried from frame to frame: [layers, R, H], or a pair of these for an LSTM.
State = Tensor | tuple[Tensor, Tensor] | None
# Positions and velocities, [T, B, N, 2] each.
Bodies = tuple[Tensor, Tensor]


def recurrence(step: Callable[..., Tensor], carried: Tensor | None, *tracks: Tensor) -> Tensor:
    """All states h_t = step(h_{t-1}, each track at t), [T, B, H], starting from zero if no state is carried.

    A plain loop: for T = 16 and more, recursive doubling and the scan in log space took several times as long
    on two cores (B = 16, H = 1250, forward and backward), and at T = 2 they are no faster.
    """
    hidden = torch.zeros_like(tracks[0][0]) if carried is None else carried
    states = []
    for frame in zip(*(track.unbind() for track in tracks)):
        hidden = step(hidden, *frame)
        states.append(hidden)
    return torch.stack(states)


def entering(candidate: Tensor, log_form: bool) -> Tensor:
    """c, or g(c) of the log form: c + 1/2 for c >= 0, sigmoid(c) below (Feng et al. 2024, appendix B)."""
    return torch.where(candidate >= 0, candidate + 0.5, torch.sigmoid(candidate)) if log_form else candidate


def mingru(gate: Tensor, candidate: Tensor, log_form: bool = False) -> tuple[Tensor, Tensor]:
    """c and z of h_t = (1 - z) h_{t-1} + z c, from the sums of the gate and of the candidate."""
    return entering(candidate, log_form), torch.sigmoid(gate)


def minlstm(forget: Tensor, update: Tensor, candidate: Tensor, log_form: bool = False) -> tuple[Tensor, Tensor]:
    """c and u = i / (f + i) of h_t = (1 - u) h_{t-1} + u c, from the sums of the gates f and i and of the candidate."""
    forget, update = torch.sigmoid(forget), torch.sigmoid(update)
    # Both gates may be zero in f32.
    return entering(candidate, log_form), update / (forget + update + 1e-12)


class MinGRU(nn.Module):
    """One layer, [T, B, inputs] to [T, B, H]; z = sigmoid(W_z x), c = W_h x."""

    def __init__(self, inputs: int, hidden: int, log_form: bool) -> None:
        super().__init__()
        self.gate = nn.Linear(inputs, hidden)
        self.candidate = nn.Linear(inputs, hidden)
        self.log_form = log_form

    def forward(self, signal: Tensor, carried: Tensor | None = None) -> Tensor:
        return recurrence(torch.lerp, carried, *mingru(self.gate(signal), self.candidate(signal), self.log_form))


class MinLSTM(nn.Module):
    """One layer, [T, B, inputs] to [T, B, H]; without normalised gates, h_t = f h_{t-1} + i c."""

    def __init__(self, inputs: int, hidden: int, log_form: bool, normalize_gates: bool) -> None:
        super().__init__()
        self.forget_gate = nn.Linear(inputs, hidden)
        self.input_gate = nn.Linear(inputs, hidden)
        self.candidate = nn.Linear(inputs, hidden)
        self.log_form, self.normalize_gates = log_form, normalize_gates

    def forward(self, signal: Tensor, carried: Tensor | None = None) -> Tensor:
        forget, update, candidate = self.forget_gate(signal), self.input_gate(signal), self.candidate(signal)
        if self.normalize_gates:
            return recurrence(torch.lerp, carried, *minlstm(forget, update, candidate, self.log_form))
        new = torch.sigmoid(update) * entering(candidate, self.log_form)
        return recurrence(lambda hidden, f, e: torch.addcmul(e, f, hidden), carried, torch.sigmoid(forget), new)


class MinimalCore(nn.ModuleList):
    """Layers of a minimal recurrence, with the interface of `nn.GRU`."""

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
    """Layers without recurrence, with the interface of `nn.GRU`; the state is None."""

    def forward(self, signal: Tensor, _: None = None) -> tuple[Tensor, None]:
        for layer in self:
            signal = layer(signal)
        return signal, None


def core(description: dict[str, Any], inputs: int) -> nn.Module:
    """The described core: maps [T, B, inputs] and a state to [T, B, H] and the next state."""
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
    """The frame model's options, with defaults for those that `model.toml` omits."""
    defaults = {"pooling": "mean", "activation": "elu", "material": "one-hot", "scaling": "min-max", "output": "displacement"}
    return defaults | description.get("frame", {})
