"""The robot of robot_peer.py on Zenoh: eclipse-zenoh and rosbags in the form of rmw_zenoh."""

import json
import os
import socket
import time

import xxhash
import zenoh
import zenoh.ext
from rosbags.typesys import get_types_from_msg

import zenoh_peer
from robot_peer import (
    COUNT, MYSTERY, PROBE, PROBE_PARTS, RATE, TOPICS, Messages, Process, check_replay, expect, read_bag, until,
    without_hashes)

DESCRIBE = "type_description_interfaces/srv/GetTypeDescription"
# rosbags knows messages only.
REQUEST_TYPE, RESPONSE_TYPE = "describe/msg/Request", "describe/msg/Response"
REQUEST = "string type_name\nstring type_hash\nbool include_type_sources true\n"
RESPONSE = """bool successful
string failure_reason
type_description_interfaces/TypeDescription type_description
type_description_interfaces/TypeSource[] type_sources
type_description_interfaces/KeyValue[] extra_information
"""
# The hash that ROS 2 installs (type_description_interfaces 2.3.0).
DESCRIBE_HASH = "RIHS01_69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5"


def dds_name(type_name):
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def token_qos(policies):
    """QoS in the notation of rmw_zenoh's liveliness tokens."""
    reliability = "2" if policies.get("reliability") == "best_effort" else ""
    durability = "1" if "durability" in policies else ""
    return f"{reliability}:{durability}:,{policies.get('depth', 10)}:,:,:,,"


def offered(policies):
    return {
        "reliability": policies.get("reliability", "reliable"), "durability": policies.get("durability", "volatile"),
        "history": "keep_last", "depth": policies.get("depth", 10),
    }


class Robot:
    """The node /robot in rmw_zenoh's form; its types other than `MYSTERY` are described by a service."""

    def __init__(self):
        self.messages = Messages()
        store = self.messages.store
        store.register({**get_types_from_msg(REQUEST, REQUEST_TYPE), **get_types_from_msg(RESPONSE, RESPONSE_TYPE)})
        self.domain = int(os.environ.get("ROS_DOMAIN_ID", 0))
        self.topics = {**TOPICS, "/custom": (PROBE, {}), "/mystery": (MYSTERY, {})}
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.place = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        config = zenoh.Config()
        for key, value in {
            "mode": "peer", "scouting/multicast/enabled": False, "timestamping/enabled": True,
            "listen/endpoints": [self.place],
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.asked, self.kept = [], []
        key = f"{self.domain}/robot/get_type_description/{dds_name(DESCRIBE)}/{DESCRIBE_HASH}"
        self.service = self.session.declare_queryable(key, self.describe, complete=True)

    def environment(self):
        place = json.dumps([self.place])
        return {**os.environ, "ZENOH_CONFIG_OVERRIDE": f'listen/endpoints=["tcp/127.0.0.1:0"];connect/endpoints={place}'}

    def describe(self, query):
        """Answer as rcl does, with the files of the type."""
        types, store = self.messages.store.types, self.messages.store
        request = store.deserialize_cdr(bytes(query.payload), REQUEST_TYPE)
        self.asked.append(request.type_name)
        expect(len(bytes(query.attachment)) == 33, f"request: found attachment {bytes(query.attachment)}")
        known = request.type_name == PROBE and request.type_hash == store.hash_rihs01(PROBE)
        sources = {
            **PROBE_PARTS, "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
            "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
        } if known else {}
        source, empty = types["type_description_interfaces/msg/TypeSource"], "type_description_interfaces/msg/"
        individual = types[f"{empty}IndividualTypeDescription"](type_name=request.type_name, fields=[])
        response = types[RESPONSE_TYPE](
            successful=known, failure_reason="" if known else "unknown type",
            type_description=types[f"{empty}TypeDescription"](
                type_description=individual, referenced_type_descriptions=[]),
            type_sources=[source(type_name=name, encoding="msg", raw_file_contents=text) for name, text in sources.items()],
            extra_information=[])
        payload = bytes(store.serialize_cdr(response, RESPONSE_TYPE))
        query.reply(str(query.key_expr), payload, attachment=bytes(query.attachment))

    def key(self, topic):
        type_name, _ = self.topics[topic]
        return f"{self.domain}/{topic.strip('/')}/{dds_name(type_name)}/{self.messages.store.hash_rihs01(type_name)}"

    def tokens(self, topic, side):
        mangled = topic.replace("/", "%")
        replies = self.session.liveliness().get(
            f"@ros2_lv/{self.domain}/*/*/*/{side}/*/*/*/{mangled}/*/*/*", timeout=2)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def publisher(self, number, topic):
        type_name, policies = self.topics[topic]
        key, mangled = self.key(topic), topic.replace("/", "%")
        kind = key.split("/")[-2:]
        token = (f"@ros2_lv/{self.domain}/{self.session.zid()}/0/{number}/MP/%/%/robot/{mangled}/{'/'.join(kind)}"
                 f"/{token_qos(policies)}")
        gid = xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
        if "durability" in policies:
            publisher = zenoh.ext.declare_advanced_publisher(
                self.session, key, cache=zenoh.ext.CacheConfig(policies["depth"]), publisher_detection=True)
        else:
            publisher = self.session.declare_publisher(key)
        self.kept += [publisher, self.session.liveliness().declare_token(token)]

        def publish(sequence, payload):
            publisher.put(payload, attachment=zenoh_peer.ATTACHMENT.pack(sequence, time.time_ns(), 16, gid))
        return publish

    def publish(self, record):
        """Publish latched messages, start the recorder, publish the others when it listens. Returns all messages."""
        published, publishers = {}, {}
        for number, (topic, (type_name, policies)) in enumerate(self.topics.items(), 1):
            publishers[topic] = self.publisher(number, topic)
            count = 1 if "durability" in policies else COUNT
            published[topic] = [self.messages.cdr(type_name, number) for number in range(count)]
            if "durability" in policies:
                publishers[topic](1, published[topic][0])
        recorder = record()
        for topic in self.topics:
            until(f"{topic}: the recorder listens", lambda: self.tokens(topic, "MS"))
        for number in range(COUNT):
            for topic, publish in publishers.items():
                if "durability" not in self.topics[topic][1]:
                    publish(number + 1, published[topic][number])
            time.sleep(1 / RATE)
        time.sleep(1)
        # One topic is without a definition.
        recorder.end(1)
        for declared in self.kept:
            declared.undeclare()
        expect(sorted(set(self.asked)) == [MYSTERY, PROBE], f"asked for the definitions of {self.asked}")
        expect(f"no definition: /mystery ({MYSTERY})" in recorder.log.read_text(), recorder.log.read_text())
        return published

    def subscribe(self, received, names):
        """Subscribe with the QoS of each topic; returns what keeps the subscriptions alive."""
        kept = []
        for number, topic in enumerate(names, 100 + len(received) * len(self.kept)):
            type_name, policies = self.topics[topic]
            key, mangled = self.key(topic), topic.replace("/", "%")

            def take(sample, into=received[topic]):
                into.append(bytes(sample.payload))
            if "durability" in policies:
                kept.append(zenoh.ext.declare_advanced_subscriber(
                    self.session, key, take, history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)))
            else:
                kept.append(self.session.declare_subscriber(key, take))
            kind = "/".join(key.split("/")[-2:])
            kept.append(self.session.liveliness().declare_token(
                f"@ros2_lv/{self.domain}/{self.session.zid()}/0/{number}/MS/%/%/robot/{mangled}/{kind}/{token_qos(policies)}"))
        return kept


