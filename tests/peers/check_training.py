"""Check the event files of a training run with TensorBoard's reader.

    check_training.py EDDY BAGS WORK

EDDY is the program, BAGS a directory of at least three bags with one stream each, WORK a working directory. The
run is killed in the middle of an epoch and resumed. Checks:
1. TensorBoard reads the event files without warnings and finds every curve.
2. The curves of epochs equal the columns of metrics.csv, at the steps of its column `samples`.
3. After resuming, every step exists once: records of the interrupted epoch are discarded.
Exits with 1 and a message if a check fails.
"""

import csv
import math
import subprocess
import sys
import time
from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

EPOCHS = 4
# A narrow network and short windows, for short epochs with many batches.
SETTINGS = """
unroll = [{ share = 1.0, frames = 2 }]
windows = { batch = 2, per_epoch = 256 }
network = { encoder = 4, hidden = 4, channels = [2, 2, 2] }
optimizer.schedule = "constant"
"""
# Curve, column of metrics.csv, and tolerance between the column's printed digits and the curve's f32.
OF_EPOCHS = {
    "loss/training": ("training_loss", lambda x: 1e-5 * abs(x)),
    "loss/validation": ("validation_loss", lambda x: 1e-6 + 1e-6 * abs(x)),
    "skill/first_frame": ("first_skill", lambda x: 1e-4 + 1e-6 * abs(x)),
    "skill/last_frame": ("last_skill", lambda x: 1e-4 + 1e-6 * abs(x)),
    "weights/distance": ("weight_distance", lambda x: 1e-4 * abs(x)),
    "weights/epsilon_share": ("epsilon_share", lambda x: 1e-4),
}
OF_BATCHES = ["loss/batch", "learning_rate", "gradient_norm", "samples_per_second"]


def expect(holds, sentence):
    if not holds:
        sys.exit(f"check_training.py: {sentence}")


def rows(output):
    with open(output / "metrics.csv", newline="") as table:
        return list(csv.DictReader(table))


def curves(output):
    events = EventAccumulator(str(output), size_guidance={"scalars": 0})
    events.Reload()
    found = sorted(events.Tags()["scalars"])
    expected = sorted([*OF_EPOCHS, *OF_BATCHES])
    expect(found == expected, f"{output}: found the curves {found}, expected {expected}")
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in found}


def check(output, epochs):
    table, found = rows(output), curves(output)
    expect(len(table) == epochs, f"{output}: found {len(table)} rows in metrics.csv, expected {epochs}")
    samples = [int(row["samples"]) for row in table]
    for tag, (column, tolerance) in OF_EPOCHS.items():
        steps = [step for step, _ in found[tag]]
        expect(steps == samples, f"{tag}: found the steps {steps}, expected {samples}")
        for (step, value), row in zip(found[tag], table):
            expected = float(row[column])
            holds = abs(value - expected) <= tolerance(expected)
            expect(holds, f"{tag} at {step}: found {value}, expected {expected} as in metrics.csv")
    for tag in OF_BATCHES:
        steps = [step for step, _ in found[tag]]
        expect(len(steps) >= epochs, f"{tag}: found only the steps {steps}")
        expect(all(a < b for a, b in zip(steps, steps[1:])), f"{tag}: found the steps {steps}, expected each once")
        expect(steps[-1] <= samples[-1], f"{tag}: found step {steps[-1]} after the last, {samples[-1]}")
        for step, value in found[tag]:
            expect(math.isfinite(value) and value > 0, f"{tag} at {step}: found {value}, expected a positive number")
    return found


def main():
    eddy, bags, work = sys.argv[1], sys.argv[2], Path(sys.argv[3])
    settings, output = work / "train.toml", work / "model"
    settings.write_text(SETTINGS)
    command = [eddy, "--quiet", "train", "--data", bags, "--config", settings, "--output", output]
    command += ["--epochs", str(EPOCHS)]

    process = subprocess.Popen(command)
    metrics, deadline = output / "metrics.csv", time.monotonic() + 120
    while not (metrics.exists() and len(rows(output)) >= 1):
        expect(process.poll() is None and time.monotonic() < deadline, "the first epoch did not finish")
        time.sleep(0.02)
    # Some batches into the next epoch: wait for the size of a few more records.
    [events] = output.glob("events.out.tfevents.*")
    size = events.stat().st_size
    while events.stat().st_size < size + 600:
        expect(process.poll() is None and time.monotonic() < deadline, "the second epoch did not start")
        time.sleep(0.005)
    process.kill()
    process.wait()
    expect(len(rows(output)) < EPOCHS, "the run ended before it could be killed")

    subprocess.run([*command, "--resume"], check=True)
    found = check(output, EPOCHS)
    files = sorted(file.name for file in output.glob("events.out.tfevents.*"))
    expect(len(files) == 2, f"found the event files {files}, expected 2: one before and one after resuming")
    batches = sum(len(found[tag]) for tag in OF_BATCHES)
    print(f"check_training.py: {EPOCHS} epochs and {batches} values of batches, across a kill, equal metrics.csv")


main()
