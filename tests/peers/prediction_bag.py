"""Rollouts as a node records them: what `eddy eval --predictions` reads, written with rosbags.

No part of eddy is used. The starts are those that `eddy eval --list-starts` prints.
"""

import json
import subprocess
from pathlib import Path

import numpy
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MSGS = Path(__file__).resolve().parents[2] / "msgs" / "eddy_msgs" / "msg"
FRAME = "eddy_msgs/msg/ParticleFrame"
STATUS = "eddy_msgs/msg/PredictionStatus"


def typestore():
    """ROS 2's messages, and eddy's as rosbags parses them."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(MSGS.glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(), f"eddy_msgs/msg/{path.stem}"))
    if FRAME not in store.fielddefs:
        raise SystemExit(f"rosbags does not know {FRAME} after reading {MSGS}")
    return store


def starts(evaluate):
    """The streams of `eddy eval .. --list-starts`, each with its bag, its number and the sequence numbers to start from; `evaluate` is
    the command without --list-starts. Returns the horizon as well."""
    command = [str(argument) for argument in (*evaluate, "--list-starts")]
    outcome = subprocess.run(command, capture_output=True, text=True)
    if outcome.returncode != 0:
        raise SystemExit(f"{command}: exit code {outcome.returncode}: {outcome.stderr[-2000:]}")
    listed = json.loads(outcome.stdout)
    return listed["streams"], listed["horizon"]


def frames_of(bag, stream, store):
    """The messages of a stream by sequence number."""
    with AnyReader([Path(bag)], default_typestore=store) as reader:
        connections = [connection for connection in reader.connections if connection.msgtype == FRAME]
        frames = (reader.deserialize(raw, connection.msgtype) for connection, _, raw in reader.messages(connections))
        return {frame.sequence: frame for frame in frames if frame.stream == stream}


class PredictionBag(Writer):
    """A bag with rollouts on /prediction and /prediction/status."""

    def __init__(self, path, model, store):
        super().__init__(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self.model, self.store, self.time = model, store, 0

    def __enter__(self):
        super().__enter__()
        named = (("/prediction", FRAME), ("/prediction/status", STATUS))
        self.topics = [(self.add_connection(topic, kind, typestore=self.store), kind) for topic, kind in named]
        return self

    def add(self, frame, ahead, position, velocity):
        """What is predicted `ahead` frames after the true message `frame`; position and velocity float32 [N, 2]."""
        self.time += 1
        arrays = [numpy.ascontiguousarray(values, numpy.float32).reshape(numpy.shape(frame.position)) for values in (position, velocity)]
        predicted = self.store.types[FRAME](
            header=frame.header, stream=frame.stream, sequence=frame.sequence + ahead, dt=frame.dt, lower=frame.lower,
            upper=frame.upper, position=arrays[0], velocity=arrays[1], material=frame.material,
        )  # fmt: skip
        status = self.store.types[STATUS](
            header=frame.header, stream=frame.stream, source_sequence=frame.sequence, horizon=ahead, state=2, latency=0.0,
            model=self.model,
        )  # fmt: skip
        for (connection, kind), message in zip(self.topics, (predicted, status)):
            self.write(connection, self.time, self.store.serialize_cdr(message, kind))
