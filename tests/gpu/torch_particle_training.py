"""Times training steps of the particle model in PyTorch on an NVIDIA GPU, as a rival for `particle_training time`.

    python3 tests/gpu/torch_particle_training.py tf32|fp32 FREE_FRAMES ..

One step is forward through 3 observed frames (together, but for the core) and so many free ones, mean squared error,
backward and Adam (fused), for 16 windows of 2,500 particles with minGRU, on data that is on the GPU already. Particles are
summed up on a dense grid by `index_add_`, whose convolutions cuDNN computes; the rest shape is 12 links a particle.
Each way to run it that PyTorch offers is timed with CUDA events; the table compares with the fastest.
"""

import statistics
import sys
import time
from pathlib import Path

import torch
from torch import nn
from torch.nn.functional import max_pool2d, relu

sys.path.append(str(Path(__file__).resolve().parents[1] / "peers"))
import torch_core  # noqa: E402

WINDOWS, PARTICLES, WARM_UP, LINKS = 16, 2500, 3, 12
ENCODER, HIDDEN, CHANNELS = 16, 24, (24, 32, 48)
# Of eddy's domain of length 1 with particles at a distance of 1 / 128.
CELL, DT, UNIT = 4 / 128, 0.016, 0.5
NODES, MARGIN = 44, 4
FEATURES = 6 + 8 + 5 + 4
NODE_FEATURES = 5


