"""The elastic impulse of jelly in PyTorch: bilinear elements on a lattice for each body, fitted to its particles by least squares.

It follows the description in eddy's documentation and `[elastic]` of `model.toml`, with dense matrices where eddy has sparse ones, for networks
that are not conditioned on the stiffness and bodies that are not narrower than an element, which needs more steps.
"""

import math
from typing import Any

import torch
from torch import Tensor

from torch_core import Bodies

# Particles of a body at least, share of a full element's particles that fills an element, mass of a node at least (full elements).
FEWEST, FILLED, LIGHTEST = 16, 0.4, 0.1
# Width of the parts of a surface, and what the stiffnesses of walls and contact refer to (spacings).
PART, SURFACE_WIDTH = 1.75, 3.5
# Speed away from a wall from which on its push is the share `rebound`.
REBOUNDING = 0.1
# Distance of connected particles (spacings); stretch from which on a point has no stress; largest change of a node's velocity, with a
# larger one there is none.
CONNECTED, TORN, FASTEST = 1.5, 1.6, 64.0
CORNERS = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]])


class Lattice:
    """The lattice of a body: M nodes, Q points, P particles."""

    def __init__(self, rest: Tensor, spacing: float, options: dict[str, Any]) -> None:
        low, high = rest.amin(0) - spacing / 2, rest.amax(0) + spacing / 2
        size = options["cell_width"] * spacing
        self.cells = ((high - low) / size + 1e-6).floor().long().clamp(min=1)
        self.corner, self.width = low, (high - low) / self.cells
        full = float(self.width.prod()) / spacing**2

        own = self.part(rest, 1)
        counts = torch.zeros(*self.cells.tolist())
        counts.index_put_((own[:, 0], own[:, 1]), torch.ones(len(rest)), accumulate=True)
        elements = torch.cartesian_prod(*(torch.arange(count) for count in self.cells.tolist())).view(-1, 2)
        # Rows of elements one after the other: of equally near ones the first is taken.
        elements = elements[(elements[:, 1] * self.cells[0] + elements[:, 0]).argsort()]
        filled = counts[elements[:, 0], elements[:, 1]] >= FILLED * full
        steps = elements.unsqueeze(1) - elements
        apart = (steps * self.width).square().sum(-1)
        near = (steps.abs().amax(-1) <= 1) & filled
        nearest = apart.masked_fill(~near, torch.inf).argmin(1)
        home = torch.where(near.any(1).unsqueeze(1), elements[nearest], elements)
        self.home = torch.zeros(*self.cells.tolist(), 2, dtype=torch.long)  # the element that each one's particles belong to
        self.home[elements[:, 0], elements[:, 1]] = home

        self.values, _ = self.shape(rest)  # [P, all nodes]
        used = self.values.abs().sum(0) > 0
        grids = home[counts[elements[:, 0], elements[:, 1]] > 0].unsqueeze(1) + CORNERS
        used[(grids[..., 1] * (self.cells[0] + 1) + grids[..., 0]).flatten()] = True
        self.values = self.values[:, used]
        self.mass = self.values.sum(0).clamp(min=LIGHTEST * full)
        quarters, self.count = self.parts(rest, 2 * self.cells)[:2]
        _, gradients = self.shape(quarters)
        self.gradients = gradients[:, used]  # [Q, M, 2]
        parts, self.particles, at = self.parts(rest, ((high - low) / (PART * spacing)).round().long().clamp(min=1))
        # A part without particles beside it is at the surface.
        outer = ((at.unsqueeze(1) - at).abs().amax(-1) <= 1).sum(1) < 9
        weights, _ = self.shape(parts[outer])
        self.weights, self.particles = weights[:, used], self.particles[outer].double()  # [S, M], [S]

    def parts(self, rest: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The mean places of the particles in each of so many parts along each axis that has some, their numbers, and its place."""
        at = ((rest - self.corner) / (self.width * self.cells) * count).floor().long().clamp(min=0).minimum(count - 1)
        at, part, number = at.unique(dim=0, return_inverse=True, return_counts=True)
        sums = rest.new_zeros(len(at), 2).index_add_(0, part, rest)
        return sums / number.unsqueeze(1), number, at

    def part(self, place: Tensor, parts: int) -> Tensor:
        at = ((place - self.corner) / self.width * parts).floor().long()
        return at.clamp(min=0).minimum(parts * self.cells - 1)

    def shape(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Shape functions of all nodes at some places, and their gradients."""
        own = self.part(place, 1)
        element = self.home[own[:, 0], own[:, 1]]
        within = (place - self.corner) / self.width - element
        nodes = int((self.cells + 1).prod())
        values, gradients = place.new_zeros(len(place), nodes), place.new_zeros(len(place), nodes, 2)
        rows = torch.arange(len(place))
        for corner in CORNERS:
            grid = element + corner
            node = grid[:, 1] * (self.cells[0] + 1) + grid[:, 0]
            part = torch.where(corner == 1, within, 1 - within)
            values[rows, node] = part.prod(1)
            gradients[rows, node] = torch.where(corner == 1, 1.0, -1.0) * part.flip(1) / self.width
        return values, gradients

    def fit(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and velocities of the nodes, [M, 2] each."""
        x, v = torch.linalg.lstsq(self.values, torch.cat([position, velocity], 1)).solution.split(2, 1)
        return x, v

    def forces(self, x: Tensor, v: Tensor, law: "Elastic", step: float) -> Tensor:
        """Those of stress and walls on the nodes, [M, 2]."""
        f = torch.einsum("mi,qmj->qij", x, self.gradients)
        cos, sin = f[:, 0, 0] + f[:, 1, 1], f[:, 1, 0] - f[:, 0, 1]
        length = (cos.square() + sin.square()).sqrt().clamp(min=1e-12)
        cos, sin = cos / length, sin / length
        turn = torch.stack([cos, -sin, sin, cos], -1).view(-1, 2, 2)
        cofactor = torch.stack([f[:, 1, 1], -f[:, 1, 0], -f[:, 0, 1], f[:, 0, 0]], -1).view(-1, 2, 2)
        rate = torch.einsum("mi,qmj->qij", v, self.gradients)
        strain = rate @ turn.mT
        strain = (strain + strain.mT) / 2
        stress = law.viscosity * math.sqrt(law.modulus) * self.width.mean() * strain @ turn
        stress = stress + 2 * law.mu * (f - turn) + law.lam * (torch.linalg.det(f) - 1)[:, None, None] * cofactor
        whole = self.count * (torch.linalg.svdvals(f)[:, 0] <= TORN)
        force = -torch.einsum("q,qij,qmj->mi", whole.to(x), stress, self.gradients)
        place, speed = self.weights @ x, self.weights @ v + law.gravity * step
        depth = (law.lower - place).clamp(min=0) - (place - law.upper).clamp(min=0)
        share = 1 - (1 - law.rebound) * (speed * depth.sign() / REBOUNDING).clamp(0, 1)
        push = law.wall_stiffness * law.rate**2 * share * depth * self.particles.unsqueeze(1)
        return force + self.weights.T @ push


def contact(one: Lattice, other: Lattice, nodes: list[tuple[Tensor, Tensor]], law: "Elastic") -> tuple[Tensor, Tensor]:
    """The forces between the surfaces of two bodies on their nodes, [M, 2] each."""
    (x, v), (y, w) = ((own.weights @ place, own.weights @ speed) for own, (place, speed) in zip((one, other), nodes, strict=True))
    apart, speed = x.unsqueeze(1) - y, v.unsqueeze(1) - w
    gap = apart.norm(dim=-1).clamp(min=1e-9)
    p, q = one.particles.unsqueeze(1), other.particles
    depth = 2 * p * q / (p + q) * (law.contact_distance - gap).clamp(min=0)
    spring = law.contact_stiffness * law.rate**2 * depth / gap
    exchange = law.contact_viscosity * law.rate * depth / law.contact_distance
    force = spring.unsqueeze(-1) * apart - exchange.unsqueeze(-1) * speed
    return one.weights.T @ force.sum(1), -other.weights.T @ force.sum(0)


def impulses(lattices: list[Lattice], bodies: list[tuple[Tensor, Tensor]], law: "Elastic") -> list[tuple[Tensor, Tensor]]:
    """What to add to the velocities of each body before a frame and to the positions after it, [P, 2] each."""
    start = [lattice.fit(*body) for lattice, body in zip(lattices, bodies, strict=True)]
    nodes, step = start, law.dt / law.steps
    for _ in range(law.steps):
        forces = [lattice.forces(x, v, law, step) for lattice, (x, v) in zip(lattices, nodes, strict=True)]
        for other in range(len(lattices)):
            for one in range(other):
                pair = contact(lattices[one], lattices[other], [nodes[one], nodes[other]], law)
                forces[one], forces[other] = forces[one] + pair[0], forces[other] + pair[1]
        speeds = [
            v + step * (force / lattice.mass.unsqueeze(1) + law.gravity)
            for lattice, (_, v), force in zip(lattices, nodes, forces, strict=True)
        ]
        nodes = [(x + step * v, v) for (x, _), v in zip(nodes, speeds, strict=True)]
    fallen = law.gravity * law.dt
    found = []
    for lattice, (x0, v0), (x, v) in zip(lattices, start, nodes, strict=True):
        faster = v - v0 - fallen
        farther = x - x0 - (v0 + faster + fallen / 2) * law.dt
        if not bool((faster.abs() <= FASTEST).all()):
            faster, farther = torch.zeros_like(faster), torch.zeros_like(farther)
        found.append((lattice.values @ faster, lattice.values @ farther))
    return found


class Elastic:
    """The impulses of a checkpoint with `[elastic]`."""

    def __init__(self, description: dict[str, Any]) -> None:
        if description.get("stiffness"):
            raise ValueError("elastic impulses of a network that is conditioned on the stiffness: found stiffness = true, expected false")
        self.options, self.dt = description["elastic"], description["dt"]
        self.spacing = description["surroundings"]["spacing"]
        modulus, ratio = self.options["modulus"], self.options["poisson_ratio"]
        self.mu, self.lam = modulus / (2 * (1 + ratio)), modulus * ratio / ((1 + ratio) * (1 - 2 * ratio))
        self.modulus = self.lam + 2 * self.mu  # of pressure waves
        self.rate = math.sqrt(self.modulus) / (SURFACE_WIDTH * self.spacing)
        self.steps, self.viscosity = self.options["steps"], self.options["viscosity"]
        self.wall_stiffness, self.rebound = self.options["wall_stiffness"], self.options["rebound"]
        self.contact_distance = self.options["contact_distance"] * self.spacing
        self.contact_stiffness, self.contact_viscosity = self.options["contact_stiffness"], self.options["contact_viscosity"]
        scale, distance = description["normalization"], self.options["wall_distance"] * self.spacing
        self.lower = torch.tensor(scale["minimum"][:2], dtype=torch.double) + distance
        self.upper = torch.tensor(scale["maximum"][:2], dtype=torch.double) - distance
        self.gravity = torch.tensor(description["gravity"], dtype=torch.double)

    def lattices(self, rest: Tensor, linked: Tensor) -> list[tuple[Tensor, Lattice]]:
        """The rows of each body of jelly, and its lattice, from rest positions [N, 2] and the neighbours of jelly, [N, N]."""
        linked = (linked | linked.T) & (torch.cdist(rest.double(), rest.double()) <= CONNECTED * self.spacing)
        body = torch.where(linked.any(1), torch.arange(len(rest)), -1)
        while True:
            least = torch.where(linked, body, len(rest)).amin(1)
            joined = torch.where(body >= 0, body.minimum(least), body)
            if joined.equal(body):
                break
            body = joined
        rows = [(body == number).nonzero().squeeze(1) for number in body[body >= 0].unique()]
        return [(own, Lattice(rest[own].double(), self.spacing, self.options)) for own in rows if len(own) >= FEWEST]

    def impulses(self, bodies: Bodies, lattices: list[list[tuple[Tensor, Lattice]]]) -> Bodies:
        """Those of T frames of B windows, [T, B, N, 2]: velocities before a frame, positions after it."""
        faster, farther = (torch.zeros_like(track) for track in bodies)
        for window, own in enumerate(lattices):
            rows, shapes = [rows for rows, _ in own], [lattice for _, lattice in own]
            for frame in range(len(faster)):
                position, velocity = (track[frame, window].double() for track in bodies)
                found = impulses(shapes, [(position[row], velocity[row]) for row in rows], self)
                for row, (change, way) in zip(rows, found, strict=True):
                    faster[frame, window, row], farther[frame, window, row] = change.to(faster), way.to(faster)
        return farther, faster
