"""NeuralMPM.

Written after O. Rochman-Sharabi, S. Lewin and G. Louppe, "A neural material point method for particle-based emulation", 2024:
particles are interpolated to a regular grid, a U-Net predicts the grid's velocities of the next frames, and these are
interpolated back to the particles, which move with them; the loss is that of positions over several calls. `rival.py` lists what
differs from the paper and its authors' program.

Letters in shapes: B windows, N particles, M materials, G nodes a side, K frames a call.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu

from scenes import Scenes, Window
from torch_core import MATERIALS

NODES, CHANNELS = 64, 64
# Frames that the network predicts at once, and calls that a training window spans.
BUNDLE, CALLS = 4, 4
# Mass below which a node has no velocity (particles).
LEAST_MASS = 1e-3


class Convolutions(nn.Sequential):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(), nn.Conv2d(outputs, outputs, 3, padding=1), nn.ReLU())


class UNet(nn.Module):
    """Three levels, each of the same number of channels, with links from the way down to the way up."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.down = nn.ModuleList([Convolutions(inputs, CHANNELS), Convolutions(CHANNELS, CHANNELS), Convolutions(CHANNELS, CHANNELS)])
        self.up = nn.ModuleList([Convolutions(2 * CHANNELS, CHANNELS), Convolutions(2 * CHANNELS, CHANNELS)])
        self.last = nn.Conv2d(CHANNELS, outputs, 1)

    def forward(self, grid: Tensor) -> Tensor:
        levels = []
        for level, convolutions in enumerate(self.down):
            grid = convolutions(grid if level == 0 else nn.functional.max_pool2d(grid, 2))
            levels.append(grid)
        grid = levels.pop()
        for convolutions in self.up:
            grid = convolutions(torch.cat((interpolate(grid, scale_factor=2), levels.pop()), 1))
        return self.last(relu(grid))


def corners(position: Tensor) -> tuple[Tensor, Tensor]:
    """The four nodes around each particle, row by row, and their bilinear weights, [B, N, 4]; position [B, N, 2]."""
    place = (position * (NODES - 1)).clamp(0, NODES - 1.001)
    cell = place.floor()
    x, y = (place - cell).unbind(-1)
    column, row = cell.long().unbind(-1)
    first = row * NODES + column
    node = torch.stack((first, first + 1, first + NODES, first + NODES + 1), -1)
    return node, torch.stack(((1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y), -1)


def to_grid(values: Tensor, material: Tensor, node: Tensor, weight: Tensor) -> Tensor:
    """Sums of weight times values [B, N, C] for each material, [B, M, C, G G]."""
    (windows, _, width), materials = values.shape, len(MATERIALS)
    place = (torch.arange(windows, device=node.device)[:, None] * materials + material)[..., None] * NODES**2 + node
    shares = weight[..., None] * values[:, :, None]
    grid = torch.zeros(windows * materials * NODES**2, width, device=values.device, dtype=values.dtype)
    grid = grid.index_add(0, place.flatten(), shares.flatten(0, 2))
    return grid.unflatten(0, (windows, materials, NODES**2)).transpose(2, 3)


class NeuralMpm(nn.Module):
    history = 1
    batch = 128
    rate = 1e-3

    def __init__(self) -> None:
        super().__init__()
        materials = len(MATERIALS)
        # For each material its density and velocity; the walls.
        self.processor = UNet(3 * materials + 1, BUNDLE * materials * 2)
        self.register_buffer("scale", torch.zeros(2))
        walls = torch.ones(NODES, NODES)
        walls[1:-1, 1:-1] = 0
        self.register_buffer("walls", walls)

    def compile_steps(self) -> None:
        """Compiles what training spends its time in."""
        self.call = torch.compile(self.call)

    @torch.no_grad()
    def prepare(self, scenes: Scenes) -> None:
        deviation = scenes.velocity.flatten(0, 2).std(0).mean()
        # Particles a node that holds any.
        node = corners(scenes.position[0, :1])[0]
        self.scale[:] = torch.stack((deviation, node.numel() / 4 / node.unique().numel() * torch.ones_like(deviation)))

    def call(self, position: Tensor, velocity: Tensor, material: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Position and velocity [B, N, 2] of the next BUNDLE frames."""
        speed, full = self.scale
        node, weight = corners(position)
        ones = torch.ones_like(velocity[..., :1])
        mass, momentum = to_grid(torch.cat((ones, velocity / speed), -1), material, node, weight).split((1, 2), 2)
        carried = torch.where(mass > LEAST_MASS, momentum / mass.clamp(min=LEAST_MASS), 0)
        channels = torch.cat((mass / full, carried), 2).flatten(1, 2).unflatten(2, (NODES, NODES))
        walls = self.walls.expand(len(channels), 1, -1, -1)
        predicted = self.processor(torch.cat((channels, walls), 1)).float()
        predicted = predicted.flatten(2).unflatten(1, (BUNDLE, len(MATERIALS), 2)) * speed
        frames = []
        for of_frame in predicted.unbind(1):
            # The node's velocity of the particle's own material.
            node, weight = corners(position)
            table = of_frame.transpose(2, 3).flatten(1, 2)
            place = material[..., None] * NODES**2 + node
            values = table.gather(1, place.flatten(1)[..., None].expand(-1, -1, 2)).unflatten(1, node.shape[1:])
            velocity = (weight[..., None] * values).sum(2)
            position = position + velocity
            frames.append((position, velocity))
        return frames

    def loss(self, scenes: Scenes, count: int, generator: torch.Generator) -> Tensor:
        window = scenes.windows(count, 1 + BUNDLE * CALLS, generator)
        rolled = self.rollout(Window(window.position[:, :1], window.velocity[:, :1], window.material), BUNDLE * CALLS)
        error = torch.stack([position for position, _ in rolled], 1) - window.position[:, 1:]
        return (error / self.scale[0]).square().mean()

    def rollout(self, window: Window, frames: int):
        """Yields position and velocity [B, N, 2] of each frame ahead."""
        position, velocity = window.position[:, -1], window.velocity[:, -1]
        for first in range(0, frames, BUNDLE):
            called = self.call(position, velocity, window.material)
            yield from called[: frames - first]
            position, velocity = called[-1]
