"""Run the node and the companion on two emulated hosts: two network namespaces connected by a cable (veth).

    two_hosts.py EDDY BAG

EDDY is the program, BAG a bag of frames that covers at least three seconds. The node runs in one namespace, `eddy replay` and
`eddy record` in the other, with Zenoh endpoints set by ZENOH_CONFIG_OVERRIDE. Once predictions arrive, the link
is taken down for ten seconds: afterwards predictions must arrive again, the node must have counted the frames that
it missed, and the recorded predictions must continue after the gap.

Needs permission to create namespaces (root); without it, prints a note and exits with 0. Prints one line of JSON;
exits with 1 and a message if a check fails.
"""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rosbags.rosbag2 import Reader

from prediction_bag import FRAME, typestore

TOPIC = "/two_hosts"
OUTAGE = 10  # s
# Replays frames recorded at 62.5 Hz at a tenth of that rate.
RATE = 0.1
DEADLINE = 60  # s


def expect(holds, sentence):
    if not holds:
        sys.exit(f"two_hosts.py: {sentence}")


def ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


class Hosts:
    """Two namespaces connected by a cable, deleted at the end."""

    def __init__(self):
        number = os.getpid()
        self.names = [f"eddy_{side}_{number}" for side in "ab"]
        self.addresses = ["10.213.77.1", "10.213.77.2"]
        self.ends = [f"ed{side}{number}" for side in "ab"]

    def __enter__(self):
        try:
            for name in self.names:
                ip("netns", "add", name)
        except (OSError, subprocess.CalledProcessError) as error:
            reason = getattr(error, "stderr", None) or str(error)
            self.__exit__()
            print(f"two hosts: skipped, network namespaces are not permitted: {reason.strip()}")
            sys.exit(0)
        ip("link", "add", self.ends[0], "type", "veth", "peer", "name", self.ends[1])
        for name, end, address in zip(self.names, self.ends, self.addresses):
            ip("link", "set", end, "netns", name)
            ip("-n", name, "addr", "add", f"{address}/24", "dev", end)
            ip("-n", name, "link", "set", "lo", "up")
            ip("-n", name, "link", "set", end, "up")
        return self

    def __exit__(self, *_):
        for name in self.names:
            # This also deletes the cable.
            subprocess.run(["ip", "netns", "delete", name], check=False, capture_output=True)

    def cable(self, state):
        ip("-n", self.names[0], "link", "set", self.ends[0], state)

    def start(self, host, port, peers, words, **options):
        """Start a program on a host; it listens on a port and connects to peers (host, port)."""
        def endpoints(places):
            return json.dumps([f"tcp/{self.addresses[host]}:{port}" for host, port in places])

        override = f"listen/endpoints={endpoints([(host, port)])};connect/endpoints={endpoints(peers)}"
        environment = {**os.environ, "ZENOH_CONFIG_OVERRIDE": override}
        command = ["ip", "netns", "exec", self.names[host], *words]
        return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, **options)


def wait_until(what, holds):
    start = time.monotonic()
    while not holds():
        expect(time.monotonic() < start + DEADLINE, f"{what}: timed out after {DEADLINE} s")
        time.sleep(0.2)
    return time.monotonic() - start


def end(process, name):
    """Interrupt a process and return its output."""
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=DEADLINE)
    expect(process.returncode == 0, f"{name}: ended with {process.returncode}")
    return printed


def sequences(bag, store):
    with Reader(bag) as reader:
        return [
            int(store.deserialize_cdr(data, FRAME).sequence)
            for connection, _, data in reader.messages() if connection.topic.endswith("/prediction")
        ]


def count(eddy, active):
    """Number of predictions in a bag that is being written."""
    command = [eddy, "--quiet", "bag", "info", "--json", str(active)]
    printed = subprocess.run(command, capture_output=True, text=True).stdout
    topics = json.loads(printed)["topics"] if printed else []
    return sum(topic["messages"] for topic in topics if topic["topic"] == f"{TOPIC}/prediction")


def run(eddy, bag, hosts, folder):
    recorded = Path(folder) / "recorded"
    active = recorded / "recorded_0.mcap.active"
    particles, prediction = f"zenoh:{TOPIC}/particles", f"zenoh:{TOPIC}/prediction"
    node = hosts.start(0, 7501, [], [eddy, "node", "--input", particles, "--output", prediction])
    record = hosts.start(1, 7502, [(0, 7501)], [
        eddy, "record", particles, prediction, "--compression", "none", "--output", str(recorded)])
    replay = hosts.start(1, 7503, [(0, 7501), (1, 7502)], [
        eddy, "replay", bag, "--to", "zenoh", "--remap", f"/particles:={TOPIC}/particles",
        "--wait-for", "2", "--rate", str(RATE), "--reliability", "drop"])
    started = [node, record, replay]
    try:
        size = lambda: active.stat().st_size if active.exists() else 0
        predicted = lambda: count(eddy, active)
        wait_until("frames are recorded", lambda: size() > 1_000_000)
        wait_until("predictions cross the cable", lambda: predicted() > 20)
        hosts.cable("down")
        time.sleep(OUTAGE)
        before = predicted()
        hosts.cable("up")
        took = wait_until("predictions flow again", lambda: predicted() > before + 20)
        end(replay, "replay")
        said = end(node, "node")
        end(record, "record")
    finally:
        for process in started:
            process.kill()
    lost = re.search(r"(\d+) lost in transport", said)
    expect(lost, f"node: counted no loss; output: {said}")
    return before, took, int(lost[1]), sequences(recorded, typestore())


def main():
    eddy, bag = os.path.abspath(sys.argv[1]), os.path.abspath(sys.argv[2])
    with Hosts() as hosts, tempfile.TemporaryDirectory() as folder:
        before, took, lost, found = run(eddy, bag, hosts, folder)
    steps = [b - a for a, b in zip(found, found[1:])]
    gap = max(steps)
    # Half of the frames of ten seconds at the replay's rate.
    expect(gap > 0.5 * OUTAGE * 62.5 * RATE, f"the largest gap in the predictions is {gap} frames")
    print(json.dumps({
        "predictions": len(found), "before the outage": before, "gap": gap,
        "seconds until twenty more were recorded": round(took, 2), "frames lost": lost,
    }))


if __name__ == "__main__":
    main()
