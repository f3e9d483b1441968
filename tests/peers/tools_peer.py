"""Follow the tools of a robot on Zenoh with independent programs: eclipse-zenoh and rosbags, in rmw_zenoh's form.

    tools_peer.py EDDY

The robot publishes the pose of a cup (geometry_msgs/PoseStamped), and a blade on /tf and, before `eddy tools` starts, on
/tf_static; beside them are frames of particles. rosbags reads what `eddy tools` publishes: for every frame the pose and the
velocity of each tool, which numpy interpolates, and for late subscribers what the tools are.

EDDY is the program. The domain is ROS_DOMAIN_ID. Prints one line of JSON; exits with 1 and a message if a check fails.
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy

import zenoh_peer
from robot_on_zenoh import Robot
from robot_peer import LATCHED, Process, expect, until

FRAMES, INTERVAL = 20, zenoh_peer.DT
# Poses of the robot, from before the first frame until after the last (s).
TIMES = numpy.arange(-1, 40) * 0.01
FILE = """
[[tools]]
name = "cup"
shape.disc.radius = 0.1
pose = "/cup/pose"
[[tools]]
name = "blade"
shape.rectangle.size = [0.02, 0.3]
frame = "blade_link"
"""
FRAME, DESCRIPTION, MOVED = (f"eddy_msgs/msg/{name}" for name in ("ParticleFrame", "ToolDescription", "ToolFrame"))
POSE, TREE = "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"
KEPT = {"durability": "transient_local", "depth": 64}
TOPICS = {
    "/particles": (FRAME, {}), "/cup/pose": (POSE, {}), "/tf": (TREE, {}), "/tf_static": (TREE, LATCHED),
    "/tools": (MOVED, {}), "/tools/description": (DESCRIPTION, KEPT),
}


def path(time):
    """x, y and angle of the cup."""
    return numpy.stack([0.5 + 0.2 * numpy.sin(9 * time), 0.3 + time, 3 + 5 * time], axis=-1)


class Messages:
    """Messages of the robot."""

    def __init__(self, store):
        self.store, self.types = store, store.types

    def make(self, name, **fields):
        return self.types[name](**fields)

    def header(self, time, frame):
        nanoseconds = round(time * 1e9)
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def turned(self, angle):
        half = 0.5 * float(angle)
        return self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=numpy.sin(half), w=numpy.cos(half))

    def pose(self, time):
        x, y, angle = path(time)
        position = self.make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        pose = self.make("geometry_msgs/msg/Pose", position=position, orientation=self.turned(angle))
        return self.bytes(POSE, header=self.header(time, "world"), pose=pose)

    def tree(self, time, parent, child, x, y, angle):
        translation = self.make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=0.0)
        transform = self.make(
            "geometry_msgs/msg/Transform", translation=translation, rotation=self.turned(angle))
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(time, parent), child_frame_id=child,
            transform=transform)
        return self.bytes(TREE, transforms=[stamped])

    def bytes(self, name, **fields):
        return bytes(self.store.serialize_cdr(self.make(name, **fields), name))


def expected(time):
    """Places, angles and velocities of cup and blade: x, y, angle, u, v, spin."""
    after = numpy.searchsorted(TIMES, time - 1e-9)
    before, share = after - 1, (time - TIMES[after - 1]) / (TIMES[after] - TIMES[after - 1])
    start, end = path(TIMES[before]), path(TIMES[after])
    cup = numpy.concatenate([start + share * (end - start), (end - start) / (TIMES[after] - TIMES[before])])
    # The base of the blade turns about a fixed point.
    arm = 0.25 * numpy.array([numpy.cos(time), numpy.sin(time)])
    return [cup, numpy.array([0.5 + arm[0], 0.5 + arm[1], time, -arm[1], arm[0], 1.0])]


def check(message, sequence):
    time = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
    expect(message.sequence == sequence and message.stream == 3, f"found frame {message.sequence}, expected {sequence}")
    expect(abs(time - sequence * INTERVAL) < 1e-9 and message.header.frame_id == "world", f"header {message.header}")
    expect(list(message.names) == ["cup", "blade"], f"names {message.names}")
    expect(len(message.wrenches) == 0, f"wrenches {message.wrenches}")
    for pose, twist, numbers in zip(message.poses, message.twists, expected(time), strict=True):
        angle = 2 * numpy.arctan2(pose.orientation.z, pose.orientation.w)
        turn = numpy.angle(numpy.exp(1j * (angle - numbers[2])))
        found = [pose.position.x, pose.position.y, numbers[2] + turn, twist.linear.x, twist.linear.y, twist.angular.z]
        # Poses of tools are float32 numbers.
        expect(numpy.allclose(found, numbers, atol=2e-4), f"frame {sequence}: found {found}, expected {numbers}")


def run(eddy, folder):
    robot = Robot()
    store = robot.messages.store = zenoh_peer.typestore()
    messages, robot.topics = Messages(store), TOPICS
    sources = [topic for topic in TOPICS if not topic.startswith("/tools")]
    publish = {topic: robot.publisher(number, topic) for number, topic in enumerate(sources, 1)}
    publish["/tf_static"](1, messages.tree(0, "base", "blade_link", 0.25, 0, 0))
    received = {"/tools": [], "/tools/description": []}
    robot.kept += robot.subscribe(received, ["/tools"])
    file = folder / "tools.toml"
    file.write_text(FILE)
    program = Process(
        folder, eddy, "tools", file, "--input", "zenoh:/particles", "--wait", "30", "--reliability", "block",
        environment=robot.environment())
    try:
        return follow(robot, messages, publish, received, program)
    finally:
        program.kill()


def follow(robot, messages, publish, received, program):
    """Publish frames and poses, and check what comes of them."""
    store = messages.store
    for topic in publish:
        until(f"{topic}: eddy listens", lambda: robot.tokens(topic, "MS"))
    until("eddy offers its topics", lambda: all(robot.tokens(topic, "MP") for topic in received))
    frames = zenoh_peer.falling_frames(store, SimpleNamespace(stream=3, particles=100, count=FRAMES))
    for number, frame in enumerate(frames, 1):
        publish["/particles"](number, bytes(store.serialize_cdr(frame, FRAME)))
    for number, time in enumerate(TIMES, 1):
        publish["/cup/pose"](number, messages.pose(time))
        publish["/tf"](number, messages.tree(time, "world", "base", 0.5, 0.5, time))
    until("all frames have tools", lambda: len(received["/tools"]) == FRAMES)
    for sequence, payload in enumerate(received["/tools"]):
        check(store.deserialize_cdr(payload, MOVED), sequence)
    robot.kept += robot.subscribe(received, ["/tools/description"])
    until("the description comes late", lambda: received["/tools/description"])
    description = store.deserialize_cdr(received["/tools/description"][0], DESCRIPTION)
    kinds = [(tool.name, tool.parts[0].kind, tool.contact) for tool in description.tools]
    expect(kinds == [("cup", 1, 1), ("blade", 2, 1)], f"description: found {kinds}")
    program.end()
    log = program.log.read_text()
    expect(f"{FRAMES} frames, 0 with a held pose, 0 without tools; 0 messages refused" in log, log)
    return {"frames": FRAMES, "tools": [name for name, _, _ in kinds]}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("eddy")
    args = parser.parse_args()
    code = 0
    with tempfile.TemporaryDirectory() as folder:
        try:
            print(json.dumps(run(args.eddy, Path(folder))), flush=True)
        except SystemExit as failure:
            print(failure, file=sys.stderr, flush=True)
            code = 1
    # Threads of the middleware would outlive it.
    os._exit(code)


if __name__ == "__main__":
    main()
