"""Exchange messages kept for late subscribers (transient local) on Zenoh with independent programs: zenoh-ext and
zenoh-ros2-sdk.

    latched_peer.py EDDY TOPIC

1. `eddy replay` plays a bag, written by rosbags, of a transient-local topic. zenoh-ext's advanced subscriber,
   declared as by rmw_zenoh, and the sdk's subscriber join after the message and receive it.
2. zenoh-ext's advanced publisher, declared as by rmw_zenoh, publishes before `eddy topic echo` and
   `eddy record` start: both receive the message, and the recorded bag marks the topic as transient local.

EDDY is the program. The domain is ROS_DOMAIN_ID. Prints one line of JSON; exits with 1 and a message if a check
fails.
"""

import argparse
import json
import os
import queue
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import xxhash
import zenoh
import zenoh.ext

import zenoh_peer


def free_places():
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as other:
        return [f"tcp/127.0.0.1:{free.getsockname()[1]}" for free in (one, other)]


def meet(listen, *dial):
    return f"listen/endpoints={json.dumps([listen])};connect/endpoints={json.dumps(dial)}"


# The addresses of this process and of eddy. The sdk connects to both: peers that learn of each other through a third do not always connect.
PLACE, EDDYS = free_places()
os.environ["ZENOH_CONFIG_OVERRIDE"] = meet("tcp/127.0.0.1:0", PLACE, EDDYS)
EDDY = {**os.environ, "ZENOH_CONFIG_OVERRIDE": meet(EDDYS, PLACE)}

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Subscriber, get_topic_names_and_types

STRING, DDS_NAME = "std_msgs/msg/String", "std_msgs::msg::dds_::String_"
ENDLESS = QosTime(9223372036, 854775807)
LATCHED = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, ENDLESS, ENDLESS,
    QosLiveliness.AUTOMATIC, ENDLESS, False,
)
# The same in the notation of rmw_zenoh's liveliness tokens.
TOKEN_QOS = ":1:,1:,:,:,,"
TIMEOUT = 60


def expect(holds, sentence):
    if not holds:
        sys.exit(f"latched_peer.py: {sentence}")


def first(messages, what):
    try:
        return messages.get(timeout=TIMEOUT)
    except queue.Empty:
        sys.exit(f"latched_peer.py: {what} received nothing within {TIMEOUT} s")


class Peer:
    """A topic of strings on eclipse-zenoh, in rmw_zenoh's form."""

    def __init__(self, topic):
        self.store, self.topic = get_typestore(Stores.ROS2_JAZZY), topic
        config = zenoh.Config()
        for key, value in {
            "mode": "peer", "scouting/multicast/enabled": False, "timestamping/enabled": True,
            "listen/endpoints": [PLACE],
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.hash = self.store.hash_rihs01(STRING)
        self.domain = int(os.environ.get("ROS_DOMAIN_ID", 0))
        self.key = f"{self.domain}/{topic.strip('/')}/{DDS_NAME}/{self.hash}"

    def tokens(self):
        """The publishers of the topic."""
        name = self.topic.replace("/", "%")
        replies = self.session.liveliness().get(
            f"@ros2_lv/{self.domain}/*/*/*/MP/*/*/*/{name}/*/*/*", timeout=1)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def subscribe(self):
        messages = queue.Queue()
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self.session, self.key, messages.put,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True), subscriber_detection=True,
        )
        return subscriber, messages

    def publish(self, text):
        """Publish one message and keep it as long as the returned objects live."""
        publisher = zenoh.ext.declare_advanced_publisher(
            self.session, self.key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True,
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
        )
        name = self.topic.replace("/", "%")
        token = (f"@ros2_lv/{self.domain}/{self.session.zid()}/0/1/MP/%/%/latched_peer/{name}/{DDS_NAME}/{self.hash}"
                 f"/{TOKEN_QOS}")
        gid = xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
        attachment = zenoh_peer.ATTACHMENT.pack(1, time.time_ns(), 16, gid)
        message = self.store.types[STRING](data=text)
        publisher.put(bytes(self.store.serialize_cdr(message, STRING)), attachment=attachment)
        return publisher, self.session.liveliness().declare_token(token)

    def text(self, payload):
        return self.store.deserialize_cdr(bytes(payload), STRING).data


