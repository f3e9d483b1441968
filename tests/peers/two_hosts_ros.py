"""Check that a node on one host and a ROS 2 (rclpy on Fast DDS) on another find each other, and that the node says farewell.

    two_hosts_ros.py EDDY

The hosts are two network namespaces connected by a cable (veth), with ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET. EDDY is the program. A
service of the node answers with more than a packet of Ethernet holds, and after SIGINT the node leaves rclpy's graph within two
seconds, with its publishers, long before its lease of 50 s ends.

Needs permission to create namespaces (root); without it, prints a note and exits with 0. Prints one line of JSON; exits with 1 and a
message if a check fails.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from two_hosts import Hosts

ROS = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}


def check(eddy, host):
    """On the other host: start the node on its own."""
    from node_peer import Peer, check_farewell, check_types, rclpy

    rclpy.init(args=[])
    with tempfile.TemporaryDirectory() as folder:
        peer = Peer(eddy, Path(folder))
        # `ip netns exec` becomes the program, which therefore gets the signal.
        peer.eddy = "ip"
        node = peer.start(
            "netns", "exec", host, eddy, "node", "--input", "dds:/managed_in", "--output", "dds:/managed_out", "--ros-args",
            "-r", "__node:=managed")
        try:
            peer.until("the node", lambda: peer.node.count_publishers("/managed_out"))
            sources = check_types(peer)
            left = check_farewell(peer, node)
        finally:
            if node.poll() is None:
                node.kill()
                node.wait()
    print(json.dumps({"sources": sources, "seconds until it left the graph": left}), flush=True)
    # Threads of the middleware would outlive it.
    os._exit(0)


def main():
    eddy = os.path.abspath(sys.argv[1])
    if len(sys.argv) == 3:
        check(eddy, sys.argv[2])
    with Hosts() as hosts:
        node, peer = hosts.names
        command = ["ip", "netns", "exec", peer, sys.executable, __file__, eddy, node]
        code = subprocess.run(command, env={**os.environ, **ROS}).returncode
    sys.exit(code)


if __name__ == "__main__":
    main()
