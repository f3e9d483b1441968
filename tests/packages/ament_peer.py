"""Checks built ament packages for check_ament: messages through rclpy, and the layout that ros2 run and ros2 launch expect.

    ament_peer.py CHECKOUT WORK     WORK: an empty folder for what is recorded
"""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
# Above domain 101, the ports of DDS collide with those of other programs.
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

import eddy
import numpy as np
import rclpy
import yaml
from ament_index_python.packages import get_package_prefix, get_package_share_directory
from eddy_msgs.msg import ParticleFrame, PredictionStatus
from rclpy.qos import QoSProfile

CHECKOUT, WORK = Path(sys.argv[1]), Path(sys.argv[2])
SAMPLE = CHECKOUT / "bags" / "sample"
#: Seconds until a check gives up.
LIMIT = 60.0

sys.path.insert(0, str(CHECKOUT / "python" / "examples"))
from rclpy_node import Predictor, to_frame


def expect(holds: object, sentence: str) -> None:
    if not holds:
        sys.exit(f"ament_peer.py: {sentence}")


def program() -> Path:
    """The program where ros2 run looks for it."""
    return Path(get_package_prefix("eddy_ros")) / "lib" / "eddy_ros" / "eddy"


def check_hashes() -> None:
    """rosidl's hashes of the types are those that eddy sends."""
    metadata = (SAMPLE / "metadata.yaml").read_text()
    share = Path(get_package_share_directory("eddy_msgs"))
    found = json.loads((share / "msg" / "ParticleFrame.json").read_text())["type_hashes"][0]["hash_string"]
    expect(found in metadata, f"rosidl's hash of ParticleFrame is {found}, another one than in {SAMPLE}")


def check_layout() -> list[dict[str, object]]:
    """The program and the launch files are found, and the files name it. Returns their nodes."""
    expect(os.access(program(), os.X_OK), f"{program()} cannot be run")
    launch = Path(get_package_share_directory("eddy_ros")) / "launch"
    nodes = []
    for file in sorted(launch.glob("*.launch.yaml")):
        for entry in yaml.safe_load(file.read_text())["launch"]:
            if "node" in entry:
                node = entry["node"]
                expect((node["pkg"], node["exec"]) == ("eddy_ros", "eddy"), f"{file}: found {node}")
                nodes.append(node)
    expect(len(nodes) == 2, f"found {len(nodes)} nodes in {launch}, expected 2")
    return nodes


def command(node: dict[str, object], values: dict[str, str]) -> list[str]:
    """What launch_ros runs for a node of a launch file: its arguments, then its name, namespace and parameters."""

    def filled(text: object) -> str:
        for name, value in values.items():
            text = str(text).replace(f"$(var {name})", value)
        return str(text)

    words = [str(program()), *shlex.split(filled(node["args"])), "--ros-args", "-r", f"__node:={node['name']}"]
    if "namespace" in node:
        words += ["-r", f"__ns:={filled(node['namespace'])}"]
    for parameter in node.get("param", []):
        words += ["-p", f"{parameter['name']}:={filled(parameter['value'])}"]
    return words


class Listener(rclpy.node.Node):
    """Keeps the messages of a node's topics."""

    def __init__(self, topic: str) -> None:
        super().__init__("listener")
        self.frames: list[ParticleFrame] = []
        self.status: list[PredictionStatus] = []
        self.create_subscription(ParticleFrame, topic, self.frames.append, QoSProfile(depth=1000))
        self.create_subscription(PredictionStatus, f"{topic}/status", self.status.append, QoSProfile(depth=1000))


def spin_until(nodes: list[rclpy.node.Node], what: str, holds: Callable[[], object]) -> None:
    deadline = time.monotonic() + LIMIT
    while not holds():
        expect(time.monotonic() < deadline, f"{what}: not within {LIMIT} s")
        for node in nodes:
            rclpy.spin_once(node, timeout_sec=0.01)


def stop(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGINT)
    expect(process.wait(LIMIT) == 0, f"{process.args} ended with {process.returncode}")


def expected(last: int) -> eddy.Frame:
    """The prediction of the frame after the sample's frame number `last`."""
    frames = [frame for frame in eddy.Bag(SAMPLE).frames() if frame.sequence <= last]
    stream = eddy.Surrogate(threads=1).stream(frames[0])
    for frame in frames:
        predicted = stream.step(frame)
    return predicted