def run(eddy, folder):
    robot, bag = Robot(), folder / "robot"
    environment = robot.environment()
    arguments = [eddy, "record", "--all", "--from", "zenoh", "--output", bag]
    published = robot.publish(lambda: Process(folder, *arguments, environment=environment))
    read_bag(bag, robot.topics, published, offered, {"/mystery"})

    plain = folder / "plain.mcap"
    without_hashes(eddy, bag, plain)
    # Without a hash and a definition, Zenoh cannot carry a topic.
    played = [topic for topic in robot.topics if topic != "/mystery"]
    received, late = ({topic: [] for topic in played} for _ in range(2))
    subscriptions = robot.subscribe(received, played)
    replay = Process(
        folder, eddy, "replay", plain, "--to", "zenoh", "--wait-for", "1", "--rate", "0.2", environment=environment)
    kept = [topic for topic in played if "durability" in robot.topics[topic][1]]
    until("the first subscribers receive", lambda: all(received[topic] for topic in kept))
    for topic in played:
        found, expected = robot.tokens(topic, "MP"), token_qos(robot.topics[topic][1])
        expect(
            len(found) == 1 and found[0].endswith(f"/{expected}"),
            f"{topic}: the replay offers {found}, expected {expected}")
    late_subscriptions = robot.subscribe(late, kept)
    until("late subscribers receive", lambda: all(late[topic] for topic in kept))
    expect(replay.process.poll() is None, "the replay ended before late subscribers were tested")
    until("the replay ends", lambda: replay.process.poll() is not None)
    replay.end(1)
    check_replay(played, received, published)
    check_replay(kept, late, published)
    expect(len(subscriptions) > len(late_subscriptions), "the subscriptions live until here")
    return {"recorded": sum(map(len, published.values())), "replayed": sum(map(len, received.values())), "late": kept}
