"""Read frames from shared memory with an independent program: iceoryx2's Python package.

    shm_peer.py listen SERVICE COUNT [--timeout S]

Waits for the service (`eddy/particles`, in a domain other than 0 `eddy<domain>:/particles`), reads COUNT frames, notified by the event service of the
same name, and checks that their fields are consistent. Prints one line of JSON; exits with 1 and a message if a check
fails.
"""

import argparse
import ctypes
import json
import math
import struct
import sys
import time

import iceoryx2 as iox2


class Particle(ctypes.Structure):
    _fields_ = [
        ("x", ctypes.c_float), ("y", ctypes.c_float), ("vx", ctypes.c_float), ("vy", ctypes.c_float),
        ("material", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name():
        return "eddy::Particle"


class FrameHeader(ctypes.Structure):
    _fields_ = [
        ("stream", ctypes.c_uint64), ("sequence", ctypes.c_uint64), ("stamp_ns", ctypes.c_int64),
        ("dt", ctypes.c_float), ("lower", ctypes.c_float * 2), ("upper", ctypes.c_float * 2),
    ]

    @staticmethod
    def type_name():
        return "eddy::FrameHeader"


def expect(holds, sentence):
    if not holds:
        sys.exit(f"shm_peer.py: {sentence}")


def open_service(node, name, deadline):
    """Open the service as soon as another program has created it."""
    while True:
        builder = node.service_builder(iox2.ServiceName.new(name))
        try:
            return builder.publish_subscribe(iox2.Slice[Particle]).user_header(FrameHeader).open()
        except iox2.PublishSubscribeOpenError as error:
            expect(time.monotonic() < deadline, f"{name}: {error}")
            time.sleep(0.05)


def particles_of(sample):
    """The particles as tuples. Their number is in the header; `payload().len()` is in bytes in 0.10.0."""
    count = sample.header.number_of_elements
    layout = struct.Struct("<ffffI")
    expect(layout.size == ctypes.sizeof(Particle), "the memory layout differs on this machine")
    return list(layout.iter_unpack(ctypes.string_at(sample.payload().as_ptr(), count * layout.size)))


def check_frame(header, particles):
    what = f"frame {header.sequence} of stream {header.stream}"
    expect(0 < header.dt < 1, f"{what}: dt {header.dt}")
    expect(all(a < b for a, b in zip(header.lower, header.upper)), f"{what}: the domain is empty")
    expect(particles, f"{what}: no particles")
    for index, (*numbers, material) in enumerate(particles):
        expect(all(map(math.isfinite, numbers)), f"{what}: particle {index} is not finite: {numbers}")
        expect(material <= 3, f"{what}: particle {index} is of material {material}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("role", choices=["listen"])
    parser.add_argument("service")
    parser.add_argument("count", type=int)
    parser.add_argument("--timeout", type=float, default=60)
    args = parser.parse_args()
    expect(ctypes.sizeof(FrameHeader) == 48, "the memory layout differs on this machine")

    deadline = time.monotonic() + args.timeout
    node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)
    service = open_service(node, args.service, deadline)
    subscriber = service.subscriber_builder().create()
    events = node.service_builder(iox2.ServiceName.new(args.service)).event().open_or_create()
    listener = events.listener_builder().create()

    sequences, streams, particles, wakes = [], set(), set(), 0
    while len(sequences) < args.count:
        expect(
            time.monotonic() < deadline,
            f"{args.service}: found {len(sequences)} frames in {args.timeout} s, expected {args.count}",
        )
        wakes += len(listener.try_wait())
        sample = subscriber.receive()
        if sample is None:
            wakes += len(listener.timed_wait(iox2.Duration.from_millis(100)))
            continue
        header, frame = sample.user_header().contents, particles_of(sample)
        check_frame(header, frame)
        sequences.append(header.sequence)
        streams.add(header.stream)
        particles.add(len(frame))
        sample.delete()
    expect(wakes > 0, f"{args.service}: no event was received with the frames")
    if len(streams) == 1:
        expect(sequences == sorted(set(sequences)), f"{args.service}: frames out of order: {sequences}")
    print(json.dumps({
        "frames": len(sequences), "streams": sorted(streams), "particles": sorted(particles),
        "first_sequence": sequences[0], "last_sequence": sequences[-1], "wakes": wakes,
    }))


if __name__ == "__main__":
    main()
