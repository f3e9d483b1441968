"""Check the node on DDS with a real ROS 2: rclpy on Fast DDS, without eddy's message package.

    ros_peer.py TOPIC --bag BAG [--timeout S] --ros-args ...

The node runs with the same `--ros-args`, with links to TOPIC/particles and TOPIC/prediction, and with clouds; BAG is replayed
to TOPIC/particles in a loop. An rclpy node with these arguments is the reference for the node's names and parameters.
Checks: topics with their types and services are discovered; /diagnostics is published; parameters can be
listed, described, read and set, a value out of range is rejected with a reason, and changes are announced on
/parameter_events; the points of both clouds equal the frames, TOPIC/particles/cloud as rosbags reads them from BAG; the
node can be reset. The domain is ROS_DOMAIN_ID. Prints one line of JSON; exits with 1 and a message if a check
fails.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")

import numpy
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterEvent, ParameterType
from rcl_interfaces.srv import (
    DescribeParameters, GetParameters, ListParameters, SetParameters, SetParametersAtomically,
)
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import qos_profile_parameter_events
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import PointCloud2, PointField

NODE = "eddy_node"
MSGS = Path(__file__).resolve().parents[2] / "msgs" / "eddy_msgs" / "msg"
FRAME = "eddy_msgs/msg/ParticleFrame"
POINT = {"x": (0, "<f4"), "y": (4, "<f4"), "z": (8, "<f4"), "vx": (12, "<f4"), "vy": (16, "<f4"), "material": (20, "u1")}
KINDS = {PointField.FLOAT32: "<f4", PointField.UINT8: "u1"}


def expect(holds, sentence):
    if not holds:
        sys.exit(f"ros_peer.py: {sentence}")


class Peer:
    """An rclpy node next to the node under test."""

    def __init__(self, topic, arguments, timeout):
        self.topic, self.deadline = topic, time.monotonic() + timeout
        # How ROS interprets the arguments. Destroyed before anything searches for a node of this name.
        twin = rclpy.create_node(NODE, cli_args=arguments, automatically_declare_parameters_from_overrides=True)
        self.name, self.namespace = twin.get_name(), twin.get_namespace()
        self.full_name = twin.get_fully_qualified_name()
        self.diagnostics = twin.resolve_topic_name("/diagnostics")
        self.parameters = {name: parameter.value for name, parameter in twin.get_parameters_by_prefix("").items()}
        twin.destroy_node()
        self.node = rclpy.create_node("ros_peer")

    def until(self, what, answer):
        """Poll until the answer is truthy, while the node spins."""
        while True:
            found = answer()
            if found:
                return found
            expect(time.monotonic() < self.deadline, f"{what}: timed out")
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def call(self, kind, name, request):
        client = self.node.create_client(kind, f"{self.full_name}/{name}")
        self.until(f"service {name}", client.service_is_ready)
        future = client.call_async(request)
        self.until(f"answer of {name}", future.done)
        self.node.destroy_client(client)
        return future.result()

    def get(self, *names):
        values = self.call(GetParameters, "get_parameters", GetParameters.Request(names=names)).values
        return [parameter_value_to_python(value) for value in values]

    def set(self, kind, service, **values):
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        return self.call(kind, service, kind.Request(parameters=parameters))

    def check_graph(self):
        place = (self.name, self.namespace)
        self.until(f"node {place}", lambda: place in self.node.get_node_names_and_namespaces())
        cloud = "sensor_msgs/msg/PointCloud2"
        published = {
            f"{self.topic}/prediction": FRAME, f"{self.topic}/prediction/status": "eddy_msgs/msg/PredictionStatus",
            f"{self.topic}/prediction/cloud": cloud, f"{self.topic}/particles/cloud": cloud,
            self.diagnostics: "diagnostic_msgs/msg/DiagnosticArray",
            "/parameter_events": "rcl_interfaces/msg/ParameterEvent",
        }

        def agree():
            found = dict(self.node.get_publisher_names_and_types_by_node(*place))
            read = dict(self.node.get_subscriber_names_and_types_by_node(*place))
            names = {name: [kind] for name, kind in published.items()}
            return names.items() <= found.items() and read.get(f"{self.topic}/particles") == [FRAME]

        self.until("topics of the node with their types", agree)
        services = dict(self.until("services", lambda: self.node.get_service_names_and_types_by_node(*place)))
        expect(services.get(f"{self.full_name}/set_parameters") == ["rcl_interfaces/srv/SetParameters"],
               f"services: {services}")
        return sorted(published)

    def read_diagnostics(self):
        received = []
        # ROS's defaults: reliable, keep last 10.
        subscription = self.node.create_subscription(DiagnosticArray, self.diagnostics, received.append, 10)
        self.until("/diagnostics", lambda: received)
        self.node.destroy_subscription(subscription)
        status = received[0].status[0]
        values = {pair.key: pair.value for pair in status.values}
        expect(f"/{status.name}" == self.full_name and len(values["model"]) == 64, f"diagnostics: found {status}")
        return status.message

    def check_parameters(self):
        names = list(self.call(ListParameters, "list_parameters", ListParameters.Request()).result.names)
        expect({"horizon", "publish", "free_run", "queue", "use_sim_time"} <= set(names), f"parameters: {names}")
        request = DescribeParameters.Request(names=names)
        described = self.call(DescribeParameters, "describe_parameters", request).descriptors
        described = {descriptor.name: descriptor for descriptor in described}
        bounds = described["horizon"].integer_range[0]
        expect((bounds.from_value, bounds.to_value) == (1, 10_000), f"range: found {bounds}")
        expect(described["queue"].read_only and not described["max_gap"].read_only, f"descriptors: {described}")
        expect(described["publish"].type == ParameterType.PARAMETER_STRING, f"descriptor: {described['publish']}")
        # The values that rclpy has for the same arguments.
        values = dict(zip(names, self.get(*names)))
        for name in self.parameters.keys() & values.keys():
            expect(values[name] == self.parameters[name],
                   f"{name}: found {values[name]}, expected {self.parameters[name]} as rclpy has it")
        given = sorted(name for name in self.parameters.keys() & values.keys() if name != "use_sim_time")
        expect(given, f"no parameter was given: {self.parameters}")

        expect(self.set(SetParameters, "set_parameters", horizon=20).results[0].successful, "horizon: 20 was rejected")
        refused = self.set(SetParameters, "set_parameters", horizon=20_000).results[0]
        expect(not refused.successful and "expected 1 to 10000" in refused.reason, f"horizon: found {refused}")
        both = self.set(SetParametersAtomically, "set_parameters_atomically", max_gap=1, queue=5).result
        expect(not both.successful and "read-only" in both.reason, f"queue: found {both}")
        expect(self.get("horizon", "max_gap") == [20, values["max_gap"]], "a rejected change had an effect")
        return {"names": names, "given": given, "refused": [refused.reason, both.reason]}

    def check_parameter_events(self):
        received = []
        subscription = self.node.create_subscription(
            ParameterEvent, "/parameter_events", received.append, qos_profile_parameter_events)

        def announced():
            answer = self.set(SetParametersAtomically, "set_parameters_atomically", publish="last", horizon=1).result
            expect(answer.successful, f"set: {answer}")
            return [event for event in received if event.node == self.full_name]

        event = self.until("/parameter_events", announced)[0]
        self.node.destroy_subscription(subscription)
        changed = {change.name: parameter_value_to_python(change.value) for change in event.changed_parameters}
        expect(changed == {"publish": "last", "horizon": 1}, f"/parameter_events: found {event}")
        return changed

    def check_clouds(self, bag):
        truth, particles = frames_of(bag)
        outcome = {}
        for name in ("particles", "prediction"):
            received, topic = [], f"{self.topic}/{name}/cloud"
            subscription = self.node.create_subscription(PointCloud2, topic, received.append, 10)
            self.until(topic, lambda: len(received) >= 20)
            self.node.destroy_subscription(subscription)
            exact = 0
            for cloud in received:
                points = points_of(cloud)
                expect(len(points) == particles, f"{topic}: found {len(points)} points, expected {particles}")
                expect((points["z"] == 0).all() and (points["material"] <= 3).all(), f"{topic}: {points}")
                expect(numpy.isfinite(points["x"]).all() and (abs(points["x"] - 0.5) < 0.6).all(), f"{topic}: x")
                frame = truth.get((cloud.header.stamp.sec, cloud.header.stamp.nanosec))
                if name == "particles":
                    expect(frame is not None, f"{topic}: no frame in the bag is stamped {cloud.header.stamp}")
                    exact += check_points(topic, points, frame)
            outcome[name] = {"clouds": len(received), "equal to the bag": exact}
        return outcome

    def reset(self):
        from std_srvs.srv import Trigger

        answer = self.call(Trigger, "reset", Trigger.Request())
        expect(answer.success, f"reset: found {answer}")
        return answer.message


def frames_of(bag):
    """The frames of a bag by stamp, as rosbags reads them, and their number of particles."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(MSGS.glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(), f"eddy_msgs/msg/{path.stem}"))
    with Reader(bag) as reader:
        wanted = [connection for connection in reader.connections if connection.msgtype == FRAME]
        frames = [store.deserialize_cdr(data, FRAME) for _, _, data in reader.messages(wanted)]
    stamps = {(frame.header.stamp.sec, frame.header.stamp.nanosec): frame for frame in frames}
    return stamps, len(frames[0].material)


