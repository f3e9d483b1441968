"""Check the node and the player on Zenoh with zenoh-ros2-sdk, an independent implementation of rmw_zenoh's wire.

    sdk_peer.py node TOPIC [--frames N] [--timeout S]
    sdk_peer.py player TOPIC [--timeout S]

node    discovers the node `eddy_node`, its topics (TOPIC/particles, TOPIC/prediction, TOPIC/prediction/status, /diagnostics)
        and services with their types; publishes N frames on TOPIC/particles and receives the predictions; gets and sets the
        parameter `horizon`; a value out of range must be rejected with a reason; resets the node.
player  controls a paused `eddy replay` of frames: is_paused, play_next, set_rate, get_rate, seek forwards and back, resume,
        toggle_paused, pause; the frames that arrive on TOPIC must match.

Definitions come from `msgs/`; type hashes are computed by the sdk, so that a wrong hash in eddy would prevent a match. The domain is
ROS_DOMAIN_ID. Prints one line of JSON; exits with 1 and a message if a check fails.
"""

import argparse
import json
import os
import queue
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy

import zenoh_peer

# The ports of eddy processes and of a router.
os.environ.setdefault("ZENOH_CONFIG_OVERRIDE", f"connect/endpoints={json.dumps(zenoh_peer.ENDPOINTS)}")

from zenoh_ros2_sdk import (
    ROS2Publisher, ROS2ServiceClient, ROS2Subscriber, get_registry, get_service_names_and_types,
    get_topic_info, get_topic_names_and_types, load_message_type,
)

MSGS = Path(__file__).resolve().parents[2] / "msgs"
FRAME = zenoh_peer.FRAME
NODE, PLAYER = "eddy_node", "eddy_replay"
MESSAGES = [FRAME] + [f"rcl_interfaces/msg/{name}" for name in (
    "Parameter", "SetParametersResult", "ListParametersResult", "ParameterDescriptor")]
# The sdk does not support empty messages.
EMPTY = "uint8 structure_needs_at_least_one_member"


def expect(holds, sentence):
    if not holds:
        sys.exit(f"sdk_peer.py: {sentence}")


def until(deadline, what, answer):
    """Poll until the answer is truthy."""
    while True:
        found = answer()
        if found:
            return found
        expect(time.monotonic() < deadline, f"{what}: timed out")
        time.sleep(0.05)


def definitions(folder):
    """Make the sdk load eddy's message definitions from a local folder instead of the network."""
    for package in (path for path in [*MSGS.joinpath("standard").iterdir(), MSGS / "eddy_msgs"] if path.is_dir()):
        shutil.copytree(package, Path(folder) / package.name)
    for file in MSGS.joinpath("standard").glob("*.txt"):
        for text in re.split(r"^=+\nMSG: ", file.read_text(), flags=re.MULTILINE)[1:]:
            name, definition = text.split("\n", 1)
            package, kind = name.split("/")
            path = Path(folder) / package / "msg" / f"{kind}.msg"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(definition)
    get_registry(str(folder))
    for kind in MESSAGES:
        expect(load_message_type(kind), f"{kind} was not loaded")


class Service:
    """A client of one of eddy's services."""

    def __init__(self, name, kind, deadline):
        text = MSGS.joinpath("standard", f"{kind}.srv").read_text()
        # The sdk resolves messages without a package name relative to the service, not to `msg`.
        package = kind.split("/")[0]
        parts = re.sub(r"^([A-Z]\w*)", rf"{package}/\1", text, flags=re.MULTILINE).split("---")
        request, response = (part.strip() or EMPTY for part in parts)
        self.empty = request == EMPTY
        until(deadline, f"service {name}", lambda: [kind] == dict(get_service_names_and_types()).get(name))
        self.client = ROS2ServiceClient(name, kind, request_definition=request, response_definition=response)
        self.name = name

    def __call__(self, **request):
        if self.empty:
            request = {"structure_needs_at_least_one_member": 0}
        answer = self.client.call(**request)
        expect(answer is not None, f"{self.name}: no answer to {request}")
        return answer

    def type(self, name):
        return self.client.session_mgr.store.types[name]


