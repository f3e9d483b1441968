"""Check that rclpy on Fast DDS finds all endpoints of two processes of eddy that start at once, on busy processors.

    discovery_peer.py EDDY BAG [STARTS]

Each of STARTS [16] times a new node of rclpy, `eddy node` and `eddy replay` meet while every processor is busy. Endpoints that are
announced while their process is not yet known to Fast DDS arrive out of order, and Fast DDS may then drop them for good: a fifth of
such starts, before eddy waited (crates/transport/src/dds/participant.rs). The domain is ROS_DOMAIN_ID. Prints one line of JSON; exits
with 1 and a message if a check fails.
"""

import json
import os
import subprocess
import sys
import time

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

# Topics and the nodes that publish them: the first that each process announces, and the node's last.
EXPECTED = {"/found_out": "found", "/diagnostics": "found", "/found_in": "eddy_replay", "/rosout": "found"}
TIMEOUT = 15


def start(eddy, *arguments):
    return subprocess.Popen([eddy, "--quiet", *arguments], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def seconds_until_found(eddy, bag):
    context = Context()
    rclpy.init(args=[], context=context)
    node = rclpy.create_node("discovery_peer", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    began = time.monotonic()
    started = [
        start(eddy, "node", "--input", "dds:/found_in", "--output", "dds:/found_out", "--ros-args", "-r", "__node:=found"),
        start(eddy, "replay", bag, "--to", "dds", "--remap", "/particles:=/found_in", "--loop", "--rate", "0.5"),
    ]
    found = lambda topic, name: any(info.node_name == name for info in node.get_publishers_info_by_topic(topic))
    try:
        while missing := [topic for topic, name in EXPECTED.items() if not found(topic, name)]:
            if time.monotonic() > began + TIMEOUT:
                known = {topic: [info.node_name for info in node.get_publishers_info_by_topic(topic)] for topic in EXPECTED}
                sys.exit(f"discovery_peer.py: {', '.join(missing)}: not found within {TIMEOUT} s; publishers: {known}")
            executor.spin_once(timeout_sec=0.02)
        return time.monotonic() - began
    finally:
        for process in started:
            process.kill()
            process.wait()
        node.destroy_node()
        rclpy.shutdown(context=context)


def main():
    eddy, bag = sys.argv[1:3]
    starts = int(sys.argv[3]) if len(sys.argv) > 3 else 16
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() + 1)]
    try:
        seconds = [seconds_until_found(eddy, bag) for _ in range(starts)]
    finally:
        for process in busy:
            process.kill()
            process.wait()
    print(json.dumps({"starts": starts, "seconds until found, slowest": round(max(seconds), 2)}), flush=True)
    # Threads of the middleware would outlive it.
    os._exit(0)


if __name__ == "__main__":
    main()
