"""Record and replay the topics of a robot: rclpy on Fast DDS and Cyclone DDS, or eclipse-zenoh in rmw_zenoh's form.

    robot_peer.py EDDY dds|zenoh

1. The robot publishes topics of ten types with several QoS profiles; two of the topics are transient local and published
   before `eddy record --all` starts. One type is not built into eddy: its publisher describes it
   (`~/get_type_description`). On Zenoh, one more type is known to nobody.
2. rosbags reads the bag with the definitions in it: every message, its type, and the QoS that was offered.
3. `eddy replay` plays the bag, without its type hashes, to subscribers with the same QoS: every message arrives, late
   subscribers of the transient-local topics receive them too, and publishers offer the recorded QoS.

EDDY is the program. The domain is ROS_DOMAIN_ID. Prints one line of JSON; exits with 1 and a message if a check fails.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TIMEOUT = 60
# Messages of each volatile topic, and their rate (Hz).
COUNT, RATE = 20, 20
PROBE = "acme_msgs/msg/Probe"
PROBE_PARTS = {
    PROBE: "std_msgs/Header header\nTip[<=2] tips\nstring<=20 label \"probe\"\nuint8 COLD=1\n",
    "acme_msgs/msg/Tip": "float32[3] position # m\nbool touches\n",
}
MYSTERY = "acme_msgs/msg/Mystery"
# An empty list of policies is ROS 2's default: reliable, volatile, the last 10.
BEST_EFFORT, LATCHED = {"reliability": "best_effort", "depth": 5}, {"durability": "transient_local", "depth": 1}
TOPICS = {
    "/cmd_vel": ("geometry_msgs/msg/Twist", {}),
    "/imu": ("sensor_msgs/msg/Imu", BEST_EFFORT),
    "/scan": ("sensor_msgs/msg/LaserScan", BEST_EFFORT),
    "/joint_states": ("sensor_msgs/msg/JointState", {}),
    "/goal_pose": ("geometry_msgs/msg/PoseStamped", {}),
    "/camera": ("sensor_msgs/msg/Image", BEST_EFFORT),
    "/points": ("sensor_msgs/msg/PointCloud2", {}),
    "/robot_description": ("std_msgs/msg/String", LATCHED),
    "/tf_static": ("tf2_msgs/msg/TFMessage", LATCHED),
}


def expect(holds, sentence):
    if not holds:
        sys.exit(f"robot_peer.py: {sentence}")


def until(what, answer):
    """Repeat `answer` until it is true; returns it."""
    deadline = time.monotonic() + TIMEOUT
    while not (found := answer()):
        expect(time.monotonic() < deadline, f"{what}: not within {TIMEOUT} s")
        time.sleep(0.02)
    return found


class Messages:
    """Messages of every type, filled with numbers."""

    def __init__(self):
        self.store = get_typestore(Stores.ROS2_JAZZY)
        for name, text in PROBE_PARTS.items():
            self.store.register(get_types_from_msg(text, name))
        self.store.register(get_types_from_msg("float64 x", MYSTERY))

    def cdr(self, type_name, number):
        return bytes(self.store.serialize_cdr(self.filled(type_name, number), type_name))

    def filled(self, type_name, number):
        _, fields = self.store.fielddefs[type_name]
        return self.store.types[type_name](**{name: self.value(kind, number) for name, kind in fields})

    def value(self, kind, number):
        node, details = kind
        if node == Nodetype.NAME:
            return self.filled(details, number)
        if node == Nodetype.BASE:
            name = details[0]
            return {"string": f"text {number}", "bool": True}.get(name, number + 0.5 if "float" in name else number % 100)
        inner, length = details
        length = length if node == Nodetype.ARRAY else min(length or 3, 3)
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            name = {"byte": "uint8", "octet": "uint8", "char": "uint8"}.get(inner[1][0], inner[1][0])
            return numpy.full(length, self.value(inner, number), dtype=name)
        return [self.value(inner, number) for _ in range(length)]


def body(data):
    """A message without its representation header, padded as on the wire of DDS."""
    return data[4:] + bytes(-len(data) % 4)


def equal(found, expected):
    return [body(data) for data in found] == [body(data) for data in expected]


class Process:
    """eddy in the background; its output is in a file."""

    def __init__(self, folder, *arguments, environment=None):
        self.log = folder / f"{arguments[1]}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [str(argument) for argument in arguments], stdout=log, stderr=subprocess.STDOUT, env=environment)

    def end(self, expected=0):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        code = self.process.wait(TIMEOUT)
        expect(code == expected, f"{self.log.stem}: exit code {code}, expected {expected}\n{self.log.read_text()}")

    def kill(self):
        self.process.kill()
        self.process.wait()


def read_bag(bag, topics, published, offered, undefined):
    """Check the bag with rosbags, which knows only the definitions in it."""
    found = {topic: [] for topic in topics}
    with AnyReader([bag]) as reader:
        for connection in reader.connections:
            topic = connection.topic
            expect(topic in topics, f"{topic}: recorded, expected {list(topics)}")
            expect(connection.msgtype == topics[topic][0], f"{topic}: found {connection.msgtype}")
            profiles = [
                {name: getattr(profile, name).name.lower() for name in ("reliability", "durability", "history")}
                | {"depth": profile.depth}
                for profile in connection.ext.offered_qos_profiles
            ]
            expected = offered(topics[topic][1])
            expect(profiles == [expected], f"{topic}: found QoS {profiles}, expected {expected}")
        for connection, _, data in reader.messages():
            found[connection.topic].append(bytes(data))
            if connection.topic not in undefined:
                reader.deserialize(data, connection.msgtype)
    for topic in topics:
        expect(
            equal(found[topic], published[topic]),
            f"{topic}: found {len(found[topic])} messages in the bag, expected the {len(published[topic])} published")


def without_hashes(eddy, bag, output):
    """The bag as Humble and rosbags write it."""
    import mcap.reader
    import mcap.writer

    source = next(bag.glob("*.mcap"))
    with source.open("rb") as read, output.open("wb") as write:
        writer = mcap.writer.Writer(write)
        writer.start("ros2")
        channels = {}
        for schema, channel, message in mcap.reader.make_reader(read).iter_messages():
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                metadata = {"offered_qos_profiles": channel.metadata["offered_qos_profiles"]}
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", number, metadata)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()


def check_replay(topics, received, published):
    for topic in topics:
        expect(
            equal(received[topic], published[topic]),
            f"{topic}: received {len(received[topic])} messages of the replay, expected {len(published[topic])}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("eddy")
    parser.add_argument("transport", choices=["dds", "zenoh"])
    args = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with tempfile.TemporaryDirectory() as folder:
        if args.transport == "dds":
            import robot_on_dds as robot
        else:
            import robot_on_zenoh as robot
        outcome = robot.run(args.eddy, Path(folder))
    print(json.dumps(outcome), flush=True)
    # Threads of the middleware would outlive it.
    os._exit(0)


if __name__ == "__main__":
    # The other files import this one.
    sys.modules["robot_peer"] = sys.modules["__main__"]
    main()
