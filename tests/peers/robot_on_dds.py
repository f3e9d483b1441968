"""The robot of robot_peer.py on DDS: rclpy on Fast DDS, and Cyclone DDS for the type that rclpy's packages lack."""

import importlib
import os
import subprocess
import threading
import time
from dataclasses import dataclass

import rclpy
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from mcap_ros2.reader import read_ros2_messages
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from cyclone_peer import valid  # keeps Cyclone DDS to the loopback
from robot_peer import COUNT, RATE, TOPICS, Messages, Process, check_replay, expect, read_bag, until, without_hashes

# A type of ROS 2 that is not built into eddy, with references to others.
CUSTOM = "rmw_dds_common/msg/ParticipantEntitiesInfo"
TF = "/tf_static"


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
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@final
@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@final
@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@final
@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@final
@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


def transforms():
    transform = Transform(Vector3(1.0, 2.0, 3.0), Quaternion(0.0, 0.0, 0.0, 1.0))
    return TFMessage([TransformStamped(Header(Time(1, 2), "map"), "base_link", transform)])


def latched(user_data=None):
    policies = [
        Policy.Reliability.Reliable(duration(seconds=10)), Policy.Durability.TransientLocal, Policy.History.KeepLast(1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    ]
    return Qos(*policies, *([Policy.Userdata(user_data)] if user_data else []))


def message_class(type_name):
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def profile(policies):
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=policies.get("depth", 10),
        reliability=ReliabilityPolicy.get_from_short_key(policies.get("reliability", "reliable")),
        durability=DurabilityPolicy.get_from_short_key(policies.get("durability", "volatile")))


def offered(policies):
    """DDS does not announce the history."""
    return {
        "reliability": policies.get("reliability", "reliable"), "durability": policies.get("durability", "volatile"),
        "history": "unknown", "depth": 0,
    }


class Robot:
    """All topics but TF on rclpy, TF on Cyclone DDS."""

    def __init__(self):
        rclpy.init(args=[])
        self.node = rclpy.create_node("robot")
        self.messages = Messages()
        self.topics = {**TOPICS, "/custom": (CUSTOM, {})}
        participant = DomainParticipant(int(os.environ.get("ROS_DOMAIN_ID", 0)))
        self.tf = Topic(participant, f"rt{TF}", TFMessage)
        self.participant, self.incompatible = participant, []
        # The node answers requests for its types.
        threading.Thread(target=rclpy.spin, args=[self.node], daemon=True).start()

    def publish(self, record):
        """Publish latched messages, start the recorder, publish the others when it listens. Returns all messages."""
        published, publishers = {}, {}
        for topic, (type_name, policies) in self.topics.items():
            if topic == TF:
                continue
            events = PublisherEventCallbacks(incompatible_qos=lambda event, topic=topic: self.incompatible.append(topic))
            publishers[topic] = self.node.create_publisher(
                message_class(type_name), topic, profile(policies), event_callbacks=events)
            count = 1 if "durability" in policies else COUNT
            published[topic] = [self.messages.cdr(type_name, number) for number in range(count)]
        digest = self.messages.store.hash_rihs01("tf2_msgs/msg/TFMessage")
        tf = DataWriter(self.participant, self.tf, latched(f"typehash={digest};".encode()))
        tf.write(transforms())
        # As Cyclone encodes it.
        published[TF] = [bytes(transforms().serialize(use_version_2=False))]
        for topic, publisher in publishers.items():
            if "durability" in self.topics[topic][1]:
                publisher.publish(published[topic][0])
        recorder = record()
        for topic, publisher in publishers.items():
            until(f"{topic}: the recorder listens", publisher.get_subscription_count)
        # The recorder's side of the match.
        time.sleep(1)
        for number in range(COUNT):
            for topic, publisher in publishers.items():
                if "durability" not in self.topics[topic][1]:
                    publisher.publish(published[topic][number])
            time.sleep(1 / RATE)
        time.sleep(1)
        recorder.end()
        for publisher in publishers.values():
            self.node.destroy_publisher(publisher)
        expect(not self.incompatible, f"publishers met incompatible subscribers on {sorted(set(self.incompatible))}")
        return published

    def subscribe(self, received, names):
        """Subscribe with the QoS of each topic; returns what keeps the subscriptions alive."""
        subscriptions = []
        for topic in names:
            type_name, policies = self.topics[topic]
            if topic == TF:
                subscriptions.append(DataReader(self.participant, self.tf, latched()))
                continue
            subscriptions.append(self.node.create_subscription(
                message_class(type_name), topic, received[topic].append, profile(policies), raw=True))
        return subscriptions

    def check_offers(self):
        """The replay's publishers offer what the robot's did."""
        for topic, (_, policies) in self.topics.items():
            def of_replay():
                infos = self.node.get_publishers_info_by_topic(topic)
                return [info.qos_profile for info in infos if info.node_name == "eddy_replay"]
            found = until(f"{topic}: the replay publishes", of_replay)
            expected = profile(policies)
            expect(
                [(qos.reliability, qos.durability) for qos in found] == [(expected.reliability, expected.durability)],
                f"{topic}: the replay offers {found}, expected {expected}")


def taken(reader, into):
    samples = valid(reader.take(N=100))
    into.extend(bytes(sample.serialize(use_version_2=False)) for sample in samples)
    return into


def run(eddy, folder):
    robot, bag = Robot(), folder / "robot"
    arguments = [eddy, "record", "--all", "--from", "dds", "--exclude", "/rosout|/parameter_events", "--output", bag]
    published = robot.publish(lambda: Process(folder, *arguments))
    standard = {topic: kind for topic, kind in robot.topics.items() if kind[0] != CUSTOM}
    # rosbags 0.11.9 hashes `char` unlike ROS and refuses bags with such a type.
    filtered = folder / "filtered"
    subprocess.run([eddy, "--quiet", "bag", "filter", bag, "--topics", *standard, "--output", filtered], check=True)
    read_bag(filtered, standard, published, offered, set())
    decoded = [message for message in read_ros2_messages(next(bag.glob("*.mcap")), topics=["/custom"])]
    expect(
        [message.ros_msg.node_entities_info_seq[0].node_name for message in decoded]
        == [f"text {number}" for number in range(COUNT)], f"/custom: mcap-ros2-support decodes {decoded}")

    plain = folder / "plain.mcap"
    without_hashes(eddy, bag, plain)
    received, late = ({topic: [] for topic in robot.topics} for _ in range(2))
    subscriptions = robot.subscribe(received, robot.topics)
    # Slow, so that there is time for late subscribers.
    replay = Process(folder, eddy, "replay", plain, "--to", "dds", "--wait-for", "1", "--rate", "0.2")
    kept = [topic for topic, (_, policies) in robot.topics.items() if "durability" in policies]
    tf = next(reader for reader in subscriptions if isinstance(reader, DataReader))
    until("the first subscribers receive", lambda: received["/robot_description"] and taken(tf, received[TF]))
    robot.check_offers()
    late_subscriptions = robot.subscribe(late, kept)
    late_tf = next(reader for reader in late_subscriptions if isinstance(reader, DataReader))
    until("late subscribers receive", lambda: late["/robot_description"] and taken(late_tf, late[TF]))
    expect(replay.process.poll() is None, "the replay ended before late subscribers were tested")
    until("the replay ends", lambda: replay.process.poll() is not None)
    replay.end()
    time.sleep(0.5)
    check_replay(robot.topics, received, published)
    check_replay(kept, late, published)
    return {"recorded": sum(map(len, published.values())), "replayed": sum(map(len, received.values())), "late": kept}
