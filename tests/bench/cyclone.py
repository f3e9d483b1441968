"""Measure the latency of messages of the size of a frame in Eclipse Cyclone DDS, between two processes.

    pip install -r tests/peers/requirements.txt
    python tests/bench/cyclone.py [PARTICLES...]        (default: 2500 10000)

For comparison with `eddy-lab bench transport --transport dds`: reliable, on the loopback interface, one message per millisecond, timed from before
the write until after the take; the reader sleeps until it is notified. The payload is a string, so that Python's
conversion of numbers is not timed. Prints median and 99th percentile (us) of 500 messages of each size.
"""

import multiprocessing
import os
import statistics
import sys
import time
from dataclasses import dataclass

# Loopback interface only.
os.environ["CYCLONEDDS_URI"] = """
    <General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces></General>
    <Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers></Discovery>"""

from cyclonedds.core import Policy, Qos, ReadCondition, SampleState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

DOMAIN = 97
MESSAGES, WARM_UP = 500, 20
# Position and velocity with two components of 4 bytes each, and a material.
BYTES_A_PARTICLE = 17
QOS = Qos(Policy.Reliability.Reliable(duration(seconds=10)), Policy.History.KeepAll)


@dataclass
class Message(IdlStruct):
    sent: uint64
    payload: str


def open_topic(particles):
    participant = DomainParticipant(DOMAIN)
    return participant, Topic(participant, f"speed_{particles}", Message)


def read(particles, delays):
    participant, topic = open_topic(particles)
    reader = DataReader(participant, topic, QOS)
    woken = WaitSet(participant)
    woken.attach(ReadCondition(reader, SampleState.NotRead))
    taken = []
    while len(taken) < MESSAGES + WARM_UP and woken.wait(duration(seconds=10)):
        for message in reader.take(N=10):
            taken.append((time.monotonic_ns() - message.sent) / 1e3)
    delays.put(taken[WARM_UP:])


def main():
    print(f"{'particles':>9} {'bytes':>8} {'p50 us':>8} {'p99 us':>8} {'messages':>8}")
    context = multiprocessing.get_context("spawn")
    for particles in [int(argument) for argument in sys.argv[1:]] or [2500, 10000]:
        delays = context.Queue()
        reader = context.Process(target=read, args=(particles, delays))
        reader.start()
        participant, topic = open_topic(particles)
        writer = DataWriter(participant, topic, QOS)
        while not writer.get_matched_subscriptions():
            time.sleep(0.01)
        payload = "x" * (BYTES_A_PARTICLE * particles)
        for _ in range(MESSAGES + WARM_UP):
            time.sleep(0.001)
            writer.write(Message(sent=time.monotonic_ns(), payload=payload))
        taken = delays.get(timeout=30)
        reader.join()
        p50, p99 = statistics.median(taken), statistics.quantiles(taken, n=100)[98]
        print(f"{particles:>9} {len(payload):>8} {p50:>8.0f} {p99:>8.0f} {len(taken):>8}")


if __name__ == "__main__":
    main()
