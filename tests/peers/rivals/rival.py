"""Simulators that others have published, trained on eddy's data sets and evaluated by `eddy eval`: GNS, NeuralMPM and Transolver.

    rival.py train  NAME MODEL --data FOLDER --minutes 20 [--validation FOLDER]
    rival.py predict NAME MODEL --eddy EDDY --data BAGS --output FOLDER [--horizon 100] [--starts 7]
    rival.py time   NAME MODEL --data FOLDER [--threads 1]

train and time take --compile (torch.compile), which is faster on a GPU.

NAME is gns, neural_mpm or transolver; MODEL the file of its weights; FOLDER the output of `eddy bag export --format npz`, one
data set of streams of one shape in a square domain.

`train` trains for the given number of minutes in total: MODEL holds the state of the training, saved every 30 s, and after an
interruption the same command continues. Adam, rate falling along half a cosine to 1 %, averaged weights (.999), gradients of norm 1 at
most, bf16 on a GPU. Prints the loss, and with --validation the error of free rollouts, every minute.

How they differ from what is published, besides budgets far below the published ones:

- gns: learns faster (7e-4 and batches of 16 instead of 1e-4 and 2); frames before the first of a stream are a parabola.
- neural_mpm: particles go to the grid by bilinear weights (the authors' program: to the nearest cell) without noise, the U-Net is a plain
  one (two convolutions a level and ReLU), it predicts 4 frames a call instead of 8, and each material has its own velocities.
- transolver: the paper has no simulator; only the attention and its blocks are published, inputs, outputs and loss are ours.

`predict` writes free rollouts from the starts of `eddy eval`, one bag for each stream. `eddy eval --predictions NAME=FOLDER` with
the same data, horizon and starts then compares them with the truth, the trivial predictors and eddy's checkpoint.

`time` prints the time of a frame ahead, one stream: the fastest of five rollouts.
"""

import argparse
import json
import math
import os
import sys
import time
from pathlib import Path

import numpy
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gns import Gns
from neural_mpm import NeuralMpm
from prediction_bag import PredictionBag, frames_of, starts, typestore
from scenes import Scenes, Unit, Window, before
from transolver import Transolver

RIVALS = {"gns": Gns, "neural_mpm": NeuralMpm, "transolver": Transolver}
AVERAGE, LOWEST_RATE = 0.999, 0.01
SAVED, PRINTED = 30, 60


def device():
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def autocast():
    return torch.autocast(device().type, torch.bfloat16, enabled=device().type == "cuda")


def save(state, path):
    """Whole or not at all."""
    whole = path.with_suffix(".part")
    torch.save(state, whole)
    os.replace(whole, path)


def load(name, path):
    """The averaged weights of a training."""
    model = RIVALS[name]().to(device())
    state = torch.load(path, map_location=device(), weights_only=True)
    if state["name"] != name:
        raise SystemExit(f"{path}: found a model of {state['name']}, expected one of {name}")
    model.load_state_dict(state["average"])
    return model.eval()


@torch.no_grad()
def validation(model, scenes, frames=20, count=8):
    """Root of the mean squared position error at frame `frames` of free rollouts, from fixed windows (domain widths)."""
    generator = torch.Generator().manual_seed(0)
    window = scenes.windows(count, model.history + frames, generator)
    first = Window(window.position[:, : model.history], window.velocity[:, : model.history], window.material)
    with autocast():
        *_, (position, _) = model.rollout(first, frames)
    return float((position - window.position[:, -1]).square().sum(-1).mean().sqrt())


def train(options):
    torch.manual_seed(options.seed)
    generator = torch.Generator().manual_seed(options.seed)
    scenes = Scenes(options.data, device())
    unseen = Scenes(options.validation, device()) if options.validation else None
    model = RIVALS[options.name]().to(device())
    model.prepare(scenes)
    batch = options.batch or model.batch
    average = torch.optim.swa_utils.AveragedModel(model, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(AVERAGE))
    optimiser = torch.optim.Adam(model.parameters(), lr=model.rate)
    trained, step = 0.0, 0
    if options.model.exists():
        state = torch.load(options.model, map_location=device(), weights_only=True)
        found = (state["name"], state["batch"], state["seed"])
        if found != (options.name, batch, options.seed):
            raise SystemExit(f"{options.model}: found name, batch and seed {found}, expected {(options.name, batch, options.seed)}")
        model.load_state_dict(state["model"])
        average.module.load_state_dict(state["average"])
        average.n_averaged += state["step"]
        optimiser.load_state_dict(state["optimiser"])
        generator.set_state(state["generator"].cpu())
        trained, step = state["seconds"], state["step"]

    def snapshot():
        return {
            "name": options.name, "batch": batch, "seed": options.seed, "seconds": trained, "step": step, "model": model.state_dict(),
            "average": average.module.state_dict(), "optimiser": optimiser.state_dict(), "generator": generator.get_state(),
        }  # fmt: skip

    if options.compile:
        model.compile_steps()
        # Compiles before the time of the training begins.
        with autocast():
            model.loss(scenes, batch, torch.Generator().manual_seed(options.seed)).backward()
    limit, last = 60 * options.minutes, time.monotonic()
    saved = printed = trained
    losses = []
    while trained < limit:
        share = LOWEST_RATE + (1 - LOWEST_RATE) * (1 + math.cos(math.pi * trained / limit)) / 2
        for group in optimiser.param_groups:
            group["lr"] = model.rate * share
        with autocast():
            loss = model.loss(scenes, batch, generator)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        average.update_parameters(model)
        step += 1
        losses.append(loss.item())
        now = time.monotonic()
        trained, last = trained + now - last, now
        is_last = trained >= limit
        if trained - printed >= PRINTED or is_last:
            error = {"validation_rmse_20": validation(average.module, unseen)} if unseen else {}
            print(json.dumps({"seconds": round(trained), "step": step, "loss": float(numpy.mean(losses)), **error}), flush=True)
            printed, losses = trained, []
        if trained - saved >= SAVED or is_last:
            save(snapshot(), options.model)
            saved = trained
        # Neither validation nor saving is training.
        last = time.monotonic()