def check_graph(topic, deadline):
    frame, status = FRAME, "eddy_msgs/msg/PredictionStatus"
    expected = {
        f"{topic}/particles": [frame], f"{topic}/prediction": [frame], f"{topic}/prediction/status": [status],
        "/diagnostics": ["diagnostic_msgs/msg/DiagnosticArray"],
    }
    until(deadline, f"topics {list(expected)}", lambda: expected.items() <= dict(get_topic_names_and_types()).items())
    info = get_topic_info(f"{topic}/prediction", verbose=True)
    names = [(end.node_name, end.node_namespace) for end in info.publishers]
    expect(names == [(NODE, "/")], f"publishers of {topic}/prediction: found {names}")
    return sorted(expected)


def exchange_frames(topic, count, deadline):
    """Send frames and receive the predictions for all frames after the warm-up."""
    predictions = queue.Queue()
    subscriber = ROS2Subscriber(f"{topic}/prediction", FRAME, predictions.put)
    publisher = ROS2Publisher(f"{topic}/particles", FRAME)
    until(deadline, "the node's subscription", lambda: publisher.pub.matching_status.matching)
    sent = argparse.Namespace(stream=11, particles=2500, count=count)
    for frame in zenoh_peer.falling_frames(zenoh_peer.typestore(), sent):
        fields = {name: getattr(frame, name) for name in frame.__dataclass_fields__ if not name.startswith("__")}
        publisher.publish(**fields)
        time.sleep(1 / 12)
    sequences = []
    while not sequences or sequences[-1] < count:
        try:
            message = predictions.get(timeout=max(0, deadline - time.monotonic()))
        except queue.Empty:
            sys.exit(f"sdk_peer.py: found predictions of {sequences}, expected up to {count}")
        zenoh_peer.check_frame(message)
        expect(message.stream == 11, f"stream: found {message.stream}, expected 11")
        sequences.append(int(message.sequence))
    expect(sequences == list(range(sequences[0], count + 1)), f"predictions: found {sequences}")
    subscriber.close()
    publisher.close()
    return len(sequences)


def check_parameters(deadline):
    def service(name, kind):
        return Service(f"/{NODE}/{name}", f"rcl_interfaces/srv/{kind}", deadline)

    get, put = service("get_parameters", "GetParameters"), service("set_parameters", "SetParameters")
    listed = service("list_parameters", "ListParameters")(prefixes=[], depth=0).result.names
    expect("horizon" in listed, f"parameters: found {listed}")

    def horizon():
        value = get(names=["horizon"]).values[0]
        expect(value.type == 2, f"horizon: found type {value.type}, expected 2")
        return value.integer_value

    def set_horizon(value):
        Parameter, Value = (put.type(f"rcl_interfaces/msg/{name}") for name in ("Parameter", "ParameterValue"))
        none = lambda kind: numpy.zeros(0, kind)
        held = Value(
            type=2, bool_value=False, integer_value=value, double_value=0.0, string_value="",
            byte_array_value=none(numpy.uint8), bool_array_value=none(numpy.bool_),
            integer_array_value=none(numpy.int64), double_array_value=none(numpy.float64), string_array_value=[],
        )
        return put(parameters=[Parameter(name="horizon", value=held)]).results[0]

    expect(horizon() == 1, f"horizon: found {horizon()}, expected 1")
    expect(set_horizon(20).successful, "horizon: 20 was rejected")
    refused = set_horizon(20_000)
    expect(not refused.successful and "expected 1 to 10000" in refused.reason, f"horizon: found {refused}")
    expect(horizon() == 20, f"horizon: found {horizon()}, expected 20")
    expect(set_horizon(1).successful, "horizon: 1 was rejected")
    return refused.reason


