"""The node on DDS against a real ROS 2: rclpy on Fast DDS, without eddy's message package.

    ros_peer.py TOPIC [--timeout S]

Finds the node `eddy_node`, its topics with their types (TOPIC/particles, TOPIC/prediction, TOPIC/prediction/status,
/diagnostics) and its services; reads /diagnostics; gets the parameter `horizon`, sets it, and is refused a value out
of its range with the reason; resets the node. The domain is ROS_DOMAIN_ID. Prints one line of JSON; exits with 1
and a sentence when something does not hold.
"""

import argparse
import json
import os
import sys
import time

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter

NODE = "eddy_node"


def expect(holds, sentence):
    if not holds:
        sys.exit(f"ros_peer.py: {sentence}")


def until(node, deadline, what, answer):
    """Asks again and again, while the node spins."""
    while True:
        found = answer()
        if found:
            return found
        expect(time.monotonic() < deadline, f"{what}: not in time")
        rclpy.spin_once(node, timeout_sec=0.05)


def call(node, deadline, kind, name, request):
    client = node.create_client(kind, f"/{NODE}/{name}")
    until(node, deadline, f"service {name}", client.service_is_ready)
    future = client.call_async(request)
    until(node, deadline, f"answer of {name}", future.done)
    node.destroy_client(client)
    return future.result()


def check_graph(node, deadline, topic):
    until(node, deadline, f"node {NODE}", lambda: (NODE, "/") in node.get_node_names_and_namespaces())
    frame, status = "eddy_msgs/msg/ParticleFrame", "eddy_msgs/msg/PredictionStatus"
    published = {
        f"{topic}/prediction": frame, f"{topic}/prediction/status": status,
        "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    }

    def agree():
        found = dict(node.get_publisher_names_and_types_by_node(NODE, "/"))
        read = dict(node.get_subscriber_names_and_types_by_node(NODE, "/"))
        names = {name: [kind] for name, kind in published.items()}
        return names.items() <= found.items() and read.get(f"{topic}/particles") == [frame]

    until(node, deadline, "topics of the node with their types", agree)
    everything = dict(node.get_topic_names_and_types())
    expect(everything[f"{topic}/prediction"] == [frame], f"topics: found {everything}")
    services = dict(until(
        node, deadline, "services", lambda: node.get_service_names_and_types_by_node(NODE, "/")))
    expect(services.get(f"/{NODE}/set_parameters") == ["rcl_interfaces/srv/SetParameters"], f"services: {services}")
    return sorted(everything)


def read_diagnostics(node, deadline):
    received = []
    # ROS's own defaults: reliable, keep last 10.
    subscription = node.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)
    until(node, deadline, "/diagnostics", lambda: received)
    node.destroy_subscription(subscription)
    status = received[0].status[0]
    values = {pair.key: pair.value for pair in status.values}
    expect(status.name == NODE and len(values["model"]) == 64, f"diagnostics: found {status}")
    return status.message


def set_horizon(node, deadline, value):
    parameter = Parameter("horizon", value=value).to_parameter_msg()
    answer = call(node, deadline, SetParameters, "set_parameters", SetParameters.Request(parameters=[parameter]))
    return answer.results[0]


def check_parameters(node, deadline):
    names = call(node, deadline, ListParameters, "list_parameters", ListParameters.Request()).result.names
    expect(names == ["horizon"], f"parameters: found {names}")
    request = DescribeParameters.Request(names=["horizon"])
    descriptor = call(node, deadline, DescribeParameters, "describe_parameters", request).descriptors[0]
    bounds = descriptor.integer_range[0]
    expect((bounds.from_value, bounds.to_value) == (1, 10_000), f"range: found {bounds}")

    def horizon():
        request = GetParameters.Request(names=["horizon"])
        return call(node, deadline, GetParameters, "get_parameters", request).values[0].integer_value

    expect(horizon() == 1, f"horizon: found {horizon()}, expected 1")
    expect(set_horizon(node, deadline, 20).successful, "horizon: 20 was refused")
    refused = set_horizon(node, deadline, 20_000)
    expect(not refused.successful and "expected 1 to 10000" in refused.reason, f"horizon: found {refused}")
    expect(horizon() == 20, f"horizon: found {horizon()}, expected 20")
    expect(set_horizon(node, deadline, 1).successful, "horizon: 1 was refused")
    return refused.reason


def reset(node, deadline):
    from std_srvs.srv import Trigger

    answer = call(node, deadline, Trigger, "reset", Trigger.Request())
    expect(answer.success, f"reset: found {answer}")
    return answer.message


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("topic")
    parser.add_argument("--timeout", type=float, default=60)
    args = parser.parse_args()
    deadline = time.monotonic() + args.timeout
    rclpy.init()
    node = rclpy.create_node("ros_peer")
    outcome = {
        "topics": check_graph(node, deadline, args.topic), "diagnostics": read_diagnostics(node, deadline),
        "refused": check_parameters(node, deadline), "reset": reset(node, deadline),
    }
    node.destroy_node()
    rclpy.shutdown()
    print(json.dumps(outcome))


if __name__ == "__main__":
    main()
