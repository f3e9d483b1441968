"""The frame model (the paper's Table 1) in PyTorch, with eddy's names for its tensors.

Letters in shapes are defined in `torch_core`; F: features.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from torch_core import ACTIVATIONS, MATERIAL_INPUTS, Bodies, State, core, options


class FrameModel(nn.Module):
    """Predicts the frame after each of T frames."""

    def __init__(self, description: dict[str, Any]) -> None:
        super().__init__()
        sizes = description["sizes"]
        chosen = options(description)
        self.particles, self.dt, self.output = sizes["particles"], description["dt"], chosen["output"]
        self.pooling, self.one_hot = chosen["pooling"], chosen["material"] == "one-hot"
        self.activation = ACTIVATIONS[chosen["activation"]]
        self.materials = description.get("material_inputs", MATERIAL_INPUTS)
        features, width, hidden = 4 + (self.materials if self.one_hot else 1), sizes["encoder"], sizes["hidden"]

        self.encoder = nn.ModuleList([nn.Linear(features, width), nn.Linear(width, hidden)])
        self.core = core(description, 2 * hidden if self.pooling == "mean+max" else hidden)
        self.mixer = nn.Linear(hidden, hidden)
        self.decoder = nn.Linear(hidden, 2 * self.particles)

        scale = {name: torch.tensor(values) for name, values in description["normalization"].items()}
        if chosen["scaling"] == "min-max":
            offset, unit = scale["minimum"], scale["maximum"] - scale["minimum"]
        else:
            offset, unit = scale["mean"], scale["standard_deviation"]
        gravity = torch.tensor(description["gravity"])
        for name, values in {
            "fall": gravity * self.dt,
            "lower": scale["minimum"][:2],
            "upper": scale["maximum"][:2],
            "mean": scale["mean"][:2],
            "deviation": scale["standard_deviation"][:2],
        }.items():
            self.register_buffer(name, values, persistent=False)
        self.register_buffer("offset", offset, persistent=False)
        self.register_buffer("unit", unit, persistent=False)

    def matter(self, material: Tensor, _: Tensor | None = None) -> Tensor:
        """Materials [B, N], indices into `torch_core.MATERIALS`, as features [B, N, F - 4]; the rest shape is not used."""
        if self.one_hot:
            return functional.one_hot(material, self.materials).float()
        return material.unsqueeze(-1) / (self.materials - 1)

    def forward(self, bodies: Bodies, matter: Tensor, state: State = None) -> tuple[Bodies, State]:
        """The frame after each of T frames, and the state after the last one; `matter` comes from `matter()`."""
        position, velocity = bodies
        signal, state = self.core(self.encode(position, velocity, matter), state)
        output = self.decoder(self.activation(self.mixer(signal)))  # [T, B, 2 N]
        return self.advance(position, velocity, output.unflatten(-1, (self.particles, 2))), state

    def advance(self, position: Tensor, velocity: Tensor, output: Tensor) -> Bodies:
        """The next state from the decoder's output, [T, B, N, 2] each."""
        if self.output == "position":
            following = self.mean + self.deviation * output
            return following, (following - position) / self.dt
        if self.output == "residual":
            fallen = velocity + self.fall
            free = position + (velocity + fallen) / 2 * self.dt
            ballistic = free.maximum(self.lower).minimum(self.upper)
            moving = (ballistic == free).detach()
            return ballistic + output * self.dt / 2, fallen * moving + output
        velocity = velocity + output
        return position + velocity * self.dt, velocity

    def encode(self, position: Tensor, velocity: Tensor, matter: Tensor) -> Tensor:
        """[T, B, H], or [T, B, 2 H] with both poolings."""
        scaled = (torch.cat([position, velocity], -1) - self.offset) / self.unit
        features = torch.cat([scaled, matter.expand(len(scaled), -1, -1, -1)], -1)  # [T, B, N, F]
        points = self.activation(self.encoder[0](features))  # [T, B, N, E]
        pooled = []
        if "mean" in self.pooling:  # commutes with the second layer
            pooled.append(self.encoder[1](points.mean(2)))
        if "max" in self.pooling:
            pooled.append(self.encoder[1](points).amax(2))
        return torch.cat(pooled, -1)