def points_of(cloud):
    """The points as the cloud's own fields describe them."""
    fields = {field.name: (field.offset, KINDS[field.datatype]) for field in cloud.fields}
    expect(fields == POINT, f"fields: found {fields}, expected {POINT}")
    expect(cloud.point_step == 24 and cloud.row_step == 24 * cloud.width and cloud.height == 1, f"cloud: {cloud}")
    offsets, formats = zip(*fields.values())
    kind = numpy.dtype({"names": list(fields), "offsets": offsets, "formats": formats, "itemsize": cloud.point_step})
    return numpy.frombuffer(bytes(cloud.data), kind)


def check_points(topic, points, frame):
    position, velocity = frame.position.reshape(-1, 2), frame.velocity.reshape(-1, 2)
    columns = {
        "x": position[:, 0], "y": position[:, 1], "vx": velocity[:, 0], "vy": velocity[:, 1], "material": frame.material,
    }
    for name, column in columns.items():
        expect((points[name] == column).all(), f"{topic}: {name} of frame {frame.sequence} differs from the bag")
    return 1


def main():
    # Arguments after --ros-args are for the node and for rclpy.
    split = sys.argv.index("--ros-args") if "--ros-args" in sys.argv else len(sys.argv)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("topic")
    parser.add_argument("--bag", required=True)
    parser.add_argument("--timeout", type=float, default=90)
    args = parser.parse_args(sys.argv[1:split])
    rclpy.init(args=[])
    peer = Peer(args.topic, sys.argv[split:], args.timeout)
    outcome = {
        "node": peer.full_name, "topics": peer.check_graph(), "diagnostics": peer.read_diagnostics(),
        "parameters": peer.check_parameters(), "events": peer.check_parameter_events(), "clouds": peer.check_clouds(args.bag),
        "reset": peer.reset(),
    }
    peer.node.destroy_node()
    rclpy.shutdown()
    print(json.dumps(outcome))


if __name__ == "__main__":
    main()