def node(args, deadline):
    topics = check_graph(args.topic, deadline)
    predictions = exchange_frames(args.topic, args.frames, deadline)
    refused = check_parameters(deadline)
    reset = Service(f"/{NODE}/reset", "std_srvs/srv/Trigger", deadline)()
    expect(reset.success and reset.message == "1 stream reset", f"reset: found {reset}")
    return {"topics": topics, "predictions": predictions, "refused": refused, "reset": reset.message}


def player(args, deadline):
    frames = queue.Queue()
    subscriber = ROS2Subscriber(args.topic, FRAME, lambda message: frames.put((time.monotonic(), message)))

    def service(name, kind):
        return Service(f"/{PLAYER}/{name}", f"rosbag2_interfaces/srv/{kind}", deadline)

    def arrival():
        """Arrival time of the next frame (s) and its simulation time (ns)."""
        try:
            came, message = frames.get(timeout=max(0, deadline - time.monotonic()))
        except queue.Empty:
            sys.exit("sdk_peer.py: timed out waiting for a frame")
        return came, message.header.stamp.sec * 10**9 + message.header.stamp.nanosec

    def stamp():
        return arrival()[1]

    def nothing():
        time.sleep(0.5)
        expect(frames.empty(), "a paused player published a frame")

    is_paused, play_next, seek = (
        service("is_paused", "IsPaused"), service("play_next", "PlayNext"), service("seek", "Seek"))
    Time = seek.type("builtin_interfaces/msg/Time")

    def go_to(nanoseconds):
        return seek(time=Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)).success

    until(deadline, "the player is paused", lambda: is_paused().paused)
    nothing()
    expect(play_next().success, "play_next: failed while paused")
    # In eddy's bags of frames, the log time is the stamp.
    first = stamp()
    set_rate, get_rate = service("set_rate", "SetRate"), service("get_rate", "GetRate")
    expect(set_rate(rate=0.5).success and get_rate().rate == 0.5, "set_rate: 0.5 had no effect")
    expect(not set_rate(rate=-1.0).success and get_rate().rate == 0.5, "set_rate: -1 was accepted")
    later = first + 10**9
    expect(go_to(later) and play_next().success, "seek: failed one second ahead")
    found = stamp()
    expect(later <= found < later + 50_000_000, f"seek: found {found} ns, expected {later}")
    expect(go_to(first) and play_next().success and stamp() == first, "seek: failed going back")
    expect(not go_to(first + 3600 * 10**9), "seek: a time after the end was accepted")
    service("resume", "Resume")()
    expect(not is_paused().paused and not play_next().success, "resume: the player is still paused")
    begun, start = arrival()
    ended, now = begun, start
    while now < start + 500_000_000:
        ended, now = arrival()
    took = ended - begun
    # Twice as long at half the rate; a busy machine may be late.
    expect(0.8 < took < 4, f"rate 0.5: {(now - start) / 1e9} s took {took} s")
    service("toggle_paused", "TogglePaused")()
    expect(is_paused().paused, "toggle_paused: the player is not paused")
    while not frames.empty():
        frames.get()
    nothing()
    service("pause", "Pause")()
    expect(is_paused().paused, "pause: the player is not paused")
    subscriber.close()
    return {"seconds": (now - start) / 1e9, "took": round(took, 3)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("role", choices=["node", "player"])
    parser.add_argument("topic")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--timeout", type=float, default=60)
    args = parser.parse_args()
    deadline = time.monotonic() + args.timeout
    with tempfile.TemporaryDirectory() as folder:
        definitions(folder)
        outcome = (node if args.role == "node" else player)(args, deadline)
    print(json.dumps(outcome), flush=True)
    # The sdk's threads would outlive its session.
    os._exit(0)


if __name__ == "__main__":
    main()
