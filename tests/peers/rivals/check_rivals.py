"""Check parts of the rivals against plain computations: neighbours, transfer to the grid and back, mirrored windows, symmetries.

    check_rivals.py

Needs no data. Exits with 1 and a message if a check fails.
"""

import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import gns
import neural_mpm
from scenes import Scenes, Window, before
from transolver import Transolver

SEED = 3


def expect(holds, sentence):
    if not holds:
        sys.exit(f"check_rivals.py: {sentence}")


def drawn(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(SEED))


def check_neighbours():
    position = drawn(3, 400, 2)
    senders, receivers = gns.neighbours(position)
    found = set(zip(senders.tolist(), receivers.tolist()))
    wanted = set()
    for window, points in enumerate(position.double()):
        for i, a in enumerate(points):
            near = ((points - a).square().sum(-1).sqrt() <= gns.RADIUS).nonzero().flatten().tolist()
            wanted |= {(window * 400 + j, window * 400 + i) for j in near}
    expect(found == wanted and len(wanted) > 3 * 400, f"neighbours: {len(found ^ wanted)} of {len(wanted)} pairs differ")


def check_transfer():
    position, material = drawn(2, 300, 2), (drawn(2, 300) * 4).long()
    node, weight = neural_mpm.corners(position)
    place = torch.stack((node % neural_mpm.NODES, node // neural_mpm.NODES), -1) / (neural_mpm.NODES - 1)
    error = ((weight[..., None] * place).sum(2) - position).abs().max()
    expect(error < 1e-5, f"the weights' mean of nodes is {error} from the particle")
    mass = neural_mpm.to_grid(torch.ones(2, 300, 1), material, node, weight)
    of_kind = torch.stack([(material == kind).sum(1) for kind in range(4)], 1)
    expect(torch.allclose(mass.sum((2, 3)), of_kind.float(), rtol=1e-5), "the grid's mass is not that of the particles")


def check_call():
    """Particles receive the velocities of their own material and frame, and the network sees each material's own."""
    position, material = drawn(1, 300, 2), (drawn(1, 300) * 4).long()
    velocity = material[..., None] + torch.tensor((1.0, 2.0))
    model, seen = neural_mpm.NeuralMpm(), []
    model.scale.fill_(0.5)
    # Channels by frame, material and direction.
    channels = torch.arange(float(neural_mpm.BUNDLE * 4 * 2))[None, :, None, None]
    model.processor = torch.nn.Identity()
    model.processor.forward = lambda grid: seen.append(grid) or channels.expand(-1, -1, neural_mpm.NODES, neural_mpm.NODES)
    for frame, (_, found) in enumerate(model.call(position, velocity, material)):
        wanted = 0.5 * (8 * frame + 2 * material[..., None] + torch.arange(2))
        expect(torch.allclose(found, wanted, rtol=1e-4), f"frame {frame}: a particle has the velocity of another material")
    grid = seen[0][0, :12].unflatten(0, (4, 3))
    for kind, (mass, *of_kind) in enumerate(grid):
        for direction, channel in enumerate(of_kind):
            wanted = (kind + 1 + direction) / 0.5
            filled = channel[mass > 0.1]
            expect(len(filled) > 20 and torch.allclose(filled, torch.full_like(filled, wanted), rtol=1e-3), f"material {kind}: {filled}")


def check_mirror():
    """Of a window and its mirror image the one is drawn as often as the other, and nothing else."""
    scenes = Scenes.__new__(Scenes)
    scenes.position, scenes.velocity = drawn(1, 3, 5, 2), drawn(1, 3, 5, 2) - 0.5
    scenes.material = torch.zeros(1, 5, dtype=torch.int64)
    windows = scenes.windows(100, 3, torch.Generator().manual_seed(SEED))
    image = torch.tensor((-1.0, 1.0)), torch.tensor((1.0, 0.0))
    mirrored = scenes.position[0] * image[0] + image[1]
    is_plain = [torch.equal(window, scenes.position[0]) for window in windows.position]
    is_image = [torch.allclose(window, mirrored) for window in windows.position]
    turned = [torch.equal(velocity, scenes.velocity[0] * image[0]) for velocity in windows.velocity]
    expect(turned == is_image and all(a != b for a, b in zip(is_plain, is_image)), "a window is neither itself nor its image")
    expect(20 < sum(is_image) < 80, f"{sum(is_image)} of 100 windows are mirrored")


def check_before():
    """Frames in front of a free flight continue it."""
    time = torch.arange(8.0)[None, :, None, None]
    start, speed, gravity = drawn(1, 1, 4, 2), drawn(1, 1, 4, 2) / 100, torch.tensor((0.0, -1e-3))
    flight = Window(start + speed * time + gravity * time**2 / 2, speed + gravity * time, torch.zeros(1, 4))
    found = before(Window(flight.position[:, 5:], flight.velocity[:, 5:], flight.material), 8)
    for name in ("position", "velocity"):
        error = (getattr(found, name) - getattr(flight, name)).abs().max()
        expect(error < 1e-6, f"{name} before a window is {error} from the flight")


@torch.no_grad()
def check_symmetries():
    """GNS sees differences of positions only, and no rival the order of particles."""
    torch.manual_seed(SEED)
    shift, order = torch.tensor((0.1, 0.05)), torch.randperm(200, generator=torch.Generator().manual_seed(SEED))
    position = 0.3 + 0.2 * drawn(1, 1, 200, 2) + 1e-3 * (drawn(1, 6, 200, 2) - 0.5).cumsum(1)
    velocity, material = position.diff(dim=1, prepend=position[:, :1]), (drawn(1, 200) * 4).long()
    for rival in (gns.Gns(), neural_mpm.NeuralMpm(), Transolver()):
        rival.scale.fill_(1e-2)
        for parameter in rival.parameters():
            torch.nn.init.normal_(parameter, std=0.1)
        roll = lambda x, v, m: next(rival.rollout(Window(x, v, m), 1))[0]
        plain = roll(position, velocity, material)
        # Sums in another order differ by rounding.
        tolerance = 1e-4 * (plain - position[:, -1]).abs().max()
        permuted = roll(position[:, :, order], velocity[:, :, order], material[:, order])
        error = (permuted - plain[:, order]).abs().max()
        expect(error < tolerance, f"{type(rival).__name__}: another order of particles moves them by {error}")
        moved = (roll(position + 0.5, velocity, material) - plain).abs().max()
        expect(moved > 0.4, f"{type(rival).__name__}: the prediction is not of the observed particles")
        if isinstance(rival, gns.Gns):
            error = (roll(position + shift, velocity, material) - plain - shift).abs().max()
            expect(error < tolerance, f"GNS: a shift of all particles changes their motion by {error}")


def main():
    for check in (check_neighbours, check_transfer, check_call, check_mirror, check_before, check_symmetries):
        check()
        print(f"{check.__name__}: holds")


if __name__ == "__main__":
    main()
