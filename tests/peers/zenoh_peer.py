"""Exchange frames on Zenoh with independent programs: eclipse-zenoh, rosbags, xxhash.

    zenoh_peer.py listen TOPIC COUNT [--connect ENDPOINT ...] [--domain D] [--timeout S]
    zenoh_peer.py publish TOPIC COUNT [--particles N] [--stream S] [--rate HZ] [--connect ...] ...

listen  receives COUNT frames and checks for each: the key expression (domain, topic, type, RIHS01 hash), the
        attachment (33 bytes; its GID is the XXH3-128 of a liveliness token of a publisher of this topic), the
        CDR header and every field of the message.
publish sends COUNT frames of falling particles, like an rmw_zenoh publisher, as soon as there is a subscriber.
Both print one line of JSON at the end, and exit with 1 and a message if a check fails.
"""

import argparse
import json
import queue
import struct
import sys
import time
from pathlib import Path

import numpy
import xxhash
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MSGS = Path(__file__).resolve().parents[2] / "msgs" / "eddy_msgs" / "msg"
FRAME = "eddy_msgs/msg/ParticleFrame"
DDS_NAME = "eddy_msgs::msg::dds_::ParticleFrame_"
ATTACHMENT = struct.Struct("<qqB16s")
DT = 0.016
GRAVITY = 1.0
# The ports of eddy processes and of a router.
ENDPOINTS = [f"tcp/127.0.0.1:{port}" for port in range(7447, 7464)]


def expect(holds, sentence):
    if not holds:
        sys.exit(f"zenoh_peer.py: {sentence}")


