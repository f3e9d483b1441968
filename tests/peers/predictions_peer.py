"""Check that rollouts which another program has recorded are evaluated.

    predictions_peer.py EDDY DATA

EDDY is the program, DATA a directory of bags. Reads the truth at the starts that `eddy eval --list-starts` prints, and writes rollouts at
constant velocity with rosbags, one bag for each stream. `eddy eval --predictions` must find the errors of its own baseline
"constant velocity". Exits with 1 and a message if a check fails.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

from check_bag import FRAME, typestore

STATUS = "eddy_msgs/msg/PredictionStatus"
HORIZON = 8
# Relative: positions are rounded to float32 in each frame ahead.
TOLERANCE = 1e-3


def expect(holds, sentence):
    if not holds:
        sys.exit(f"predictions_peer.py: {sentence}")


def run(*arguments):
    outcome = subprocess.run([str(argument) for argument in arguments], capture_output=True, text=True)
    expect(outcome.returncode == 0, f"{arguments}: exit code {outcome.returncode}: {outcome.stderr[-2000:]}")
    return outcome.stdout


def rollout(writer, topics, store, frame, stream):
    """Rollout at constant velocity from one frame."""
    position, velocity = (numpy.asarray(values, numpy.float32) for values in (frame.position, frame.velocity))
    for ahead in range(1, HORIZON + 1):
        position = position + velocity * numpy.float32(frame.dt)
        time = writer.time = writer.time + 1
        predicted = store.types[FRAME](
            header=frame.header, stream=stream, sequence=frame.sequence + ahead, dt=frame.dt, lower=frame.lower, upper=frame.upper,
            position=position, velocity=velocity, material=frame.material,
        )  # fmt: skip
        status = store.types[STATUS](
            header=frame.header, stream=stream, source_sequence=frame.sequence, horizon=ahead, state=2, latency=0.0, model="constant velocity"
        )
        for (connection, kind), message in zip(topics, (predicted, status)):
            writer.write(connection, time, store.serialize_cdr(message, kind))


def main():
    eddy, data = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    store = typestore()
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        evaluate = [eddy, "--quiet", "eval", "--checkpoint", Path(__file__).parents[2] / "checkpoints/particle-mingru", "--data", data, "--horizon", HORIZON]
        (folder / "mine").mkdir()
        listed = json.loads(run(*evaluate, "--list-starts"))
        expect(listed["horizon"] == HORIZON and listed["streams"], f"--list-starts printed {listed}")
        for entry in listed["streams"]:
            wanted = set(entry["sequences"])
            with AnyReader([Path(entry["bag"])], default_typestore=store) as reader:
                frames = [reader.deserialize(raw, connection.msgtype) for connection, _, raw in reader.messages()]
            with Writer(folder / "mine" / str(entry["stream"]), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                writer.time = 0
                named = (("/prediction", FRAME), ("/prediction/status", STATUS))
                topics = [(writer.add_connection(topic, kind, typestore=store), kind) for topic, kind in named]
                for frame in frames:
                    if frame.stream == entry["stream"] and frame.sequence in wanted:
                        rollout(writer, topics, store, frame, entry["stream"])
        run(*evaluate, "--predictions", f"mine={folder / 'mine'}", "--output", folder / "report")
        report = json.loads((folder / "report" / "report.json").read_text())
        errors = {entry["name"]: numpy.array(entry["skill"]) for entry in report["predictors"]}
        mine, baseline = errors["mine"], errors["constant velocity"]
        difference = abs((1 - mine) / (1 - baseline) - 1).max()
        expect(len(mine) == HORIZON and difference < TOLERANCE, f"found skill {mine}, expected {baseline}")
    print(f"recorded rollouts: {len(listed['streams'])} streams, errors within {difference:.1e} of the baseline's")


if __name__ == "__main__":
    main()