@torch.no_grad()
def predict(options):
    if options.output.exists():
        raise SystemExit(f"{options.output}: found a file or folder, expected none")
    model, store = load(options.name, options.model), typestore()
    # Does not decide on the starts, but `eddy eval` evaluates a checkpoint.
    shipped = Path(__file__).resolve().parents[3] / "checkpoints" / "particle-mingru"
    evaluate = [options.eddy, "--quiet", "eval", "--checkpoint", shipped, "--data", options.data, "--horizon", options.horizon]
    streams, horizon = starts([*evaluate, "--starts", options.starts])
    options.output.mkdir(parents=True)
    for entry in (entry for entry in streams if entry["sequences"]):
        frames = frames_of(entry["bag"], entry["stream"], store)
        with PredictionBag(options.output / str(entry["stream"]), options.name, store) as bag:
            first = next(iter(frames.values()))
            unit = Unit(numpy.asarray(first.lower), numpy.asarray(first.upper), first.dt)
            windows = []
            for sequence in entry["sequences"]:
                observed = [frames[s] for s in range(max(sequence - model.history + 1, 0), sequence + 1) if s in frames]
                windows.append(before(window_of(observed, unit), model.history))
            # All starts of a stream at once, [B, N, 2] a frame.
            fields = zip(*((one.position, one.velocity, one.material) for one in windows))
            window = Window(*(torch.cat(field) for field in fields))
            with autocast():
                ahead = [[values.float().cpu().numpy() for values in frame] for frame in model.rollout(window, horizon)]
            for row, sequence in enumerate(entry["sequences"]):
                for number, (position, velocity) in enumerate(ahead, 1):
                    bag.add(frames[sequence], number, *unit.restored(position[row], velocity[row]))
        print(f"stream {entry['stream']}: {len(entry['sequences'])} rollouts", file=sys.stderr, flush=True)


def window_of(frames, unit):
    """The window [1, T, N, 2] of successive messages."""
    arrays = [[numpy.asarray(values, numpy.float32).reshape(-1, 2) for values in (frame.position, frame.velocity)] for frame in frames]
    scaled = [torch.from_numpy(numpy.stack(values))[None].to(device()) for values in zip(*(unit.scaled(*pair) for pair in arrays))]
    material = torch.from_numpy(numpy.asarray(frames[-1].material).astype(numpy.int64))[None].to(device())
    return Window(*scaled, material)


@torch.no_grad()
def measure(options):
    torch.set_num_threads(options.threads)
    model, scenes = load(options.name, options.model), Scenes(options.data, device())
    if options.compile:
        model.compile_steps()
    window = scenes.windows(1, model.history, torch.Generator().manual_seed(options.seed))
    frames, times = 8, []
    for _ in range(5):
        if device().type == "cuda":
            torch.cuda.synchronize()
        begin = time.perf_counter()
        with autocast():
            for position, _ in model.rollout(window, frames):
                pass
        position.cpu()
        times.append((time.perf_counter() - begin) / frames)
    where = torch.cuda.get_device_name() if device().type == "cuda" else f"{options.threads} threads"
    print(json.dumps({"rival": options.name, "compiled": options.compile, "particles": position.shape[1], "ms": 1e3 * min(times), "on": where}))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("train", "predict", "time"))
    parser.add_argument("name", choices=RIVALS)
    parser.add_argument("model", type=Path)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--validation", type=Path)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--batch", type=int, help="windows of a step (default: that of the rival)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--compile", action="store_true", help="with torch.compile, whose time does not count (train, time)")
    parser.add_argument("--eddy", type=Path, help="the program")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--horizon", type=int, default=100)
    parser.add_argument("--starts", type=int, default=7, help="of a stream, which are rolled out together")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    if options.command == "predict" and not (options.eddy and options.output):
        parser.error("predict needs --eddy and --output")
    {"train": train, "predict": predict, "time": measure}[options.command](options)


if __name__ == "__main__":
    main()
