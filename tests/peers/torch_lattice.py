"""The rule `elastic` in PyTorch: bilinear elements on a lattice for each body of jelly, fitted to its particles by least squares.

It follows the description in eddy's documentation and `[rules.elastic]` of `model.toml`, with dense matrices where eddy has sparse ones, for
networks that are not conditioned on the stiffness and bodies that need no more steps (narrow ones do, and light corners that walls push).
"""

import math
from typing import Any

import torch
from torch import Tensor

from torch_core import Bodies

# Particles of a body at least, share of a full element's particles that fills an element, mass of a node at least (full elements).
FEWEST, FILLED, LIGHTEST = 16, 0.4, 0.1
# Width of the parts of a surface, and what the stiffness of walls refers to (spacings).
PART, SURFACE_WIDTH = 1.75, 3.5
# Speed away from a wall from which on its push is the share `rebound`.
REBOUNDING = 0.1
# Distance of connected particles (spacings); largest change of a node's velocity, with a
# larger one there is none.
CONNECTED, FASTEST = 1.5, 64.0
# Strain that tears a body while walls push it, relative to that of a free one.
PUSHED_STRAIN = 2
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
        # Of the nodes in the coming frame, and the largest sum of mass x squared distance from there; none is expected first.
        self.expected: tuple[Tensor, float] | None = None
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

    def weighted_distance(self, one: Tensor, other: Tensor) -> float:
        """Sum of mass x squared distance of nodes, [M, 2] each."""
        return float((self.mass * (one - other).square().sum(1)).sum())

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
        force = -torch.einsum("q,qij,qmj->mi", self.count.to(x), stress, self.gradients)
        place, speed = self.weights @ x, self.weights @ v + law.gravity * step
        depth = (law.lower - place).clamp(min=0) - (place - law.upper).clamp(min=0)
        share = 1 - (1 - law.rebound) * (speed * depth.sign() / REBOUNDING).clamp(0, 1)
        push = law.wall_stiffness * law.rate**2 * share * depth * self.particles.unsqueeze(1)
        return force + self.weights.T @ push


class Elastic:
    """The rule of a checkpoint with `[rules.elastic]`."""

    def __init__(self, description: dict[str, Any]) -> None:
        if description.get("stiffness"):
            raise ValueError("the rule `elastic` of a network that is conditioned on the stiffness: found stiffness = true, expected false")
        self.options, self.dt = description["rules"]["elastic"], description["dt"]
        self.spacing = description["surroundings"]["spacing"]
        modulus, ratio = self.options["modulus"], self.options["poisson_ratio"]
        self.mu, self.lam = modulus / (2 * (1 + ratio)), modulus * ratio / ((1 + ratio) * (1 - 2 * ratio))
        self.modulus = self.lam + 2 * self.mu  # of pressure waves
        self.rate = math.sqrt(self.modulus) / (SURFACE_WIDTH * self.spacing)
        self.steps, self.viscosity = self.options["steps"], self.options["viscosity"]
        self.most_error = self.options.get("most_error", math.inf)
        self.small_error = self.options.get("small_error", 0.0) * self.spacing
        self.wall_stiffness, self.rebound = self.options["wall_stiffness"], self.options["rebound"]
        scale, distance = description["normalization"], self.options["wall_distance"] * self.spacing
        self.walls = [torch.tensor(scale[side][:2], dtype=torch.double) for side in ("minimum", "maximum")]
        self.lower, self.upper = self.walls[0] + distance, self.walls[1] - distance
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

    def move(self, position: Tensor, velocity: Tensor, lattice: Lattice) -> Bodies | None:
        """A body's particles one frame later, [P, 2] each; none if its lattice diverges. Its nodes are then expected there."""
        x0, v0 = x, v = lattice.fit(position, velocity)
        step = self.dt / self.steps
        for _ in range(self.steps):
            v = v + step * (lattice.forces(x, v, self, step) / lattice.mass.unsqueeze(1) + self.gravity)
            x = x + step * v
        fallen = self.gravity * self.dt
        faster = v - v0 - fallen
        if not bool((faster.abs() <= FASTEST).all()):
            return None
        farther = x - x0 - (v0 + faster + fallen / 2) * self.dt
        if self.most_error < math.inf:
            moved = lattice.weighted_distance(x, x0 + (v0 + fallen / 2) * self.dt)
            lattice.expected = x, self.most_error * moved + len(position) * self.small_error**2
        velocity = velocity + lattice.values @ faster
        moved = position + (velocity + fallen / 2) * self.dt + lattice.values @ farther
        return moved.clamp(*self.walls), velocity + fallen

    def replace(self, shown: Bodies, next: Bodies, lattices: list[tuple[Tensor, Lattice]]) -> Bodies:
        """The prediction `next` after `shown`, [N, 2] each, with the motion of bodies of jelly that are whole, nothing else is close to, and
        whose nodes are where they were expected."""
        position, velocity = (track.double() for track in shown)
        to, speed = (track.clone() for track in next)
        for rows, lattice in lattices:
            is_other = torch.ones(len(position), dtype=torch.bool)
            is_other[rows] = False
            nodes = lattice.fit(position[rows], velocity[rows])[0]
            expected, lattice.expected = lattice.expected, None
            stretch = torch.linalg.svdvals(torch.einsum("mi,qmj->qij", nodes, lattice.gradients))[:, 0]
            parts = lattice.weights @ nodes
            pushed = bool(((parts < self.lower) | (parts > self.upper)).any())
            strain = (PUSHED_STRAIN if pushed else 1) * (self.options["most_stretch"] - 1)
            if not bool((stretch <= 1 + strain).all()):
                continue
            if bool((torch.cdist(position[is_other], parts) < self.options["clear_distance"] * self.spacing).any()):
                continue
            moved = self.move(position[rows], velocity[rows], lattice)
            if moved is not None and (expected is None or lattice.weighted_distance(nodes, expected[0]) <= expected[1]):
                to[rows], speed[rows] = (track.to(to) for track in moved)
        return to, speed
