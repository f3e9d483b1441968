"""Times frames of the paper's frame model in PyTorch on an NVIDIA GPU, as a rival for `frame_inference time`.

    python3 tests/gpu/torch_inference.py

A frame of B streams of 2,500 particles, from pinned memory of the host to pinned memory of the host; the hidden states
stay on the GPU. FP32, minGRU. The table has the median and the 99th percentile of the time from the call to the result.
"""

import sys
import time
from pathlib import Path

import torch
import torch.nn.functional as functional
from torch import nn

sys.path.append(str(Path(__file__).resolve().parents[1] / "peers"))
import torch_core  # noqa: E402

PARTICLES, HIDDEN, ENCODER, FEATURES, FRAMES = 2500, 1250, 256, 8, 1000


class Network(nn.Module):
    def __init__(self):
        super().__init__()
        self.points, self.pooled = nn.Linear(FEATURES, ENCODER), nn.Linear(ENCODER, HIDDEN)
        self.core = nn.ModuleList([nn.Linear(HIDDEN, 2 * HIDDEN) for _ in range(2)])
        self.mixer, self.decoder = nn.Linear(HIDDEN, HIDDEN), nn.Linear(HIDDEN, 2 * PARTICLES)

    def forward(self, bodies, material, states):  # [B, N, 4], [B, N, 4], [2, B, H]
        x = torch.cat([bodies, material], -1)
        x = self.pooled(functional.elu(self.points(x)).mean(-2))
        new = []
        for layer, state in zip(self.core, states):
            x = torch.lerp(state, *torch_core.mingru(*layer(x).chunk(2, -1)))
            new.append(x)
        change = self.decoder(functional.elu(self.mixer(x))).view(-1, PARTICLES, 2)
        velocity = bodies[..., 2:] + change
        return torch.cat([bodies[..., :2] + 0.016 * velocity, velocity], -1), torch.stack(new)


@torch.no_grad()
def run(streams, way):
    torch._dynamo.reset()
    network = Network().cuda()
    compiled = network if way == "eager" else torch.compile(network)
    host = [torch.rand(streams, PARTICLES, 4).pin_memory() for _ in range(2)]
    bodies = torch.empty(streams, PARTICLES, 4, device="cuda")
    material = functional.one_hot(torch.randint(0, 4, (streams, PARTICLES)), 4).float().cuda()
    states = torch.zeros(2, streams, HIDDEN, device="cuda")

    def step():
        bodies.copy_(host[0], non_blocking=True)
        following, new = compiled(bodies, material, states)
        states.copy_(new)
        host[1].copy_(following, non_blocking=True)

    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        for _ in range(4):
            step()
    torch.cuda.synchronize()
    if way == "compile in a graph":
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            step()
        step = graph.replay
    times = []
    for _ in range(FRAMES):
        start = time.perf_counter()
        step()
        torch.cuda.synchronize()
        times.append(1e6 * (time.perf_counter() - start))
    times.sort()
    return times[FRAMES // 2], times[FRAMES * 99 // 100]


for streams in [1, 8, 64]:
    for way in ["eager", "compile", "compile in a graph"]:
        median, slow = run(streams, way)
        print(f"mingru: {streams} streams: {way}: {median:.1f} us a frame of all, 99th percentile {slow:.1f}", flush=True)
