"""Check what ROS 2 expects of any node on DDS: rclpy on Fast DDS manages, reads and calls eddy's node, and eddy calls rclpy.

    node_peer.py EDDY BAG

1. `eddy node --lifecycle` is taken through its life by the services of a managed node; it predicts only while it is active, and
   announces its transitions.
2. Its log is on /rosout, also for late subscribers; it describes its types; the QoS of its topics follows `qos_overrides`.
3. After SIGINT it leaves rclpy's graph within two seconds, with all its publishers.
4. `eddy param` and `eddy service` read, set and call a node of rclpy.
5. Service events (introspection) of rclpy are recorded: rosbags reads requests and responses from the bag.

EDDY is the program; BAG is replayed to the node. The domain is ROS_DOMAIN_ID. Prints one line of JSON; exits with 1 and a message if
a check fails.
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

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Log
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data, qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from type_description_interfaces.srv import GetTypeDescription

NODE = "/managed"
TIMEOUT = 60
# Time for the answer to a request that is sent once (s).
CALL = 10
# Time in which a node that ended has to leave the graph (s).
FAREWELL = 2
HASH = "RIHS01_"


def expect(holds, sentence):
    if not holds:
        sys.exit(f"node_peer.py: {sentence}")


class Peer:
    """A node of rclpy that also answers services while it waits."""

    def __init__(self, eddy, folder):
        self.eddy, self.folder = eddy, folder
        self.node = rclpy.create_node("node_peer")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.started = []

    def until(self, what, answer, timeout=TIMEOUT):
        deadline = time.monotonic() + timeout
        while not (found := answer()):
            expect(time.monotonic() < deadline, f"{what}: not within {timeout} s")
            self.executor.spin_once(timeout_sec=0.02)
        return found

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        self.until(f"service {name}", client.service_is_ready)
        future = client.call_async(request)
        self.until(f"response of {name}", future.done, CALL)
        self.node.destroy_client(client)
        return future.result()

    def received(self, kind, topic, qos=10):
        messages = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def start(self, *arguments):
        log = (self.folder / f"{arguments[0]}.log").open("w")
        process = subprocess.Popen([self.eddy, *arguments], stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        self.started.append(process)
        return process

    def run(self, *arguments, code=0):
        """The output of eddy, while this node answers."""
        process = subprocess.Popen([self.eddy, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.until(" ".join(arguments), lambda: process.poll() is not None)
        out, error = process.communicate()
        expect(process.returncode == code, f"{arguments}: exit code {process.returncode}\n{out}{error}")
        return out + error

    def end(self, process):
        process.send_signal(signal.SIGINT)
        code = process.wait(TIMEOUT)
        expect(code == 0, f"exit code {code}")


def state(peer):
    return peer.call(GetState, f"{NODE}/get_state", GetState.Request()).current_state.label


def change(peer, label, number=0):
    request = ChangeState.Request()
    request.transition.id, request.transition.label = number, label
    return peer.call(ChangeState, f"{NODE}/change_state", request).success


def check_life(peer):
    events = peer.received(TransitionEvent, f"{NODE}/transition_event")
    clouds = peer.received(PointCloud2, "/managed_out/cloud")
    diagnostics = peer.received(DiagnosticArray, "/diagnostics", qos_profile_sensor_data)
    expect(state(peer) == "unconfigured", f"state: {state(peer)}")
    peer.until("diagnostics", lambda: diagnostics)
    expect(diagnostics[-1].status[0].message == "unconfigured", f"diagnostics: {diagnostics[-1]}")
    expect(not change(peer, "activate"), "activate from unconfigured succeeded")
    states = peer.call(GetAvailableStates, f"{NODE}/get_available_states", GetAvailableStates.Request())
    expect({"unconfigured", "inactive", "active", "finalized"} <= {one.label for one in states.available_states}, f"{states}")

    def transitions():
        answer = peer.call(
            GetAvailableTransitions, f"{NODE}/get_available_transitions", GetAvailableTransitions.Request())
        return sorted(one.transition.label for one in answer.available_transitions)

    expect(transitions() == ["configure", "shutdown"], f"transitions: {transitions()}")
    peer.until("a match for the events", lambda: peer.node.count_publishers(f"{NODE}/transition_event"))
    expect(change(peer, "configure", 1) and state(peer) == "inactive", "configure")
    expect(transitions() == ["activate", "cleanup", "shutdown"], f"transitions: {transitions()}")
    peer.spin(2)
    expect(not clouds, f"{len(clouds)} predictions while inactive")
    expect(change(peer, "", 3) and state(peer) == "active", "activate")
    peer.until("predictions", lambda: len(clouds) > 20)
    expect(change(peer, "deactivate") and state(peer) == "inactive", "deactivate")
    peer.spin(1)
    before = len(clouds)
    peer.spin(2)
    expect(len(clouds) == before, f"{len(clouds) - before} predictions after deactivate")
    expect(change(peer, "activate") and state(peer) == "active", "activate again")
    peer.until("predictions again", lambda: len(clouds) > before + 20)
    expect(change(peer, "deactivate") and change(peer, "cleanup"), "cleanup")
    expect(state(peer) == "unconfigured", f"state: {state(peer)}")
    expect(change(peer, "shutdown") and state(peer) == "finalized", "shutdown")
    expect(transitions() == [], f"transitions: {transitions()}")
    path = lambda: [(event.start_state.label, event.goal_state.label) for event in events]
    expected = [
        ("unconfigured", "configuring"), ("configuring", "inactive"), ("inactive", "activating"), ("activating", "active"),
        ("active", "deactivating"), ("deactivating", "inactive"), ("inactive", "activating"), ("activating", "active"),
        ("active", "deactivating"), ("deactivating", "inactive"), ("inactive", "cleaningup"), ("cleaningup", "unconfigured"),
        ("unconfigured", "shuttingdown"), ("shuttingdown", "finalized"),
    ]
    peer.until(f"events, found {path()}", lambda: path() == expected)
    return len(events)


def check_log(peer):
    """A late subscriber receives what the node said before."""
    latched = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE,
                         durability=DurabilityPolicy.TRANSIENT_LOCAL)
    records = peer.received(Log, "/rosout", latched)
    said = lambda text: [one for one in records if one.name == "managed" and text in one.msg]
    first = peer.until("the first words", lambda: said("predicting dds:"))[0]
    expect(first.level == 20 and first.file.endswith(".rs") and first.line > 0, f"log: {first}")
    peer.until("the last transition", lambda: said("shuttingdown -> finalized"))
    return len([one for one in records if one.name == "managed"])


def check_types(peer):
    """The first answer is larger than a packet of Ethernet."""
    own = peer.node.get_publishers_info_by_topic("/parameter_events")
    mine = next(info for info in own if info.node_name == "node_peer")
    kind = "rcl_interfaces/msg/ParameterEvent"
    expect(mine.topic_type == kind, f"{mine}")
    request = GetTypeDescription.Request(type_name=kind, type_hash=str(mine.topic_type_hash), include_type_sources=True)
    answer = peer.call(GetTypeDescription, f"{NODE}/get_type_description", request)
    expect(answer.successful and answer.type_description.type_description.type_name == kind, f"{answer.failure_reason}")
    expect(any("ParameterValue" in source.raw_file_contents for source in answer.type_sources), f"{answer.type_sources}")
    other = peer.call(
        GetTypeDescription, f"{NODE}/get_type_description", GetTypeDescription.Request(type_name="acme/msg/None"))
    expect(not other.successful and other.failure_reason, f"{other}")
    return len(answer.type_sources)


def check_qos(peer):
    info = lambda topic: peer.until(topic, lambda: [
        info for info in peer.node.get_publishers_info_by_topic(topic) if info.node_name == "managed"])[0].qos_profile
    diagnostics, prediction = info("/diagnostics"), info("/managed_out")
    expect(diagnostics.reliability == ReliabilityPolicy.BEST_EFFORT, f"/diagnostics: {diagnostics}")
    expect(prediction.reliability == ReliabilityPolicy.RELIABLE, f"prediction: {prediction}")
    expect(prediction.durability == DurabilityPolicy.TRANSIENT_LOCAL, f"prediction: {prediction}")


def check_farewell(peer, process):
    known = lambda: "managed" in peer.node.get_node_names()
    published = lambda: peer.node.count_publishers("/managed_out")
    expect(known() and published() == 1, "the node is not in the graph")
    peer.end(process)
    start = time.monotonic()
    peer.until("the node leaves the graph", lambda: not known() and not published(), FAREWELL)
    return round(time.monotonic() - start, 3)


def check_commands(peer):
    def answer(request, response):
        response.success, response.message = True, f"data: {request.data}"
        return response

    service = peer.node.create_service(SetBool, "/switch", answer)
    service.configure_introspection(
        peer.node.get_clock(), qos_profile_system_default, ServiceIntrospectionState.CONTENTS)
    peer.node.declare_parameter("gain", 1.5)
    listed = peer.run("service", "list", "-t", "--from", "dds", "--wait", "6")
    expect("dds:/switch [std_srvs/srv/SetBool]" in listed, f"service list: {listed}")
    expect(peer.run("service", "type", "dds:/switch") == "std_srvs/srv/SetBool\n", "service type")
    called = peer.run("service", "call", "dds:/switch", "std_srvs/srv/SetBool", "{data: true}")
    expect(called == "success: true\nmessage: 'data: True'\n" or "data: True" in called, f"service call: {called}")
    wrong = peer.run("service", "call", "dds:/switch", "std_srvs/srv/SetBool", "{data: 3}", code=1)
    expect("data: found 3, expected true or false" in wrong, f"service call: {wrong}")
    names = peer.run("param", "list", "dds:/node_peer").split()
    expect("gain" in names and "use_sim_time" in names, f"param list: {names}")
    expect(peer.run("param", "get", "dds:/node_peer", "gain") == "Double value is: 1.5\n", "param get")
    peer.run("param", "set", "dds:/node_peer", "gain", "-2.5")
    expect(peer.node.get_parameter("gain").value == -2.5, "param set")
    refused = peer.run("param", "set", "dds:/node_peer", "gain", "high", code=1)
    expect("gain was not set" in refused, f"param set: {refused}")
    dumped = peer.run("param", "dump", "dds:/node_peer")
    expect("ros__parameters:" in dumped and "gain: -2.5" in dumped, f"param dump: {dumped}")
    # rclpy reads it.
    file = peer.folder / "dump.yaml"
    file.write_text(dumped)
    twin = rclpy.create_node("node_peer", cli_args=["--ros-args", "--params-file", str(file)],
                             automatically_declare_parameters_from_overrides=True)
    expect(twin.get_parameter("gain").value == -2.5, "the file is not read by rclpy")
    twin.destroy_node()


def check_service_events(peer):
    bag = peer.folder / "events"
    recorder = peer.start("record", "--from", "dds", "--regex", "_service_event$", "--output", str(bag))
    topic = "/switch/_service_event"
    peer.until("the recorder", lambda: peer.node.count_subscribers(topic))
    peer.spin(1)
    for data in (True, False, True):
        answer = peer.call(SetBool, "/switch", SetBool.Request(data=data))
        expect(answer.success, f"{answer}")
    peer.spin(2)
    peer.end(recorder)
    with AnyReader([bag]) as reader:
        expect([c.topic for c in reader.connections] == [topic], f"topics: {[c.topic for c in reader.connections]}")
        kind = reader.connections[0].msgtype
        expect(kind == "std_srvs/srv/SetBool_Event", f"type: {kind}")
        # What rosbags calls it.
        name = kind.replace("/srv/", "/srv/msg/")
        events = [reader.typestore.deserialize_cdr(data, name) for _, _, data in reader.messages()]
    requests = [event.request[0].data for event in events if len(event.request)]
    responses = [event.response[0].message for event in events if len(event.response)]
    # System default is transient local with depth 1 on Fast DDS: the last event before the recording is received, too.
    expect(len(responses) <= 4, f"responses: {responses}")
    responses = responses[-3:]
    expect(requests == [True, False, True], f"requests: {requests}")
    expect(responses == ["data: True", "data: False", "data: True"], f"responses: {responses}")
    return len(events)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("eddy")
    parser.add_argument("bag")
    args = parser.parse_args()
    rclpy.init(args=[])
    with tempfile.TemporaryDirectory() as folder:
        peer = Peer(args.eddy, Path(folder))
        try:
            overrides = [
                "/diagnostics.publisher.reliability:=best_effort", "/managed_out.publisher.reliability:=reliable",
                "/managed_out.publisher.durability:=transient_local", "/managed_out.publisher.depth:=3",
            ]
            parameters = [word for override in overrides for word in ("-p", f"qos_overrides.{override}")]
            node = peer.start(
                "node", "--lifecycle", "--cloud", "--input", "dds:/managed_in", "--output", "dds:/managed_out", "--ros-args",
                "-r", "__node:=managed", *parameters)
            peer.start("replay", args.bag, "--to", "dds", "--remap", "/particles:=/managed_in", "--loop", "--rate", "0.5")
            check_qos(peer)
            outcome = {"transitions": check_life(peer), "log": check_log(peer), "sources": check_types(peer)}
            outcome["seconds until it left the graph"] = check_farewell(peer, node)
            peer.end(peer.started.pop())
            check_commands(peer)
            outcome["service events"] = check_service_events(peer)
        finally:
            for process in peer.started:
                if process.poll() is None:
                    process.kill()
                    process.wait()
    print(json.dumps(outcome), flush=True)
    # Threads of the middleware would outlive it.
    os._exit(0)


if __name__ == "__main__":
    main()
