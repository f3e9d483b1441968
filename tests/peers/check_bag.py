"""Check bags with independent programs: rosbags, and mcap with mcap-ros2-support.

    check_bag.py EDDY BAG

EDDY is the program, BAG a bag directory that it wrote. Checks:
1. rosbags parses the .msg files in msgs/eddy_msgs.
2. Both decoders read every message of BAG and agree on every field.
3. The type hashes and schemas in BAG are those that rosbags computes from the .msg files.
4. Conversely, `eddy bag check` accepts bags written by rosbags and mcap, and `eddy replay` plays
   them.
Exits with 1 and a message if a check fails.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from prediction_bag import FRAME, typestore

FRAMES = 25
PARTICLES = 300
DT = 0.016


def expect(holds, sentence):
    if not holds:
        sys.exit(f"check_bag.py: {sentence}")


def plain(value):
    """A message of either decoder as dictionaries, lists, numbers and strings."""
    if isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (bytes, bytearray)):
        return list(value)
    if isinstance(value, numpy.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(element) for element in value]
    if hasattr(value, "__dataclass_fields__"):
        fields = value.__dataclass_fields__
    else:
        fields = value.__slots__
    # Names in capitals are constants.
    return {name: plain(getattr(value, name)) for name in fields if name == name.lower() and not name.startswith("_")}


def by_rosbags(bag, store):
    """The messages of every topic, and its type, definition and hash according to rosbags."""
    messages, topics = {}, {}
    with Reader(bag) as reader:
        for connection in reader.connections:
            topics[connection.topic] = connection
        for connection, time, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            messages.setdefault(connection.topic, []).append((time, plain(message)))
        expect(reader.message_count == sum(map(len, messages.values())), f"{bag}: counts in metadata.yaml")
    return messages, topics


def by_mcap(bag):
    """The messages of every topic, and its channel with metadata."""
    messages, channels = {}, {}
    for path in sorted(Path(bag).glob("*.mcap")):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            expect(reader.get_header().profile == "ros2", f"{path}: profile {reader.get_header().profile}")
            for schema, channel, message, decoded in reader.iter_decoded_messages():
                expect(schema.encoding == "ros2msg", f"{path}: schema encoding {schema.encoding}")
                channels[channel.topic] = channel
                messages.setdefault(channel.topic, []).append((message.log_time, plain(decoded)))
    return messages, channels


def check_read(bag, store):
    ours, topics = by_rosbags(bag, store)
    theirs, channels = by_mcap(bag)
    expect(ours, f"{bag}: found no message")
    expect(ours.keys() == theirs.keys(), f"{bag}: topics {ours.keys()} and {theirs.keys()}")
    for topic, messages in ours.items():
        others = theirs[topic]
        expect(len(messages) == len(others), f"{topic}: {len(messages)} and {len(others)} messages")
        for number, (one, other) in enumerate(zip(messages, others)):
            expect(one == other, f"{topic}, message {number}: rosbags and mcap-ros2-support disagree")
        connection, channel = topics[topic], channels[topic]
        expected = store.hash_rihs01(connection.msgtype)
        for source, found in [("metadata.yaml", connection.digest), ("channel", channel.metadata["topic_type_hash"])]:
            expect(found == expected, f"{topic}: {source}: found {found}, expected {expected}")
        definition = get_types_from_msg(connection.msgdef.data, connection.msgtype)
        for name, fields in definition.items():
            expect(fields == store.fielddefs[name], f"{topic}: schema of {name}: found {fields}")
        print(f"{topic} ({connection.msgtype}): {len(messages)} messages agree")


def frame(store, sequence):
    """A frame as another program might write it."""
    time = round(sequence * DT * 1e9)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="world")
    random = numpy.random.default_rng(sequence)
    message = store.types[FRAME](
        header=header,
        stream=7,
        sequence=sequence,
        dt=DT,
        lower=numpy.zeros(2, numpy.float32),
        upper=numpy.ones(2, numpy.float32),
        position=random.random(2 * PARTICLES, numpy.float32),
        velocity=random.random(2 * PARTICLES, numpy.float32),
        material=random.integers(0, 4, PARTICLES).astype(numpy.uint8),
    )
    return time, message


def write_by_rosbags(path, store):
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/particles", FRAME, typestore=store)
        for time, message in (frame(store, sequence) for sequence in range(FRAMES)):
            writer.write(connection, time, store.serialize_cdr(message, FRAME))


def write_by_mcap(path, store, compression):
    definition, _ = store.generate_msgdef(FRAME, ros_version=2)
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=1 << 15, compression=compression)
        schema = writer.register_msgdef(FRAME, definition)
        for time, message in (frame(store, sequence) for sequence in range(FRAMES)):
            writer.write_message("/particles", schema, plain(message), log_time=time, publish_time=time)
        writer.finish()


def check_accepted(eddy, path):
    outcome = subprocess.run([eddy, "--quiet", "bag", "check", path], capture_output=True, text=True)
    said = outcome.stdout + outcome.stderr
    expect(outcome.returncode == 0, f"eddy bag check rejects {path.name}: {said}")
    expect(f"{FRAMES} messages" in said, f"eddy bag check: {said}, expected {FRAMES} messages")
    print(said.strip())
    topic = f"/check_bag_{os.getpid()}"
    command = [eddy, "replay", path, "--to", "shm", "--remap", f"/particles:={topic}", "--rate", "100"]
    outcome = subprocess.run(command, capture_output=True, text=True)
    said = outcome.stdout + outcome.stderr
    expect(outcome.returncode == 0, f"eddy replay rejects {path.name}: {said}")
    expect(f"{FRAMES} messages" in said, f"eddy replay: {said}, expected {FRAMES} messages")


def check_write(eddy, store):
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "by_rosbags"
        write_by_rosbags(path, store)
        check_accepted(eddy, path)
        for compression in CompressionType:
            path = Path(directory) / f"by_mcap_{compression.name.lower()}.mcap"
            write_by_mcap(path, store, compression)
            check_accepted(eddy, path)


def main():
    expect(len(sys.argv) == 3, __doc__)
    eddy, bag = sys.argv[1:]
    store = typestore()
    check_read(bag, store)
    check_write(eddy, store)


if __name__ == "__main__":
    main()
