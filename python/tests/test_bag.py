"""Bags, also beside rosbags."""

from pathlib import Path

import eddy
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML

yaml = YAML(typ="safe")


def test_frames_come_back_as_they_were_written(tmp_path: Path) -> None:
    frames = list(eddy.Solver(eddy.Scene.generate("kinds", seed=4, id=3, particles=300), duration=0.1))
    with eddy.BagWriter(tmp_path / "bag", compression="lz4") as writer:
        for frame in frames:
            writer.write_frame(frame)
    bag = eddy.Bag(tmp_path / "bag")
    assert list(bag.frames()) == frames
    assert (len(bag), bag.start, bag.end, bag.damage) == (len(frames), 0, frames[-1].stamp, None)
    arrays = bag.arrays()
    assert arrays["position"].shape == (len(frames), len(frames[0]), 2)
    assert np.array_equal(arrays["velocity"][2], frames[2].velocity)
    assert arrays["time"][1] == 0.016 and arrays["sequence"].dtype == np.uint64


def test_rosbags_reads_what_python_writes(bags: Path) -> None:
    with AnyReader([bags / "scene_0000"]) as reader:
        connection = next(c for c in reader.connections if c.topic == "/particles")
        assert connection.msgtype == "eddy_msgs/msg/ParticleFrame"
        _, _, data = next(reader.messages(connections=[connection]))
        message = reader.deserialize(data, connection.msgtype)
    first = next(eddy.Bag(bags / "scene_0000").frames())
    assert np.array_equal(np.asarray(message.position).reshape(-1, 2), first.position)


def test_messages_of_any_type(tmp_path: Path) -> None:
    data = b"\x00\x01\x00\x00" + (6).to_bytes(4, "little") + b"hello\x00"
    with eddy.BagWriter(tmp_path / "bag") as writer:
        writer.write("/chatter", "std_msgs/msg/String", data, log_time=5, publish_time=4)
        writer.write("/own", "own_msgs/msg/Word", data, definition="string data\n", log_time=6)
        with pytest.raises(ValueError, match="definition: "):
            writer.write("/bad", "own_msgs/msg/Bad", data, definition="no definition at all !\n", log_time=6)
    bag = eddy.Bag(tmp_path / "bag")
    assert [topic["name"] for topic in bag.topics] == ["/chatter", "/own"]
    first, second = bag.messages()
    assert (first.topic, first.type, first.data) == ("/chatter", "std_msgs/msg/String", data)
    assert (first.log_time, first.publish_time, second.log_time) == (5, 4, 6)
    assert [message.topic for message in bag.messages("/own")] == ["/own"]
    assert [message.topic for message in bag.messages(end=5)] == ["/chatter"]
    with pytest.raises(ValueError, match="topics: found /absent, expected /chatter, /own"):
        bag.messages(["/own", "/absent"])
    with pytest.raises(eddy.BagError, match="/particles"):
        bag.frames()


