"""Compare the speed of eddy and PyTorch, alternating on the same two cores.

    pip install -r tests/peers/requirements-bench.txt
    cargo build --release -p eddy-lab
    python tests/peers/torch_speed.py target/release/eddy-lab

Units of work, f32, N = 2500, encoder 256, two layers of 1250:
1. inference: one frame through the frame model, with carried state.
2. frame: a training step of the frame model. 16 windows, T frames observed, the next one predicted;
   forward, mean squared error, backward, Adam.
3. core: a training step of the core alone on [T, 16, 1250]. Loss mean(h^2), backward to weights and
   input, Adam.

Both pool before the encoder's second layer. PyTorch runs eager with default settings, and a second time
with torch.compile and Adam's `fused=True`. Each number is the median of several rounds, each of them the
median of a few seconds after a warm-up. `share` is eddy's time divided by eager PyTorch's; exits with 1 if one
exceeds its limit.

`--table4` prints the times of the paper's Table 4 instead, for both programs: training steps of the four
recurrent cores, as time per sample and per epoch, and the savings of the minimal ones.
"""

import argparse
import dataclasses
import gc
import json
import os
import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from torch_frame import FrameModel
from torch_model import describe

THREADS = 2
PAPER = {"encoder": 256, "hidden": 1250, "layers": 2, "particles": 2500}
WINDOWS = 16
# Samples per epoch in the paper's Table 4.
PAPER_SAMPLES = 23_856
# Matrix products per layer and frame, relative to each other.
PRODUCTS = {"lstm": 8, "gru": 6, "minlstm": 3, "mingru": 2}


@dataclass(frozen=True)
class Case:
    """A unit of work, and the limit of eddy's time as a fraction of PyTorch's."""

    what: str
    core: str
    frames: int
    limit: float | None = None


@dataclass(frozen=True)
class Timing:
    """Times (ms); `compiled` is None if torch.compile was not requested or failed."""

    case: Case
    eager: float
    compiled: float | None
    eddy: float

    @property
    def share(self) -> float:
        """eddy's time divided by eager PyTorch's."""
        return self.eddy / self.eager

    @property
    def exceeded(self) -> bool:
        """Whether eddy exceeds the limit."""
        return self.case.limit is not None and self.share > self.case.limit


CORE_SHARE = {"mingru": 0.85, "minlstm": 0.85, "gru": 1.2, "lstm": 1.2}
CASES = [
    Case("inference", "mingru", 1, 0.5),
    Case("inference", "lstm", 1, 0.45),
    *(Case("inference", core, 1) for core in ("minlstm", "gru", "mlp")),
    Case("frame", "mingru", 2, 0.4),
    *(Case("core", core, frames, limit) for core, limit in CORE_SHARE.items() for frames in (2, 16, 64)),
]
TABLE_4 = [
    *(Case("frame", core, 2) for core in PRODUCTS),
    *(Case("core", core, frames) for frames in (2, 16, 64, 256) for core in PRODUCTS),
]


def compilable(module: nn.Module, compiled: bool) -> Callable:
    """The module, optionally compiled with torch.compile."""
    return torch.compile(module) if compiled else module


