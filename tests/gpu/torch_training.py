"""Times training steps of the paper's frame model in PyTorch on an NVIDIA GPU, as a rival for eddy's.

    python3 tests/gpu/torch_training.py CORE FEATURES tf32|fp32 [PARTICLES FRAMES [WINDOWS]]

One step is forward, mean squared error of all frames, backward and Adam (fused), for 256 windows of 2 frames of 2,500
particles if no others are given, on data that is on the GPU already. Each way to run it that PyTorch offers is timed with
CUDA events; the table compares with the fastest. With 8 particles and many frames, the core takes nearly all of the time;
then the minimal cores run frame by frame, and in the parallel form that is exact and does not overflow: prefix products by
doubling.
"""

import statistics
import sys
from pathlib import Path

import torch
import torch.nn.functional as functional
from torch import nn

sys.path.append(str(Path(__file__).resolve().parents[1] / "peers"))
import torch_core  # noqa: E402

SIZES = [2500, 2, 256]
given = [int(number) for number in sys.argv[4:]]
PARTICLES, FRAMES, WINDOWS = given + SIZES[len(given) :]
HIDDEN, ENCODER = 1250, 256


class MinGru(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(HIDDEN, 2 * HIDDEN)

    def forward(self, x):  # [T, B, H]
        candidate, update = torch_core.mingru(*self.linear(x).chunk(2, -1))
        return scan(1 - update, update * candidate)


class MinLstm(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(HIDDEN, 3 * HIDDEN)

    def forward(self, x):
        candidate, update = torch_core.minlstm(*self.linear(x).chunk(3, -1))
        return scan(1 - update, update * candidate)


class Mlp(nn.Module):
    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(HIDDEN, HIDDEN)

    def forward(self, x):
        return functional.elu(self.linear(x))


def scan(a, b):
    """h_t = a_t h_{t-1} + b_t."""
    return (by_doubling if parallel else frame_by_frame)(a, b)


parallel = False


def by_doubling(a, b):
    """log2(T) passes over all frames (Hillis and Steele 1986)."""
    step = 1
    while step < a.shape[0]:
        b = torch.cat([b[:step], b[step:] + a[step:] * b[:-step]])
        a = torch.cat([a[:step], a[step:] * a[:-step]])
        step *= 2
    return b


def frame_by_frame(a, b):
    states = [b[0]]
    for t in range(1, b.shape[0]):
        states.append(a[t] * states[-1] + b[t])
    return torch.stack(states)


class Cudnn(nn.Module):
    """PyTorch's own GRU or LSTM, which cuDNN computes."""

    def __init__(self, kind):
        super().__init__()
        self.core = kind(HIDDEN, HIDDEN, 1)

    def forward(self, x):
        return self.core(x)[0]


CORES = {
    "mlp": Mlp,
    "lstm": lambda: Cudnn(nn.LSTM),
    "gru": lambda: Cudnn(nn.GRU),
    "minlstm": MinLstm,
    "mingru": MinGru,
}


class Network(nn.Module):
    def __init__(self, core, features):
        super().__init__()
        self.points, self.pooled = nn.Linear(features, ENCODER), nn.Linear(ENCODER, HIDDEN)
        self.core = nn.Sequential(CORES[core](), CORES[core]())
        self.mixer, self.decoder = nn.Linear(HIDDEN, HIDDEN), nn.Linear(HIDDEN, 2 * PARTICLES)

    def forward(self, x):  # [T, B, N, F]
        x = self.pooled(functional.elu(self.points(x)).mean(-2))
        return self.decoder(functional.elu(self.mixer(self.core(x))))


def milliseconds(step, steps=20, repetitions=7):
    for _ in range(4):
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


def run(core, features, mode, graph):
    torch._dynamo.reset()
    torch.cuda.empty_cache()
    torch.manual_seed(1)
    network = Network(core, features).cuda()
    x = torch.rand(FRAMES, WINDOWS, PARTICLES, features, device="cuda")
    y = torch.rand(FRAMES, WINDOWS, 2 * PARTICLES, device="cuda")
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3, fused=True, capturable=graph)

    def loss(x, y):
        return ((network(x) - y) ** 2).mean()

    compiled = torch.compile(loss, mode=None if mode == "default" else mode) if mode else loss

    def step():
        optimizer.zero_grad(set_to_none=not graph)
        compiled(x, y).backward()
        optimizer.step()

    if not graph:
        return milliseconds(step)
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(4):
            step()
    torch.cuda.current_stream().wait_stream(stream)
    recorded = torch.cuda.CUDAGraph()
    with torch.cuda.graph(recorded):
        step()
    return milliseconds(recorded.replay)


def main():
    core, features, precision = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = precision == "tf32"
    global parallel
    best = float("inf")
    ways = [(None, True, False), ("default", True, False), (None, False, False), ("reduce-overhead", False, False)]
    if FRAMES > 2 and core.startswith("min"):
        ways = [(None, True, False), (None, True, True), ("default", True, True)]
        if FRAMES <= 64:  # compiling more frames one by one takes minutes
            ways.append(("default", True, False))
    for mode, graph, parallel in ways:
        name = (mode or "eager") + (" in a graph" if graph else "") + (", parallel" if parallel else "")
        try:
            time = run(core, features, mode, graph)
        except Exception as error:  # a way that does not work here is no rival
            print(f"{core} F {features} T {FRAMES} {precision}: {name}: {type(error).__name__}: {str(error)[:120]!r}", flush=True)
            continue
        best = min(best, time)
        print(f"{core} F {features} T {FRAMES} {precision}: {name}: {time:.3f} ms", flush=True)
    print(f"{core} F {features} T {FRAMES} {precision}: best of PyTorch {best:.3f} ms", flush=True)


main()
