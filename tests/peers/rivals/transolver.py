"""A transformer of particles, with the attention of Transolver.

The attention is that of H. Wu et al., "Transolver: a fast transformer solver for PDEs on general geometries", ICML 2024,
section 3: particles are assigned softly to slices, the slices attend to each other, and each particle receives its share, so
that the cost is linear in the number of particles. Around it stands a simulator as that of GNS, which is also told the
observed velocity: it predicts the acceleration of each particle, in free rollouts of a few frames during training.

Letters in shapes: B windows, N particles, H heads, K slices, D width of a head.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot, scaled_dot_product_attention

from scenes import Scenes, Window
from torch_core import MATERIALS

WIDTH, LAYERS, HEADS, SLICES = 128, 6, 8, 64
# Free frames of a training window.
FREE = 8
# Wavelengths of the sines of the position (domain widths).
WAVES = (1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125)
# Reach of the features of walls (domain widths).
NEAR = 0.05


class Attention(nn.Module):
    """Physics attention on irregular points (paper, equations 1 to 4)."""

    def __init__(self) -> None:
        super().__init__()
        head = WIDTH // HEADS
        self.values, self.keys = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)
        self.slices = nn.Linear(head, SLICES)
        self.sharpness = nn.Parameter(torch.full((1, HEADS, 1, 1), 2.0))
        self.project = nn.Linear(head, 3 * head, bias=False)
        self.out = nn.Linear(WIDTH, WIDTH)

    def forward(self, x: Tensor) -> Tensor:
        heads = lambda values: values.unflatten(-1, (HEADS, -1)).transpose(1, 2)
        weights = (self.slices(heads(self.keys(x))) * self.sharpness).softmax(-1)
        share = weights / (weights.sum(2, keepdim=True) + 1e-5)
        tokens = share.transpose(2, 3) @ heads(self.values(x))
        tokens = scaled_dot_product_attention(*self.project(tokens).chunk(3, -1))
        return self.out((weights @ tokens).transpose(1, 2).flatten(2))


class Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.attention = nn.Sequential(nn.LayerNorm(WIDTH), Attention())
        self.each = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 2 * WIDTH), nn.GELU(), nn.Linear(2 * WIDTH, WIDTH))

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attention(x)
        return x + self.each(x)


class Transolver(nn.Module):
    history = 1
    batch = 32
    rate = 1e-3

    def __init__(self) -> None:
        super().__init__()
        features = 2 + 4 * len(WAVES) + 4 + len(MATERIALS)
        self.encode = nn.Sequential(nn.Linear(features, 2 * WIDTH), nn.GELU(), nn.Linear(2 * WIDTH, WIDTH))
        self.blocks = nn.Sequential(*[Block() for _ in range(LAYERS)])
        self.decode = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 4))
        # Begins with the mean change, so that the rollouts of the first steps stay finite.
        nn.init.zeros_(self.decode[1].weight)
        # Deviation of velocities; mean and deviation of what is added to them in a frame.
        self.register_buffer("scale", torch.ones(3, 2))

    def compile_steps(self) -> None:
        """Compiles what training spends its time in."""
        self.step = torch.compile(self.step)

    @torch.no_grad()
    def prepare(self, scenes: Scenes) -> None:
        change = scenes.velocity.diff(dim=1).flatten(0, 2)
        self.scale[:] = torch.stack((scenes.velocity.flatten(0, 2).std(0), change.mean(0), change.std(0)))

    def step(self, position: Tensor, velocity: Tensor, material: Tensor) -> tuple[Tensor, Tensor]:
        """Position and velocity [B, N, 2] of the next frame."""
        speed, mean, deviation = self.scale
        phase = torch.cat([position * (2 * torch.pi / wave) for wave in WAVES], -1)
        walls = (torch.cat((position, 1 - position), -1) / NEAR).clamp(-1, 1)
        kind = one_hot(material, len(MATERIALS)).to(position.dtype)
        features = torch.cat((velocity / speed, phase.sin(), phase.cos(), walls, kind), -1)
        # The observed velocity is that of an instant: how far a particle moves is predicted beside it.
        change, shift = self.decode(self.blocks(self.encode(features))).float().chunk(2, -1)
        moved = velocity + mean / 2 + shift * deviation
        return position + moved, velocity + mean + change * deviation

    def loss(self, scenes: Scenes, count: int, generator: torch.Generator) -> Tensor:
        window = scenes.windows(count, 1 + FREE, generator)
        first = Window(window.position[:, :1], window.velocity[:, :1], window.material)
        position, velocity = (torch.stack(values, 1) for values in zip(*self.rollout(first, FREE)))
        errors = (position - window.position[:, 1:], velocity - window.velocity[:, 1:])
        return sum((error / self.scale[2]).square().mean() for error in errors)

    def rollout(self, window: Window, frames: int):
        """Yields position and velocity [B, N, 2] of each frame ahead."""
        position, velocity = window.position[:, -1], window.velocity[:, -1]
        for _ in range(frames):
            position, velocity = self.step(position, velocity, window.material)
            yield position, velocity
