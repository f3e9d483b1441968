"""The particle model in PyTorch, with eddy's tensor names: one hidden state per particle,
and a grid through which particles see their surroundings.

Letters in shapes are defined in `torch_core`; F: features, C0, C1, ..: channels of the grid's levels, I x J: nodes of the
finest. The grid is dense here: masks keep nodes that no particle touches at zero.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv_transpose2d, max_pool2d, one_hot, pad, relu

from torch_core import MATERIAL_INPUTS, MATERIALS, Bodies, State, core
from torch_lattice import Elastic

# Length scales of the proximity to walls (domain lengths).
NEAR, FAR = 0.03, 0.2
# Margin by which the velocity may leave the range of training velocities, as a fraction of that range.
VELOCITY_MARGIN = 0.25

# A solid particle's rest neighbours: largest distance (spacings), maximum and minimum number, and smallest ratio of
# the eigenvalues of their second moment.
RANGE, MOST, FEWEST, FLATTEST = 2.1, 12, 3, 0.05
# Scales of strain and bend, and the limit of the scaled values.
SHAPE_SCALE, SHAPE_LARGEST = (10.0, 10.0, 10.0, 60.0, 60.0), 4.0
# Velocity, velocity residual, wall impulse; four walls at two scales; shape; without the material.
FEATURES = 3 * 2 + 2 * 4 + len(SHAPE_SCALE)
# The stiffness that is the feature 0, the decades that are 1, and the limit of the feature.
MIDDLE_STIFFNESS, STIFFNESS_DECADES, MAX_STIFFNESS_FEATURE = 1e4, 1.5, 1.5

# Keeps a node's averages finite; mass of a node inside a body.
LEAST_MASS, FULL = 1e-3, 16.0
# Features of a node besides its channels: its fill and the proximity to the four walls.
NODE_FEATURES = 1 + 4
# The remaining constants belong to the rules: those of format version 1, and of `[rules]` as `eddy train` writes it, but for the
# rate of `area`.
# Distance to a wall that ends free flight (cells).
REACH = 1.5
# Rule `area`: width of a cell (spacings), fill of a node above which pressure acts and fill at the
# surface, sweeps and over-relaxation of the solver, largest shift (cells).
AREA_CELL, FULLEST, SURFACE, SWEEPS, OVER, LONGEST = 2, 1.25, 0.5, 20, 1.7, 0.5
# Rule `shape`: largest strain of jelly and rope; number of sweeps.
STRAIN, RESTORED = 0.03, 5
# Rule `rest`: speeds of a body's fastest cell below which it rests and above which it moves freely (units: velocity
# that gravity adds per frame).
ASLEEP, AWAKE = 0.25, 1.0
# Nodes outside the domain's corner, at least those that splines reach.
MARGIN = 4


class Around(nn.Linear):
    """Map the 3 x 3 nodes around each node, row by row from the lower left, to the node."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(9 * inputs, outputs)

    def forward(self, grid: Tensor) -> Tensor:
        kernel = self.weight.unflatten(1, (3, 3, -1)).permute(0, 3, 1, 2)
        return conv2d(grid, kernel, self.bias, padding=1)


class Down(nn.Linear):
    """Map the 2 x 2 nodes below each node of the next coarser level to that node."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(4 * inputs, outputs)

    def forward(self, grid: Tensor) -> Tensor:
        kernel = self.weight.unflatten(1, (2, 2, -1)).permute(0, 3, 1, 2)
        return conv2d(grid, kernel, self.bias, stride=2)


class Up(nn.Linear):
    """Map each node to the 2 x 2 nodes below it, with one matrix for each and a shared bias."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, 4 * outputs)
        self.bias = nn.Parameter(self.bias.detach()[:outputs].clone())

    def forward(self, grid: Tensor) -> Tensor:
        kernel = self.weight.unflatten(0, (2, 2, -1)).permute(3, 2, 0, 1)
        return conv_transpose2d(grid, kernel, self.bias, stride=2)


def spline(distance: Tensor) -> Tensor:
    """Quadratic B-spline of distances in cells."""
    outer = 0.5 * (1.5 - distance.abs()).clamp(min=0).square()
    return torch.where(distance.abs() < 0.5, 0.75 - distance.square(), outer)


