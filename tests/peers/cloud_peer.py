"""Check the point clouds in a bag with Foxglove's and Rerun's software.

    cloud_peer.py BAG FRAMES CLOUDS

The frames on topic FRAMES are read with mcap-ros2-support, which takes their layout from the bag. The clouds on topic
CLOUDS must hold the same particles

1. in the recording that `rerun mcap convert` creates from the bag: `Points3D:positions` of every frame, with velocities and
   materials;
2. in the file that foxglove-sdk writes from the schema and the messages of the bag, converted
   in the same way. The SDK has no reader in Python: this tests whether it accepts what eddy writes.

A bag recorded live may have fewer clouds than frames, or more. Clouds and frames with the same stamp are compared.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import foxglove
import numpy as np
import rerun
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import RrdReader

# The rerun program that pip installed next to this Python.
RERUN = Path(sys.executable).parent / "rerun"


def expect(holds, sentence):
    if not holds:
        sys.exit(f"cloud_peer.py: {sentence}")


def files(bag):
    found = sorted(Path(bag).glob("*.mcap"))
    expect(found, f"{bag}: found no .mcap file")
    return found


def frames(bag, topic):
    """Positions, velocities and materials by stamp (ns)."""
    found = {}
    for path in files(bag):
        with open(path, "rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for _, _, _, frame in reader.iter_decoded_messages(topics=[topic]):
                stamp = frame.header.stamp.sec * 10**9 + frame.header.stamp.nanosec
                particles = len(frame.material)
                position = np.array(frame.position, np.float32).reshape(particles, 2)
                velocity = np.array(frame.velocity, np.float32).reshape(particles, 2)
                found[stamp] = position, velocity, np.frombuffer(bytes(frame.material), np.uint8)
    return found


def columns(recording, topic):
    """The values of each column of points, by stamp (ns)."""
    found = {}
    for chunk in RrdReader(recording).stream():
        if str(chunk.entity_path) != topic:
            continue
        batch = chunk.to_record_batch()
        names = batch.schema.names
        if "ros2_timestamp" not in names:
            continue
        stamps = batch.column(names.index("ros2_timestamp")).cast("int64").to_pylist()
        for name in names:
            if not name.startswith("Points3D:"):
                continue
            for stamp, value in zip(stamps, batch.column(names.index(name))):
                found.setdefault(stamp, {})[name] = np.array(value.as_py())
    return found


def check(file, topic, truth, work):
    """Compare the clouds of a file as rerun reads them. Returns how many were compared."""
    recording = work / f"{file.stem}.rrd"
    subprocess.run([RERUN, "mcap", "convert", file, "-o", recording], check=True, capture_output=True)
    compared = 0
    for stamp, points in columns(recording, topic).items():
        if stamp not in truth:
            continue
        position, velocity, material = truth[stamp]
        seen = points["Points3D:positions"]
        expect(seen.shape == (len(position), 3), f"{file}: {stamp}: found points {seen.shape}")
        expect(np.array_equal(seen[:, :2].astype(np.float32), position), f"{file}: {stamp}: position")
        expect(not seen[:, 2].any(), f"{file}: {stamp}: z")
        for axis, name in enumerate(["vx", "vy"]):
            speed = np.ravel(points[f"Points3D:{name}"]).astype(np.float32)
            expect(np.array_equal(speed, velocity[:, axis]), f"{file}: {stamp}: {name}")
        expect(np.array_equal(np.ravel(points["Points3D:material"]), material), f"{file}: {stamp}: material")
        compared += 1
    return compared


def relay(path, topic, output):
    """Write the clouds of a file with foxglove-sdk."""
    context = foxglove.Context()
    with open(path, "rb") as file, foxglove.open_mcap(output, context=context):
        channel = None
        for schema, of, message in make_reader(file).iter_messages(topics=[topic]):
            if channel is None:
                kind = (schema.name, schema.encoding)
                expect(kind == ("sensor_msgs/msg/PointCloud2", "ros2msg"), f"{path}: {topic}: found {kind}")
                described = foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
                channel = foxglove.Channel(
                    topic, schema=described, message_encoding=of.message_encoding, context=context
                )
            channel.log(message.data, log_time=message.log_time)


def main(bag, topic, clouds):
    truth = frames(bag, topic)
    expect(truth, f"{bag}: found no frame on {topic}")
    with tempfile.TemporaryDirectory() as work:
        work = Path(work)
        seen = relayed = 0
        for file in files(bag):
            seen += check(file, clouds, truth, work)
            copy = work / f"{file.stem}_foxglove.mcap"
            relay(file, clouds, copy)
            relayed += check(copy, clouds, truth, work)
    expected = min(10, len(truth))
    expect(seen >= expected, f"{bag}: found {seen} clouds with a frame of the same time, expected {expected} or more")
    expect(relayed == seen, f"{bag}: foxglove-sdk wrote {relayed} clouds, expected {seen}")
    print(f"   rerun {rerun.__version__}: {seen} of {len(truth)} frames are points on {clouds}; foxglove-sdk takes them")


main(*sys.argv[1:])
