"""Exchange frames on DDS with an independent implementation: Eclipse Cyclone DDS in Python.

    cyclone_peer.py listen TOPIC COUNT [--timeout S]
    cyclone_peer.py publish TOPIC COUNT [--particles N] [--stream S] [--rate HZ] [--timeout S]

listen  receives COUNT frames and checks that the fields of each are consistent.
publish sends COUNT frames of particles on circles, as soon as there is a subscriber.
The frame type is declared again here, for Cyclone. The domain is ROS_DOMAIN_ID. Both print one line
of JSON at the end, and exit with 1 and a message if a check fails.
"""

import argparse
import json
import math
import os
import sys
import time
from dataclasses import dataclass

# Loopback only, like eddy; search for participants at the ports of eddy's participants.
os.environ.setdefault("CYCLONEDDS_URI", """
    <General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces></General>
    <Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers></Discovery>""")

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float32, int32, sequence, uint8, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

DT = 0.016


@final
@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@final
@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@final
@dataclass
class ParticleFrame(IdlStruct, typename="eddy_msgs::msg::dds_::ParticleFrame_"):
    header: Header
    stream: uint64
    sequence: uint64
    dt: float32
    lower: sequence[float32]
    upper: sequence[float32]
    position: sequence[float32]
    velocity: sequence[float32]
    material: sequence[uint8]


QOS = Qos(Policy.Reliability.Reliable(duration(seconds=10)), Policy.History.KeepAll)


def expect(holds, sentence):
    if not holds:
        sys.exit(f"cyclone_peer.py: {sentence}")


def open_topic(name):
    participant = DomainParticipant(int(os.environ.get("ROS_DOMAIN_ID", 0)))
    return participant, Topic(participant, f"rt{name}", ParticleFrame)


def check(frame):
    """Check that the fields of a frame are consistent."""
    particles = len(frame.material)
    what = f"frame {frame.sequence} of stream {frame.stream}"
    expect(particles > 0, f"{what}: no particles")
    for name in ("position", "velocity"):
        values = getattr(frame, name)
        expect(len(values) == 2 * particles, f"{what}: {name} has {len(values)} numbers for {particles} particles")
        expect(all(map(math.isfinite, values)), f"{what}: {name} is not finite")
    expect(len(frame.lower) == len(frame.upper) == 2, f"{what}: the domain is not two-dimensional")
    expect(max(frame.material) <= 3, f"{what}: unknown material")
    expect(frame.header.frame_id == "world", f"{what}: frame_id {frame.header.frame_id}")


def listen(args):
    participant, topic = open_topic(args.topic)
    reader = DataReader(participant, topic, QOS)
    deadline = time.monotonic() + args.timeout
    sequences, particles = [], set()
    while len(sequences) < args.count:
        expect(time.monotonic() < deadline, f"found {len(sequences)} frames in {args.timeout} s, expected {args.count}")
        for frame in reader.take_iter(timeout=duration(seconds=1)):
            check(frame)
            sequences.append(frame.sequence)
            particles.add(len(frame.material))
            if len(sequences) == args.count:
                break
    expect(sequences == sorted(set(sequences)), f"sequences: {sequences}")
    missed = sequences[-1] - sequences[0] + 1 - len(sequences)
    return {"frames": len(sequences), "particles": sorted(particles), "missed": missed}


def publish(args):
    participant, topic = open_topic(args.topic)
    writer = DataWriter(participant, topic, QOS)
    deadline = time.monotonic() + args.timeout
    while not writer.get_matched_subscriptions():
        expect(time.monotonic() < deadline, f"found no subscriber of {args.topic} in {args.timeout} s")
        time.sleep(0.01)
    angles = [2 * math.pi * index / args.particles for index in range(args.particles)]
    radii = [0.1 + 0.3 * (index % 97) / 97 for index in range(args.particles)]
    for number in range(args.count):
        position, velocity = [], []
        for angle, radius in zip(angles, radii):
            here = angle + number * DT
            position += [0.5 + radius * math.cos(here), 0.5 + radius * math.sin(here)]
            velocity += [-radius * math.sin(here), radius * math.cos(here)]
        nanoseconds = number * 16_000_000
        stamp = Time(nanoseconds // 10**9, nanoseconds % 10**9)
        writer.write(ParticleFrame(
            Header(stamp, "world"), args.stream, number, DT, [0.0, 0.0], [1.0, 1.0], position, velocity,
            [0] * args.particles,
        ))
        time.sleep(1 / args.rate)
    expect(writer.wait_for_acks(duration(seconds=args.timeout)), "not all messages were acknowledged")
    return {"frames": args.count, "stream": args.stream, "particles": args.particles}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("role", choices=["listen", "publish"])
    parser.add_argument("topic")
    parser.add_argument("count", type=int)
    parser.add_argument("--particles", type=int, default=2500)
    parser.add_argument("--stream", type=int, default=1)
    parser.add_argument("--rate", type=float, default=20)
    parser.add_argument("--timeout", type=float, default=60)
    args = parser.parse_args()
    print(json.dumps((listen if args.role == "listen" else publish)(args)))


if __name__ == "__main__":
    main()
