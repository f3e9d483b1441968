"""Exchange frames on DDS with an independent implementation: Eclipse Cyclone DDS in Python.

    cyclone_peer.py listen TOPIC COUNT [--timeout S]
    cyclone_peer.py publish TOPIC COUNT [--particles N] [--stream S] [--rate HZ] [--timeout S]
    cyclone_peer.py services EDDY NODE [--timeout S]

listen  receives COUNT frames and checks that the fields of each are consistent.
publish sends COUNT frames of particles on circles, as soon as there is a subscriber.
services calls NODE/reset of a running node of eddy, and answers `eddy service call`, both in the form of rmw_cyclonedds: the
        identity of a request stands before its body (rmw_cyclonedds_cpp/src/serdata.hpp, cdds_request_header).
The frame type is declared again here, for Cyclone. The domain is ROS_DOMAIN_ID. Both print one line
of JSON at the end, and exit with 1 and a message if a check fails.
"""

import argparse
import json
import math
import os
import subprocess
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
from cyclonedds.idl.types import float32, int32, int64, sequence, uint8, uint32, uint64
from cyclonedds.internal import InvalidSample
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


@final
@dataclass
class TriggerRequest(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Request_"):
    guid: uint64
    number: int64
    structure_needs_at_least_one_member: uint8


@final
@dataclass
class TriggerResponse(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Response_"):
    guid: uint64
    number: int64
    success: bool
    message: str


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


def service(participant, name):
    """Topics of the requests and the responses of a service."""
    qos = Qos(Policy.Reliability.Reliable(duration(seconds=10)), Policy.History.KeepAll,
              Policy.DataRepresentation(use_cdrv0_representation=True))
    requests = Topic(participant, f"rq{name}Request", TriggerRequest, qos)
    return requests, Topic(participant, f"rr{name}Reply", TriggerResponse, qos), qos


def valid(samples):
    """Without the notices of a writer that left."""
    return [sample for sample in samples if not isinstance(sample, InvalidSample)]


def services(args):
    participant = DomainParticipant(int(os.environ.get("ROS_DOMAIN_ID", 0)))
    deadline = time.monotonic() + args.timeout

    def until(what, answer):
        while not (found := answer()):
            expect(time.monotonic() < deadline, f"{what}: not within {args.timeout} s")
            time.sleep(0.01)
        return found

    requests, responses, qos = service(participant, f"{args.node}/reset")
    writer, reader = DataWriter(participant, requests, qos), DataReader(participant, responses, qos)
    until("the node", lambda: writer.get_matched_subscriptions() and reader.get_matched_publications())
    # A service may know the client's reader a moment later than its writer.
    answers = []
    for number in range(1, 100):
        writer.write(TriggerRequest(guid=0xEDD1, number=number, structure_needs_at_least_one_member=0))
        time.sleep(0.1)
        answers += valid(reader.take(10))
        if answers:
            break
    expect(answers, "the node does not answer")
    answer = answers[0]
    expect((answer.guid, answer.success) == (0xEDD1, True) and answer.number <= number, f"response: {answer}")
    expect("streams reset" in answer.message, f"response: {answer}")

    name = "/cyclone_trigger"
    requests, responses, qos = service(participant, name)
    reader, writer = DataReader(participant, requests, qos), DataWriter(participant, responses, qos)
    call = subprocess.Popen([args.eddy, "service", "call", f"dds:{name}", "--timeout", str(args.timeout)],
                            stdout=subprocess.PIPE, text=True)
    answered = 0
    while call.poll() is None:
        expect(time.monotonic() < deadline, "eddy service call does not end")
        for request in valid(reader.take(10)):
            writer.write(TriggerResponse(request.guid, request.number, True, f"asked {request.number}"))
            answered += 1
        time.sleep(0.01)
    said = call.stdout.read()
    expect(call.returncode == 0 and said == "success: true\nmessage: asked 1\n", f"{call.returncode}: {said}")
    return {"reset": answer.message, "answered": answered}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    roles = parser.add_subparsers(required=True)
    for role in (listen, publish, services):
        words = roles.add_parser(role.__name__)
        words.set_defaults(role=role)
        words.add_argument("--timeout", type=float, default=60)
        if role is services:
            words.add_argument("eddy")
            words.add_argument("node")
            continue
        words.add_argument("topic")
        words.add_argument("count", type=int)
        if role is publish:
            words.add_argument("--particles", type=int, default=2500)
            words.add_argument("--stream", type=int, default=1)
            words.add_argument("--rate", type=float, default=20)
    args = parser.parse_args()
    print(json.dumps(args.role(args)))


if __name__ == "__main__":
    main()