def spline_until(distance: Tensor) -> Tensor:
    """Integral of `spline` from minus infinity."""
    tail = (1.5 - distance.abs()).clamp(min=0).pow(3) / 6
    outer = torch.where(distance > 0, 1 - tail, tail)
    return torch.where(distance.abs() < 0.5, 0.5 + 0.75 * distance - distance.pow(3) / 3, outer)


def spline_slope(distance: Tensor) -> Tensor:
    """Derivative of `spline`."""
    outer = -distance.sign() * (1.5 - distance.abs()).clamp(min=0)
    return torch.where(distance.abs() < 0.5, -2 * distance, outer)


def rest_neighbours(position: Tensor, material: Tensor, spacing: float) -> tuple[Tensor, Tensor, Tensor]:
    """For rest positions [B, N, 2]: the weights k of a particle's neighbours, [B, N, N], zero where the neighbours do not
    determine a deformation; their offsets X_j - X, [B, N, N, 2]; and the inverse of A, [B, N, 2, 2]."""
    position, reach = position.double(), (RANGE * spacing) ** 2
    apart = position.unsqueeze(1) - position.unsqueeze(2)  # X_j - X_i, [B, i, j, 2]
    squared = apart.square().sum(-1)
    solid = (material == MATERIALS.index("jelly")) | (material == MATERIALS.index("rope"))
    linked = (material.unsqueeze(1) == material.unsqueeze(2)) & solid.unsqueeze(2) & (squared < reach)
    linked &= ~torch.eye(position.shape[1], dtype=torch.bool)
    rank = squared.masked_fill(~linked, torch.inf).argsort(stable=True).argsort()
    linked &= rank < MOST
    weight = torch.where(linked, (1 - squared / reach).square(), 0)  # k

    moment = torch.einsum("bij,bijx,bijy->bixy", weight, apart, apart)  # A
    low, high = torch.linalg.eigvalsh(moment).unbind(-1)
    is_determined = (linked.sum(-1) >= FEWEST) & (low > FLATTEST * high)
    inverse = torch.linalg.inv(torch.where(is_determined[..., None, None], moment, torch.eye(2).double()))
    return torch.where(is_determined.unsqueeze(2), weight, 0), apart, inverse


def rest_shape(position: Tensor, material: Tensor, spacing: float) -> Tensor:
    """The linear map from positions to deformation and bend, [B, 3, N, N], for rest positions [B, N, 2].

    Its product with positions x gives the two columns of F = sum_j (x_j - x) c_j^T and the bend,
    sum_j k_j (x_j - x - F (X_j - X)) / sum_j k_j in spacings; zero where the neighbours do not determine them.
    """
    weight, apart, inverse = rest_neighbours(position, material, spacing)
    column = torch.einsum("bij,bixy,bijy->bxij", weight, inverse, apart)  # c
    mean = torch.einsum("bij,bijx->bix", weight, apart)
    share = weight - torch.einsum("bxij,bix->bij", column, mean)
    total = weight.sum(-1, keepdim=True)
    total = torch.where(total > 0, total, 1)
    shape = torch.cat([column, (share / (total * spacing)).unsqueeze(1)], 1)
    return shape - torch.diag_embed(shape.sum(-1))  # of x_j - x_i