def write_bag(path, store, texts):
    """Messages ten minutes apart."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/latched", STRING, typestore=store, offered_qos_profiles=[LATCHED])
        for number, text in enumerate(texts):
            data = store.serialize_cdr(store.types[STRING](data=text), STRING)
            writer.write(connection, 1_000_000_000 + number * 600_000_000_000, bytes(data))


def eddy_keeps(eddy, topic, folder):
    peer = Peer(topic)
    write_bag(folder / "latched", peer.store, ["kept", "much later"])
    replay = subprocess.Popen([
        eddy, "--quiet", "replay", str(folder / "latched"), "--to", "zenoh", "--remap", f"/latched:={topic}"],
        env=EDDY)
    try:
        deadline = time.monotonic() + TIMEOUT
        while not (tokens := peer.tokens()):
            expect(time.monotonic() < deadline, "the replay's publisher was not discovered")
            time.sleep(0.1)
        expect(tokens[0].endswith(f"/{TOKEN_QOS}"), f"token: found {tokens[0]}, expected {TOKEN_QOS}")
        # The first message has been published; the next one follows ten minutes later.
        time.sleep(1)
        subscriber, messages = peer.subscribe()
        sample = first(messages, "zenoh-ext's subscriber")
        expect(str(sample.key_expr) == peer.key and peer.text(sample.payload) == "kept", f"zenoh-ext: found {sample}")
        expect(len(bytes(sample.attachment)) == 33, "zenoh-ext: no attachment in rmw_zenoh's form")
        heard = queue.Queue()
        # It queries once, and only the publishers that it knows by then.
        while topic not in dict(get_topic_names_and_types()):
            expect(time.monotonic() < deadline, "the sdk did not discover the replay's publisher")
            time.sleep(0.05)
        listener = ROS2Subscriber(topic, STRING, heard.put, msg_definition="string data\n", qos=TOKEN_QOS)
        expect(first(heard, "the sdk's subscriber").data == "kept", "the sdk's subscriber: found another message")
        time.sleep(1)
        expect(messages.empty() and heard.empty(), "a kept message was received twice")
        listener.close()
        subscriber.undeclare()
    finally:
        replay.kill()
        replay.wait()
        peer.session.close()


def eddy_takes(eddy, topic, folder):
    peer = Peer(topic)
    kept = peer.publish("kept")
    link, output = f"zenoh:{topic}", folder / "recorded"
    echo = subprocess.run(
        [eddy, "--quiet", "topic", "echo", link, "--count", "1"], timeout=TIMEOUT, capture_output=True, text=True,
        env=EDDY)
    expect(echo.stdout == "data: kept\n---\n", f"eddy topic echo: found {echo.stdout!r} {echo.stderr!r}")
    subprocess.run([
        eddy, "--quiet", "record", "--regex", f"^{topic}$", "--from", "zenoh", "--max-messages", "1",
        "--output", str(output)], timeout=TIMEOUT, check=True, env=EDDY)
    with Reader(output) as reader:
        texts = [peer.text(data) for _, _, data in reader.messages()]
        profiles = [profile for connection in reader.connections for profile in connection.ext.offered_qos_profiles]
    expect(texts == ["kept"], f"eddy record: found {texts}")
    expect(profiles == [LATCHED], f"eddy record: found {profiles}, expected {LATCHED}")
    del kept
    peer.session.close()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("eddy")
    parser.add_argument("topic")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        # Topic names without slashes: the sdk does not find kept messages of other topics.
        eddy_keeps(args.eddy, f"{args.topic}_ours", Path(folder))
        eddy_takes(args.eddy, f"{args.topic}_theirs", Path(folder))
    print(json.dumps({"kept by eddy": ["zenoh-ext", "zenoh-ros2-sdk"], "taken by eddy": ["echo", "record"]}), flush=True)
    # The sdk's threads would outlive its session.
    os._exit(0)


if __name__ == "__main__":
    main()
