"""A node within the interpreter: frames from other programs in, predictions out."""

import os
import queue
import shutil
import signal
import struct
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import eddy
import pytest
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

FRAME = "eddy_msgs/msg/ParticleFrame"
MESSAGES = Path(__file__).parents[2] / "msgs" / "eddy_msgs" / "msg"
#: Seconds until a test gives up.
LIMIT = 60.0


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A domain that no other process on this machine uses. Above 101, the ports of DDS are those of other programs."""
    number = 1 + os.getpid() % 100
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    return number


def until(what: str, holds: Callable[[], object]) -> None:
    """Waits for a condition."""
    deadline = time.monotonic() + LIMIT
    while not holds():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def key(domain: int, topic: str) -> str:
    """The key of a topic of frames in rmw_zenoh's form."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in MESSAGES.glob("*.msg"):
        store.register(get_types_from_msg(path.read_text(), f"eddy_msgs/msg/{path.stem}"))
    return f"{domain}/{topic.strip('/')}/eddy_msgs::msg::dds_::ParticleFrame_/{store.hash_rihs01(FRAME)}"


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    """A session of eclipse-zenoh on the loopback interface."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    endpoints = [f'"tcp/127.0.0.1:{port}"' for port in range(7447, 7464)]
    config.insert_json5("connect/endpoints", f"[{', '.join(endpoints)}]")
    config.insert_json5("connect/retry", '{"period_init_ms": 100, "period_max_ms": 500}')
    with zenoh.open(config) as opened:
        yield opened


def frame_of(data: bytes, folder: Path) -> eddy.Frame:
    """The frame in a message."""
    with eddy.BagWriter(folder) as bag:
        bag.write("/particles", FRAME, data)
    return next(eddy.Bag(folder).frames())


def test_frames_published_from_python_are_predicted(
    tmp_path: Path, bags: Path, domain: int, session: zenoh.Session
) -> None:
    source = eddy.Bag(bags / "scene_0005")
    surrogate = eddy.Surrogate(threads=1)
    received: queue.Queue[bytes] = queue.Queue()
    subscriber = session.declare_subscriber(
        key(domain, "/python/ahead"), lambda sample: received.put(bytes(sample.payload))
    )
    publisher = session.declare_publisher(
        key(domain, "/python/seen"), congestion_control=zenoh.CongestionControl.BLOCK
    )
    links = ("zenoh:/python/seen", "zenoh:/python/ahead")
    with eddy.Node(*links, surrogate, settings={"horizon": 3}, reliability="block") as node:
        until("the node subscribes", lambda: publisher.matching_status.matching)
        for number, message in enumerate(source.messages("/particles"), 1):
            attachment = struct.pack("<qqB16s", number, time.time_ns(), 16, b"eddy python test")
            publisher.put(message.data, attachment=attachment)
        # A stream is predicted once it has warmed up.
        predicted_frames = len(source) - surrogate.warm_up + 1
        predictions = [received.get(timeout=LIMIT) for _ in range(predicted_frames)]
        assert node.running
        assert node.settings["horizon"] == 3
    subscriber.undeclare()
    assert not node.running
    assert (node.counters["received"], node.counters["published"]) == (len(source), predicted_frames)
    # The same bits as a stream of the same surrogate.
    frames = list(source.frames())
    stream = surrogate.stream(frames[0])
    for frame in frames:
        predicted = stream.step(frame)
    expected = stream.rollout(predicted, 2)[-1]
    assert frame_of(predictions[-1], tmp_path / "predicted") == expected


@pytest.mark.parametrize("transport", ["shm", "dds", "zenoh"])
def test_the_program_s_replay_is_predicted(transport: str, bags: Path) -> None:
    program = shutil.which("eddy", path=Path(sys.executable).parent)
    assert program is not None, "the wheel installs the program"
    bag = bags / "scene_0006"
    topic = f"/python_{os.getpid()}/{transport}"
    surrogate = eddy.Surrogate(threads=1)
    with eddy.Node(f"{transport}:{topic}", f"{transport}:{topic}/ahead", surrogate) as node:
        to = ["--to", transport, "--remap", f"/particles:={topic}", "--wait-for", "1", "--rate", "4"]
        subprocess.run([program, "--quiet", "replay", bag, *to], check=True, timeout=LIMIT)
        # Counters are those of the last second.
        until("the last frame", lambda: node.counters["received"] == len(eddy.Bag(bag)))
        assert node.status["streams"] == 1
        assert node.reset() == 1
    assert node.counters["published"] == len(eddy.Bag(bag)) - surrogate.warm_up + 1
    assert node.counters["lost_in_gaps"] == 0


def test_a_node_starts_stops_and_starts_again() -> None:
    topic = f"shm:/python_{os.getpid()}/again"
    node = eddy.Node(topic, [f"{topic}/a", f"{topic}/b"], name="predictor", namespace="/robot1")
    assert (node.name, node.input) == ("/robot1/predictor", topic)
    assert node.outputs == [f"{topic}/a", f"{topic}/b"]
    assert repr(node) == f"Node(/robot1/predictor, {topic} -> {topic}/a, {topic}/b)"
    node.stop()
    assert node.wait() and not node.running
    for _ in range(2):
        node.start()
        with pytest.raises(ValueError, match="this node is running"):
            node.start()
        assert not node.wait(0.05)
        node.set({"horizon": 7, "publish": "all"})
        assert node.settings["horizon"] == 7
        assert node.reset() == 0
        node.stop()
    assert node.settings["publish"] == "all", "kept for the next start"


def test_another_thread_may_stop_it() -> None:
    topic = f"shm:/python_{os.getpid()}/stopped"
    with eddy.Node(topic, f"{topic}/ahead") as node:
        threading.Timer(0.2, node.stop).start()
        assert node.wait(LIMIT)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"input": "zenoh"}, "link: found `zenoh`, expected transport:topic"),
        ({"input": "tcp:/a"}, "link transport: found `tcp`, expected shm, zenoh or dds"),
        ({"input": "memory:/a"}, "memory:/a: found memory, expected shm, zenoh or dds"),
        ({"output": []}, "output: found no links, expected at least 1"),
        ({"output": "zenoh:particles"}, "output: found zenoh:/particles, which is the input"),
        ({"output": ["shm:/a", "shm:/a"]}, "output: found shm:/a twice, expected once"),
        ({"reliability": "maybe"}, "reliability: found maybe, expected block or drop"),
        ({"name": "a b"}, "found `a b`, expected the name of a node"),
        ({"namespace": "robot"}, "found `robot`, expected an absolute namespace"),
        ({"settings": {"horizon": 0}}, "horizon: found 0, expected 1 to 10000"),
        ({"settings": {"horizon": 2.5}}, "horizon: found a double, expected an integer"),
        ({"settings": {"horizons": 1}}, "parameter: found horizons, expected one of horizon"),
    ],
)
def test_wrong_arguments_are_named(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        eddy.Node(**options)  # type: ignore[arg-type]


def test_other_mistakes_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(TypeError, match="horizon: found list, expected a bool, an int, a float or a str"):
        eddy.Node(settings={"horizon": []})  # type: ignore[dict-item]
    with pytest.raises(eddy.CheckpointError, match="model.toml"):
        eddy.Node(surrogate=tmp_path)
    topic = f"shm:/python_{os.getpid()}/mistakes"
    with eddy.Node(topic, f"{topic}/ahead") as node:
        with pytest.raises(ValueError, match="queue: read-only while the node runs"):
            node.set({"queue": 3})
        with pytest.raises(ValueError, match="timeout: found -1"):
            node.wait(-1.0)
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(eddy.NodeError, match="ROS_DOMAIN_ID: found `many`, expected a whole number"):
        node.start()
    assert not node.running


def test_ctrl_c_ends_the_waiting_and_the_block_stops_the_node() -> None:
    program = textwrap.dedent(
        f"""
        import eddy, os, signal, threading
        topic = "shm:/python_{os.getpid()}/interrupted"
        with eddy.Node(topic, topic + "/ahead") as node:
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
            try:
                node.wait()
            finally:
                print("stopping", flush=True)
        """
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=LIMIT)
    assert "KeyboardInterrupt" in ended.stderr and ended.stdout == "stopping\n", ended
    assert ended.returncode == -signal.SIGINT


@pytest.mark.parametrize("end", ["", "del node", "raise SystemExit(3)"])
def test_a_node_that_nobody_stops_ends_with_the_interpreter(end: str) -> None:
    program = f"import eddy; node = eddy.Node('zenoh:/a', 'shm:/python_{os.getpid()}/left'); node.start(); {end}"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=LIMIT)
    assert (ended.returncode, ended.stderr) == (3 if "Exit" in end else 0, "")