def test_tools_come_back_as_they_were_written(tmp_path: Path, block: eddy.Frame) -> None:
    tools = [
        {"name": "blade", "shape": {"rectangle": {"size": [0.1, 0.2]}}, "contact": {"friction": 0.5}},
        {"name": "floor", "shape": "half_plane", "contact": "slip"},
    ]
    pose = np.array([[0.5, 0.25, 0.125], [0.0, 0.0625, 0.0]], np.float32)
    twist, wrench = np.ones((2, 3), np.float32), np.array([[1.0, -2.0, 0.5], [0.0, 8.0, 0.0]])
    after = eddy.Frame(block.position, block.velocity, block.material, sequence=block.sequence + 1, time=1.0)
    with eddy.BagWriter(tmp_path / "bag") as writer:
        for frame in (block, after):
            writer.write_frame(frame, "/left/particles")
        writer.write_tools(block, tools, pose, "/left/particles")
        writer.write_tools(after, tools, pose + 1, "/left/particles", twist=twist, wrench=wrench)
        with pytest.raises(ValueError, match="tools: found other tools, expected those"):
            writer.write_tools(after, tools[::-1], pose, "/left/particles")
        with pytest.raises(ValueError, match=r"pose: found .*, expected shape \[2, 3\]"):
            writer.write_tools(after, tools, pose[:1])
        with pytest.raises(ValueError, match=r"tools\[0\]\.shape\.disc\.radius: found -1"):
            writer.write_tools(after, [{"name": "ball", "shape": {"disc": {"radius": -1}}}], pose[:1])
        with pytest.raises(ValueError, match="found .*NaN.*, expected"):
            writer.write_tools(after, tools, pose * np.float32("nan"))
    bag = eddy.Bag(tmp_path / "bag")
    found = bag.tools("/left/particles")
    assert found["tools"][1] == tools[1] and found["tools"][0]["contact"] == {"friction": 0.5}
    assert found["sequence"].tolist() == [block.sequence, after.sequence]
    assert np.array_equal(found["pose"], np.stack([pose, pose + 1]))
    assert np.array_equal(found["twist"], np.stack([0 * twist, twist]))
    assert np.isnan(found["wrench"][0]).all() and np.array_equal(found["wrench"][1], wrench)
    with pytest.raises(ValueError, match=r"/particles: found tools of streams \[\], expected"):
        bag.tools()


def test_a_closed_writer_and_a_taken_name(tmp_path: Path, block: eddy.Frame) -> None:
    writer = eddy.BagWriter(tmp_path / "bag")
    writer.write_frame(block)
    assert writer.close() == 1
    assert writer.close() == 0
    with pytest.raises(ValueError, match="this bag is closed"):
        writer.write_frame(block)
    with pytest.raises(eddy.BagError, match="already exists"):
        eddy.BagWriter(tmp_path / "bag")
    with pytest.raises(ValueError, match="compression: found gzip"):
        eddy.BagWriter(tmp_path / "other", compression="gzip")  # type: ignore[arg-type]
    with pytest.raises(eddy.BagError):
        eddy.Bag(tmp_path / "absent")


def test_the_stiffness_of_a_bag(tmp_path: Path, block: eddy.Frame) -> None:
    path, entries = tmp_path / "bag", {"eddy_stiffness": "1e4", "run": 'seven: "7"\n'}
    with eddy.BagWriter(path, custom_data=entries) as writer:
        writer.write_frame(block)
    assert eddy.Bag(path).custom_data == entries
    stated = yaml.load(path / "metadata.yaml")["rosbag2_bagfile_information"]["custom_data"]
    assert stated == entries
    for key, value, expected in [
        ("eddy_stiffness", "-1", "a positive number"),
        ("eddy_topics_not_recorded", "/a", "another key: eddy writes this one"),
    ]:
        with pytest.raises(ValueError, match=f"custom_data: found {key}={value}, expected {expected}"):
            eddy.BagWriter(tmp_path / "other", custom_data={key: value})
    assert not (tmp_path / "other").exists()


def test_streams_are_told_apart(tmp_path: Path, block: eddy.Frame) -> None:
    other = eddy.Frame(block.position, block.velocity, "jelly", stream=1)
    with eddy.BagWriter(tmp_path / "bag") as writer:
        writer.write_frame(block)
        writer.write_frame(other)
    bag = eddy.Bag(tmp_path / "bag")
    with pytest.raises(ValueError, match="/particles: found frames of streams 0 and 1, expected one stream"):
        bag.arrays()
    assert bag.arrays(stream=1)["position"].shape == (1, 400, 2)
    with pytest.raises(ValueError, match="found no frames of stream 9"):
        bag.arrays(stream=9)


def test_a_damaged_bag_raises_after_its_whole_messages(tmp_path: Path, bags: Path) -> None:
    source = next((bags / "scene_0001").glob("*.mcap"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(source.read_bytes()[: source.stat().st_size // 2])
    bag = eddy.Bag(cut)
    assert bag.damage is not None
    frames = bag.frames()
    count = 0
    with pytest.raises(eddy.BagError):
        for _ in frames:
            count += 1
    assert 0 < count < len(eddy.Bag(source))