def typestore():
    """ROS 2's messages, and eddy's as rosbags parses them."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(MSGS.glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(), f"eddy_msgs/msg/{path.stem}"))
    return store


def open_session(endpoints):
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("connect/endpoints", json.dumps(endpoints))
    config.insert_json5("connect/retry", '{"period_init_ms": 100, "period_max_ms": 500}')
    return zenoh.open(config)


def key_of(store, args):
    return f"{args.domain}/{args.topic.strip('/')}/{DDS_NAME}/{store.hash_rihs01(FRAME)}"


def check_frame(message):
    """Check that the fields of a frame are consistent."""
    particles = len(message.material)
    what = f"frame {message.sequence} of stream {message.stream}"
    expect(particles > 0, f"{what}: no particles")
    for name in ("position", "velocity"):
        values = getattr(message, name)
        expect(len(values) == 2 * particles, f"{what}: {name} has {len(values)} numbers for {particles} particles")
        expect(numpy.isfinite(values).all(), f"{what}: {name} is not finite")
    expect(len(message.lower) == len(message.upper) == 2, f"{what}: the domain is not two-dimensional")
    expect((message.lower < message.upper).all(), f"{what}: the domain is empty")
    expect((message.material <= 3).all(), f"{what}: unknown material")
    expect(message.header.frame_id == "world", f"{what}: frame_id {message.header.frame_id}")
    expect(0 < message.dt < 1, f"{what}: dt {message.dt}")


def gids_of_publishers(session, args):
    """The GIDs that rmw_zenoh assigns to the publishers of the topic."""
    topic = args.topic.replace("/", "%")
    tokens = session.liveliness().get(f"@ros2_lv/{args.domain}/*/*/*/MP/*/*/*/{topic}/*/*/*")
    keys = [str(reply.ok.key_expr) for reply in tokens if reply.ok is not None]
    return {xxhash.xxh3_128_intdigest(key.encode()).to_bytes(16, "little"): key for key in keys}


def listen(store, args):
    session = open_session(args.connect)
    samples = queue.Queue()
    # Any type and hash, to detect a wrong one.
    wildcard = f"{args.domain}/{args.topic.strip('/')}/*/*"
    subscriber = session.declare_subscriber(wildcard, samples.put)
    key, deadline = key_of(store, args), time.monotonic() + args.timeout
    numbers, sequences, streams, gids, particles = [], [], set(), set(), set()
    while len(sequences) < args.count:
        try:
            sample = samples.get(timeout=max(0, deadline - time.monotonic()))
        except queue.Empty:
            sys.exit(f"zenoh_peer.py: found {len(sequences)} frames in {args.timeout} s, expected {args.count}")
        expect(str(sample.key_expr) == key, f"key: found {sample.key_expr}, expected {key}")
        expect(sample.attachment is not None, "no attachment")
        attachment = bytes(sample.attachment)
        expect(len(attachment) == 33, f"attachment: found {len(attachment)} bytes, expected 33")
        number, source_time, length, gid = ATTACHMENT.unpack(attachment)
        expect(length == 16, f"attachment: found GID length {length}, expected 16")
        age = abs(time.time_ns() - source_time) / 1e9
        expect(age < 60, f"attachment: source time is {age} s from now")
        payload = bytes(sample.payload)
        expect(payload[:4] == b"\x00\x01\x00\x00", f"CDR header: found {payload[:4].hex()}")
        message = store.deserialize_cdr(payload, FRAME)
        check_frame(message)
        numbers.append(number)
        sequences.append(int(message.sequence))
        streams.add(int(message.stream))
        gids.add(gid)
        particles.add(len(message.material))
    known = gids_of_publishers(session, args)
    expect(gids <= set(known), f"GID: found {[gid.hex() for gid in gids]}, expected of {list(known.values())}")
    if len(gids) == 1:
        expect(numbers == sorted(set(numbers)), f"attachment: sequence numbers {numbers}")
    subscriber.undeclare()
    session.close()
    return {
        "frames": len(sequences), "streams": sorted(streams), "particles": sorted(particles),
        "first_sequence": sequences[0], "last_sequence": sequences[-1],
        "missed": sum(max(0, b - a - 1) for a, b in zip(numbers, numbers[1:])) if len(gids) == 1 else None,
    }


def falling_frames(store, args):
    """Frames of particles that fall and bounce in the unit square."""
    Frame, Header, Time = (
        store.types[name] for name in (FRAME, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    random = numpy.random.default_rng(args.stream)
    position = random.uniform(0.3, 0.7, (args.particles, 2))
    velocity = numpy.zeros_like(position)
    material = (numpy.arange(args.particles) % 4).astype(numpy.uint8)
    interval = round(DT * 1e9)
    for sequence in range(args.count):
        stamp = Time(sec=sequence * interval // 10**9, nanosec=sequence * interval % 10**9)
        yield Frame(
            header=Header(stamp=stamp, frame_id="world"), stream=args.stream, sequence=sequence, dt=DT,
            lower=numpy.zeros(2, numpy.float32), upper=numpy.ones(2, numpy.float32),
            position=position.astype(numpy.float32).ravel(), velocity=velocity.astype(numpy.float32).ravel(),
            material=material,
        )
        velocity[:, 1] -= GRAVITY * DT
        position += velocity * DT
        below = position[:, 1] < 0.05
        position[below, 1] = 0.05
        velocity[below, 1] *= -0.5


def publish(store, args):
    session = open_session(args.connect)
    key = key_of(store, args)
    publisher = session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.BLOCK
    )
    token_key = (
        f"@ros2_lv/{args.domain}/{session.zid()}/0/1/MP/%/%/zenoh_peer/{args.topic.replace('/', '%')}"
        f"/{DDS_NAME}/{store.hash_rihs01(FRAME)}/::2,:,:,:,,"
    )
    token = session.liveliness().declare_token(token_key)
    gid = xxhash.xxh3_128_intdigest(token_key.encode()).to_bytes(16, "little")
    deadline = time.monotonic() + args.timeout
    while not publisher.matching_status.matching:
        expect(time.monotonic() < deadline, f"found no subscriber of {key} in {args.timeout} s")
        time.sleep(0.01)
    for frame in falling_frames(store, args):
        attachment = ATTACHMENT.pack(frame.sequence + 1, time.time_ns(), 16, gid)
        publisher.put(bytes(store.serialize_cdr(frame, FRAME)), attachment=attachment)
        time.sleep(1 / args.rate)
    token.undeclare()
    session.close()
    return {"frames": args.count, "stream": args.stream, "particles": args.particles}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("role", choices=["listen", "publish"])
    parser.add_argument("topic")
    parser.add_argument("count", type=int)
    parser.add_argument("--particles", type=int, default=2500)
    parser.add_argument("--stream", type=int, default=1)
    parser.add_argument("--rate", type=float, default=1 / DT)
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--timeout", type=float, default=60)
    parser.add_argument("--connect", nargs="+", default=ENDPOINTS)
    args = parser.parse_args()
    print(json.dumps((listen if args.role == "listen" else publish)(typestore(), args)))


if __name__ == "__main__":
    main()