def check_launched_node(nodes: list[dict[str, object]]) -> None:
    """The processes of the launch files: rclpy reads frames, predictions and their status with generated types."""
    values = {"input": "dds:truth", "output": "dds:ahead", "horizon": "1", "namespace": "/robot1", "bag": str(SAMPLE)}
    live, replayed = nodes
    expect(str(replayed["args"]).startswith("replay "), f"found {replayed}, expected the node, then the replay")
    listener = Listener("/robot1/ahead")
    node = subprocess.Popen([*command(live, values), "--", "--quiet", "--reliability", "block"])
    try:
        name = ("eddy_node", "/robot1")
        spin_until([listener], "the node", lambda: name in listener.get_node_names_and_namespaces())
        spin_until([listener], "its topic", lambda: listener.count_publishers("/robot1/ahead") == 1)
        words = [*command(replayed, values), "-r", "/particles:=/robot1/truth", "--", "--quiet", "--rate", "0.5"]
        replay = subprocess.Popen(words, stdout=subprocess.DEVNULL)
        count = len(list(eddy.Bag(SAMPLE).frames())) - eddy.Surrogate().warm_up + 1
        spin_until([listener], f"{count} predictions", lambda: len(listener.frames) >= count)
        spin_until([listener], f"{count} statuses", lambda: len(listener.status) >= count)
        expect(replay.wait(LIMIT) == 0, "the replay failed")
        last = to_frame(listener.frames[-1])
        expect(np.array_equal(last.position, expected(last.sequence - 1).position), "another prediction than Surrogate's")
        status = listener.status[-1]
        expect(status.state == PredictionStatus.TRACKING, f"found status {status}")
        expect((status.stream, status.source_sequence) == (last.stream, last.sequence - 1), f"found status {status}")
    finally:
        stop(node)
        listener.destroy_node()
    print(f"ament_peer.py: the node of eddy_ros: {count} predictions read by rclpy with generated types")


def check_rclpy_node() -> None:
    """The example: a node of rclpy that holds the surrogate."""
    predictor, listener = Predictor(), Listener("/prediction")
    words = [program(), "--quiet", "replay", SAMPLE, "--to", "dds", "--wait-for", "1", "--rate", "0.5"]
    replay = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    count = len(list(eddy.Bag(SAMPLE).frames()))
    spin_until([predictor, listener], f"{count} predictions", lambda: len(listener.frames) >= count)
    expect(replay.wait(LIMIT) == 0, "the replay failed")
    for message in (listener.frames[5], listener.frames[-1]):
        predicted = to_frame(message)
        expect(predicted == expected(predicted.sequence - 1), f"frame {predicted.sequence}: another one than Surrogate's")
    predictor.destroy_node()
    listener.destroy_node()
    print(f"ament_peer.py: rclpy_node.py: {count} predictions, equal to those of eddy.Surrogate")


def files_of(page: str) -> Path:
    """A folder with the Python files that a page of the documentation shows."""
    folder = WORK / Path(page).stem
    folder.mkdir()
    text = (CHECKOUT / "docs" / "src" / page).read_text()
    for name, content in re.findall(r"^```python (\S+)\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        (folder / name).write_text(content)
    return folder


def check_documented_publisher() -> None:
    """The publisher of the page on one's own simulation, from the page: its frames are those of the simulation."""
    folder = files_of("own_simulation.md")
    listener = Listener("/particles")
    publisher = subprocess.Popen([sys.executable, folder / "publisher.py"], cwd=folder)
    try:
        spin_until([listener], "ten frames", lambda: len(listener.frames) >= 10)
    finally:
        stop(publisher)
    sys.path.insert(0, str(folder))
    from my_simulation import simulate

    position, velocity = simulate(1, frames=listener.frames[-1].sequence + 1)
    for message in listener.frames:
        frame = to_frame(message)
        same = np.array_equal(frame.position, position[frame.sequence]) and np.array_equal(frame.velocity, velocity[frame.sequence])
        expect(frame.stream == 1 and same, f"frame {frame.sequence} is another one than that of the simulation")
    listener.destroy_node()
    print(f"ament_peer.py: own_simulation.md: {len(listener.frames)} frames of the page's publisher")


def check_documented_subscriber() -> None:
    """The subscriber of the page on ROS 2 reads what a node with the default quality of service predicts."""
    folder = files_of("how-to/ros.md")
    node = subprocess.Popen([program(), "--quiet", "node", "--input", "dds:/particles", "--output", "dds:/prediction"])
    words = [program(), "--quiet", "replay", SAMPLE, "--to", "dds", "--wait-for", "1", "--loop"]
    replay = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    waiting, said = rclpy.create_node("waiting"), folder / "said"
    with said.open("w") as output:
        subscriber = subprocess.Popen([sys.executable, folder / "subscriber.py"], stdout=output)
    try:
        spin_until([waiting], "ten frames of the subscriber", lambda: said.read_text().count("the first particle is at") >= 10)
    finally:
        for process in (subscriber, replay, node):
            stop(process)
    waiting.destroy_node()
    print(f"ament_peer.py: ros.md: the page's subscriber: {said.read_text().splitlines()[0]}")


def main() -> None:
    check_hashes()
    nodes = check_layout()
    rclpy.init()
    check_rclpy_node()
    check_launched_node(nodes)
    check_documented_publisher()
    check_documented_subscriber()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
