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

from prediction_bag import PredictionBag, frames_of, starts, typestore

HORIZON = 8
# Relative: positions are rounded to float32 in each frame ahead.
TOLERANCE = 1e-3


def expect(holds, sentence):
    if not holds:
        sys.exit(f"predictions_peer.py: {sentence}")


def main():
    eddy, data = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    store = typestore()
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        checkpoint = Path(__file__).parents[2] / "checkpoints/particle-mingru"
        evaluate = [eddy, "--quiet", "eval", "--checkpoint", checkpoint, "--data", data, "--horizon", str(HORIZON)]
        (folder / "mine").mkdir()
        streams, horizon = starts(evaluate)
        expect(horizon == HORIZON and streams, f"--list-starts printed horizon {horizon}, streams {streams}")
        for entry in streams:
            frames = frames_of(entry["bag"], entry["stream"], store)
            with PredictionBag(folder / "mine" / str(entry["stream"]), "constant velocity", store) as bag:
                for sequence in entry["sequences"]:
                    frame = frames[sequence]
                    position, velocity = (numpy.asarray(values, numpy.float32) for values in (frame.position, frame.velocity))
                    for ahead in range(1, HORIZON + 1):
                        position = position + velocity * numpy.float32(frame.dt)
                        bag.add(frame, ahead, position, velocity)
        subprocess.run([*evaluate, "--predictions", f"mine={folder / 'mine'}", "--output", folder / "report"], check=True)
        report = json.loads((folder / "report" / "report.json").read_text())
        errors = {entry["name"]: numpy.array(entry["skill"]) for entry in report["predictors"]}
        mine, baseline = errors["mine"], errors["constant velocity"]
        difference = abs((1 - mine) / (1 - baseline) - 1).max()
        expect(len(mine) == HORIZON and difference < TOLERANCE, f"found skill {mine}, expected {baseline}")
    print(f"recorded rollouts: {len(streams)} streams, errors within {difference:.1e} of the baseline's")


if __name__ == "__main__":
    main()
