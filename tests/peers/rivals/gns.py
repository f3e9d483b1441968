"""Graph network simulator.

Written after A. Sanchez-Gonzalez et al., "Learning to simulate complex physics with graph networks", ICML 2020, section 4
and appendices B and C: an encoder, ten interaction networks with residual connections, a decoder of the acceleration; five
past velocities; random-walk noise whose effect on the last velocity the target corrects.

Letters in shapes: B windows, N particles, V = B N nodes, E edges, L latent width.
"""

import torch
from torch import Tensor, nn

from scenes import Scenes, Window
from torch_core import MATERIALS

HISTORY = 5
LATENT, STEPS, EMBEDDING = 128, 10, 16
# Radius of the neighbourhood (domain widths): 2.6 particle spacings at 2,500 particles, some 17 neighbours.
RADIUS = 0.02
# Standard deviation of the last step of the random walk that is added to positions (domain widths per frame): about .3 of the
# velocities' own, the published ratio.
NOISE = 2e-3


def mlp(inputs: int, outputs: int, is_normalised: bool = True) -> nn.Sequential:
    layers = [nn.Linear(inputs, LATENT), nn.ReLU(), nn.Linear(LATENT, LATENT), nn.ReLU(), nn.Linear(LATENT, outputs)]
    return nn.Sequential(*layers, *([nn.LayerNorm(outputs)] if is_normalised else []))


class Interaction(nn.Module):
    """Messages along the edges, summed up at their receivers (paper, appendix B.1)."""

    def __init__(self) -> None:
        super().__init__()
        self.edge, self.node = mlp(3 * LATENT, LATENT), mlp(2 * LATENT, LATENT)

    def forward(self, nodes: Tensor, edges: Tensor, senders: Tensor, receivers: Tensor) -> tuple[Tensor, Tensor]:
        # The gradient of indexing with brackets sorts the indices first.
        ends = [nodes.index_select(0, which) for which in (senders, receivers)]
        messages = self.edge(torch.cat((edges, *ends), -1))
        received = torch.zeros_like(nodes).index_add_(0, receivers, messages.to(nodes.dtype))
        return nodes + self.node(torch.cat((nodes, received), -1)), edges + messages


def neighbours(position: Tensor) -> tuple[Tensor, Tensor]:
    """Senders and receivers of all pairs within the radius, each particle with itself among them; position [B, N, 2]."""
    # Axis by axis, since torch.cdist starts a block of threads for every pair on a GPU.
    squared = sum((axis[:, :, None] - axis[:, None]).square() for axis in position.unbind(-1))
    window, receiver, sender = (squared <= RADIUS**2).nonzero(as_tuple=True)
    first = window * position.shape[1]
    return first + sender, first + receiver


class Gns(nn.Module):
    history = HISTORY + 1
    batch = 16
    rate = 7e-4

    def __init__(self) -> None:
        super().__init__()
        self.material = nn.Embedding(len(MATERIALS), EMBEDDING)
        self.encode_nodes, self.encode_edges = mlp(2 * HISTORY + 4 + EMBEDDING, LATENT), mlp(3, LATENT)
        self.interactions = nn.ModuleList([Interaction() for _ in range(STEPS)])
        self.decode = mlp(LATENT, 2, is_normalised=False)
        # Mean and standard deviation of velocities and of accelerations, of the training data and the noise.
        self.register_buffer("scale", torch.zeros(4, 2))

    def compile_steps(self) -> None:
        """Compiles what training spends its time in, for any number of edges."""
        for interaction in self.interactions:
            interaction.compile(dynamic=True)

    @torch.no_grad()
    def prepare(self, scenes: Scenes) -> None:
        velocity = scenes.position.diff(dim=1)
        for row, values in ((0, velocity), (2, velocity.diff(dim=1))):
            deviation = (values.flatten(0, 2).var(0) + NOISE**2).sqrt()
            self.scale[row : row + 2] = torch.stack((values.flatten(0, 2).mean(0), deviation))

    def acceleration(self, position: Tensor, material: Tensor) -> Tensor:
        """In units of its deviation, [B, N, 2]; of the last of HISTORY + 1 positions [B, T, N, 2]."""
        last = position[:, -1]
        velocity = (position.diff(dim=1) - self.scale[0]) / self.scale[1]
        walls = (torch.cat((last, 1 - last), -1) / RADIUS).clamp(-1, 1)
        features = torch.cat((velocity.permute(0, 2, 1, 3).flatten(2), walls, self.material(material)), -1)
        senders, receivers = neighbours(last)
        flat = last.flatten(0, 1)
        apart = (flat[senders] - flat[receivers]) / RADIUS
        nodes = self.encode_nodes(features.flatten(0, 1))
        edges = self.encode_edges(torch.cat((apart, apart.norm(dim=-1, keepdim=True)), -1))
        for interaction in self.interactions:
            nodes, edges = interaction(nodes, edges, senders, receivers)
        return self.decode(nodes).unflatten(0, last.shape[:2])

    def loss(self, scenes: Scenes, count: int, generator: torch.Generator) -> Tensor:
        window = scenes.windows(count, self.history + 1, generator)
        observed, target = window.position[:, :-1], window.position[:, -1]
        steps = torch.randn(observed.diff(dim=1).shape, generator=generator).to(observed.device)
        walk = (steps * (NOISE / HISTORY**0.5)).cumsum(1).cumsum(1)
        noise = torch.cat((torch.zeros_like(walk[:, :1]), walk), 1)
        noisy, target = observed + noise, target + noise[:, -1]
        wanted = (target - 2 * noisy[:, -1] + noisy[:, -2] - self.scale[2]) / self.scale[3]
        return (self.acceleration(noisy, window.material).float() - wanted).square().mean()

    def rollout(self, window: Window, frames: int):
        """Yields position and velocity [B, N, 2] of each frame ahead."""
        position = window.position[:, -self.history :]
        for _ in range(frames):
            acceleration = self.acceleration(position, window.material).float() * self.scale[3] + self.scale[2]
            velocity = position[:, -1] - position[:, -2] + acceleration
            position = torch.cat((position[:, 1:], (position[:, -1] + velocity)[:, None]), 1)
            yield position[:, -1], velocity