def particles(frames: int, windows: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Particles at random positions, all of them liquid."""
    shape = (frames, windows, PAPER["particles"], 2)
    return (torch.rand(shape), 2 * torch.rand(shape) - 1), torch.zeros(shape[1:3], dtype=torch.long)


def inference(case: Case, compiled: bool) -> Callable[[], None]:
    """A step that predicts the next frame of a stream."""
    model = FrameModel(describe(case.core, PAPER)).eval()
    predict = compilable(model, compiled)
    bodies, material = particles(1, 1)
    matter, state = model.matter(material), None

    @torch.inference_mode()
    def step() -> None:
        nonlocal state
        _, state = predict(bodies, matter, state)

    return step


def training(parameters: list[Tensor], loss: Callable[[], Tensor], compiled: bool) -> Callable[[], None]:
    """A training step with Adam."""
    adam = torch.optim.Adam(parameters, lr=1e-3, fused=True if compiled else None)

    def step() -> None:
        adam.zero_grad()
        loss().backward()
        adam.step()

    return step


def frame(case: Case, compiled: bool) -> Callable[[], None]:
    """A training step that predicts the frame after T others."""
    model = FrameModel(describe(case.core, PAPER))
    predict = compilable(model, compiled)
    (position, velocity), material = particles(case.frames + 1, WINDOWS)
    matter = model.matter(material)

    def loss() -> Tensor:
        (found_position, found_velocity), _ = predict((position[:-1], velocity[:-1]), matter)
        return mse_loss(found_position[-1], position[-1]) + mse_loss(found_velocity[-1], velocity[-1])

    return training(list(model.parameters()), loss, compiled)


def core(case: Case, compiled: bool) -> Callable[[], None]:
    """A training step that minimises the outputs for T random encodings."""
    module = FrameModel(describe(case.core, PAPER | {"particles": 1})).core
    run = compilable(module, compiled)
    encodings = torch.rand(case.frames, WINDOWS, PAPER["hidden"], requires_grad=True)

    def loss() -> Tensor:
        encodings.grad = None
        return run(encodings)[0].square().mean()

    return training(list(module.parameters()), loss, compiled)


WORK = {"inference": inference, "frame": frame, "core": core}


def milliseconds(step: Callable[[], None], seconds: float) -> float:
    """Median time (ms) over this many seconds and at least three steps, after two warm-up steps."""
    for _ in range(2):
        step()
    times: list[float] = []
    end = time.perf_counter() + seconds
    while len(times) < 3 or time.perf_counter() < end:
        before = time.perf_counter()
        step()
        times.append(1e3 * (time.perf_counter() - before))
    return statistics.median(times)


def eddy(program: str, case: Case, seconds: float) -> float:
    """Time (ms) from `eddy-lab bench`."""
    if case.what == "inference":
        arguments = ["inference", "--core", case.core, "--threads", str(THREADS), "--engine-only"]
    else:
        arguments = ["training", "--step", f"{case.what}:{case.core}:{case.frames}:{WINDOWS}"]
    command = [program, "--quiet", "bench", *arguments, "--seconds", str(seconds), "--json"]
    report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    if case.what == "inference":
        [row] = [row for row in report["timings"] if row["architecture"] == "frame"]
        return row["p50"]
    return report["steps"][0]["milliseconds"]


def compile_step(case: Case) -> Callable[[], None] | None:
    """The step with torch.compile; None, with a printed reason, if it fails."""
    step = WORK[case.what](case, compiled=True)
    try:
        step()
    except Exception as error:  # compilers may raise anything
        print(f"torch.compile: {case.what} {case.core} {case.frames}: {error!s:.200}")
        return None
    return step


def measure(program: str, case: Case, rounds: int, seconds: float, compiled: bool) -> Timing:
    """Time eddy and PyTorch in alternating rounds."""
    torch.compiler.reset()
    eager = WORK[case.what](case, compiled=False)
    fast = compile_step(case) if compiled else None
    times: dict[str, list[float]] = {"eddy": [], "eager": [], "compiled": []}
    for _ in range(rounds):
        times["eddy"].append(eddy(program, case, seconds))
        times["eager"].append(milliseconds(eager, seconds))
        if fast is not None:
            times["compiled"].append(milliseconds(fast, seconds))
    median = {name: statistics.median(found) if found else None for name, found in times.items()}
    return Timing(case, median["eager"], median["compiled"], median["eddy"])


def show(timing: Timing) -> str:
    """A row of the table."""
    case = timing.case
    compiled = "-" if timing.compiled is None else f"{timing.compiled:.1f}"
    limit = "" if case.limit is None else f"<= {case.limit:.2f}" + " exceeded" * timing.exceeded
    return (
        f"{case.what:9} {case.core:8} {case.frames:4} {timing.eager:9.1f} {compiled:>9} {timing.eddy:9.1f}"
        f" {timing.share:6.2f}  {limit}"
    )


def show_table_4(timing: Timing) -> str:
    """A row of the paper's Table 4 for both programs."""
    case = timing.case
    columns = []
    for step in (timing.eager, timing.eddy):
        sample = step / WINDOWS
        columns.append(f"{step:10.1f} {sample:9.2f} {1e-3 * sample * PAPER_SAMPLES:8.0f}")
    return f"{case.what:9} {case.core:8} {case.frames:4} {''.join(columns)}"


def ratios(timings: list[Timing]) -> str:
    """The savings of the minimal cores."""
    by = {(timing.case.what, timing.case.frames, timing.case.core): timing for timing in timings}
    lines = ["\nwhat        T  LSTM/minLSTM: PyTorch   eddy   GRU/minGRU: PyTorch   eddy"]
    for what, frames in dict.fromkeys((timing.case.what, timing.case.frames) for timing in timings):
        lstm, minlstm, gru, mingru = (by[what, frames, name] for name in ("lstm", "minlstm", "gru", "mingru"))
        lines.append(
            f"{what:9} {frames:3} {lstm.eager / minlstm.eager:22.2f} {lstm.eddy / minlstm.eddy:6.2f}"
            f" {gru.eager / mingru.eager:21.2f} {gru.eddy / mingru.eddy:6.2f}"
        )
    saved = PRODUCTS["lstm"] / PRODUCTS["minlstm"], PRODUCTS["gru"] / PRODUCTS["mingru"]
    return "\n".join([*lines, f"products  any {saved[0]:29.2f} {saved[1]:28.2f}"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", help="the built eddy-lab")
    parser.add_argument("--what", choices=WORK, help="run only these rows")
    parser.add_argument("--table4", action="store_true", help="print the paper's Table 4 instead")
    parser.add_argument("--quick", action="store_true", help="one round of one second")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:THREADS])  # for both programs
    torch.set_num_threads(THREADS)
    torch.manual_seed(1)

    rounds, seconds = (1, 1.0) if options.quick else (5, 3.0)
    timings = []
    if not options.json and options.table4:
        print("what      core        T PyTorch ms ms/sample  s/epoch   eddy ms ms/sample  s/epoch")
    elif not options.json:
        print("what      core        T   PyTorch  compiled      eddy  share  limit")
    for case in TABLE_4 if options.table4 else CASES:
        if options.what not in (None, case.what):
            continue
        timing = measure(options.program, case, rounds, seconds, compiled=not options.table4)
        timings.append(timing)
        gc.collect()  # the weights of the previous case
        if not options.json:
            print(show_table_4(timing) if options.table4 else show(timing), flush=True)
    if options.json:
        print(json.dumps([dataclasses.asdict(timing) | {"share": timing.share} for timing in timings], indent=2))
    elif options.table4:
        print(ratios(timings))
    raise SystemExit(1 if any(timing.exceeded for timing in timings) else 0)


if __name__ == "__main__":
    main()