class MinGru(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(HIDDEN, 2 * HIDDEN)

    def forward(self, x, state):
        return torch.lerp(state, *torch_core.mingru(*self.linear(x).chunk(2, -1)))


class Network(nn.Module):
    def __init__(self):
        super().__init__()
        c0, c1, c2 = CHANNELS
        self.encoder = nn.Sequential(nn.Linear(FEATURES, ENCODER), nn.ReLU(), nn.Linear(ENCODER, c0))
        around = lambda a, b: nn.Conv2d(a, b, 3, padding=1)
        self.fine = nn.ModuleList([around(c0 + NODE_FEATURES, c0), around(c0, c0), around(c0, c0)])
        self.middle = nn.ModuleList([around(c1, c1), around(c1, c1)])
        self.coarse = nn.ModuleList([around(c2, c2), around(c2, c2)])
        self.down = nn.ModuleList([nn.Conv2d(c0, c1, 2, 2), nn.Conv2d(c1, c2, 2, 2)])
        self.up = nn.ModuleList([nn.ConvTranspose2d(c1, c0, 2, 2), nn.ConvTranspose2d(c2, c1, 2, 2)])
        self.context = nn.Linear(FEATURES + c0, HIDDEN)
        self.core = nn.ModuleList([MinGru(), MinGru()])
        self.mixer, self.decoder = nn.Linear(HIDDEN, HIDDEN), nn.Linear(HIDDEN, 4)

    def surroundings(self, position, velocity, expected, links):
        """What particles see: [B, N, FEATURES + C0]."""
        number, coefficient, material = links  # [B, N, 12], [B, N, 12, 3], [B, N, 4]
        batch = position.shape[0]
        fallen = velocity + torch.tensor([0.0, -9.81 * DT], device=position.device)
        held = position + 0.5 * DT * (velocity + fallen)
        impulse = torch.where((held > 0) & (held < 1), 0.0, -fallen)
        distance = torch.cat([position, 1 - position], -1).clamp(min=0)
        there = torch.gather(position, 1, number.flatten(1).unsqueeze(-1).expand(-1, -1, 2))
        apart = there.view(batch, PARTICLES, LINKS, 2) - position.unsqueeze(2)
        shape = torch.einsum("bnlk,bnlx->bnkx", coefficient, apart)
        first, second, bend = shape.unbind(2)
        strain = torch.cat([first * first + second * second, (first * second).sum(-1, keepdim=True), bend], -1).clamp(-4, 4)
        features = torch.cat(
            [
                velocity / UNIT,
                (velocity - expected) / UNIT,
                impulse / UNIT,
                torch.exp(-distance / 0.03),
                torch.exp(-distance / 0.2),
                strain,
                material,
            ],
            -1,
        )
        encoded = self.encoder(features)
        place = position / CELL
        lowest = torch.floor(place - 0.5)
        d = (place - lowest).unsqueeze(-1)
        weights = torch.cat([0.5 * (1.5 - d) ** 2, 0.75 - (d - 1) ** 2, 0.5 * (d - 0.5) ** 2], -1)  # [B, N, 2, 3]
        weight = (weights[..., 1, :, None] * weights[..., 0, None, :]).flatten(-2)  # [B, N, 9]
        step = torch.arange(3, device=position.device)
        base = lowest.long() + MARGIN
        node = (base[..., 1, None, None] + step[:, None]) * NODES + base[..., 0, None, None] + step
        node = node.flatten(-2) + NODES * NODES * torch.arange(batch, device=position.device).view(-1, 1, 1)
        written = torch.cat([encoded, torch.ones_like(encoded[..., :1])], -1).unsqueeze(2) * weight.unsqueeze(-1)
        grid = torch.zeros(batch * NODES * NODES, CHANNELS[0] + 1, device=position.device)
        grid = grid.index_add(0, node.flatten(), written.flatten(0, 2))
        mass = grid[:, -1:]
        grid = torch.cat([grid[:, :-1] / (mass + 1e-3), mass / 16, mass.new_zeros(len(mass), 4)], -1)
        grid = grid.view(batch, NODES, NODES, -1).permute(0, 3, 1, 2)
        fine = (mass > 0).float().view(batch, 1, NODES, NODES)
        middle = max_pool2d(fine, 2)
        coarse = max_pool2d(middle, 2)
        a = fine * relu(self.fine[1](fine * relu(self.fine[0](fine * grid))))
        b = middle * relu(self.middle[0](middle * relu(self.down[0](a))))
        c = coarse * relu(self.coarse[0](coarse * relu(self.down[1](b))))
        c = coarse * relu(self.coarse[1](c))
        b = middle * relu(self.middle[1](middle * relu(self.up[1](c) + b)))
        a = self.fine[2](fine * relu(self.up[0](b) + a))
        rows = a.permute(0, 2, 3, 1).reshape(batch * NODES * NODES, -1)
        gathered = (rows[node.flatten()].view(batch, PARTICLES, 9, -1) * weight.unsqueeze(-1)).sum(2)
        return torch.cat([features, gathered], -1)

    def move(self, seen, position, velocity, states):
        """The next positions and velocities, and states."""
        x = relu(self.context(seen))
        new = []
        for layer, state in zip(self.core, states.unbind()):
            x = layer(x, state)
            new.append(x)
        faster, farther = (UNIT * self.decoder(relu(self.mixer(x)))).chunk(2, -1)
        fallen = velocity + torch.tensor([0.0, -9.81 * DT], device=position.device)
        velocity_next = (fallen + faster).clamp(-5, 5)
        position_next = (position + 0.5 * DT * (velocity + fallen) + DT * farther).clamp(0.01, 0.99)
        return position_next, velocity_next, torch.stack(new)


def milliseconds(step, steps=5, repetitions=5):
    for _ in range(3):
        step()
    torch.cuda.synchronize()
    times = []
    for _ in range(repetitions):
        start, end = torch.cuda.Event(True), torch.cuda.Event(True)
        start.record()
        for _ in range(steps):
            step()
        end.record()
        torch.cuda.synchronize()
        times.append(start.elapsed_time(end) / steps)
    return statistics.median(times)


def trajectory(frames):
    """Four blocks of 25 x 25 particles in each window, which move evenly: [T, B, N, 2] twice."""
    torch.manual_seed(1)
    k = torch.arange(625)
    block = torch.stack([k % 25, k // 25], -1) / 128
    corner = torch.tensor([[0.08 + 0.22 * n, 0.3] for n in range(4)]) + torch.rand(WINDOWS, 4, 2) * torch.tensor([0.0, 0.2])
    start = (corner.unsqueeze(2) + block).flatten(1, 2)
    speed = (0.05 * torch.randn(WINDOWS, 4, 1, 2)).expand(-1, -1, 625, -1).flatten(1, 2)
    times = DT * torch.arange(frames).view(-1, 1, 1, 1)
    return (start + times * speed).cuda(), speed.expand(frames, -1, -1, -1).contiguous().cuda()


def run(free, compiled, graph):
    torch._dynamo.reset()
    torch.cuda.empty_cache()
    network = Network().cuda()
    position, velocity = trajectory(WARM_UP + free)
    number = torch.randint(0, PARTICLES, (WINDOWS, PARTICLES, LINKS), device="cuda")
    coefficient = 0.1 * torch.randn(WINDOWS, PARTICLES, LINKS, 3, device="cuda")
    material = torch.eye(4, device="cuda")[torch.arange(PARTICLES, device="cuda") // 625].expand(WINDOWS, -1, -1)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3, fused=True, capturable=graph)
    surroundings, move = network.surroundings, network.move
    if compiled:
        surroundings, move = torch.compile(surroundings), torch.compile(move)
    together = tuple(tensor.repeat(WARM_UP, *[1] * (tensor.dim() - 1)) for tensor in (number, coefficient, material))

    def step():
        optimizer.zero_grad(set_to_none=not graph)
        shown = [track[:WARM_UP].flatten(0, 1) for track in (position, velocity)]
        expected = torch.cat([velocity[:1], velocity[: WARM_UP - 1]]).flatten(0, 1)
        seen = surroundings(*shown, expected, together).unflatten(0, (WARM_UP, WINDOWS))
        states, loss = torch.zeros(2, WINDOWS, PARTICLES, HIDDEN, device="cuda"), 0.0
        for t in range(WARM_UP + free - 1):
            if t < WARM_UP:
                x, v, s = position[t], velocity[t], seen[t]
            else:
                x, v, s = x_next, v_next, surroundings(x_next, v_next, v, (number, coefficient, material))
            x_next, v_next, states = move(s, x, v, states)
            loss = loss + (x_next - position[t + 1]).square().mean() + 0.1 * (v_next - velocity[t + 1]).square().mean()
        loss.backward()
        optimizer.step()

    if not graph:
        return milliseconds(step)
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            step()
    torch.cuda.current_stream().wait_stream(stream)
    recorded = torch.cuda.CUDAGraph()
    with torch.cuda.graph(recorded):
        step()
    return milliseconds(recorded.replay)


def main():
    precision = sys.argv[1]
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = precision == "tf32"
    torch.backends.cudnn.benchmark = True
    for free in map(int, sys.argv[2:]):
        best = float("inf")
        for name, compiled, graph in [("eager", False, False), ("eager in a graph", False, True), ("compiled in a graph", True, True)]:
            begun = time.perf_counter()
            try:
                found = run(free, compiled, graph)
            except Exception as error:  # a way that does not work here is no rival
                print(f"{free} free frames {precision}: {name}: {type(error).__name__}: {str(error)[:200]!r}", flush=True)
                continue
            best = min(best, found)
            print(f"{free} free frames {precision}: {name}: {found:.3f} ms ({time.perf_counter() - begun:.0f} s in all)", flush=True)
        print(f"{free} free frames {precision}: best of PyTorch {best:.3f} ms", flush=True)


main()