class ParticleModel(nn.Module):
    """Predicts the frame after each of T frames."""

    def __init__(self, description: dict[str, Any]) -> None:
        super().__init__()
        sizes, surroundings = description["sizes"], description["surroundings"]
        width, hidden, channels = sizes["encoder"], sizes["hidden"], surroundings["channels"]
        # Share of the excess that the rule `area` removes in a frame: all in format version 1, which has no rules.
        rules = description.get("rules", {})
        self.rate = rules.get("area", {}).get("rate", 1.0)
        self.elastic = Elastic(description) if "elastic" in rules else None
        self.dt, self.spacing, self.cell = description["dt"], surroundings["spacing"], surroundings["cell_width"]

        self.is_conditioned = description.get("stiffness", False)
        self.materials = description.get("material_inputs", MATERIAL_INPUTS)
        features, c0 = FEATURES + self.materials + self.is_conditioned, channels[0]
        self.encoder = nn.ModuleList([nn.Linear(features, width), nn.Linear(width, c0)])
        levels = []
        for level, own in enumerate(channels):
            if level == 0:
                layers = {"a": Around(c0 + NODE_FEATURES, c0), "b": Around(c0, c0)}
            else:
                layers = {"down": Down(channels[level - 1], own), "a": Around(own, own)}
            if level + 1 < len(channels):
                layers["up"] = Up(channels[level + 1], own)
            layers["b" if level > 0 else "c"] = Around(own, own)
            levels.append(nn.ModuleDict(layers))
        self.grid = nn.ModuleDict({str(level): layers for level, layers in enumerate(levels)})
        self.context = nn.Linear(features + c0, hidden)
        self.core = core(description, hidden)
        self.mixer = nn.Linear(hidden, hidden)
        self.decoder = nn.Linear(hidden, 4)

        scale = {name: torch.tensor(values) for name, values in description["normalization"].items()}
        margin = VELOCITY_MARGIN * (scale["maximum"] - scale["minimum"])[2:]
        corner, end = (torch.tensor(description["domain"][side]) for side in ("lower", "upper"))
        ends = (torch.ceil((end - corner) / self.cell) + 2).int().tolist()
        # So that the coarsest level also starts at a node.
        self.margin = max(MARGIN, 2 ** (len(channels) - 1))
        x, y = (torch.arange(-self.margin, end + -end % self.margin) for end in ends)
        constants = {
            "gravity": torch.tensor(description["gravity"]),
            "unit": scale["standard_deviation"][2:].square().mean().sqrt(),
            "lower": scale["minimum"][:2],  # walls in effect
            "upper": scale["maximum"][:2],
            "slowest": scale["minimum"][2:] - margin,
            "fastest": scale["maximum"][2:] + margin,
            "shape_scale": torch.tensor(SHAPE_SCALE),
            "corner": corner,
            "far_corner": end,
            "node_x": x.float(),  # [I]
            "node_y": y.float(),  # [J]
        }
        for name, tensor in constants.items():
            self.register_buffer(name, tensor, persistent=False)

    def matter(self, material: Tensor, rest: Tensor, stiffness: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Static inputs: materials [B, N] as features [B, N, M], with the stiffness [B] behind them, [B, N, M + 1], if the network
        is conditioned on it; and `rest_shape` of the rest positions [B, N, 2], which are those of a stream's first frame."""
        if (stiffness is not None) != self.is_conditioned:
            raise ValueError(f"found stiffness {stiffness}, expected {'one for each window' if self.is_conditioned else 'none'}")
        features = one_hot(material, self.materials).to(self.unit)
        if stiffness is not None:
            feature = torch.log10(stiffness.to(self.unit) / MIDDLE_STIFFNESS) / STIFFNESS_DECADES
            feature = feature.clamp(-MAX_STIFFNESS_FEATURE, MAX_STIFFNESS_FEATURE)
            features = torch.cat([features, feature[:, None, None].expand(-1, material.shape[1], 1)], -1)
        return features, rest_shape(rest, material, self.spacing).to(self.unit)

    def forward(
        self, bodies: Bodies, matter: tuple[Tensor, Tensor], state: tuple[State, Tensor] | None = None
    ) -> tuple[Bodies, tuple[State, Tensor]]:
        """The frame after each of T frames, and after the last one the core's state and the velocities expected from the
        ballistic step; `matter` comes from `matter()`."""
        position, velocity = (track.to(self.unit) for track in bodies)
        carried, expected = (None, velocity[0]) if state is None else state
        fallen_position, fallen_velocity, impulse = self.fall(position, velocity)
        residual = velocity - torch.cat([expected.unsqueeze(0), fallen_velocity[:-1]])
        features = self.features(position, torch.cat([velocity, residual, impulse], -1), matter)  # [T, B, N, F]

        encoded = self.encoder[1](relu(self.encoder[0](features)))  # [T, B, N, C0]
        context = torch.stack([self.look_around(*frame) for frame in zip(position, encoded)])
        signal = relu(self.context(torch.cat([features, context], -1)))  # [T, B, N, H]
        signal, carried = self.core(signal.flatten(1, 2), carried)
        output = self.decoder(relu(self.mixer(signal))).unflatten(1, position.shape[1:3])  # [T, B, N, 4]

        faster, farther = (self.unit * output).split(2, -1)
        velocity = (fallen_velocity + faster).clamp(self.slowest, self.fastest)
        position = (fallen_position + self.dt * farther).clamp(self.lower, self.upper)
        return (position, velocity), (carried, fallen_velocity[-1])

    def fall(self, position: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The ballistic step: the next positions and velocities, and the wall impulses."""
        faster = velocity + self.gravity * self.dt
        free = position + 0.5 * (velocity + faster) * self.dt
        held = free.clamp(self.lower, self.upper)
        impulse = torch.where(held == free, 0, -faster)
        return held, faster + impulse, impulse

    def features(self, position: Tensor, velocities: Tensor, matter: tuple[Tensor, Tensor]) -> Tensor:
        """[T, B, N, F] from positions [T, B, N, 2] and velocities, velocity residuals and wall impulses [T, B, N, 6]."""
        material, shape = matter
        distance = torch.cat([position - self.lower, self.upper - position], -1).clamp(min=0)
        walls = torch.cat([torch.exp(-distance / NEAR), torch.exp(-distance / FAR)], -1)
        material = material.expand(len(position), -1, -1, -1)
        return torch.cat([velocities / self.unit, walls, self.strain(position, shape), material], -1)

    def strain(self, position: Tensor, shape: Tensor) -> Tensor:
        """Strain B - 1, B = F F^T, as xx, yy, xy, and bend as x, y, [T, B, N, 5]."""
        solid = (shape != 0).any(3).any(1).unsqueeze(-1)  # [B, N, 1]
        first, second, bend = torch.einsum("bkij,tbjx->ktbix", shape, position)
        square = first.square() + second.square() - solid.to(first)
        product = first.prod(-1, keepdim=True) + second.prod(-1, keepdim=True)
        numbers = torch.cat([square, product, bend], -1) * self.shape_scale
        return numbers.clamp(-SHAPE_LARGEST, SHAPE_LARGEST)

    def look_around(self, position: Tensor, encoded: Tensor) -> Tensor:
        """Scatter `encoded`, [B, N, C0], to the grid, apply the convolutions and gather the result, [B, N, C0], at
        `position`, [B, N, 2], inside the domain."""
        x, y = ((position - self.corner) / self.cell).unsqueeze(-1).unbind(2)
        across, up = spline(x - self.node_x), spline(y - self.node_y)  # weights [B, N, I], [B, N, J]
        mass = torch.einsum("bnj,bni->bji", up, across).unsqueeze(1)  # [B, 1, J, I]
        written = torch.einsum("bnj,bni,bnc->bcji", up, across, encoded) / (mass + LEAST_MASS)
        walls = self.node_walls().expand(len(mass), -1, -1, -1)

        levels, there = list(self.grid.values()), [(mass > 0).to(mass)]
        while len(there) < len(levels):
            there.append(max_pool2d(there[-1], 2))
        held = there[0] * torch.cat([written, mass / FULL, walls], 1)  # [B, C0 + 5, J, I]
        held = there[0] * relu(levels[0]["a"](held))
        skipped = [there[0] * relu(levels[0]["b"](held))]
        for layers, mask in zip(levels[1:], there[1:]):
            held = mask * relu(layers["down"](skipped[-1]))  # [B, C1, J / 2, I / 2] and so on
            skipped.append(mask * relu(layers["a"](held)))
        held = there[-1] * relu(levels[-1]["b"](skipped[-1]))
        for level in reversed(range(len(levels) - 1)):
            held = there[level] * relu(levels[level]["up"](held) + skipped[level])
            if level > 0:
                held = there[level] * relu(levels[level]["b"](held))
        return torch.einsum("bnj,bni,bcji->bnc", up, across, levels[0]["c"](held))

    def node_walls(self) -> Tensor:
        """Proximity of the left, lower, right and upper wall at each node, [4, J, I]."""
        (left, lower), (right, upper) = self.lower, self.upper
        x = self.corner[0] + self.cell * self.node_x  # [I]
        y = self.corner[1] + self.cell * self.node_y.unsqueeze(-1)  # [J, 1]
        distances = torch.broadcast_tensors(x - left, y - lower, right - x, upper - y)
        return torch.exp(-torch.stack(distances).clamp(min=0) / self.cell)

    def keep_area(self, material: Tensor, predicted: Bodies) -> Bodies:
        """First rule, on the network's prediction, [N, 2] each: liquids keep their area."""
        position, velocity = predicted
        cell = AREA_CELL * self.spacing
        extent = ((self.far_corner - self.corner) / cell).ceil().int().tolist()
        x, y = (torch.arange(-2.0, end + 4) for end in extent)  # [I], [J]
        place, low, high = ((at - self.corner) / cell for at in (position, self.lower, self.upper))
        across, up = (spline(place[:, axis, None] - nodes) for axis, nodes in enumerate((x, y)))
        columns, rows = ((nodes >= low[axis]) & (nodes <= high[axis]) for axis, nodes in enumerate((x, y)))
        inside, beyond = rows.unsqueeze(1) & columns, 0.5 / AREA_CELL
        share = [
            spline_until(high[axis] + beyond - nodes) - spline_until(low[axis] - beyond - nodes)
            for axis, nodes in enumerate((x, y))
        ]
        wet = (material == MATERIALS.index("liquid")).to(position)
        mass = torch.einsum("nj,ni->ji", up, across) / AREA_CELL**2
        liquid = torch.einsum("nj,ni,n->ji", up, across, wet) / AREA_CELL**2 / mass.clamp(min=1e-9)
        fill = torch.where(inside, mass / (share[1].unsqueeze(1) * share[0]).clamp(min=1e-9), 0)
        pressed = fill >= SURFACE
        excess = torch.where(pressed, self.rate * (fill - FULLEST).clamp(min=0) * liquid, 0)
        if not (excess > 0).any():
            return predicted

        def neighbours(field: Tensor) -> Tensor:
            framed = pad(field[None], (1, 1, 1, 1))[0]
            return framed[:-2, 1:-1] + framed[2:, 1:-1] + framed[1:-1, :-2] + framed[1:-1, 2:]

        pressure, count = torch.zeros_like(fill), neighbours(inside.to(fill))
        odd = (torch.arange(len(y)).unsqueeze(1) + torch.arange(len(x))) % 2
        for sweep in range(2 * SWEEPS):
            level = (neighbours(pressure) + excess) / count.clamp(min=1)
            relaxed = (pressure + OVER * (level - pressure)).clamp(min=0)
            pressure = torch.where(pressed & (odd == sweep % 2), relaxed, pressure)
        kept = pressure[rows][:, columns][None, None]
        left, below = int(columns.int().argmax()), int(rows.int().argmax())
        pressure = pad(kept, (2, 2, 2, 2), mode="replicate")[0, 0]  # outside the walls as at the walls
        x, y = x[left - 2 : left + kept.shape[3] + 2], y[below - 2 : below + kept.shape[2] + 2]
        across, up = place[:, 0, None] - x, place[:, 1, None] - y
        slope = torch.stack(
            [
                torch.einsum("nj,ni,ji->n", spline(up), spline_slope(across), pressure),
                torch.einsum("nj,ni,ji->n", spline_slope(up), spline(across), pressure),
            ],
            -1,
        )
        shift = wet.unsqueeze(1) * -slope.clamp(-LONGEST, LONGEST) * cell
        moved = (position + shift).clamp(self.lower, self.upper)
        return moved, velocity + (moved - position) / self.dt

    def keep_shape(self, matter: tuple[Tensor, Tensor, Tensor], predicted: Bodies) -> Bodies:
        """Second rule, on a prediction, [N, 2] each: jelly and rope keep their shape. `matter` is the
        `rest_shape`, [3, N, N], with weights and offsets from `rest_neighbours`."""
        (shape, weight, apart), (position, velocity) = matter, predicted
        solid = weight.sum(1) > 0
        share = weight / torch.where(solid, weight.sum(1), 1).unsqueeze(1)
        gradient = torch.einsum("kij,jx->ixk", shape[:2], position)  # F, [N, 2, 2]
        left, stretch, right = torch.linalg.svd(torch.where(solid[:, None, None], gradient, torch.eye(2).to(gradient)))
        # Rotations only: a reflection becomes a negative stretch.
        mirrored = torch.stack([torch.ones(len(left)).to(left), torch.det(left @ right).sign()], 1)
        stretch = (stretch * mirrored).clamp(1 - STRAIN, 1 + STRAIN)
        limited = left * (mirrored * stretch).unsqueeze(1) @ right
        own = torch.einsum("ixy,ij,ijy->ix", limited, share, apart)
        theirs = torch.einsum("jxy,ij,ijy->ix", limited, share, apart)
        place = position
        for _ in range(RESTORED):
            there = share @ place - 0.5 * (own + theirs)
            place = torch.where(solid.unsqueeze(1), there.clamp(self.lower, self.upper), place)
        return place, velocity + (place - position) / self.dt

    def keep_momentum(self, bodies: Bodies, predicted: Bodies) -> Bodies:
        """Third and fourth rule, on a prediction, [N, 2] each, for the frame after `bodies`, [N, 2] each: bodies in
        free flight keep momentum and angular momentum, and other bodies that hardly move come to rest."""
        position, velocity = (track.to(self.unit) for track in bodies)
        faster = velocity + self.gravity * self.dt
        fallen = position + 0.5 * (velocity + faster) * self.dt
        number, reach = self.body(bodies[0]), REACH * self.cell
        kept_position, kept_velocity = (track.clone() for track in predicted)

        def turn(arm: Tensor, way: Tensor) -> Tensor:
            return (arm[:, 0] * way[:, 1] - arm[:, 1] * way[:, 0]).sum()

        for body in number.unique():
            own = number == body
            way = 0.5 * self.dt * (velocity[own] + faster[own]).mean(0)
            lowest, highest = position[own].amin(0), position[own].amax(0)
            touches = (lowest + way.clamp(max=0) < self.lower + reach) | (highest + way.clamp(min=0) > self.upper - reach)
            if touches.any():
                cells = torch.floor((position[own] - self.corner) / self.cell - 0.5).long()
                squares = torch.stack([track[own].square().sum(1) for track in (velocity, predicted[1])])
                fastest = max(squares[:, (cells == cell).all(1)].mean(1).max() for cell in cells.unique(dim=0))
                fastest = fastest.sqrt() / (self.gravity.norm() * self.dt)
                awake = ((fastest - ASLEEP) / (AWAKE - ASLEEP)).clamp(0, 1)
                kept_position[own] = position[own] + awake * (predicted[0][own] - position[own])
                kept_velocity[own] = awake * predicted[1][own]
                continue
            arm, flight = fallen[own] - fallen[own].mean(0), faster[own] - faster[own].mean(0)
            found, speed = (track[own] - track[own].mean(0) for track in predicted)
            turned = torch.stack([-arm[:, 1], arm[:, 0]], -1)
            found = found - turn(arm, found) / arm.square().sum().clamp(min=1e-10) * turned
            turned = torch.stack([-found[:, 1], found[:, 0]], -1)
            spin = (turn(found, speed) - turn(arm, flight)) / found.square().sum().clamp(min=1e-10)
            kept_position[own] = (fallen[own].mean(0) + found).clamp(self.lower, self.upper)
            kept_velocity[own] = faster[own].mean(0) + speed - spin * turned
        return kept_position, kept_velocity

    def body(self, position: Tensor) -> Tensor:
        """The index of the body that each particle belongs to, [N]; a body is a connected group of nodes."""
        place = torch.floor((position - self.corner) / self.cell - 0.5).long() + self.margin
        there = torch.zeros(1, len(self.node_y), len(self.node_x))
        for across in range(3):
            for up in range(3):
                there[0, place[:, 1] + up, place[:, 0] + across] = 1
        number, before = there * torch.arange(1.0, there.numel() + 1).view_as(there), None
        while before is None or not number.equal(before):
            before, number = number, there * max_pool2d(number, 3, stride=1, padding=1)
        return number[0, place[:, 1], place[:, 0]]
