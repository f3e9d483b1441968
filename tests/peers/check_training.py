"""The event files of a training run against TensorBoard's own reader.

    check_training.py EDDY BAGS WORK

EDDY is the program, BAGS a directory of at least three bags with one stream each, WORK a directory to work in. The
run is ended by force in the middle of an epoch and resumed. Checked are:
1. TensorBoard reads the event files without complaint and finds every curve.
2. The curves of epochs are the columns of metrics.csv, at the steps of its column `samples`.
3. After the resumption every step is there once: what was recorded of the epoch that was lost no longer counts.
Exits with 1 and a sentence when something does not hold.
"""

import csv
import math
import subprocess
import sys
import time
from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

EPOCHS = 4
# A narrow network and short windows, so that epochs are short, but of many batches.
SETTINGS = """
unroll = [{ share = 1.0, frames = 2 }]
windows = { batch = 2, per_epoch = 256 }
network = { encoder = 4, hidden = 4, channels = [2, 2, 2] }
optimizer.schedule = "constant"
"""
# Curve and column of metrics.csv, and how far the column's printed digits may be from the curve's 32 bits.
OF_EPOCHS = {
    "loss/training": ("training_loss", lambda x: 1e-5 * abs(x)),
    "loss/validation": ("validation_loss", lambda x: 1e-6 + 1e-6 * abs(x)),
    "skill/first_frame": ("first_skill", lambda x: 1e-4 + 1e-6 * abs(x)),
    "skill/last_frame": ("last_skill", lambda x: 1e-4 + 1e-6 * abs(x)),
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
        expect(process.poll() is None and time.monotonic() < deadline, "the first epoch did not come to its end")
        time.sleep(0.02)
    # Some batches into the next epoch: as many bytes as a few records more.
    [events] = output.glob("events.out.tfevents.*")
    size = events.stat().st_size
    while events.stat().st_size < size + 600:
        expect(process.poll() is None and time.monotonic() < deadline, "the second epoch did not begin")
        time.sleep(0.005)
    process.kill()
    process.wait()
    expect(len(rows(output)) < EPOCHS, "the run was over before it could be ended by force")

    subprocess.run([*command, "--resume"], check=True)
    found = check(output, EPOCHS)
    files = sorted(file.name for file in output.glob("events.out.tfevents.*"))
    expect(len(files) == 2, f"found the event files {files}, expected 2: one before and one after the resumption")
    batches = sum(len(found[tag]) for tag in OF_BATCHES)
    print(f"check_training.py: {EPOCHS} epochs and {batches} numbers of batches, across a kill, as in metrics.csv")


main()
